"""Effect: a named piece of physics with parameters that leaves a rollout unchanged at its neutral values."""

from __future__ import annotations

import math
from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor

from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.effects.setup import Setup

STAGES = ("command", "contact", "body", "measurement")
Values = Mapping[str, Tensor]
"""Parameter values by name, each a scalar or ``[B]``."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect."""

    name: str
    unit: str
    neutral: float
    """Value at which the effect does nothing."""
    low: float
    high: float
    scale: float
    """How far from neutral a robot is typically found: the prior's standard deviation."""
    meaning: str


@dataclass(frozen=True)
class WheelResponse:
    """What measured wheel speeds show of an effect: how one parameter changes commanded wheel speeds."""

    parameter: str
    speeds: Callable[[np.ndarray, float, float], np.ndarray]
    """Wheel speeds ``[sides, T]`` [m/s] of commanded ones, the parameter's value and the time step [s]."""
    starts: Callable[[float], tuple[float, ...]]
    """Values from which a fit starts, of the fastest commanded speed [m/s]."""
    bounds: Callable[[float], tuple[float, float]]
    """Bounds of the fit, of the fastest commanded speed [m/s]."""
    counts: Callable[[float, float], bool]
    """Whether a fitted value is an effect at all, of the value and the fastest commanded speed [m/s]."""
    wording: str
    """How a report says it, with the value in braces."""
    excludes: tuple[str, ...] = ()
    """Effects that a model of the wheels does not hold beside this one: too alike to be fitted together."""


class Effect(ABC):
    """Base of the catalogue: one small file for each effect, which says everything about it.

    A command effect changes drive speeds, a contact or body effect the setup of the rollout, a measurement effect what
    is recorded. The methods below do nothing, so an effect overrides only what it acts on. The class attributes
    say what ``diagnose`` needs to know; :mod:`monoforce_ros.effects.catalogue` checks them when it finds the file.
    """

    name: ClassVar[str]
    stage: ClassVar[str]
    summary: ClassVar[str]
    formula: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    order: ClassVar[int | None] = None
    """Position among the effects that change drive speeds, smallest first: electronics, then mechanics, then ground.
    Required of every effect that overrides :meth:`drive_speeds`."""
    identified: ClassVar[tuple[str, ...]] = ()
    """Parameters that a recording of motion and commands can identify, the decisive one first. Empty: ``diagnose`` does
    not try this effect."""
    manoeuvre: ClassVar[str] = ""
    """What to drive so that the effect shows."""
    separated_by: ClassVar[Mapping[str, str]] = {}
    """Effects that a recording may confuse with this one, and the manoeuvre that separates both. One of two files is
    enough."""
    separated_by_sensor: ClassVar[Mapping[str, str]] = {}
    """Effects that no manoeuvre separates from this one, and the sensor that does."""
    formula_terms: ClassVar[tuple[str, ...]] = ()
    """Terms of ``learned_term`` that this effect consists of."""
    commissioning_start: ClassVar[Mapping[str, float]] = {}
    """Values from which commissioning fits the effect to a healthy robot; empty where it does not."""
    wheel_response: ClassVar[WheelResponse | None] = None
    """What measured wheel speeds show of the effect."""
    gyro_measures: ClassVar[str] = ""
    """Parameter that the comparison of poses with a gyro measures directly."""

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds ``[B, T, D]`` [m/s] that result from commanded ones.

        Args:
            speeds: commanded, the time before the start included.
            values: parameters.
            time_step: between the speeds [s].
            offsets: lateral offset of each drive ``[D]`` [m], left positive.
        """
        return speeds

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        return setup

    def turned(self, values: Mapping[str, float | Tensor], heading: Tensor) -> Mapping[str, float | Tensor]:
        """Parameters that hold in the odometry frame, in frames turned about the vertical by ``heading`` ``[B]``."""
        return values

    def motion(self, motion: MotionTrack, values: Mapping[str, float]) -> MotionTrack:
        """Motion as it is recorded under this effect."""
        return motion

    def commands(self, commands: CommandTrack, values: Mapping[str, float]) -> CommandTrack:
        """Commands as they are recorded under this effect."""
        return commands

    def first_values(self) -> list[dict[str, float]]:
        """Values of the identified parameters from which a fit starts, spread over the typical range."""
        known = {parameter.name: parameter for parameter in self.parameters}
        neutral = {key: known[key].neutral for key in self.identified}
        decisive = known[self.identified[0]]
        starts = [decisive.neutral + factor * decisive.scale for factor in (-2.0, -1.0, -0.4, 0.4, 1.0, 2.0)]
        return [neutral | {decisive.name: float(value)} for value in starts if decisive.low <= value <= decisive.high]

    def complaint(self) -> str:
        """What is wrong with this effect's own description; empty where it is complete."""
        known = [parameter.name for parameter in self.parameters]
        missing = [key for key in ("name", "stage", "summary", "formula", "source") if not getattr(self, key, "")]
        if missing:
            return f"has no {', '.join(missing)}"
        if self.stage not in STAGES:
            return f"stage: got {self.stage!r}, expected one of {STAGES}"
        changes_speeds = type(self).drive_speeds is not Effect.drive_speeds
        if (changes_speeds or self.stage == "command") and self.order is None:
            return "changes drive speeds and has no order: set its position among the command effects"
        for label, keys in (("identified", self.identified), ("commissioning_start", tuple(self.commissioning_start))):
            unknown = sorted(set(keys) - set(known))
            if unknown:
                return f"{label}: parameters {unknown} are unknown; expected some of {known}"
        if self.identified and not self.manoeuvre:
            return "can be identified and names no manoeuvre that shows it"
        unbounded = any(math.isinf(parameter.neutral) for parameter in self.parameters)
        if self.identified and unbounded and type(self).first_values is Effect.first_values:
            return "has an infinite neutral value: override first_values"
        return ""


def per_trajectory(value: Tensor, dimensions: int) -> Tensor:
    """A scalar or ``[B]`` shaped to multiply a tensor of ``dimensions`` dimensions whose first is the batch."""
    return value if value.ndim == 0 else value.reshape(-1, *[1] * (dimensions - 1))
