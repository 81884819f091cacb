"""Candidates through the installed node: markers, table of costs, best path and occupancy, with a wall in the way."""

import numpy as np
import pytest
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from ros_peer import ground_cloud

from monoforce_ros.bags import builders
from monoforce_ros.messages.message_types import message_class

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
        "-p", "weight_effort:=0.0",
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


def feed(peer, heard, cloud=None) -> None:
    for messages in heard.values():
        messages.clear()
    for _ in range(8):
        peer.drive(0.8, cloud=cloud)
        if all(heard.values()) and peer.until(lambda: all(len(m) >= 2 for m in heard.values()), 1.0):
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
    assert abs(column["x"][-1] - 1.0) < 0.02 and abs(column["y"][-1] - 2.0) < 0.02
    np.testing.assert_allclose(
        column["x_50"][COUNT // 2 - 1], 1.0 + 0.5 * (column["x"][COUNT // 2 - 1] - 1.0), atol=0.15
    )
    # On level ground everything can be driven; the terms add up to the cost by their weights.
    assert column["feasible"].all()
    weights = {"roll": 1.0, "pitch": 1.0, "force_variation": 0.5, "wheel_load": 1.0, "slip": 1.0, "effort": 0.0,
               "unobserved": 1.0, "collision": 3.0}  # fmt: skip
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
    feed(peer, heard, walled)
    names, values = table(heard["/predicted/candidate_costs"][-1])
    feasible, collision = values[:, names.index("feasible")] > 0, values[:, names.index("collision")]
    straight = int(np.abs(values[:-1, names.index("yaw_rate")]).argmin())
    assert not feasible[straight] and collision[straight] > 1.0
    assert feasible[0] and feasible[COUNT - 2], "the outermost arcs pass the wall"
    ends = [message.poses[-1].pose.position for message in heard["/predicted/best_path"]]
    # The robot stands at (1, 2): no best path ends in the wall or beyond it straight ahead.
    assert all(not (p.x > 2.6 and abs(p.y - 2.0) < 0.6) for p in ends)


def test_the_occupancy_grid_shows_the_wall_where_it_is(peer, predictor, heard):
    feed(peer, heard, walled)
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
