"""Sensor names: what the frames of sensors are called in robot descriptions."""

import re

LIDAR = re.compile(
    r"lidar|laser|velodyne|vlp|ouster|(^|_)os[012]?_?sensor|hesai|pandar|livox|mid_?360|robosense|hokuyo|(^|_)sick(_|$)"
    r"|(^|_)scan",
    re.IGNORECASE,
)
IMU = re.compile(r"(^|_)imu", re.IGNORECASE)
OPTICAL = re.compile(r"optical", re.IGNORECASE)
"""Frames of images: z forward, y down."""
CAMERA = re.compile(r"camera|(^|_)cam(_|$)|realsense|zed", re.IGNORECASE)


def is_lidar(frame: str) -> bool:
    """Whether a frame is called as lidars are."""
    return LIDAR.search(frame) is not None
