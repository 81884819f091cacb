"""Joints and motors of a robot file: steering, casters, suspension, rockers, flippers, torque limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from monoforce_ros.robots.checks import FieldChecks
from monoforce_ros.robots.joint import CASTER, FLIPPER, ROCKER, STEERING, SUSPENSION, Coordinate, Joint, Vector
from monoforce_ros.robots.kinematics import ACKERMANN, DIFFERENTIAL, DRIVE_KINDS, INDEPENDENT, SKID, SteeredDrive

GRAVITY = 9.81
_UNSPRUNG_SHARE = 0.03
"""Mass that moves with a wheel as a share of the robot's, where the file does not say: wheel, hub and half of its arm
are 2 to 4 % on passenger cars (Gillespie, Fundamentals of Vehicle Dynamics, ch. 5)."""
_SMALLEST_INERTIA = 1e-6
"""About the axis of a caster or rocker [kg m²]."""
_CASTER_SHARE = 0.01
_MOTOR_SHARE = 0.01
"""Mass at the rim of a wheel that accelerates as slowly as motor, gear and wheels, as a share of the robot's."""
_MOTOR_ERROR = 0.1
"""Error of the surface speed at which a speed controller demands the largest torque [m/s]."""
_FLIPPER_ERROR = 0.2
"""Error of a flipper's rate at which its controller demands the largest torque [rad/s]."""
_FLIPPER_TIME = 0.1
"""Time in which a flipper's controller corrects an error of the angle [s]."""
_STOP_DEPTH = 0.02
"""Travel over which the stops of a joint take the robot's weight [m, or rad at 1 m]."""


@dataclass(frozen=True)
class WheelEntry:
    """A wheel as read from the file."""

    name: str
    drive: str | None
    centre: np.ndarray
    radius: float


class JointReader:
    """Reads the sections that describe what moves.

    Args:
        checks: checks of the file's fields.
        top: the whole file.
        wheels: its wheels.
        mass: of the robot [kg].
        centre_of_mass: ``[3]`` [m].
    """

    def __init__(
        self,
        checks: FieldChecks,
        top: Mapping[str, Any],
        wheels: Sequence[WheelEntry],
        mass: float,
        centre_of_mass: np.ndarray,
    ):
        self.checks, self.top, self.mass, self.centre_of_mass = checks, top, mass, centre_of_mass
        self.wheels = {wheel.name: wheel for wheel in wheels}
        self.joints: list[Joint] = []
        self.carrier: dict[str, int] = {}
        """Joint that each wheel is mounted on."""
        self.kind, self.reference_x = self._kind()
        for section, read in (
            ("suspension", self._spring),
            ("rockers", self._rocker),
            ("steering", self._steering),
            ("casters", self._caster),
        ):
            for index, entry in enumerate(checks.items(top.get(section, []), section)):
                read(entry, f"{section}[{index}]")
        self._check_kind()

    def _kind(self) -> tuple[str, float | None]:
        entry = self.checks.mapping(self.top.get("drive", {"kind": SKID}), "drive", {"kind", "reference_x"}, ["kind"])
        if entry["kind"] not in DRIVE_KINDS:
            raise self.checks.fail("drive.kind", entry["kind"], f"one of {list(DRIVE_KINDS)}")
        reference = entry.get("reference_x")
        if reference is not None:
            reference = self.checks.number(reference, "drive.reference_x", -20.0, 20.0, "m")
        return str(entry["kind"]), reference

    @property
    def steers(self) -> bool:
        """Whether the robot steers wheels."""
        return self.kind not in (SKID, DIFFERENTIAL)

    def _check_kind(self) -> None:
        steered = sum(joint.kind == STEERING for joint in self.joints)
        if steered and not self.steers:
            raise self.checks.fail(
                "drive.kind", self.kind, "ackermann, four_wheel_steering or independent with steering"
            )
        if self.steers and self.kind != INDEPENDENT and not steered:
            raise self.checks.fail("steering", [], f"the steered wheels of the kind {self.kind!r}")
        if self.kind == "four_wheel_steering" and steered < len(self.wheels):
            raise self.checks.fail("steering", f"{steered} joints", f"one for each of the {len(self.wheels)} wheels")
        if self.steers and (self.top.get("tracks") or self.top.get("flippers")):
            raise self.checks.fail("drive.kind", self.kind, "skid for a robot with tracks or flippers")
        names = [joint.name for joint in self.joints]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise self.checks.fail("joint names", repeated, "names that differ")

    def _wheel(self, name: Any, where: str) -> WheelEntry:
        if name not in self.wheels:
            raise self.checks.fail(where, name, f"the name of a wheel, one of {sorted(self.wheels)}")
        return self.wheels[name]

    def _mount(self, wheel: WheelEntry, where: str, kinds: tuple[str, ...]) -> int:
        """Mount a wheel on the joint that is read next; returns that joint's parent."""
        parent = self.carrier.get(wheel.name, -1)
        if parent >= 0 and self.joints[parent].kind not in kinds:
            raise self.checks.fail(where, wheel.name, f"a wheel that is not on {self.joints[parent].name!r} already")
        self.carrier[wheel.name] = len(self.joints)
        return parent

    def _pivot(self, entry: Mapping[str, Any], where: str, wheel: WheelEntry) -> Vector:
        if "pivot" not in entry:
            return _vector(wheel.centre)
        return _vector(self.checks.vector(entry["pivot"], f"{where}.pivot", 3, 20.0, "m"))

    def _steering(self, content: Any, where: str) -> None:
        known = {"name", "wheel", "maximum_angle", "maximum_rate", "time_constant", "pivot"}
        entry = self.checks.mapping(content, where, known, ["name", "wheel", "maximum_angle"])
        wheel = self._wheel(entry["wheel"], f"{where}.wheel")
        limit = self.checks.number(entry["maximum_angle"], f"{where}.maximum_angle", 0.01, 1.58, "rad")
        pivot = self._pivot(entry, where, wheel)
        parent = self._mount(wheel, where, (SUSPENSION, ROCKER))
        self.joints.append(
            Joint(
                str(entry["name"]), STEERING, (0.0, 0.0, 1.0), pivot, parent=parent, low=-limit, high=limit,
                **self._following(entry, where),
            )
        )  # fmt: skip

    def _following(self, entry: Mapping[str, Any], where: str) -> dict[str, Any]:
        rate = self.checks.number(entry.get("maximum_rate", math.inf), f"{where}.maximum_rate", 1e-3, math.inf, "rad/s")
        lag = self.checks.number(entry.get("time_constant", 0.0), f"{where}.time_constant", 0.0, 10.0, "s")
        return {"maximum_rate": rate, "time_constant": lag}

    def _caster(self, content: Any, where: str) -> None:
        entry = self.checks.mapping(
            content, where, {"name", "wheel", "pivot", "inertia", "damping"}, ["name", "wheel", "pivot"]
        )
        wheel = self._wheel(entry["wheel"], f"{where}.wheel")
        if wheel.drive is not None:
            raise self.checks.fail(f"{where}.wheel", wheel.name, "a wheel with drive: null")
        pivot = np.array(self._pivot(entry, where, wheel))
        trail = float(np.hypot(*(wheel.centre - pivot)[:2]))
        share = max(_SMALLEST_INERTIA, _CASTER_SHARE * self.mass * (trail**2 + 0.5 * wheel.radius**2))
        inertia = self.checks.number(entry.get("inertia", share), f"{where}.inertia", _SMALLEST_INERTIA, 1e4, "kg m²")
        damping = self.checks.number(entry.get("damping", 0.0), f"{where}.damping", 0.0, 1e4, "N m s/rad")
        parent = self._mount(wheel, where, (SUSPENSION, ROCKER))
        self.joints.append(
            Joint(
                str(entry["name"]), CASTER, (0.0, 0.0, 1.0), _vector(pivot), parent=parent,
                dynamics=Coordinate(inertia, damping=damping),
            )
        )  # fmt: skip

    def _spring(self, content: Any, where: str) -> None:
        known = {"name", "wheel", "stiffness", "damping", "unsprung_mass", "travel", "preload"}
        entry = self.checks.mapping(content, where, known, ["name", "wheel", "stiffness", "damping"])
        wheel = self._wheel(entry["wheel"], f"{where}.wheel")
        stiffness = self.checks.number(entry["stiffness"], f"{where}.stiffness", 1.0, 1e8, "N/m")
        load = self._load_at_rest(wheel)
        low, high = -math.inf, math.inf
        if "travel" in entry:
            low, high = self.checks.vector(entry["travel"], f"{where}.travel", 2, 5.0, "m").tolist()
            if not low < 0.0 < high:
                raise self.checks.fail(f"{where}.travel", [low, high], "a negative and a positive number [m]")
        dynamics = Coordinate(
            inertia=self.checks.number(
                entry.get("unsprung_mass", _UNSPRUNG_SHARE * self.mass), f"{where}.unsprung_mass", 1e-3, 1e4, "kg"
            ),
            stiffness=stiffness,
            damping=self.checks.number(entry["damping"], f"{where}.damping", 0.0, 1e7, "N s/m"),
            preload=self.checks.number(entry.get("preload", load), f"{where}.preload", 0.0, 1e6, "N"),
            low=low,
            high=high,
            stop_stiffness=self.mass * GRAVITY / _STOP_DEPTH,
        )
        self._mount(wheel, where, ())
        self.joints.append(
            Joint(
                str(entry["name"]), SUSPENSION, (0.0, 0.0, 1.0), _vector(wheel.centre), slides=True, dynamics=dynamics
            )
        )

    def _load_at_rest(self, wheel: WheelEntry) -> float:
        """Load of a wheel on level ground, the one linear in position among those that balance the weight [N]."""
        places = np.array([[1.0, *other.centre[:2]] for other in self.wheels.values()])
        moments = self.mass * GRAVITY * np.array([1.0, *self.centre_of_mass[:2]])
        slopes = np.linalg.lstsq(places.T @ places, moments, rcond=None)[0]
        return max(0.0, float(np.array([1.0, *wheel.centre[:2]]) @ slopes))

    def _rocker(self, content: Any, where: str) -> None:
        known = {"name", "wheels", "pivot", "axis", "inertia", "damping", "limit"}
        entry = self.checks.mapping(content, where, known, ["name", "wheels", "pivot"])
        wheels = [
            self._wheel(name, f"{where}.wheels") for name in self.checks.items(entry["wheels"], f"{where}.wheels")
        ]
        if len(wheels) < 2:
            raise self.checks.fail(f"{where}.wheels", entry["wheels"], "two wheels or more")
        pivot = self.checks.vector(entry["pivot"], f"{where}.pivot", 3, 20.0, "m")
        axis = self.checks.vector(entry.get("axis", [0.0, 1.0, 0.0]), f"{where}.axis", 3, 1.0, "-")
        if np.linalg.norm(axis) < 1e-6:
            raise self.checks.fail(f"{where}.axis", axis.tolist(), "a direction")
        axis = axis / np.linalg.norm(axis)
        arms = [np.linalg.norm(np.cross(axis, wheel.centre - pivot)) for wheel in wheels]
        share = max(_SMALLEST_INERTIA, _UNSPRUNG_SHARE * self.mass * float(np.square(arms).sum()))
        limit = self.checks.number(entry.get("limit", math.inf), f"{where}.limit", 0.01, math.inf, "rad")
        dynamics = Coordinate(
            inertia=self.checks.number(
                entry.get("inertia", share), f"{where}.inertia", _SMALLEST_INERTIA, 1e5, "kg m²"
            ),
            damping=self.checks.number(entry.get("damping", 0.0), f"{where}.damping", 0.0, 1e6, "N m s/rad"),
            low=-limit,
            high=limit,
            stop_stiffness=self.mass * GRAVITY * float(max(arms)) / _STOP_DEPTH,
        )
        for wheel in wheels:
            self._mount(wheel, where, ())
        self.joints.append(Joint(str(entry["name"]), ROCKER, _vector(axis), _vector(pivot), dynamics=dynamics))

    def flipper(self, entry: Mapping[str, Any], where: str, joint: np.ndarray, angle: float, length: float) -> Joint:
        """The joint of a flipper whose points are at its angle."""
        front = entry["end"] == "front"
        low, high = -math.inf, math.inf
        if "limits" in entry:
            low, high = self.checks.vector(entry["limits"], f"{where}.limits", 2, 7.0, "rad").tolist()
            if not low <= angle <= high:
                raise self.checks.fail(f"{where}.angle", angle, f"an angle within its limits [{low:g}, {high:g}]")
        mass = self.checks.number(entry["mass"], f"{where}.mass", 0.0, 1e4, "kg")
        forward = length / 2 * math.cos(angle) * (1.0 if front else -1.0)
        return Joint(
            name=str(entry["name"]),
            kind=FLIPPER,
            # A positive angle raises the tip: of a front flipper, which points forward, against the y axis.
            axis=(0.0, -1.0 if front else 1.0, 0.0),
            origin=_vector(joint),
            mass=mass,
            place=_vector(joint + np.array([forward, 0.0, length / 2 * math.sin(angle)])),
            low=low,
            high=high,
            dynamics=self._flipper_dynamics(entry, where, mass * length**2 / 3),
            **self._following(entry, where),
        )

    def _flipper_dynamics(self, entry: Mapping[str, Any], where: str, inertia: float) -> Coordinate | None:
        torque = self.checks.number(
            entry.get("maximum_torque", math.inf), f"{where}.maximum_torque", 0.01, math.inf, "N m"
        )
        power = self.checks.number(entry.get("maximum_power", math.inf), f"{where}.maximum_power", 0.01, math.inf, "W")
        if math.isinf(min(torque, power)):
            return None
        reference = torque if not math.isinf(torque) else power / _FLIPPER_ERROR
        gain = reference / _FLIPPER_ERROR
        return Coordinate(
            inertia=max(inertia, 1e-4),
            stiffness=gain / _FLIPPER_TIME,
            damping=gain,
            maximum_torque=torque,
            maximum_power=power,
        )

    def motors(self, drives: Mapping[str, Sequence[int]], radii: Mapping[str, float], count: int) -> tuple:
        """Motor of each drive, as a coordinate at the rim of its wheels; None without limits.

        Args:
            drives: indices of the drives that each name of the file stands for.
            radii: wheel radius of each name [m].
            count: number of drives.
        """
        found: list[Coordinate | None] = [None] * count
        for index, content in enumerate(self.checks.items(self.top.get("motors", []), "motors")):
            where = f"motors[{index}]"
            limits = ("stall_torque", "no_load_speed", "maximum_torque", "maximum_power")
            entry = self.checks.mapping(content, where, {"drives", *limits, "inertia", "gain"}, ["drives"])
            values = {
                key: self.checks.number(entry.get(key, math.inf), f"{where}.{key}", 1e-3, math.inf, unit)
                for key, unit in zip(limits, ("N m", "rad/s", "N m", "W"), strict=True)
            }
            if "no_load_speed" in entry and "stall_torque" not in entry:
                raise self.checks.fail(where, sorted(entry), "stall_torque with no_load_speed")
            for name in self.checks.items(entry["drives"], f"{where}.drives"):
                if name not in drives:
                    raise self.checks.fail(f"{where}.drives", name, f"some of the drives {sorted(drives)}")
                for drive in drives[name]:
                    found[drive] = self._motor(entry, where, values, radii[name], 1.0 / len(drives[name]))
        return tuple(found) if any(motor is not None and motor.limited for motor in found) else ()

    def _motor(
        self, entry: Mapping[str, Any], where: str, values: Mapping[str, float], radius: float, share: float
    ) -> Coordinate:
        inertia = self.checks.number(
            entry.get("inertia", _MOTOR_SHARE * self.mass * radius**2), f"{where}.inertia", 1e-6, 1e4, "kg m²"
        )
        largest = min(values["stall_torque"], values["maximum_torque"])
        if math.isinf(largest):
            largest = values["maximum_power"] * radius / 1.0  # the torque of this power at 1 m/s
        if math.isinf(largest):
            return Coordinate(inertia)
        gain = self.checks.number(
            entry.get("gain", largest * radius / _MOTOR_ERROR), f"{where}.gain", 1e-6, 1e9, "N m s/rad"
        )
        return Coordinate(
            inertia=share * inertia / radius**2,
            damping=share * gain / radius**2,
            stall_torque=share * values["stall_torque"] / radius,
            no_load_rate=values["no_load_speed"] * radius,
            maximum_torque=share * values["maximum_torque"] / radius,
            maximum_power=share * values["maximum_power"],
        )

    def steered_drive(
        self, places: Sequence[np.ndarray], wheels: Sequence[str], motors: Mapping[str, Sequence[int]]
    ) -> SteeredDrive | None:
        """Inverse kinematics of a steered robot; None for the others.

        Args:
            places: centre of each drive's wheel, each ``[3]`` [m].
            wheels: name of each drive's wheel.
            motors: indices of the drives that each motor turns.
        """
        if not self.steers:
            return None
        steering = [index for index, joint in enumerate(self.joints) if joint.kind == STEERING]
        position = {joint: place for place, joint in enumerate(steering)}
        pivots = np.array([self.joints[index].origin[:2] for index in steering]).reshape(-1, 2)
        turned = {
            self.carrier[wheel.name]: wheel.centre[:2] for wheel in self.wheels.values() if wheel.name in self.carrier
        }
        centres = np.array([turned[index] for index in steering]).reshape(-1, 2)
        reference = self.reference_x
        if reference is None:
            reference = self._turning_axle(position) if self.kind == ACKERMANN else 0.0
        return SteeredDrive(
            kind=self.kind,
            drive_places=torch.tensor(np.array(places)[:, :2], dtype=torch.float32),
            drive_joints=tuple(position.get(self.carrier.get(name, -1), -1) for name in wheels),
            joints=tuple(steering),
            joint_places=torch.tensor(pivots, dtype=torch.float32),
            joint_offsets=torch.tensor(centres - pivots, dtype=torch.float32),
            joint_limits=torch.tensor([self.joints[index].high for index in steering], dtype=torch.float32),
            reference_x=reference,
            differentials=tuple(tuple(turned) for turned in motors.values() if len(turned) > 1)
            if self.kind == ACKERMANN
            else (),
        )

    def _turning_axle(self, steering: Mapping[int, int]) -> float:
        straight = [w.centre[0] for w in self.wheels.values() if self.carrier.get(w.name, -1) not in steering]
        every = [wheel.centre[0] for wheel in self.wheels.values()]
        return float(np.mean(straight)) if straight else 0.5 * float(min(every) + max(every))


def _vector(values: Sequence[float] | np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
