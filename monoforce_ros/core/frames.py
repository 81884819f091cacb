"""Frames: transforms between named frames, and where a robot's sensors and its odometry are on it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

_SAME_PLACE = 1e-3
"""Largest difference of two poses of the same place [m, -]: transforms are rounded."""


class FrameError(ValueError):
    """Two frames are not connected; the message names both and where the path between them breaks."""


class TransformTree:
    """Transforms between named frames, as on /tf; a recording may even give a frame several parents.

    Leading slashes of names are ignored, as in tf2. :meth:`find` may run while another thread adds transforms.
    """

    def __init__(self, transforms: Mapping[tuple[str, str], np.ndarray] | None = None):
        # Neighbours of each frame; the matrix is the pose of the child in the parent, and the flag tells whether the
        # neighbour is the child.
        self._neighbours: dict[str, dict[str, tuple[np.ndarray, bool]]] = {}
        for (parent, child), matrix in (transforms or {}).items():
            self.add(parent, child, matrix)

    def add(self, parent: str, child: str, matrix: np.ndarray) -> None:
        """Set the pose ``[4, 4]`` of a child in its parent's frame; replaces an earlier one."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        self._neighbours.setdefault(parent, {})[child] = matrix, True
        self._neighbours.setdefault(child, {})[parent] = matrix, False

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return set(self._neighbours)

    def find(self, target: str, source: str, *, without: str = "") -> np.ndarray | None:
        """Pose ``[4, 4]`` of ``source`` in ``target``; None if they are not connected, or only through ``without``."""
        target, source, without = (name.lstrip("/") for name in (target, source, without))
        return self._reached(target, source, without).get(source)

    def path(self, target: str, source: str) -> list[tuple[str, str]]:
        """The transforms, as (parent, child), that :meth:`find` composes; empty if there are none."""
        target, source = target.lstrip("/"), source.lstrip("/")
        found = self._searched(target, source)
        edges = []
        while source != target and source in found:
            before, _, downwards = found[source]
            edges.append((before, source) if downwards else (source, before))
            source = before
        return edges[::-1]

    def descends(self, frame: str, ancestor: str) -> bool:
        """Whether a frame is a child of another one, or a child of its children."""
        known, frontier = {ancestor.lstrip("/")}, [ancestor.lstrip("/")]
        while frontier:
            neighbours = list(self._neighbours.get(frontier.pop(), {}).items())
            children = {name for name, (_, downwards) in neighbours if downwards} - known
            known |= children
            frontier += children
        return frame.lstrip("/") in known - {ancestor.lstrip("/")}

    def missing_path(self, target: str, source: str) -> str:
        """Why :meth:`find` returns None, in words."""
        target, source = target.lstrip("/"), source.lstrip("/")
        unknown = [repr(frame) for frame in (target, source) if frame not in self.frames]
        if unknown:
            known = ", ".join(sorted(self.frames)) or "none"
            return f"no transform has {' or '.join(unknown)} (frames there: {known})"
        near_target, near_source = (", ".join(sorted(set(self._reached(f)) - {f})) for f in (target, source))
        return (
            f"{target!r} is connected with {near_target}, and {source!r} with {near_source}: a transform between these "
            "is missing"
        )

    def _reached(self, start: str, end: str = "", without: str = "") -> dict[str, np.ndarray]:
        """Pose in ``start`` of every frame connected with it, not through ``without``; ends early at ``end``."""
        reached = {start: np.eye(4)}
        for frame, (before, matrix, downwards) in self._searched(start, end, without).items():
            reached[frame] = reached[before] @ (matrix if downwards else np.linalg.inv(matrix))
        return reached

    def _searched(self, start: str, end: str, without: str = "") -> dict[str, tuple[str, np.ndarray, bool]]:
        """Frames in the order in which they are reached, each with its neighbour towards ``start`` (see above)."""
        found: dict[str, tuple[str, np.ndarray, bool]] = {}
        frontier = [start]
        while frontier and end != start and end not in found:
            following = []
            for frame in frontier:
                # Copied at once: another thread may add a frame.
                for neighbour, (matrix, downwards) in list(self._neighbours.get(frame, {}).items()):
                    if neighbour not in found and neighbour not in (start, without):
                        found[neighbour] = frame, matrix, downwards
                        following.append(neighbour)
            frontier = following
        return found


@dataclass(frozen=True)
class RobotFrames:
    """Poses on a robot in its base frame: from transforms, else from its file.

    Names may have a prefix per robot (``robot1/base_link``): names without one are also looked for with the prefix of
    the frame that is asked for.
    """

    base_frame: str
    """The frame that the lengths in the robot's file refer to."""
    sensors: Mapping[str, Any] = field(default_factory=dict)
    """Poses ``[4, 4]`` of sensors by frame, from the robot's file."""
    odometry_child_pose: np.ndarray | None = None
    """Pose ``[4, 4]`` of the odometry's child frame, if it is given instead of looked up."""
    file_frame: str = ""
    """The robot file's own name of the base frame, if ``base_frame`` replaces it."""

    def base_name(self, frame: str, known: Iterable[str]) -> str:
        """The base frame's name beside a frame: with that frame's prefix, unless only the bare name is known."""
        bare, prefixed = self.base_frame.lstrip("/"), _prefixed(self.base_frame, frame)
        frames = {*known, frame.lstrip("/")}
        return prefixed if prefixed in frames or bare not in frames else bare

    def sensor_pose(
        self,
        frame: str,
        transforms: TransformTree,
        *,
        odometry_frame: str = "",
        odometry_from_base: Callable[[], np.ndarray] | None = None,
    ) -> np.ndarray:
        """Pose ``[4, 4]`` of the frame of sensor data in the base frame.

        Lidar odometry publishes its clouds in the odometry frame. Where the robot was at the stamp of the data is then
        known from the odometry itself; the newest transform would be that of another time.

        Args:
            frame: the frame.
            transforms: transforms between frames.
            odometry_frame: frame of the odometry, in which data may be, too; empty if they may not.
            odometry_from_base: returns the pose ``[4, 4]`` of the base in it at the stamp of the data; called if it is
                needed.

        Raises:
            FrameError: the name is empty, or neither the transforms nor the robot's file have it.
        """
        frame = frame.lstrip("/")
        if not frame:
            raise FrameError(
                "the message does not say which sensor it is from (header.frame_id is empty): set the driver's frame "
                f"parameter (frames in the robot file: {sorted(self.sensors)})"
            )
        base, odometry_frame = self.base_name(frame, transforms.frames), odometry_frame.lstrip("/")
        pose = transforms.find(base, frame, without=odometry_frame) if frame != odometry_frame else None
        if pose is not None:
            return pose
        if odometry_frame and odometry_from_base is not None:
            pose = np.eye(4) if frame == odometry_frame else transforms.find(odometry_frame, frame, without=base)
            if pose is not None:
                return np.linalg.inv(odometry_from_base()) @ pose
        for name in (frame, frame.rpartition("/")[2]):
            if name in self.sensors:
                return np.asarray(self.sensors[name], np.float64)
        raise FrameError(
            f"the pose of frame {frame!r} on the robot is unknown: add it to the robot file under `sensors` (frames "
            f"there: {sorted(self.sensors)}), or publish the path from {base!r} to {frame!r} on /tf_static: "
            f"{transforms.missing_path(base, frame)}"
        )

    def odometry_child(self, frame: str, transforms: TransformTree) -> np.ndarray:
        """Pose ``[4, 4]`` of the odometry's child frame in the base frame. An empty name means the base frame.

        Raises:
            FrameError: it is another frame, and neither given nor connected with the base frame; or the base frame is
                elsewhere than the one of the robot file.
        """
        frame = frame.lstrip("/")
        self._refuse_another_place(frame, transforms)
        if self.odometry_child_pose is not None:
            return self.odometry_child_pose
        base = self.base_name(frame, transforms.frames)
        if frame in ("", base):
            return np.eye(4)
        pose = transforms.find(base, frame)
        if pose is None:
            raise FrameError(
                f"odometry describes the frame {frame!r}, lengths in the robot file refer to {base!r}, and the offset "
                f"between them is unknown: {transforms.missing_path(base, frame)}. Publish it on /tf_static, give it "
                "as `odometry_child_pose` (--odometry-child-pose X Y Z ROLL PITCH YAW). Only if both are the same "
                "place on the robot: give its name here as `base_frame` (--base-frame)"
            )
        return pose

    def _refuse_another_place(self, frame: str, transforms: TransformTree) -> None:
        if not self.file_frame or self.file_frame == self.base_frame:
            return
        own = replace(self, base_frame=self.file_frame).base_name(frame, transforms.frames)
        base = self.base_name(frame, transforms.frames)
        offset = transforms.find(base, own)
        if offset is not None and not np.allclose(offset, np.eye(4), atol=_SAME_PLACE):
            raise FrameError(
                f"base_frame (--base-frame): got {base!r}, expected {own!r}, to which lengths in the robot file refer: "
                f"transforms put it {np.linalg.norm(offset[:3, 3]):.3f} m away. Leave base_frame out: the offset of "
                "the odometry's frame is then looked up. If the lengths do refer to the other frame, name it in the "
                "robot file as `base_frame`"
            )


def _prefixed(name: str, like: str) -> str:
    """A name with the prefix of another one, unless it has a prefix itself."""
    name, prefix = name.lstrip("/"), like.lstrip("/").rpartition("/")[0]
    return f"{prefix}/{name}" if prefix and "/" not in name else name
