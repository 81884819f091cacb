"""SensorDecoder: undecoded sensor messages → an Observation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from monoforce_ros.core import NANOSECOND, CameraModel, MotionTrack, RobotFrames, TransformHistory, transform_points
from monoforce_ros.messages import MessageError, decoding
from monoforce_ros.nodes.health import ERROR, OK, Health
from monoforce_ros.nodes.inputs import Received
from monoforce_ros.perception import Observation

LIDAR = "lidar"
"""Part of the diagnostics for the point clouds; every other sensor is a camera."""
_LATEST = 1.0
"""Time by which a sensor's data may be older than the newest odometry when they arrive [s]: slow drivers and encoders
of images take some tenths of it. What is older starts the prediction where the robot no longer is."""
_AGE = "age relative to the newest sensor [s]"


class SensorDecoder:
    """Decodes the sensor messages of a prediction with their calibrations and poses.

    Args:
        frames: poses of the sensors on the robot.
        transforms: transforms received so far; a sensor may move on the robot, as one on a pan-tilt head.
        health: receives reports on unusable messages.
    """

    def __init__(self, frames: RobotFrames, transforms: TransformHistory, health: Health):
        self._frames, self._transforms, self._health = frames, transforms, health
        self._info_topics: dict[str, str] = {}
        self._rectified: set[str] = set()
        self._cameras: dict[str, CameraModel | MessageError] = {}

    def add_camera(self, part: str, info_topic: str, *, rectified: bool = False) -> None:
        """Name the CameraInfo topic of a camera, for error messages, and say whether its images are rectified."""
        self._info_topics[part] = info_topic
        if rectified:
            self._rectified.add(part)

    def set_camera_info(self, part: str, message: CameraInfo) -> None:
        """Use a calibration from now on."""
        try:
            self._cameras[part] = decoding.decode_camera_info(message, rectified=part in self._rectified)
        except MessageError as error:
            # Reported with the next image, which cannot be used.
            self._cameras[part] = error

    def observe(
        self, stamp: int, received: Mapping[str, Received], track: MotionTrack, *, maximum_gap: float
    ) -> Observation | None:
        """Decode sensor messages, report errors per input, and return None if no usable data remain.

        Data from before ``stamp`` are transformed to the robot's pose at ``stamp``.

        Args:
            stamp: time of the observation [ns].
            received: messages by input; ``odometry`` means an observation without sensors.
            track: measured motion.
            maximum_gap: largest time difference to measured motion [s].
        """
        cloud: np.ndarray | None = None
        images: dict[str, np.ndarray] = {}
        cameras: dict[str, CameraModel] = {}
        poses: dict[str, np.ndarray] = {}
        for part, entry in received.items():
            if part == "odometry":
                continue
            try:
                if entry.behind > _LATEST:
                    raise MessageError(
                        f"stamped {entry.behind:.1f} s before the odometry that has arrived, expected at most "
                        f"{_LATEST:g} s: another clock? Synchronise it (PTP, chrony)"
                    )
                pose = self._sensor_pose(entry, track, maximum_gap)
                pose = track.base_between(entry.stamp, stamp, maximum_gap=maximum_gap) @ pose
                if part == LIDAR:
                    cloud = transform_points(pose, decoding.decode_cloud(entry.message))
                else:
                    images[part], cameras[part] = self._image(part, entry.message)
                    poses[part] = pose
            except ValueError as error:
                self._health.report(part, ERROR, str(error), reason=str(error)[:40])
                continue
            kind = "point clouds" if part == LIDAR else "images"
            age = (stamp - entry.stamp) * NANOSECOND
            self._health.report(part, OK, f"receiving {kind}", **{_AGE: f"{age:.3f}"})
        if not received.keys() <= {"odometry"} and cloud is None and not images:
            return None
        return Observation(stamp, cloud, images, cameras, poses, track=track)

    def _sensor_pose(self, entry: Received, track: MotionTrack, maximum_gap: float) -> np.ndarray:
        def odometry_from_base() -> np.ndarray:
            return track.at(entry.stamp, maximum_gap=maximum_gap).odometry_from_base

        return self._frames.sensor_pose(
            entry.message.header.frame_id,
            # An image may arrive before the transforms of its time: the newest ones are used then.
            self._transforms.at(entry.stamp, hold=True),
            odometry_frame=track.frame_id or "odom",
            odometry_from_base=odometry_from_base,
        )

    def _image(self, part: str, message: Image | CompressedImage) -> tuple[np.ndarray, CameraModel]:
        camera = self._cameras.get(part)
        if isinstance(camera, MessageError):
            raise camera
        if camera is None:
            raise MessageError(
                f"no usable CameraInfo on {self._info_topics[part]}, which the camera needs; set its topic in "
                "`camera_info_topics`"
            )
        image = decoding.decode_image(message)
        camera.check_image(image)
        return image, camera
