"""Losses of the encoder (paper III-F): geometric, terrain and trajectory, each averaged over measured cells only."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.effects import controls
from monoforce_ros.encoder import SMALLEST_DECREASE, EncodedMaps, EncoderConfig
from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap
from monoforce_ros.training.recording_samples import CHUNK
from monoforce_ros.training.samples import Targets
from monoforce_ros.training.trajectory_residual import robust_loss, trajectory_residual

HIGHEST, LOWEST = 1.0, -1.5
"""Heights relative to the ground under the robot are clamped to this range [m]: a tree is a wall (paper, figure 6)."""
_HUBER_DELTA = SMALLEST_DECREASE
"""Height errors beyond this count linearly, so that a few walls and trees do not outweigh the ground [m]."""
_PROMINENT_HEIGHT, _NEIGHBOURHOOD = 0.3, 12
"""Height over the neighbourhood's mean of a fully prominent cell [m]; half-width of the neighbourhood [cells]."""
_OUT_OF_VIEW = 0.1
"""Weight of measured cells out of every camera's view, which can only be inferred from their surroundings."""
_MEAN_FRICTION = -0.41
"""Mean of the logarithm of the friction of randomised worlds, seeds 420000 to 420119."""
_SLOPE_BASELINE = 0.6
"""Distance over which slopes are compared [m]: about the wheelbase and track width of a robot."""
_HORIZONTAL_SCALE, _VERTICAL_SCALE, _TILT_SCALE, _HEADING_SCALE = 0.15, 0.03, np.radians(2.0), np.radians(4.0)
"""Scales of pose residuals [m, m, rad, rad]; wider horizontally and in heading because both depend on slip."""


@dataclass(frozen=True)
class LossWeights:
    """Weights of the losses; 0 disables one."""

    geometric: float = 1.0
    terrain: float = 2.0
    slope: float = 2.0
    """Of slopes of H_t between cells in contact; only with the terrain loss."""
    trajectory: float = 0.05
    decrease: float = 0.3
    """Of the mean square of H_d (λ_d of the paper's equation 3)."""
    measured_decrease: float = 2.0
    """Of H_d where both surfaces were measured; only with the geometric and the terrain loss."""
    prominent_decrease: float = 0.1
    """Of H_d on prominent cells without contact; only with the geometric loss."""
    prominence: float = 3.0
    """Additional relative weight of prominent cells in the geometric loss."""

    spread: float = 0.05
    """Of the likelihood of the heights' errors, which trains their spreads only."""
    depth: float = 0.2
    """Of the depth along each pixel's ray that the lidar measured."""
    friction: float = 0.1
    """Of the logarithm of the friction, where it is known."""

    def __post_init__(self):
        for name in (entry.name for entry in fields(self)):
            if not 0.0 <= getattr(self, name) <= 1e6:
                raise ValueError(f"loss weight {name}: got {getattr(self, name)}, expected 0 or more")
        if self.geometric == self.terrain == self.trajectory == 0.0:
            raise ValueError("loss weights: got 0 for geometric, terrain and trajectory, expected at least one above 0")


def geometric_loss(
    maps: EncodedMaps, targets: Targets, ground: Tensor, prominence: float = LossWeights.prominence
) -> Tensor:
    """Equation 4 averaged over cells measured by the lidar, with a Huber instead of a squared loss.

    Prominent cells weigh up to ``1 + prominence`` times as much: walls, trunks and edges of grass cover few cells, and
    a loss that is linear in the error is smallest if they are ignored.
    """
    measured = _clamped(targets.geometric, ground)
    weight = targets.observed * _view_weight(maps) * (1.0 + prominence * _prominence(targets, ground))
    # What is measured beyond a limit must be predicted beyond it, no matter how far.
    low, high = (ground[:, None, None] + limit for limit in (LOWEST, HIGHEST))
    predicted = torch.where(targets.geometric > high, torch.minimum(maps.geometric_height, high), maps.geometric_height)
    predicted = torch.where(targets.geometric < low, torch.maximum(predicted, low), predicted)
    return _huber(predicted, measured, weight)


def terrain_loss(
    maps: EncodedMaps, targets: Targets, ground: Tensor, prominence: float = LossWeights.prominence
) -> Tensor:
    """First part of equation 3 averaged over the contact mask, with a Huber instead of a squared loss.

    Prominent cells weigh more, as in :func:`geometric_loss`: whether they are firm or soft concerns few cells, and half
    of their height is a cheap answer.
    """
    weight = targets.contact_mask * _view_weight(maps) * (1.0 + prominence * _prominence(targets, ground))
    return _huber(maps.height, targets.supporting, weight)


def slope_loss(maps: EncodedMaps, targets: Targets, resolution: float) -> Tensor:
    """Huber loss of height differences of H_t [m] between pairs of contact cells, in four directions.

    A robot rests on several cells at once: a common height error lifts it, different errors tilt it. The terrain loss
    (equation 3), a sum over cells, does not distinguish the two.
    """
    weight = targets.contact_mask * _view_weight(maps)
    error = torch.where(targets.contact_mask, maps.height - targets.supporting, 0.0)
    straight, diagonal = (max(round(_SLOPE_BASELINE * share / resolution), 1) for share in (1.0, 0.5**0.5))
    losses = []
    for rows, columns in ((straight, 0), (0, straight), (diagonal, diagonal), (diagonal, -diagonal)):
        first, second = ((_shifted(error, *by), _shifted(weight, *by)) for by in ((rows, columns), (-rows, -columns)))
        losses.append(_huber(first[0], second[0], first[1] * second[1]))
    return torch.stack(losses).mean()


def decrease_loss(maps: EncodedMaps) -> Tensor:
    """Second part of equation 3: a prior towards H_d = 0, the visible surface supporting the robot."""
    return (maps.decrease**2).mean()


def prominent_decrease_loss(maps: EncodedMaps, targets: Targets, ground: Tensor) -> Tensor:
    """Second part of equation 3 on prominent cells without contact: the mean square of H_d there.

    Motion supervises H_d only where a robot drives. It drives through grass and never through walls, so a network
    trained on grass alone would lower walls too. This loss keeps prominent cells without contact at their visible
    height; for grass the losses on contact cells oppose it, for walls none does. It is squared, so that cells subject
    to both settle in between rather than at 0.
    """
    weight = _prominence(targets, ground) * (targets.observed & ~targets.contact_mask) * _view_weight(maps)
    return _mean_over_maps(maps.decrease**2, weight)


def measured_decrease_loss(maps: EncodedMaps, targets: Targets) -> Tensor:
    """Huber loss of H_d on contact cells that the lidar measured, where both surfaces are known.

    The geometric and the terrain loss supervise H_d only through a difference of heights; an encoder that does not yet
    recognise grass tends to lower H_g instead.
    """
    measured = (targets.geometric - targets.supporting).clamp(0.0, HIGHEST)
    known = targets.contact_mask & targets.observed
    return _huber(maps.decrease, torch.where(known, measured, 0.0), known * _view_weight(maps))


def spread_loss(maps: EncodedMaps, targets: Targets, ground: Tensor) -> Tensor:
    """Negative log-likelihood of the errors of H_g and H_d under Laplace distributions, as a function of their scales.

    The errors have no gradient: uncertain places would otherwise count less in the heights' own losses, walls above
    all, and the network would never learn them.
    """
    measured = _clamped(targets.geometric, ground)
    error = (_clamped(maps.geometric_height, ground) - measured).detach().abs()
    loss = _mean_over_maps(
        error / maps.geometric_spread + maps.geometric_spread.log(), targets.observed * _view_weight(maps)
    )
    known = targets.contact_mask & targets.observed
    depth = torch.where(known, (targets.geometric - targets.supporting).clamp(0.0, HIGHEST), 0.0)
    error = (maps.decrease - depth).detach().abs()
    return loss + _mean_over_maps(error / maps.decrease_spread + maps.decrease_spread.log(), known * _view_weight(maps))


def depth_loss(maps: EncodedMaps, targets: Targets, depths: Tensor) -> Tensor:
    """:func:`ray_depth_loss` of a batch; 0 without images."""
    if maps.depth is None or not len(targets.depth):
        return maps.geometric_height.sum() * 0.0
    return ray_depth_loss(maps.depth, targets.depth, depths)


def ray_depth_loss(log_probability: Tensor, measured: Tensor, depths: Tensor, weight: Tensor | float = 1.0) -> Tensor:
    """Cross-entropy of the depth bins along the rays of features that the lidar measured.

    Args:
        log_probability: logarithm of the depth probabilities ``[N, bins, rows, columns]``.
        measured: depths ``[N, rows, columns]`` [m]; 0 where none was measured.
        depths: depth of each bin ``[bins]`` [m].
        weight: of each ray, shaped like ``measured``.
    """
    known = weight * ((measured >= depths[0]) & (measured <= depths[-1]))
    # Bins are evenly spaced in the logarithm.
    step = (depths[-1] / depths[0]).log() / (len(depths) - 1)
    place = (measured.clamp_min(float(depths[0])) / depths[0]).log() / step
    bins = place.round().long().clamp(0, len(depths) - 1)
    loss = -log_probability.gather(1, bins[:, None])[:, 0]
    return (loss * known).sum() / known.sum().clamp_min(1.0)


def friction_loss(maps: EncodedMaps, targets: Targets, config: EncoderConfig) -> Tensor:
    """Huber loss of the logarithm of friction relative to average ground, where it is known and in view.

    Ground of which nothing tells has the configuration's friction.
    """
    known = torch.isfinite(targets.friction) & maps.covered
    error = (maps.friction / config.friction).log() - torch.where(known, targets.friction - _MEAN_FRICTION, 0.0)
    return _mean_over_maps(functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=0.2), known)


def trajectory_loss(
    maps: EncodedMaps, targets: Targets, robot: RobotModel, config: EncoderConfig, options: PhysicsOptions
) -> Tensor:
    """Equation 2 over chunks of motion that start at measured states: Huber loss of scaled pose residuals.

    Heights get a gradient on contact cells only. Otherwise a wall predicted slightly too close to the path, which the
    predicted robot hits, would be lowered.
    """
    if not len(targets.map_of):
        return maps.geometric_height.sum() * 0.0
    heights = {
        name: torch.where(targets.contact_mask, getattr(maps, name), getattr(maps, name).detach())[targets.map_of]
        for name in ("height", "geometric_height")
    }
    terrain = TerrainMap(
        **heights,
        **{name: getattr(maps, name)[targets.map_of] for name in ("stiffness", "damping", "friction")},
        observed=maps.covered[targets.map_of],
        grid=config.grid,
    )
    steps = round(CHUNK / options.time_step)
    history = targets.twists.shape[1] - steps
    with torch.no_grad():
        given = controls(robot, targets.twists, options.time_step, history=history)
    start = State(
        targets.positions[:, 0].clone(), targets.rotations[:, 0].clone(), targets.velocity, targets.angular_velocity
    )
    result = rollout(terrain, robot, given, start, options=options, with_forces=False)
    index = torch.linspace(0, steps, targets.positions.shape[1]).round().long()
    positions, rotations = result.position[:, index[1:]], result.rotation[:, index[1:]]
    translation, rotation = trajectory_residual(
        positions, rotations, targets.positions[:, 1:], targets.rotations[:, 1:]
    )
    parts = [
        translation[..., :2] / _HORIZONTAL_SCALE,
        translation[..., 2:] / _VERTICAL_SCALE,
        rotation[..., :2] / _TILT_SCALE,
        rotation[..., 2:] / _HEADING_SCALE,
    ]
    loss = robust_loss(torch.cat(parts, dim=-1), 2.0).mean(dim=(1, 2))
    # Chunks that leave the map end on ground without a prediction.
    grid = config.grid
    left, right, bottom, top = grid.extent
    x, y = targets.positions[..., 0], targets.positions[..., 1]
    inside = ((x > left) & (x < right) & (y > bottom) & (y < top)).all(dim=1) & torch.isfinite(loss)
    return torch.where(inside, loss, 0.0).sum() / inside.sum().clamp_min(1)


def _view_weight(maps: EncodedMaps) -> Tensor:
    return torch.where(maps.covered, 1.0, _OUT_OF_VIEW)


def _clamped(heights: Tensor, ground: Tensor) -> Tensor:
    above = heights - ground[:, None, None]
    return ground[:, None, None] + above.clamp(LOWEST, HIGHEST)


def _prominence(targets: Targets, ground: Tensor) -> Tensor:
    """Height of measured cells over the mean of their measured neighbours, scaled to 0..1 ``[B, rows, columns]``."""
    heights = _clamped(targets.geometric, ground)
    mask = targets.observed.to(heights.dtype)
    summed, count = (_box_mean(values, _NEIGHBOURHOOD) for values in (heights * mask, mask))
    return ((heights - summed / count.clamp_min(1e-6)) / _PROMINENT_HEIGHT).clamp(0.0, 1.0)


def _box_mean(values: Tensor, reach: int) -> Tensor:
    """Mean over squares of ``2 · reach + 1`` cells ``[B, rows, columns]``, zeros outside: along rows, then columns."""
    window = 2 * reach + 1
    along = functional.avg_pool2d(values[:, None], (window, 1), 1, (reach, 0))
    return functional.avg_pool2d(along, (1, window), 1, (0, reach))[:, 0]


def _shifted(values: Tensor, rows: int, columns: int) -> Tensor:
    """Maps without their first rows and columns, or without the last for negative shifts; opposite shifts align."""
    return values[
        :,
        slice(max(rows, 0), min(rows, 0) or None),
        slice(max(columns, 0), min(columns, 0) or None),
    ]


def _huber(predicted: Tensor, measured: Tensor, weight: Tensor) -> Tensor:
    """Huber loss (in metres, linear beyond its delta), averaged by :func:`_mean_over_maps`."""
    loss = functional.smooth_l1_loss(predicted, measured, reduction="none", beta=_HUBER_DELTA)
    return _mean_over_maps(loss, weight)


def _mean_over_maps(error: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean over the cells of each map, then the mean over maps with any weight."""
    weight = weight.to(error.dtype)
    total = weight.sum(dim=(1, 2))
    mean = (error * weight).sum(dim=(1, 2)) / total.clamp_min(1e-6)
    weighted = total > 0
    return torch.where(weighted, mean, 0.0).sum() / weighted.sum().clamp_min(1)
