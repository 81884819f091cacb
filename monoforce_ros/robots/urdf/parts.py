"""Parts: which joints are wheels, steering, casters, rockers, tracks and flippers, and why."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.robots.urdf.description import Joint
from monoforce_ros.robots.urdf.errors import UrdfError
from monoforce_ros.robots.urdf.geometry import ALIGNED, DIRECTIONS, Frames, WheelShape, wheel_shape
from monoforce_ros.robots.urdf.shapes import Shape

HINTS = ("wheel", "free_wheel", "steering", "caster", "rocker", "track", "flipper", "fixed", "ignore")
_TRACK = re.compile(r"track(?!er|ing)|crawler|tread(?!s?_width)|(?<![a-z])belt", re.IGNORECASE)
_FLIPPER = re.compile(r"flipper", re.IGNORECASE)
_CASTER = re.compile(r"caster|castor|swivel", re.IGNORECASE)
_ONE_AXIS = 0.05
"""Rockers turn about one axis if their pivots differ by less than this along x and z [m]."""
_STRAIGHT = 0.999
"""Smallest lateral component of the axis of a wheel that is drawn straight (2.6°)."""
_TRAIL = 0.15
"""Smallest trail of a caster in wheel radii, where neither actuation nor names tell it from steering."""


@dataclass(frozen=True)
class WheelPart:
    """A wheel and the joints between it and the body."""

    name: str
    """The wheel's name in the robot file."""
    joint: Joint
    shape: WheelShape
    steering: Joint | None = None
    swivel: Joint | None = None
    rocker: Joint | None = None
    slider: Joint | None = None
    twin: Joint | None = None
    """Joint of a second wheel beside it, whose surface is part of ``shape``."""
    shapes: tuple[Shape, ...] = ()
    """Shapes of a body that a support was made of."""
    pivot: np.ndarray | None = None
    """A point of the swivel's axis in the base frame [m]; None: the origin of its joint."""
    reason: str = ""


@dataclass(frozen=True)
class BeltPart:
    """A track or a flipper: the shapes that its belt runs around."""

    name: str
    """The link's name for a track, the joint's for a flipper."""
    link: str
    shapes: tuple[tuple[str, Shape], ...]
    """With the links that carry them."""
    joint: Joint | None = None
    """The joint that a flipper turns about."""
    share: float = 1.0
    """Of the mass of the links that turn with the joint: half, if one joint turns a flipper on either side."""


@dataclass(frozen=True)
class Parts:
    """Joints and links by what they are."""

    wheels: tuple[WheelPart, ...]
    tracks: tuple[BeltPart, ...]
    flippers: tuple[BeltPart, ...]
    rockers: tuple[Joint, ...]
    left_out: frozenset[str]
    """Links that belong to none of the bodies (hint ``ignore``)."""
    notes: tuple[str, ...]


def _coaxial(first: WheelPart, second: WheelPart) -> bool:
    """Whether two wheels have one axis and one radius."""
    apart = np.abs(first.shape.centre - second.shape.centre)[[0, 2]].max()
    radii = first.shape.radius, second.shape.radius
    return bool(apart < 0.1 * min(radii) and max(radii) < 1.1 * min(radii))


def drawn_aside(frames: Frames, hints: Mapping[str, str]) -> dict[str, float]:
    """Angles [rad] that bring casters which are drawn turned to the side to straight ahead, by joint.

    A caster's wheel is one about a horizontal axis; drawn at an angle, that axis is not lateral.
    """
    angles: dict[str, float] = {}
    joints = frames.description.joints.values()
    if not any(joint.kind == "continuous" and abs(frames.axis(joint)[1]) > ALIGNED for joint in joints):
        # All wheels point elsewhere: it is the frame that is turned.
        return angles
    for swivel in joints:
        upright = frames.axis(swivel)[2]
        kinds = {hints.get(swivel.name), hints.get(swivel.child)}
        if swivel.kind != "continuous" or abs(upright) < ALIGNED or kinds & {"fixed", "ignore", "steering"}:
            continue
        for joint in frames.description.children(swivel.child):
            axis = frames.axis(joint)
            if joint.kind != "continuous" or abs(axis[2]) > 1.0 - ALIGNED or abs(axis[1]) > _STRAIGHT:
                continue
            # The smaller of the two turns that make the axis lateral.
            turn = np.arctan2(axis[0], axis[1])
            turn -= np.pi * np.round(turn / np.pi)
            angles[swivel.name] = float(turn * np.sign(upright))
    return angles


def find_parts(frames: Frames, hints: Mapping[str, str]) -> Parts:
    """Sort a description's joints by axis, shape, actuation and name; ``hints`` by link or joint name go before.

    Raises ``UrdfError``: a hint names nothing, a joint that moves mimics another, or nothing drives.
    """
    return _Finder(frames, hints).parts()


class _Finder:
    def __init__(self, frames: Frames, hints: Mapping[str, str]):
        self.frames, self.description = frames, frames.description
        self.notes: list[str] = []
        self.shapeless: list[str] = []
        """Links that would be wheels, tracks or flippers if they had a shape."""
        self.hints = dict(hints)
        known = {*self.description.links, *self.description.joints}
        for name, kind in hints.items():
            if name not in known:
                raise UrdfError(f"hint {name}={kind}: the description has no link or joint of this name")
            if kind not in HINTS:
                raise UrdfError(f"hint {name}={kind}: expected one of {', '.join(HINTS)}")

    def hint(self, joint: Joint | None, link: str) -> str | None:
        """The hint for a joint or the link that it carries."""
        return self.hints.get("" if joint is None else joint.name) or self.hints.get(link)

    def parts(self) -> Parts:
        ignored = frozenset(link for name in self._hinted("ignore") for link in self.description.subtree(name))
        flippers = self._flippers(ignored)
        taken = {link for joint in flippers for link in self.description.subtree(joint.child)} | ignored
        tracks = self._track_parts(self._tracks(taken))
        taken |= {link for track in tracks for link, _ in track.shapes if track.name == track.link}
        taken |= {link for track in tracks for link in self._hanging(track)}
        spinning = self._spinning(taken)
        names = [_short(joint.name) for joint, _ in spinning]
        wheels = tuple(
            # Short names only where they stay different.
            self._wheel(name if names.count(name) == 1 else joint.name, joint, shape)
            for name, (joint, shape) in zip(names, spinning, strict=True)
        )
        if not wheels and not tracks and not flippers:
            raise self._nothing()
        rockers = tuple(
            joint
            for joint in self.description.joints.values()
            if sum(wheel.rocker is not None and wheel.rocker.name == joint.name for wheel in wheels) >= 2
        )
        level = self._level(wheels, rockers) if not tracks and not flippers else ()
        rockers = tuple(joint for joint in rockers if joint not in level)
        carrying = {joint.name for joint in rockers}
        wheels = tuple(
            wheel if wheel.rocker is None or wheel.rocker.name in carrying else replace(wheel, rocker=None)
            for wheel in wheels
        )
        self._check_mimics(wheels, flippers)
        wheels = self._merged_twins(wheels)
        self._check_pairs(wheels)
        self._told_still(wheels, flippers, (*rockers, *level), taken)
        parts = [part for joint in flippers for part in self._flipper_parts(joint)]
        return Parts(wheels, tuple(tracks), tuple(parts), rockers, ignored, tuple(self.notes))

    def _hinted(self, kind: str) -> list[str]:
        """Links with a hint, by their own name or their joint's."""
        found = []
        for name, hint in self.hints.items():
            if hint == kind:
                found.append(self.description.joints[name].child if name in self.description.joints else name)
        return found

    def _flippers(self, ignored: frozenset[str]) -> list[Joint]:
        found: list[Joint] = []
        for joint in self.description.joints.values():
            hint = self.hint(joint, joint.child)
            if joint.child in ignored or (hint is not None and hint != "flipper"):
                continue
            named = _FLIPPER.search(joint.name) or _FLIPPER.search(joint.child)
            lateral = joint.kind in ("revolute", "continuous") and abs(self.frames.axis(joint)[1]) > ALIGNED
            if hint == "flipper" and not lateral:
                raise UrdfError(
                    f"{self.description.path}: joint {joint.name}: a flipper turns about a lateral axis; this one is "
                    f"{joint.kind}, axis {np.round(self.frames.axis(joint), 2).tolist()} of the base frame"
                )
            carried = list(self.description.subtree(joint.child))
            if lateral and (hint or named) and not len(self.frames.points(carried)):
                self.shapeless.append(joint.child)
            elif lateral and (hint or named):
                if any(joint.child in self.description.subtree(other.child) for other in found):
                    continue
                found.append(joint)
                self.notes.append(f"flipper {joint.child}: {'by hint' if hint else 'by its name'}, joint {joint.name}")
        return found

    def _flipper_parts(self, joint: Joint) -> list[BeltPart]:
        """The flipper of a joint, or one on either side if the joint turns both."""
        links = list(self.description.subtree(joint.child))
        sides = self.frames.sides(links)
        if not sides:
            return [BeltPart(joint.name, joint.child, tuple(self.frames.shapes(links)), joint)]
        self.notes.append(
            f"flipper {joint.child}: its shapes lie on both sides: one flipper on either side, each with half its "
            f"mass; give both the angle of {joint.name} in JointState"
        )
        return [
            BeltPart(f"{joint.name}_{side}", joint.child, tuple(shapes), joint, 0.5) for side, shapes in sides.items()
        ]

    def _track_parts(self, links: Sequence[str]) -> list[BeltPart]:
        """The track of each link, or one on either side if a link has shapes on both."""
        found = []
        for link in links:
            sides = self.frames.sides([link])
            if sides:
                found += [BeltPart(f"{link}_{side}", link, tuple(shapes)) for side, shapes in sides.items()]
                self.notes.append(f"track {link}: its shapes lie on both sides: one track on either side")
            else:
                found.append(BeltPart(link, link, tuple(self.frames.shapes(self.description.subtree(link)))))
        return found

    def _hanging(self, track: BeltPart) -> list[str]:
        """Links that belong to a track: all that hang on it, or none if it is a part of the body."""
        return list(self.description.subtree(track.link)) if track.name == track.link else []

    def _level(self, wheels: Sequence[WheelPart], rockers: Sequence[Joint]) -> tuple[Joint, ...]:
        """Rockers that carry the whole body about one lateral axis, on which it would tip onto its stops."""
        carried = [wheel.rocker for wheel in wheels if wheel.rocker in rockers]
        if len(rockers) < 2 or len(carried) < len(wheels) or any(self.hint(j, j.child) == "rocker" for j in rockers):
            return ()
        pivots = np.array([self.frames.origin(joint) for joint in rockers])
        lateral = all(abs(self.frames.axis(joint)[1]) > ALIGNED for joint in rockers)
        if not lateral or np.ptp(pivots[:, [0, 2]], axis=0).max() > _ONE_AXIS:
            return ()
        self.notes.append(
            f"rockers {', '.join(joint.name for joint in rockers)}: held at 0, because the whole body hangs on one "
            "axis and the file does not say what keeps it level (a differential); to let them swing: "
            f"--hint {rockers[0].name}=rocker"
        )
        return tuple(rockers)

    def _tracks(self, taken: set[str]) -> list[str]:
        found: list[str] = []
        for name in self.description.links:
            hint = self.hint(self.description.parent_joint(name), name)
            if name in taken or (hint is not None and hint != "track"):
                continue
            if name == self.frames.base and not (hint and self.frames.sides([name])):
                continue
            inside = any(name in self.description.subtree(track) for track in found)
            rollers = len(self.frames.points([name])) > 0
            if _TRACK.search(name) and self.description.links[name].without_meshes and not rollers:
                self.shapeless.append(name)
            if not inside and (hint or (_TRACK.search(name) and rollers)):
                found.append(name)
                self.notes.append(f"track {name}: {'by hint' if hint else 'by its name'}")
        return found

    def _spinning(self, taken: set[str]) -> list[tuple[Joint, WheelShape]]:
        """Joints that carry a wheel, with its shape."""
        candidates = []
        for joint in self.description.joints.values():
            hint = self.hint(joint, joint.child)
            if joint.child in taken or hint in ("fixed", "steering", "caster", "rocker"):
                continue
            lateral = abs(self.frames.axis(joint)[1]) > ALIGNED
            if hint in ("wheel", "free_wheel") and not lateral:
                raise UrdfError(f"{self.description.path}: {self._axis(joint)}; a wheel's is lateral, (0, 1, 0)")
            if hint in ("wheel", "free_wheel") or (joint.kind == "continuous" and lateral):
                shape = wheel_shape(self.frames, joint)
                if shape is not None:
                    candidates.append((joint, shape))
                elif self.description.links[joint.child].without_meshes:
                    self.shapeless.append(joint.child)
        candidates = self._on_the_ground(candidates)
        inner = {joint.child for joint, _ in candidates}
        # What carries another wheel is a rocker, not a wheel.
        return [
            (joint, shape)
            for joint, shape in candidates
            if not any(link in inner for link in list(self.description.subtree(joint.child))[1:])
        ]

    def _on_the_ground(self, candidates: list[tuple[Joint, WheelShape]]) -> list[tuple[Joint, WheelShape]]:
        """Those that reach down to about where the lowest one does: arms and tilting sensors turn about such axes, too.

        What hangs higher by more than the smallest radius is no wheel, unless a hint says so.
        """
        bottoms = [float(shape.centre[2]) - shape.radius for _, shape in candidates]
        ground, smallest = min(bottoms, default=0.0), min((shape.radius for _, shape in candidates), default=0.0)
        kept = []
        for (joint, shape), bottom in zip(candidates, bottoms, strict=True):
            hinted = self.hint(joint, joint.child) in ("wheel", "free_wheel")
            if hinted or bottom - ground <= smallest:
                kept.append((joint, shape))
            else:
                self.notes.append(
                    f"joint {joint.name} turns about a lateral axis, but {joint.child} hangs {bottom - ground:.2f} m "
                    f"above the wheels' ground: it is part of the body; --hint {joint.name}=wheel makes it a wheel"
                )
        return kept

    def _wheel(self, name: str, joint: Joint, shape: WheelShape) -> WheelPart:
        part = WheelPart(
            name, joint, shape, reason=f"joint {joint.name} is {joint.kind} about a lateral axis, {shape.source}"
        )
        parent = self.description.parent_joint(joint.parent)
        while parent is not None and parent.child != self.frames.base:
            part = self._carried(part, parent)
            parent = self.description.parent_joint(parent.parent)
        return part

    def _carried(self, part: WheelPart, joint: Joint) -> WheelPart:
        """The wheel with one more joint between it and the body."""
        hint = self.hint(joint, joint.child)
        if joint.kind not in ("continuous", "revolute", "prismatic") or hint == "fixed":
            return part
        axis = np.abs(self.frames.axis(joint))
        if joint.kind == "prismatic":
            return replace(part, slider=joint) if axis[2] > ALIGNED else part
        if axis[2] > ALIGNED and part.steering is None and part.swivel is None:
            if hint == "caster" or (hint != "steering" and self._is_caster(part, joint)):
                return replace(part, swivel=joint)
            return replace(part, steering=joint)
        if (axis[1] > ALIGNED or axis[0] > ALIGNED or hint == "rocker") and part.rocker is None:
            return replace(part, rocker=joint)
        return part

    def _is_caster(self, part: WheelPart, joint: Joint) -> bool:
        if _CASTER.search(joint.name) or _CASTER.search(joint.child):
            return True
        if self.description.actuated:
            return joint.name not in self.description.actuated and joint.kind == "continuous"
        trail = abs(part.shape.centre[0] - self.frames.origin(joint)[0])
        return joint.kind == "continuous" and trail > _TRAIL * part.shape.radius

    def _check_mimics(self, wheels: Sequence[WheelPart], flippers: Sequence[Joint]) -> None:
        used = list(flippers)
        for wheel in wheels:
            used += [joint for joint in (wheel.joint, wheel.steering) if joint is not None]
        sides = {wheel.joint.name: wheel.shape.centre[1] > 0 for wheel in wheels}
        for joint in used:
            if joint.mimics is None:
                continue
            if joint.name in sides and sides.get(joint.mimics) == sides[joint.name]:
                self.notes.append(
                    f"wheel {joint.name} turns as {joint.mimics} does: all wheels of a side have one speed anyway"
                )
                continue
            fixed = "" if joint.name in sides else f", or pass --hint {joint.name}=fixed"
            raise UrdfError(
                f"{self.description.path}: joint {joint.name} mimics {joint.mimics}: joints that follow others "
                f"are not supported, except wheels that follow one of their side; remove the mimic tag (the drive's "
                f"kinematics couple the wheels){fixed}"
            )

    def _merged_twins(self, wheels: tuple[WheelPart, ...]) -> tuple[WheelPart, ...]:
        """Wheels with those that run beside each other on one swivel joined: twin casters stand on one strip."""
        kept: list[WheelPart] = []
        for wheel in wheels:
            beside = [
                index
                for index, other in enumerate(kept)
                if wheel.swivel is not None and other.swivel is wheel.swivel and _coaxial(other, wheel)
            ]
            if not beside or kept[beside[0]].twin is not None:
                kept.append(wheel)
                continue
            first = kept[beside[0]]
            edges = [part.shape.centre[1] + side * part.shape.width / 2 for part in (first, wheel) for side in (-1, 1)]
            centre = first.shape.centre.copy()
            centre[1] = (min(edges) + max(edges)) / 2
            shape = replace(first.shape, centre=centre, width=max(edges) - min(edges))
            kept[beside[0]] = replace(first, shape=shape, twin=wheel.joint)
            assert first.swivel is not None
            self.notes.append(
                f"caster {first.swivel.name}: {first.joint.name} and {wheel.joint.name} run beside each other and are "
                f"one wheel, {shape.width:.3f} m wide; that they turn at different speeds when it swivels is left out"
            )
        return tuple(kept)

    def _check_pairs(self, wheels: Sequence[WheelPart]) -> None:
        carried: dict[str, str] = {}
        for wheel in wheels:
            for joint in (wheel.steering, wheel.swivel):
                if joint is None:
                    continue
                if joint.name in carried:
                    raise UrdfError(
                        f"{self.description.path}: joint {joint.name} turns the wheels {carried[joint.name]} and "
                        f"{wheel.name}: an axle or a pair of wheels on one vertical joint is not supported; leave one "
                        f"of a pair out (--hint {wheel.joint.child}=ignore), or hold the axle straight (--hint "
                        f"{joint.name}=fixed)"
                    )
                carried[joint.name] = wheel.name

    def _told_still(
        self, wheels: Sequence[WheelPart], flippers: Sequence[Joint], rockers: Sequence[Joint], taken: set[str]
    ) -> None:
        moving = {joint.name for joint in (*flippers, *rockers)}
        for wheel in wheels:
            used = (wheel.joint, wheel.steering, wheel.swivel)
            moving |= {joint.name for joint in used if joint is not None}
        for joint in self.description.joints.values():
            if (
                joint.kind not in ("continuous", "revolute", "prismatic")
                or joint.name in moving
                or joint.child in taken
            ):
                continue
            if any(wheel.slider is not None and wheel.slider.name == joint.name for wheel in wheels):
                self.notes.append(
                    f"joint {joint.name}: a suspension held rigid, URDF has no springs; write a `suspension` entry"
                )
            else:
                carries = sum(wheel.joint.child in self.description.subtree(joint.child) for wheel in wheels)
                why = " (of joints that carry wheels, only the one next to two or more swings)" if carries else ""
                self.notes.append(f"joint {joint.name} ({joint.kind}): held at 0{why}")
        for link in self.shapeless:
            self.notes.append(f"{link}: neither wheel, track nor flipper, because it has no shape without its mesh")

    def _axis(self, joint: Joint) -> str:
        axis = ", ".join(f"{value:g}" for value in np.round(self.frames.axis(joint), 2) + 0.0)
        return f"joint {joint.name}: its axis is ({axis}) of the base frame"

    def _has_wheel(self, joint: Joint) -> bool:
        try:
            return wheel_shape(self.frames, joint) is not None
        except UrdfError:
            return False

    def _nothing(self) -> UrdfError:
        if self.shapeless:
            return UrdfError(
                f"{self.description.path}: no wheel, track or flipper has a shape: the meshes of "
                f"{', '.join(self.shapeless[:6])} are left out; name the folder of the meshes (--package NAME=FOLDER)"
            )
        ahead = [
            joint.name
            for joint in self.description.joints.values()
            if joint.kind == "continuous" and abs(self.frames.axis(joint)[0]) > ALIGNED and self._has_wheel(joint)
        ]
        if len(ahead) >= 2:
            directions = [name for name, angle in DIRECTIONS.items() if abs(np.cos(angle)) < 0.5]
            if self.frames.forward not in ("x", "-x"):
                directions = [name for name in DIRECTIONS if name not in directions]
            return UrdfError(
                f"{self.description.path}: the joints {', '.join(ahead[:4])} turn about a longitudinal axis of the "
                "base frame, as if the robot drove sideways; name the direction of travel in the axes of "
                f"{self.frames.base} (--forward={directions[0]} or --forward={directions[1]}) or a frame with x "
                "forward (--base-frame)"
            )
        turning = [joint for joint in self.description.joints.values() if joint.kind == "continuous"]
        listed = "; ".join(self._axis(joint) for joint in turning[:4]) or "there is no continuous joint"
        return UrdfError(
            f"{self.description.path}: no wheel, track or flipper found: {listed}. A wheel is a continuous joint about "
            "a lateral axis, (0, 1, 0), whose link has a collision shape; name others by --hint NAME=wheel, "
            "--track LINK or --flipper LINK, and the frame with x forward by --base-frame"
        )


def _short(name: str) -> str:
    """A joint's name without the words at its end that most wheel joints have."""
    return re.sub(r"(_wheel|_drive)?(_joint|_jnt|_axle)?$", "", name) or name
