"""Frames: transforms between named frames, and where a robot's sensors and its odometry are on it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


class FrameError(ValueError):
    """Two frames are not connected; the message names both and where the path between them breaks."""


class TransformTree:
    """Transforms between named frames, as on /tf: each frame has one parent.

    Leading slashes of names are ignored, as in tf2. Not thread-safe, except that :meth:`find` may run while another
    thread adds transforms.
    """

    def __init__(self, transforms: Mapping[tuple[str, str], np.ndarray] | None = None):
        self._parents: dict[str, tuple[str, np.ndarray]] = {}
        for (parent, child), matrix in (transforms or {}).items():
            self.add(parent, child, matrix)

    def add(self, parent: str, child: str, matrix: np.ndarray) -> None:
        """Set the pose ``[4, 4]`` of a child in its parent's frame; replaces an earlier one."""
        self._parents[child.lstrip("/")] = parent.lstrip("/"), matrix

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        # Copied at once: another thread may add a frame.
        parents = list(self._parents.items())
        return {child for child, _ in parents} | {parent for _, (parent, _) in parents}

    def find(self, target: str, source: str) -> np.ndarray | None:
        """Pose ``[4, 4]`` of ``source`` in ``target``; None if they are not connected."""
        up_from_target = self._path_up(target.lstrip("/"))
        up_from_source = self._path_up(source.lstrip("/"))
        common = next((frame for frame in up_from_source if frame in up_from_target), None)
        if common is None:
            return None
        return np.asarray(np.linalg.inv(up_from_target[common]) @ up_from_source[common])

    def missing_path(self, target: str, source: str) -> str:
        """Why :meth:`find` returns None, in words."""
        target, source = target.lstrip("/"), source.lstrip("/")
        unknown = [repr(frame) for frame in (target, source) if frame not in self.frames]
        if unknown:
            known = ", ".join(sorted(self.frames)) or "none"
            return f"no transform has {' or '.join(unknown)} (frames there: {known})"
        roots = [list(self._path_up(frame))[-1] for frame in (target, source)]
        return (
            f"{target!r} is below {roots[0]!r} and {source!r} below {roots[1]!r}: a transform between these trees is "
            "missing"
        )

    def _path_up(self, frame: str) -> dict[str, np.ndarray]:
        """The frame and its ancestors, each with the pose of ``frame`` in it, up to the root (or to a loop)."""
        path = {frame: np.eye(4)}
        here = frame
        while here in self._parents:
            parent, matrix = self._parents[here]
            if parent in path:
                break
            path[parent] = matrix @ path[here]
            here = parent
        return path


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

    def base_name(self, frame: str, known: Iterable[str]) -> str:
        """The base frame's name beside a frame: with that frame's prefix, unless only the bare name is known."""
        bare, prefixed = self.base_frame.lstrip("/"), _prefixed(self.base_frame, frame)
        frames = {*known, frame.lstrip("/")}
        return prefixed if prefixed in frames or bare not in frames else bare

    def sensor_pose(self, frame: str, transforms: TransformTree) -> np.ndarray:
        """Pose ``[4, 4]`` of a sensor's frame in the base frame.

        Raises:
            FrameError: neither the transforms nor the robot's file have it.
        """
        frame = frame.lstrip("/")
        base = self.base_name(frame, transforms.frames)
        pose = transforms.find(base, frame)
        if pose is not None:
            return pose
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
            FrameError: it is another frame, and neither given nor connected with the base frame.
        """
        frame = frame.lstrip("/")
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
                "as `odometry_child_pose`, or name the robot's frame in `base_frame`"
            )
        return pose


def _prefixed(name: str, like: str) -> str:
    """A name with the prefix of another one, unless it has a prefix itself."""
    name, prefix = name.lstrip("/"), like.lstrip("/").rpartition("/")[0]
    return f"{prefix}/{name}" if prefix and "/" not in name else name
