"""Local rollout: effects that act on a part of the ground alone.

What is a property of the ground, as friction is, becomes a part of the map: one wheel may be on ice and the other one
not. Other effects act on the robot from where its predicted path enters the part to where it leaves it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects import CATALOGUE
from monoforce_ros.physics import PhysicsOptions, Rollout, State, rollout
from monoforce_ros.robots import Controls, RobotModel
from monoforce_ros.terrain import Grid, TerrainMap

STEPS = 40
"""Steps between questions whether a robot is on the part [-]: 0.4 s, in which most robots move by less than half their
length."""

Effects = tuple[tuple[str, Mapping[str, float]], ...]
"""Effects with their values."""
BatchedEffects = tuple[tuple[str, Mapping[str, float | Tensor]], ...]
"""Effects whose values may be one for each trajectory, ``[B]``."""


_MARGIN = 1.0
"""Of a map beyond the part of level ground [m]."""
_CELL = 0.1
"""Of that map [m]."""


@dataclass(frozen=True)
class GroundPart:
    """A part of a map."""

    terrain: TerrainMap
    cells: Tensor
    """Those of the part, ``[rows, columns]`` bool."""

    @classmethod
    def of(
        cls,
        terrain: TerrainMap | None,
        bounds: tuple[np.ndarray, np.ndarray],
        holds: Callable[[np.ndarray], np.ndarray],
    ) -> GroundPart:
        """The part of a map, or of level ground, whose cells ``holds`` tells.

        Args:
            terrain: the map; None for level ground.
            bounds: lowest and highest corner of the part, ``[2]`` each in terrain axes [m]; of level ground no more is
                mapped.
            holds: whether positions ``[N, 2]`` in terrain axes are on the part, ``[N]`` bool.
        """
        if terrain is None:
            low, high = bounds[0] - _MARGIN, bounds[1] + _MARGIN
            columns, rows = np.ceil((high - low) / _CELL).astype(int) + 1
            terrain = TerrainMap.flat(Grid(int(rows), int(columns), _CELL, (float(low[0]), float(low[1]))))
        x, y = np.meshgrid(terrain.grid.x, terrain.grid.y)
        held = holds(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape)
        return cls(terrain, torch.from_numpy(held))

    def with_effects(self, effects: Effects, usual: Callable[[str], Mapping[str, float]]) -> tuple[TerrainMap, Effects]:
        """The map on which those effects act that are properties of the ground, and the others.

        Args:
            effects: with their values on the part.
            usual: values of an effect elsewhere.
        """
        terrain, others = self.terrain, []
        for name, values in effects:
            changed = CATALOGUE[name].ground(terrain, _tensors(values), _tensors(usual(name)), self.cells)
            if changed is None:
                others.append((name, values))
            else:
                terrain = changed
        return terrain, tuple(others)


@dataclass(frozen=True)
class Driven:
    """A robot with effects, and the speeds of its drives under them."""

    robot: RobotModel
    controls: Controls


def moves_rigidly(robot: RobotModel) -> bool:
    """Whether a rollout can be continued from position, attitude and velocities alone: no moving joints, no motors with
    limits."""
    return not robot.joints and not any(robot.motors)


def local_rollout(
    terrain: TerrainMap,
    here: Driven,
    elsewhere: Driven,
    state: State,
    on_part: Callable[[Tensor], Tensor],
    options: PhysicsOptions,
) -> Rollout:
    """Predict a batch of trajectories, each with one robot on a part of the ground and another one elsewhere.

    Args:
        terrain: one map.
        here: on the part of the ground.
        elsewhere: on the rest, with the same effects at other values.
        state: start states, ``[B]``.
        on_part: whether positions ``[B, 3]`` in terrain axes are on the part, ``[B]`` bool.
        options: of the physics.

    Returns:
        positions, rotations and velocities, without forces.
    """
    steps = here.controls.drive_speeds.shape[1]
    states = [[tensor[:, None]] for tensor in (state.position, state.rotation, state.velocity, state.angular_velocity)]
    result = None
    for first in range(0, steps, STEPS):
        part = slice(first, min(first + STEPS, steps))
        middle = state.position + 0.5 * options.time_step * (part.stop - first) * state.velocity
        # Of a diverged trajectory nobody knows where it is.
        on = on_part(torch.nan_to_num(middle))
        robot = replace(here.robot, effects=_chosen(on, here.robot.effects, elsewhere.robot.effects))
        speeds = torch.where(
            on[:, None, None], here.controls.drive_speeds[:, part], elsewhere.controls.drive_speeds[:, part]
        )
        result = rollout(terrain, robot, speeds, state, options=options, with_forces=False)
        parts = (result.position, result.rotation, result.velocity, result.angular_velocity)
        for kept, values in zip(states, parts, strict=True):
            kept.append(values[:, 1:])
        state = State(*(values[:, -1] for values in parts))
    assert result is not None
    position, rotation, velocity, angular = (torch.cat(kept, dim=1) for kept in states)
    times = options.time_step * torch.arange(steps + 1, dtype=position.dtype)
    return replace(
        result, times=times, position=position, rotation=rotation, velocity=velocity, angular_velocity=angular
    )


def outside_values(name: str, values: Mapping[str, float | Tensor], own: Mapping[str, float]) -> dict[str, float]:
    """Values of an effect where it does not act: those of the robot's file, or else the neutral ones."""
    neutral = {parameter.name: parameter.neutral for parameter in CATALOGUE[name].parameters}
    return {key: float(own.get(key, neutral[key])) for key in values}


def _tensors(values: Mapping[str, float]) -> dict[str, Tensor]:
    return {key: torch.tensor(float(value)) for key, value in values.items()}


def _chosen(on: Tensor, here: BatchedEffects, elsewhere: BatchedEffects) -> BatchedEffects:
    """Effects whose values are those of here where ``on`` ``[B]``, and else those of elsewhere."""
    others = dict(elsewhere)
    return tuple(
        (name, {key: _blend(on, value, others[name][key]) for key, value in values.items()}) for name, values in here
    )


def _blend(on: Tensor, here: float | Tensor, elsewhere: float | Tensor) -> Tensor:
    one, other = (torch.as_tensor(value, dtype=torch.float32).expand(len(on)) for value in (here, elsewhere))
    return torch.where(on, one, other)
