"""Motor efforts: whether the drives' motors work as hard as the healthy robot's do for the same commands.

Currents (or torques) that a driver publishes with the wheels' joint states tell apart what looks alike in the motion:
wheels in the air turn easily, a brake that drags or ground that yields takes more. What they say is an observation
beside the diagnosis, and names no effect: slopes, loads and other ground change them, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import nnls
from scipy.stats import t as student

from monoforce_ros.core import CommandTrack, EffortTrack, WheelTrack
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.trial import BLOCK
from monoforce_ros.discrepancy.wheel_motion import half_track, side_speeds
from monoforce_ros.robots import RobotModel

_SIDES = ("left", "right")
_TERMS = ("constant", "speed", "turn")
"""Of the effort of a side: one that any driving takes, one with its commanded speed, one with that at which the sides
are commanded apart, for skidding tyres take most of what a turn takes."""
_SEGMENT = 2 * BLOCK
"""Length of the segments between which efforts vary [s], as the healthy robot's residuals do."""
_PIECE = 2.0
"""Length of the pieces to which the terms are fitted [s]: a window, in which delays of the drives hardly count."""
_COMMANDED = 0.05
"""Speed of a side from which on a command asks its wheels to turn [m/s], as in the check of the motion."""
_FEWEST_SEGMENTS = 3
"""Of fewer nobody knows how much they differ."""
_LEAST = 1e-3
"""Effort, as a share of the expected one, that counts as none: the logarithm of none is not a number."""
_BATTERY = 1.1
"""Factor by which currents change with the charge alone: for the same power they go with the inverse of the voltage,
and that of a lead or lithium battery falls by about a fifth from full to empty."""
_HARDLY = 0.5
"""Share of the healthy effort below which most of it is missing: by the meaning of "most"."""
NOTHING = np.zeros((0, 2), np.int64)
"""No stretches."""


@dataclass(frozen=True)
class _Pieces:
    """Pieces of a recording in which each side is commanded to turn."""

    terms: np.ndarray
    """Means of the terms, ``[n, 2, 3]`` [1, m/s, m/s]."""
    efforts: np.ndarray
    """Mean efforts, ``[n, 2]``."""
    segments: np.ndarray
    """Number of the segment of each, ``[n]``."""

    @classmethod
    def of(cls, commands: CommandTrack, efforts: EffortTrack, robot: RobotModel, left_out: np.ndarray) -> _Pieces:
        """Of a recording without stretches ``[n, 2]`` [ns] of it; commands beyond what the robot's base carries out
        count as its limits."""
        stamps = efforts.stamps
        twists = commands.sample(stamps)
        bounds = np.array([robot.maximum_speed, robot.maximum_yaw_rate, robot.maximum_lateral_speed])[: twists.shape[1]]
        twists = np.clip(twists, -bounds, bounds)
        speeds = np.abs(side_speeds(robot, twists))
        apart = np.broadcast_to(half_track(robot) * np.abs(twists[:, 1:2]), speeds.shape)
        terms = np.stack([np.ones_like(speeds), speeds, apart], axis=-1)
        driven = (speeds > _COMMANDED).all(axis=1) & (stamps >= commands.stamps[0])
        for low, high in left_out:
            driven &= (stamps < low) | (stamps > high)
        numbers = (stamps - stamps[0]) // round(_PIECE * 1e9)
        kept = []
        for number in np.unique(numbers[driven]):
            inside = numbers == number
            # A start or a stop within a piece is none of its speed.
            if driven[inside].all():
                kept.append((terms[inside].mean(axis=0), efforts.efforts[inside].mean(axis=0), number))
        segments = np.array([number for *_, number in kept], np.int64) * round(_PIECE * 1e9) // round(_SEGMENT * 1e9)
        return cls(
            np.array([term for term, *_ in kept]).reshape(-1, 2, len(_TERMS)),
            np.array([effort for _, effort, _ in kept]).reshape(-1, 2),
            segments,
        )

    def __getitem__(self, chosen: np.ndarray) -> _Pieces:
        return _Pieces(self.terms[chosen], self.efforts[chosen], self.segments[chosen])

    @property
    def known(self) -> bool:
        """Whether there are segments enough to know how much they differ."""
        return len(np.unique(self.segments)) >= _FEWEST_SEGMENTS

    def fitted(self) -> np.ndarray:
        """Coefficients of the terms, none negative, ``[2, 3]`` [driver's unit, and this over m/s]."""
        return np.stack([nnls(self.terms[:, side], self.efforts[:, side])[0] for side in range(2)])

    def ratios(self, coefficients: np.ndarray) -> np.ndarray:
        """Logarithms of measured over expected effort of each segment, ``[S, 2]``."""
        expected = np.einsum("nsk,sk->ns", self.terms, coefficients)
        rows = []
        for segment in np.unique(self.segments):
            inside = self.segments == segment
            whole = np.maximum(expected[inside].sum(axis=0), 1e-12)
            rows.append(np.log(np.maximum(self.efforts[inside].sum(axis=0) / whole, _LEAST)))
        return np.array(rows)


@dataclass(frozen=True)
class HealthyEfforts:
    """How hard the motors of the healthy robot work."""

    coefficients: np.ndarray
    """Of constant, commanded speed and half of the sides' difference, for left and right, ``[2, 3]``."""
    spread: np.ndarray
    """Standard deviation of the logarithm of measured over expected effort between segments, ``[2]``."""
    segments: int
    """Number of segments."""

    @classmethod
    def learned(
        cls, recordings: Sequence[tuple[CommandTrack, EffortTrack | None, np.ndarray]], robot: RobotModel
    ) -> HealthyEfforts | None:
        """From recordings of the healthy robot; None where one has no efforts, or all together too few segments.

        Each segment is predicted by the others.

        Args:
            recordings: commands, efforts and the stretches that are left out, see :func:`changed_efforts`.
            robot: whose track width is used.
        """
        cut, first = [], 0
        for commands, efforts, left_out in recordings:
            if efforts is None or not len(commands):
                return None
            pieces = _Pieces.of(commands, efforts, robot, left_out)
            cut.append(_Pieces(pieces.terms, pieces.efforts, pieces.segments + first))
            first = int(max(cut[-1].segments, default=first - 1)) + 1
        together = _Pieces(
            *(np.concatenate([getattr(c, name) for c in cut]) for name in ("terms", "efforts", "segments"))
        )
        if not together.known or not together.efforts.any(axis=0).all():
            return None
        ratios = []
        for segment in np.unique(together.segments):
            inside = together.segments == segment
            ratios.append(together[inside].ratios(together[~inside].fitted())[0])
        return cls(together.fitted(), np.std(ratios, axis=0, ddof=1), len(ratios))

    def entry(self) -> dict[str, Any]:
        """The entry ``commissioning.efforts`` of a robot file."""
        terms = {
            side: {term: float(f"{value:.4g}") for term, value in zip(_TERMS, row, strict=True)}
            for side, row in zip(_SIDES, self.coefficients, strict=True)
        }
        spread = {side: float(f"{value:.3g}") for side, value in zip(_SIDES, self.spread, strict=True)}
        return {"terms": terms, "spread": spread, "segments": self.segments}

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> HealthyEfforts:
        """From the entry of a robot file.

        Raises:
            KeyError, TypeError, ValueError: the entry is invalid.
        """
        coefficients = np.array([[float(entry["terms"][side][term]) for term in _TERMS] for side in _SIDES])
        spread = np.array([float(entry["spread"][side]) for side in _SIDES])
        segments = int(entry["segments"])
        numbers = np.r_[coefficients.ravel(), spread]
        if not np.isfinite(numbers).all() or (numbers < 0).any() or segments < _FEWEST_SEGMENTS:
            raise ValueError(f"efforts: expected numbers of 0 or more, and {_FEWEST_SEGMENTS} segments or more")
        return cls(coefficients, spread, segments)


def changed_efforts(
    commands: CommandTrack,
    efforts: EffortTrack | None,
    wheels: WheelTrack | None,
    robot: RobotModel,
    healthy: HealthyEfforts | None,
    thresholds: Thresholds = Thresholds(),  # noqa: B008
    *,
    left_out: np.ndarray = NOTHING,
) -> tuple[str, ...]:
    """Sides whose motors work harder, or less hard, than the healthy robot's for the same commands, one sentence each.

    Healthy drives differ by a share (``drive_share``) of the variance between segments of one, beside what both means
    are uncertain by; a side is named at half of ``effect_rate``, the stated rate of false alarms.

    Args:
        commands: of the recording.
        efforts: of its motors; None if nothing was recorded.
        wheels: measured speeds, which tell whether the wheels turn.
        robot: whose track width is used.
        healthy: what commissioning learned; None if unknown.
        thresholds: stated rates, and how much healthy drives differ.
        left_out: start and end of stretches in which something else moves or holds the robot, ``[n, 2]`` [ns]: a
            joystick, under which the last command counts for nothing, or wheels that turn in place.
    """
    if efforts is None or healthy is None or not len(efforts) or not len(commands):
        return ()
    pieces = _Pieces.of(commands, efforts, robot, left_out)
    if not pieces.known:
        return ()
    ratios = pieces.ratios(healthy.coefficients)
    count = len(ratios)
    of_healthy = healthy.spread**2 * (thresholds.drive_share + 1.0 / healthy.segments)
    of_drive = np.var(ratios, axis=0, ddof=1) / count
    error = np.sqrt(np.maximum(of_healthy + of_drive, 1e-12))
    # Welch and Satterthwaite.
    degrees = error**4 / (of_healthy**2 / (healthy.segments - 1) + of_drive**2 / (count - 1) + 1e-30)
    turning = _turning(commands, wheels, robot)
    texts = []
    for side, name in enumerate(_SIDES):
        middle, reach = float(ratios[:, side].mean()), float(error[side])
        if abs(middle) <= student.ppf(1.0 - 0.25 * thresholds.effect_rate, degrees[side]) * reach:
            continue
        width = student.ppf(0.5 + 0.5 * thresholds.confidence, degrees[side]) * reach
        low, high = np.exp(middle - width), np.exp(middle + width)
        if low < _BATTERY and high > 1.0 / _BATTERY:
            continue
        texts.append(_sentence(name, float(np.exp(middle)), float(low), float(high), turning[side]))
    return tuple(texts)


def _turning(commands: CommandTrack, wheels: WheelTrack | None, robot: RobotModel) -> list[bool | None]:
    """Whether the wheels of each side turn for most of the time in which they are commanded to; None if unknown."""
    if wheels is None or robot.wheel_radius is None or not len(wheels):
        return [None, None]
    asked = np.abs(side_speeds(robot, commands.sample(wheels.stamps))) > _COMMANDED
    turned = np.abs(wheels.speeds) * robot.wheel_radius > _COMMANDED
    return [bool(turned[asked[:, s], s].mean() > 0.5) if asked[:, s].any() else None for s in range(2)]


def _sentence(side: str, ratio: float, low: float, high: float, turning: bool | None) -> str:
    """What the efforts of a side say, in the words of a mechanic."""
    while_ = {True: " while the wheels turn", False: " although the wheels do not turn", None: ""}[turning]
    size = f"{ratio:.2g} times ({low:.2g} to {high:.2g})"
    text = f"the {side} motors draw {size} the current of the healthy robot for the same commands{while_}"
    if ratio > 1.0:
        asked = "a brake, stiff ground contact or a load" if turning is not False else "a blocked wheel"
        return f"{text}: look for {asked}, ground that yields, or a slope"
    if high >= _HARDLY:
        return f"{text}: look for less load, other ground, or a slope that leads down"
    if turning is False:
        return f"{text}: are they switched off, or is a fuse blown?"
    return f"{text}, hardly any: are the wheels off the ground, or a chain or gear broken?"
