"""The installed player and recorder as processes: complete images, correct timing, clear errors."""

import time

import numpy as np
import pytest
from nav_msgs.msg import Goals, OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image

from monoforce_ros.bags import BagReader, BagWriter, builders
from monoforce_ros.core import pose_matrix
from monoforce_ros.messages import encoding, message_class
from monoforce_ros.messages.decoding import stamp_of
from monoforce_ros.nodes.frames import TransformListener

START = 1_700_000_000_000_000_000
COUNT = 60


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Three seconds of raw 640 × 480 images at 20 Hz: 55 MB."""
    path = tmp_path_factory.mktemp("bags") / "images"
    with BagWriter(path) as writer:
        for i in range(COUNT):
            at = START + i * 50_000_000
            pixels = np.full((480, 640, 3), i, np.uint8)
            writer.write("/camera/image_raw", builders.image(at, "camera", pixels), at)
            writer.write("/cmd_vel", builders.twist(0.1 * i, 0), at)
    return path


class Listener:
    def __init__(self, peer, kind, topic, reliable=True):
        self.peer, self.messages, self.arrivals = peer, [], []
        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        self.subscription = peer.node.create_subscription(
            kind, topic, self._take, QoSProfile(depth=60, reliability=policy)
        )

    def _take(self, message):
        self.messages.append(message)
        self.arrivals.append(time.monotonic())

    def close(self):
        self.peer.node.destroy_subscription(self.subscription)


def finish(peer, process, seconds=40.0):
    assert peer.until(lambda: not process.running, seconds), process.output
    peer.spin(0.5)
    return process.wait()


@pytest.mark.parametrize("reliable", [True, False])
def test_large_raw_images_arrive_whole_with_their_timing(start, peer, bag, reliable):
    images = Listener(peer, Image, "/camera/image_raw", reliable)
    player = start("bag_player", bag, "--wait", "10", "--quiet")
    assert finish(peer, player) == 0, player.output
    images.close()
    sent = [(stamp_of(message) - START) // 50_000_000 for message in images.messages]
    if reliable:
        assert sent == list(range(COUNT))
    else:  # Best effort may lose one under load, which is its contract; the small default segment loses most.
        assert sent == sorted(set(sent)) and len(sent) >= COUNT - 3
    for i, message in zip(sent, images.messages, strict=True):
        assert stamp_of(message) == START + i * 50_000_000
        assert (np.frombuffer(message.data, np.uint8) == i).all()
    assert images.arrivals[-1] - images.arrivals[0] == pytest.approx(2.95, abs=0.4)


def test_rate_start_duration_topics_and_clock(start, peer, bag):
    images, clock = Listener(peer, Image, "/camera/image_raw"), Listener(peer, Clock, "/clock")
    player = start(
        "bag_player", bag, "--rate", "4", "--start", "1.0", "--duration", "1.0", "--clock", "--topics",
        "/camera/image_raw", "--wait", "10", "--quiet",
    )  # fmt: skip
    assert finish(peer, player) == 0, player.output
    images.close()
    clock.close()
    assert [int(m.data[0]) for m in images.messages] == list(range(20, 41))
    assert images.arrivals[-1] - images.arrivals[0] == pytest.approx(0.25, abs=0.15)
    times = [m.clock.sec * 10**9 + m.clock.nanosec for m in clock.messages]
    assert times == sorted(times)
    assert times[0] == START + 10**9 and times[-1] == START + 2 * 10**9


@pytest.mark.unhurried_nodes
def test_a_loop_goes_on_until_interrupted(start, peer, bag):
    images = Listener(peer, Image, "/camera/image_raw")
    player = start("bag_player", bag, "--loop", "--rate", "10", "--duration", "0.5", "--wait", "10", "--quiet")
    assert peer.until(lambda: len(images.messages) > 25, 30)
    assert player.stop() == 0
    images.close()
    first = [stamp_of(m) for m in images.messages].count(START)
    assert first >= 2


@pytest.fixture(scope="module")
def tf_type():
    kind = message_class("tf2_msgs/msg/TFMessage")
    if kind is None:
        pytest.skip("tf2_msgs is not installed (make interfaces builds it)")
    return kind


def write_motion(path, *, tf: bool, namespace: str = ""):
    with BagWriter(path) as writer:
        lidar = {"lidar": pose_matrix([1, 2, 3, 0, 0, 0])}
        writer.write(f"{namespace}/tf_static", builders.transforms(START, "base_link", lidar), START)
        for i in range(60):
            at = START + 10**9 + i * 50_000_000
            odometry = builders.odometry(at, "odom", "base_link", [0.1 * i, 0, 0], [0, 0, 0, 1], [0] * 3, [0] * 3)
            writer.write("/odom", odometry, at)
            if tf:
                writer.write("/tf", builders.transforms(at, "odom", {"base_link": pose_matrix([7, 0, 0, 0, 0, 0])}), at)
    return path


@pytest.mark.unhurried_nodes
@pytest.mark.parametrize("tf", [True, False])
def test_transforms_are_played_or_derived_from_odometry(start, peer, tf_type, tmp_path, tf):
    player = start("bag_player", write_motion(tmp_path / "bag", tf=tf), "--start", "2", "--wait", "10", "--quiet")
    transforms = TransformListener(peer.node)
    assert finish(peer, player) == 0
    assert "not played" not in player.output and ("derived from /odom" in player.output) != tf
    # The static transform lies before the start.
    assert transforms.tree.find("base_link", "lidar")[:3, 3].tolist() == [1.0, 2.0, 3.0]
    assert transforms.tree.find("odom", "base_link")[0, 3] == pytest.approx(7.0 if tf else 5.9)


@pytest.mark.unhurried_nodes
def test_a_tf_without_the_robot_s_pose_gets_it_from_the_odometry(start, peer, tf_type, tmp_path):
    """A driver that publishes the angles of its wheels, and a state estimator that publishes odometry alone."""
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(40):
            at = START + i * 50_000_000
            odometry = builders.odometry(at, "odom", "base_link", [0.1 * i, 0, 0], [0, 0, 0, 1], [0] * 3, [0] * 3)
            writer.write("/odom", odometry, at)
            wheel = {"wheel": pose_matrix([0.3, 0, 0, 0, 0.1 * i, 0])}
            writer.write("/tf", builders.transforms(at, "base_link", wheel), at)
    player = start("bag_player", tmp_path / "bag", "--wait", "10", "--quiet")
    transforms = TransformListener(peer.node)
    assert finish(peer, player) == 0
    assert "the bag's /tf has no odom → base_link: it is derived from /odom" in player.output
    assert transforms.tree.find("odom", "wheel")[0, 3] == pytest.approx(3.9 + 0.3)


@pytest.mark.unhurried_nodes
def test_transforms_of_a_robot_with_its_own_tf_stay_together(start, peer, tf_type, tmp_path):
    bag = write_motion(tmp_path / "bag", tf=False, namespace="/left")
    received = Listener(peer, tf_type, "/left/tf")
    player = start("bag_player", bag, "--start", "2", "--wait", "10", "--quiet")
    assert finish(peer, player, 90.0) == 0
    assert "the bag has no /left/tf: it is derived from /odom" in player.output
    assert received.messages[-1].transforms[0].child_frame_id == "base_link"
    received.close()


@pytest.mark.unhurried_nodes
def test_no_tf_is_derived_on_request(start, peer, tf_type, tmp_path):
    player = start("bag_player", write_motion(tmp_path / "bag", tf=False), "--no-tf", "--rate", "5", "--quiet")
    transforms = TransformListener(peer.node)
    assert finish(peer, player) == 0
    assert transforms.tree.find("odom", "base_link") is None


@pytest.mark.unhurried_nodes
def test_latched_topics_reach_late_subscribers_also_after_recording_anew(start, peer, tmp_path):
    """A map, as Nav2's static layer subscribes to it, published once before the part that is played."""
    with BagWriter(tmp_path / "maps") as writer:
        for second in range(3):
            data = encoding.occupancy_grid(
                START + second, "map", 0.1, (0.0, 0.0, 0.0), np.full((2, 2), second, np.int8)
            )
            writer.write_serialized("/map", "nav_msgs/msg/OccupancyGrid", data, START + second, latched=True)
        for tick in range(60):
            at = START + 10**9 + tick * 50_000_000
            writer.write("/cmd_vel", builders.twist(0.1, 0), at)
    player = start("bag_player", tmp_path / "maps", "--start", "1", "--wait", "0", "--loop", "--quiet")
    player.wait_for("playing")
    recorder = start("bag_recorder", tmp_path / "again", "--topics", "map")
    recorder.wait_for("recording /map")
    grids = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = peer.node.create_subscription(OccupancyGrid, "/map", grids.append, latched)
    assert peer.until(lambda: grids, 15.0)
    assert set(grids[-1].data) == {2}
    peer.node.destroy_subscription(subscription)
    assert player.stop() == 0 and recorder.stop() == 0
    with BagReader(tmp_path / "again") as bag:
        assert bag.latched == {"/map"} and bag.counts["/map"] >= 1


def damaged(bag, tmp_path, damage):
    broken = tmp_path / "images"
    broken.mkdir()
    for file in bag.iterdir():
        (broken / file.name).write_bytes(file.read_bytes())
    damage(broken)
    return broken


def cut(path, size):
    file = path / "images.mcap"
    file.write_bytes(file.read_bytes()[:size])


@pytest.mark.unhurried_nodes
def test_an_unreadable_bag_is_refused_in_one_line(start, bag, tmp_path):
    player = start("bag_player", damaged(bag, tmp_path, lambda path: cut(path, 30)), "--quiet", "--wait", "0")
    assert player.wait(30) == 1
    lines = [line for line in player.output.splitlines() if line.startswith("error:")]
    assert len(lines) == 1 and "cannot be read" in lines[0] and "Traceback" not in player.output


@pytest.mark.unhurried_nodes
@pytest.mark.parametrize(
    "damage",
    [
        lambda path: cut(path, (path / "images.mcap").stat().st_size * 2 // 3),
        lambda path: (path / "metadata.yaml").unlink(),
        lambda path: (path / "metadata.yaml").write_text("{"),
    ],
    ids=["cut off", "no metadata", "metadata makes no sense"],
)
def test_the_readable_part_of_a_damaged_bag_is_played_with_a_warning(start, peer, bag, tmp_path, damage):
    images = Listener(peer, Image, "/camera/image_raw")
    player = start("bag_player", damaged(bag, tmp_path, damage), "--quiet", "--rate", "20", "--wait", "10")
    assert player.wait(60) == 0
    peer.until(lambda: len(images.messages) > 5, 5)
    assert len(images.messages) > 5
    images.close()
    assert "no usable index" in player.output and "Traceback" not in player.output


@pytest.mark.unhurried_nodes
@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--topics", "/nothing"], "has no topics ['/nothing']"), (["--rate", "0"], "--rate: got 0.0")],
)
def test_wrong_arguments_are_reported(start, bag, arguments, message):
    player = start("bag_player", bag, *arguments)
    assert player.wait(30) in (1, 2)
    assert message in player.output and "Traceback" not in player.output


@pytest.mark.unhurried_nodes
def test_the_recorder_writes_the_received_messages(start, peer, tmp_path):
    recorder = start("bag_recorder", tmp_path / "out", "--topics", "cmd_vel", "/odom", "odmo")
    sent = 0

    def publish():
        nonlocal sent
        peer.publish("/cmd_vel", builders.twist_stamped(START + sent, "base_link", 0.1 * sent, 0.0))
        sent += 1
        peer.spin(0.05)

    deadline = time.monotonic() + 30
    while "recording /cmd_vel (geometry_msgs/msg/TwistStamped)" not in recorder.output:
        assert time.monotonic() < deadline
        publish()
    for _ in range(40):
        publish()
    assert not (tmp_path / "out").exists()
    assert recorder.stop() == 0
    assert "nobody published /odmo, /odom" in recorder.output
    with BagReader(tmp_path / "out") as bag:
        speeds = [m.decode().twist.linear.x for m in bag.messages(["/cmd_vel"])]
    assert len(speeds) >= 35 and np.allclose(np.diff(speeds), 0.1)
    refused = start("bag_recorder", tmp_path / "out")
    assert refused.wait(30) == 1
    assert "exists already" in refused.output


@pytest.mark.unhurried_nodes
def test_a_type_that_jazzy_does_not_have_is_recorded_from_its_package(start, peer, tmp_path):
    """A newer package's type ended the recording of all topics."""
    recorder = start("bag_recorder", tmp_path / "out", "--topics", "/goals", "/cmd_vel")
    goals = peer.node.create_publisher(Goals, "/goals", 10)
    deadline = time.monotonic() + 30
    while not all(f"recording {topic} " in recorder.output for topic in ("/goals", "/cmd_vel")):
        assert time.monotonic() < deadline, recorder.output
        goals.publish(Goals())
        peer.publish("/cmd_vel", builders.twist_stamped(START, "base_link", 0.1, 0.0))
        peer.spin(0.05)
    for _ in range(20):
        goals.publish(Goals())
        peer.publish("/cmd_vel", builders.twist_stamped(START, "base_link", 0.1, 0.0))
        peer.spin(0.05)
    assert recorder.stop() == 0 and "Traceback" not in recorder.output
    with BagReader(tmp_path / "out") as bag:
        assert bag.topics["/goals"] == "nav_msgs/msg/Goals"
        assert min(len(list(bag.messages([topic]))) for topic in ("/goals", "/cmd_vel")) >= 15


@pytest.mark.unhurried_nodes
def test_a_driver_that_starts_again_with_best_effort_is_recorded_on(start, peer, tmp_path):
    recorder = start("bag_recorder", tmp_path / "out", "--topics", "/restarted")
    clocks = peer.node.create_publisher(Clock, "/restarted", 10)
    message, deadline = Clock(), time.monotonic() + 30
    while "recording /restarted (" not in recorder.output:
        assert time.monotonic() < deadline, recorder.output
        peer.spin(0.05)
    peer.node.destroy_publisher(clocks)
    clocks = peer.node.create_publisher(
        Clock, "/restarted", QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    for second in range(80):
        message.clock.sec = 1 + second
        clocks.publish(message)
        peer.spin(0.05)
    assert recorder.stop() == 0 and "Traceback" not in recorder.output
    with BagReader(tmp_path / "out") as bag:
        received = {entry.decode().clock.sec for entry in bag.messages(["/restarted"])}
    assert {60, 70, 80} <= received
