"""Node parameters from a YAML file with the type, default, range and meaning of each."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

ParameterValue = bool | int | float | str | list[float] | list[str]


@dataclass(frozen=True)
class ParameterEntry:
    """A parameter as the YAML file describes it."""

    name: str
    type: str
    """``bool``, ``integer``, ``double``, ``string``, ``double_array`` or ``string_array``."""
    default: ParameterValue
    description: str
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    choices: tuple[str, ...] = ()
    dynamic: bool = False
    """Whether it may be changed while the node runs."""
    formerly: str = ""
    """Deprecated name under which a value is still accepted at start-up."""

    @property
    def range_text(self) -> str:
        """The allowed values as text."""
        if self.choices:
            return " | ".join(self.choices)
        return "" if self.minimum is None else f"{self.minimum:g} … {self.maximum:g}"


def read_parameter_file(path: Path) -> list[ParameterEntry]:
    """Entries of a parameter file, in its order."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [
        ParameterEntry(name, **{**entry, "choices": tuple(entry.get("choices", ()))}) for name, entry in content.items()
    ]


def declare_parameters(node: Node, entries: list[ParameterEntry]) -> SimpleNamespace:
    """Declare the entries on a node and return their values.

    A value given under a deprecated name replaces the default and is logged as a warning; a value under the current
    name takes precedence.

    Raises:
        ValueError: a value has the wrong type or is outside its range or choices.
    """
    values = SimpleNamespace()
    for entry in entries:
        default = entry.default
        if entry.formerly and (old := _deprecated_value(node, entry)) is not None:
            node.get_logger().warning(f"parameter '{entry.formerly}' is deprecated: use '{entry.name}'")
            default = old
        setattr(values, entry.name, _declare(node, entry, entry.name, default))
    return values


def _deprecated_value(node: Node, entry: ParameterEntry) -> ParameterValue | None:
    """The value set under an entry's deprecated name, which is undeclared again after reading."""
    value = _declare(node, entry, entry.formerly, None)
    node.undeclare_parameter(entry.formerly)
    return value


def _declare(node: Node, entry: ParameterEntry, name: str, default: ParameterValue | None) -> ParameterValue | None:
    """Declare a parameter under a name and return its value; without a default, None if no value was given."""
    descriptor = ParameterDescriptor(
        description=f"{entry.description}{f' [{entry.unit}]' if entry.unit else ''}",
        additional_constraints=entry.range_text if entry.choices else "",
        read_only=default is not None and not entry.dynamic,
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
        expected = f"{entry.type} {entry.range_text}".strip()
        raise ValueError(f"parameter {name}: {error}; expected {expected} {entry.unit}".rstrip()) from error
    if entry.choices and value is not None and value not in entry.choices:
        raise ValueError(f"parameter {name}: got {value!r}, expected one of {list(entry.choices)}")
    return value


def follow_changes(
    node: Node,
    entries: list[ParameterEntry],
    current: Callable[[], SimpleNamespace],
    change: Callable[[SimpleNamespace], None],
) -> None:
    """Check changes of dynamic parameters together, and apply either all of them or none.

    Args:
        node: node with the parameters.
        entries: definitions of the parameters.
        current: returns the values in use, as :func:`declare_parameters` does.
        change: applies all values, with the changes among them; raises ``ValueError`` if it refuses them.
    """
    known = {entry.name: entry for entry in entries}

    def on_change(parameters: list[Parameter]) -> SetParametersResult:
        changed = SimpleNamespace(**vars(current()))
        for parameter in parameters:
            entry = known.get(parameter.name)
            if entry is None:
                continue
            if entry.choices and parameter.value not in entry.choices:
                reason = f"{entry.name}: got {parameter.value!r}, expected one of {list(entry.choices)}"
                return SetParametersResult(successful=False, reason=reason)
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
        lines.append(f"  {entry.name}:={entry.default}{limits}{formerly}")
        lines += textwrap.wrap(entry.description, 100, initial_indent="      ", subsequent_indent="      ")
    return "\n".join(lines)
