"""The launch file: its plan everywhere, and the file itself wherever ROS's launch is installed."""

import importlib.util
import subprocess
import sys

import pytest
from conftest import ROOT

from monoforce_ros.nodes.launch_plan import launch_arguments, plan_nodes
from monoforce_ros.nodes.schema import read_schema, schema_path

LAUNCH_FILE = ROOT / "launch" / "predictor.launch.py"


@pytest.fixture
def file(tmp_path):
    def write(text: str) -> str:
        path = tmp_path / "parameters.yaml"
        path.write_text(text)
        return str(path)

    return write


def test_by_default_only_the_predictor_starts_with_its_own_defaults():
    (plan,) = plan_nodes({argument.name: "" for argument in launch_arguments()})
    assert (plan.executable, plan.full_name, plan.parameters, plan.remappings) == ("predictor", "/predictor", {}, ())


def test_arguments_win_over_the_file_and_the_file_over_defaults(file):
    path = file("/**:\n  ros__parameters:\n    robot: warthog\n    terrain_source: flat\n    rate: 4\n")
    (plan,) = plan_nodes({"params_file": path, "robot": "marv", "candidates": "32", "use_sim_time": "true"})
    assert plan.parameters == {
        "robot": "marv", "terrain_source": "flat", "rate": 4.0, "candidates": 32, "use_sim_time": True,
    }  # fmt: skip


@pytest.mark.parametrize("key", ["/**", "predictor", "/left/predictor", "left/predictor", "/*/predictor"])
def test_a_namespace_leaves_a_file_in_effect_however_it_names_the_node(file, key):
    path = file(f"{key}:\n  ros__parameters:\n    robot: warthog\n")
    (plan,) = plan_nodes({"params_file": path, "namespace": "/left/"})
    assert plan.full_name == "/left/predictor" and plan.parameters == {"robot": "warthog"}


def test_one_file_serves_both_nodes(file):
    path = file(
        "/**:\n  ros__parameters:\n    command_topic: drive\n    horizon: 4.0\n    goal_tolerance: 0.3\n"
        "path_selector:\n  ros__parameters:\n    rate: 20.0\n"
    )
    predictor, selector = plan_nodes({"params_file": path, "path_selector": "true", "odometry_topic": "filtered"})
    assert predictor.parameters == {"command_topic": "drive", "horizon": 4.0, "odometry_topic": "filtered"}
    assert selector.parameters == {
        "command_topic": "drive", "goal_tolerance": 0.3, "rate": 20.0, "odometry_topic": "filtered",
    }  # fmt: skip


def test_tf_moves_into_the_namespace_on_request():
    (plan,) = plan_nodes({"namespace": "left", "tf_in_namespace": "true"})
    assert plan.remappings == (("/tf", "tf"), ("/tf_static", "tf_static"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"candidates": "abc"}, "candidates: got 'abc', expected an integer 0 … 512"),
        ({"candidates": "5000"}, "candidates: got 5000, expected an integer 0 … 512"),
        ({"terrain_source": "sonar"}, "terrain_source: got 'sonar', expected one of lidar, camera"),
        ({"path_selector": "maybe"}, "path_selector: got 'maybe', expected true or false"),
        ({"use_sim_time": "1"}, "use_sim_time: got 1, expected true or false"),
        ({"namespace": "1st robot"}, "namespace: got '1st robot', expected letters"),
        ({"params_file": "/nowhere.yaml"}, "parameter file /nowhere.yaml: No such file"),
    ],
)
def test_wrong_values_are_named_with_what_was_expected(given, message):
    with pytest.raises(ValueError, match=message):
        plan_nodes(given)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "other:\n  ros__parameters:\n    robot: husky\n",
            "no parameters for /left/predictor: its sections are /other",
        ),
        ("/**:\n  ros__parameters:\n    robbot: husky\n", "predictor has no parameter 'robbot'; did you mean 'robot'"),
        (
            "/**:\n  ros__parameters:\n    rate: fast\n",
            "section /\\*\\*: rate: got 'fast', expected a number 0.1 … 100 Hz",
        ),
        ("robot: husky\n", "has no 'ros__parameters'"),
        ("a: [", "is not YAML"),
    ],
)
def test_a_wrong_parameter_file_is_named_with_what_was_expected(file, text, message):
    with pytest.raises(ValueError, match=message):
        plan_nodes({"params_file": file(text), "namespace": "left"})


def test_a_misspelt_argument_is_answered_and_those_of_other_launch_files_are_left_alone():
    with pytest.raises(ValueError, match="unknown launch argument 'terain_source'; did you mean 'terrain_source'"):
        plan_nodes({}, ["terain_source:=camera"])
    assert plan_nodes({}, ["slam:=true", "robot:=husky", "map_yaml:=x"])


def test_every_launch_argument_is_a_parameter_or_explained():
    described = {argument.name: argument.description for argument in launch_arguments()}
    assert {"robot", "terrain_source", "candidates", "autostart", "params_file", "namespace"} <= set(described)
    known = {entry.name: entry for entry in read_schema(schema_path("predictor"))}
    for name in set(described) & set(known):
        assert described[name].startswith(known[name].description)
    assert all("Default: " in text for text in described.values())


def test_the_plan_needs_neither_launch_nor_the_physics():
    """ros2 launch may run in another Python than the nodes."""
    loaded = (
        "import sys, monoforce_ros.nodes.launch_plan; "
        "print(sorted({'torch', 'warp', 'mujoco', 'launch', 'rclpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


def test_the_launch_file_starts_what_is_planned(file):
    launch = pytest.importorskip("launch", reason="ROS's launch is not installed")
    pytest.importorskip("launch_ros", reason="ROS's launch_ros is not installed")
    spec = importlib.util.spec_from_file_location("predictor_launch", LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    description = module.generate_launch_description()
    declared = [argument.name for argument in description.get_launch_arguments()]
    assert declared == [argument.name for argument in launch_arguments()]
    context = launch.LaunchContext(argv=["robot:=marv"])
    context.launch_configurations.update({name: "" for name in declared} | {"robot": "marv", "path_selector": "true"})
    nodes = module._nodes(context)
    assert [node.node_executable for node in nodes] == ["predictor", "path_selector"]
    context.launch_configurations["candidates"] = "abc"
    with pytest.raises(ValueError, match="candidates: got 'abc'"):
        module._nodes(context)
