"""Parameters of a node: declared from its schema, checked, and followed while the node runs."""

from __future__ import annotations

import math
import textwrap
from array import array
from collections.abc import Callable, Iterable, Sequence
from types import SimpleNamespace
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.parameter import Parameter

from monoforce_ros.core import nearest
from monoforce_ros.nodes.schema import (
    ParameterEntry,
    ParameterValue,
    no_parameters,
    of_every_node,
    parameter_owners,
)

_SOMETIMES = "read-only while the node is configured"


def declare_parameters(node: Node, entries: list[ParameterEntry], *, changeable: Iterable[str] = ()) -> SimpleNamespace:
    """Declare the entries on a node and return their values.

    A value given under a deprecated name replaces the default and is logged as a warning; a value under the current
    name takes precedence.

    Args:
        node: node that gets the parameters.
        entries: their definitions.
        changeable: names of parameters that are not dynamic but may change at times; :func:`follow_changes` decides
            when.

    Raises:
        ValueError: a value has the wrong type or is outside its range or choices, or a value was given for a
            parameter that does not exist.
    """
    refuse_unknown_parameters(node, entries)
    changeable = frozenset(changeable)
    values = SimpleNamespace()
    for entry in entries:
        default = entry.default
        if entry.formerly and (old := _deprecated_value(node, entry)) is not None:
            node.get_logger().warning(f"parameter '{entry.formerly}' is deprecated: use '{entry.name}'")
            default = old
        read_only = not entry.dynamic and entry.name not in changeable
        setattr(values, entry.name, _declare(node, entry, entry.name, default, read_only=read_only))
    return values


def refuse_unknown_parameters(node: Node, entries: Iterable[ParameterEntry] = ()) -> None:
    """Raise ``ValueError`` if a value was given for a parameter that the node does not have.

    Parameters of the package's other nodes are only logged: several nodes may share a file with the key ``/**``.
    """
    known = {name for entry in entries for name in (entry.name, entry.formerly) if name}
    others = parameter_owners()
    unused = []
    # rclpy keeps the values given on the command line and in files only here.
    if ineffective := sorted(name for name in node._parameter_overrides if name.startswith("qos_overrides.")):
        node.get_logger().warning(
            f"without effect: {', '.join(ineffective)}: subscriptions follow the quality of service of their "
            "publishers, publishers of this node offer the strictest one (ros2 topic info -v lists both)"
        )
    for name in node._parameter_overrides:
        if name in known or of_every_node(name):
            continue
        if name not in others and not known:
            raise ValueError(f"unknown parameter {name!r}: {no_parameters(node.get_name())}")
        if name not in others:
            meant = nearest(name, known | {"use_sim_time"})
            raise ValueError(f"unknown parameter {name!r}{meant or ';'} --help lists all parameters")
        unused.append(name)
    if unused:
        owners = " and ".join(sorted({others[name] for name in unused}))
        node.get_logger().warning(f"not used by this node: {', '.join(sorted(unused))} (of {owners})")


def settings_without_effect(entries: Iterable[ParameterEntry], settings: SimpleNamespace) -> list[str]:
    """A sentence for each parameter that differs from its default but is not used with the others' values."""
    found = []
    for entry in entries:
        if getattr(settings, entry.name) == entry.default:
            continue
        values = {name: getattr(settings, name) for name in entry.used_with}
        used = [
            bool(values[name]) == accepted if isinstance(accepted, bool) else values[name] in accepted
            for name, accepted in entry.used_with.items()
        ]
        if used and not any(used):
            states = ", ".join(f"{name} is {value or 'off'}" for name, value in values.items())
            needed = " or ".join(
                f"{name}{'' if accepted else ' off'}"
                if isinstance(accepted, bool)
                else f"{name} {' or '.join(accepted)}"
                for name, accepted in entry.used_with.items()
            )
            found.append(f"{entry.name} has no effect: it needs {needed}, and {states}")
    return found


def _deprecated_value(node: Node, entry: ParameterEntry) -> ParameterValue | None:
    """The value set under an entry's deprecated name, which is undeclared again after reading."""
    value = _declare(node, entry, entry.formerly, None)
    node.undeclare_parameter(entry.formerly)
    return value


def _declare(
    node: Node, entry: ParameterEntry, name: str, default: ParameterValue | None, *, read_only: bool = False
) -> ParameterValue | None:
    """Declare a parameter under a name and return its value; without a default, None if no value was given."""
    descriptor = ParameterDescriptor(
        description=f"{entry.description}{f' [{entry.unit}]' if entry.unit else ''}",
        additional_constraints=entry.range_text if entry.choices else "" if read_only or entry.dynamic else _SOMETIMES,
        read_only=read_only,
    )
    if entry.type == "integer":
        descriptor.integer_range = [IntegerRange(from_value=entry.minimum, to_value=entry.maximum, step=1)]
    elif entry.minimum is not None:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=entry.minimum, to_value=entry.maximum, step=0.0)
        ]
    declared = Parameter.Type[entry.type.upper()] if default is None else default
    try:
        value = node.declare_parameter(name, declared, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        expected = entry.expected if entry.type.endswith("_array") else f"{entry.type} {entry.range_text}".strip()
        got = node._parameter_overrides[name].value if name in node._parameter_overrides else default
        # rclpy keeps lists as arrays or tuples.
        got = list(got) if isinstance(got, Sequence | array) and not isinstance(got, str) else got
        text = f"parameter {name}: got {got!r}, expected {expected} {entry.unit}".rstrip()
        # ROS takes no integers for floating-point numbers.
        if entry.type == "double" and isinstance(got, int) and _whole([got]):
            text += f": write {float(got)}"
        if entry.type == "double_array" and isinstance(got, list) and _whole(got):
            text += f": write {[float(number) for number in got]}"
        raise ValueError(text) from error
    if (value is not None or name == entry.name) and (reason := complaint(entry, value)):
        raise ValueError(f"parameter {name}: {reason}")
    return value


def _whole(values: Sequence[Any]) -> bool:
    """Whether these are integers."""
    return bool(values) and all(isinstance(number, int) and not isinstance(number, bool) for number in values)


def complaint(entry: ParameterEntry, value: Any) -> str:
    """What is wrong with a parameter's value beyond its type and range, which ROS checks; empty if nothing is."""
    if value is None:
        # ROS has no type for an empty list, and leaves the parameter unset.
        return "" if entry.default is None else f"got no value, expected {entry.expected}"
    if entry.size and len(value) != entry.size:
        return f"got {len(value)} values, expected {entry.expected}"
    if entry.type == "double_array" and not all(math.isfinite(number) for number in value):
        return f"got {list(value)}, expected finite numbers"
    if entry.choices and value not in entry.choices:
        return f"got {value!r}, expected one of {list(entry.choices)}"
    if not entry.name.endswith(("_topic", "_topics")):
        return ""
    if value == "" and entry.default:
        return f"got an empty name, expected a topic such as {entry.default!r}"
    for topic in [value] if isinstance(value, str) else value:
        try:
            if topic:
                expand_topic_name(topic, "node", "/")
        except ValueError as error:
            # rcl's messages end with the place in its source code.
            reason = str(error).partition(", at /")[0].partition(": ")[2]
            return f"got {topic!r}, expected a topic such as '/odom': {reason}"
    return ""


def follow_changes(
    node: Node,
    entries: list[ParameterEntry],
    current: Callable[[], SimpleNamespace],
    change: Callable[[SimpleNamespace], None],
    fixed: Callable[[str], str] = lambda name: "",
) -> None:
    """Check changes of parameters together, and apply either all of them or none.

    Args:
        node: node with the parameters.
        entries: definitions of the parameters.
        current: returns the values in use, as :func:`declare_parameters` does.
        change: applies all values, with the changes among them; raises ``ValueError`` if it refuses them.
        fixed: why a parameter that is not dynamic may not change now; empty if it may.
    """
    known = {entry.name: entry for entry in entries}

    def on_change(parameters: list[Parameter]) -> SetParametersResult:
        changed = SimpleNamespace(**vars(current()))
        for parameter in parameters:
            entry = known.get(parameter.name)
            if entry is None:
                continue
            if not entry.dynamic and (reason := fixed(entry.name)):
                return SetParametersResult(successful=False, reason=reason)
            if reason := complaint(entry, parameter.value):
                return SetParametersResult(successful=False, reason=f"{entry.name}: {reason}")
            setattr(changed, parameter.name, parameter.value)
        try:
            change(changed)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_change)


def parameter_help(executable: str, entries: list[ParameterEntry]) -> str:
    """Text for ``--help``: how to start a node, and every parameter that it has."""
    lines = [
        f"usage: {executable} [--ros-args -p NAME:=VALUE ... --params-file FILE -r OLD:=NEW ...]",
        "",
        "parameters:",
    ]
    for entry in entries:
        limits = f" ({entry.range_text}{f' {entry.unit}' if entry.unit else ''})" if entry.range_text else ""
        formerly = f" (formerly {entry.formerly}, deprecated)" if entry.formerly else ""
        default = "" if entry.default is None else entry.default
        lines.append(f"  {entry.name}:={default}{limits}{formerly}")
        lines += textwrap.wrap(entry.description, 100, initial_indent="      ", subsequent_indent="      ")
    return "\n".join(lines)
