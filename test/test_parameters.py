"""Node parameters: values under deprecated names, types, ranges and choices."""

import pytest
import rclpy
from conftest import ROOT

from monoforce_ros.nodes.parameters import ParameterEntry, declare_parameters, parameter_help, read_parameter_file

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
    entries = read_parameter_file(ROOT / "config" / f"{name}.yaml")
    names = [entry.name for entry in entries] + [entry.formerly for entry in entries if entry.formerly]
    assert len(names) == len(set(names))
    assert all(entry.description[-1] == "." and len(entry.description) > 10 for entry in entries)
