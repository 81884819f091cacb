"""Camera choice: which image topics of a recording can be used, one of each camera, and the times of their images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from monoforce_ros.bags.recording import Frame, Recording
from monoforce_ros.bags.topic_choice import camera_info_topics
from monoforce_ros.core import nearest_stamp

if TYPE_CHECKING:
    # Players of bags start without physics.
    from monoforce_ros.robots import RobotModel


_IMAGE_NAME = re.compile(r"image(_raw|_color|_mono|_rect|_rect_color|_rect_raw)?")
"""Names of image_transport, image_proc and realsense2_camera."""


@dataclass(frozen=True)
class CameraChoice:
    """Image topics to use, and why others are not."""

    topics: tuple[str, ...]
    """The one with the most images first."""
    left_out: dict[str, str]
    """Reason by topic."""

    @property
    def remarks(self) -> list[str]:
        """What is left out, in sentences."""
        return [f"{topic} is left out: {reason}" for topic, reason in self.left_out.items()]


def chosen_cameras(recording: Recording, robot: RobotModel, topics: Sequence[str] = ()) -> CameraChoice:
    """Topics whose images can be used: with a CameraInfo of their size, a pose on the robot, and images to decode.

    Topics that share a CameraInfo are of one camera (raw, compressed, rectified); the one with the most images is used.

    Args:
        recording: the recording.
        robot: its file may know the poses of the cameras.
        topics: to choose from; by default all.
    """
    reasons: dict[str, str] = {}
    usable: list[str] = []
    for topic in topics or recording.images:
        reason = _fault(recording, robot, topic)
        if reason:
            reasons[topic] = reason
        else:
            usable.append(topic)
    kept: dict[str, str] = {}
    for topic in sorted(usable, key=lambda topic: _rank(recording, topic)):
        same = kept.setdefault(recording.info_topics[topic], topic)
        if same != topic:
            reasons[topic] = f"of the same camera as {same}, by its CameraInfo"
    chosen = [topic for topic in usable if topic in kept.values()]
    return CameraChoice(tuple(sorted(chosen, key=lambda topic: -len(recording.images[topic]))), reasons)


def image_frames(recording: Recording, topics: Sequence[str], limit: float) -> list[Frame]:
    """Images at whose times a camera sees something, in the order of their stamps.

    Those of the first topic, and of the others where the first one has none within ``limit`` [s]: it may have begun
    late or died early.
    """
    frames: list[Frame] = []
    for topic in topics:
        known = np.sort(np.array([frame.stamp for frame in frames], np.int64))
        frames += [f for f in recording.images[topic] if nearest_stamp(known, f.stamp, limit=limit) is None]
    return sorted(frames, key=lambda frame: frame.stamp)


def _rank(recording: Recording, topic: str) -> tuple[bool, int, bool]:
    """Order of the topics of one camera: those named as images, with the most of them, before compression.

    What is drawn into images, such as detections, is published under other names.
    """
    name = topic.removesuffix("/compressed").rpartition("/")[2]
    return _IMAGE_NAME.fullmatch(name) is None, -len(recording.images[topic]), topic.endswith("/compressed")


def _fault(recording: Recording, robot: RobotModel, topic: str) -> str:
    """Why the images of a topic cannot be used; empty if they can."""
    frames = recording.images.get(topic, ())
    if not frames:
        return "no image"
    if topic not in recording.cameras:
        return f"no usable CameraInfo on {' or '.join(camera_info_topics(topic))}"
    camera = recording.cameras[topic]
    first = ""
    # A single damaged image says nothing of the others.
    for frame in dict.fromkeys((frames[0], frames[len(frames) // 2], frames[-1])):
        try:
            recording.sensor_pose(camera.frame_id, robot.base_frame, robot.sensors, frame.stamp)
            camera.check_image(recording.image(frame))
        except ValueError as error:
            first = first or str(error)
        else:
            return ""
    return first
