"""Node parameters: values under deprecated names, types, ranges and choices."""

import pytest
import rclpy
from conftest import ROOT

from monoforce_ros.nodes.parameter_files import parameter_file_text, read_sections, section_matches
from monoforce_ros.nodes.parameters import declare_parameters, parameter_help, settings_without_effect
from monoforce_ros.nodes.schema import SCHEMAS, ParameterEntry, read_schema

ENTRY = ParameterEntry("retention", "double", 1.5, "How long.", 0.0, 10.0, "s", formerly="memory")
PLAIN = ParameterEntry("mode", "string", "fast", "Which.", choices=("fast", "slow"))


@pytest.fixture
def declared(ros_environment):
    """Declares entries on a node that is started with parameters ``NAME:=VALUE``."""
    contexts = []

    def declare(*parameters: str, entries=(ENTRY, PLAIN)):
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=int(ros_environment["ROS_DOMAIN_ID"]))
        contexts.append(context)
        arguments = ["--ros-args", *(word for parameter in parameters for word in ("-p", parameter))]
        node = rclpy.create_node("declaring", context=context, cli_args=arguments, use_global_arguments=False)
        return node, declare_parameters(node, list(entries))

    yield declare
    for context in contexts:
        rclpy.shutdown(context=context)


def test_a_value_under_the_deprecated_name_is_used_with_one_warning(declared, capfd):
    node, values = declared("memory:=4.0")
    assert values.retention == 4.0 and node.get_parameter("retention").value == 4.0
    assert not node.has_parameter("memory")
    text = capfd.readouterr().err
    assert text.count("parameter 'memory' is deprecated: use 'retention'") == 1


def test_the_current_name_takes_precedence_and_needs_no_warning(declared, capfd):
    assert declared("memory:=4.0", "retention:=5.0")[1].retention == 5.0
    assert capfd.readouterr().err.count("deprecated") == 1
    assert declared("retention:=5.0")[1].retention == 5.0
    assert declared()[1].retention == 1.5
    assert "deprecated" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ("retention:=11.0", "parameter retention: .*expected double 0 … 10 s"),
        ("memory:=11.0", "parameter memory: .*expected double 0 … 10 s"),
        ("memory:=long", "parameter memory: .*expected double 0 … 10 s"),
        ("mode:=medium", "parameter mode: got 'medium', expected one of"),
    ],
)
def test_wrong_types_ranges_and_choices_are_refused_under_either_name(declared, parameter, message):
    with pytest.raises(ValueError, match=message):
        declared(parameter)


def test_the_help_names_deprecated_parameters():
    assert "retention:=1.5 (0 … 10 s) (formerly memory, deprecated)" in parameter_help("node", [ENTRY, PLAIN])


@pytest.mark.parametrize("name", ["predictor", "path_selector"])
def test_parameter_files_have_unique_names_and_full_sentences(name):
    entries = read_schema(ROOT / "config" / f"{name}.schema.yaml")
    names = [entry.name for entry in entries] + [entry.formerly for entry in entries if entry.formerly]
    assert len(names) == len(set(names))
    assert all(entry.description[-1] == "." and len(entry.description) > 10 for entry in entries)


@pytest.mark.parametrize("name", SCHEMAS)
def test_the_shipped_parameter_files_are_what_the_schemas_say(name):
    entries = read_schema(ROOT / "config" / f"{name}.schema.yaml")
    file = ROOT / "config" / f"{name}.params.yaml"
    advice = "renew it: scripts/run.sh python -m monoforce_ros.nodes.parameter_files"
    assert file.read_text() == parameter_file_text(name, entries), advice
    (section,) = read_sections(file).items()
    assert section == ("/**", {entry.name: entry.default for entry in entries if entry.default is not None})


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [("integer", "32", 32), ("double", "2", 2.0), ("double", "1e3", 1000.0), ("bool", "true", True),
     ("string", "7", "7"), ("double_array", "[0, 0.5]", [0.0, 0.5]), ("string_array", "[a, b]", ["a", "b"])],
)  # fmt: skip
def test_texts_become_values_of_the_parameter_s_type(kind, text, value):
    parsed = ParameterEntry("x", kind, None, "Anything.").parsed(text)
    assert parsed == value and type(parsed) is type(value)


@pytest.mark.parametrize(
    ("entry", "text", "expected"),
    [
        (ParameterEntry("count", "integer", 0, "How many.", 0, 512), "abc", "got 'abc', expected an integer 0 … 512"),
        (ParameterEntry("count", "integer", 0, "How many.", 0, 512), "700", "got 700, expected an integer 0 … 512"),
        (ParameterEntry("on", "bool", True, "Whether."), "yess", "on: got 'yess', expected true or false"),
        (ENTRY, "nan", "retention: got nan, expected a number 0 … 10 s"),
        (PLAIN, "medium", "mode: got 'medium', expected one of fast, slow"),
        (ParameterEntry("pose", "double_array", None, "Where.", size=6), "[1.0]", r"got \[1.0\], expected a list of 6"),
    ],
)  # fmt: skip
def test_values_that_do_not_fit_are_answered_with_what_would(entry, text, expected):
    with pytest.raises(ValueError, match=expected):
        entry.parsed(text)


def test_an_unknown_parameter_is_answered_with_the_nearest_name(declared):
    with pytest.raises(ValueError, match="unknown parameter 'retension'; did you mean 'retention'"):
        declared("retension:=3.0")


def test_sections_match_nodes_as_in_ros(tmp_path):
    file = tmp_path / "file.yaml"
    file.write_text("left:\n  predictor:\n    ros__parameters: {a: 1}\n/*/other:\n  ros__parameters: {b: 2}\n")
    sections = read_sections(file)
    assert sections == {"/left/predictor": {"a": 1}, "/*/other": {"b": 2}}
    assert section_matches("/left/predictor", "/left/predictor")
    assert not section_matches("/predictor", "/left/predictor")
    assert section_matches("/*/other", "/left/other") and not section_matches("/*/other", "/a/left/other")
    assert section_matches("/**", "/left/other") and section_matches("/**/other", "/other")


def test_parameters_that_have_no_effect_are_said(declared):
    entries = read_schema(ROOT / "config" / "predictor.schema.yaml")

    def said(*parameters):
        return settings_without_effect(entries, declared(*parameters, entries=entries)[1])

    assert said() == said("terrain_source:=camera") == []
    assert (
        said("checkpoint:=/a.safetensors", "terrain_source:=lidar_camera", "ensemble:=8", "ensemble_scale:=2.0") == []
    )
    assert said("candidate_topic:=/planner", "candidate_delay:=0.2", "limit_roll:=0.3") == []
    assert said("checkpoint:=/a.safetensors") == []
    assert said("camera_retention_time:=1.0") == [
        "camera_retention_time has no effect: it needs terrain_source camera or lidar_camera, and terrain_source is "
        "lidar"
    ]
    assert said("refine_seconds:=0.1", "ensemble_scale:=2.0", "candidates:=0") == [
        "refine_seconds has no effect: it needs candidates or candidate_topic, and candidates is off, "
        "candidate_topic is off",
        "ensemble_scale has no effect: it needs ensemble, and ensemble is off",
    ]


def test_every_condition_of_a_schema_names_parameters_and_values_that_exist():
    for node in SCHEMAS:
        entries = {entry.name: entry for entry in read_schema(ROOT / "config" / f"{node}.schema.yaml")}
        for entry in entries.values():
            for name, accepted in entry.used_with.items():
                assert isinstance(accepted, bool) or set(accepted) < set(entries[name].choices)


def test_a_goal_is_not_used_beside_a_plan(declared):
    entries = read_schema(ROOT / "config" / "path_selector.schema.yaml")
    assert settings_without_effect(entries, declared("goal_topic:=/goal", entries=entries)[1]) == []
    assert settings_without_effect(entries, declared("goal_topic:=/goal", "plan_topic:=/plan", entries=entries)[1]) == [
        "goal_topic has no effect: it needs plan_topic off, and plan_topic is /plan"
    ]


def test_whole_numbers_in_a_list_are_answered_with_what_to_write(declared):
    speeds = ParameterEntry("speeds", "double_array", [0.5, 1.0], "Speeds.", unit="m/s")
    with pytest.raises(ValueError, match=r"got \[0, 1\], expected a list of numbers m/s: write \[0.0, 1.0\]"):
        declared("speeds:=[0, 1]", entries=(speeds,))
