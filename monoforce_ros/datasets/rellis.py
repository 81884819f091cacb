"""RELLIS-3D sequences: images, Ouster clouds and lidar poses of a Warthog off road (github.com/unmannedlab/RELLIS-3D).

A sequence is a folder ``00000`` to ``00004`` of ``os1_cloud_node_kitti_bin/<frame>.bin`` (float32 x, y, z, intensity),
``pylon_camera_node/frame<frame>-<sec>_<msec>.jpg``, ``poses.txt`` (a 3 × 4 matrix map ← lidar for each frame),
``camera_info.txt`` (fx fy cx cy) and ``transforms.yaml`` (the camera's pose in the lidar's frame). Splits are lists
``pt_train.lst``, ``pt_val.lst`` and ``pt_test.lst`` next to the sequences. Clouds have no time and take that of the
image with the same number.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, builders
from monoforce_ros.core import CameraModel, homogeneous
from monoforce_ros.datasets.dataset import DatasetError, odometry_message, require_returns
from monoforce_ros.datasets.rough import motion_from_poses
from monoforce_ros.messages import decoding

LIDAR_FRAME, CAMERA_FRAME, BASE_FRAME = "os1_lidar", "pylon_camera", "base_link"
CLOUDS, IMAGES = "os1_cloud_node_kitti_bin", "pylon_camera_node"
SPLITS = ("train", "val", "test")
LARGEST_CLOUD = 100_000_000
_FRAME_TIME = 100_000_000
_IMAGE_NAME = re.compile(r"frame(\d{6})-(\d{9,10})_(\d{1,3})\.(jpg|png)")


@dataclass(frozen=True)
class RellisSequence:
    """One folder of the dataset."""

    path: Path
    stamps: np.ndarray
    """Stamp of each frame, ``[n]`` int64 [ns]."""
    images: dict[int, Path]
    """Image file of each frame that has one."""
    map_from_lidar: np.ndarray
    """``[n, 4, 4]``."""
    camera: CameraModel
    lidar_from_camera: np.ndarray
    """``[4, 4]``, with the optical frame of the camera."""
    without_pose: int = 0
    """Frames with a cloud or an image after the last pose."""

    @classmethod
    def open(cls, path: str | Path) -> RellisSequence:
        """Read a sequence's calibration, poses and file names.

        Raises:
            DatasetError: a file is missing or invalid.
        """
        path = Path(path)
        for part in (CLOUDS, IMAGES, "poses.txt", "camera_info.txt", "transforms.yaml"):
            if not (path / part).exists():
                raise DatasetError(f"{path} is not a RELLIS-3D sequence: {part} is missing")
        images, times = {}, {}
        for file in sorted((path / IMAGES).iterdir()):
            named = _IMAGE_NAME.fullmatch(file.name)
            if named:
                frame = int(named[1])
                images[frame] = file
                times[frame] = int(named[2]) * 10**9 + int(named[3].ljust(3, "0")) * 10**6
        if len(times) < 2:
            raise DatasetError(
                f"{path / IMAGES}: got {len(times)} images, expected frame000000-<sec>_<msec>.jpg and on"
            )
        poses = _poses(path / "poses.txt")
        frames = np.arange(len(poses))
        known = np.array(sorted(times))
        stamps = np.array([times[frame] for frame in known], np.int64)
        if (np.diff(stamps) <= 0).any():
            raise DatasetError(f"{path / IMAGES}: the stamps of the images do not increase with their numbers")
        first = stamps[0]
        # Frames without an image are interpolated, and extrapolated at the lidar's rate.
        seconds = np.interp(frames, known, (stamps - first).astype(np.float64))
        seconds = np.where(frames < known[0], (frames - known[0]) * float(_FRAME_TIME), seconds)
        last = float(stamps[-1] - first)
        seconds = np.where(frames > known[-1], last + (frames - known[-1]) * float(_FRAME_TIME), seconds)
        size = _image_size(images[int(known[0])])
        return cls(
            path=path,
            stamps=first + np.rint(seconds).astype(np.int64),
            images=images,
            map_from_lidar=poses,
            camera=_camera(path / "camera_info.txt", size),
            lidar_from_camera=_camera_pose(path / "transforms.yaml"),
            without_pose=sum(frame >= len(poses) for frame in {*images, *_cloud_numbers(path / CLOUDS)}),
        )

    def __len__(self) -> int:
        return len(self.stamps)

    def cloud(self, frame: int) -> np.ndarray:
        """Returns ``[n, 3]`` float32 [m] in the lidar's frame.

        Raises:
            DatasetError: there is no such cloud, or its file does not hold rows of x, y, z and intensity.
        """
        file = self.path / CLOUDS / f"{frame:06d}.bin"
        if not file.is_file():
            raise DatasetError(f"{file}: no such cloud")
        size = file.stat().st_size
        if size % 16 or not 0 < size <= LARGEST_CLOUD:
            raise DatasetError(f"{file}: got {size} bytes, expected a multiple of 16 up to {LARGEST_CLOUD}")
        rows = np.fromfile(file, np.float32).reshape(-1, 4)
        require_returns(rows[:, :3], file)
        if (rows[:, 3] < 0.0).any():
            raise DatasetError(f"{file}: got negative intensities, expected rows of x, y, z and intensity in float32")
        return rows[:, :3]

    def image(self, frame: int) -> np.ndarray:
        """RGB pixels ``[height, width, 3]``; raises ``DatasetError`` if there is no such image or it is damaged."""
        return decoding.decode_image(self.image_message(frame))

    def image_message(self, frame: int) -> builders.Message:
        """The image as it is in its file, as ``sensor_msgs/CompressedImage``.

        Raises:
            DatasetError: there is no such image, it is damaged, or of another size than the first one.
        """
        file = self.images.get(frame)
        if file is None:
            raise DatasetError(f"{self.path}: frame {frame} has no image")
        encoding = "png" if file.suffix == ".png" else "jpeg"
        message = builders.compressed_image(int(self.stamps[frame]), CAMERA_FRAME, encoding, file.read_bytes())
        try:
            self.camera.check_image(decoding.decode_image(message))
        except ValueError as error:
            raise DatasetError(f"{file}: {error}") from error
        return message


def read_splits(root: str | Path) -> dict[str, list[tuple[str, int]]]:
    """The published splits ``train``, ``val`` and ``test``: sequence and frame of each cloud.

    Raises:
        DatasetError: a list is missing, or a line is not the path of a cloud.
    """
    splits = {}
    for name in SPLITS:
        file = Path(root) / f"pt_{name}.lst"
        if not file.is_file():
            raise DatasetError(f"{file} is missing; expected pt_train.lst, pt_val.lst and pt_test.lst in {root}")
        entries = []
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), start=1):
            if not line.strip():
                continue
            parts = Path(line.split()[0]).parts
            if len(parts) < 3 or not Path(parts[-1]).stem.isdecimal():
                raise DatasetError(f"{file}, line {number}: got {line!r}, expected 00000/{CLOUDS}/000000.bin")
            entries.append((parts[-3], int(Path(parts[-1]).stem)))
        splits[name] = entries
    return splits


def sequence_to_bag(
    sequence: RellisSequence,
    out: str | Path,
    *,
    base_from_lidar: np.ndarray,
    frames: range | None = None,
    storage: str = "mcap",
    overwrite: bool = False,
) -> list[str]:
    """Write a sequence or part of it as a bag: original images, calibration, clouds, and odometry from its poses.

    Args:
        sequence: folder of the dataset.
        out: folder of the bag.
        base_from_lidar: pose ``[4, 4]`` of the lidar on the robot, for example from the robot file ``warthog``: the
            dataset's poses are those of the lidar.
        frames: frames to write, by default all.
        storage: ``mcap`` or ``sqlite3``.
        overwrite: replace an existing bag.

    Returns:
        remarks on data in the bag that are not measurements.

    Raises:
        DatasetError: a cloud or image is damaged, or there are fewer than two frames.
    """
    chosen = range(len(sequence)) if frames is None else frames
    chosen = range(max(chosen.start, 0), min(chosen.stop, len(sequence)))
    if len(chosen) < 2:
        raise DatasetError(f"{sequence.path}: got frames {frames}, expected at least two of its {len(sequence)}")
    base_from_lidar = np.asarray(base_from_lidar, np.float64)
    poses = sequence.map_from_lidar[chosen.start : chosen.stop] @ np.linalg.inv(base_from_lidar)
    stamps = sequence.stamps[chosen.start : chosen.stop]
    start = homogeneous(Rotation.from_euler("z", _heading(poses[0])).as_matrix(), poses[0, :3, 3])
    motion = motion_from_poses(stamps, np.linalg.inv(start) @ poses)
    remarks = [
        "there are no commands, since the sequence has none",
        "clouds have the stamps of the images with the same number",
        "the pose of the lidar on the robot comes from the robot file",
    ]
    if sequence.without_pose and chosen.stop == len(sequence):
        remarks.append(
            f"{sequence.without_pose} frames after the last of the {len(sequence)} poses are left out: poses.txt "
            "has no row for them"
        )
    events: list[tuple[int, int]] = [(int(motion.stamps[i]), -1 - i) for i in range(len(motion))]
    events += [(int(sequence.stamps[frame]), frame) for frame in chosen]
    sensors = {LIDAR_FRAME: base_from_lidar, CAMERA_FRAME: base_from_lidar @ sequence.lidar_from_camera}
    camera = sequence.camera
    with BagWriter(out, storage=storage, overwrite=overwrite) as bag:
        bag.write("/tf_static", builders.static_transforms(int(stamps[0]), BASE_FRAME, sensors), int(stamps[0]))
        about = builders.string("; ".join([f"from RELLIS-3D {sequence.path.name}", *remarks]))
        bag.write("/about", about, int(stamps[0]))
        for stamp, number in sorted(events):
            if number < 0:
                bag.write("/odom", odometry_message(motion, -1 - number), stamp)
                continue
            if (sequence.path / CLOUDS / f"{number:06d}.bin").is_file():
                bag.write("/points", builders.point_cloud(stamp, LIDAR_FRAME, sequence.cloud(number)), stamp)
            if number in sequence.images:
                image = sequence.image_message(number)
                info = builders.camera_info(
                    stamp, CAMERA_FRAME, camera.width, camera.height, camera.matrix, camera.distortion
                )
                bag.write("/pylon_camera_node/camera_info", info, stamp)
                bag.write("/pylon_camera_node/image_raw/compressed", image, stamp)
    return remarks


def _heading(pose: np.ndarray) -> float:
    return float(np.arctan2(pose[1, 0], pose[0, 0]))


def _poses(file: Path) -> np.ndarray:
    try:
        values = np.loadtxt(file, dtype=np.float64, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise DatasetError(f"{file}: not readable: {error}") from error
    if values.ndim != 2 or values.shape[1] != 12 or len(values) < 2 or not np.isfinite(values).all():
        raise DatasetError(f"{file}: got shape {values.shape}, expected at least two rows of twelve finite numbers")
    left, scales, right = np.linalg.svd(values.reshape(-1, 3, 4)[:, :, :3])
    if (np.abs(scales - 1.0) > 0.05).any() or (np.linalg.det(left @ right) < 0).any():
        raise DatasetError(f"{file}: some matrices are not rotations")
    matrices = np.tile(np.eye(4), (len(values), 1, 1))
    matrices[:, :3, :3] = left @ right
    matrices[:, :3, 3] = values.reshape(-1, 3, 4)[:, :, 3]
    return matrices


def _cloud_numbers(folder: Path) -> set[int]:
    return {int(file.stem) for file in folder.glob("*.bin") if file.stem.isdecimal()}


def _camera(file: Path, size: tuple[int, int]) -> CameraModel:
    try:
        fx, fy, cx, cy = (float(value) for value in file.read_text(encoding="utf-8").split())
        camera = CameraModel(
            width=size[0],
            height=size[1],
            matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            distortion=np.zeros(5),
            distortion_model="plumb_bob",
            frame_id=CAMERA_FRAME,
        )
        camera.check()
    except (ValueError, UnicodeDecodeError) as error:
        raise DatasetError(f"{file}: expected fx fy cx cy: {error}") from error
    return camera


def _image_size(file: Path) -> tuple[int, int]:
    pixels = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if pixels is None:
        raise DatasetError(f"{file}: cannot be decoded as an image")
    return pixels.shape[1], pixels.shape[0]


def _camera_pose(file: Path) -> np.ndarray:
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        entry = content["os1_cloud_node-pylon_camera_node"]
        quaternion, place = (
            np.array([float(entry[k][axis]) for axis in axes]) for k, axes in (("q", "xyzw"), ("t", "xyz"))
        )
        if not (np.isfinite(quaternion).all() and np.isfinite(place).all()):
            raise ValueError(f"got q {quaternion.tolist()} and t {place.tolist()}, expected finite numbers")
        return homogeneous(Rotation.from_quat(quaternion).as_matrix(), place)
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        text = " ".join(str(error).split())
        raise DatasetError(
            f"{file}: expected os1_cloud_node-pylon_camera_node with q and t: {type(error).__name__}: {text}"
        ) from error
