"""Recorded observation: the sensor data of a recording at one time, as terrain sources take them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from monoforce_ros.bags.reader import BagError
from monoforce_ros.bags.recording import Recording, nearest_frame
from monoforce_ros.core import transform_points
from monoforce_ros.perception import Observation
from monoforce_ros.robots import RobotModel

MAXIMUM_SPREAD = 0.1
"""Largest time between the sensor data of one observation [s]."""
MAXIMUM_GAP = 0.3
"""Largest time between sensor data, or a compared pose, and the nearest odometry [s]."""


def observe(
    recording: Recording, robot: RobotModel, stamp: int, sensors: Sequence[str], image_topics: Sequence[str] = ()
) -> Observation:
    """The data of ``sensors`` (``lidar``, ``camera``) nearest to a stamp [ns], moved to the robot's pose at that stamp.

    Images more than :data:`MAXIMUM_SPREAD` away from the stamp are left out; so are clouds used together with images,
    and images that cannot be used (depths, damaged ones, of another size than their CameraInfo) beside others that can.

    Raises:
        ValueError: none of the images can be used, and there is no cloud.
    """
    cloud, images, cameras, poses = None, {}, {}, {}
    refused: ValueError | None = None
    if "lidar" in sensors:
        frame = nearest_frame(recording.clouds, stamp, limit=MAXIMUM_SPREAD if "camera" in sensors else np.inf)
        if frame is not None:
            points, frame_id = recording.cloud(frame)
            pose = recording.sensor_pose(frame_id, robot.base_frame, robot.sensors, frame.stamp)
            cloud = transform_points(_base_motion(recording, frame.stamp, stamp) @ pose, points).astype(np.float32)
    for topic in image_topics if "camera" in sensors else ():
        frame = nearest_frame(recording.images[topic], stamp, limit=MAXIMUM_SPREAD)
        if frame is None:
            continue
        if topic not in recording.cameras:
            raise BagError(f"{recording.path}: no CameraInfo for the images on {topic}")
        camera = recording.cameras[topic]
        try:
            image = recording.image(frame)
            camera.check_image(image)
            pose = recording.sensor_pose(camera.frame_id, robot.base_frame, robot.sensors, frame.stamp)
        except ValueError as error:
            refused = refused or error
            continue
        images[topic], cameras[topic] = image, camera
        poses[topic] = _base_motion(recording, frame.stamp, stamp) @ pose
    if refused is not None and not images and cloud is None:
        raise refused
    return Observation(stamp, cloud, images, cameras, poses, flippers_at(recording, stamp), recording.motion)


def flippers_at(recording: Recording, stamp: int) -> np.ndarray | None:
    """Measured angles of the flippers ``[F]`` [rad] at a stamp [ns]; None where none were measured."""
    if recording.joints is None or not recording.joints.flippers:
        return None
    measured = recording.joints.start(np.array([stamp]))
    return None if measured is None else measured[0, -recording.joints.flippers :]


def _base_motion(recording: Recording, start: int, end: int) -> np.ndarray:
    """Pose ``[4, 4]`` of the base at ``start`` [ns] relative to the base at ``end`` [ns]."""
    return recording.motion.base_between(start, end, maximum_gap=MAXIMUM_GAP)
