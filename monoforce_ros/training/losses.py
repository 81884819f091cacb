"""Losses of the encoder (paper III-F): geometric, terrain and trajectory, each over what was measured alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.effects import drive_speeds
from monoforce_ros.encoder import EncodedMaps, EncoderConfig
from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap
from monoforce_ros.training.recording_samples import CHUNK
from monoforce_ros.training.samples import Targets
from monoforce_ros.training.trajectory_residual import robust_loss, trajectory_residual

HIGHEST, LOWEST = 1.0, -1.5
"""Heights above and below the ground under the robot that are told apart [m]; a tree is a wall (paper, figure 6)."""
_KNEE = 0.05
"""Errors beyond it count linearly, so that few walls and trees do not outweigh the ground [m]."""
_STANDING, _AROUND = 0.3, 12
"""Height over the mean of so many cells to all sides from which on a cell stands out [m]."""
_UNSEEN = 0.1
"""Weight of measured cells that no camera looks at: only what surrounds them tells of them."""
_APART = 0.6
"""How far apart errors are compared: as the wheels of a robot [m]."""
_ACROSS, _UP, _TURN, _HEADING = 0.15, 0.03, np.radians(2.0), np.radians(4.0)
"""How far a prediction may be off before it weighs: along the ground, where slip decides, up, in roll and pitch, and in
heading, which slip decides too."""


@dataclass(frozen=True)
class LossWeights:
    """Weights of the losses; 0 leaves one out."""

    geometric: float = 1.0
    terrain: float = 2.0
    slope: float = 2.0
    """Of slopes of H_t, where wheels or tracks touched both ends; together with the terrain loss alone."""
    trajectory: float = 0.05
    decrease: float = 0.3
    """Of the mean square of H_d (λ_d of the paper's equation 3)."""
    measured_decrease: float = 2.0
    """Of H_d where it was measured; together with the geometric and the terrain loss alone."""
    standing_decrease: float = 0.1
    """Of H_d where something stands that nobody drove over; together with the geometric loss alone."""
    standing: float = 3.0
    """By how much more what stands out of its surroundings counts in the geometric loss."""

    def __post_init__(self):
        for name in (
            "geometric", "terrain", "slope", "trajectory", "decrease", "measured_decrease", "standing_decrease",
            "standing",
        ):  # fmt: skip
            if not 0.0 <= getattr(self, name) <= 1e6:
                raise ValueError(f"loss weight {name}: got {getattr(self, name)}, expected 0 or more")
        if self.geometric == self.terrain == self.trajectory == 0.0:
            raise ValueError("loss weights: all are 0, expected geometric, terrain or trajectory above it")


def geometric_loss(
    maps: EncodedMaps, targets: Targets, ground: Tensor, standing: float = LossWeights.standing
) -> Tensor:
    """Equation 4, averaged over the cells that the lidar measured; robust instead of squared.

    What stands out of its surroundings counts more, ``1 + standing`` times: walls, trunks and the edges of grass are
    few, and an error that counts linearly is least where they are left out.
    """
    measured = _limited(targets.geometric, ground)
    weight = targets.observed * torch.where(maps.covered, 1.0, _UNSEEN) * (1.0 + standing * _stands(targets, ground))
    return _masked(maps.geometric_height, measured, weight)


def terrain_loss(maps: EncodedMaps, targets: Targets) -> Tensor:
    """First part of equation 3, averaged over the cells that wheels or tracks touched; robust instead of squared."""
    weight = targets.felt * torch.where(maps.covered, 1.0, _UNSEEN)
    return _masked(maps.height, targets.supporting, weight)


def slope_loss(maps: EncodedMaps, targets: Targets, resolution: float) -> Tensor:
    """Slopes of H_t where wheels or tracks touched both ends, in four directions; robust, as a difference in metres.

    A robot stands on several cells at once. Heights that are all wrong by as much lift it, heights that are wrong by
    different amounts tilt it; the terrain loss (equation 3) tells the two no more apart than a sum of them does.
    """
    weight = targets.felt * torch.where(maps.covered, 1.0, _UNSEEN)
    error = torch.where(targets.felt, maps.height - targets.supporting, 0.0)
    straight, slanted = (max(round(_APART * share / resolution), 1) for share in (1.0, 0.5**0.5))
    losses = []
    for rows, columns in ((straight, 0), (0, straight), (slanted, slanted), (slanted, -slanted)):
        first, second = ((_shifted(error, *by), _shifted(weight, *by)) for by in ((rows, columns), (-rows, -columns)))
        losses.append(_masked(first[0], second[0], first[1] * second[1]))
    return torch.stack(losses).mean()


def decrease_loss(maps: EncodedMaps) -> Tensor:
    """Second part of equation 3: what nobody drove over is as high as it looks."""
    return (maps.decrease**2).mean()


def standing_decrease_loss(maps: EncodedMaps, targets: Targets, ground: Tensor) -> Tensor:
    """Second part of equation 3 where it decides: H_d of what stands out and nobody drove over, squared.

    Motion tells only of what a robot dares to enter. Grass that is entered teaches H_d; walls never are, and what is
    learnt from grass would be said of walls too. What stands beside the way is as high as it looks, unless the same is
    seen to give way elsewhere: grass is felt in many places, a wall in none. Squared, so that what both are said of
    comes to lie in between rather than at 0.
    """
    weight = _stands(targets, ground) * (targets.observed & ~targets.felt) * torch.where(maps.covered, 1.0, _UNSEEN)
    return _mean_over_maps(maps.decrease**2, weight)


def measured_decrease_loss(maps: EncodedMaps, targets: Targets) -> Tensor:
    """H_d where both surfaces are known: where wheels or tracks touched what the lidar measured; robust.

    Heights tell of it by their difference alone, and an encoder that is not yet sure what is grass finds it easier to
    see lower.
    """
    measured = (targets.geometric - targets.supporting).clamp(0.0, HIGHEST)
    known = targets.felt & targets.observed
    weight = known * torch.where(maps.covered, 1.0, _UNSEEN)
    return _masked(maps.decrease, torch.where(known, measured, 0.0), weight)


def trajectory_loss(
    maps: EncodedMaps, targets: Targets, robot: RobotModel, config: EncoderConfig, options: PhysicsOptions
) -> Tensor:
    """Equation 2 over pieces of motion that start at measured states, in units of what may be ignored; robust.

    Motion tells how high the ground is where wheels or tracks touched it, and nowhere else: a wall that is seen a
    little too near, so that the robot predicted beside it runs into it, would otherwise be learnt as lower.
    """
    if not len(targets.map_of):
        return maps.geometric_height.sum() * 0.0
    heights = {
        name: torch.where(targets.felt, getattr(maps, name), getattr(maps, name).detach())[targets.map_of]
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
        speeds = drive_speeds(robot, targets.twists, options.time_step, history=history)
    start = State(
        targets.positions[:, 0].clone(), targets.rotations[:, 0].clone(), targets.velocity, targets.angular_velocity
    )
    result = rollout(terrain, robot, speeds, start, options=options, with_forces=False)
    index = torch.linspace(0, steps, targets.positions.shape[1]).round().long()
    positions, rotations = result.position[:, index[1:]], result.rotation[:, index[1:]]
    away, turns = trajectory_residual(positions, rotations, targets.positions[:, 1:], targets.rotations[:, 1:])
    parts = [away[..., :2] / _ACROSS, away[..., 2:] / _UP, turns[..., :2] / _TURN, turns[..., 2:] / _HEADING]
    scaled = torch.cat(parts, dim=-1)
    loss = robust_loss(scaled, 2.0).mean(dim=(1, 2))
    # What left the map rolled on ground that nobody predicted.
    grid = config.grid
    left, right, bottom, top = grid.extent
    x, y = targets.positions[..., 0], targets.positions[..., 1]
    inside = ((x > left) & (x < right) & (y > bottom) & (y < top)).all(dim=1) & torch.isfinite(loss)
    return torch.where(inside, loss, 0.0).sum() / inside.sum().clamp_min(1)


def _limited(heights: Tensor, ground: Tensor) -> Tensor:
    above = heights - ground[:, None, None]
    return ground[:, None, None] + above.clamp(LOWEST, HIGHEST)


def _stands(targets: Targets, ground: Tensor) -> Tensor:
    """How surely what the lidar measured stands out of its surroundings, 0 to 1 ``[B, rows, columns]``."""
    return (_prominence(_limited(targets.geometric, ground), targets.observed) / _STANDING).clamp(0.0, 1.0)


def _prominence(heights: Tensor, known: Tensor) -> Tensor:
    """Height of cells over the mean of the known ones around them [m]; all ``[B, rows, columns]``."""
    mask = known.to(heights.dtype)
    around = 2 * _AROUND + 1
    summed, count = (
        functional.avg_pool2d(values[:, None], around, 1, _AROUND)[:, 0] for values in (heights * mask, mask)
    )
    return heights - summed / count.clamp_min(1e-6)


def _shifted(values: Tensor, rows: int, columns: int) -> Tensor:
    """Without the first rows and columns, or without the last if negative: two of opposite sign fit on each other."""
    return values[
        :,
        slice(max(rows, 0), min(rows, 0) or None),
        slice(max(columns, 0), min(columns, 0) or None),
    ]


def _masked(predicted: Tensor, measured: Tensor, weight: Tensor) -> Tensor:
    """Robust error, averaged as :func:`_mean_over_maps` does."""
    return _mean_over_maps(functional.smooth_l1_loss(predicted, measured, reduction="none", beta=_KNEE), weight)


def _mean_over_maps(error: Tensor, weight: Tensor) -> Tensor:
    """Mean over weighted cells of each map, then over the maps that have any."""
    total = weight.sum(dim=(1, 2))
    mean = (error * weight).sum(dim=(1, 2)) / total.clamp_min(1e-6)
    some = total > 0
    return torch.where(some, mean, 0.0).sum() / some.sum().clamp_min(1)
