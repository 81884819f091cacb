"""Arrays → messages of the bag type store. Stamps are in nanoseconds, quaternions are x, y, z, w."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags.types import type_store

Message = Any
"""A message of the type store, whose classes are generated at run time."""
Vector = Sequence[float] | np.ndarray


def _make(message_type: str, /, *fields: Any, **named: Any) -> Message:
    return type_store().types[message_type](*fields, **named)


def time(stamp: int) -> Message:
    """``builtin_interfaces/Time`` of a stamp [ns]."""
    return _make("builtin_interfaces/msg/Time", sec=int(stamp // 10**9), nanosec=int(stamp % 10**9))


def header(stamp: int, frame_id: str) -> Message:
    """``std_msgs/Header``."""
    return _make("std_msgs/msg/Header", stamp=time(stamp), frame_id=frame_id)


def _vector(values: Vector) -> Message:
    return _make("geometry_msgs/msg/Vector3", *(float(value) for value in values))


def _point(values: Vector) -> Message:
    return _make("geometry_msgs/msg/Point", *(float(value) for value in values))


def _quaternion(values: Vector) -> Message:
    return _make("geometry_msgs/msg/Quaternion", *(float(value) for value in values))


def _twist(linear: Vector, angular: Vector) -> Message:
    return _make("geometry_msgs/msg/Twist", linear=_vector(linear), angular=_vector(angular))


def odometry(
    stamp: int,
    frame_id: str,
    child_frame_id: str,
    position: Vector,
    quaternion: Vector,
    linear_velocity: Vector,
    angular_velocity: Vector,
) -> Message:
    """``nav_msgs/Odometry``: pose in ``frame_id``, twist [m/s, rad/s] in ``child_frame_id``."""
    pose = _make("geometry_msgs/msg/Pose", position=_point(position), orientation=_quaternion(quaternion))
    return _make(
        "nav_msgs/msg/Odometry",
        header=header(stamp, frame_id),
        child_frame_id=child_frame_id,
        pose=_make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=_make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=_twist(linear_velocity, angular_velocity),
            covariance=np.zeros(36),
        ),
    )


def imu(stamp: int, frame_id: str, angular_velocity: Vector, linear_acceleration: Vector) -> Message:
    """``sensor_msgs/Imu`` without orientation (its first covariance is -1, as the message definition requires)."""
    unknown = np.zeros(9)
    unknown[0] = -1.0
    return _make(
        "sensor_msgs/msg/Imu",
        header=header(stamp, frame_id),
        orientation=_quaternion([0, 0, 0, 1]),
        orientation_covariance=unknown,
        angular_velocity=_vector(angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(linear_acceleration),
        linear_acceleration_covariance=np.zeros(9),
    )


def twist(linear_x: float, angular_z: float, linear_y: float = 0.0) -> Message:
    """``geometry_msgs/Twist``: forward speed [m/s], yaw rate [rad/s] and speed to the left [m/s]."""
    return _twist([linear_x, linear_y, 0], [0, 0, angular_z])


def twist_stamped(stamp: int, frame_id: str, linear_x: float, angular_z: float, linear_y: float = 0.0) -> Message:
    """``geometry_msgs/TwistStamped``: forward speed [m/s], yaw rate [rad/s] and speed to the left [m/s]."""
    content = twist(linear_x, angular_z, linear_y)
    return _make("geometry_msgs/msg/TwistStamped", header=header(stamp, frame_id), twist=content)


def ackermann_drive(stamp: int, frame_id: str, speed: float, steering_angle: float) -> Message:
    """``ackermann_msgs/AckermannDriveStamped``: forward speed [m/s] and steering angle [rad]."""
    drive = _make(
        "ackermann_msgs/msg/AckermannDrive", speed=speed, steering_angle=steering_angle, steering_angle_velocity=0.0,
        acceleration=0.0, jerk=0.0,
    )  # fmt: skip
    return _make("ackermann_msgs/msg/AckermannDriveStamped", header=header(stamp, frame_id), drive=drive)


def joint_state(
    stamp: int, names: Sequence[str], positions: Vector, velocities: Vector, efforts: Vector = ()
) -> Message:
    """``sensor_msgs/JointState`` [rad, rad/s, N m or A]."""
    return _make(
        "sensor_msgs/msg/JointState",
        header=header(stamp, ""),
        name=list(names),
        position=np.asarray(positions, np.float64),
        velocity=np.asarray(velocities, np.float64),
        effort=np.asarray(efforts, np.float64),
    )


def camera_info(
    stamp: int,
    frame_id: str,
    width: int,
    height: int,
    camera_matrix: np.ndarray,
    distortion: Vector,
    distortion_model: str = "plumb_bob",
) -> Message:
    """``sensor_msgs/CameraInfo`` of a single camera; ``camera_matrix`` is ``[3, 3]`` in pixels."""
    matrix = np.asarray(camera_matrix, np.float64).reshape(3, 3)
    projection = np.concatenate([matrix, np.zeros((3, 1))], axis=1)
    return _make(
        "sensor_msgs/msg/CameraInfo",
        header=header(stamp, frame_id),
        height=int(height),
        width=int(width),
        distortion_model=distortion_model,
        d=np.asarray(distortion, np.float64),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=projection.ravel(),
        binning_x=0,
        binning_y=0,
        roi=_make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def compressed_image(stamp: int, frame_id: str, encoding: str, data: bytes) -> Message:
    """``sensor_msgs/CompressedImage``; ``encoding`` is ``jpeg`` or ``png``."""
    return _make(
        "sensor_msgs/msg/CompressedImage",
        header=header(stamp, frame_id),
        format=encoding,
        data=np.frombuffer(data, np.uint8),
    )


def image(stamp: int, frame_id: str, pixels: np.ndarray, encoding: str = "rgb8") -> Message:
    """``sensor_msgs/Image`` of ``[height, width(, channels)]`` uint8 pixels."""
    pixels = np.ascontiguousarray(pixels, np.uint8)
    return _make(
        "sensor_msgs/msg/Image",
        header=header(stamp, frame_id),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.nbytes // pixels.shape[0],
        data=pixels.ravel(),
    )


def point_cloud(stamp: int, frame_id: str, points: np.ndarray, height: int = 1) -> Message:
    """``sensor_msgs/PointCloud2`` with float32 fields x, y, z [m] (and intensity, if ``points`` has four columns)."""
    points = np.ascontiguousarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] not in (3, 4) or points.shape[0] % height:
        raise ValueError(f"points: got shape {points.shape} in {height} rows, expected [n, 3] or [n, 4]")
    names = ["x", "y", "z", "intensity"][: points.shape[1]]
    return _make(
        "sensor_msgs/msg/PointCloud2",
        header=header(stamp, frame_id),
        height=height,
        width=points.shape[0] // height,
        fields=[
            _make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1)
            for i, name in enumerate(names)
        ],
        is_bigendian=False,
        point_step=4 * points.shape[1],
        row_step=4 * points.size // height,
        data=points.view(np.uint8).ravel(),
        is_dense=bool(np.isfinite(points).all()),
    )


def transforms(stamp: int, parent: str, children: Mapping[str, np.ndarray]) -> Message:
    """``tf2_msgs/TFMessage`` of child frames; each matrix is ``[4, 4]``, parent ← child."""
    entries = []
    for child, matrix in children.items():
        matrix = np.asarray(matrix, np.float64)
        transform = _make(
            "geometry_msgs/msg/Transform",
            translation=_vector(matrix[:3, 3]),
            rotation=_quaternion(Rotation.from_matrix(matrix[:3, :3]).as_quat()),
        )
        entries.append(
            _make(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp, parent),
                child_frame_id=child,
                transform=transform,
            )
        )
    return _make("tf2_msgs/msg/TFMessage", transforms=entries)


static_transforms = transforms
"""The message on /tf_static is that on /tf."""


def string(text: str) -> Message:
    """``std_msgs/String``."""
    return _make("std_msgs/msg/String", data=text)
