"""The launch file: its plan everywhere, and the file itself wherever ROS's launch is installed."""

import importlib.util
import json
import subprocess
import sys
from unittest.mock import MagicMock

import pytest
from conftest import ROOT

from monoforce_ros.nodes.launch_plan import SHARED, idle_sections, launch_arguments, plan_nodes
from monoforce_ros.nodes.schema import SCHEMAS, read_schema, schema_path

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
        "path_selector:\n  ros__parameters:\n    command_rate: 20.0\n"
    )
    predictor, selector = plan_nodes({"params_file": path, "path_selector": "true", "odometry_topic": "filtered"})
    assert predictor.parameters == {"command_topic": "drive", "horizon": 4.0, "odometry_topic": "filtered"}
    assert selector.parameters == {
        "command_topic": "drive", "goal_tolerance": 0.3, "command_rate": 20.0, "odometry_topic": "filtered",
    }  # fmt: skip


def test_a_general_section_comes_before_that_of_one_node(file):
    general = "/**:\n  ros__parameters:\n    rate: 4.0\n    robot: marv\n"
    own = "predictor:\n  ros__parameters:\n    rate: 7.0\n"
    (plan,) = plan_nodes({"params_file": file(general + own)})
    assert plan.parameters == {"rate": 7.0, "robot": "marv"}
    with pytest.raises(ValueError, match=r"/\*\* sets rate to 4.0 after /predictor set it to 7.0, and ROS takes the"):
        plan_nodes({"params_file": file(own + general)})
    # Where both say the same, the order does not matter.
    assert plan_nodes({"params_file": file(own.replace("7.0", "4.0") + general)})


@pytest.mark.parametrize("key", ["path_selector", "/left/path_selector"])
def test_parameters_for_a_node_that_is_not_started_are_mentioned(file, key):
    section = f"{key}:\n  ros__parameters:\n    timeout: 2.0\n"
    given = {"params_file": file(f"predictor:\n  ros__parameters:\n    rate: 4.0\n{section}"), "namespace": "left"}
    (sentence,) = idle_sections(plan_nodes(given), given["params_file"])
    assert sentence.endswith("has parameters for path_selector, which is not started: add path_selector:=true")
    both = plan_nodes(given | {"path_selector": "true"})
    assert idle_sections(both, given["params_file"]) == idle_sections(both[:1], "") == []


def test_tf_moves_into_the_namespace_on_request():
    (plan,) = plan_nodes({"namespace": "left", "tf_in_namespace": "true"})
    assert plan.remappings == (("/tf", "tf"), ("/tf_static", "tf_static"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"candidates": "abc"}, "candidates: got 'abc', expected an integer 0 … 512"),
        ({"candidates": "5000"}, "candidates: got 5000, expected an integer 0 … 512"),
        (
            {"terrain_source": "sonar"},
            "terrain_source: got 'sonar', expected one of lidar, lidar_interpolation, camera",
        ),
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
        (
            "/**:\n  robot: jackal\n  ros__parameters:\n    rate: 3.0\n",
            "'robot: jackal' is not under 'ros__parameters'",
        ),
        (
            "predictor:\n  ros__parameters:\n    rate: 3.0\npredictr:\n  ros__parameters:\n    horizon: 3.0\n",
            "no node is called /predictr; did you mean 'predictor'",
        ),
        (
            "predictor:\n  ros__parameters:\n    rate: 3.0\nforesight:\n  ros__parameters:\n    horizon: 3.0\n"
            "    candidates: 8\n    robot: husky\n",
            "no node is called /foresight; expected /left/predictor or /\\*\\*",
        ),
        ("a: [", "is not YAML: line 1: expected the node content"),
        (
            "/**:\n  ros__parameters: [1, 2\n",
            "is not YAML: line 3: expected ',' or ']', but got '<stream end>', while parsing a flow sequence that "
            "begins in line 2$",
        ),
        ("a: &a [*a]", "is not YAML: maximum recursion depth"),
        ("/**:\n  ros__parameters:\n    rate: 3.0\n    rate: 4.0\n", "has 'rate' twice, again in line 4"),
    ],
)
def test_a_wrong_parameter_file_is_named_with_what_was_expected(file, text, message):
    with pytest.raises(ValueError, match=message):
        plan_nodes({"params_file": file(text), "namespace": "left"})


def test_sections_for_other_packages_and_other_robots_are_left_alone(file):
    mine = "predictor:\n  ros__parameters:\n    rate: 3.0\n"
    others = "controller_server:\n  ros__parameters:\n    controller_frequency: 20.0\n    odom_topic: odom\n"
    others += "/right/predictor:\n  ros__parameters:\n    robot: marv\n/**/costmap:\n  ros__parameters: {}\n"
    # Other packages have parameters of the same name as well.
    others += (
        "joint_state_publisher:\n  ros__parameters:\n    rate: 30\nteleop_node:\n  ros__parameters:\n    device: 0\n"
    )
    others += "local_costmap:\n  local_costmap:\n    ros__parameters:\n      robot_radius: 0.3\n"
    (plan,) = plan_nodes({"params_file": file(mine + others), "namespace": "left"})
    assert plan.parameters == {"rate": 3.0}


def test_numbers_are_read_as_ros_reads_them(file):
    """YAML 1.1 takes 1e-1 for text."""
    path = file(
        "path_selector:\n  ros__parameters:\n    goal_tolerance: 1e-1\n/**:\n  ros__parameters:\n    rate: 2e0\n"
    )
    predictor, selector = plan_nodes({"params_file": path, "path_selector": "true"})
    assert selector.parameters == {"goal_tolerance": 0.1} and predictor.parameters == {"rate": 2.0}


@pytest.mark.parametrize("node", ["predictor", "path_selector"])
def test_the_shipped_file_of_one_node_serves_both(node):
    path = str(ROOT / "config" / f"{node}.params.yaml")
    plans = plan_nodes({"params_file": path, "path_selector": "true"})
    other = next(plan for plan in plans if plan.name != node)
    assert set(other.parameters) <= set(SHARED) and other.parameters["odometry_topic"] == "odom"


def test_every_parameter_is_an_argument_and_reaches_the_nodes_that_have_it():
    entries = {node: {entry.name: entry for entry in read_schema(schema_path(node))} for node in SCHEMAS}
    both = set(entries["predictor"]) & set(entries["path_selector"])
    assert both == set(SHARED), "a parameter of both nodes: does it mean the same in both?"
    arguments = {argument.name for argument in launch_arguments()}
    for node, known in entries.items():
        for name, entry in known.items():
            assert name in arguments
            value = entry.default
            if value is None or entry.type == "string_array":
                value = [0.5] * entry.size if entry.type == "double_array" else ["/a", "/b"]
            text = value if isinstance(value, str) else json.dumps(value)
            if text:
                plans = {
                    plan.name: plan.parameters for plan in plan_nodes({}, [f"{name}:={text}", "path_selector:=true"])
                }
                assert plans[node] == {name: value}
                assert all((name in plans[other]) == (name in entries[other]) for other in plans)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["horizon:=300"], "horizon: got 300, expected a number"),
        (["image_topics:=a"], r"image_topics: got 'a', expected a list of texts, such as image_topics:='\[/a, /a\]'"),
        (
            ["goal_topic:=/g"],
            "goal_topic is a parameter of path_selector, which is not started: add path_selector:=true",
        ),
        (["terain_source:=camera"], "unknown launch argument 'terain_source'; did you mean 'terrain_source'?"),
        (["ns:=left"], "unknown launch argument 'ns'; did you mean 'namespace'?"),
        (["slam:=true"], "unknown launch argument 'slam'.*--show-args lists all arguments"),
        (["candidates=32"], "unexpected argument 'candidates=32': launch arguments are given as candidates:=32"),
        (["robot:=husky", "robot:=jackal"], "'robot' is given twice, as 'husky' and 'jackal': give it once"),
        (["--robot", "husky"], "unexpected argument '--robot': launch arguments are given as robot:=VALUE"),
    ],
)
def test_an_argument_that_would_be_ignored_is_refused_with_the_right_advice(words, message):
    with pytest.raises(ValueError, match=message):
        plan_nodes({}, words)


def test_an_empty_argument_empties_what_the_file_sets(file):
    path = file("path_selector:\n  ros__parameters:\n    plan_topic: /plan\n")
    words = [f"params_file:={path}", "path_selector:=true"]
    assert plan_nodes({}, words)[1].parameters == {"plan_topic": "/plan"}
    assert plan_nodes({}, [*words, "plan_topic:="])[1].parameters == {"plan_topic": ""}


def test_arguments_of_a_launch_file_that_includes_this_one_are_left_alone():
    assert plan_nodes({"robot": "marv"}, ["slam:=true", "robot:=husky", "map_yaml:=x", "rate:=5"], included=True)
    with pytest.raises(ValueError, match="did you mean 'terrain_source'"):
        plan_nodes({}, ["terain_source:=camera"], included=True)


def test_every_launch_argument_is_a_parameter_or_explained():
    described = {argument.name: argument.description for argument in launch_arguments()}
    assert {"robot", "terrain_source", "candidates", "autostart", "params_file", "namespace"} <= set(described)
    known = {entry.name: entry for entry in read_schema(schema_path("predictor"))}
    for name in set(described) & set(known):
        assert described[name].startswith(known[name].description)
    assert described["horizon"].endswith("Parameter of predictor.")
    assert described["odometry_topic"].endswith("Parameter of predictor and path_selector.")
    assert all("Default: " in text for text in described.values())


def test_the_plan_needs_neither_launch_nor_the_physics():
    """ros2 launch may run in another Python than the nodes."""
    loaded = (
        "import sys, monoforce_ros.nodes.launch_plan; "
        "print(sorted({'torch', 'warp', 'mujoco', 'launch', 'rclpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


@pytest.fixture
def launch_file(monkeypatch):
    """The launch file, with stand-ins for ROS's launch, which keep what they are given."""
    for name in ("launch", "launch.actions", "launch.substitutions", "launch_ros", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    sys.modules["launch_ros.actions"].Node = dict
    spec = importlib.util.spec_from_file_location("predictor_launch", LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    given: dict[str, str] = {}
    monkeypatch.setattr(module, "LaunchConfiguration", lambda name: MagicMock(perform=lambda _: given.get(name, "")))
    return module, given


def test_arguments_reach_the_nodes_and_unknown_ones_end_the_start_unless_another_file_owns_them(
    launch_file, monkeypatch
):
    module, given = launch_file
    given |= {"horizon": "3.0", "timeout": "1.0", "path_selector": "true"}
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "monoforce_ros", "predictor.launch.py", "horizon:=3.0"])
    predictor, selector = module._actions(MagicMock(argv=["horizon:=3.0", "timeout:=1.0", "path_selector:=true"]))
    assert predictor["parameters"] == [{"horizon": 3.0}] and selector["parameters"] == [{"timeout": 1.0}]
    with pytest.raises(ValueError, match="unknown launch argument 'ns'; did you mean 'namespace'"):
        module._actions(MagicMock(argv=["ns:=left"]))
    monkeypatch.setattr(sys, "argv", ["ros2", "launch", "my_robot", "bringup.launch.py", "ns:=left"])
    passed = {"ns": "left", "horizon": "3.0"}
    assert len(module._actions(MagicMock(argv=["ns:=left"], launch_configurations=passed))) == 2
    with pytest.raises(ValueError, match="unknown launch argument 'terrain_sourse'; did you mean 'terrain_source'"):
        module._actions(MagicMock(argv=["ns:=left"], launch_configurations=passed | {"terrain_sourse": "lidar"}))


def test_the_launch_file_mentions_parameters_of_a_node_that_it_does_not_start(launch_file, file):
    module, given = launch_file
    sections = (f"{name}:\n  ros__parameters:\n    {value}\n" for name, value in
                (("predictor", "rate: 4.0"), ("path_selector", "timeout: 2.0")))  # fmt: skip
    given |= {"params_file": file("".join(sections))}
    module._actions(MagicMock(argv=[]))
    (called,) = module.LogInfo.call_args_list
    assert "add path_selector:=true" in called.kwargs["msg"]


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
    nodes = module._actions(context)
    assert [node.node_executable for node in nodes] == ["predictor", "path_selector"]
    context.launch_configurations["candidates"] = "abc"
    with pytest.raises(ValueError, match="candidates: got 'abc'"):
        module._actions(context)
