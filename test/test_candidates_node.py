"""Candidates of the installed node: markers, cost table, best path and occupancy grid, with a wall in the way."""

import numpy as np
import pytest
from predictor_peer import ground_cloud, stamp_in
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from monoforce_ros.bags import builders
from monoforce_ros.messages.message_types import message_class
from monoforce_ros.prediction.ensemble import EnsembleSettings

TOPICS = {
    "/predicted/candidates": "visualization_msgs/msg/MarkerArray",
    "/predicted/candidate_costs": "sensor_msgs/msg/PointCloud2",
    "/predicted/best_path": "nav_msgs/msg/Path",
    "/predicted/occupancy": "nav_msgs/msg/OccupancyGrid",
}
COUNT = 15


@pytest.fixture(scope="module")
def predictor(start, peer):
    process = start(
        "predictor", "--ros-args", "-p", f"candidates:={COUNT}", "-p", "candidate_speeds:=[0.8]", "-p", "horizon:=3.0",
        "-p", "weight_effort:=0.0", "-p", "candidate_yaw_rate:=1.0",
    )  # fmt: skip
    process.wait_for("predicting 3 s ahead for husky")
    return process


@pytest.fixture(scope="module")
def heard(peer, predictor):
    received: dict[str, list] = {topic: [] for topic in TOPICS}
    for topic, name in TOPICS.items():
        kind = message_class(name)
        peer.node.create_subscription(
            kind,
            topic,
            lambda data, topic=topic, kind=kind: received[topic].append(deserialize_message(data, kind)),
            QoSProfile(depth=10),
            raw=True,
        )
    return received


def walled(stamp: int):
    """Level ground with a wall straight ahead, 2 m away and 1.2 m wide."""
    across, up = np.meshgrid(np.arange(-0.6, 0.6, 0.04), np.arange(0.0, 1.2, 0.04))
    front = np.stack([np.full(across.size, 2.0), across.ravel(), -0.1323 - 0.65 + up.ravel()], axis=1)
    top = np.stack([np.tile(np.arange(2.0, 2.5, 0.04), 30), np.repeat(np.arange(-0.6, 0.6, 0.04), 13)], axis=1)
    top = np.column_stack([top, np.full(len(top), -0.1323 - 0.65 + 1.2)])
    ground = ground_cloud()
    open_ground = ground[(ground[:, 0] < 1.9) | (np.abs(ground[:, 1]) > 0.6) | (ground[:, 0] > 2.6)]
    return builders.point_cloud(stamp, "lidar", np.concatenate([open_ground, front, top]).astype(np.float32))


def table(message) -> tuple[list[str], np.ndarray]:
    names = [field.name for field in message.fields]
    return names, np.frombuffer(bytes(message.data), "<f4").reshape(message.width, len(names))


def feed(peer, heard, **world) -> None:
    """Drive until each output for this world has arrived twice; outputs for the previous world are dropped."""
    begin = peer.now
    for messages in heard.values():
        messages.clear()

    def enough() -> bool:
        for messages in heard.values():
            messages[:] = [message for message in messages if stamp_in(message) >= begin]
        return all(len(messages) >= 2 for messages in heard.values())

    for _ in range(8):
        peer.drive(0.8, **world)
        if peer.until(enough, 1.0):
            return
    pytest.fail(f"no candidates: { {topic: len(m) for topic, m in heard.items()} }")


def test_every_candidate_has_its_path_and_its_costs(peer, predictor, heard):
    feed(peer, heard)
    names, values = table(heard["/predicted/candidate_costs"][-1])
    assert names[:8] == ["x", "y", "z", "heading", "speed", "yaw_rate", "cost", "feasible"] and "collision" in names
    column = {name: values[:, i] for i, name in enumerate(names)}
    assert len(values) == COUNT and (column["speed"][:-1] == np.float32(0.8)).all()
    assert column["speed"][-1] == column["yaw_rate"][-1] == 0.0
    # The robot stands at (1, 2): arcs to the right end there, to the left there, and stopping ends where it is.
    assert column["y"][0] < 1.5 and column["y"][COUNT - 2] > 2.5 and column["heading"][0] < -0.5
    # The current command, 0.5 m/s, holds until the candidates start: after `candidate_delay`, 0.2 s, or as late as
    # this computer publishes them.
    assert 0.2 <= column["start"][0] <= 1.0 and (column["start"] == column["start"][0]).all()
    assert abs(column["x"][-1] - 1.0 - 0.5 * column["start"][0]) < 0.05 and abs(column["y"][-1] - 2.0) < 0.02
    np.testing.assert_allclose(
        column["x_50"][COUNT // 2 - 1], 1.0 + 0.5 * (column["x"][COUNT // 2 - 1] - 1.0), atol=0.15
    )
    # On level ground everything can be driven; the terms add up to the cost by their weights.
    assert column["feasible"].all()
    weights = {"roll": 1.0, "pitch": 1.0, "force_variation": 0.5, "wheel_load": 1.0, "slip": 1.0, "effort": 0.0,
               "unobserved": 1.0, "collision": 3.0, "obstacle_clearance": 1.0}  # fmt: skip
    total = sum(weight * values[:, names.index(name)] for name, weight in weights.items())
    np.testing.assert_allclose(column["cost"], total, rtol=1e-4)
    markers = {m.ns: m for m in heard["/predicted/candidates"][-1].markers}
    assert set(markers) == {"candidates", "best_candidate"}
    assert len(markers["candidates"].points) == COUNT * 30 * 2
    first = markers["candidates"].points[0]
    np.testing.assert_allclose([first.x, first.y, first.z], [1.0, 2.0, 0.3], atol=1e-3)
    path = heard["/predicted/best_path"][-1]
    assert path.header.frame_id == "odom" and len(path.poses) == 31
    status = peer.status("prediction")
    assert status is not None and status[1] == "predicting"


def test_a_wall_is_not_driven_into(peer, predictor, heard):
    feed(peer, heard, cloud=walled, speed=0.0)
    names, values = table(heard["/predicted/candidate_costs"][-1])
    feasible, collision = values[:, names.index("feasible")] > 0, values[:, names.index("collision")]
    straight = int(np.abs(values[:-1, names.index("yaw_rate")]).argmin())
    assert not feasible[straight] and collision[straight] > 1.0
    assert feasible[0] and feasible[COUNT - 2], "the outermost arcs pass the wall"
    ends = [message.poses[-1].pose.position for message in heard["/predicted/best_path"]]
    # Standing, the last candidate, costs least, but the best one moves.
    cost = values[:, names.index("cost")]
    assert cost[-1] == cost.min() and all(np.hypot(p.x - 1.0, p.y - 2.0) > 1.0 for p in ends)
    # The robot stands at (1, 2): no best path ends in the wall or beyond it straight ahead.
    assert all(not (p.x > 2.6 and abs(p.y - 2.0) < 0.6) for p in ends)


def test_the_occupancy_grid_shows_the_wall_where_it_is(peer, predictor, heard):
    feed(peer, heard, cloud=walled, speed=0.0)
    grid = heard["/predicted/occupancy"][-1]
    data = np.array(grid.data, np.int8).reshape(grid.info.height, grid.info.width)
    assert grid.header.frame_id == "odom" and grid.info.resolution == pytest.approx(0.1)

    def at(x: float, y: float) -> int:
        column = int((x - grid.info.origin.position.x) / grid.info.resolution)
        row = int((y - grid.info.origin.position.y) / grid.info.resolution)
        return int(data[row, column])

    assert at(3.05, 2.0) == 100
    assert 0 <= at(1.0 + 1.2, 2.0) < 50 and 0 <= at(1.0, 2.0 + 2.0) < 50
    assert data.min() == -1


def test_candidates_of_a_planner_are_compared_and_refined(peer, start):
    """Sequences of two commands over a topic; with the best refined as one more; everything in one typed message."""
    typed = message_class("monoforce_msgs/msg/Candidates")
    process = start(
        "predictor", "--ros-args", "-r", "__node:=requested", "-p", "candidate_topic:=planned", "-p", "horizon:=2.0",
        "-p", "candidate_delay:=0.8",
        "-p", "refine_seconds:=0.8", "-p", "rate:=1.0", "-p", "ensemble:=8",
        "-r", "predicted/candidate_costs:=requested_costs", "-r", "predicted/candidate_rollouts:=requested_rollouts",
    )  # fmt: skip
    process.wait_for("predicting 2 s ahead for husky")
    costs, rollouts, spreads, starts = [], [], [], {}
    cloud = message_class("sensor_msgs/msg/PointCloud2")

    def on_costs(message) -> None:
        costs.append(message)
        names, values = table(message)
        starts[stamp_in(message)] = float(values[0, names.index("start")])

    peer.node.create_subscription(cloud, "/requested_costs", on_costs, QoSProfile(depth=10))
    peer.node.create_subscription(cloud, "/predicted/path_spread", spreads.append, QoSProfile(depth=10))
    if typed is not None:
        peer.node.create_subscription(typed, "/requested_rollouts", rollouts.append, QoSProfile(depth=10))
    sequences = np.array([[[0.6, 0.3], [0.6, -0.3]], [[0.4, 0.0], [0.8, 0.0]], [[0.0, 0.0], [0.0, 0.0]]])
    array = message_class("std_msgs/msg/Float32MultiArray")()
    dimension = message_class("std_msgs/msg/MultiArrayDimension")
    array.layout.dim = [dimension(label=label, size=size) for label, size in zip("nkc", sequences.shape, strict=True)]
    array.data = sequences.ravel().tolist()
    planner = peer.node.create_publisher(type(array), "/planned", 1)

    def feed(message) -> None:
        # Comparison runs in the background: on a busy machine it comes late.
        for _ in range(40):
            planner.publish(message)
            peer.drive(0.5)
            if costs and spreads and (rollouts or typed is None):
                return
        pytest.fail(process.output[-2000:])

    feed(array)
    names, values = table(costs[-1])
    assert len(values) == 4, "three candidates and the refined one"
    np.testing.assert_allclose(values[:3, names.index("speed")], sequences[:, 0, 0], atol=1e-6)
    # The best one that moves is refined, not the one that stands.
    feasible = values[:2, names.index("feasible")] > 0
    best = values[:2, names.index("cost")][feasible].min()
    assert values[3, names.index("cost")] <= best + 1e-3 and values[3, names.index("speed")] > 0.1
    names, values = table(spreads[-1])
    assert {"time", "along", "across", "heading", "radius_90"} <= set(names) and len(values) > 10
    radius = values[:, names.index("radius_90")]
    # At the start the band is as wide as odometry jumps.
    settings = EnsembleSettings()
    jumps = settings.scale * settings.position * np.sqrt(2 * np.log(10))
    assert radius[0] == pytest.approx(jumps, rel=0.02) and np.isfinite(radius).all()
    # Wrong dimensions are refused with a reason; the previous candidates are used until they expire.
    wrong = type(array)()
    wrong.layout.dim = [dimension(label="n", size=3)]
    wrong.data = [0.0] * 3
    peer.clear()
    planner.publish(wrong)

    def said() -> list[str]:
        statuses = [status for array in peer.received["/diagnostics"] for status in array.status]
        return [status.message for status in statuses if status.name == "requested: candidates"]

    assert peer.until(lambda: any("dimensions [3]" in text for text in said()), 10.0), said()
    costs.clear()
    peer.drive(5.0)
    assert any("no candidates for" in text for text in said()), said()
    assert process.stop() == 0
    if typed is None:
        pytest.skip("monoforce_msgs is not built: its message was not looked at")
    message = rollouts[-1]
    count, samples = message.count, len(message.times)
    assert count == 4 and samples == 21 and message.robot == "husky" and message.header.frame_id == "odom"
    states = np.array(message.states).reshape(count, samples, 7)
    commands = np.array(message.commands).reshape(count, samples, 2)
    np.testing.assert_allclose(states[:, 0, :3], [[1.0, 2.0, 0.3]] * 4, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(states[..., 3:], axis=-1), 1.0, atol=1e-5)
    # Samples are 0.1 s apart. The last command holds until the candidates start, for longer than `command_timeout`:
    # after `candidate_delay`, or as late as they are published, but with half the horizon left. They share the rest.
    start_time = starts[stamp_in(message)]
    assert 0.8 - 1e-6 <= start_time <= 1.0
    held, first = commands[0, 0], int(np.ceil(start_time / 0.1 - 1e-6))
    middle = int(np.ceil((first + 20) / 2))
    np.testing.assert_allclose(commands[:, :first], np.broadcast_to(held, (count, first, 2)), atol=1e-6)
    assert abs(held[0] - sequences[0, 0, 0]) > 0.01 or abs(held[1] - sequences[0, 0, 1]) > 0.01
    shared = commands[0, [first, middle - 1, middle + 1, 20]]
    np.testing.assert_allclose(shared, sequences[0][[0, 0, 1, 1]], atol=1e-6)
    # The robot's weight rests on its drives, in every candidate and at every time after the start.
    loads = np.array(message.loads).reshape(count, samples, len(message.drives))
    forces = np.array(message.forces).reshape(count, samples, 3)
    assert list(message.drives)[-1] == "hull"
    np.testing.assert_allclose(forces[2, 5:, 2], 50 * 9.81, rtol=0.05)
    np.testing.assert_allclose(loads[2, 5:].sum(axis=1), 50 * 9.81, rtol=0.05)
    velocities = np.array(message.velocities).reshape(count, samples, 6)
    np.testing.assert_allclose(velocities[1, middle - 1, 0], 0.4, atol=0.05)
    terms = np.array(message.terms).reshape(count, len(message.term_names))
    assert "roll" in message.term_names and np.isfinite(terms).all() and len(message.costs) == count
    costs_moving = np.where(message.feasible, message.costs, np.inf)
    costs_moving[2] = np.inf
    assert message.best == int(np.argmin(costs_moving))


def test_candidates_that_come_too_late_are_reported(peer, start):
    """A bag played ten times as fast asks ten times as much of the computer; path_selector would stop the robot."""
    names = ("-r", "__ns:=/late", "-p", "odometry_topic:=/late/odom", "-p", "command_topic:=/late/cmd_vel")
    sizes = ("-p", "candidates:=400", "-p", "horizon:=5.0", "-p", "terrain_source:=flat")
    process = start("predictor", "--ros-args", *names, *sizes)
    process.wait_for("predicting 5 s ahead")

    def status() -> tuple[int, str]:
        for array in reversed(peer.received["/diagnostics"]):
            for entry in array.status:
                if entry.name == "late/predictor: comparison":
                    return int.from_bytes(entry.level, "little"), entry.message
        return -1, ""

    def live(pace: int, until) -> bool:
        for _ in range(400):
            peer.now += pace * 50_000_000
            message = builders.odometry(peer.now, "odom", "base_link", [1.0, 2.0, 0.3], [0, 0, 0, 1], [0] * 3, [0] * 3)
            peer.publish("/late/odom", message)
            peer.spin(0.05)
            if until():
                return True
        return False

    assert live(20, lambda: status()[0] == 1 and "behind the odometry: this computer is too slow" in status()[1]), (
        status()
    )
    assert process.stop() == 0
