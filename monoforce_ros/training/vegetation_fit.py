"""VegetationFit: drag of vegetation, from recordings of driving through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize

from monoforce_ros.effects import controls, only_effect
from monoforce_ros.encoder import EncoderConfig
from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainDefaults, TerrainMap
from monoforce_ros.training.recording_samples import CHUNK, RecordingSamples
from monoforce_ros.training.samples import Targets, targets
from monoforce_ros.training.trajectory_residual import robust_loss

EFFECT = only_effect(lambda effect: effect.fitted_in_training)
"""Effect of the drag that is fitted."""
TALL = 0.1
"""Least height of vegetation above the supporting terrain [m]."""
_FEWEST, _MOST = 30, 400
"""Least and largest number of chunks of motion."""
_HORIZONTAL_SCALE, _HEADING_SCALE = 0.05, np.radians(2.0)
"""Scales of residuals [m, rad]."""
_HUBER_DELTA = 2.0
_INITIAL = ((3e3, 1.0), (1.5e4, 0.3))
"""Initial coefficients [N s/m⁴] and yield speeds [m/s] of the descents."""
_LARGEST = (1e6, 10.0)


@dataclass(frozen=True)
class VegetationFit:
    """Drag of vegetation, and the prediction error in vegetation with and without it."""

    coefficient: float
    """[N s/m⁴]."""
    yield_speed: float
    """[m/s]."""
    chunks: int
    """Number of chunks of motion of one second through vegetation."""
    before: float
    """Mean loss without drag."""
    after: float
    """Mean loss with drag."""

    @property
    def effect(self) -> dict:
        """The effect as an entry of a robot file."""
        values = {"coefficient": (self.coefficient, "N s/m⁴"), "yield_speed": (self.yield_speed, "m/s")}
        return {"name": EFFECT, "parameters": {key: {"value": v, "unit": u} for key, (v, u) in values.items()}}


@dataclass(frozen=True)
class _ChunksInVegetation:
    """Chunks of motion, each with its own map."""

    terrain: TerrainMap
    targets: Targets


def fit_vegetation(
    recordings: Sequence[RecordingSamples], robot: RobotModel, config: EncoderConfig
) -> VegetationFit | None:
    """Fit :data:`EFFECT` to chunks of motion, with H_g* - H_t* as the height of vegetation.

    Both heights come from the recordings, so no encoder is needed. The robot's other effects are kept.

    Returns:
        None if the recordings have too few chunks in vegetation, or if drag hardly improves predictions.
    """
    chunks = _in_vegetation(recordings, config)
    if chunks is None:
        return None

    def loss(values: np.ndarray) -> float:
        return _loss(chunks, robot, *np.minimum(np.exp(values), _LARGEST))

    without = _loss(chunks, robot, 0.0, 0.0)
    found = [
        minimize(
            loss,
            np.log(start),
            method="Nelder-Mead",
            options={"maxfev": 60, "xatol": 0.02, "fatol": 1e-4 * without,
                     "initial_simplex": np.log(start) + np.array([[0.0, 0.0], [0.7, 0.0], [0.0, 0.7]])},
        )
        for start in _INITIAL
    ]  # fmt: skip
    best = min(found, key=lambda result: result.fun)
    if not best.fun < 0.98 * without:
        return None
    coefficient, yield_speed = np.minimum(np.exp(best.x), _LARGEST)
    return VegetationFit(
        float(coefficient), float(yield_speed), len(chunks.targets.positions), without, float(best.fun)
    )


def _in_vegetation(recordings: Sequence[RecordingSamples], config: EncoderConfig) -> _ChunksInVegetation | None:
    """Chunks of motion that start in vegetation, drawn at random from all recordings."""
    motions: list[Targets] = []
    count = 0
    # Every fourth sample only, so that chunks hardly overlap.
    candidates = [(recording, i) for recording in recordings for i in range(0, len(recording), 4)]
    for candidate in np.random.default_rng(0).permutation(len(candidates)):
        recording, index = candidates[candidate]
        found = targets(recording, index, config, chunks=2, horizon=3.0)
        if not len(found.map_of):
            continue
        rows, columns, inside = config.grid.cells(found.positions[:, 0, :2].numpy())
        tall = (found.geometric - found.supporting)[0, rows, columns] > TALL
        # No contact mask: the fit determines the ground between the wheels too.
        known = found.observed[0, rows, columns] & torch.from_numpy(inside)
        chosen = tall & known
        if not bool(chosen.any()):
            continue
        motion = {
            name: getattr(found, name)[chosen]
            for name in ("positions", "rotations", "velocity", "angular_velocity", "twists")
        }
        motions.append(replace(found, map_of=torch.zeros(int(chosen.sum()), dtype=torch.long), **motion))
        count += int(chosen.sum())
        if count >= _MOST:
            break
    if count < _FEWEST:
        return None
    joined = Targets.stack(motions)
    height = joined.supporting
    geometric = torch.where(joined.observed, joined.geometric, height)
    maps = TerrainMap.from_height(height, config.grid, geometric_height=geometric, material=TerrainDefaults())
    channels = ("height", "geometric_height", "stiffness", "damping", "friction", "observed")
    per_chunk = TerrainMap(**{name: getattr(maps, name)[joined.map_of] for name in channels}, grid=config.grid)
    return _ChunksInVegetation(per_chunk, joined)


@torch.no_grad()
def _loss(chunks: _ChunksInVegetation, robot: RobotModel, coefficient: float, yield_speed: float) -> float:
    """Mean Huber loss of the chunks' final horizontal position and heading."""
    others = tuple(entry for entry in robot.effects if entry[0] != EFFECT)
    robot = replace(robot, effects=(*others, (EFFECT, {"coefficient": coefficient, "yield_speed": yield_speed})))
    options, found = PhysicsOptions(), chunks.targets
    steps = round(CHUNK / options.time_step)
    given = controls(robot, found.twists, options.time_step, history=found.twists.shape[1] - steps)
    start = State(found.positions[:, 0].clone(), found.rotations[:, 0].clone(), found.velocity, found.angular_velocity)
    result = rollout(chunks.terrain, robot, given, start, options=options, with_forces=False)
    translation = (result.position[:, -1, :2] - found.positions[:, -1, :2]) / _HORIZONTAL_SCALE
    relative = result.rotation[:, -1].transpose(-1, -2) @ found.rotations[:, -1]
    heading = torch.atan2(relative[:, 1, 0], relative[:, 0, 0])[:, None] / _HEADING_SCALE
    scaled = torch.cat([translation, heading], dim=1).nan_to_num(1e3)
    return float(robust_loss(scaled, _HUBER_DELTA).mean())
