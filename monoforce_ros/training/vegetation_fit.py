"""VegetationFit: how hard vegetation holds the robot, from drives through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize

from monoforce_ros.effects import drive_speeds
from monoforce_ros.encoder import EncoderConfig
from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainDefaults, TerrainMap
from monoforce_ros.training.recording_samples import CHUNK, RecordingSamples
from monoforce_ros.training.samples import Targets, targets

EFFECT = "vegetation_drag"
TALL = 0.1
"""Vegetation that counts, in height over the ground that carries [m]."""
_FEWEST, _MOST = 30, 400
"""Pieces of motion that are needed, and used."""
_ACROSS, _TURN = 0.05, np.radians(2.0)
_KNEE = 2.0
_STARTS = ((3e3, 1.0), (1.5e4, 0.3))
_LARGEST = (1e6, 10.0)


@dataclass(frozen=True)
class VegetationFit:
    """Drag of vegetation, and how much of the disagreement in it that explains."""

    coefficient: float
    """[N s/m⁴]."""
    yield_speed: float
    """[m/s]."""
    pieces: int
    """Pieces of motion of one second through vegetation."""
    before: float
    """Mean loss without."""
    after: float

    @property
    def effect(self) -> dict:
        """As a robot's file holds it."""
        values = {"coefficient": (self.coefficient, "N s/m⁴"), "yield_speed": (self.yield_speed, "m/s")}
        return {"name": EFFECT, "parameters": {key: {"value": v, "unit": u} for key, (v, u) in values.items()}}


@dataclass(frozen=True)
class _Pieces:
    """Pieces of motion, each on a map of its own."""

    terrain: TerrainMap
    targets: Targets


def fit_vegetation(
    drives: Sequence[RecordingSamples], robot: RobotModel, config: EncoderConfig
) -> VegetationFit | None:
    """Fit :data:`EFFECT` to pieces of motion on what the lidar saw over the ground that the robot felt.

    Both heights come from the drives alone (H_g*, H_t*), so that no encoder is needed. Other effects of the robot stay.

    Returns:
        None where the drives hardly went through vegetation, or where drag does not bring predictions closer.
    """
    pieces = _through_vegetation(drives, config)
    if pieces is None:
        return None

    def loss(values: np.ndarray) -> float:
        return _loss(pieces, robot, *np.minimum(np.exp(values), _LARGEST))

    without = _loss(pieces, robot, 0.0, 0.0)
    found = [
        minimize(
            loss,
            np.log(start),
            method="Nelder-Mead",
            options={"maxfev": 60, "xatol": 0.02, "fatol": 1e-4 * without,
                     "initial_simplex": np.log(start) + np.array([[0.0, 0.0], [0.7, 0.0], [0.0, 0.7]])},
        )
        for start in _STARTS
    ]  # fmt: skip
    best = min(found, key=lambda result: result.fun)
    if not best.fun < 0.98 * without:
        return None
    coefficient, yield_speed = np.minimum(np.exp(best.x), _LARGEST)
    return VegetationFit(
        float(coefficient), float(yield_speed), len(pieces.targets.positions), without, float(best.fun)
    )


def _through_vegetation(drives: Sequence[RecordingSamples], config: EncoderConfig) -> _Pieces | None:
    """Pieces of motion whose start stands in vegetation, spread over the drives."""
    maps, motions, count = [], [], 0
    # Several seconds lie between samples from which pieces are taken: they hardly overlap.
    every = [(drive, i) for drive in drives for i in range(0, len(drive), 4)]
    order = np.random.default_rng(0).permutation(len(every))
    for at in order:
        drive, index = every[at]
        found = targets(drive, index, config, chunks=2, horizon=3.0)
        if not len(found.map_of):
            continue
        rows, columns, inside = config.grid.cells(found.positions[:, 0, :2].numpy())
        tall = (found.geometric - found.supporting)[0, rows, columns] > TALL
        # The ground between the wheels is fitted along with what they felt.
        known = found.observed[0, rows, columns] & torch.from_numpy(inside)
        chosen = tall & known
        if not bool(chosen.any()):
            continue
        motion = {
            name: getattr(found, name)[chosen]
            for name in ("positions", "rotations", "velocity", "angular_velocity", "twists")
        }
        pages = torch.zeros(int(chosen.sum()), dtype=torch.long)
        motions.append(replace(found, map_of=pages, **motion))
        count += int(chosen.sum())
        if count >= _MOST:
            break
    if count < _FEWEST:
        return None
    joined = Targets.stack(motions)
    height = joined.supporting
    seen = torch.where(joined.observed, joined.geometric, height)
    maps = TerrainMap.from_height(height, config.grid, geometric_height=seen, material=TerrainDefaults())
    channels = ("height", "geometric_height", "stiffness", "damping", "friction", "observed")
    each = TerrainMap(**{name: getattr(maps, name)[joined.map_of] for name in channels}, grid=config.grid)
    return _Pieces(each, joined)


@torch.no_grad()
def _loss(pieces: _Pieces, robot: RobotModel, coefficient: float, yield_speed: float) -> float:
    """Mean robust loss of where the pieces end, along the ground and in heading."""
    others = tuple(entry for entry in robot.effects if entry[0] != EFFECT)
    robot = replace(robot, effects=(*others, (EFFECT, {"coefficient": coefficient, "yield_speed": yield_speed})))
    options, found = PhysicsOptions(), pieces.targets
    steps = round(CHUNK / options.time_step)
    speeds = drive_speeds(robot, found.twists, options.time_step, history=found.twists.shape[1] - steps)
    start = State(found.positions[:, 0].clone(), found.rotations[:, 0].clone(), found.velocity, found.angular_velocity)
    result = rollout(pieces.terrain, robot, speeds, start, options=options, with_forces=False)
    away = (result.position[:, -1, :2] - found.positions[:, -1, :2]) / _ACROSS
    turned = result.rotation[:, -1].transpose(-1, -2) @ found.rotations[:, -1]
    turn = torch.atan2(turned[:, 1, 0], turned[:, 0, 0])[:, None] / _TURN
    size = torch.cat([away, turn], dim=1).nan_to_num(1e3).abs()
    return float(torch.where(size <= _KNEE, 0.5 * size**2, _KNEE * (size - 0.5 * _KNEE)).mean())
