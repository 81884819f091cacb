"""Checks of a robot in the physics: it stands still at rest, drives straight and turns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from monoforce_ros.effects import controls
from monoforce_ros.physics import Rollout, State, rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap

STEP = 0.01
SETTLING, DRIVING = 1.5, 3.0
"""Duration of standing and driving [s]."""
SPEED, YAW_RATE = 0.5, 0.6
"""Commands [m/s, rad/s], or the robot's limits if they are lower."""
_TURNING_RADIUS = 3.0
"""Of the commanded turn of a robot that cannot turn on the spot, in lengths of its wheelbase."""
_DRIFT, _LEAN, _WEIGHT = 5e-3, 8.0, 0.03
"""Largest motion at rest [m/s], largest inclination at rest [°], and relative error of the carried weight."""
_SUNK, _USUALLY_SUNK = 0.15, 0.05
"""Depth over the wheels' radius that is no longer firm ground; that of most shipped robots (a Husky: 6 of 165 mm)."""
_COVERED, _SIDEWAYS, _HEADING = 0.75, 0.05, 2.0
"""Least share of the commanded distance, largest lateral share, largest change of heading [°] when driving straight."""
_TURNED = 0.15
"""Least share of the commanded change of heading: robots that skid turn by less than the command."""


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    name: str
    passed: bool
    text: str


def check_robot(robot: RobotModel, *, turns_on_the_spot: bool = True, wheelbase: float = 1.0) -> list[Finding]:
    """Roll a robot out on level ground and judge the motion.

    Args:
        robot: the robot.
        turns_on_the_spot: whether it can; otherwise it is commanded to drive a curve.
        wheelbase: distance between its axles [m], for the curve's radius.
    """
    speed = min(SPEED, robot.maximum_speed)
    yaw_rate = min(YAW_RATE, robot.maximum_yaw_rate)
    forward = 0.0
    if not turns_on_the_spot:
        forward = speed
        yaw_rate = min(yaw_rate, speed / max(_TURNING_RADIUS * wheelbase, 0.3))
    runs = {name: _drive(robot, *twist) for name, twist in (
        ("rest", (0.0, 0.0)), ("straight", (speed, 0.0)), ("left", (forward, yaw_rate)),
        ("right", (forward, -yaw_rate)),
    )}  # fmt: skip
    failed = [name for name, run in runs.items() if not bool(run.valid.all())]
    if failed:
        return [Finding("simulation", False, f"the rollout diverges ({', '.join(failed)}): check mass and inertia")]
    return [_stands(robot, runs["rest"]), _straight(runs["straight"], speed), *_turns(runs, yaw_rate)]


def _drive(robot: RobotModel, speed: float, yaw_rate: float) -> Rollout:
    twists = torch.tensor([[0.0, 0.0]] * round(SETTLING / STEP) + [[speed, yaw_rate]] * round(DRIVING / STEP))[None]
    terrain = TerrainMap.flat(Grid.square(max(16.0, 4.0 * (DRIVING * abs(speed) + 4.0)), 0.5))
    start = State.at_rest(robot.ground_clearance)
    return rollout(terrain, robot, controls(robot, twists, STEP), start, force_every=10)


def _moved(run: Rollout) -> np.ndarray:
    """Displacement while driving [m], ``[3]``."""
    return (run.position[0, -1] - run.position[0, round(SETTLING / STEP)]).double().numpy()


def _heading(run: Rollout) -> float:
    """Change of heading while driving [°]."""
    ahead = run.rotation[0, round(SETTLING / STEP) :, :2, 0].double().numpy()
    angles = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return math.degrees(float(angles[-1] - angles[0]))


def _stands(robot: RobotModel, run: Rollout) -> Finding:
    drift = float(np.linalg.norm(_moved(run))) / DRIVING
    lean = math.degrees(math.acos(min(1.0, float(run.rotation[0, -1, 2, 2]))))
    weight = float(robot.mass) * 9.81
    carried = 0.0 if run.normal_forces is None else float(run.normal_forces[0, -1].sum())
    text = (
        f"moves {1000 * drift:.1f} mm/s, leans {lean:.1f}°, contacts carry {100 * carried / weight:.0f} % of its weight"
    )
    if lean > _LEAN:
        text += "; does it tip over, or are wheels at different heights?"
    depth, most = _sunk(robot, run), _SUNK * (robot.wheel_radius or math.inf)
    text += f", sinks {1000 * depth:.0f} mm"
    if depth > most:
        softness = max(0.1, float(f"{_usual_softness(robot, depth):.2g}"))
        text += (
            f", more than {100 * _SUNK:.0f} % of its wheels' radius: its wheels are too narrow for its mass on firm "
            f"soil; on hard ground add effects: [{{name: terrain_softness, parameters: {{factor: {softness:g}}}}}] to "
            "its file, or commission it"
        )
    stands = drift < _DRIFT and lean < _LEAN and abs(carried / weight - 1) < _WEIGHT and depth <= most
    return Finding("stands still", stands, text)


def _sunk(robot: RobotModel, run: Rollout) -> float:
    """How far a robot at rest stands lower than on ground that does not yield [m]."""
    return robot.ground_clearance - float(run.position[0, -1, 2])


def _usual_softness(robot: RobotModel, depth: float) -> float:
    """Factor on the ground's softness with which the wheels sink by :data:`_USUALLY_SUNK` of their radius.

    A wheel's contact patch grows with the root of the depth, so that its load grows with the power 1.5 of it.
    """
    assert robot.wheel_radius is not None
    return (_USUALLY_SUNK * robot.wheel_radius / depth) ** 1.5


def _straight(run: Rollout, speed: float) -> Finding:
    distance, moved, turned = speed * DRIVING, _moved(run), _heading(run)
    covered, sideways = float(moved[0]) / distance, abs(float(moved[1])) / distance
    passed = covered > _COVERED and sideways < _SIDEWAYS and abs(turned) < _HEADING
    text = f"covers {moved[0]:.2f} of {distance:.2f} m, {1000 * moved[1]:+.0f} mm to the left, turns by {turned:+.1f}°"
    if covered <= _COVERED:
        text += "; does a part of the hull drag on the ground, or is no wheel driven?"
    return Finding("drives straight", passed, text)


def _turns(runs: dict[str, Rollout], yaw_rate: float) -> list[Finding]:
    commanded = math.degrees(yaw_rate * DRIVING)
    found = []
    for name, sign in (("left", 1.0), ("right", -1.0)):
        turned = _heading(runs[name])
        passed = sign * turned > _TURNED * commanded
        text = f"turns by {turned:+.0f}° of {sign * commanded:+.0f}° commanded"
        if not passed:
            text += "; are the sides of the drives or the steering's signs exchanged?"
        found.append(Finding(f"turns {name}", passed, text))
    return found
