"""Node parameters from a YAML file that holds each one's type, default, range and meaning."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter


@dataclass(frozen=True)
class ParameterEntry:
    """A parameter as the YAML file describes it."""

    name: str
    type: str
    default: Any
    description: str
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    choices: tuple[str, ...] = ()
    dynamic: bool = False
    """Whether it may be changed while the node runs."""

    @property
    def range_text(self) -> str:
        """The allowed values in words."""
        if self.choices:
            return " | ".join(self.choices)
        return "" if self.minimum is None else f"{self.minimum:g} … {self.maximum:g}"


def read_parameter_file(path: Path) -> list[ParameterEntry]:
    """Entries of a parameter file in its order."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [
        ParameterEntry(name, **{**entry, "choices": tuple(entry.get("choices", ()))}) for name, entry in content.items()
    ]


def declare_parameters(node: Node, entries: list[ParameterEntry]) -> SimpleNamespace:
    """Declare the entries on a node and return their values.

    Raises:
        ValueError: a value is of the wrong type or outside its range or choices.
    """
    values = SimpleNamespace()
    for entry in entries:
        descriptor = ParameterDescriptor(
            description=f"{entry.description}{f' [{entry.unit}]' if entry.unit else ''}",
            additional_constraints=entry.range_text if entry.choices else "",
            read_only=not entry.dynamic,
        )
        if entry.type == "integer":
            descriptor.integer_range = [IntegerRange(from_value=entry.minimum, to_value=entry.maximum, step=1)]
        elif entry.minimum is not None:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=entry.minimum, to_value=entry.maximum, step=0.0)
            ]
        try:
            value = node.declare_parameter(entry.name, entry.default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            expected = f"{entry.type} {entry.range_text}".strip()
            raise ValueError(f"parameter {entry.name}: {error}; expected {expected} {entry.unit}".rstrip()) from error
        if entry.choices and value not in entry.choices:
            raise ValueError(f"parameter {entry.name}: got {value!r}, expected one of {list(entry.choices)}")
        setattr(values, entry.name, value)
    return values


def follow_changes(node: Node, entries: list[ParameterEntry], change: Callable[[SimpleNamespace], None]) -> None:
    """Have changes of dynamic parameters checked together, and taken over only if all of them fit.

    Args:
        node: whose ``settings`` hold the values that :func:`declare_parameters` returned.
        entries: of the parameters.
        change: takes all values with the changes in them; raises ``ValueError`` where they do not fit.
    """
    known = {entry.name: entry for entry in entries}

    def on_change(parameters: list[Parameter]) -> SetParametersResult:
        changed = SimpleNamespace(**vars(node.settings))
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
    """Text for ``--help``: how to start a node and every parameter it takes."""
    lines = [
        f"usage: {executable} [--ros-args -p NAME:=VALUE ... --params-file FILE -r OLD:=NEW ...]",
        "",
        "parameters:",
    ]
    for entry in entries:
        limits = f" ({entry.range_text}{f' {entry.unit}' if entry.unit else ''})" if entry.range_text else ""
        lines.append(f"  {entry.name}:={entry.default}{limits}")
        lines += textwrap.wrap(entry.description, 100, initial_indent="      ", subsequent_indent="      ")
    return "\n".join(lines)
