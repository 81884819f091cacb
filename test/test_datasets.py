"""Public datasets: read with their peculiarities, and converted to bags for the rest of the package."""

import gzip

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import Recording, cut_windows
from monoforce_ros.core import CameraModel
from monoforce_ros.datasets import DatasetError, DriveRecording, RellisSequence, cli, drive_to_bag, read_splits

LIDAR_ON_ROBOT = np.array([0.2, 0.0, 1.0])


# ---- DRIVE


def windows_file(path, *, delay=0.6, sign=-1.0, runs=30, seed=3):
    """Windows as in DRIVE: each run holds a command for 6 s; poses are delayed and start at the origin."""
    random = np.random.default_rng(seed)
    step, fields = 0.05, {}
    time = np.arange(int(runs * 6 / step)) * step
    commands = np.repeat(random.uniform(-8, 8, (runs, 2)), 120, axis=0)
    wheels = np.zeros_like(commands)
    for i in range(1, len(time)):
        wheels[i] = wheels[i - 1] + step / 0.3 * (commands[i - 1] - wheels[i - 1])
    rate = 0.6 * 0.3 / 1.08 * (wheels[:, 1] - wheels[:, 0])
    speed = 0.3 * wheels.mean(axis=1)
    heading = np.cumsum(rate) * step
    place = np.cumsum(np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=1), axis=0) * step
    late = round(delay / step)
    delayed_heading, delayed_place = np.roll(heading, late), np.roll(place, late, axis=0)
    delayed_heading[:late], delayed_place[:late] = heading[0], place[0]

    def cut(values):
        return values.reshape(-1, 40).astype(np.float32)

    start = np.arange(0, len(time), 40)
    turned = Rotation.from_euler("z", -delayed_heading[start][:, None]).as_matrix()[:, :2, :2]
    relative = delayed_place.reshape(-1, 40, 2) - delayed_place[start][:, None]
    local = np.einsum("wij,wkj->wki", turned, relative)
    fields.update(
        dt=np.float32(step), cmd_left=cut(commands[:, 0]), cmd_right=cut(commands[:, 1]),
        left_wheel_vel=cut(wheels[:, 0]), right_wheel_vel=cut(wheels[:, 1]),
        icp_x=local[..., 0].astype(np.float32), icp_y=local[..., 1].astype(np.float32),
        icp_yaw=(delayed_heading.reshape(-1, 40) - delayed_heading[start][:, None]).astype(np.float32),
        imu_yaw_rate=cut(sign * rate),
        steady_state_mask=np.tile([0, 1, 1], runs).astype(np.float32),
        transitory_state_mask=np.tile([1, 0, 0], runs).astype(np.float32),
    )  # fmt: skip
    for name in ("icp_z", "icp_roll", "icp_pitch"):
        fields[name] = np.zeros((3 * runs, 40), np.float32)
    np.savez(path, **fields)
    return delayed_place, delayed_heading


def test_windows_are_joined_and_their_clocks_estimated(tmp_path):
    place, heading = windows_file(tmp_path / "nameless.npz", delay=0.6, sign=-1.0)
    recording = DriveRecording.open(tmp_path / "nameless.npz")
    assert [len(run.stamps) for run in recording.runs] == [120] * 30
    clocks = recording.clocks()
    assert clocks.gyro_sign == -1
    assert clocks.pose_delay == pytest.approx(0.6, abs=0.06)
    for number in (3, 11):
        run = recording.runs[number]
        first = 120 * number
        turn = Rotation.from_euler("z", heading[first]).as_matrix()[:2, :2]
        expected = (place[first : first + 120] - place[first]) @ turn
        # Steps between windows are extrapolated from the half second before them.
        assert np.abs(run.positions[:, :2] - expected).max() < 0.06
        yaw = np.unwrap(Rotation.from_quat(run.quaternions).as_euler("ZYX")[:, 0])
        assert np.abs(yaw - (heading[first : first + 120] - heading[first])).max() < 0.06


def test_a_converted_file_of_windows_has_windows_within_its_runs_only(tmp_path):
    windows_file(tmp_path / "nameless.npz")
    recording = DriveRecording.open(tmp_path / "nameless.npz")
    remarks = drive_to_bag(recording, tmp_path / "bag", correct_delay=True)
    assert any("0.60 s late" in remark or "0.55 s late" in remark or "0.65 s late" in remark for remark in remarks)
    assert any("sign is corrected" in remark for remark in remarks)
    bag = Recording.open(tmp_path / "bag")
    windows = cut_windows(bag.motion, bag.commands, length=2.0, stride=0.5)
    assert len(windows) > 100
    assert np.linalg.norm(windows.positions[:, -1] - windows.positions[:, 0], axis=1).max() < 2.0 * 8 * 0.3 + 0.5
    # Wheel commands of ±8 rad/s as speeds of the whole robot.
    assert np.abs(bag.commands.twists[:, 0]).max() <= 8 * 0.3 + 1e-6


@pytest.mark.parametrize(
    ("name", "sign", "delay"),
    [
        ("warthog_wheels_asphalt.npz", 1, (0.5, 0.9)),
        ("warthog_wheels_gravel_2024_8_6_11h37s32.npz", -1, (0.55, 0.9)),
        ("warthog_wheels_sand_2024_9_25_14h13s47.npz", 1, (0.7, 1.0)),
        ("test_warthog.npz", 1, (0.15, 0.35)),
    ],
)
def test_clocks_of_real_recordings_are_estimated(real_data, name, sign, delay):
    recording = DriveRecording.open(real_data / "drive" / name)
    clocks = recording.clocks()
    assert clocks.gyro_sign == sign
    assert delay[0] <= clocks.pose_delay <= delay[1]
    assert clocks.correlation > 0.8
    assert all(len(run.stamps) == 120 for run in recording.runs)


def test_the_real_continuous_log_becomes_a_bag(tmp_path, real_data):
    file = next((real_data / "drive").glob("*continuous*.csv.gz"))
    assert cli.main(["drive", str(file), str(tmp_path / "bag")]) == 0
    bag = Recording.open(tmp_path / "bag")
    assert len(bag.commands) > 7000
    span = (bag.motion.stamps[-1] - bag.motion.stamps[0]) * 1e-9
    assert span == pytest.approx(363, abs=3)
    # Poses that the log repeats are not measurements.
    assert len(bag.motion) < 0.6 * len(bag.commands)
    assert np.diff(bag.motion.stamps).max() * 1e-9 < 0.4


def test_a_table_of_windows_is_read_like_their_arrays(tmp_path):
    """The data frame that DRIVE publishes, written as CSV: one row for each window, one column for each sample."""
    windows_file(tmp_path / "windows.npz")
    with np.load(tmp_path / "windows.npz") as content:
        fields = {name: content[name] for name in content.files if name != "dt"}
    columns = {"calib_step": ["0"] * len(fields["cmd_left"])}
    for name, values in fields.items():
        if values.ndim == 1:
            # As pandas writes booleans and numbers.
            columns[name] = [
                str(value > 0.5) if name == "steady_state_mask" else repr(float(value)) for value in values
            ]
            continue
        for number in range(values.shape[1]):
            title = f"{'imu_yaw' if name == 'imu_yaw_rate' else name}_{number}"
            columns[title] = [repr(float(value)) for value in values[:, number]]
    lines = [",".join(columns), *(",".join(row) for row in zip(*columns.values(), strict=True))]
    (tmp_path / "windows.csv").write_text("\n".join(lines))
    array, table = (DriveRecording.open(tmp_path / f"windows.{kind}") for kind in ("npz", "csv"))
    assert len(array.runs) == len(table.runs)
    for one, other in zip(array.runs, table.runs, strict=True):
        np.testing.assert_allclose(one.positions, other.positions, atol=1e-6)
        # The arrays keep the time step in single precision.
        np.testing.assert_allclose(one.stamps - one.stamps[0], other.stamps - other.stamps[0], rtol=1e-6)
        np.testing.assert_allclose(one.gyro, other.gyro)
    (tmp_path / "lacking.csv").write_text("\n".join(line.replace("icp_yaw_7,", "x,") for line in lines))
    with pytest.raises(DatasetError, match="got no column icp_yaw_7"):
        DriveRecording.open(tmp_path / "lacking.csv")
    (tmp_path / "short.csv").write_text("\n".join([lines[0], "1,2,3"]))
    with pytest.raises(DatasetError, match="line 2: got 3 columns"):
        DriveRecording.open(tmp_path / "short.csv")


@given(st.binary(max_size=200), st.sampled_from(["x.npz", "x.csv", "x.csv.gz", "x.txt"]))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_bytes_are_rejected_by_name(tmp_path, data, name):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(DatasetError, match=name.split(".")[1]):
        DriveRecording.open(tmp_path / name)


def test_missing_fields_of_logs_and_windows_are_named(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(DatasetError, match="got no cmd_left"):
        DriveRecording.open(tmp_path / "other.npz")
    with gzip.open(tmp_path / "log.csv.gz", "wt") as stream:
        stream.write("time,x\n1,2\n")
    with pytest.raises(DatasetError, match="got no column"):
        DriveRecording.open(tmp_path / "log.csv.gz")


# ---- RELLIS-3D


def rellis_folder(root, sequence="00001", frames=12, missing=(4,)):
    """A sequence of the published layout: a lidar 1 m up that drives along x and turns, a wall 6 m ahead."""
    folder = root / sequence
    for part in ("os1_cloud_node_kitti_bin", "pylon_camera_node"):
        (folder / part).mkdir(parents=True)
    rng = np.random.default_rng(2)
    ground = np.column_stack([rng.uniform(-8, 8, (3000, 2)), np.full(3000, -1.3)])
    poses = []
    for frame in range(frames):
        cloud = np.column_stack([ground, rng.uniform(0, 1, 3000)]).astype(np.float32)
        cloud.tofile(folder / "os1_cloud_node_kitti_bin" / f"{frame:06d}.bin")
        if frame not in missing:
            seconds, millis = divmod(1581624652750 + 100 * frame, 1000)
            image = np.full((30, 48, 3), 10 * frame, np.uint8)
            cv2.imwrite(str(folder / "pylon_camera_node" / f"frame{frame:06d}-{seconds}_{millis:03d}.jpg"), image)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", 0.3 + 0.02 * frame).as_matrix()
        pose[:3, 3] = [5.0 + 0.1 * frame, 2.0, 0.4]
        poses.append(" ".join(f"{value:.9f}" for value in pose[:3].ravel()))
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")
    (folder / "camera_info.txt").write_text("40.0 41.0 24.0 15.0\n")
    # Optical axes: z along the lidar's x, x along its -y.
    quaternion = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]).as_quat()
    entry = {
        "q": dict(zip("xyzw", map(float, quaternion), strict=True)),
        "t": {"x": 0.1, "y": 0.0, "z": -0.2},
    }
    (folder / "transforms.yaml").write_text(yaml.safe_dump({"os1_cloud_node-pylon_camera_node": entry}))
    for name, numbers in (("train", range(6)), ("val", range(6, 9)), ("test", range(9, 12))):
        lines = [
            " ".join(
                f"{sequence}/os1_cloud_node_{folder}/{k:06d}.{ending}"
                for folder, ending in (("kitti_bin", "bin"), ("semantickitti_label_id", "label"))
            )
            for k in numbers
        ]
        (root / f"pt_{name}.lst").write_text("\n".join(lines) + "\n")
    return folder


def test_a_rellis_sequence_is_read_as_published(tmp_path):
    sequence = RellisSequence.open(rellis_folder(tmp_path))
    assert len(sequence) == 12
    # The frame without an image lies between its neighbours.
    np.testing.assert_array_equal(sequence.stamps, 1581624652750000000 + 100_000_000 * np.arange(12))
    assert sequence.cloud(3).shape == (3000, 3)
    assert sequence.image(5).mean() == pytest.approx(50, abs=2)
    camera = sequence.camera
    assert isinstance(camera, CameraModel)
    ahead = np.linalg.inv(sequence.lidar_from_camera) @ [6.1, 0.0, -0.2, 1.0]
    np.testing.assert_allclose(ahead[:3], [0.0, 0.0, 6.0], atol=1e-9)
    with pytest.raises(DatasetError, match="frame 4 has no image"):
        sequence.image(4)
    with pytest.raises(DatasetError, match="no such cloud"):
        sequence.cloud(99)


def test_rellis_splits_are_the_published_lists(tmp_path):
    rellis_folder(tmp_path)
    splits = read_splits(tmp_path)
    assert splits["train"][0] == ("00001", 0)
    assert [len(splits[name]) for name in ("train", "val", "test")] == [6, 3, 3]
    assert not {*splits["train"]} & {*splits["test"]}
    (tmp_path / "pt_val.lst").write_text("nonsense\n")
    with pytest.raises(DatasetError, match=r"pt_val.lst, line 1"):
        read_splits(tmp_path)


def test_a_rellis_bag_has_the_robot_below_its_lidar(tmp_path, capsys):
    folder = rellis_folder(tmp_path)
    assert cli.main(["rellis", str(folder), str(tmp_path / "bag"), "--first", "2", "--count", "8"]) == 0
    assert "no commands" in capsys.readouterr().out
    bag = Recording.open(tmp_path / "bag")
    assert len(bag.clouds) == 8
    assert [len(frames) for frames in bag.images.values()] == [7]
    state = bag.motion.at(int(bag.motion.stamps[0]))
    np.testing.assert_allclose(state.position, 0.0, atol=1e-9)
    assert state.heading == pytest.approx(0.0, abs=1e-9)
    # The Warthog's lidar is 0.2 m ahead of the base frame, which turns about it.
    assert state.linear_velocity[0] > 0.8
    points, frame = bag.cloud(bag.clouds[0])
    pose = bag.base_from(frame, "base_link")
    np.testing.assert_allclose(pose[:3, 3], LIDAR_ON_ROBOT, atol=1e-6)
    assert (points @ pose[:3, :3].T + pose[:3, 3])[:, 2].mean() == pytest.approx(-0.3, abs=1e-5)


@pytest.mark.parametrize("broken", ["poses.txt", "camera_info.txt", "transforms.yaml"])
def test_broken_rellis_files_are_named(tmp_path, broken):
    folder = rellis_folder(tmp_path)
    (folder / broken).write_text("1 2 three")
    with pytest.raises(DatasetError, match=broken):
        RellisSequence.open(folder)
    (folder / broken).unlink()
    with pytest.raises(DatasetError, match=f"{broken} is missing"):
        RellisSequence.open(folder)


def test_a_cloud_of_odd_size_is_rejected(tmp_path):
    folder = rellis_folder(tmp_path)
    (folder / "os1_cloud_node_kitti_bin" / "000003.bin").write_bytes(b"odd")
    with pytest.raises(DatasetError, match=r"000003\.bin: got 3 bytes"):
        RellisSequence.open(folder).cloud(3)


def test_convert_reports_errors_in_one_line(tmp_path, capsys):
    assert cli.main(["rough", str(tmp_path), str(tmp_path / "bag")]) == 1
    assert cli.main(["drive", str(tmp_path / "none.npz"), str(tmp_path / "bag")]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "not a ROUGH scene" in lines[0]
    assert "no such file" in lines[1]


# ---- damaged folders


def rough_folder(root):
    """A scene of the published layout: two cameras, one cloud, a robot at rest and then driving along x."""
    folder = root / "scene"
    for part in ("images", "clouds", "poses", "calibration/cameras"):
        (folder / part).mkdir(parents=True)
    seconds, nanoseconds = 1700000000, 250000000
    rng = np.random.default_rng(4)
    points = np.zeros(500, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")])
    points["x"], points["y"], points["z"] = rng.uniform(-8, 8, 500), rng.uniform(-8, 8, 500), -1.0
    np.savez_compressed(folder / "clouds" / f"{seconds}_{nanoseconds:09d}.npz", cloud=points)
    optical = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1.0]])
    lidar = np.eye(4)
    lidar[2, 3] = 0.9
    transforms = {"T_base_link__os_sensor": {"rows": 4, "cols": 4, "data": lidar.ravel().tolist()}}
    for name in ("camera_front", "camera_rear"):
        image = rng.integers(0, 255, (30, 40, 3), np.uint8)
        cv2.imwrite(str(folder / "images" / f"{seconds}_{nanoseconds:09d}_{name}.png"), image)
        transforms[f"T_base_link__{name}"] = {"rows": 4, "cols": 4, "data": optical.ravel().tolist()}
        camera = {
            "image_width": 40, "image_height": 30, "camera_name": name, "distortion_model": "plumb_bob",
            "camera_matrix": {"rows": 3, "cols": 3, "data": [30.0, 0.0, 19.5, 0.0, 30.0, 14.5, 0.0, 0.0, 1.0]},
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        }  # fmt: skip
        (folder / "calibration" / "cameras" / f"{name}.yaml").write_text(yaml.safe_dump(camera))
    (folder / "calibration" / "transformations.yaml").write_text(yaml.safe_dump(transforms))
    rows = ["timestamp, T00"]
    for i in range(120):
        pose = lidar.copy()
        pose[0, 3] = 0.05 * max(0, i - 20)
        stamp = f"{seconds}.{nanoseconds // 10**6 + 0:03d}" if i == 0 else f"{seconds + (i + 2) // 10}.{(i + 2) % 10}5"
        rows.append(", ".join([stamp, *(f"{value:.9f}" for value in pose[:3].ravel())]))
    (folder / "poses" / "lidar_poses.csv").write_text("\n".join(rows) + "\n")
    return folder


def cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def changed_yaml(file, change):
    content = yaml.safe_load(file.read_text())
    change(content)
    file.write_text(yaml.safe_dump(content))


def edited_poses(file, row, column, value):
    lines = file.read_text().splitlines()
    parts = [part.strip() for part in lines[row].split(",")] if "," in lines[row] else lines[row].split()
    parts[column : column + 1] = [] if value is None else [value]
    lines[row] = (", " if "," in lines[row] else " ").join(parts)
    file.write_text("\n".join(lines) + "\n")


def saved(file, **arrays):
    with open(file, "wb") as stream:
        np.savez(stream, **arrays)


ROUGH_POSES, ROUGH_TRANSFORMS = "poses/lidar_poses.csv", "calibration/transformations.yaml"
ROUGH_CLOUD, ROUGH_IMAGE = "clouds/1700000000_250000000.npz", "images/1700000000_250000000_camera_rear.png"
ROUGH_CAMERA = "calibration/cameras/camera_rear.yaml"
ROUGH_DAMAGE = {
    "cut cloud": (ROUGH_CLOUD, cut),
    "empty cloud": (ROUGH_CLOUD, lambda file: file.write_bytes(b"")),
    "no array": (ROUGH_CLOUD, lambda file: saved(file)),
    "objects": (ROUGH_CLOUD, lambda file: saved(file, a=np.array([{}], object))),
    "other fields": (ROUGH_CLOUD, lambda file: saved(file, a=np.zeros((5, 3)))),
    "fields of text": (ROUGH_CLOUD, lambda file: saved(file, a=np.zeros(5, [(n, "U3") for n in "xyz"]))),
    "NaN points": (ROUGH_CLOUD, lambda file: saved(file, a=np.full(5, np.nan, [(n, "f4") for n in "xyz"]))),
    "cut image": (ROUGH_IMAGE, cut),
    "empty image": (ROUGH_IMAGE, lambda file: file.write_bytes(b"")),
    "image of another size": (ROUGH_IMAGE, lambda file: cv2.imwrite(str(file), np.zeros((15, 20, 3), np.uint8))),
    "NaN pose": (ROUGH_POSES, lambda file: edited_poses(file, 30, 4, "nan")),
    "infinite pose": (ROUGH_POSES, lambda file: edited_poses(file, 30, 1, "inf")),
    "missing column": (ROUGH_POSES, lambda file: edited_poses(file, 30, 4, None)),
    "text": (ROUGH_POSES, lambda file: edited_poses(file, 30, 4, "east")),
    "text as stamp": (ROUGH_POSES, lambda file: edited_poses(file, 30, 0, "noon")),
    "one stamp": (ROUGH_POSES, lambda file: file.write_text("\n".join(["t", *file.read_text().splitlines()[1:2] * 3]))),
    "poses in binary": (ROUGH_POSES, lambda file: file.write_bytes(b"\xff\xfe\x00\x81")),
    "poses of another time": (
        ROUGH_POSES, lambda file: file.write_text(file.read_text().replace("\n1700", "\n1600")),
    ),
    "no dictionary": (ROUGH_TRANSFORMS, lambda file: changed_yaml(file, lambda c: c.update(T_base_link__os_sensor=3))),
    "NaN transform": (
        ROUGH_TRANSFORMS,
        lambda file: changed_yaml(file, lambda c: c["T_base_link__os_sensor"]["data"].__setitem__(3, float("nan"))),
    ),
    "no data": (ROUGH_TRANSFORMS, lambda file: changed_yaml(file, lambda c: c["T_base_link__os_sensor"].pop("data"))),
    "data is a number": (
        ROUGH_TRANSFORMS, lambda file: changed_yaml(file, lambda c: c["T_base_link__os_sensor"].update(data=3)),
    ),
    "matrix of another image": (
        ROUGH_CAMERA, lambda file: changed_yaml(file, lambda c: c.update(image_width=160, image_height=120)),
    ),
    "NaN matrix": (
        ROUGH_CAMERA, lambda file: changed_yaml(file, lambda c: c["camera_matrix"]["data"].__setitem__(0, float("nan")))
    ),
    "no size": (ROUGH_CAMERA, lambda file: changed_yaml(file, lambda c: c.pop("image_width"))),
    "cut calibration": (ROUGH_CAMERA, lambda file: file.write_text(file.read_text()[:60] + "[")),
}  # fmt: skip
RELLIS_IMAGE = "pylon_camera_node/frame000005-1581624653_250.jpg"
RELLIS_CLOUD = "os1_cloud_node_kitti_bin/000005.bin"
RELLIS_DAMAGE = {
    "cut image": (RELLIS_IMAGE, cut),
    "empty image": (RELLIS_IMAGE, lambda file: file.write_bytes(b"")),
    "image of another size": (RELLIS_IMAGE, lambda file: cv2.imwrite(str(file), np.zeros((15, 24, 3), np.uint8))),
    "cut cloud": (RELLIS_CLOUD, lambda file: file.write_bytes(file.read_bytes()[:1001])),
    "empty cloud": (RELLIS_CLOUD, lambda file: file.write_bytes(b"")),
    "three columns": (
        RELLIS_CLOUD, lambda file: np.fromfile(file, np.float32).reshape(-1, 4)[:, :3].copy().tofile(file),
    ),
    "doubles": (RELLIS_CLOUD, lambda file: np.fromfile(file, np.float32).astype(np.float64).tofile(file)),
    "NaN points": (RELLIS_CLOUD, lambda file: np.full((50, 4), np.nan, np.float32).tofile(file)),
    "NaN pose": ("poses.txt", lambda file: edited_poses(file, 5, 3, "nan")),
    "missing column": ("poses.txt", lambda file: edited_poses(file, 5, 3, None)),
    "NaN focal length": ("camera_info.txt", lambda file: file.write_text("nan 41.0 24.0 15.0")),
    "matrix of another image": ("camera_info.txt", lambda file: file.write_text("160.0 164.0 96.0 60.0")),
    "NaN transform": (
        "transforms.yaml",
        lambda file: changed_yaml(file, lambda c: c["os1_cloud_node-pylon_camera_node"]["t"].update(x=float("nan"))),
    ),
    "no rotation": (
        "transforms.yaml",
        lambda file: changed_yaml(file, lambda c: next(iter(c.values())).update(q=dict.fromkeys("xyzw", 0))),
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "damage"), [*(("rough", name) for name in ROUGH_DAMAGE), *(("rellis", name) for name in RELLIS_DAMAGE)]
)
def test_a_damaged_folder_is_refused_in_one_line_that_names_the_file(tmp_path, capsys, kind, damage):
    folder = rough_folder(tmp_path) if kind == "rough" else rellis_folder(tmp_path)
    assert cli.main([kind, str(folder), str(tmp_path / "whole")]) == 0, capsys.readouterr().err
    name, change = (ROUGH_DAMAGE if kind == "rough" else RELLIS_DAMAGE)[damage]
    assert (folder / name).is_file()
    change(folder / name)
    capsys.readouterr()
    assert cli.main([kind, str(folder), str(tmp_path / "bag")]) == 1
    said = capsys.readouterr().err.splitlines()
    named = folder.name if damage == "poses of another time" else name.rpartition("/")[2]
    assert len(said) == 1 and said[0].startswith("convert: ") and named in said[0], said
    assert not (tmp_path / "bag").exists()


def test_frames_without_a_pose_are_named(tmp_path, capsys):
    folder = rellis_folder(tmp_path)
    poses = folder / "poses.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:-2]))
    assert cli.main(["rellis", str(folder), str(tmp_path / "bag")]) == 0
    assert "2 frames after the last of the 10 poses are left out" in capsys.readouterr().out
