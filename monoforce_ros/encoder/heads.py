"""Heads: features of a map → heights, their spread and material, each within its bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from monoforce_ros.encoder.config import EncoderConfig
from monoforce_ros.encoder.edges import restore_edges
from monoforce_ros.encoder.sweep import BETWEEN, HIT, LOWEST, STANDING, TOP
from monoforce_ros.encoder.view import EncoderInput
from monoforce_ros.terrain import TerrainMap, fill_holes

SMALLEST_DECREASE = 0.05
"""Smallest H_d that is used [m], and where the training's loss of heights turns from squared to linear: below, an
unsure network predicts a little vegetation everywhere at hardly any cost."""
_LAYER_REACH = 0.1
"""Half-width of the square whose mean H_d decides that [m], a wheel's width: cell by cell, what hovers about the limit
would become a ground of steps and holes. On 24 worlds for choosing paths are as good as cell by cell, and 2 % worse
with half a metre (docs/training.md)."""
_HEADS, _SWEEP_HEADS = 7, 2
"""And those for how far heights that a sweep measured are believed, and how far they carry; another one for heights
interpolated between them."""
_SOFTPLUS_BETA = 5.0
"""Sharpness β of the softplus that keeps H_d ≥ 0 [1/m]. Its gradient vanishes far below 0: a sharper bend starts there,
or firm ground pushes the whole map there before grass is distinguished from it."""
_FIRM = -0.4
"""Initial output of the head of H_d, before the softplus: 2.5 cm, with an eighth of the full gradient [m]."""
_INITIAL_SPREAD = 0.1
_SMALLEST_SPREAD, _LARGEST_SPREAD = 0.01, 3.0
"""Scales of the Laplace distribution of a height [m]: untrained, and limits."""
_BELIEVED = 3.0
"""Initial output of the heads for measured heights, before the logistic function: 95 %."""
_CELL_TOLERANCE = 0.05
"""How far a surface may lie beyond the returns of its cell [m]: noise, and half of what a slope of 45° rises in it."""
_WORTH_CORRECTING = 0.02
"""Least correction by returns [m]: a lidar's noise."""
_BESIDE = 10
"""Distance [cells] within which returns that lie in no plane keep a surface from being lowered."""
_CARRIED = 4.0, 10.0
"""Distances from a corrected cell up to which its correction holds, and from which on there is none [cells]."""
_SUPPORTED = 0.4, 1.0
"""Distances from a return up to which bands are as narrow as a sweep's, and from which on they are those of images [m].
With sweeps of all directions and of a sector (11 worlds for choosing), a sweep's bands hold 89 to 98 % of the cells
within half a metre (83 % just beyond the last ring of one that ends at 3 m), 85 to 89 % up to a metre, and 80 to 87
% from there on, where the worst scenes ask for twice as wide ones."""
_AT_THE_WHEELS = 0.999
"""Weight of the plane under the wheels above which the ground is that one, up to 1 m from the robot."""
_PLANE, _PLANE_REACH, _FEWEST_CELLS, _LEAST_SPREAD = 0.04, 3, 8, 0.5
"""Scatter of returns about a plane that is a surface [m], twice a lidar's noise; half-width of the squares in which it
is sought [cells]; fewest of their cells with returns; and least determinant of their places [cells⁴]: returns on one
line have no plane. Tops of grass scatter by a decimetre."""
_OBSERVED = 0.05
"""Least summed depth probability of an observed cell."""


@dataclass(frozen=True)
class EncodedMaps:
    """Predictions for a batch; each ``[B, rows, columns]``, heights in the terrain frame [m]."""

    geometric_height: Tensor
    decrease: Tensor
    """H_d ≥ 0: depth of the supporting ground below the visible surface."""
    stiffness: Tensor
    """[N/m³]."""
    damping: Tensor
    """[N s/m³]."""
    friction: Tensor
    geometric_spread: Tensor
    decrease_spread: Tensor
    """Scale of the Laplace distribution of H_g and of H_d [m]: the mean of their absolute errors."""
    covered: Tensor
    """Whether a cell is in the field of view (bool)."""
    evidence: Tensor
    """Summed depth probability of the features in a cell."""
    depth: Tensor | None = None
    """Logarithm of the depth probabilities of each image ``[N, bins, feature rows, feature columns]``."""

    @property
    def height(self) -> Tensor:
        """H_t = H_g - H_d (paper III-A)."""
        return self.geometric_height - self.decrease


def map_heads(config: EncoderConfig) -> nn.Conv2d:
    """Untrained heads for H_g, H_d, stiffness, damping, friction, the spreads of H_g and H_d, and measured heights.

    All weights start at zero, which encodes the ground that carries the robot (and the surface that a sweep measured)
    with the configuration's material; without a loss they stay there.
    """
    heads = nn.Conv2d(config.map_features, _HEADS + _SWEEP_HEADS * config.believes + config.interpolates, kernel_size=1)
    assert heads.bias is not None
    with torch.no_grad():
        heads.weight.zero_()
        heads.bias.zero_()
        heads.bias[1] = _FIRM
        if config.believes:
            heads.bias[_HEADS:] = _BELIEVED
    return heads


def maps_from_heads(
    outputs: Tensor,
    batch: EncoderInput,
    config: EncoderConfig,
    covered: Tensor,
    evidence: Tensor,
    depth: Tensor | None = None,
    *,
    training: bool = False,
) -> EncodedMaps:
    """Heights, spreads and material from outputs of the heads ``[B, 7..10, rows, columns]``, each within its bounds.

    H_g is a correction to the ground that carries the robot. Where a sweep measured something, an eighth output says
    how far that is believed instead, and a ninth how far what rises there carries: a network that predicted all heights
    anew would blur the steps of walls and posts into slopes, and a smooth H_d below single leaves would leave spikes in
    H_t. Between such cells, a tenth output says how far the interpolation is believed.

    In ``training`` spreads are the network's own, which would otherwise learn to make up for the factors on them that
    are calibrated afterwards.
    """
    # Channel by channel in memory: each is used alone.
    outputs = outputs.contiguous()
    geometric, decrease, stiffness, damping, friction, geometric_spread, decrease_spread = outputs[:, :_HEADS].unbind(1)
    below = functional.softplus(decrease, beta=_SOFTPLUS_BETA)
    if config.believes:
        believed, carries, *others = torch.sigmoid(outputs[:, _HEADS:]).unbind(1)
        standing = batch.sweep[:, STANDING]
        rise = believed * standing * (batch.sweep[:, TOP] - batch.anchor)
        if config.interpolates:
            # Without a sweep there is nothing between.
            between = others[0] * (standing.amax(dim=(1, 2), keepdim=True) - standing)
            rise = rise + between * (batch.sweep[:, BETWEEN] - batch.anchor)
            # What is believed is not corrected: pictures or points of another world would spoil what was measured.
            geometric = geometric * (1.0 - believed * standing - between)
        geometric, below = geometric + rise, below + (1.0 - carries) * rise.clamp_min(0.0)
    alone = torch.zeros_like(geometric) if training else _images_alone(batch, config)
    wider = config.geometric_spread_factor * config.image_spread_factor**alone
    deeper = config.decrease_spread_factor * config.image_decrease_spread_factor**alone
    return EncodedMaps(
        geometric_height=geometric + batch.anchor + batch.ground[:, None, None],
        decrease=below if config.decreases else torch.zeros_like(below),
        stiffness=config.stiffness * torch.exp(stiffness.clamp(-4.0, 4.0)),
        damping=config.damping * torch.exp(damping.clamp(-4.0, 4.0)),
        friction=config.friction * torch.exp(friction.clamp(-3.0, 1.0)),
        geometric_spread=_spread(geometric_spread) * (1.0 if training else wider),
        decrease_spread=_spread(decrease_spread) * (1.0 if training else deeper),
        covered=covered,
        evidence=evidence,
        depth=depth,
    )


def _images_alone(batch: EncoderInput, config: EncoderConfig) -> Tensor:
    """How far a map rests on images alone, with no return of a sweep nearby: 0 to 1, ``[B, rows, columns]``."""
    hit = batch.sweep[:, HIT].cpu().numpy() > 0
    if not (config.takes_sweeps and hit.any()):
        return torch.ones_like(batch.anchor)
    limits = tuple(distance / config.resolution for distance in _SUPPORTED)
    measured = np.stack([_fading(cells, limits) if cells.any() else np.zeros(cells.shape) for cells in hit])
    return 1.0 - torch.as_tensor(measured).to(batch.anchor)


def _spread(output: Tensor) -> Tensor:
    limits = math.log(_SMALLEST_SPREAD), math.log(_LARGEST_SPREAD)
    return (output + math.log(_INITIAL_SPREAD)).clamp(*limits).exp()


def within_returns(maps: EncodedMaps, batch: EncoderInput) -> EncodedMaps:
    """Maps whose surface is, where returns lie in a plane, between the lowest and the highest of each cell.

    A network that has never seen a hillside of 20° puts it a metre too low, and is sure of it. Returns of vegetation
    lie in no plane: what its surface is, the network knows better. So it does under what stands there with a gap below,
    a car or a guard rail, whose floor a lidar sees: beside what is no plane nothing is lowered. Corrections are
    interpolated between the cells with returns, but not far beyond them, and not into the ground at the wheels.
    """
    sweep = batch.sweep
    standing = sweep[:, STANDING] > 0
    low = sweep[:, LOWEST] - _CELL_TOLERANCE
    high = torch.maximum(sweep[:, TOP], sweep[:, LOWEST]) + _CELL_TOLERANCE
    relative = maps.geometric_height - batch.ground[:, None, None]
    beyond = torch.minimum(torch.maximum(relative, low), high) - relative
    beyond = torch.where(standing & (beyond.abs() > _WORTH_CORRECTING), beyond, 0.0)
    if not bool(beyond.any()):
        return maps
    solid = _roughness(sweep) < _PLANE
    beside = _within(standing & ~solid, _BESIDE)
    change = torch.where(solid & ~(beside & (beyond < 0.0)), beyond, 0.0)
    if not bool(change.any()):
        return maps
    plane = batch.support[:, 1].cpu().numpy() > _AT_THE_WHEELS
    added = [_carried(values, known | wheels) for values, known, wheels in
             zip(change.cpu().numpy(), standing.cpu().numpy(), plane, strict=True)]  # fmt: skip
    correction = torch.as_tensor(np.stack(added), dtype=change.dtype, device=change.device)
    return replace(maps, geometric_height=maps.geometric_height + correction)


def _within(cells: Tensor, reach: int) -> Tensor:
    """Cells ``[B, rows, columns]`` (bool) with one of ``cells`` in the square of half-width ``reach`` [cells]."""
    # Squares of 21 × 21 cells take PyTorch's pooling 3 ms, and 0.01 ms row by row and column by column.
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    pages = [cv2.dilate(page, square) for page in cells.cpu().numpy().astype(np.uint8)]
    return torch.as_tensor(np.stack(pages), device=cells.device) > 0


def _fading(cells: np.ndarray, limits: tuple[float, ...]) -> np.ndarray:
    """1 up to the first of two distances from any of ``cells`` [cells], and down to 0 at the second."""
    full, none = limits
    away = cv2.distanceTransform((~cells).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.clip((none - away) / (none - full), 0.0, 1.0)


def _carried(change: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Corrections ``[rows, columns]`` between cells where they are known [m]."""
    changed = known & (change != 0.0)
    if not changed.any():
        return np.zeros_like(change)
    return fill_holes(change, known) * np.where(known, 1.0, _fading(changed, _CARRIED))


def _roughness(sweep: Tensor) -> Tensor:
    """Standard deviation of the highest and lowest returns of cells about their plane in squares around each cell.

    ``[B, rows, columns]`` [m]; infinite where fewer than :data:`_FEWEST_CELLS` cells have returns.
    """
    device = sweep.device
    values = sweep[:, [STANDING, LOWEST, TOP]].double().cpu().numpy()
    rows, columns = values.shape[-2:]
    y, x = np.meshgrid(np.arange(rows) / rows, np.arange(columns) / rows, indexing="ij")
    size = 2 * _PLANE_REACH + 1
    pages = []
    for hit, low, high in values:
        z = 0.5 * (low + high)
        terms = (hit, hit * x, hit * y, hit * z, hit * x * x, hit * y * y, hit * x * y, hit * x * z, hit * y * z,
                 hit * z * z, hit * (0.5 * (high - low)) ** 2)  # fmt: skip
        pages.append([cv2.boxFilter(term, -1, (size, size), borderType=cv2.BORDER_CONSTANT) for term in terms])
    means = torch.as_tensor(np.array(pages), device=device)
    count = means[:, 0]
    mx, my, mz, xx, yy, xy, xz, yz, zz, within = (means[:, 1:] / count.clamp_min(1e-9)[:, None]).unbind(1)
    xx, yy, zz = xx - mx**2, yy - my**2, zz - mz**2
    xy, xz, yz = xy - mx * my, xz - mx * mz, yz - my * mz
    determinant = xx * yy - xy**2
    explained = (xz**2 * yy - 2 * xz * yz * xy + yz**2 * xx) / determinant.clamp_min(1e-15)
    rough = ((zz - explained).clamp_min(0.0) + within).sqrt()
    enough = (count * size**2 > _FEWEST_CELLS - 0.5) & (determinant * rows**4 > _LEAST_SPREAD)
    return torch.where(enough, rough, torch.inf)


def with_edges(maps: EncodedMaps, config: EncoderConfig) -> EncodedMaps:
    """Maps with steps restored in H_t; H_g changes by the same amount, so that H_d is unchanged."""
    change = restore_edges(maps.height, config.resolution) - maps.height
    return replace(maps, geometric_height=maps.geometric_height + change)


def _layer(decrease: Tensor, resolution: float) -> Tensor:
    """H_d ``[B, rows, columns]`` [m] where its mean nearby is that of a layer, 0 elsewhere."""
    reach = max(1, round(_LAYER_REACH / resolution))
    mean = functional.avg_pool2d(decrease[:, None], 2 * reach + 1, 1, reach, count_include_pad=False)[:, 0]
    return torch.where(mean > SMALLEST_DECREASE, decrease, 0.0)


def terrain_of(maps: EncodedMaps, batch: EncoderInput, config: EncoderConfig) -> TerrainMap:
    """The prediction for a batch of one, kept within the returns of its sweep where the network takes sweeps."""
    return terrain_maps(within_returns(maps, batch) if config.believes else maps, config)[0]


def terrain_maps(maps: EncodedMaps, config: EncoderConfig) -> list[TerrainMap]:
    """The predictions of a batch as terrain maps on the CPU.

    Where H_d is below :data:`SMALLEST_DECREASE` on average, it is no layer but a hedge, and left out.
    """
    maps = replace(maps, decrease=_layer(maps.decrease, config.resolution))
    values = {
        name: getattr(maps, name).detach().cpu()
        for name in (
            "height", "geometric_height", "stiffness", "damping", "friction", "geometric_spread", "decrease_spread",
        )
    }  # fmt: skip
    observed = ((maps.evidence > _OBSERVED) & maps.covered).detach().cpu()
    return [
        TerrainMap(**{name: value[i] for name, value in values.items()}, observed=observed[i], grid=config.grid)
        for i in range(len(observed))
    ]
