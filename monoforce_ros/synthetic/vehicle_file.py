"""Wheels and arms of a vehicle from the content of a robot file that has been checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from monoforce_ros.robots import Joint, RobotModel
from monoforce_ros.synthetic.vehicle_parts import Arm, Pivot, Servo, Spring, Wheel

# Spacing of the small wheels that model a track, in wheel radii; close enough to climb like a belt.
_TRACK_WHEEL_DISTANCE = 1.1
# Three wheels of a flipper touch each other; five take twice as long to simulate.
_FLIPPER_WHEELS = 3


def read_wheels(robot: RobotModel, content: Mapping[str, Any]) -> list[Wheel]:
    """Wheels of the file, those that model tracks and flippers included.

    Args:
        robot: as loaded from the file.
        content: of the file.
    """
    sides = dict(zip(robot.drive_names, robot.drive_offsets.tolist(), strict=True))
    torques = _motor_torques(robot)
    wheels = [_wheel(entry, robot, content, sides, torques) for entry in content.get("wheels", [])]
    for track in content.get("tracks", []):
        wheels += _track_wheels(track, sides)
    for flipper in content.get("flippers", []):
        wheels += _flipper_wheels(flipper, sides)
    return wheels


def read_arms(robot: RobotModel, content: Mapping[str, Any]) -> list[Arm]:
    """Rockers and flippers of the file."""
    joints = {joint.name: joint for joint in robot.joints}
    arms = []
    for entry in content.get("rockers", []):
        joint = joints[str(entry["name"])]
        assert joint.dynamics is not None
        arms.append(
            Arm(
                joint.name, np.array(joint.origin), np.array(joint.axis), 0.0, np.array(joint.origin), 0.0, None,
                damping=joint.dynamics.damping, limit=joint.dynamics.high,
            )
        )  # fmt: skip
    for entry in content.get("flippers", []):
        joint = joints[str(entry["name"])]
        arms.append(
            Arm(
                joint.name, np.array(joint.origin), np.array(joint.axis), joint.mass, np.array(joint.place),
                float(entry["angle"]), _servo(joint),
            )
        )  # fmt: skip
    return arms


def _servo(joint: Joint) -> Servo:
    torque = math.inf if joint.dynamics is None else joint.dynamics.maximum_torque
    return Servo(joint.low, joint.high, joint.maximum_rate, joint.time_constant, torque)


def _motor_torques(robot: RobotModel) -> dict[str, float]:
    """Largest force of each drive at the rim of its wheels [N], where its motor has a limit."""
    limits = {}
    for name, motor in zip(robot.drive_names, robot.motors, strict=False):
        if motor is not None:
            limits[name] = min(motor.stall_torque, motor.maximum_torque)
    return limits


def _wheel(
    entry: Mapping[str, Any], robot: RobotModel, content: Mapping[str, Any], sides: Mapping[str, float],
    torques: Mapping[str, float],
) -> Wheel:  # fmt: skip
    name, drive = str(entry["name"]), entry["drive"]
    steers = robot.steered is not None
    # Drives of a robot that steers are wheels: a differential lets each turn at its own speed.
    drive = name if steers and drive is not None else drive
    radius = float(entry["radius"])
    count = sum(other["drive"] == entry["drive"] for other in content["wheels"])
    force = torques.get(str(drive), math.inf)
    return Wheel(
        name,
        0.0 if drive is None or steers else sides[str(drive)],
        np.array(entry["centre"], float),
        radius,
        float(entry["width"]),
        driven=drive is not None,
        pivot=_pivot(name, np.array(entry["centre"], float), robot, content),
        spring=_spring(name, robot, content),
        arm=next((str(e["name"]) for e in content.get("rockers", []) if name in e["wheels"]), ""),
        is_scaled=steers or robot.point_grip is not None,
        maximum_torque=force * radius / (1 if steers else count),
        differential=_differential(name, robot),
    )


def _differential(wheel: str, robot: RobotModel) -> str:
    """Name of the differential that drives a wheel; empty if it has a motor of its own."""
    if robot.steered is not None:
        for index, drives in enumerate(robot.steered.differentials):
            if wheel in [robot.drive_names[drive] for drive in drives]:
                return f"differential_{index}"
    return ""


def _pivot(wheel: str, centre: np.ndarray, robot: RobotModel, content: Mapping[str, Any]) -> Pivot | None:
    joints = {joint.name: joint for joint in robot.joints}
    for section in ("steering", "casters"):
        for entry in content.get(section, []):
            if entry["wheel"] == wheel:
                joint = joints[str(entry["name"])]
                place = np.array(entry.get("pivot", centre), float)
                if section == "steering":
                    return Pivot(joint.name, place, _servo(joint))
                assert joint.dynamics is not None
                return Pivot(joint.name, place, None, joint.dynamics.damping)
    return None


def _spring(wheel: str, robot: RobotModel, content: Mapping[str, Any]) -> Spring | None:
    for entry in content.get("suspension", []):
        if entry["wheel"] == wheel:
            dynamics = next(joint.dynamics for joint in robot.joints if joint.name == entry["name"])
            assert dynamics is not None
            return Spring(dynamics.stiffness, dynamics.damping, dynamics.preload, dynamics.low, dynamics.high)
    return None


def _track_wheels(track: Mapping[str, Any], sides: Mapping[str, float]) -> list[Wheel]:
    """Wheels along the bottom of a track; the first and last are its rollers."""
    centre, radius, length = np.array(track["centre"], float), float(track["radius"]), float(track["length"])
    count = max(2, 1 + round(length / (_TRACK_WHEEL_DISTANCE * radius)))
    offsets_x = np.linspace(length / 2, -length / 2, count)
    return [
        Wheel(
            f"{track['name']}_{index}", sides[str(track["drive"])], centre + np.array([offset, 0.0, 0.0]), radius,
            float(track["width"]),
        )
        for index, offset in enumerate(offsets_x)
    ]  # fmt: skip


def _flipper_wheels(flipper: Mapping[str, Any], sides: Mapping[str, float]) -> list[Wheel]:
    """Wheels along a flipper at its angle in the file, from the root to the smaller tip."""
    joint, length, angle = np.array(flipper["joint"], float), float(flipper["length"]), float(flipper["angle"])
    root, tip = float(flipper["root_radius"]), float(flipper["tip_radius"])
    forward = 1.0 if flipper["end"] == "front" else -1.0
    direction = np.array([forward * np.cos(angle), 0.0, np.sin(angle)])
    return [
        Wheel(
            f"{flipper['name']}_{index}", sides[str(flipper["drive"])], joint + share * length * direction,
            root + share * (tip - root), float(flipper["width"]), arm=str(flipper["name"]),
        )
        for index, share in enumerate(np.linspace(0.0, 1.0, _FLIPPER_WHEELS))
    ]  # fmt: skip
