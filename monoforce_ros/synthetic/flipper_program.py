"""Flipper program: commanded angles of a robot's flippers over time."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from monoforce_ros.synthetic.vehicle_parts import Arm

HOLD, STEPS = "hold", "steps"
_MAXIMUM_FILE_BYTES = 10_000_000
_STEP_RANGE = (-0.35, 0.6)
"""Angles of random steps [rad]: tips from below the tracks' own level to well above the ground."""
_STEP_TIMES = (2.5, 5.0)
_PAIR_SHARE = 0.6
"""Probability that the flippers of one end move together, as drivers do on a step."""


class FlipperProgram(Protocol):
    """Gives commanded angles for each instant."""

    def angles(self, time: float) -> np.ndarray:
        """Angles ``[F]`` [rad] at ``time`` [s]; calls are in ascending order of time."""
        ...


class FlipperTable:
    """Angles that are linear between given times and hold before and after them.

    Args:
        times: ``[n]`` ascending [s].
        angles: ``[n, F]`` [rad].
    """

    def __init__(self, times: np.ndarray, angles: np.ndarray):
        self._times, self._angles = times, angles

    @classmethod
    def read(cls, path: Path, flippers: Sequence[Arm]) -> FlipperTable:
        """Read a CSV file with a header: ``t`` [s] and names of flippers [rad]; flippers without a column hold.

        Raises:
            ValueError: there is no such file, or it is not a table of angles of these flippers.
        """
        names = [arm.name for arm in flippers]
        if not path.is_file():
            raise ValueError(
                f"flippers: got {str(path)!r}, expected {HOLD}, {STEPS} or a CSV file (t,{','.join(names)})"
            )
        if path.stat().st_size > _MAXIMUM_FILE_BYTES:
            raise ValueError(f"{path}: got {path.stat().st_size} bytes, expected at most {_MAXIMUM_FILE_BYTES}")
        with path.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row and not row[0].lstrip().startswith("#")]
        header = [cell.strip() for cell in rows[0]] if rows else []
        unknown = sorted(set(header[1:]) - set(names))
        if header[:1] != ["t"] or len(header) < 2 or unknown or len(set(header)) < len(header):
            raise ValueError(f"{path}: got the header {header}, expected t and some of {names}, each once")
        table = np.zeros((len(rows) - 1, len(header)))
        for number, row in enumerate(rows[1:]):
            try:
                table[number] = [float(cell) for cell in row]
            except ValueError:
                raise ValueError(f"{path}, row {number + 2}: got {row}, expected {len(header)} numbers") from None
        if not len(table) or not np.isfinite(table).all() or (np.diff(table[:, 0]) <= 0).any():
            raise ValueError(f"{path}: expected rows of finite numbers with ascending times")
        angles = np.tile([arm.angle for arm in flippers], (len(table), 1))
        for column, name in enumerate(header[1:], start=1):
            angles[:, names.index(name)] = table[:, column]
        return cls(table[:, 0], angles)

    def angles(self, time: float) -> np.ndarray:
        """Angles ``[F]`` [rad] at ``time`` [s]."""
        return np.array([np.interp(time, self._times, column) for column in self._angles.T])


class FlipperSteps:
    """Random steps of the flippers, together at an end or each alone, for identification.

    Args:
        flippers: in the order of the angles.
        random: draws the steps.
    """

    def __init__(self, flippers: Sequence[Arm], random: np.random.Generator):
        self._flippers, self._random = flippers, random
        self._angles = np.array([arm.angle for arm in flippers])
        self._next = 1.5

    def angles(self, time: float) -> np.ndarray:
        """Angles ``[F]`` [rad] at ``time`` [s]."""
        if time >= self._next:
            self._next = time + float(self._random.uniform(*_STEP_TIMES))
            fronts = np.array([arm.centre[0] > arm.place[0] for arm in self._flippers])
            chosen = fronts == (self._random.uniform() < 0.5)
            target = self._random.uniform(*_STEP_RANGE, len(self._flippers))
            if self._random.uniform() < _PAIR_SHARE:
                target[:] = target[0]
            self._angles = np.where(chosen, target, self._angles)
        return self._angles


def make_flipper_program(
    name_or_file: str, flippers: Sequence[Arm], random: np.random.Generator
) -> FlipperProgram | None:
    """The program ``hold``, ``steps`` or of a CSV file; None where flippers hold their angles.

    Raises:
        ValueError: the robot has no flippers, or the file is not a table of their angles.
    """
    if name_or_file == HOLD:
        return None
    if not flippers:
        raise ValueError(f"flippers: got {name_or_file!r} for a robot without flippers, expected {HOLD}")
    if name_or_file == STEPS:
        return FlipperSteps(flippers, random)
    return FlipperTable.read(Path(name_or_file).expanduser(), flippers)
