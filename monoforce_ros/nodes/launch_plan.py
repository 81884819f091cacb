"""What the launch file starts: nodes and their parameters, from launch arguments and a parameter file.

Nothing here needs ``launch``: launch/predictor.launch.py turns a plan into actions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from monoforce_ros.nodes.parameter_files import read_sections, section_matches
from monoforce_ros.nodes.schema import (
    SCHEMAS,
    ParameterEntry,
    ParameterValue,
    most_similar,
    nearest,
    read_schema,
    schema_path,
)

_PARAMETERS = (
    "robot", "terrain_source", "checkpoint", "cloud_topic", "odometry_topic", "command_topic", "base_frame",
    "candidates", "ensemble", "autostart",
)  # fmt: skip
"""The predictor's parameters that are launch arguments; path_selector gets those that it has, too."""
_CLOCK = ParameterEntry("use_sim_time", "bool", False, "Use the time on /clock.")
_SWITCHES = (
    ParameterEntry("path_selector", "bool", False, "Also start path_selector, which drives to goal_pose."),
    ParameterEntry(
        "tf_in_namespace", "bool", False, "Use tf and tf_static in the namespace instead of /tf and /tf_static, as "
        "Nav2 and Clearpath robots do.",
    ),
)  # fmt: skip
_FILE = ParameterEntry(
    "params_file", "string", "", "Parameter file for the nodes, see config/predictor.params.yaml; launch arguments win."
)
_NAMESPACE = ParameterEntry("namespace", "string", "", "Namespace of the nodes and their topics, for several robots.")


@dataclass(frozen=True)
class LaunchArgument:
    """An argument of the launch file. Its default is empty: not given."""

    name: str
    description: str


@dataclass(frozen=True)
class NodePlan:
    """A node to start."""

    executable: str
    name: str
    namespace: str
    parameters: dict[str, ParameterValue]
    remappings: tuple[tuple[str, str], ...] = ()

    @property
    def full_name(self) -> str:
        """Fully qualified name."""
        return f"/{self.namespace}/{self.name}".replace("//", "/")


@dataclass(frozen=True)
class _Node:
    """A node with its schema."""

    name: str
    entries: dict[str, ParameterEntry] = field(default_factory=dict)

    @classmethod
    def read(cls, name: str) -> _Node:
        return cls(name, {entry.name: entry for entry in (*read_schema(schema_path(name)), _CLOCK)})


def launch_arguments() -> tuple[LaunchArgument, ...]:
    """All arguments, with the default of each in its description."""
    entries = _Node.read("predictor").entries
    listed = [entries[name] for name in (*_PARAMETERS, _CLOCK.name)]
    return tuple(_described(entry) for entry in (*listed, _FILE, _NAMESPACE, *_SWITCHES))


def _described(entry: ParameterEntry) -> LaunchArgument:
    default = str(entry.default).lower() if isinstance(entry.default, bool) else str(entry.default)
    limits = f" [{entry.range_text}]" if entry.range_text else ""
    return LaunchArgument(entry.name, f"{entry.description}{limits} Default: {default or 'empty'}.")


def plan_nodes(given: Mapping[str, str], words: Sequence[str] = ()) -> tuple[NodePlan, ...]:
    """The nodes to start.

    Args:
        given: values of the launch arguments by name; an empty one was not given.
        words: ``NAME:=VALUE`` of the whole command line, in which misspelt names are found. Arguments of other launch
            files may be among them.

    Raises:
        ValueError: a value, the parameter file or a name is wrong; the message names the argument.
    """
    known = [argument.name for argument in launch_arguments()]
    for name in (word.partition(":=")[0] for word in words if ":=" in word):
        # Far from every name it is an argument of another launch file.
        if name not in known and most_similar(name, known):
            raise ValueError(f"unknown launch argument {name!r}{nearest(name, known)}")
    namespace = given.get("namespace", "").strip("/")
    if namespace and not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", namespace):
        raise ValueError(f"namespace: got {namespace!r}, expected letters, digits and underscores, parts joined by /")
    switches = {entry.name: bool(entry.parsed(text)) for entry in _SWITCHES if (text := given.get(entry.name, ""))}
    names = SCHEMAS if switches.get("path_selector") else SCHEMAS[:1]
    nodes = [_Node.read(name) for name in names]
    file = given.get(_FILE.name, "")
    from_file = _from_file(Path(file), nodes, namespace) if file else [{} for _ in nodes]
    remappings = (("/tf", "tf"), ("/tf_static", "tf_static")) if switches.get("tf_in_namespace") else ()
    plans = []
    for node, parameters in zip(nodes, from_file, strict=True):
        for name in (*_PARAMETERS, _CLOCK.name):
            if (text := given.get(name, "")) and name in node.entries:
                parameters[name] = node.entries[name].parsed(text)
        plans.append(NodePlan(node.name, node.name, namespace, parameters, remappings))
    return tuple(plans)


def _from_file(path: Path, nodes: Sequence[_Node], namespace: str) -> list[dict[str, ParameterValue]]:
    """Parameters of each node from the sections of a file that match its name, with or without the namespace."""
    sections = read_sections(path)
    found: list[dict[str, ParameterValue]] = []
    used = set()
    for node in nodes:
        parameters: dict[str, ParameterValue] = {}
        for section, values in sections.items():
            wanted = (f"/{namespace}/{node.name}".replace("//", "/"), f"/{node.name}")
            if any(section_matches(section, name) for name in wanted):
                used.add(section)
                parameters |= _checked(path, section, node, values)
        found.append(parameters)
    if not used:
        expected = " or ".join(f"/{namespace}/{node.name}".replace("//", "/") for node in nodes)
        raise ValueError(
            f"params_file: {path} has no parameters for {expected}: its sections are {', '.join(sorted(sections))}; "
            "expected /** or the name of the node"
        )
    return found


def _checked(path: Path, section: str, node: _Node, values: Mapping[str, object]) -> dict[str, ParameterValue]:
    checked: dict[str, ParameterValue] = {}
    former = {entry.formerly: entry for entry in node.entries.values() if entry.formerly}
    others = {name for other in SCHEMAS for name in _Node.read(other).entries}
    for name, value in values.items():
        if name.startswith("qos_overrides."):
            continue
        entry = node.entries.get(name) or former.get(name)
        if entry is not None:
            try:
                checked[name] = entry.checked(value)
            except ValueError as error:
                raise ValueError(f"params_file: {path}, section {section}: {error}") from error
        elif "*" not in section or name not in others:
            known = nearest(name, node.entries)
            raise ValueError(f"params_file: {path}, section {section}: {node.name} has no parameter {name!r}{known}")
    return checked
