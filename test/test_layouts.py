"""Layouts of RViz and Foxglove show the outputs of the node, with matching names and types."""

import json
import re

import yaml
from conftest import ROOT

TYPES = {
    "rviz_default_plugins/PointCloud2": "PointCloud2",
    "rviz_default_plugins/GridCells": "GridCells",
    "rviz_default_plugins/Map": "OccupancyGrid",
    "rviz_default_plugins/MarkerArray": "MarkerArray",
    "rviz_default_plugins/Path": "Path",
    "rviz_default_plugins/Odometry": "Odometry",
}


def published() -> dict[str, str]:
    """Topic → type of every publisher in the code of the nodes, and of the odometry input."""
    found = {"/odom": "Odometry", "/diagnostics": "DiagnosticArray"}
    for file in (ROOT / "monoforce_ros" / "nodes").glob("*.py"):
        for kind, topic in re.findall(r"create_publisher\((\w+), \"(predicted/\w+)\"", file.read_text()):
            found[f"/{topic}"] = kind
    return found


def test_rviz_shows_every_output_with_its_type():
    content = yaml.safe_load((ROOT / "config" / "rviz" / "predictor.rviz").read_text())
    displays = [d for d in content["Visualization Manager"]["Displays"] if "Topic" in d]
    shown = {display["Topic"]["Value"]: TYPES[display["Class"]] for display in displays}
    outputs = published()
    assert shown == {topic: outputs[topic] for topic in shown}
    # Tables of numbers are not for a 3D view.
    tables = {"candidate_costs", "candidate_rollouts", "path_spread", "live_gap"}
    assert set(outputs) - set(shown) == {"/diagnostics", *(f"/predicted/{name}" for name in tables)}


def test_foxglove_shows_topics_that_exist():
    layout = json.loads((ROOT / "config" / "foxglove" / "predictor.json").read_text())
    panels = layout["configById"]
    assert set(panels["3D!predictor"]["topics"]) <= set(published())
    assert panels["DiagnosticSummary!predictor"]["topicToRender"] == "/diagnostics"
    assert panels["RawMessages!gap"]["topicPath"] in published()

    def panels_of(node):
        return [node] if isinstance(node, str) else panels_of(node["first"]) + panels_of(node["second"])

    assert sorted(panels_of(layout["layout"])) == sorted(panels)
