"""Bags: written atomically, read for either ROS, salvaged when damaged, else rejected with a clear error."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import (
    BagError,
    BagReader,
    BagWriter,
    Recording,
    builders,
    camera_info_topics,
    find_transform,
    type_store,
)
from monoforce_ros.bags.moving_frame import MovingFrame
from monoforce_ros.core import homogeneous, unfinished_path

START = 1_700_000_000_000_000_000


def write(path, storage="mcap", count=20, **options):
    with BagWriter(path, storage=storage, **options) as bag:
        for i in range(count):
            at = START + i * 50_000_000
            bag.write(
                "/odom",
                builders.odometry(at, "odom", "base_link", [0.05 * i, 0, 0], [0, 0, 0, 1], [1, 0, 0], [0] * 3),
                at,
            )
            bag.write("/cmd_vel", builders.twist_stamped(at, "base_link", 1.0, 0.1), at)
            bag.write("/points", builders.point_cloud(at, "lidar", np.full((30, 3), float(i + 1))), at)
            bag.write("/cam/image_raw", builders.image(at, "cam", np.full((4, 6, 3), i, np.uint8)), at)
            bag.write(
                "/cam/camera_info",
                builders.camera_info(at, "cam", 6, 4, [[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]], [0] * 5),
                at,
            )
        pose = np.eye(4)
        pose[:3, 3] = [0.1, 0.2, 0.3]
        bag.write("/tf_static", builders.static_transforms(START, "base_link", {"lidar": pose}), at)
    return path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_what_is_written_is_read(tmp_path, storage):
    recording = Recording.open(write(tmp_path / "drive", storage))
    assert recording.topics == {"odometry": "/odom", "commands": "/cmd_vel", "cloud": "/points"}
    assert len(recording.motion) == len(recording.commands) == len(recording.clouds) == 20
    assert recording.motion.at(START + 125_000_000).position[0] == pytest.approx(0.125)
    points, frame = recording.cloud(recording.clouds[7])
    assert frame == "lidar" and (points == 8.0).all()
    assert (recording.image(recording.images["/cam/image_raw"][5]) == 5).all()
    assert recording.cameras["/cam/image_raw"].matrix[0, 0] == 5.0
    np.testing.assert_allclose(recording.base_from("lidar", "base_link")[:3, 3], [0.1, 0.2, 0.3])
    assert recording.base_from("elsewhere", "base_link") is None
    assert (tmp_path / "drive" / f"drive.{'mcap' if storage == 'mcap' else 'db3'}").is_file()


def test_a_recording_that_fails_leaves_nothing_behind(tmp_path):
    with pytest.raises(RuntimeError, match="stop"), BagWriter(tmp_path / "drive") as bag:
        bag.write("/cmd_vel", builders.twist(1, 0), START)
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_bag_is_kept_unless_overwriting_is_allowed(tmp_path):
    write(tmp_path / "drive", count=3)
    with pytest.raises(FileExistsError, match="exists already"):
        BagWriter(tmp_path / "drive")
    with pytest.raises(RuntimeError), BagWriter(tmp_path / "drive", overwrite=True) as bag:
        bag.write("/cmd_vel", builders.twist(1, 0), START)
        raise RuntimeError
    assert len(Recording.open(tmp_path / "drive").motion) == 3
    write(tmp_path / "drive", count=5, overwrite=True)
    assert len(Recording.open(tmp_path / "drive").motion) == 5
    with pytest.raises(ValueError, match="storage: got 'csv'"):
        BagWriter(tmp_path / "other", storage="csv")


def test_a_bag_that_somebody_else_finished_meanwhile_is_kept(tmp_path):
    with pytest.raises(FileExistsError, match="made by somebody else meanwhile"), BagWriter(
        tmp_path / "drive", keep=True
    ) as bag:  # fmt: skip
        bag.write("/cmd_vel", builders.twist(1, 0), START)
        write(tmp_path / "other", count=3).rename(tmp_path / "drive")
    assert len(Recording.open(tmp_path / "drive").motion) == 3
    (left,) = BagWriter.unfinished(tmp_path / "drive")
    with BagReader(left) as bag:
        assert len(list(bag.messages(["/cmd_vel"]))) == 1


def test_what_a_killed_writer_of_the_same_number_left_is_kept(tmp_path):
    """In a container a recorder has the same number at every start."""
    left = unfinished_path(tmp_path / "drive")
    write(tmp_path / "other", count=3).rename(left)
    write(tmp_path / "drive", count=5)
    assert len(Recording.open(left).motion) == 3 and len(Recording.open(tmp_path / "drive").motion) == 5


def test_types_of_installed_packages_are_learned_with_all_that_they_consist_of(tmp_path, monkeypatch):
    with BagWriter(tmp_path / "drive") as bag:
        assert bag.knows("geometry_msgs/msg/Twist") and not bag.knows("nobody_msgs/msg/Nothing")
        folder = tmp_path / "prefix" / "share" / "farm_msgs" / "msg"
        folder.mkdir(parents=True)
        (folder / "Row.msg").write_text("std_msgs/Header header\nPlant[] plants\nfloat64[2] ends\n")
        monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "prefix"))
        assert not bag.knows("farm_msgs/msg/Row"), "Plant is missing"
        (folder / "Plant.msg").write_text("geometry_msgs/Point place\nstring kind\n")
        assert bag.knows("farm_msgs/msg/Row") and bag.knows("farm_msgs/msg/Plant")
        (folder / "Odd.msg").write_text("this is : no definition\n")
        assert not bag.knows("farm_msgs/msg/Odd")
        bag.write("/cmd_vel", builders.twist(1, 0), START)


def storage_file(path):
    return next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_an_empty_bag_is_rejected_with_one_error(tmp_path, storage):
    path = write(tmp_path / "drive", storage)
    storage_file(path).write_bytes(b"")
    with pytest.raises(BagError, match="drive.*(cannot be read|is gone|damaged)"):
        Recording.open(path)


@pytest.mark.parametrize("part", [0.35, 0.6, 0.9])
def test_a_truncated_bag_is_read_up_to_the_damage(tmp_path, part):
    path = tmp_path / "drive"
    with BagWriter(path) as bag:
        random = np.random.default_rng(1)
        for i in range(400):
            at = START + i * 50_000_000
            bag.write(
                "/odom",
                builders.odometry(at, "odom", "base_link", [0.05 * i, 0, 0], [0, 0, 0, 1], [1, 0, 0], [0] * 3),
                at,
            )
            # Noise does not compress, so the file has many chunks.
            pixels = random.integers(0, 255, (120, 160, 3), np.uint8)
            bag.write("/cam/image_raw", builders.image(at, "cam", pixels), at)
    file = storage_file(path)
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * part)])
    recording = Recording.open(path)
    assert part * 400 - 40 < len(recording.motion) <= part * 400
    assert "cut off or damaged" in recording.warnings[0]
    assert "breaks off" in recording.warnings[1]
    np.testing.assert_allclose(recording.motion.positions[:, 0], 0.05 * np.arange(len(recording.motion)))
    frame = recording.images["/cam/image_raw"][10]
    assert recording.image(frame).shape == (120, 160, 3)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_without_metadata_is_read_with_a_warning(tmp_path, storage):
    path = write(tmp_path / "drive", storage)
    (path / "metadata.yaml").unlink()
    recording = Recording.open(path)
    assert "no usable index (there is no metadata.yaml)" in recording.warnings[0]
    for opened in (recording, Recording.open(storage_file(path))):
        assert len(opened.motion) == 20
        assert opened.cloud(opened.clouds[7])[0][0, 0] == 8.0


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("metadata", [True, False])
def test_messages_compressed_one_by_one_are_read(tmp_path, storage, metadata):
    """``ros2 bag record --compression-mode message``; only metadata.yaml says so."""
    path, types = tmp_path / "drive", type_store()
    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=types)
        for n in range(20):
            message = builders.twist(0.1 * n, 0.0)
            writer.write(connection, START + n, types.serialize_cdr(message, message.__msgtype__))
    if not metadata:
        (path / "metadata.yaml").unlink()
    for opened in (path, next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))):
        with BagReader(opened) as bag:
            speeds = [message.decode().linear.x for message in bag.messages()]
        np.testing.assert_allclose(speeds, 0.1 * np.arange(20))


def test_a_real_ros_1_bag_without_its_index_is_read(tmp_path, real_data):
    source = next((real_data / "husky_outdoor").glob("*.bag"))
    cut = tmp_path / "cut.bag"
    with source.open("rb") as stream:
        cut.write_bytes(stream.read(source.stat().st_size // 2))
    whole, part = Recording.open(source), Recording.open(cut)
    assert 0.3 * len(whole.motion) < len(part.motion) < 0.7 * len(whole.motion)
    np.testing.assert_array_equal(part.motion.positions, whole.motion.positions[: len(part.motion)])
    assert "cut off" in part.warnings[0]


@given(st.binary(max_size=400), st.sampled_from([b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\x00", b""]))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_bytes_give_a_clear_error(tmp_path, data, magic):
    file = tmp_path / ("junk.db3" if magic.startswith(b"SQL") else "junk.mcap")
    file.write_bytes(magic + data)
    with pytest.raises(BagError, match="cannot be read"):
        Recording.open(file)


def test_a_record_larger_than_the_file_is_rejected(tmp_path):
    file = tmp_path / "huge.mcap"
    file.write_bytes(b"\x89MCAP0\r\n" + b"\x06" + (2**62).to_bytes(8, "little") + b"short")
    with pytest.raises(BagError, match="does not fit"):
        Recording.open(file)


def test_missing_bags_are_named(tmp_path):
    with pytest.raises(BagError, match="does not exist"):
        Recording.open(tmp_path / "nowhere")
    junk = tmp_path / "junk.bag"
    junk.write_bytes(b"not a bag at all")
    with pytest.raises(BagError, match="cannot be read"):
        Recording.open(junk)
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match=r"contains no .mcap, .db3 or .bag file"):
        Recording.open(tmp_path / "empty")


def test_topics_of_unknown_types_are_ignored(tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("float64 level\nstring name", "strange_msgs/msg/Battery"))
    with Writer(tmp_path / "drive", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        odometry = bag.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        strange = bag.add_connection("/battery", "strange_msgs/msg/Battery", typestore=store)
        for i in range(5):
            at = START + i * 10**8
            message = builders.odometry(at, "odom", "base_link", [i, 0, 0], [0, 0, 0, 1], [1, 0, 0], [0] * 3)
            bag.write(odometry, at, store.serialize_cdr(message, "nav_msgs/msg/Odometry"))
            level = store.types["strange_msgs/msg/Battery"](level=0.5, name="b")
            bag.write(strange, at, store.serialize_cdr(level, "strange_msgs/msg/Battery"))
    recording = Recording.open(tmp_path / "drive")
    assert len(recording.motion) == 5
    with BagReader(tmp_path / "drive") as bag:
        assert bag.topics["/battery"] == "strange_msgs/msg/Battery"


def test_large_bags_are_read_in_little_memory(tmp_path):
    """Half a gigabyte of images, of which the reader holds one chunk at a time."""
    import subprocess
    import sys

    pixels = np.zeros((720, 1280, 3), np.uint8)
    with BagWriter(tmp_path / "drive") as bag:
        for i in range(190):
            at = START + i * 10**8
            bag.write("/cam/image_raw", builders.image(at, "cam", pixels), at)
            message = builders.odometry(at, "odom", "base_link", [i, 0, 0], [0, 0, 0, 1], [1, 0, 0], [0] * 3)
            bag.write("/odom", message, at)
    script = (
        "import resource, sys; from monoforce_ros.bags import Recording; import torch, cv2, scipy.interpolate\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "recording = Recording.open(sys.argv[1])\n"
        "print(len(recording.images['/cam/image_raw']), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "drive")], capture_output=True, text=True, check=True, timeout=120
    )
    images, grown_kilobytes = map(int, done.stdout.split())
    assert images == 190
    assert grown_kilobytes < 90_000


def test_a_bag_without_odometry_lists_its_types(tmp_path):
    with BagWriter(tmp_path / "drive") as bag:
        bag.write("/cmd_vel", builders.twist(1, 0), START)
    with pytest.raises(BagError, match=r"no nav_msgs/msg/Odometry topic; it contains \['geometry_msgs/msg/Twist'\]"):
        Recording.open(tmp_path / "drive")
    with pytest.raises(BagError, match="topic /cmd_vel is geometry_msgs/msg/Twist, expected nav_msgs"):
        Recording.open(tmp_path / "drive", odometry="/cmd_vel")


def test_single_invalid_messages_are_skipped_with_a_warning(tmp_path):
    with BagWriter(tmp_path / "drive") as bag:
        for i in range(10):
            at = START + i * 10**8
            speed = np.nan if i == 4 else 1.0
            bag.write(
                "/odom", builders.odometry(at, "odom", "base_link", [i, 0, 0], [0, 0, 0, 1], [speed, 0, 0], [0] * 3), at
            )
    recording = Recording.open(tmp_path / "drive")
    assert len(recording.motion) == 9 and "not finite" in recording.warnings[0]


def test_messages_out_of_order_are_sorted_by_their_stamps(tmp_path):
    with BagWriter(tmp_path / "drive") as bag:
        for i, k in enumerate([0, 2, 1, 3, 3]):
            at = START + k * 10**8
            message = builders.odometry(at, "odom", "base_link", [k, 0, 0], [0, 0, 0, 1], [1, 0, 0], [0] * 3)
            bag.write("/odom", message, START + i * 10**8)
    motion = Recording.open(tmp_path / "drive").motion
    assert motion.positions[:, 0].tolist() == [0, 1, 2, 3] and (np.diff(motion.stamps) > 0).all()


@pytest.mark.parametrize(
    ("image", "info"),
    [
        ("/cam/image_raw", ("/cam/camera_info", "/cam/image_raw/camera_info")),
        ("/cam/image_raw/compressed", ("/cam/camera_info", "/cam/image_raw/camera_info")),
        ("/camera_0/color/compressed", ("/camera_0/camera_info", "/camera_0/color/camera_info")),
        ("/image", ("/camera_info", "/image/camera_info")),
        ("image", ("camera_info", "image/camera_info")),
    ],
)
def test_camera_info_topics_follow_image_transport(image, info):
    assert camera_info_topics(image) == info


def test_transforms_are_chained_in_both_directions():
    step = np.eye(4)
    step[0, 3] = 1.0
    transforms = {("base_link", "mast"): step, ("mast", "lidar"): step, ("camera", "mast"): step}
    assert find_transform(transforms, "base_link", "lidar")[0, 3] == 2.0
    assert find_transform(transforms, "base_link", "camera")[0, 3] == 0.0
    assert find_transform(transforms, "base_link", "moon") is None


def test_a_real_ros_1_bag_of_a_husky_is_read_without_conversion(real_data):
    recording = Recording.open(real_data / "husky_outdoor" / "husky_odom_imu_gnss.bag")
    assert recording.topics["odometry"] == "/husky_velocity_controller/odom"
    length = np.linalg.norm(np.diff(recording.motion.positions, axis=0), axis=1).sum()
    assert len(recording.motion) == 3952 and 330 < length < 390
    with BagReader(real_data / "husky_outdoor" / "husky_odom_imu_gnss.bag") as bag:
        message = next(m for m in bag.messages(["/husky_velocity_controller/odom"]))
        converted = deserialize_message(message.cdr(), Odometry)
        assert converted.child_frame_id == message.decode().child_frame_id


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_is_opened_once_for_many_reads_and_anew_once_it_changed(tmp_path, storage, monkeypatch):
    openings = []
    enter = BagReader.__enter__
    monkeypatch.setattr(BagReader, "__enter__", lambda self: openings.append(self.path) or enter(self))
    path = write(tmp_path / "drive", storage)
    recording = Recording.open(path)
    frames = recording.images["/cam/image_raw"]
    before = len(openings)
    for index, frame in enumerate(frames):
        assert (recording.image(frame) == index).all()
    assert len(openings) == before + 1
    # Two passes at once, and other threads, do not disturb each other.
    pairs = zip(recording.images_of(frames), recording.images_of(frames[3:]), strict=False)
    for index, ((_, first), (_, second)) in enumerate(pairs):
        assert (first == index).all()
        assert (second == index + 3).all()
        assert (recording.image(frames[1]) == 1).all()
    with ThreadPoolExecutor(3) as pool:
        assert [int(image.flat[0]) for image in pool.map(recording.image, frames)] == list(range(len(frames)))
    write(path, storage, count=3, overwrite=True)
    with pytest.raises(BagError, match="the bag has changed"):
        recording.image(frames[-1])
    assert (Recording.open(path).image(frames[2]) == 2).all()


def test_a_pose_of_the_robot_in_the_world_is_none_of_a_sensor(tmp_path):
    """Transforms may come before the first odometry, which says in which frame that is."""
    with BagWriter(tmp_path / "bag") as bag:
        for i in range(40):
            at, pose = START + i * 50_000_000, np.eye(4)
            pose[0, 3] = 0.05 * i
            bag.write("/tf", builders.transforms(at, "world_odom", {"base_link": pose}), at)
            if i > 3:
                place = [0.05 * i, 0, 0]
                bag.write(
                    "/odom",
                    builders.odometry(at, "world_odom", "base_link", place, [0, 0, 0, 1], [1, 0, 0], [0] * 3),
                    at,
                )
        bag.write("/tf_static", builders.static_transforms(START, "map", {"world_odom": np.eye(4)}), START)
    recording = Recording.open(tmp_path / "bag")
    assert not recording.moving_transforms
    with pytest.raises(BagError, match="map"):
        recording.sensor_pose("map", "base_link", {}, START)


def test_a_frame_that_seldom_moves_takes_little_memory_and_is_where_it_was():
    def pose(time):
        """Stands, turns from 60 s on by 0.5 rad/s for 2 s, and stands again."""
        angle = 0.5 * float(np.clip(time - 60.0, 0.0, 2.0))
        return homogeneous(Rotation.from_euler("z", angle).as_matrix(), np.array([0.1, 0.0, 0.3]))

    kept = MovingFrame()
    times = np.arange(0.0, 120.0, 0.01)
    for time in np.r_[times, times[3000]]:  # one comes late
        kept.add(round(1e9 * time), pose(time))
    track = kept.track()
    assert len(track.stamps) < 120
    assert (np.diff(track.stamps) > 0).all()
    for time in (0.0, 31.7, 59.99, 60.503, 61.3, 62.1, 119.0):
        np.testing.assert_allclose(track.at(round(1e9 * time)), pose(time), atol=6e-3)
    # After a reset of the clock, the second run counts.
    again = MovingFrame()
    for time in np.r_[times[:3000] + 100.0, times]:
        again.add(round(1e9 * time), pose(time))
    np.testing.assert_allclose(again.track().at(round(61.3e9)), pose(61.3), atol=6e-3)
    assert again.track().stamps[-1] == round(1e9 * times[-1])
    # Beyond the first and last one: those.
    np.testing.assert_allclose(track.at(-(10**9)), pose(0.0), atol=1e-9)
    np.testing.assert_allclose(track.at(500 * 10**9), pose(119.0), atol=1e-9)
