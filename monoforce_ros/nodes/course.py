"""Course: a goal or plan, and its place in the odometry frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.core import FrameError, MotionState, PoseHistory, TransformHistory, transform_points
from monoforce_ros.nodes.frames import TransformListener

TRANSFORM_TIMEOUT = 2.0
"""Time that a goal or plan waits for its transform [s]; then it is refused."""


@dataclass(frozen=True)
class Course:
    """Where to drive: a plan, or a goal as a plan of one point."""

    kind: str
    """``goal`` or ``plan``, for messages."""
    frame_id: str
    """Empty means the odometry frame."""
    stamp: int
    """[ns]; 0 asks for the newest transform."""
    points: np.ndarray
    """``[n, 3]`` [m]; the last one is the goal."""
    received: float
    """Steady time [s]."""

    def repeats(self, other: Course | None) -> bool:
        """Whether another course has the same points of the same stamp in the same frame."""
        return (
            other is not None
            and (self.frame_id, self.stamp) == (other.frame_id, other.stamp)
            and np.array_equal(self.points, other.points)
        )


class CourseFrames:
    """Transforms courses into the odometry frame.

    A frame that moves with the robot describes a place only at one time: a course in such a frame is transformed once,
    and its result is in the odometry frame. Transformed again and again, it would keep its distance from the robot and
    never be reached. Any other frame, such as ``map``, may be corrected against the odometry: a course there stays in
    its frame, and its points are transformed at each call.

    A frame moves with the robot if the transforms connect it with the base, or with the frame that the odometry
    describes, on a path that avoids the odometry frame. Its pose is composed of that path and of the odometry itself,
    so that no transform from the odometry frame to the base is needed.
    """

    def __init__(self, transforms: TransformListener, history: TransformHistory):
        self._transforms = transforms
        self._history = history
        self._poses = PoseHistory()
        self._odometry_frame = ""
        self._latest: np.ndarray | None = None
        self._on_robot: Mapping[str, np.ndarray] = {}

    def add_odometry(self, frame_id: str, motion: MotionState, on_robot: Mapping[str, np.ndarray]) -> None:
        """Note the odometry.

        Args:
            frame_id: the odometry frame.
            motion: motion of the base.
            on_robot: poses ``[4, 4]`` in the base frame of the base and of the frame that the odometry describes.
        """
        frame_id = frame_id.lstrip("/")
        if frame_id != self._odometry_frame:
            self._poses = PoseHistory()
        self._odometry_frame = frame_id
        self._latest = motion.odometry_from_base
        self._poses.add(motion.stamp, self._latest)
        self._on_robot = {name.lstrip("/"): pose for name, pose in on_robot.items()}

    def resolved(self, course: Course, now: float) -> tuple[Course, np.ndarray]:
        """The course to keep, and its points ``[n, 3]`` [m] in the odometry frame.

        Args:
            course: a course; odometry was received.
            now: steady time [s].

        Raises:
            FrameError: there is no transform, or none of its stamp; the message names both frames and the reason.
        """
        frame, odometry = course.frame_id.lstrip("/"), self._odometry_frame
        if frame in ("", odometry):
            return course, course.points
        try:
            pose = self._moving_pose(course, frame, now)
            if pose is not None:
                points = transform_points(pose, course.points)
                return replace(course, frame_id=odometry, stamp=0, points=points), points
            pose = self._transforms.tree.find(odometry, frame)
            if pose is None:
                raise FrameError(self._transforms.unavailable or self._transforms.tree.missing_path(odometry, frame))
        except FrameError as error:
            message = f"the {course.kind} is in frame {frame!r}, odometry in {odometry!r}: {error}"
            raise FrameError(message) from None
        return course, transform_points(pose, course.points)

    def _moving_pose(self, course: Course, frame: str, now: float) -> np.ndarray | None:
        """Pose ``[4, 4]`` in the odometry frame of a frame that moves with the robot; None if it does not."""
        tree, odometry = self._transforms.tree, self._odometry_frame
        near = [name for name in self._on_robot if tree.find(name, frame, without=odometry) is not None]
        # Without any transform of the robot's own frames, what the odometry frame carries may be the robot.
        carried = not near and not set(self._on_robot) & tree.frames and tree.descends(frame, odometry)
        if not near and not carried:
            return None
        if not course.stamp:
            if now - course.received > TRANSFORM_TIMEOUT:
                raise FrameError(f"{frame!r} moves with the robot, and the {course.kind} without a stamp is too old")
            odometry_from_base = self._latest
        else:
            tree, odometry_from_base = self._history.at(course.stamp), self._poses.at(course.stamp)
        what = f"at the {course.kind}'s stamp"
        if carried:
            pose = tree.find(odometry, frame)
        elif odometry_from_base is None:
            raise FrameError(f"{what} there is no odometry: {self._poses.gap_text(course.stamp)}")
        else:
            base_from_frame = tree.find(near[0], frame, without=odometry)
            pose = None if base_from_frame is None else odometry_from_base @ self._on_robot[near[0]] @ base_from_frame
        if pose is None:
            raise FrameError(f"{what} there is no transform between {(near or [odometry])[0]!r} and {frame!r}")
        return pose
