"""Layouts of RViz and Foxglove show the outputs of the nodes, with matching names, types and durability."""

import json
import re
from dataclasses import replace

import numpy as np
import torch
import yaml
from conftest import ROOT
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2, PointField

from monoforce_ros.core import MotionState
from monoforce_ros.nodes.prediction_messages import terrain_cloud
from monoforce_ros.nodes.schema import read_schema
from monoforce_ros.prediction import Prediction
from monoforce_ros.terrain import Grid, TerrainMap

# Display of RViz: type of the messages that it draws.
RVIZ = {
    "rviz_default_plugins/PointCloud2": "PointCloud2",
    "rviz_default_plugins/GridCells": "GridCells",
    "rviz_default_plugins/Map": "OccupancyGrid",
    "rviz_default_plugins/MarkerArray": "MarkerArray",
    "rviz_default_plugins/Path": "Path",
    "rviz_default_plugins/Odometry": "Odometry",
}
# What Foxglove's 3D panel draws of the nodes' types: no GridCells.
FOXGLOVE = {"PointCloud2", "OccupancyGrid", "MarkerArray", "Path", "Odometry"}
# Tables of numbers, and messages for other programs, are not for a 3D view.
NOT_DRAWN = {
    "candidate_costs",
    "candidate_rollouts",
    "path_spread",
    "live_gap",
    "speed_filter_info",
    "grid_map",
    "flipper_angles",
}


def published() -> dict[str, tuple[str, bool]]:
    """Topic → type, whether it is latched, of every predicted output in the code of the nodes."""
    found = {}
    for file in (ROOT / "monoforce_ros" / "nodes").glob("*.py"):
        for kind, topic, quality in re.findall(
            r"create_publisher\((\w+), \"(predicted/\w+)\", (\w+)\)", file.read_text()
        ):
            found[f"/{topic}"] = (kind, quality == "latched")
    return found


def inputs() -> dict[str, str]:
    """Topics that the nodes read by default, with their types."""
    defaults = {entry.name: entry.default for entry in read_schema(ROOT / "config" / "predictor.schema.yaml")}
    return {f"/{defaults['odometry_topic']}": "Odometry", f"/{defaults['cloud_topic']}": "PointCloud2"}


def rviz() -> dict:
    return yaml.safe_load((ROOT / "config" / "rviz" / "predictor.rviz").read_text())["Visualization Manager"]


def absolute(topic: str) -> str:
    """A topic of RViz's layout as it is without a namespace."""
    return f"/{topic}"


def foxglove() -> dict:
    return json.loads((ROOT / "config" / "foxglove" / "predictor.json").read_text())


def goal_topic() -> str:
    parameters = read_schema(ROOT / "config" / "path_selector.schema.yaml")
    return next(f"/{entry.default}" for entry in parameters if entry.name == "goal_topic")


def test_rviz_shows_every_output_with_its_type():
    displays = [d for d in rviz()["Displays"] if "Topic" in d]
    shown = {absolute(display["Topic"]["Value"]): RVIZ[display["Class"]] for display in displays}
    outputs = {topic: kind for topic, (kind, _) in published().items()}
    known = outputs | inputs()
    assert shown == {topic: known.get(topic) for topic in shown}
    assert len(outputs) > 8
    assert set(outputs) - set(shown) == {f"/predicted/{name}" for name in NOT_DRAWN} & set(outputs)


def test_rviz_gets_the_last_message_of_latched_topics():
    outputs = published()
    for display in rviz()["Displays"]:
        topic = absolute(display.get("Topic", {}).get("Value", ""))
        if topic in outputs:
            latched = display["Topic"]["Durability Policy"] == "Transient Local"
            assert latched == outputs[topic][1], topic


def test_rviz_receives_best_effort_inputs():
    shown = {absolute(d["Topic"]["Value"]): d["Topic"] for d in rviz()["Displays"] if "Topic" in d}
    assert {shown[topic]["Reliability Policy"] for topic in inputs()} == {"Best Effort"}


def test_rviz_shows_a_robot_in_the_namespace_that_it_is_started_in():
    named = [entry["Topic"]["Value"] for entry in [*rviz()["Displays"], *rviz()["Tools"]] if "Topic" in entry]
    assert len(named) > 10 and not [topic for topic in named if topic.startswith("/")]


FIELDS = {"RGB8": "rgba", "AxisColor": "z"}
"""What a transformer of RViz reads."""


def terrain_message(spread):
    """A map of the node as a message, whose expected errors grow along x up to ``spread`` [m]."""
    terrain = TerrainMap.flat(Grid.square(6.4, 0.1))
    if spread:
        errors = torch.linspace(0.0, spread, terrain.grid.columns).expand(terrain.grid.rows, -1)
        terrain = replace(terrain, geometric_spread=errors, decrease_spread=0.0 * errors)
    still = MotionState(1, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    cloud = deserialize_message(terrain_cloud(Prediction(still, terrain, None), "odom"), PointCloud2)
    layout = {f.name: ("<u4" if f.datatype == PointField.UINT32 else "<f4", f.offset) for f in cloud.fields}
    kinds, offsets = zip(*layout.values(), strict=True)
    record = np.dtype(
        {"names": list(layout), "formats": list(kinds), "offsets": list(offsets), "itemsize": cloud.point_step}
    )
    return cloud, np.frombuffer(bytes(cloud.data), record)


def test_rviz_colours_terrain_by_fields_that_its_message_has():
    displays = [d for d in rviz()["Displays"] if d.get("Topic", {}).get("Value") == "predicted/terrain"]
    fields = {field.name: field.datatype for field in terrain_message(0.5)[0].fields}
    read = [FIELDS.get(d["Color Transformer"]) or d["Channel Name"] for d in displays]
    assert len(read) >= 2 and set(read) <= fields.keys()
    # By default cells fade: RViz takes the opacity of each point of a field rgba, not of one named rgb.
    assert [FIELDS.get(d["Color Transformer"]) for d in displays if d["Enabled"]] == ["rgba"]
    assert fields["rgba"] == PointField.UINT32 and "rgb" not in fields


def test_cells_fade_with_their_expected_error():
    cloud, values = terrain_message(1.0)
    opacity = (values["rgba"] >> 24).reshape(64, 64)[0] / 255
    assert opacity[0] > 0.98 and (np.diff(opacity) <= 0.0).all() and opacity[-1] == opacity[40] < 0.2
    assert 0.45 < opacity[16] < 0.7
    colour = values["rgba"] & 0xFFFFFF
    assert (colour == colour[0]).all() and cloud.is_dense
    # Readers that take all fields for float32 see numbers.
    assert np.isfinite(np.frombuffer(bytes(cloud.data), "<f4")).all()
    # Without errors all that is measured is opaque.
    assert ((terrain_message(0.0)[1]["rgba"] >> 24) > 250).all()


def test_goals_of_both_layouts_reach_path_selector():
    (tool,) = [t for t in rviz()["Tools"] if t["Class"] == "rviz_default_plugins/SetGoal"]
    assert absolute(tool["Topic"]["Value"]) == goal_topic()
    publish = foxglove()["configById"]["3D!predictor"]["publish"]
    assert (publish["type"], publish["poseTopic"]) == ("pose", goal_topic())


def test_foxglove_shows_topics_that_exist_and_that_it_can_draw():
    panels = foxglove()["configById"]
    outputs = {topic: kind for topic, (kind, _) in published().items()}
    known = outputs | inputs()
    shown = set(panels["3D!predictor"]["topics"])
    assert {known.get(topic) for topic in shown} <= FOXGLOVE
    drawable = {topic for topic, kind in outputs.items() if kind in FOXGLOVE}
    assert drawable - shown == {f"/predicted/{name}" for name in NOT_DRAWN} & drawable
    assert panels["DiagnosticSummary!predictor"]["topicToRender"] == "/diagnostics"
    assert panels["RawMessages!gap"]["topicPath"] in outputs

    def panels_of(node):
        return [node] if isinstance(node, str) else panels_of(node["first"]) + panels_of(node["second"])

    assert sorted(panels_of(foxglove()["layout"])) == sorted(panels)


def test_both_layouts_follow_the_robot():
    assert rviz()["Views"]["Current"]["Target Frame"] == "base_link"
    assert foxglove()["configById"]["3D!predictor"]["followTf"] == "base_link"
