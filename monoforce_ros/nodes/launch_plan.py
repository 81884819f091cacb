"""What the launch file starts: nodes and their parameters, from launch arguments and a parameter file.

Nothing here needs ``launch``: launch/predictor.launch.py turns a plan into actions.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from monoforce_ros.core import most_similar, nearest
from monoforce_ros.nodes.parameter_files import (
    read_sections,
    refuse_misnamed_sections,
    refuse_overridden_sections,
    section_matches,
)
from monoforce_ros.nodes.schema import (
    SCHEMAS,
    ParameterEntry,
    ParameterValue,
    read_schema,
    schema_path,
)

SHARED = ("odometry_topic", "base_frame", "odometry_child_pose", "command_topic", "data_timeout")
"""Parameters that mean the same in both nodes: their launch arguments are passed to both."""
_INCLUDED_CUTOFF = 0.8
"""Similarity from which an unknown argument is refused where another launch file may own it."""
_CLOCK = ParameterEntry("use_sim_time", "bool", False, "Use the time on /clock.")
_SWITCHES = (
    ParameterEntry("path_selector", "bool", False, "Also start path_selector, which drives to goal_pose."),
    ParameterEntry(
        "tf_in_namespace", "bool", False, "Use tf and tf_static in the namespace instead of /tf and /tf_static, as "
        "Nav2 and Clearpath robots do.",
    ),
)  # fmt: skip
_FILE = ParameterEntry(
    "params_file",
    "string",
    "",
    "Parameter file for the nodes, see config/predictor.params.yaml; launch arguments win.",
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
    """All arguments: every parameter of the nodes, with its default and its nodes."""
    nodes = [_Node.read(name) for name in SCHEMAS]
    names = dict.fromkeys(name for node in nodes for name in node.entries if name != _CLOCK.name)
    listed = [_described(name, [node for node in nodes if name in node.entries]) for name in (*names, _CLOCK.name)]
    return (
        *listed,
        *(_described(entry.name, [_Node("", {entry.name: entry})]) for entry in (_FILE, _NAMESPACE, *_SWITCHES)),
    )


def _described(name: str, nodes: Sequence[_Node]) -> LaunchArgument:
    entry = nodes[0].entries[name]
    defaults = {node.name: _default_text(node.entries[name]) for node in nodes}
    if len(set(defaults.values())) > 1:
        default = ", ".join(f"{text} ({node})" for node, text in defaults.items())
    else:
        default = defaults[nodes[0].name]
    unit = f" {entry.unit}" if entry.unit else ""
    limits = f" [{entry.range_text}{unit}]" if entry.range_text else ""
    owners = f" Parameter of {' and '.join(defaults)}." if nodes[0].name else ""
    return LaunchArgument(name, f"{entry.description}{limits} Default: {default}.{owners}")


def _default_text(entry: ParameterEntry) -> str:
    default = str(entry.default).lower() if isinstance(entry.default, bool) else entry.default
    return "empty" if default in ("", None, []) else str(default)


def plan_nodes(given: Mapping[str, str], words: Sequence[str] = (), *, included: bool = False) -> tuple[NodePlan, ...]:
    """The nodes to start.

    Args:
        given: values of the launch arguments by name; an empty one was not given.
        words: the arguments on the command line, ``NAME:=VALUE``. All of them have to be arguments of this launch file.
        included: another launch file includes this one, and ``words`` may be arguments of that file: only those that
            closely resemble one of this file are refused.

    Raises:
        ValueError: a value, the parameter file or a name is wrong; the message names the argument.
    """
    schemas = [_Node.read(name) for name in SCHEMAS]
    _refuse_unknown_words(words, schemas, included=included)
    on_line = {} if included else _values(words)
    # An empty value on the command line was given, to set an empty text in place of the file's.
    values = on_line | {name: text for name, text in given.items() if text}
    namespace = values.get("namespace", "").strip("/")
    if namespace and not re.fullmatch(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", namespace):
        raise ValueError(f"namespace: got {namespace!r}, expected letters, digits and underscores, parts joined by /")
    switches = {entry.name: bool(entry.parsed(text)) for entry in _SWITCHES if (text := values.get(entry.name, ""))}
    nodes = schemas if switches.get("path_selector") else schemas[:1]
    idle = {name: node.name for node in schemas if node not in nodes for name in node.entries}
    for name in values:
        if name in idle and name not in nodes[0].entries:
            owner = idle[name]
            raise ValueError(f"{name} is a parameter of {owner}, which is not started: add {owner}:=true")
    file = values.get(_FILE.name, "")
    from_file = _from_file(Path(file), nodes, namespace) if file else [{} for _ in nodes]
    remappings = (("/tf", "tf"), ("/tf_static", "tf_static")) if switches.get("tf_in_namespace") else ()
    plans = []
    for node, parameters in zip(nodes, from_file, strict=True):
        parameters |= {name: _parsed(node.entries[name], text) for name, text in values.items() if name in node.entries}
        plans.append(NodePlan(node.name, node.name, namespace, parameters, remappings))
    return tuple(plans)


def idle_sections(plans: Sequence[NodePlan], file: str) -> list[str]:
    """A sentence for each node that a parameter file has a section for, by name, and that is not started.

    Args:
        plans: the nodes that are started.
        file: the parameter file; empty if there is none.
    """
    idle = set(SCHEMAS) - {plan.name for plan in plans}
    return [
        f"{file} has parameters for {name}, which is not started: add {name}:=true"
        for section in (read_sections(Path(file)) if file else ())
        if (name := section.rpartition("/")[2]) in idle
    ]


def _parsed(entry: ParameterEntry, text: str) -> ParameterValue:
    """The value of a launch argument; raises ``ValueError`` with an example if it is no list where it has to be one."""
    try:
        return entry.parsed(text)
    except ValueError as error:
        if not entry.type.endswith("_array"):
            raise
        element = "0.0" if entry.type == "double_array" else "/a"
        raise ValueError(f"{error}, such as {entry.name}:='[{', '.join([element] * (entry.size or 2))}]'") from None


def _refuse_unknown_words(words: Sequence[str], nodes: Sequence[_Node], *, included: bool) -> None:
    """Raise ``ValueError`` for an argument on the command line that is not ``NAME:=VALUE`` with a known name."""
    known = [argument.name for argument in launch_arguments()]
    former = {entry.formerly: entry.name for node in nodes for entry in node.entries.values() if entry.formerly}
    for word in words:
        name, sign, _ = word.partition(":=")
        if name in known and sign:
            continue
        if included:
            if sign and difflib.get_close_matches(name, known, n=1, cutoff=_INCLUDED_CUTOFF):
                raise ValueError(f"unknown launch argument {name!r}{nearest(name, known)}")
            continue
        if not sign:
            name, _, value = word.lstrip("-").partition("=")
            name = name.rstrip(":").replace("-", "_")
            meant = f"{_meant(name, known) or 'NAME'}:={value or 'VALUE'}"
            raise ValueError(f"unexpected argument {word!r}: launch arguments are given as {meant}")
        if name in former:
            raise ValueError(f"unknown launch argument {name!r}: it is called {former[name]!r} now")
        meant = _meant(name, known)
        advice = f"; did you mean {meant!r}?" if meant else ""
        raise ValueError(f"unknown launch argument {name!r}{advice} --show-args lists all arguments")


def _values(words: Sequence[str]) -> dict[str, str]:
    """Values by name; raises ``ValueError`` for a name with two values, of which ``ros2 launch`` takes the last."""
    values: dict[str, str] = {}
    for word in words:
        name, _, value = word.partition(":=")
        if values.setdefault(name, value) != value:
            raise ValueError(
                f"launch argument {name!r} is given twice, as {values[name]!r} and {value!r}: give it once"
            )
    return values


def _meant(name: str, known: Sequence[str]) -> str:
    """The known name that is most similar, or that the name abbreviates; empty if there is none."""
    similar = most_similar(name, known)
    if similar:
        return similar[0]
    letters = re.compile(".*".join(map(re.escape, name)), re.IGNORECASE)
    # `ns` for `namespace`: the same first letter, and all others in order; of several, a single word before others.
    abbreviated = [full for full in known if name and full.startswith(name[0]) and letters.match(full)]
    return min(abbreviated, key=lambda full: (full != _NAMESPACE.name, len(full)), default="")


def _from_file(path: Path, nodes: Sequence[_Node], namespace: str) -> list[dict[str, ParameterValue]]:
    """Parameters of each node from the sections of a file that match its name, with or without the namespace."""
    sections = read_sections(path)
    found: list[dict[str, ParameterValue]] = []
    used = set()
    for node in nodes:
        parameters: dict[str, ParameterValue] = {}
        wanted = (f"/{namespace}/{node.name}".replace("//", "/"), f"/{node.name}")
        refuse_overridden_sections(path, sections, wanted)
        for section, values in sections.items():
            if any(section_matches(section, name) for name in wanted):
                used.add(section)
                parameters |= _checked(path, section, node, values)
        found.append(parameters)
    expected = [f"/{namespace}/{node.name}".replace("//", "/") for node in nodes]
    if not used:
        raise ValueError(
            f"params_file: {path} has no parameters for {' or '.join(expected)}: its sections are "
            f"{', '.join(sorted(sections))}; expected /** or the name of the node"
        )
    refuse_misnamed_sections(path, {name: sections[name] for name in set(sections) - used}, expected)
    return found


def _checked(path: Path, section: str, node: _Node, values: Mapping[str, object]) -> dict[str, ParameterValue]:
    checked: dict[str, ParameterValue] = {}
    former = {entry.formerly: entry for entry in node.entries.values() if entry.formerly}
    others = {name for other in SCHEMAS for name in _Node.read(other).entries}
    for name, value in values.items():
        if name.partition(".")[0] == "qos_overrides":
            # The node says that they have no effect.
            checked[name] = value  # type: ignore[assignment]
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
