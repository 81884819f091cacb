"""Geometry: bounds, wheels and belts of links in the base frame, at the zero position."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from monoforce_ros.robots.urdf.description import Description, Joint
from monoforce_ros.robots.urdf.errors import UrdfError
from monoforce_ros.robots.urdf.shapes import Shape

ALIGNED = 0.9
"""Smallest cosine between an axis and the direction that it is taken for (26°); camber and caster are smaller."""
DIRECTIONS = {"x": 0.0, "y": math.pi / 2, "-x": math.pi, "-y": -math.pi / 2}
"""Angle of a horizontal direction about the vertical axis [rad]."""
_PARALLEL = 0.95
_SPHERE_WIDTH = 0.5
"""Width of a spherical wheel in radii: it touches soft ground about as wide as this."""


@dataclass(frozen=True)
class Frames:
    """Poses of a description's links and joints in the base frame."""

    description: Description
    base: str
    forward: str = "x"
    """Direction of travel in the axes of ``base``, one of :data:`DIRECTIONS`: the base frame's x axis."""

    def link(self, name: str) -> np.ndarray:
        """Base ← link, ``[4, 4]``."""
        poses = self.description.poses
        return self._turn() @ np.linalg.inv(poses[self.base]) @ poses[name]

    def _turn(self) -> np.ndarray:
        """Base frame ← link ``base``, ``[4, 4]``: a turn about the vertical axis."""
        angle = DIRECTIONS[self.forward]
        cosine, sine = round(math.cos(angle)), round(math.sin(angle))
        turn = np.eye(4)
        turn[:2, :2] = [[cosine, sine], [-sine, cosine]]
        return turn

    def axis(self, joint: Joint) -> np.ndarray:
        """A joint's axis in the base frame, ``[3]``."""
        return self.link(joint.child)[:3, :3] @ joint.axis

    def origin(self, joint: Joint) -> np.ndarray:
        """A joint's origin in the base frame [m], ``[3]``."""
        return self.link(joint.child)[:3, 3]

    def shapes(self, links: Iterable[str]) -> Iterator[tuple[str, Shape]]:
        """Collision shapes of links, or simple visual shapes of those that have none."""
        for name in links:
            link = self.description.links[name]
            for shape in link.shapes or link.visuals:
                yield name, shape

    def points(self, links: Iterable[str]) -> np.ndarray:
        """Extreme points of the links' shapes in the base frame [m], ``[n, 3]``."""
        return self.placed(self.shapes(links))

    def placed(self, shapes: Iterable[tuple[str, Shape]]) -> np.ndarray:
        """Extreme points of shapes of links in the base frame [m], ``[n, 3]``."""
        found = [shape.placed(self.link(name)) for name, shape in shapes]
        return np.concatenate(found) if found else np.zeros((0, 3))

    def sides(self, links: Iterable[str]) -> dict[str, list[tuple[str, Shape]]]:
        """Shapes that lie wholly on the ``left`` and on the ``right`` of the centre line, if there are both."""
        found: dict[str, list[tuple[str, Shape]]] = {"left": [], "right": []}
        for name, shape in self.shapes(links):
            across = shape.placed(self.link(name))[:, 1]
            if across.min() > 0 or across.max() < 0:
                found["left" if across.min() > 0 else "right"].append((name, shape))
        return found if found["left"] and found["right"] else {}


@dataclass(frozen=True)
class WheelShape:
    """A wheel in the base frame [m]."""

    centre: np.ndarray
    radius: float
    width: float
    source: str
    """The shape that it was taken from."""


def wheel_shape(frames: Frames, joint: Joint) -> WheelShape | None:
    """The wheel that turns with a joint; None if nothing with a shape does.

    Raises ``UrdfError`` if a cylinder's axis is not the joint's.
    """
    axis, origin = frames.axis(joint), frames.origin(joint)
    links = list(frames.description.subtree(joint.child, ("fixed",)))
    reach, low, high, kinds = 0.0, np.inf, -np.inf, []
    for name, shape in frames.shapes(links):
        pose = frames.link(name) @ shape.pose
        along = float((pose[:3, 3] - origin) @ axis)
        if shape.kind == "cylinder" and abs(pose[:3, 2] @ axis) < _PARALLEL:
            raise UrdfError(
                f"{frames.description.path}: link {name}: the cylinder lies along {_told(pose[:3, 2])} of the base "
                f"frame, but joint {joint.name} turns about {_told(axis)}; turn the shape (rpy 1.5708 0 0) or "
                "correct the axis"
            )
        if shape.kind == "sphere":
            half = _SPHERE_WIDTH * shape.radius / 2
            edge, extent = shape.radius, (along - half, along + half)
        else:
            offsets = shape.placed(frames.link(name)) - origin
            axial = offsets @ axis
            edge = float(np.linalg.norm(offsets - axial[:, None] * axis, axis=1).max())
            extent = (float(axial.min()), float(axial.max()))
        reach, low, high = max(reach, edge), min(low, extent[0]), max(high, extent[1])
        kinds.append(shape.kind)
    if not kinds:
        return None
    return WheelShape(origin + axis * (low + high) / 2, reach, high - low, " and ".join(sorted(set(kinds))))


@dataclass(frozen=True)
class BeltShape:
    """A track or a flipper's belt in the base frame [m]: two circles and the width of the belt around them."""

    rear: np.ndarray
    front: np.ndarray
    rear_radius: float
    front_radius: float
    width: float
    source: str


def belt_shape(frames: Frames, shapes: Iterable[tuple[str, Shape]]) -> BeltShape | None:
    """The belt around shapes of links: around their outermost lateral cylinders, else around all their bounds."""
    shapes = list(shapes)
    points = frames.placed(shapes)
    if not len(points):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    y, width = float(low[1] + high[1]) / 2, float(high[1] - low[1])
    circles = []
    for name, shape in shapes:
        pose = frames.link(name) @ shape.pose
        if shape.kind == "cylinder" and abs(pose[1, 2]) > _PARALLEL:
            circles.append((pose[:3, 3], shape.radius))
    circles.sort(key=lambda circle: circle[0][0])
    if len(circles) >= 2:
        (rear, rear_radius), (front, front_radius) = circles[0], circles[-1]
        source = "the outermost cylinders"
    else:
        radius = float(high[2] - low[2]) / 2
        middle = float(high[2] + low[2]) / 2
        rear, front = np.array([low[0] + radius, y, middle]), np.array([high[0] - radius, y, middle])
        rear_radius = front_radius = radius
        source = "the bounds of its shapes"
    if front[0] - rear[0] < 0.01:
        return None
    rear, front = np.array([rear[0], y, rear[2]]), np.array([front[0], y, front[2]])
    return BeltShape(rear, front, float(rear_radius), float(front_radius), width, source)


def flipper_shape(frames: Frames, shapes: Iterable[tuple[str, Shape]], axle: np.ndarray) -> BeltShape | None:
    """The belt around a flipper's shapes, from its axle (``rear``) to its tip (``front``), at any angle.

    Around the lateral cylinders nearest to the axle and farthest from it, else along the middle of all shapes.

    Args:
        frames: poses.
        shapes: the flipper's shapes, with the links that carry them.
        axle: a point of its axis in the base frame [m], ``[3]``.
    """
    shapes = list(shapes)
    points = frames.placed(shapes)
    if not len(points):
        return None
    y, width = float(points[:, 1].min() + points[:, 1].max()) / 2, float(np.ptp(points[:, 1]))
    flat = np.array([1.0, 0.0, 1.0])
    circles = []
    for name, shape in shapes:
        pose = frames.link(name) @ shape.pose
        if shape.kind == "cylinder" and abs(pose[1, 2]) > _PARALLEL:
            circles.append((float(np.linalg.norm((pose[:3, 3] - axle) * flat)), pose[:3, 3], shape.radius))
    circles.sort(key=lambda circle: circle[0])
    root = axle * flat + [0.0, y, 0.0]
    if len(circles) >= 2:
        tip, tip_radius, root_radius = circles[-1][1] * flat + [0.0, y, 0.0], circles[-1][2], circles[0][2]
        source = "the cylinders at the axle and at the tip"
    else:
        offsets = (points - axle)[:, [0, 2]]
        direction = offsets.mean(axis=0)
        if np.linalg.norm(direction) < 1e-3:
            return None
        direction = direction / np.linalg.norm(direction)
        if all(shape.kind == "box" for _, shape in shapes):
            direction = _along_box(frames, shapes, direction)
        across = offsets @ [-direction[1], direction[0]]
        # The belt is as high as the shapes; its tip lies in their middle, its root at the axle.
        radius, middle = float(np.ptp(across)) / 2, float(across.max() + across.min()) / 2
        along = float((offsets @ direction).max()) - radius
        reach = along * direction + middle * np.array([-direction[1], direction[0]])
        tip = root + np.array([reach[0], 0.0, reach[1]])
        tip_radius = root_radius = radius
        source = "the bounds of its shapes"
    if np.linalg.norm(tip - root) < max(0.01, abs(tip_radius - root_radius)):
        return None
    return BeltShape(root, tip, float(root_radius), float(tip_radius), width, source)


def _along_box(frames: Frames, shapes: Iterable[tuple[str, Shape]], towards: np.ndarray) -> np.ndarray:
    """The edge of the largest box that lies nearest to a direction, in the plane of x and z, ``[2]``."""
    name, shape = max(shapes, key=lambda entry: float(np.prod(np.ptp(entry[1].points, axis=0))))
    edges = (frames.link(name) @ shape.pose)[[0, 2], :3].T
    edge = max(edges, key=lambda candidate: float(abs(candidate @ towards)))
    length = float(np.linalg.norm(edge))
    return edge / length * np.sign(edge @ towards) if length > _PARALLEL else towards


def _told(direction: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.2g}" for value in np.round(direction, 2) + 0.0) + ")"
