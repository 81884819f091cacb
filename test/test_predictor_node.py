"""The installed predictor as a process of its own: its outputs, and its reaction to bad input."""

import signal

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from predictor_peer import OUTPUTS, ground_cloud

from monoforce_ros.bags import builders

OK, WARN, ERROR = 0, 1, 2
PREDICTED = [topic for topic in OUTPUTS if topic.startswith("/predicted")]


@pytest.fixture(scope="module")
def predictor(start, peer):
    """One node for all tests of this file: the input of one test must not affect the next."""
    process = start("predictor", "--ros-args", "-p", "data_timeout:=1.0")
    process.wait_for("predicting 5 s ahead for husky")
    assert peer.until(lambda: peer.node.count_subscribers("/diagnostics") > 0)
    return process


def healthy(peer, predictor) -> None:
    """Feed good data until predictions are back; discovery of new publishers takes a moment."""
    peer.begin()
    for _ in range(6):
        peer.drive(0.8)
        complete = all(peer.received[topic] for topic in PREDICTED)
        if complete and peer.until(lambda: peer.status("prediction") == (OK, "predicting"), 0.5):
            return
    pytest.fail(f"no prediction from good data: {peer.status('prediction')}\n{predictor.output[-3000:]}")


def test_outputs_carry_the_stamp_and_frame_of_their_input(peer, predictor):
    healthy(peer, predictor)
    for topic in PREDICTED:
        assert set(peer.stamps(topic)) <= set(peer.clouds_sent)
        message = peer.received[topic][-1]
        header = message.markers[0].header if hasattr(message, "markers") else message.header
        assert header.frame_id == "odom"
    path = peer.received["/predicted/path"][-1]
    start, end = path.poses[0].pose.position, path.poses[-1].pose.position
    np.testing.assert_allclose([start.x, start.y, start.z], [1.0, 2.0, 0.3], atol=1e-6)
    # From rest, five seconds at 0.5 m/s, along the level.
    assert end.x - 1.0 == pytest.approx(2.45, abs=0.1) and end.y == pytest.approx(2.0, abs=0.01)
    assert max(abs(p.pose.position.z - 0.3) for p in path.poses) < 0.02
    assert len(path.poses) == 51
    assert len(peer.received["/predicted/height_map"][-1].cells) == 128 * 128
    terrain = peer.received["/predicted/terrain"][-1]
    names = ["x", "y", "z", "geometric_height", "stiffness", "damping", "friction", "observed"]
    names += ["geometric_spread", "decrease_spread", "rgba"]
    assert [f.name for f in terrain.fields] == names
    values = np.frombuffer(terrain.data, "<f4").reshape(-1, len(names))
    assert np.isfinite(values).all()
    np.testing.assert_allclose(values[values[:, 7] > 0.5, 2], 0.3 - 0.1323, atol=0.03)
    forces = next(m for m in peer.received["/predicted/contact_forces"][-1].markers if m.ns == "contact_forces")
    assert len(forces.points) > 20
    first_time = forces.points[0]
    assert abs(first_time.z - (0.3 - 0.14)) < 0.05


@pytest.mark.unhurried_nodes
def test_the_first_prediction_is_logged_and_inputs_are_visible_before_they_are_published(peer, start):
    process = start("predictor", "--ros-args", "-r", "__ns:=/apart", "-p", "terrain_source:=lidar_camera")
    process.wait_for("predicting 5 s ahead for husky")
    expected = {
        "/apart/odom": "nav_msgs/msg/Odometry",
        "/apart/cmd_vel": "geometry_msgs/msg/TwistStamped",
        "/apart/points": "sensor_msgs/msg/PointCloud2",
        "/apart/camera_front/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
        "/apart/camera_front/camera_info": "sensor_msgs/msg/CameraInfo",
    }

    def seen() -> dict:
        # Until it is discovered, the peer knows no such node and raises an error.
        if ("predictor", "/apart") not in peer.node.get_node_names_and_namespaces():
            return {}
        listed = dict(peer.node.get_subscriber_names_and_types_by_node("predictor", "/apart"))
        return {topic: listed.get(topic, [""])[0] for topic in expected}

    assert peer.until(lambda: seen() == expected, 10.0), seen()
    assert "first prediction" not in process.output
    assert process.stop() == 0


def test_the_first_prediction_is_logged_once(peer, predictor):
    healthy(peer, predictor)
    (line,) = [line for line in predictor.output.splitlines() if "first prediction" in line]
    assert "5 s ahead, in frame 'odom', published on /predicted/path" in line


def refused(peer, predictor, part: str, text: str, seconds: float = 1.4, **bad) -> None:
    """Feed bad input: a diagnostic names it, nothing is predicted, the node survives and then recovers."""
    healthy(peer, predictor)
    peer.settle()
    peer.begin()
    bad_from = peer.now
    peer.drive(seconds, **bad)
    assert peer.until(lambda: peer.status(part) is not None and text in peer.status(part)[1], 5.0), (
        peer.status(part),
        predictor.output[-2000:],
    )
    assert peer.status(part)[0] == ERROR
    # Until odometry_timeout a prediction may be made from the last good odometry.
    first = bad_from + (300_000_000 if part == "odometry" else -1)
    for topic in PREDICTED:
        assert [s for s in peer.stamps(topic) if s > first] == []
    assert predictor.running
    assert predictor.output.count("Traceback") == 0
    healthy(peer, predictor)


def test_clouds_full_of_nan(peer, predictor):
    bad = lambda stamp: builders.point_cloud(stamp, "lidar", np.full((500, 3), np.nan))  # noqa: E731
    refused(peer, predictor, "lidar", "none of its 500 points is a finite return", cloud=bad)


def test_clouds_with_some_nan_are_used(peer, predictor):
    cloud = ground_cloud()
    cloud[::2] = np.nan
    peer.begin()
    peer.drive(1.2, cloud=lambda stamp: builders.point_cloud(stamp, "lidar", cloud))
    assert peer.until(lambda: bool(peer.received["/predicted/terrain"]))
    data = np.frombuffer(peer.received["/predicted/terrain"][-1].data, "<f4")
    assert np.isfinite(data).all()


def test_clouds_in_an_unknown_frame(peer, predictor):
    bad = lambda stamp: builders.point_cloud(stamp, "mystery", ground_cloud())  # noqa: E731
    refused(peer, predictor, "lidar", "the pose of frame 'mystery' on the robot is unknown", cloud=bad)


def test_clouds_with_a_wrong_size(peer, predictor):
    def bad(stamp):
        message = builders.point_cloud(stamp, "lidar", ground_cloud())
        message.width = 2_000_000
        return message

    refused(peer, predictor, "lidar", "point cloud data: got", cloud=bad)


def test_clouds_that_miss_the_map(peer, predictor):
    bad = lambda stamp: builders.point_cloud(stamp, "lidar", ground_cloud() + np.float32([500, 0, 0]))  # noqa: E731
    refused(peer, predictor, "prediction", "hit 0 cells", cloud=bad)


def test_stamps_of_zero(peer, predictor):
    bad = lambda stamp: builders.point_cloud(0, "lidar", ground_cloud())  # noqa: E731
    refused(peer, predictor, "lidar", "stamps are zero", cloud=bad)


def test_odometry_with_stamps_of_zero(peer, predictor):
    bad = lambda stamp: builders.odometry(0, "odom", "base_link", [1, 2, 0.3], [0, 0, 0, 1], [0] * 3, [0] * 3)  # noqa: E731
    refused(peer, predictor, "odometry", "the stamps are zero: the state estimator does not set them", odometry=bad)


@pytest.mark.parametrize(("offset", "text"), [(-2.0, "before the odometry and ignored"), (50.0, "after the odometry")])
def test_commands_of_another_clock_are_reported(peer, predictor, offset, text):
    """A laptop that drives the robot, its clock off: the robot would be predicted to stand, without a word."""
    healthy(peer, predictor)
    peer.begin()
    shift = round(1e9 * offset)
    peer.drive(1.4, command=lambda stamp: builders.twist_stamped(stamp + shift, "base_link", 0.5, 0.0))
    assert peer.until(lambda: text in (peer.status("commands") or (0, ""))[1], 5.0), peer.status("commands")
    level, message = peer.status("commands")
    stated = float(message.removeprefix("commands are stamped ").split()[0])
    assert level == WARN and stated == pytest.approx(abs(offset), abs=0.7)
    healthy(peer, predictor)
    assert peer.until(lambda: peer.status("commands") == (OK, "receiving commands"), 3.0)


def test_clouds_in_the_odometry_frame_are_used(peer, predictor):
    healthy(peer, predictor)
    peer.settle()
    peer.begin()
    moved = ground_cloud() + np.float32([1.0, 2.0, 0.3 + 0.65])
    peer.drive(1.6, cloud=lambda stamp: builders.point_cloud(stamp, "odom", moved))
    assert peer.until(lambda: len(peer.received["/predicted/terrain"]) > 1, 5.0), peer.status("lidar")
    terrain = peer.received["/predicted/terrain"][-1]
    values = np.frombuffer(terrain.data, "<f4").reshape(-1, len(terrain.fields))
    np.testing.assert_allclose(values[values[:, 7] > 0.5, 2], 0.3 - 0.1323, atol=0.03)


def test_odometry_that_stops(peer, predictor):
    refused(peer, predictor, "odometry", "no messages for", seconds=2.5, odometry=lambda stamp: None)


def test_odometry_of_nan(peer, predictor):
    def bad(stamp):
        return builders.odometry(stamp, "odom", "base_link", [0, 0, 0], [0, 0, 0, 1], [np.nan, 0, 0], [0] * 3)

    refused(peer, predictor, "odometry", "position or velocity is not finite", odometry=bad)


def test_odometry_far_from_its_origin_is_used_with_a_warning(peer, predictor):
    """Paths hold 64-bit numbers, clouds 32-bit ones: in UTM coordinates these are half a metre apart."""

    def far(stamp):
        place = [443_000.0, 5_540_000.0, 300.0]
        return builders.odometry(stamp, "odom", "base_link", place, [0, 0, 0, 1], [0] * 3, [0] * 3)

    peer.drive(1.4, odometry=far)
    said = "positions 5540 km from the origin of 'odom': point clouds hold 32-bit numbers, which are 50 cm apart there"
    assert peer.until(lambda: said in (peer.status("odometry") or (0, ""))[1], 5.0), peer.status("odometry")
    healthy(peer, predictor)


def test_odometry_with_a_zero_quaternion(peer, predictor):
    def bad(stamp):
        return builders.odometry(stamp, "odom", "base_link", [0, 0, 0], [0, 0, 0, 0], [0, 0, 0], [0] * 3)

    refused(peer, predictor, "odometry", "expected a unit quaternion", odometry=bad)


@pytest.mark.parametrize("quaternion", [[1.0, 0, 0, 0], [-0.5, 0.5, -0.5, 0.5]])
def test_odometry_of_a_robot_upside_down_or_of_an_optical_frame(peer, predictor, quaternion):
    def bad(stamp):
        return builders.odometry(stamp, "odom", "base_link", [1, 2, 0.3], quaternion, [0.5, 0, 0], [0] * 3)

    refused(peer, predictor, "odometry", "the robot lies on its side or upside down", odometry=bad)


def test_odometry_of_two_estimators_that_do_not_agree(peer, predictor):
    def bad(stamp):
        beside = 2.0 + 0.4 * (stamp // 20_000_000 % 2)
        return builders.odometry(stamp, "odom", "base_link", [1, beside, 0.3], [0, 0, 0, 1], [0] * 3, [0] * 3)

    healthy(peer, predictor)
    # One estimator's poses are its own, however rough.
    other = peer.node.create_publisher(Odometry, "/odom", 10)
    peer.settle()
    # A third of a second shows two tracks.
    peer.drive(0.6, odometry=bad)
    peer.settle()
    peer.begin()
    peer.drive(1.4, odometry=bad)
    text = "alternate between two tracks that are 0.40 m or rad apart"
    assert text in (peer.status("odometry") or (0, ""))[1], peer.status("odometry")
    assert all(not peer.stamps(topic) for topic in PREDICTED)
    assert "published by /peer;" in predictor.output
    peer.node.destroy_publisher(other)
    healthy(peer, predictor)


def test_odometry_with_a_speed_that_no_robot_has(peer, predictor):
    def bad(stamp):
        return builders.odometry(stamp, "odom", "base_link", [1, 2, 0.3], [0, 0, 0, 1], [500.0, 0, 0], [0] * 3)

    refused(peer, predictor, "odometry", "expected at most 100", odometry=bad)


@pytest.mark.parametrize(
    ("moved", "text"), [([1, 1, -1, 0.0], "above its wheels"), ([1, 1, 1, -3.0], "below its wheels")]
)
def test_a_lidar_that_is_mounted_otherwise_than_the_transforms_say(peer, predictor, moved, text):
    cloud = ground_cloud() * np.float32(moved[:3]) + np.float32([0, 0, moved[3]])
    healthy(peer, predictor)
    peer.begin()
    peer.drive(1.4, cloud=lambda stamp: builders.point_cloud(stamp, "lidar", cloud))
    assert peer.until(lambda: text in (peer.status("ground") or (0, ""))[1], 5.0), peer.status("ground")
    assert peer.status("ground")[0] == WARN
    healthy(peer, predictor)
    assert peer.until(lambda: peer.status("ground")[0] == OK, 5.0)


def test_a_lidar_that_falls_silent(peer, predictor):
    refused(peer, predictor, "lidar", "no messages for", seconds=2.5, cloud=lambda stamp: None)


def test_commands_of_nan_are_ignored(peer, predictor):
    healthy(peer, predictor)
    peer.begin()
    peer.drive(1.6, command=lambda stamp: builders.twist_stamped(stamp, "base_link", np.nan, 0.0))
    reported = lambda: peer.status("commands") or (OK, "")  # noqa: E731
    assert peer.until(lambda: reported()[0] == ERROR, 3.0) and "expected finite numbers" in reported()[1], reported()
    peer.settle()
    # The last good command has expired by then: the robot is predicted to stop.
    path = peer.received["/predicted/path"][-1]
    assert path.poses[-1].pose.position.x == pytest.approx(1.0, abs=0.05)


def test_without_commands_zero_velocity_is_assumed_with_a_warning(peer, predictor):
    peer.settle()
    peer.begin()
    peer.drive(2.0, command=lambda stamp: None)
    silent = lambda: peer.status("commands") or (OK, "")  # noqa: E731
    assert peer.until(lambda: silent()[0] == WARN, 3.0), silent()
    assert "assuming zero velocity" in silent()[1]

    def end() -> float:
        return peer.received["/predicted/path"][-1].poses[-1].pose.position.x

    assert peer.until(lambda: end() == pytest.approx(1.0, abs=0.05), 3.0), end()


def test_time_that_jumps_back(peer, predictor):
    healthy(peer, predictor)
    peer.settle(1.0)
    peer.clear()
    peer.now -= 60_000_000_000
    jumped_to = peer.now
    peer.drive(1.6)
    assert peer.until(lambda: any(s >= jumped_to for s in peer.stamps("/predicted/path")))
    assert "time went back by" in predictor.output
    # Nothing of the time before the jump is mixed in: every output belongs to a cloud sent after it.
    assert all(jumped_to <= s < peer.now for s in peer.stamps("/predicted/path"))


def test_late_messages_out_of_order_are_dropped(peer, predictor):
    healthy(peer, predictor)
    peer.clear()
    newest = peer.now
    peer.publish("/points", builders.point_cloud(newest - 900_000_000, "lidar", ground_cloud()))
    peer.spin(0.8)
    assert not [s for s in peer.stamps("/predicted/path") if s == newest - 900_000_000]
    healthy(peer, predictor)


def test_a_fault_is_logged_once(predictor):
    lines = [line for line in predictor.output.splitlines() if "none of its 500 points" in line]
    assert len(lines) == 1


def test_ends_cleanly_on_an_interrupt(predictor):
    assert predictor.stop(signal.SIGINT) == 0
    assert "Traceback" not in predictor.output


@pytest.mark.unhurried_nodes
def test_a_termination_ends_it_cleanly_too(start):
    process = start("predictor", "--ros-args", "-p", "terrain_source:=flat")
    process.wait_for("with terrain from flat")
    assert process.stop(signal.SIGTERM) == 0


@pytest.mark.unhurried_nodes
@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (["robot:=huskey"], "there is no robot named 'huskey'"),
        (["terrain_source:=camera", "checkpoint:=/nowhere/encoder.safetensors"], "encoder.safetensors does not exist"),
        (["terrain_source:=sonar"], "parameter terrain_source: got 'sonar', expected one of"),
        (["horizon:=-1.0"], "horizon"),
    ],
)
def test_a_node_that_cannot_start_names_the_reason(start, parameters, message):
    arguments = [word for parameter in parameters for word in ("-p", parameter)]
    process = start("predictor", "--ros-args", *arguments)
    assert process.wait() == 1
    assert message in process.output and "Traceback" not in process.output


def test_the_live_gap_is_small_for_good_predictions_and_recommends_diagnose_otherwise(peer, start):
    predictor = start("predictor", "--ros-args", "-p", "data_timeout:=1.0", "-r", "__node:=watcher")
    predictor.wait_for("predicting 5 s ahead for husky")

    def gap() -> tuple[int, str, dict]:
        for array in reversed(peer.received["/diagnostics"]):
            for status in array.status:
                if status.name == "watcher: live gap":
                    values = {entry.key: entry.value for entry in status.values}
                    return int.from_bytes(status.level, "little"), status.message, values
        return -1, "", {}

    peer.clear()
    peer.drive(5.0, speed=0.0)
    # The first comparison takes five seconds from the first prediction; on a busy machine that may come late.
    for _ in range(30):
        if gap()[0] == OK:
            break
        peer.drive(0.5, speed=0.0)
    assert gap()[0] == OK, (gap(), predictor.output[-2000:])
    first = next(
        status
        for array in peer.received["/diagnostics"]
        for status in array.status
        if status.name == "watcher: live gap" and status.level == bytes([OK])
    )
    assert "compared predictions" in {entry.key for entry in first.values}, "a state was published without its values"
    # A busy machine may leave a hole in the odometry where the first comparisons look.
    for _ in range(4):
        if "median error at 5 s [m]" not in gap()[2]:
            peer.drive(1.0, speed=0.0)
    assert float(gap()[2]["median error at 5 s [m]"]) < 0.05
    # The robot does not move although it is commanded to: it is stuck at a kerb that is not modelled.
    for _ in range(14):
        if gap()[0] == WARN:
            break
        peer.drive(1.0, speed=0.5)
    assert peer.until(lambda: gap()[0] == WARN, 5.0), (gap(), predictor.output[-2000:])
    assert "off after 2 s" in gap()[1] and "run `diagnose`" in gap()[1]
    predictor.stop()
