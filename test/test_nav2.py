"""What Nav2 makes of the installed node's messages, by its static layer's and speed filter's rules and docs/nav2.md."""

import re

import numpy as np
import pytest
import yaml
from conftest import ROOT
from nav2_costmap import FREE, LETHAL, UNKNOWN, StaticLayer, layer_quality, speed_limit
from nav_msgs.msg import OccupancyGrid
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from test_candidates_node import walled

from monoforce_ros.bags import builders
from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.discrepancy.ros_export import nav2_text
from monoforce_ros.messages import encoding, message_class
from monoforce_ros.nodes.schema import read_schema, schema_path
from monoforce_ros.planning import AlignedGrid, Occupancy, speed_mask
from monoforce_ros.robots import load_robot

GRID_MAP, FILTER_INFO = "grid_map_msgs/msg/GridMap", "nav2_msgs/msg/CostmapFilterInfo"
BLOCKS = [
    yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", (ROOT / "docs/nav2.md").read_text(), re.S)
]
COSTMAP = BLOCKS[0]["local_costmap"]["local_costmap"]["ros__parameters"]
LAYER = COSTMAP["terrain_layer"]


class Layer:
    """A subscriber with the static layer's quality of service, and the layer behind it."""

    def __init__(self, peer, topic: str, **settings):
        self.layer, self.messages = StaticLayer(**settings), []
        quality = layer_quality(LAYER["map_subscribe_transient_local"])
        self.subscription = peer.node.create_subscription(OccupancyGrid, topic, self._take, quality)

    def _take(self, message) -> None:
        self.messages.append(message)
        self.layer.take(message)


def documented(rolling=COSTMAP["rolling_window"], trinary=COSTMAP["trinary_costmap"]) -> dict:
    return {
        "rolling": rolling, "trinary": trinary, "lethal_threshold": COSTMAP["lethal_cost_threshold"],
        "unknown_value": COSTMAP["unknown_cost_value"], "track_unknown": COSTMAP["track_unknown_space"],
    }  # fmt: skip


@pytest.fixture(scope="module")
def predictor(start, peer):
    """Without candidates: the grids are made for whoever subscribes."""
    process = start("predictor", "--ros-args", "-p", "horizon:=1.0")
    process.wait_for("predicting 1 s ahead for husky")
    return process


def drive(peer, condition, *, heading=0.0, place=(1.0, 2.0), **world) -> None:
    """Feed a world with the robot at a place and heading until a condition holds."""
    turn = Rotation.from_euler("z", heading).as_quat()

    def odometry(stamp):
        return builders.odometry(stamp, "odom", "base_link", [*place, 0.3], turn, [0] * 3, [0] * 3)

    for _ in range(12):
        peer.drive(0.8, odometry=odometry, speed=0.0, **world)
        if peer.until(condition, 0.5):
            return
    pytest.fail("the condition did not come true")


def test_the_static_layer_receives_grids_of_one_size_on_one_lattice(peer, predictor):
    layer, resized = (
        Layer(peer, LAYER["map_topic"], **documented()),
        Layer(peer, LAYER["map_topic"], **documented(False)),
    )
    shapes, origins = set(), set()
    for heading, place in ((0.0, (1.0, 2.0)), (0.4, (1.03, 2.0)), (0.8, (1.33, 1.91)), (2.4, (-3.07, 0.55))):
        layer.messages.clear()
        # The first message may still be that of the last pose.
        drive(peer, lambda: len(layer.messages) >= 3, heading=heading, place=place)
        info = layer.messages[-1].info
        shapes.add((info.width, info.height, round(info.resolution, 6)))
        origins.add((info.origin.position.x, info.origin.position.y))
        centre = np.array([info.origin.position.x, info.origin.position.y]) + 0.5 * info.width * info.resolution
        assert np.abs(centre - place).max() <= info.resolution, "the grid follows the robot"
    # The first two places lie in one cell.
    assert len(shapes) == 1 and len(origins) == 3
    cells = np.array(sorted(origins)) / layer.messages[-1].info.resolution
    np.testing.assert_allclose(cells, np.rint(cells), atol=1e-4)
    assert not layer.layer.resized and not resized.layer.misaligned
    assert len(resized.layer.resized) >= 3, "a costmap that does not roll is resized, as the page says"
    assert layer.layer.frame == COSTMAP["global_frame"]


def test_a_late_subscriber_gets_the_last_grid(peer, predictor):
    first = Layer(peer, LAYER["map_topic"], **documented())
    drive(peer, lambda: len(first.messages) >= 1)
    peer.settle()
    late = Layer(peer, LAYER["map_topic"], **documented())
    assert peer.until(lambda: len(late.messages) == 1, 10.0), "nothing is kept for who comes later"


def test_costs_stay_graded_and_the_wall_is_lethal_in_the_local_costmap(peer, predictor):
    layer = Layer(peer, LAYER["map_topic"], **documented())
    drive(peer, lambda: len(layer.messages) >= 3, cloud=walled)
    size, resolution, centre = COSTMAP["width"], COSTMAP["resolution"], np.array([1.0, 2.0])
    costs = layer.layer.window(centre, size, resolution, COSTMAP["global_frame"])
    low = np.floor((centre - size / 2) / resolution) * resolution

    def at(x: float, y: float) -> int:
        column, row = ((np.array([x, y]) - low) / resolution).astype(int)
        return int(costs[row, column])

    # The wall is 2 m ahead of the robot at (1, 2).
    assert at(3.05, 2.0) == LETHAL and at(2.0, 2.0) < 100 and at(1.0, 4.5) < 100
    graded = costs[(costs > FREE) & (costs < LETHAL)]
    assert len(graded) > 20, "grading is lost"
    assert (costs != UNKNOWN).mean() > 0.7
    trinary = StaticLayer(**documented(trinary=True))
    trinary.take(layer.messages[-1])
    assert set(np.unique(trinary.costs)) <= {FREE, LETHAL, UNKNOWN}


def test_the_largest_graded_cost_is_not_read_as_inscribed():
    data = np.array([[0, 50, 98, 100, -1]], np.int8)
    message = deserialize_message(encoding.occupancy_grid(1, "odom", 0.1, (0.0, 0.0, 0.0), data), OccupancyGrid)
    layer = StaticLayer(**documented())
    layer.take(message)
    assert layer.costs.tolist() == [[FREE, 127, 248, LETHAL, UNKNOWN]]


@pytest.mark.skipif(message_class(FILTER_INFO) is None, reason="nav2_msgs is not installed")
def test_the_speed_filter_reads_the_mask(peer, predictor):
    infos = []
    quality = layer_quality(True)
    info_topic = COSTMAP["speed_filter"]["filter_info_topic"]
    peer.node.create_subscription(message_class(FILTER_INFO), info_topic, infos.append, quality)
    assert peer.until(lambda: len(infos) == 1, 10.0)
    masks = []
    peer.node.create_subscription(OccupancyGrid, infos[0].filter_mask_topic, masks.append, quality)
    drive(peer, lambda: len(masks) >= 2, cloud=walled)
    assert masks[-1].header.frame_id == "odom"
    assert speed_limit(infos[0], masks[-1], np.array([3.05, 2.0])) == 20.0
    open_ground = speed_limit(infos[0], masks[-1], np.array([2.0, 3.5]))
    assert open_ground == 0.0 or open_ground > 60.0
    assert min(masks[-1].data) >= 0


@pytest.mark.skipif(message_class(GRID_MAP) is None, reason="grid_map_msgs is not installed")
def test_the_grid_map_holds_every_layer_where_grid_map_looks_for_it(peer, predictor):
    maps = []
    peer.node.create_subscription(message_class(GRID_MAP), "/predicted/grid_map", maps.append, layer_quality(True))
    drive(peer, lambda: len(maps) >= 3, cloud=walled, heading=0.3)
    message = maps[-1]
    assert list(message.layers) == [
        "height", "geometric_height", "stiffness", "damping", "friction", "observed", "cost",
    ]  # fmt: skip
    assert list(message.basic_layers) == ["height"] and message.header.frame_id == "odom"
    centre = np.array([message.info.pose.position.x, message.info.pose.position.y])
    length, resolution = np.array([message.info.length_x, message.info.length_y]), message.info.resolution

    def at(layer: str, x: float, y: float) -> float:
        # grid_map: index 0 has the largest coordinate; arrays are column-major.
        array = message.data[list(message.layers).index(layer)]
        assert [d.label for d in array.layout.dim] == ["column_index", "row_index"]
        columns, rows = array.layout.dim[0].size, array.layout.dim[1].size
        assert array.layout.dim[0].stride == rows * columns == len(array.data) and array.layout.dim[1].stride == rows
        row, column = ((centre + length / 2 - [x, y]) / resolution).astype(int)
        return float(np.asarray(array.data).reshape(rows, columns, order="F")[row, column])

    # The wall is 2 m ahead of a robot at (1, 2) with a heading of 0.3; the ground is 0.13 m below base_link at 0.3 m.
    ahead = np.array([np.cos(0.3), np.sin(0.3)])
    wall = np.array([1.0, 2.0]) + 2.2 * ahead
    assert at("height", *wall) > 1.0 and at("cost", *(np.array([1.0, 2.0]) + 2.05 * ahead)) == 100.0
    # Beside the wall, mirrored at the robot and mirrored in either axis, there is level ground.
    for place in ((1.0, 2.0) - 2.2 * ahead, (1.0, 2.0) + 2.2 * ahead[::-1], (1.0, 2.0) + 2.2 * ahead * [1, -1]):
        assert at("height", *place) == pytest.approx(0.3 - 0.1323, abs=0.05)
    assert at("friction", *wall) == pytest.approx(0.8) and np.isnan(at("height", *(centre + 0.49 * length)))


def test_the_footprint_on_the_page_is_the_robot_s():
    corners = np.array(yaml.safe_load(COSTMAP["footprint"]))
    robot = yaml.safe_load((ROOT / "config/robots/husky.yaml").read_text())
    length = max(part["size"][0] / 2 for part in robot["hull"])
    width = max(wheel["centre"][1] + wheel["width"] / 2 for wheel in robot["wheels"])
    np.testing.assert_allclose(corners.max(axis=0), [length, width], atol=0.02)
    np.testing.assert_allclose(corners.min(axis=0), [-length, -width], atol=0.02)


def test_the_controller_on_the_page_is_complete():
    """MPPI without critics weighs nothing; what diagnose exports must fit under the same names."""
    (server,) = (block["controller_server"]["ros__parameters"] for block in BLOCKS if "controller_server" in block)
    controller = server[server["controller_plugins"][0]]
    assert {"CostCritic", "PathFollowCritic", "GoalCritic"} <= set(controller["critics"])
    assert controller["model_dt"] == pytest.approx(1.0 / server["controller_frequency"])
    effects = {}
    for name, values in {"actuator_saturation": {"limit": 0.7}, "friction_scale": {"factor": 0.6}}.items():
        parameters = {key: ParameterEstimate(value, value, value, "-") for key, value in values.items()}
        effects[name] = EffectEstimate(name, parameters)
    exported = yaml.safe_load(nav2_text(load_robot("husky"), effects)[0])["controller_server"]["ros__parameters"]
    assert set(exported["FollowPath"]) <= set(controller)


def test_the_page_names_parameters_that_exist():
    for block in BLOCKS:
        for node in set(block) & {"predictor", "path_selector"}:
            known = {entry.name: entry for entry in read_schema(schema_path(node))}
            for name, value in block[node]["ros__parameters"].items():
                known[name].checked(value)
    assert any("path_selector" in block for block in BLOCKS)


def test_the_speed_mask_limits_unknown_ground_but_not_the_robot_s_blind_spot():
    cells = 60
    grid = AlignedGrid(0.1, (-3.0, -3.0), 0.0, *(np.zeros((cells, cells), int),) * 2, np.ones((cells, cells), bool))
    x, y = np.meshgrid(*(np.linspace(-2.95, 2.95, cells),) * 2)
    data = np.where(x > 0.5, 50, 0).astype(np.int8)
    data[np.hypot(x, y) < 0.8] = -1
    data[y > 1.0] = -1
    mask = speed_mask(Occupancy(grid, data))
    # Below the robot the limit is that of the ground beside it, and unknown ground far from known one is slow.
    assert mask[30, 28] == 0 and mask[30, 36] == 60
    assert mask[-1, 10] == 20 and (mask[data == 50] == 60).all() and (mask[data == 0] == 0).all()
    nothing = speed_mask(Occupancy(grid, np.full_like(data, -1)))
    assert (nothing == 20).all()
