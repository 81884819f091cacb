"""Sensor check: whether a recording's clouds and images can be used, each fault in one sentence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from monoforce_ros.bags import BagError, Frame, Recording, camera_info_topics, chosen_cameras
from monoforce_ros.core import NANOSECOND, MotionTrack
from monoforce_ros.evaluation.findings import Finding, note, ok, warning
from monoforce_ros.robots import RobotModel

_FARTHEST = 300.0
"""Range of lidars for robots and cars [m]."""
_FEWEST_USABLE = 0.5
"""Share of the frames within the odometry below which a sensor cannot be used."""
_STEEPEST = 0.7
"""Vertical component of an optical axis from which on a camera looks at the sky: 45° above the horizon."""


def cloud_findings(recording: Recording, robot: RobotModel) -> Iterator[Finding]:
    """Findings about the lidar's clouds."""
    if not recording.clouds:
        return
    topic = recording.topics["cloud"]
    try:
        points, frame = recording.cloud(recording.clouds[0])
    except ValueError as error:
        yield warning(f"{topic}: the first cloud cannot be used: {error}")
        return
    distance = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 0.0
    if distance > _FARTHEST:
        yield warning(
            f"{topic}: half of the points of the first cloud are {distance:.0f} m away or more, "
            "farther than a lidar sees: are they in millimetres?"
        )
    if apart := _apart(recording.clouds, recording.motion):
        yield warning(f"{topic}: {apart}")
        return
    try:
        recording.sensor_pose(frame, robot.base_frame, robot.sensors, recording.clouds[0].stamp)
        yield ok(f"clouds {topic}: {len(recording.clouds)}, frame {frame}")
    except BagError as error:
        yield warning(f"clouds cannot be used: {error}")
    if not len(points):
        yield warning(f"{topic}: the first cloud is empty")


def image_findings(recording: Recording, robot: RobotModel) -> Iterator[Finding]:
    """Findings about the cameras' images."""
    left_out = chosen_cameras(recording, robot).left_out
    for topic, frames in recording.images.items():
        if topic not in recording.cameras:
            expected = " or ".join(camera_info_topics(topic))
            yield warning(f"{topic}: no CameraInfo on {expected}; images cannot be used without it")
            continue
        camera = recording.cameras[topic]
        if not frames:
            continue
        try:
            pose = recording.sensor_pose(camera.frame_id, robot.base_frame, robot.sensors, frames[0].stamp)
        except BagError as error:
            yield warning(f"{topic}: {error}")
            continue
        try:
            camera.check_image(recording.image(frames[0]))
        except ValueError as error:
            yield warning(f"{topic}: the images cannot be used: {error}")
            continue
        if topic in left_out:
            yield note(f"{topic}: {left_out[topic]}")
            continue
        if apart := _apart(frames, recording.motion):
            yield warning(f"{topic}: {apart}")
            continue
        if pose[2, 2] > _STEEPEST:
            yield warning(
                f"{topic}: its frame {camera.frame_id} looks up at the sky: images are in an optical frame, z ahead "
                "and y down (REP 103), and this one looks like a body frame, x ahead; stamp them with the camera's "
                "optical frame"
            )
            continue
        yield ok(f"images {topic}: {len(frames)}, {camera.width} × {camera.height}, {camera.distortion_model}")


def _apart(frames: Sequence[Frame], motion: MotionTrack) -> str:
    """How frames lie beside the odometry in time, in words; empty if most lie within it."""
    stamps = np.array([frame.stamp for frame in frames], np.int64)
    first, last = int(motion.stamps[0]), int(motion.stamps[-1])
    share = float(np.mean((stamps >= first) & (stamps <= last)))
    if share >= _FEWEST_USABLE:
        return ""
    middle = float(np.median(stamps) - 0.5 * (float(first) + float(last))) * NANOSECOND
    side = "after" if middle > 0 else "before"
    return (
        f"{share:.0%} of its messages have stamps within the odometry, the others are {abs(middle):.0f} s {side} it on "
        "average: another clock stamps them; they cannot be used. Synchronise the sensor (PTP), or let its driver "
        "stamp with ROS time"
    )
