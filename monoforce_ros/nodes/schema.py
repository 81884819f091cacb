"""Parameter schemas: YAML files with the type, default, range and meaning of each parameter of a node."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from monoforce_ros.core import share_directory

ParameterValue = bool | int | float | str | list[float] | list[str]

SCHEMAS = ("predictor", "path_selector")
"""Nodes with a schema: ``config/NAME.schema.yaml``."""

_ELEMENTS = {"double_array": "double", "string_array": "string"}
_WORDS = {"bool": "true or false", "integer": "an integer", "double": "a number", "string": "text"}


def _number(value: Any) -> Any:
    """A number that YAML 1.1 reads as text, such as 1e3, as ROS reads it; anything else unchanged."""
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            return float(value)
    return value


@dataclass(frozen=True)
class ParameterEntry:
    """A parameter as the schema describes it."""

    name: str
    type: str
    """``bool``, ``integer``, ``double``, ``string``, ``double_array`` or ``string_array``."""
    default: ParameterValue | None
    """None only for arrays: the parameter is unset by default."""
    description: str
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ""
    choices: tuple[str, ...] = ()
    size: int = 0
    """Required number of elements of an array; 0 allows any."""
    dynamic: bool = False
    """Whether it may be changed while the node runs."""
    formerly: str = ""
    """Deprecated name under which a value is still accepted at start-up."""
    used_with: Mapping[str, bool | Sequence[str]] = field(default_factory=dict)
    """Parameters without which it has no effect: any one of them set (True), not set (False), or with one of these
    values."""

    @property
    def range_text(self) -> str:
        """The allowed values as text."""
        if self.choices:
            return " | ".join(self.choices)
        return "" if self.minimum is None else f"{self.minimum:g} … {self.maximum:g}"

    @property
    def expected(self) -> str:
        """Type and allowed values in words, for error messages."""
        element = _ELEMENTS.get(self.type)
        if element is not None:
            count = f"{self.size} " if self.size else ""
            return f"a list of {count}{'numbers' if element == 'double' else 'texts'}"
        if self.choices:
            return "one of " + ", ".join(self.choices)
        return f"{_WORDS[self.type]} {self.range_text} {self.unit}".replace("  ", " ").strip()

    def checked(self, value: Any) -> ParameterValue:
        """The value with the parameter's type; raises ``ValueError`` with what was got and what was expected."""
        value = _number(value) if self.type == "double" else value
        try:
            return self._converted(value)
        except (TypeError, ValueError):
            raise ValueError(f"{self.name}: got {value!r}, expected {self.expected}") from None

    def parsed(self, text: str) -> ParameterValue:
        """The value of a text such as a launch argument; raises ``ValueError`` as :meth:`checked` does."""
        if self.type == "string":
            return self.checked(text)
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            value = text
        return self.checked(value)

    def _converted(self, value: Any) -> ParameterValue:
        element = _ELEMENTS.get(self.type)
        if element is not None:
            if not isinstance(value, list) or (self.size and len(value) not in (0, self.size)):
                raise ValueError
            return [float(v) if element == "double" else v for v in value if self._is_of(element, v)]
        if not self._is_of(self.type, value):
            raise ValueError
        if self.type == "double":
            value = float(value)
        if self.minimum is not None and self.maximum is not None and not self.minimum <= value <= self.maximum:
            raise ValueError
        if self.choices and value not in self.choices:
            raise ValueError
        return value

    @staticmethod
    def _is_of(kind: str, value: Any) -> bool:
        accepted: dict[str, tuple[type, ...]] = {
            "bool": (bool,), "integer": (int,), "double": (int, float), "string": (str,),
        }  # fmt: skip
        fits = isinstance(value, accepted[kind]) and (kind == "bool" or not isinstance(value, bool))
        if not fits or (kind == "double" and not math.isfinite(value)):
            raise ValueError
        return True


def schema_path(node: str) -> Path:
    """The schema of a node by its executable's name."""
    return share_directory() / "config" / f"{node}.schema.yaml"


def read_schema(path: Path) -> list[ParameterEntry]:
    """Entries of a schema, in its order."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [
        ParameterEntry(name, **{"default": None, **entry, "choices": tuple(entry.get("choices", ()))})
        for name, entry in content.items()
    ]


def of_every_node(name: str) -> bool:
    """Whether rclpy itself declares or understands a parameter."""
    return name in ("use_sim_time", "start_type_description_service") or name.startswith("qos_overrides.")


def parameter_owners() -> dict[str, str]:
    """Node of each parameter; a parameter of several nodes counts for the last of them."""
    return {entry.name: node for node in SCHEMAS for entry in read_schema(schema_path(node))}


def no_parameters(node: str) -> str:
    """The answer to a parameter for a node that has none, only options."""
    return f"{node} has no parameters; --help lists its options"
