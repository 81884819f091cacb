"""ROS messages → arrays; every size and value is checked before use."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core import LARGEST_COMMAND, CameraModel, MotionState

MAXIMUM_IMAGE_PIXELS = 64_000_000
MAXIMUM_CLOUD_POINTS = 8_000_000
MAXIMUM_COMMANDS = 1000
"""In one sequence."""

_POINT_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# encoding → (dtype, channels, OpenCV's conversion to RGB). Bayer names of ROS start with the first pixels of the first
# row, those of OpenCV with the second row, which explains the different letters.
_IMAGE_ENCODINGS = {
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "mono8": ("u1", 1, cv2.COLOR_GRAY2RGB),
    "8UC1": ("u1", 1, cv2.COLOR_GRAY2RGB),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "mono16": ("u2", 1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2RGB),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
}


_SENSOR_BITS = (10, 12, 14, 16)
"""Bits of the sensors whose images are sent in 16: the fewest that hold the brightest pixel. An image that uses less
than a quarter of its range is dark, and brightened by that, as by a gain."""
_NO_DISTORTION = ("", "none", "pinhole", "perspective", "rectilinear", "undistorted", "no_distortion")
"""Names that drivers and simulators give images without distortion."""


class MessageError(ValueError):
    """A message with unusable content; the text states the value received and the value expected."""


def stamp_of(message: Any) -> int:
    """Header stamp [ns] of a message; 0 if it has no header."""
    header = getattr(message, "header", None)
    return 0 if header is None else int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def stamp_of_cdr(data: bytes) -> int:
    """Header stamp [ns] of an encoded message that begins with a header, without decoding the rest.

    Raises ``MessageError`` if the data are too short to contain one.
    """
    if len(data) < 12:
        raise MessageError(f"message: got {len(data)} bytes, expected at least the 12 of a header's stamp")
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)
    return seconds * 10**9 + nanoseconds


def decode_image(message: Any) -> np.ndarray:
    """``sensor_msgs/Image`` or ``CompressedImage`` → RGB pixels ``[height, width, 3]`` uint8.

    Raises ``MessageError`` for an empty image, an unknown encoding, or data that do not fit the stated size.
    """
    return _decode_compressed(message) if hasattr(message, "format") else _decode_raw(message)


def _decode_compressed(message: Any) -> np.ndarray:
    data = np.frombuffer(message.data, np.uint8)
    if "compressedDepth" in message.format or message.format.startswith(("16UC1", "32FC1")):
        raise MessageError(f"image format: got {message.format!r}, a depth image; expected a colour or grey image")
    content = data.tobytes()
    size = _encoded_size(content)
    if size is not None and not 1 <= size[0] * size[1] <= MAXIMUM_IMAGE_PIXELS:
        # A few bytes may claim a picture that no memory holds.
        raise MessageError(f"image size: got {size[0]} × {size[1]}, expected 1 to {MAXIMUM_IMAGE_PIXELS} pixels")
    # Some versions of OpenCV fill what is missing of a JPEG with grey. FF D9 ends it, and cannot occur in its pixels.
    cut = content[:2] == b"\xff\xd8" and content.rfind(b"\xff\xd9") < len(content) // 2
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR) if size is not None and not cut else None
    if decoded is None:
        raise MessageError(
            f"compressed image: {data.size} bytes of format {message.format!r} cannot be decoded, expected jpeg or png"
        )
    return cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)


def _encoded_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that the header of a PNG or JPEG image states; None for other data."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return width, height
    if data[:2] != b"\xff\xd8":
        return None
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF:  # padding
            place += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of a frame (ITU T.81, table B.1)
            height, width = struct.unpack(">HH", data[place + 5 : place + 9])
            return width, height
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return None


def _decode_raw(message: Any) -> np.ndarray:
    height, width, step = int(message.height), int(message.width), int(message.step)
    if height < 1 or width < 1 or height * width > MAXIMUM_IMAGE_PIXELS:
        raise MessageError(f"image size: got {width} × {height}, expected 1 to {MAXIMUM_IMAGE_PIXELS} pixels")
    if message.encoding not in _IMAGE_ENCODINGS:
        raise MessageError(f"image encoding: got {message.encoding!r}, expected one of {sorted(_IMAGE_ENCODINGS)}")
    kind, channels, conversion = _IMAGE_ENCODINGS[message.encoding]
    dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
    data = np.frombuffer(message.data, np.uint8)
    row = width * channels * dtype.itemsize
    if step < row or data.size < step * height:
        raise MessageError(
            f"image data: got {data.size} bytes with a row step of {step}, expected at least {row} bytes in each of "
            f"{height} rows of encoding {message.encoding}"
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    pixels = rows.view(dtype).reshape(height, width, channels)
    if kind == "u2":
        largest = int(pixels.max())
        bits = next(bits for bits in _SENSOR_BITS if largest < 1 << bits)
        pixels = (pixels >> (bits - 8)).astype(np.uint8)
    try:
        return pixels.copy() if conversion is None else cv2.cvtColor(pixels, conversion)
    except cv2.error as error:
        raise MessageError(
            f"image: {width} × {height} px cannot be of the encoding {message.encoding}, expected an even width"
        ) from error


def _binned(camera: CameraModel, message: Any) -> CameraModel:
    """The camera of the image that is sent: a region of the calibrated one, with pixels combined (REP 104)."""
    roi = getattr(message, "roi", None)
    if roi is not None and roi.width and roi.height:
        right, bottom = int(roi.x_offset) + int(roi.width), int(roi.y_offset) + int(roi.height)
        if right > camera.width or bottom > camera.height:
            raise ValueError(
                f"roi: got {roi.width} × {roi.height} px at ({roi.x_offset}, {roi.y_offset}), expected a part of "
                f"{camera.width} × {camera.height} px"
            )
        matrix = camera.matrix.copy()
        matrix[:2, 2] -= (int(roi.x_offset), int(roi.y_offset))
        camera = replace(camera, width=int(roi.width), height=int(roi.height), matrix=matrix)
    across, down = (max(1, int(getattr(message, name, 0))) for name in ("binning_x", "binning_y"))
    if across == down == 1:
        return camera
    return camera.resized(max(1, camera.width // across), max(1, camera.height // down))


def decode_camera_info(message: Any, *, rectified: bool = False) -> CameraModel:
    """``sensor_msgs/CameraInfo`` → CameraModel; raises ``MessageError`` if it is uncalibrated or inconsistent.

    Images that were rectified share the CameraInfo of the raw ones: their projection is P, without distortion.
    """
    model, coefficients = message.distortion_model or "plumb_bob", np.asarray(message.d, np.float64)
    if message.distortion_model.lower() in _NO_DISTORTION and not coefficients.any():
        model, coefficients = "plumb_bob", np.zeros(5)
    # Drivers write "plumb_bob" with eight coefficients; OpenCV's rational model takes them as they are.
    try:
        matrix = np.asarray(message.k, np.float64).reshape(3, 3)
        if rectified:
            model, coefficients = "plumb_bob", np.zeros(5)
            matrix = np.asarray(message.p, np.float64).reshape(3, 4)[:, :3]
            if not matrix.any():
                raise ValueError("got no projection P, which rectified images need")
        camera = CameraModel(
            width=int(message.width),
            height=int(message.height),
            matrix=matrix,
            distortion=coefficients,
            distortion_model={"fisheye": "equidistant"}.get(model, model),
            frame_id=message.header.frame_id,
        )
        camera.check()
        camera = _binned(camera, message)
    except ValueError as error:
        raise MessageError(f"CameraInfo: {error}") from error
    return camera


def decode_cloud(message: Any) -> np.ndarray:
    """``sensor_msgs/PointCloud2`` → finite returns ``[n, 3]`` float32 [m] in the sensor frame.

    Empty returns (NaN, infinity, or all zeros) are removed. Raises ``MessageError`` if fields or sizes are wrong, or if
    no return remains.
    """
    missing = [name for name in "xyz" if name not in {field.name for field in message.fields}]
    if missing:
        raise MessageError(
            f"point cloud fields: got {sorted(field.name for field in message.fields)}, expected x, y and z"
        )
    columns = decode_fields(message, tuple("xyz"))
    points = np.stack([column.astype(np.float32) for column in columns.values()], axis=1)
    with np.errstate(invalid="ignore", over="ignore"):
        kept = np.isfinite(points).all(axis=1) & (np.abs(points) < 1e4).all(axis=1) & (points != 0.0).any(axis=1)
    if not kept.any():
        raise MessageError(f"point cloud: none of its {len(points)} points is a finite return")
    return points[kept]


def decode_fields(message: Any, names: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
    """Fields of a ``sensor_msgs/PointCloud2`` by name, each ``[points]``; all of them, or only ``names``.

    Raises ``MessageError`` if sizes are wrong or a field does not contain floating-point numbers.
    """
    count = int(message.width) * int(message.height)
    if count < 1 or count > MAXIMUM_CLOUD_POINTS:
        raise MessageError(f"point cloud size: got {count} points, expected 1 to {MAXIMUM_CLOUD_POINTS}")
    point_step, row_step = int(message.point_step), int(message.row_step)
    by_name = {field.name: field for field in message.fields}
    data = np.frombuffer(message.data, np.uint8)
    width, height = int(message.width), int(message.height)
    if point_step < 1 or row_step < width * point_step or data.size < row_step * height:
        raise MessageError(
            f"point cloud data: got {data.size} bytes, point step {point_step}, row step {row_step}; "
            f"expected at least {width * point_step} bytes in each of {height} rows"
        )
    rows = data[: row_step * height].reshape(height, row_step)[:, : width * point_step]
    records = np.ascontiguousarray(rows).reshape(count, point_step)
    order = ">" if message.is_bigendian else "<"
    columns = {}
    for name in names if names is not None else by_name:
        field = by_name[name]
        kind = _POINT_DTYPES.get(int(field.datatype))
        if kind not in ("f4", "f8"):
            raise MessageError(f"point cloud field {name}: got datatype {field.datatype}, expected FLOAT32 or FLOAT64")
        dtype = np.dtype(order + kind)
        end = int(field.offset) + dtype.itemsize
        if end > point_step:
            raise MessageError(f"point cloud field {name}: ends at byte {end} of a point of {point_step} bytes")
        columns[name] = np.ascontiguousarray(records[:, int(field.offset) : end]).view(dtype)[:, 0]
    return columns


def decode_odometry(message: Any) -> tuple[MotionState, str, str]:
    """``nav_msgs/Odometry`` → state, frame, child frame; raises ``MessageError`` for NaN, an invalid quaternion,
    or velocities that no ground robot has."""
    pose, twist = message.pose.pose, message.twist.twist
    quaternion = np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w], float)
    vectors = [
        np.array([v.x, v.y, v.z], float) for v in (pose.position, twist.linear, twist.angular)
    ]  # position, linear and angular velocity
    if not all(np.isfinite(v).all() and (np.abs(v) < 1e7).all() for v in vectors):
        raise MessageError("odometry: position or velocity is not finite")
    if max(float(np.abs(v).max()) for v in vectors[1:]) > LARGEST_COMMAND:
        raise MessageError(
            f"odometry: got the velocities {vectors[1].tolist()} m/s and {vectors[2].tolist()} rad/s, expected at most "
            f"{LARGEST_COMMAND:g}"
        )
    norm = float(np.linalg.norm(quaternion))
    if not abs(norm - 1.0) < 0.05:
        raise MessageError(f"odometry: orientation has norm {norm:.3g}, expected a unit quaternion x, y, z, w")
    rotation = Rotation.from_quat(quaternion).as_matrix()
    state = MotionState(stamp_of(message), vectors[0], rotation, vectors[1], vectors[2])
    return state, message.header.frame_id, message.child_frame_id


def decode_angular_velocity(message: Any) -> tuple[np.ndarray, str]:
    """``sensor_msgs/Imu`` → angular velocity ``[3]`` [rad/s] in the frame of the IMU, and the name of that frame."""
    rate = message.angular_velocity
    values = np.array([rate.x, rate.y, rate.z], np.float64)
    if not np.isfinite(values).all():
        raise MessageError(f"imu: got angular velocity {values.tolist()}, expected finite numbers")
    return values, message.header.frame_id


_NOT_ROLLING = ("steer", "swivel", "caster", "castor", "suspension", "shock", "spring", "rocker", "bogie")
"""Parts of names of joints at a wheel that do not drive it."""
_ROLLING = ("wheel", "track", "tyre", "tire")
_ABBREVIATED = re.compile(r"[fbrm]?[lr]|[lr][fbrm]")
"""Sides as words of a name: l, r, or with front, back, rear or middle: fl, rl, lf, lr (left rear)."""


def wheel_side(name: str) -> str | None:
    """``left`` or ``right`` for the name of a wheel's or track's joint, None for others.

    Sides are written out (``front_left_wheel_joint``, ``wheelLeft``) or short, as a word of their own (``fl_wheel``,
    ``wheel_r``); joints that steer, swivel or spring are no wheels.
    """
    lowered = name.lower()
    if not any(word in lowered for word in _ROLLING) or any(word in lowered for word in _NOT_ROLLING):
        return None
    written = [side for side in ("left", "right") if side in lowered]
    if written:
        return written[0] if len(written) == 1 else None
    words = re.split(r"[^a-z]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower())
    short = {_side_of_word(word) for word in words if _ABBREVIATED.fullmatch(word)}
    return short.pop() if len(short) == 1 else None


def _side_of_word(word: str) -> str:
    """A word with l is on the left: in ``rl`` and ``lr`` the other letter is rear."""
    return "left" if "l" in word else "right"


def decode_wheels(message: Any) -> dict[str, tuple[float, float]]:
    """``sensor_msgs/JointState`` → angle [rad] and rate [rad/s] of each wheel, see :func:`wheel_side`.

    NaN where the message has no finite value.
    """
    angles, rates = (np.asarray(values, np.float64) for values in (message.position, message.velocity))

    def value(values: np.ndarray, index: int) -> float:
        return float(values[index]) if index < len(values) and np.isfinite(values[index]) else math.nan

    return {
        str(name): (value(angles, index), value(rates, index))
        for index, name in enumerate(message.name)
        if wheel_side(str(name))
    }


def decode_efforts(message: Any) -> dict[str, float]:
    """``sensor_msgs/JointState`` → effort of each wheel, see :func:`wheel_side`; those without a finite one are left
    out. Many drivers publish the motor's current [A] rather than a torque [N m]."""
    efforts = np.asarray(message.effort, np.float64)
    return {
        str(name): float(efforts[index])
        for index, name in enumerate(message.name)
        if wheel_side(str(name)) and index < len(efforts) and np.isfinite(efforts[index])
    }


def decode_joints(message: Any, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """``sensor_msgs/JointState`` → angles [rad] and rates [rad/s] of the named joints, each ``[J]``, in their order.

    Other joints are ignored. What the message does not contain is NaN: joints that it does not name, and rates or
    angles of a message without velocities or positions.

    Joints without a velocity interface have rates of NaN (joint_state_broadcaster).

    Raises ``MessageError`` if no joint is known, a list has another length than the names, an angle is not finite or
    beyond two turns, or a rate is infinite.
    """
    index = {str(name): place for place, name in enumerate(message.name)}
    known = [name for name in names if name in index]
    if not known:
        raise MessageError(f"joint states: got the joints {sorted(index)}, expected some of {sorted(names)}")
    found = []
    for label, given in (("position", message.position), ("velocity", message.velocity)):
        values = np.asarray(given, np.float64)
        if len(values) not in (0, len(message.name)):
            raise MessageError(f"joint states: got {len(values)} values of {label} for {len(message.name)} names")
        listed = np.array([values[index[name]] if name in index and len(values) else np.nan for name in names])
        usable = np.isfinite(values) if label == "position" else ~np.isinf(values)
        bad = [name for name in known if len(values) and not usable[index[name]]]
        if bad:
            raise MessageError(f"joint states: got no finite {label} of {bad}, expected finite numbers")
        if label == "position" and (far := [name for name in known if len(values) and _is_far(values[index[name]])]):
            got = ", ".join(f"{values[index[name]]:g}" for name in far)
            raise MessageError(
                f"joint states: got {got} for {far}, expected angles within two turns: are they degrees?"
            )
        found.append(listed)
    return found[0], found[1]


def _is_far(angle: float) -> bool:
    """Whether an angle [rad] is none of a joint that steers, swivels or lifts: more than two turns."""
    return abs(angle) > 4.0 * np.pi


def decode_ackermann(message: Any, wheelbase: float) -> np.ndarray:
    """``ackermann_msgs/AckermannDriveStamped`` → forward speed [m/s] and yaw rate [rad/s], ``[2]``.

    The yaw rate is that of the bicycle model with ``wheelbase`` [m]; at standstill a steering angle is lost.
    """
    drive = getattr(message, "drive", message)
    speed, angle = float(drive.speed), float(drive.steering_angle)
    if not (np.isfinite(speed) and np.isfinite(angle)) or abs(angle) >= 0.5 * np.pi:
        raise MessageError(
            f"command: got speed {speed}, steering angle {angle}; expected finite numbers, the angle within ±π/2"
        )
    return np.array([speed, speed * np.tan(angle) / wheelbase])


def decode_command(message: Any, *, lateral: bool = False) -> np.ndarray:
    """``geometry_msgs/Twist`` or ``TwistStamped`` → forward speed [m/s] and yaw rate [rad/s], ``[2]``.

    With ``lateral``, for robots that move sideways, the speed to the left [m/s] follows, ``[3]``.
    """
    twist = getattr(message, "twist", message)
    command = np.array([twist.linear.x, twist.angular.z, *([twist.linear.y] if lateral else [])], float)
    if not np.isfinite(command).all():
        sideways = f", lateral speed {command[2]}" if lateral else ""
        raise MessageError(
            f"command: got forward speed {command[0]}, yaw rate {command[1]}{sideways}; expected finite numbers"
        )
    if np.abs(command).max() > LARGEST_COMMAND:
        raise MessageError(f"command: got {command.tolist()}, expected at most {LARGEST_COMMAND:g} m/s and rad/s")
    return command


def decode_command_sequences(message: Any, maximum: int) -> np.ndarray:
    """``std_msgs/Float32MultiArray`` with dimensions sequences, commands and 2 → forward speeds [m/s] and yaw rates
    [rad/s] ``[N, K, 2]``.

    Raises:
        MessageError: other dimensions, values that are not finite or above :data:`LARGEST_COMMAND`, or more than
            ``maximum`` sequences.
    """
    sizes = tuple(int(dimension.size) for dimension in message.layout.dim)
    if len(sizes) != 3 or sizes[2] != 2 or sizes[0] < 1 or not 1 <= sizes[1] <= MAXIMUM_COMMANDS:
        raise MessageError(
            f"command sequences: got dimensions {list(sizes)}, expected [sequences, commands in each (1 to "
            f"{MAXIMUM_COMMANDS}), 2 (forward speed, yaw rate)]"
        )
    if sizes[0] > maximum:
        raise MessageError(f"command sequences: got {sizes[0]}, expected at most {maximum}")
    values, offset = np.asarray(message.data, np.float32), int(message.layout.data_offset)
    if len(values) - offset != sizes[0] * sizes[1] * 2:
        raise MessageError(
            f"command sequences: got {len(values)} numbers with an offset of {offset}, expected "
            f"{sizes[0] * sizes[1] * 2} after it"
        )
    if not np.isfinite(values).all() or np.abs(values).max() > LARGEST_COMMAND:
        raise MessageError(f"command sequences: not all values are finite and below {LARGEST_COMMAND:g} m/s or rad/s")
    return values[offset:].reshape(sizes).astype(np.float64)


def decode_occupancy(message: Any) -> tuple[np.ndarray, float, np.ndarray]:
    """``nav_msgs/OccupancyGrid`` → costs ``[rows, columns]`` int8, edge length of a cell [m], corner of the first cell
    ``[2]`` [m].

    Raises:
        MessageError: sizes do not match, or the grid is rotated, which costmaps are not.
    """
    info = message.info
    rows, columns = int(info.height), int(info.width)
    data = np.asarray(message.data, np.int8)
    if not 1 <= rows * columns <= MAXIMUM_IMAGE_PIXELS or data.size != rows * columns:
        raise MessageError(f"occupancy grid: got {data.size} cells, expected {rows} rows of {columns}")
    corner = np.array([info.origin.position.x, info.origin.position.y], float)
    resolution = float(info.resolution)
    if not (np.isfinite(corner).all() and 1e-3 <= resolution <= 100.0):
        raise MessageError(f"occupancy grid: cells of {resolution} m from {corner.tolist()}, expected finite numbers")
    if abs(float(info.origin.orientation.w)) < 0.9999:
        raise MessageError("occupancy grid: it is rotated, expected axes parallel to those of its frame")
    return data.reshape(rows, columns), resolution, corner


def decode_transforms(message: Any) -> dict[tuple[str, str], np.ndarray]:
    """``tf2_msgs/TFMessage`` → ``{(parent, child): [4, 4] parent ← child}``, without those that are none.

    Raises ``MessageError`` if none of several can be used.
    """
    transforms = {}
    fault = ""
    for entry in message.transforms:
        rotation, translation = entry.transform.rotation, entry.transform.translation
        quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w], float)
        offset = np.array([translation.x, translation.y, translation.z], float)
        if not (np.isfinite(quaternion).all() and np.isfinite(offset).all() and np.linalg.norm(quaternion) > 0.5):
            fault = fault or f"transform to {entry.child_frame_id!r}: not finite, or its quaternion is zero"
            continue
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        matrix[:3, 3] = offset
        transforms[entry.header.frame_id.lstrip("/"), entry.child_frame_id.lstrip("/")] = matrix
    if fault and not transforms:
        raise MessageError(fault)
    return transforms


def transform_stamps(message: Any) -> dict[tuple[str, str], int]:
    """Stamps [ns] of a ``tf2_msgs/TFMessage`` by the frames of :func:`decode_transforms`."""
    return {
        (entry.header.frame_id.lstrip("/"), entry.child_frame_id.lstrip("/")): stamp_of(entry)
        for entry in message.transforms
    }
