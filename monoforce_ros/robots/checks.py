"""Checks of the fields of a robot file; every error names the file, the field, what was got and what was expected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


class RobotFileError(ValueError):
    """The robot file is invalid; the message names the file, the field, the value and what was expected."""


class FieldChecks:
    """Reads fields of a parsed robot file."""

    def __init__(self, path: Path):
        self.path = path

    def fail(self, where: str, got: object, expected: str) -> RobotFileError:
        """The error for a field."""
        return RobotFileError(f"{self.path}: {where}: got {got!r}, expected {expected}")

    def mapping(self, content: Any, where: str, known: set[str], required: Sequence[str] = ()) -> Mapping[str, Any]:
        """A mapping with known keys only, and with all that are required."""
        if not isinstance(content, Mapping):
            raise self.fail(where, content, "a mapping")
        for key in content:
            if key not in known:
                raise self.fail(where, key, f"one of the keys {sorted(known)}")
        for key in required:
            if key not in content:
                raise self.fail(where, sorted(content), f"the key {key!r}, which is missing")
        return content

    def number(self, value: Any, where: str, low: float, high: float, unit: str) -> float:
        """A number within bounds."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise self.fail(where, value, f"a number from {low:g} to {high:g} {unit}")
        return float(value)

    def vector(self, value: Any, where: str, count: int, bound: float, unit: str) -> np.ndarray:
        """A list of numbers, each within ±``bound``."""
        if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != count:
            raise self.fail(where, value, f"a list of {count} numbers [{unit}]")
        return np.array([self.number(v, f"{where}[{i}]", -bound, bound, unit) for i, v in enumerate(value)])

    def items(self, content: Any, where: str) -> Sequence[Any]:
        """A list."""
        if not isinstance(content, Sequence) or isinstance(content, str):
            raise self.fail(where, content, "a list")
        return content
