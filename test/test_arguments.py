"""Command lines of the nodes: nothing on them is ignored, and what is wrong is answered with the nearest right name."""

import subprocess
import sys

import pytest
import torch
from conftest import ROOT

from monoforce_ros.core import OptionParser
from monoforce_ros.nodes.arguments import (
    check_parameter_files,
    own_arguments,
    parameter_files,
    refuse_other_nodes,
    refuse_stray_arguments,
)

# Starts and refusals: how long they take does not matter.
pytestmark = pytest.mark.unhurried_nodes

KNOWN = ("robot", "terrain_source", "rate")


@pytest.mark.parametrize(
    ("words", "own"),
    [
        (["--ros-args", "-p", "robot:=husky"], []),
        (["robot:=husky"], ["robot:=husky"]),
        (["a", "--ros-args", "-r", "x:=y", "--", "b"], ["a", "b"]),
        (["--ros-args", "-p", "broken", "--", "--ros-args", "-p", "c"], []),
    ],
)
def test_own_arguments_are_those_outside_of_ros_args(words, own):
    assert own_arguments(words) == own


@pytest.mark.parametrize(
    ("word", "meant"),
    [("--robot", "robot"), ("robot:=husky", "robot"), ("--terain-source=flat", "terrain_source"), ("7", "NAME")],
)
def test_a_stray_argument_is_answered_with_how_to_give_the_parameter(word, meant):
    with pytest.raises(ValueError, match=rf"unexpected argument '{word}'.*--ros-args -p {meant}:=VALUE"):
        refuse_stray_arguments([word, "--ros-args", "-p", "rate:=3.0"], KNOWN)


def test_a_file_without_a_section_for_the_node_is_reported(tmp_path):
    file = tmp_path / "parameters.yaml"
    file.write_text("predictor:\n  ros__parameters:\n    rate: 3.0\n")
    words = ["--ros-args", "--params-file", str(file)]
    assert parameter_files(words) == [file]
    assert check_parameter_files(words, "/predictor") == []
    (warning,) = check_parameter_files(words, "/left/predictor")
    assert "has no parameters for /left/predictor: its sections are /predictor" in warning


@pytest.mark.parametrize(
    ("words", "right"),
    [
        (["-p", "predictor:robot:=marv"], True),
        (["-p", "left/predictor:robot:=marv"], False),
        (["-r", "predictor:cmd_vel:=drive", "-r", "rostopic://a:=b", "-r", "__ns:=/", "-p", "robot:=a:b"], True),
        (["--param", "predictr:robot:=marv"], False),
        (["-r", "foresight:cmd_vel:=drive"], False),
    ],
)
def test_what_is_for_a_node_of_another_name_is_refused(words, right):
    if right:
        refuse_other_nodes(words, "/predictor")
        return
    with pytest.raises(ValueError, match="the node is /predictor, not"):
        refuse_other_nodes(words, "/predictor")


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            "predictor --robot husky",
            "unexpected argument '--robot': parameters are given as --ros-args -p robot:=VALUE",
        ),
        ("predictor robot:=husky", "unexpected argument 'robot:=husky'"),
        (
            "predictor --ros-args -p terrain_sourse:=camera",
            "unknown parameter 'terrain_sourse'; did you mean 'terrain_source'?",
        ),
        (
            "predictor --ros-args -p use_sim_tme:=true",
            "unknown parameter 'use_sim_tme'; did you mean 'use_sim_time'?",
        ),
        ("predictor --ros-args -p robot=husky", "the ROS arguments cannot be read"),
        ("predictor --ros-args --params-file {schema}", "has no 'ros__parameters': expected '/**:'"),
        ("predictor --ros-args --params-file /nowhere.yaml", "parameter file /nowhere.yaml: No such file"),
        (
            "path_selector --ros-args -p weight_distence:=1.0",
            "unknown parameter 'weight_distence'; did you mean 'weight_distance'?",
        ),
        (
            "predictor --ros-args -p predictr:terrain_source:=camera",
            "the node is /predictor, not 'predictr'; give -p terrain_source:=camera",
        ),
        ("path_selector --ros-args -r selector:cmd_vel:=drive", "the node is /path_selector, not 'selector'"),
        ("path_selector --ros-args --params-file {misnamed}", "no node is called /path_selectr; did you mean 'path_s"),
        ("path_selector --ros-args --params-file {beside}", "'timeout: 2.0' is not under 'ros__parameters'"),
        (
            "path_selector --ros-args -p odometry_child_pose:=[.nan,0.0,0.0,0.0,0.0,0.0]",
            "parameter odometry_child_pose: got [nan, 0.0, 0.0, 0.0, 0.0, 0.0], expected finite numbers",
        ),
        (
            "predictor --ros-args -p candidate_speeds:=[]",
            "parameter candidate_speeds: got no value, expected a list of",
        ),
        (
            "path_selector --ros-args -p candidate_topic:=plans",
            "unknown parameter 'candidate_topic' (it is one of predictor); did you mean 'candidate_cost_topic'?",
        ),
        ("simulator --ros-args -p robot:=marv", "unknown parameter 'robot': simulator has no parameters"),
        ("bag_player --start 1000", "--start: got 1000 s, but "),
        ("bag_player --topics /odm", "has no topics ['/odm']; did you mean '/odom'? its topics are"),
        ("predictor --ros-args -p robot:=5", "parameter robot: got 5, expected string"),
        ("predictor --ros-args -p horizon:=-1.0", "parameter horizon: got -1.0, expected double 0.1 … 30 s"),
        (
            "path_selector --ros-args -p timeout:=1",
            "parameter timeout: got 1, expected double 0.05 … 10 s: write 1.0",
        ),
        (
            "path_selector --ros-args -p use_sim_times:=true",
            "unknown parameter 'use_sim_times'; did you mean 'use_sim_time'?",
        ),
        ("path_selector --ros-args -p max_sped:=1.0", "unknown parameter 'max_sped'; --help lists all parameters"),
        ("predictor --ros-args -p odometry_topic:=odom!", "got 'odom!', expected a topic such as '/odom': topic name"),
        (
            "path_selector --ros-args --params-file {overridden}",
            "/** sets timeout to 2.0 after /path_selector set it to",
        ),
        ("path_selector --ros-args --params-file {repeated}", "has '/**' twice, again in line 4: merge both into one"),
        ("simulator --fat", "unrecognized arguments: --fat; did you mean '--flat'?"),
        ("bag_player --rte 3", "unrecognized arguments: --rte; did you mean '--rate'?"),
        ("bag_player --ros-args -p rate:=3.0", "unknown parameter 'rate': bag_player has no parameters"),
        ("bag_recorder {out} --ros-args -p topics:=odom", "unknown parameter 'topics': bag_recorder has no parameters"),
        ("bag_player --start inf", "argument --start: got 'inf', expected a number of seconds, 0 or more"),
        ("bag_player --wait nan", "argument --wait: got 'nan', expected a number of seconds, 0 or more"),
        ("bag_recorder {out} --topics a!b", "argument --topics: got 'a!b', expected a topic such as '/odom'"),
        ("simulator --seed -1", "argument --seed: got '-1', expected an integer, 0 or more"),
        ("simulator --duration nan", "argument --duration: got 'nan', expected a number of seconds"),
        ("bag_recorder {out} --topic odom", "unrecognized arguments: --topic odom; did you mean '--topics'?"),
    ],
)
def test_a_wrong_command_line_ends_the_start_in_one_line(executables, ros_environment, tmp_path, command, message):
    files = {name: tmp_path / f"{name}.yaml" for name in ("misnamed", "beside", "repeated", "overridden")}
    section = "ros__parameters:\n    timeout: 1.0\n"
    files["misnamed"].write_text(f"path_selector:\n  {section}path_selectr:\n  {section}")
    files["beside"].write_text(f"/**:\n  timeout: 2.0\n  {section}")
    files["repeated"].write_text(2 * f"/**:\n  {section}")
    files["overridden"].write_text(f"path_selector:\n  {section}/**:\n  {section.replace('1.0', '2.0')}")
    schema = ROOT / "config" / "predictor.schema.yaml"
    filled = command.format(schema=schema, out=tmp_path / "bag", **files)
    name, *words = filled.split()
    done = subprocess.run(
        [str(executables / name), *words],
        env=ros_environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode in (1, 2)
    assert message in done.stderr and "Traceback" not in done.stderr
    assert len([line for line in done.stderr.splitlines() if "error: " in line]) == 1


@pytest.mark.parametrize("node", ["predictor", "path_selector"])
def test_the_shipped_parameter_file_loads_under_any_name_and_namespace(start, node):
    process = start(
        node, "--ros-args", "--params-file", ROOT / "config" / f"{node}.params.yaml", "-r", "__ns:=/left",
        "-r", "__node:=renamed",
    )  # fmt: skip
    process.wait_for("predicting 5 s ahead for husky" if node == "predictor" else "waiting for a goal", 120.0)
    assert "no parameters for" not in process.output and "not used" not in process.output
    assert process.stop() == 0


def test_a_value_of_a_parameter_file_arrives_and_those_of_the_other_node_are_named(start, tmp_path):
    file = tmp_path / "both.yaml"
    file.write_text("/**:\n  ros__parameters:\n    goal_topic: here\n    terrain_source: flat\n")
    process = start("path_selector", "--ros-args", "--params-file", file)
    process.wait_for("waiting for a goal on /here")
    assert "not used by this node: terrain_source (of predictor)" in process.output
    assert process.stop() == 0


def test_a_file_that_all_nodes_share_does_no_harm_to_those_without_parameters(executables, ros_environment):
    file = ROOT / "config" / "predictor.params.yaml"
    done = subprocess.run(
        [executables / "bag_player", "--wait", "0", "--duration", "0.1", "--ros-args", "--params-file", file],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "not used by this node: autostart, base_frame" in done.stderr


def test_a_remapping_that_renames_nothing_is_reported(start):
    rules = ("odm:=/husky/odometry", "odom:=/husky/odom", "__ns:=/left", "path_selector:cmd_vel:=drive")
    process = start("path_selector", "--ros-args", *(word for rule in rules for word in ("-r", rule)))
    process.wait_for("-r odm:=/husky/odometry renames nothing: /left/path_selector has no topic /left/odm")
    assert process.output.count("renames nothing") == 1
    assert process.stop() == 0


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["--robto=husky"], "unrecognized arguments: --robto=husky; did you mean '--robot'?"),
        (["--rob=husky"], "unrecognized arguments: --rob=husky; did you mean '--robot'?"),
        (["rough", "--secnds", "3"], "unrecognized arguments: --secnds 3; did you mean '--seconds'?"),
    ],
)
def test_tools_name_the_nearest_option_and_take_no_abbreviation(capsys, words, answer):
    parser = OptionParser(prog="tool")
    parser.add_argument("--robot")
    parser.add_subparsers().add_parser("rough").add_argument("--seconds")
    with pytest.raises(SystemExit):
        parser.parse_args(words)
    assert answer in capsys.readouterr().err


def test_every_tool_uses_this_parser():
    plain = [
        path.name
        for path in (ROOT / "monoforce_ros").rglob("*.py")
        if "argparse.ArgumentParser(" in path.read_text() and path.name != "command_line.py"
    ]
    assert plain == []


def test_a_wrong_command_line_is_answered_before_torch_is_loaded():
    code = (
        "import sys\nfrom monoforce_ros.nodes.executables import predictor\n"
        "assert predictor(['--ros-args', '-p', 'terrain_sourse:=camera']) == 1 and predictor(['--help']) == 0\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60, capture_output=True)


@pytest.mark.parametrize("module", ["bag_player", "bag_recorder", "path_selector"])
def test_nodes_without_physics_start_without_torch(module):
    code = f"import sys, monoforce_ros.nodes.{module}; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize(("node", "other"), [("predictor", "path_selector"), ("path_selector", "predictor")])
def test_the_other_node_s_shipped_file_does_no_harm(start, node, other):
    process = start(node, "--ros-args", "--params-file", ROOT / "config" / f"{other}.params.yaml")
    process.wait_for("predicting 5 s ahead for husky" if node == "predictor" else "waiting for a goal", 120.0)
    assert "not used by this node" in process.output and "Traceback" not in process.output
    assert process.stop() == 0


def test_an_empty_topic_is_refused(executables, ros_environment):
    done = subprocess.run(
        [executables / "path_selector", "--ros-args", "-p", "odometry_topic:=''"],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "parameter odometry_topic: got an empty name, expected a topic such as 'odom'" in done.stderr


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_said_in_one_line(executables, ros_environment):
    done = subprocess.run(
        [executables / "predictor", "--ros-args", "-p", "device:=cuda", "-p", "terrain_source:=camera"],
        env=ros_environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "parameter device: got 'cuda', but PyTorch finds no CUDA device" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["evaluate", "bag", "--terrain", "lidar_interpolation", "--checkpoint", "/a.safetensors"],
            "--checkpoint has no effect with --terrain lidar_interpolation: no encoder",
        ),
        (["evaluate", "bag", "--terrain", "flat", "--images", "/front"], "--images has no effect with --terrain flat"),
        (["evaluate", "bag", "--check", "--images", "/typo"], "--images has no effect with --check"),
        (["synthesize", "out", "--camera", "none", "--cameras", "3"], "--cameras has no effect with --camera none"),
        (["synthesize", "out", "--lidar", "none", "--lidar-rate", "3"], "--lidar-rate has no effect with --lidar none"),
    ],
)
def test_options_without_effect_are_refused(executables, tmp_path, words, message):
    done = subprocess.run(
        [executables / words[0], *words[1:]], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2 and message in done.stderr and not list(tmp_path.iterdir())
