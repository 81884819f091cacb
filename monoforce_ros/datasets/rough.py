"""ROUGH / RobinGas scenes: calibrated images, one lidar cloud and lidar poses (github.com/ctu-vras/monoforce).

A scene is a folder of ``images/<sec>_<nsec>_<camera>.png``, ``clouds/<sec>_<nsec>.npz``, ``poses/lidar_poses.csv`` and
``calibration/``. Clouds are in ``os_sensor``; a row of the poses is the stamp and the 3 × 4 matrix map ← os_sensor.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation, Slerp

from monoforce_ros.bags import BagWriter, builders
from monoforce_ros.core import NANOSECOND, CameraModel, MotionTrack, homogeneous
from monoforce_ros.datasets.dataset import DatasetError, odometry_message, require_returns
from monoforce_ros.robots import robot_file

LIDAR_FRAME = "os_sensor"
BASE_FRAME = "base_link"
MAXIMUM_POSE_GAP = 0.2
"""Largest time between a cloud and its pose [s]."""
MAXIMUM_CLOUD_BYTES = 500_000_000


@dataclass(frozen=True)
class RoughScene:
    """One folder of the dataset."""

    path: Path
    cameras: dict[str, CameraModel]
    base_from_sensors: dict[str, np.ndarray]
    """Pose ``[4, 4]`` of each sensor frame in ``base_link``, rotations orthonormal."""
    pose_stamps: np.ndarray
    """``[n]`` int64 [ns], increasing."""
    map_from_base: np.ndarray
    """``[n, 4, 4]``."""
    cloud_stamps: np.ndarray
    """``[m]`` int64 [ns]."""

    @property
    def base_from_lidar(self) -> np.ndarray:
        """Pose ``[4, 4]`` of the lidar in ``base_link``."""
        return self.base_from_sensors[LIDAR_FRAME]

    @classmethod
    def open(cls, path: str | Path) -> RoughScene:
        """Read the calibration and poses of a scene; images and clouds are read on demand.

        Raises:
            DatasetError: a file is missing or invalid.
        """
        path = Path(path)
        transforms = path / "calibration" / "transformations.yaml"
        poses = path / "poses" / "lidar_poses.csv"
        for file in (transforms, poses):
            if not file.is_file():
                raise DatasetError(f"{path} is not a ROUGH scene: {file.relative_to(path)} is missing")
        base_from_sensors = {
            name.removeprefix(f"T_{BASE_FRAME}__"): _matrix(entry, f"{transforms}: {name}")
            for name, entry in _read_yaml(transforms).items()
            if name.startswith(f"T_{BASE_FRAME}__")
        }
        if LIDAR_FRAME not in base_from_sensors:
            raise DatasetError(f"{transforms}: no pose of {LIDAR_FRAME} in {BASE_FRAME}")
        cameras = {file.stem: _camera(file) for file in sorted((path / "calibration" / "cameras").glob("*.yaml"))}
        stamps, matrices = _read_poses(poses)
        return cls(
            path=path,
            cameras=cameras,
            base_from_sensors=base_from_sensors,
            pose_stamps=stamps,
            map_from_base=matrices @ np.linalg.inv(base_from_sensors[LIDAR_FRAME]),
            cloud_stamps=np.array(sorted(_stamp(file.stem) for file in (path / "clouds").glob("*.npz")), np.int64),
        )

    def cloud(self, stamp: int) -> np.ndarray:
        """Points ``[n, 3]`` [m] of the cloud with this stamp in ``os_sensor``, including empty returns.

        Raises:
            DatasetError: the file is damaged, has other fields, or no return.
        """
        file = self._file("clouds", stamp, ".npz")
        if file.stat().st_size > MAXIMUM_CLOUD_BYTES:
            raise DatasetError(f"{file}: {file.stat().st_size} bytes, at most {MAXIMUM_CLOUD_BYTES}")
        try:
            with np.load(file, allow_pickle=False) as content:
                arrays = [content[name] for name in content.files[:1]]
        # A zip file may be cut anywhere.
        except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error) as error:
            raise DatasetError(f"{file}: not readable as a cloud: {error}") from error
        if not arrays or {"x", "y", "z"} - set(arrays[0].dtype.names or ()):
            got = f"fields {arrays[0].dtype.names}" if arrays else "no array"
            raise DatasetError(f"{file}: got {got}, expected an array with the fields x, y and z")
        try:
            points = np.stack([arrays[0][name].astype(np.float32).ravel() for name in "xyz"], axis=1)
        except (TypeError, ValueError) as error:
            raise DatasetError(f"{file}: x, y or z is no number: {error}") from error
        require_returns(points, file)
        return points

    def images(self, stamp: int) -> dict[str, np.ndarray]:
        """RGB images with this stamp by camera, of the cameras that have an image and a calibration.

        Raises:
            DatasetError: an image is damaged, or of another size than its calibration.
        """
        found = {}
        for camera in self.cameras:
            file = self._file("images", stamp, f"_{camera}.png")
            if file.is_file():
                pixels = cv2.imread(str(file), cv2.IMREAD_COLOR)
                if pixels is None:
                    raise DatasetError(f"{file}: cannot be decoded as an image")
                found[camera] = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
                try:
                    self.cameras[camera].check_image(pixels)
                except ValueError as error:
                    raise DatasetError(f"{file}: {error}") from error
        return found

    def pose(self, stamp: int, *, maximum_gap: float = MAXIMUM_POSE_GAP) -> np.ndarray:
        """Pose ``[4, 4]`` map ← base_link at a stamp, interpolated.

        Raises:
            DatasetError: there is no pose within ``maximum_gap`` [s]; one from another time would be wrong.
        """
        gap = np.abs(self.pose_stamps - stamp).min() * NANOSECOND
        if gap > maximum_gap:
            raise DatasetError(
                f"{self.path}: the nearest pose is {gap:.2f} s away from {stamp * NANOSECOND:.3f}, expected at most "
                f"{maximum_gap:g} s"
            )
        inside = np.clip(stamp, self.pose_stamps[0], self.pose_stamps[-1])
        return interpolate_poses(self.pose_stamps, self.map_from_base, np.array([inside]))[0]

    def stands_at_start(self, seconds: float = 2.0, tolerance: float = 0.02) -> bool:
        """Whether the robot is at rest during the first ``seconds`` of the poses."""
        early = self.pose_stamps <= self.pose_stamps[0] + seconds * 1e9
        start = self.map_from_base[0, :3, 3]
        return bool(
            early.sum() >= 3 and np.linalg.norm(self.map_from_base[early, :3, 3] - start, axis=1).max() < tolerance
        )

    def _file(self, folder: str, stamp: int, suffix: str) -> Path:
        return self.path / folder / f"{stamp // 10**9}_{stamp % 10**9:09d}{suffix}"


def interpolate_poses(stamps: np.ndarray, matrices: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Poses ``[n, 4, 4]`` at the stamps ``targets`` [ns], which must lie within ``stamps``."""
    origin = stamps[0]
    times, at = (stamps - origin) * NANOSECOND, (targets - origin) * NANOSECOND
    result = np.tile(np.eye(4), (len(targets), 1, 1))
    result[:, :3, :3] = Slerp(times, Rotation.from_matrix(matrices[:, :3, :3]))(at).as_matrix()
    for axis in range(3):
        result[:, axis, 3] = np.interp(at, times, matrices[:, axis, 3])
    return result


def motion_from_poses(stamps: np.ndarray, matrices: np.ndarray, rate: float = 50.0) -> MotionTrack:
    """Motion at a constant rate from sparse poses; velocities are finite differences of the poses, in base axes."""
    count = int((stamps[-1] - stamps[0]) * NANOSECOND * rate)
    targets = stamps[0] + np.rint(np.arange(count + 1) / rate * 1e9).astype(np.int64)
    dense = interpolate_poses(stamps, matrices, np.minimum(targets, stamps[-1]))
    rotations = Rotation.from_matrix(dense[:, :3, :3])
    world = np.gradient(dense[:, :3, 3], 1.0 / rate, axis=0)
    turns = (rotations[:-1].inv() * rotations[1:]).as_rotvec() * rate
    return MotionTrack(
        stamps=targets,
        positions=dense[:, :3, 3],
        quaternions=rotations.as_quat(),
        linear_velocities=rotations.inv().apply(world),
        angular_velocities=np.concatenate([turns, turns[-1:]]),
        frame_id="map",
        child_frame_id=BASE_FRAME,
    )


def scene_to_bag(
    scene: RoughScene,
    out: str | Path,
    *,
    twist: tuple[float, float] = (0.5, 0.0),
    seconds: float = 10.0,
    compressed: bool = True,
    storage: str = "mcap",
    overwrite: bool = False,
) -> list[str]:
    """Write a scene as a bag: its images, calibration, cloud, and odometry from its poses.

    The scenes have no commands; the bag has the constant command ``twist`` on ``/cmd_vel``. If the cloud precedes the
    first pose of a robot at rest, that pose is extended back to the cloud. The topic ``/about`` lists both.

    Args:
        scene: the scene.
        out: folder of the bag.
        twist: forward speed [m/s] and yaw rate [rad/s] of the commands.
        seconds: duration of the odometry after the cloud [s].
        compressed: JPEG images, else raw ones.

    Returns:
        remarks on data in the bag that are not measurements.

    Raises:
        DatasetError: there is no cloud, or no pose for it.
    """
    if not len(scene.cloud_stamps):
        raise DatasetError(f"{scene.path}: no cloud")
    stamp = int(scene.cloud_stamps[0])
    remarks = [f"the commands ({twist[0]:g} m/s, {twist[1]:g} rad/s) are not the robot's: the scene has none"]
    stamps, matrices = scene.pose_stamps, scene.map_from_base
    lead = (stamps[0] - stamp) * NANOSECOND
    if lead > -1.0:
        if lead > MAXIMUM_POSE_GAP and not (lead < 10.0 and scene.stands_at_start()):
            scene.pose(stamp)  # raises the error
        remarks.append(f"the first pose, {lead:.1f} s after the cloud, is extended back to it: the robot is at rest")
        stamps = np.r_[stamp - 10**9, stamps]
        matrices = np.concatenate([matrices[:1], matrices])
    scene.pose(max(stamp, int(scene.pose_stamps[0])))
    motion = motion_from_poses(stamps, matrices)
    messages = []
    for index in range(len(motion)):
        at = int(motion.stamps[index])
        if stamp - 10**9 <= at <= stamp + seconds * 1e9:
            messages.append((at, "/odom", odometry_message(motion, index)))
    for at in range(stamp - 10**9, stamp + int(seconds * 1e9), 50_000_000):
        messages.append((at, "/cmd_vel", builders.twist_stamped(at, BASE_FRAME, *twist)))
    for name, pixels in scene.images(stamp).items():
        camera = scene.cameras[name]
        for at in range(stamp - 900_000_000, stamp + 1, 100_000_000):
            messages.append((at, f"/{name}/camera_info", _camera_info(at, name, camera)))
        messages.append(
            (stamp, f"/{name}/image_raw{'/compressed' * compressed}", _image(stamp, name, pixels, compressed))
        )
    messages.append((stamp, "/points", builders.point_cloud(stamp, LIDAR_FRAME, scene.cloud(stamp))))
    transforms = builders.static_transforms(stamp - 10**9, BASE_FRAME, scene.base_from_sensors)
    messages.append((stamp - 10**9, "/tf_static", transforms))
    messages.append((stamp - 10**9, "/about", builders.string("; ".join([f"from {scene.path.name}", *remarks]))))
    with BagWriter(out, storage=storage, overwrite=overwrite) as bag:
        for at, topic, message in sorted(messages, key=lambda entry: entry[0]):
            bag.write(topic, message, at)
    return remarks


def robot_file_for(scene: RoughScene, robot: str | Path, out: str | Path) -> Path:
    """Write a copy of a robot file with the scene's sensor poses."""
    content = _read_yaml(robot_file(robot))
    content["sensors"] = {
        frame: {
            "translation": [float(v) for v in pose[:3, 3]],
            "quaternion": [float(v) for v in Rotation.from_matrix(pose[:3, :3]).as_quat()],
        }
        for frame, pose in scene.base_from_sensors.items()
    }
    out = Path(out)
    out.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return out


def _camera_info(stamp: int, frame_id: str, camera: CameraModel) -> builders.Message:
    # The files state plumb_bob even for eight coefficients, which is the rational model in ROS.
    model = "rational_polynomial" if camera.distortion.size >= 8 else camera.distortion_model
    return builders.camera_info(stamp, frame_id, camera.width, camera.height, camera.matrix, camera.distortion, model)


def _image(stamp: int, frame_id: str, pixels: np.ndarray, compressed: bool) -> builders.Message:
    if not compressed:
        return builders.image(stamp, frame_id, pixels)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 92])
    return builders.compressed_image(stamp, frame_id, "jpeg", data.tobytes())


def _read_yaml(file: Path) -> dict:
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DatasetError(f"{file}: not readable as YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{file}: got {type(content).__name__}, expected a mapping")
    return content


def _numbers(values: Sequence, count: int, where: str) -> np.ndarray:
    try:
        array = np.array([float(value) for value in values])  # some files store numbers as strings
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{where}: not numbers: {error}") from error
    if (count >= 0 and array.size != count) or not np.isfinite(array).all():
        text = f"{array.size} numbers" if np.isfinite(array).all() else "numbers that are not finite"
        raise DatasetError(f"{where}: got {text}, expected {count if count >= 0 else 'some'} finite ones")
    return array


def _matrix(entry: object, where: str) -> np.ndarray:
    if not isinstance(entry, dict):
        raise DatasetError(f"{where}: got {entry!r}, expected a mapping with `data`")
    matrix = _numbers(entry.get("data", ()), 16, where).reshape(4, 4)
    return homogeneous(_orthonormal(matrix[None, :3, :3], where)[0], matrix[:3, 3])


def _camera(file: Path) -> CameraModel:
    content = _read_yaml(file)
    try:
        camera = CameraModel(
            width=int(content["image_width"]),
            height=int(content["image_height"]),
            matrix=_numbers(content["camera_matrix"]["data"], 9, f"{file}: camera_matrix").reshape(3, 3),
            distortion=_numbers(content["distortion_coefficients"]["data"], -1, f"{file}: distortion_coefficients"),
            distortion_model=content.get("distortion_model", "plumb_bob"),
            frame_id=file.stem,
        )
        camera.check()
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{file}: not a camera calibration: {error!r}") from error
    return camera


def _read_poses(file: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise DatasetError(f"{file}: not readable as a table: {error}") from error
    rows = [[part.strip() for part in line.split(",")] for line in lines[1:] if line.strip()]
    odd = next((row for row in rows if len(row) != 13), None)
    if odd is not None or len(rows) < 2:
        got = f"{len(rows)} rows" if odd is None else f"a row of {len(odd)} columns"
        raise DatasetError(f"{file}: got {got}, expected at least two rows of a stamp and twelve numbers")
    # A double resolves current stamps only to a quarter of a microsecond, so they are parsed as integers.
    stamps = np.array([_decimal_stamp(row[0], file) for row in rows], np.int64)
    values = _numbers([value for row in rows for value in row[1:]], 12 * len(rows), str(file)).reshape(-1, 3, 4)
    order = np.argsort(stamps)
    stamps, values = stamps[order], values[order]
    keep = np.r_[True, np.diff(stamps) > 0]
    if keep.sum() < 2:
        raise DatasetError(f"{file}: got one stamp in {len(rows)} rows, expected different ones")
    matrices = np.tile(np.eye(4), (int(keep.sum()), 1, 1))
    matrices[:, :3, :3] = _orthonormal(values[keep, :, :3], str(file))
    matrices[:, :3, 3] = values[keep, :, 3]
    return stamps[keep], matrices


def _orthonormal(matrices: np.ndarray, where: str) -> np.ndarray:
    """Nearest rotations of matrices with rounding errors, ``[n, 3, 3]``."""
    left, scales, right = np.linalg.svd(matrices)
    if not (np.abs(scales - 1.0) < 0.05).all() or not (np.linalg.det(matrices) > 0).all():
        raise DatasetError(f"{where}: some matrices are not rotations")
    return left @ right


def _stamp(name: str) -> int:
    seconds, _, nanoseconds = name.partition("_")
    try:
        return int(seconds) * 10**9 + int(nanoseconds[:9])
    except ValueError as error:
        raise DatasetError(f"file name {name!r}: expected <sec>_<nsec>") from error


def _decimal_stamp(text: str, file: Path) -> int:
    seconds, _, fraction = text.partition(".")
    try:
        return int(seconds) * 10**9 + int((fraction + "0" * 9)[:9])
    except ValueError as error:
        raise DatasetError(f"{file}: stamp {text!r}: expected seconds with decimals") from error
