"""Conversion: a robot description becomes the content of a robot file, with a list of what was guessed."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from monoforce_ros.robots.urdf.description import Description, Joint, Link
from monoforce_ros.robots.urdf.errors import UrdfError
from monoforce_ros.robots.urdf.geometry import DIRECTIONS, Frames, belt_shape, flipper_shape
from monoforce_ros.robots.urdf.hull import find_hull
from monoforce_ros.robots.urdf.parts import BeltPart, Parts, WheelPart, drawn_aside, find_parts
from monoforce_ros.robots.urdf.review import SAME_AXLE, review, side_of
from monoforce_ros.robots.urdf.sensors import find_sensors
from monoforce_ros.robots.urdf.supports import find_supports

DRIVES = ("skid", "differential", "ackermann", "four_wheel_steering", "independent")
_FASTEST = 100.0
"""Velocity limits from this on [rad/s] are placeholders: URDF requires a number even where there is no limit."""
_SIDEWAYS_WHEELS = ("mecanum", "omni")
"""Parts of names of wheels with rollers on their rims."""
_LARGEST_STEERING = 1.4
"""Steering limits above this [rad] are placeholders; beyond it a wheel is nearly across."""
_TILTED = 3.0
"""Tilt of a steering axis from which it is reported [deg]."""
_HEAVY, _POINT = 0.1, 0.05
"""Links are heavy from this share of the robot's mass; a radius of gyration below this share of a shape's diagonal is
that of a point (a rod has 0.29, a box at least 0.17)."""


@dataclass(frozen=True)
class ConversionOptions:
    """What the caller says about a robot; the rest is guessed."""

    name: str | None = None
    base_frame: str | None = None
    forward: str = "x"
    """Direction of travel in the axes of the base frame's link: ``x``, ``y``, ``-x`` or ``-y``."""
    drive: str | None = None
    maximum_speed: float | None = None
    maximum_yaw_rate: float | None = None
    hints: Mapping[str, str] = field(default_factory=dict)
    """Kind by link or joint name, see :data:`monoforce_ros.robots.urdf.parts.HINTS`."""


@dataclass(frozen=True)
class Conversion:
    """A robot file's content, and what it rests on."""

    content: Mapping[str, Any]
    """What :func:`monoforce_ros.robots.load_robot` reads."""
    guesses: tuple[str, ...]
    """One line for each guess."""
    warnings: tuple[str, ...]
    """What is probably wrong with the description or the guesses."""


def convert_description(description: Description, options: ConversionOptions | None = None) -> Conversion:
    """Make a robot file's content from a description.

    Raises ``UrdfError`` if the description has no masses, no wheels, tracks or flippers, or contradicts an option.
    """
    return _Converter(description, options or ConversionOptions()).conversion()


class _Converter:
    def __init__(self, description: Description, options: ConversionOptions):
        if options.drive is not None and options.drive not in DRIVES:
            raise UrdfError(f"drive {options.drive!r}: expected one of {', '.join(DRIVES)}")
        self.description, self.options = description, options
        self.guesses: list[str] = []
        self.warnings: list[str] = []
        if options.forward not in DIRECTIONS:
            raise UrdfError(f"forward {options.forward!r}: expected one of {', '.join(DIRECTIONS)}")
        self.frames = self._straightened(Frames(description, self._base(), options.forward))
        self.description = self.frames.description
        self.parts = self._with_supports(find_parts(self.frames, options.hints))

    def fail(self, message: str) -> UrdfError:
        return UrdfError(f"{self.description.path}: {message}")

    def guess(self, text: str) -> None:
        self.guesses.append(text)

    def _base(self) -> str:
        links = self.description.links
        if self.options.base_frame is not None:
            if self.options.base_frame not in links:
                raise self.fail(
                    f"base frame {self.options.base_frame!r}: expected one of {', '.join(list(links)[:8])}, ..."
                )
            return self.options.base_frame
        found = "base_link" if "base_link" in links else self.description.root
        self.guess(f"base frame {found}: {'by its name' if found == 'base_link' else 'the root link'}")
        return found

    def _straightened(self, frames: Frames) -> Frames:
        """The description with its casters straight ahead."""
        angles = drawn_aside(frames, self.options.hints)
        for name, angle in angles.items():
            self.warnings.append(
                f"caster {name}: drawn turned to the side; its angle 0 in the robot file is {angle:.3f} rad in the "
                "description"
            )
        return replace(frames, description=frames.description.turned(angles)) if angles else frames

    def _with_supports(self, parts: Parts) -> Parts:
        """The parts, and casters that are fixed to the body."""
        taken = set(parts.left_out) | {link for wheel in parts.wheels for link in self._turning_with(wheel)}
        taken |= {link for belt in (*parts.tracks, *parts.flippers) for link, _ in belt.shapes}
        return replace(
            parts, wheels=(*parts.wheels, *find_supports(self.frames, parts.wheels, self.options.hints, taken))
        )

    def _turning_with(self, wheel: WheelPart) -> list[str]:
        joints = (wheel.joint, wheel.twin)
        return [link for joint in joints if joint for link in self.description.subtree(joint.child, ("fixed",))]

    def _base_frame(self) -> str:
        """Name of the robot file's base frame."""
        base, forward = self.frames.base, self.options.forward
        if forward == "x":
            return base
        angle = DIRECTIONS[forward]
        self.warnings.append(
            f"the base frame {base}_forward is {base} turned by {angle:.4f} rad, and the description has no such link; "
            f"publish it: ros2 run tf2_ros static_transform_publisher --yaw {angle:.6f} --frame-id {base} "
            f"--child-frame-id {base}_forward"
        )
        return f"{base}_forward"

    def conversion(self) -> Conversion:
        mass, centre, inertia = self._mass()
        wheels = self.parts.wheels
        kind = self._drive_kind()
        content: dict[str, Any] = {
            "name": self._name(),
            "description": f"imported from {self.description.path.name}",
            "base_frame": self._base_frame(),
            "mass": _number(mass),
            "centre_of_mass": _numbers(centre),
            "inertia": _numbers([*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]),
            "command": {},
        }
        if kind != "skid":
            content["drive"] = {"kind": kind}
        self.guesses += self.parts.notes
        driven = self._driven(kind)
        content["wheels"] = [self._wheel_entry(wheel, kind, driven) for wheel in wheels]
        content["tracks"] = [entry for track in self.parts.tracks if (entry := self._track_entry(track))]
        content["flippers"] = [self._flipper_entry(part) for part in self.parts.flippers]
        content["steering"] = [self._steering_entry(wheel) for wheel in wheels if wheel.steering is not None]
        content["casters"] = [self._caster_entry(wheel) for wheel in wheels if wheel.swivel is not None]
        content["rockers"] = [self._rocker_entry(joint) for joint in self.parts.rockers]
        hull = find_hull(self.frames, self.parts)
        content["hull"] = [
            {"name": name, "centre": _numbers((low + high) / 2), "size": _numbers(high - low)}
            for name, low, high in hull.boxes
        ]
        self.guesses += hull.guesses
        self.warnings += hull.warnings
        sensors, notes = find_sensors(self.frames)
        content["sensors"] = sensors
        self.guesses += notes
        content["command"] = self._command(content)
        self.warnings += review(content)
        kept = {key: value for key, value in content.items() if value not in ([], {})}
        return Conversion(kept, tuple(self.guesses), tuple(self.warnings))

    def _name(self) -> str:
        return re.sub(r"\W+", "_", self.options.name or self.description.name).strip("_").lower() or "robot"

    def _mass(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass, centre of mass and inertia about it at the zero position, by the parallel-axis theorem."""
        links = [link for name, link in self.description.links.items() if name not in self.parts.left_out]
        heavy = [link for link in links if link.mass > 0]
        if not heavy:
            raise self.fail(f"none of the {len(links)} links has a mass; add inertial elements")
        without = [name for name in self._moving_links() if not self._carried_mass(name)]
        if without:
            self.warnings.append(f"without mass: {', '.join(without[:6])}; the robot's mass may be too small")
        body = list(self.description.subtree(self.frames.base, ("fixed",)))
        if len(self.frames.points(body)) and not sum(self.description.links[name].mass for name in body):
            self.warnings.append(f"without mass: the body, {self.frames.base}; the robot's mass is far too small")
        poses = {link.name: self.frames.link(link.name) for link in heavy}
        places = np.array([poses[link.name][:3, :3] @ link.centre + poses[link.name][:3, 3] for link in heavy])
        masses = np.array([link.mass for link in heavy])
        centre = masses @ places / masses.sum()
        self._check_inertias(heavy, float(masses.sum()))
        inertia = np.zeros((3, 3))
        for link, place in zip(heavy, places, strict=True):
            turn, arm = poses[link.name][:3, :3], place - centre
            inertia += turn @ link.inertia @ turn.T + link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        moments = np.linalg.eigvalsh(inertia)
        if moments[0] <= 0 or moments[0] + moments[1] < moments[2] * (1 - 1e-6):
            raise self.fail(
                f"inertia of the whole robot: principal moments {moments.round(5).tolist()} kg m², expected positive "
                "ones, the largest at most the others' sum; correct the links' inertia elements"
            )
        self.guess(f"mass {masses.sum():.4g} kg: the sum over {len(heavy)} links, at the zero position of all joints")
        return float(masses.sum()), centre, inertia

    def _check_inertias(self, links: Sequence[Link], total: float) -> None:
        """Name heavy links whose inertia is that of a point, not of their shape."""
        for link in links:
            points = np.concatenate(
                [shape.placed(np.eye(4)) for shape in link.shapes or link.visuals] or [np.zeros((1, 3))]
            )
            extent = float(np.linalg.norm(np.ptp(points, axis=0)))
            gyration = math.sqrt(max(np.linalg.eigvalsh(link.inertia)[-1], 0.0) / link.mass)
            if link.mass > _HEAVY * total and gyration < _POINT * extent:
                self.warnings.append(
                    f"inertia of {link.name}: a radius of gyration of {100 * gyration:.1f} cm for a shape of "
                    f"{extent:.2f} m; is it a placeholder?"
                )

    def _moving_links(self) -> list[str]:
        turning = [wheel.joint.child for wheel in self.parts.wheels if wheel.joint.kind != "fixed"]
        return list(dict.fromkeys(turning + [belt.link for belt in (*self.parts.tracks, *self.parts.flippers)]))

    def _carried_mass(self, link: str) -> float:
        """Mass of a link and all that hang on it [kg]."""
        return sum(self.description.links[name].mass for name in self.description.subtree(link))

    def _drive_kind(self) -> str:
        wheels = self.parts.wheels
        steered = [wheel for wheel in wheels if wheel.steering is not None]
        straight = [wheel for wheel in wheels if wheel.steering is None and wheel.swivel is None]
        if self.options.drive is not None:
            return self.options.drive
        if not steered:
            casters = len(straight) < len(wheels)
            along = [wheel.shape.centre[0] for wheel in straight]
            one_axle = len(straight) >= 2 and max(along) - min(along) < SAME_AXLE and not self.parts.tracks
            kind, reason = ("differential", "it has casters") if casters else ("skid", "no wheel is steered")
            if one_axle and not casters:
                kind, reason = "differential", "its wheels stand on one axle"
        elif not straight:
            four = len(steered) == 4
            kind, reason = ("four_wheel_steering" if four else "independent"), f"all {len(steered)} wheels are steered"
        else:
            places = [wheel.shape.centre[0] for wheel in steered]
            between = all(min(places) < wheel.shape.centre[0] < max(places) for wheel in straight)
            if max(places) - min(places) > SAME_AXLE and between:
                kind, reason = "independent", "wheels in front and behind are steered, those between are not"
            else:
                kind, reason = "ackermann", f"{len(steered)} of {len(wheels)} wheels are steered"
        self.guess(f"drive {kind}: {reason}")
        names = [f"{wheel.joint.name} {wheel.joint.child}".lower() for wheel in wheels]
        rolling = [
            wheel.joint.child
            for wheel, name in zip(wheels, names, strict=True)
            if any(word in name for word in _SIDEWAYS_WHEELS)
        ]
        if rolling:
            self.warnings.append(
                f"wheels {', '.join(rolling)}: by their names they have rollers and move sideways, too; here they have "
                "the grip of plain wheels, so that only driving straight is predicted as it is"
            )
        return kind

    def _driven(self, kind: str) -> set[str]:
        """Joints of the wheels that a motor turns."""
        wheels = [wheel for wheel in self.parts.wheels if wheel.swivel is None]
        hinted = {wheel.joint.name for wheel in wheels if self._hinted(wheel, "free_wheel")}
        named = {wheel.joint.name for wheel in wheels} & self.description.actuated
        if named:
            free = [wheel.name for wheel in wheels if wheel.joint.name not in named]
            if free:
                self.guess(f"free wheels {', '.join(free)}: no transmission or ros2_control interface names them")
            return named - hinted
        told = {wheel.joint.name for wheel in wheels if self._hinted(wheel, "wheel")}
        if told and any(wheel.joint.name in told for wheel in wheels if wheel.steering is not None):
            return told
        found = {wheel.joint.name for wheel in wheels if kind != "ackermann" or wheel.steering is None}
        if kind == "ackermann":
            self.guess("driven wheels: those that are not steered, because the file names no motors")
        return (found or {wheel.joint.name for wheel in wheels}) - hinted

    def _hinted(self, wheel: WheelPart, kind: str) -> bool:
        return kind in (self.options.hints.get(wheel.joint.name), self.options.hints.get(wheel.joint.child))

    def _drive(self, wheel: WheelPart, kind: str) -> str:
        """Name of a wheel's drive: its side, its axle, or its own."""
        if kind in ("skid", "differential"):
            return side_of(wheel.shape.centre[1])
        if kind == "ackermann":
            middle = np.mean([other.shape.centre[0] for other in self.parts.wheels])
            return "front" if wheel.shape.centre[0] > middle else "rear"
        return wheel.name

    def _wheel_entry(self, wheel: WheelPart, kind: str, driven: set[str]) -> dict[str, Any]:
        shape = wheel.shape
        drive = self._drive(wheel, kind) if wheel.joint.name in driven else None
        self.guess(
            f"wheel {wheel.name}: {wheel.reason}, radius {shape.radius:.3f} m, width {shape.width:.3f} m, "
            f"{'rolls freely' if drive is None else f'drive {drive}'}"
        )
        return {
            "name": wheel.name, "drive": drive, "centre": _numbers(shape.centre), "radius": _number(shape.radius),
            "width": _number(shape.width),
        }  # fmt: skip

    def _track_entry(self, part: BeltPart) -> dict[str, Any] | None:
        shape, track = belt_shape(self.frames, part.shapes), part.name
        if shape is None:
            raise self.fail(
                f"track {track}: no collision shapes that are longer than high; give it a box, or pass "
                f"--hint {part.link}=fixed"
            )
        radius = (shape.rear_radius + shape.front_radius) / 2
        centre = (shape.rear + shape.front) / 2
        length = float(shape.front[0] - shape.rear[0])
        self.guess(
            f"track {track}: from {shape.source}, length {length:.3f} m between rollers of radius {radius:.3f} m"
        )
        return {
            "name": track, "drive": side_of(centre[1]), "centre": _numbers(centre), "length": _number(length),
            "radius": _number(radius), "width": _number(shape.width),
        }  # fmt: skip

    def _flipper_entry(self, part: BeltPart) -> dict[str, Any]:
        joint = part.joint
        assert joint is not None
        axle = self.frames.origin(joint)
        shape = flipper_shape(self.frames, part.shapes, axle)
        if shape is None:
            raise self.fail(f"flipper {joint.child}: no collision shapes that are longer than high; give it a box")
        reach = shape.front - shape.rear
        end = "front" if self._points_forward(joint, reach) else "rear"
        angle = math.atan2(reach[2], reach[0] if end == "front" else -reach[0])
        mass = part.share * self._carried_mass(joint.child)
        length = float(np.hypot(reach[0], reach[2]))
        centre = shape.rear
        entry: dict[str, Any] = {
            "name": part.name, "drive": side_of(centre[1]), "end": end, "joint": _numbers(centre),
            "length": _number(length),
            "root_radius": _number(shape.rear_radius), "tip_radius": _number(shape.front_radius),
            "width": _number(shape.width),
            "mass": _number(mass), "angle": _number(angle),
        }  # fmt: skip
        entry |= self._flipper_limits(joint, end, angle)
        up = self._raises(joint, end)
        if up < 0 or abs(angle) > 0.02:
            self.warnings.append(
                f"flipper {part.name}: its angle in the robot file is {_number(angle):+g} {'+' if up > 0 else '-'} the "
                "joint's angle in this description [rad]; convert the measured and commanded angles in JointState"
            )
        self.guess(
            f"flipper {part.name}: from {shape.source}, {end}, length {length:.3f} m, at {math.degrees(angle):.0f}° "
            "at the zero position"
        )
        return entry

    def _raises(self, joint: Joint, end: str) -> float:
        """1 if a positive rotation raises the tip, -1 if it lowers it: about y it lowers what points forward."""
        return float(-np.sign(self.frames.axis(joint)[1]) * (1.0 if end == "front" else -1.0))

    def _flipper_limits(self, joint: Joint, end: str, angle: float) -> dict[str, Any]:
        """Limits of the angle, positive upwards, and of its speed, where the file has them."""
        entry: dict[str, Any] = {}
        if joint.limits is not None and joint.limits[1] - joint.limits[0] < 2 * math.pi:
            up = self._raises(joint, end)
            entry["limits"] = sorted(_number(angle + up * limit) for limit in joint.limits)
        if joint.maximum_velocity is not None and joint.maximum_velocity < _FASTEST:
            entry["maximum_rate"] = _number(joint.maximum_velocity)
        return entry

    def _points_forward(self, joint: Joint, reach: np.ndarray) -> bool:
        """Whether a flipper is a front one: by where it points, or where its axle is if it stands upright."""
        if abs(reach[0]) > 0.2 * np.linalg.norm(reach):
            return bool(reach[0] > 0)
        places = [self.frames.origin(other.joint)[0] for other in self.parts.flippers if other.joint]
        return bool(self.frames.origin(joint)[0] >= (min(places) + max(places)) / 2)

    def _steering_entry(self, wheel: WheelPart) -> dict[str, Any]:
        joint = wheel.steering
        assert joint is not None
        entry: dict[str, Any] = {"name": joint.name, "wheel": wheel.name}
        limit = min(abs(joint.limits[0]), abs(joint.limits[1])) if joint.limits else math.inf
        if not 0.01 < limit <= _LARGEST_STEERING:
            given = "no limit" if joint.limits is None else f"the limits {joint.limits[0]:g} to {joint.limits[1]:g} rad"
            self.guess(f"steering {joint.name}: {given} in the file, {_LARGEST_STEERING} rad are taken")
            limit = _LARGEST_STEERING
        entry["maximum_angle"] = _number(limit)
        if joint.maximum_velocity is not None and joint.maximum_velocity < _FASTEST:
            entry["maximum_rate"] = _number(joint.maximum_velocity)
        if self.frames.axis(joint)[2] < 0:
            self.warnings.append(
                f"steering {joint.name}: positive angles in this description steer to the right, those of the robot "
                "file to the left; change the sign of its angles in JointState"
            )
        entry["pivot"] = _numbers(self.frames.origin(joint))
        tilt = math.degrees(math.acos(min(abs(self.frames.axis(joint)[2]), 1.0)))
        about = (
            f"an axis that is tilted by {tilt:.0f}°, as if it were vertical" if tilt > _TILTED else "a vertical axis"
        )
        self.guess(f"steering {joint.name}: turns {wheel.name} about {about}, {math.degrees(limit):.0f}° to each side")
        return entry

    def _caster_entry(self, wheel: WheelPart) -> dict[str, Any]:
        joint = wheel.swivel
        assert joint is not None
        pivot = self.frames.origin(joint) if wheel.pivot is None else wheel.pivot
        trail = float(np.linalg.norm((wheel.shape.centre - pivot)[:2]))
        how = "without a motor" if wheel.pivot is None else "as a ball rolls in any direction"
        self.guess(f"caster {joint.name}: swivels {wheel.name} about a vertical axis {how}, trail {trail:.3f} m")
        if trail < 0.005:
            self.warnings.append(f"caster {joint.name}: without trail it does not follow; correct its origin")
        return {"name": joint.name, "wheel": wheel.name, "pivot": _numbers(pivot)}

    def _rocker_entry(self, joint: Joint) -> dict[str, Any]:
        wheels = [w.name for w in self.parts.wheels if w.rocker is not None and w.rocker.name == joint.name]
        entry: dict[str, Any] = {"name": joint.name, "wheels": wheels, "pivot": _numbers(self.frames.origin(joint))}
        if abs(self.frames.axis(joint)[0]) > abs(self.frames.axis(joint)[1]):
            entry["axis"] = [1.0, 0.0, 0.0]
        limit = min(abs(joint.limits[0]), abs(joint.limits[1])) if joint.limits else math.inf
        if 0.01 < limit < math.pi:
            entry["limit"] = _number(limit)
        self.guess(f"rocker {joint.name}: carries {', '.join(wheels)}")
        return entry

    def _command(self, content: Mapping[str, Any]) -> dict[str, Any]:
        wheels = [wheel for wheel in self.parts.wheels if wheel.swivel is None]
        sides = [wheel.shape.centre[1] for wheel in wheels] + [entry["centre"][1] for entry in content["tracks"]]
        sides = sides or [entry["joint"][1] for entry in content["flippers"]]
        # A wheel on the centre line is on neither side.
        width = 2 * float(np.mean([side for side in np.abs(sides) if side >= 0.1 * np.max(np.abs(sides))]))
        command: dict[str, Any] = {"track_width": _number(max(width, 0.05))}
        self.guess(f"track width {width:.3f} m: twice the mean distance of wheels and tracks from the centre line")
        speed = self.options.maximum_speed
        limits = [
            wheel.joint.maximum_velocity * wheel.shape.radius
            for wheel in wheels
            if wheel.joint.maximum_velocity is not None and wheel.joint.maximum_velocity < _FASTEST
        ]
        if speed is None and limits:
            speed = float(min(limits))
            self.guess(f"maximum speed {speed:.2f} m/s: the wheel joints' velocity limit times the radius")
        if speed is None:
            self.guess("maximum speed: not limited; give --maximum-speed")
        else:
            command["maximum_speed"] = _number(speed)
        if self.options.maximum_yaw_rate is not None:
            command["maximum_yaw_rate"] = _number(self.options.maximum_yaw_rate)
        return command


def _number(value: float) -> float:
    """Rounded for reading: 10 µm, and four digits of larger numbers, are finer than any description."""
    return float(f"{value:.6g}") if abs(value) >= 1.0 else round(float(value), 6) + 0.0


def _numbers(values: Sequence[float] | np.ndarray) -> list[float]:
    return [_number(float(value)) for value in values]


__all__ = ["DRIVES", "Conversion", "ConversionOptions", "Parts", "convert_description"]
