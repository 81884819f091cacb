"""Effect: a named piece of physics with parameters that leaves a rollout unchanged at its neutral values."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

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


class Effect(ABC):
    """Base of the catalogue: one small file an effect.

    A command effect changes drive speeds, a contact or body effect the setup of the rollout, a measurement effect what
    is recorded of it. The defaults below do nothing, so an effect overrides just what it acts on.
    """

    name: ClassVar[str]
    stage: ClassVar[str]
    summary: ClassVar[str]
    formula: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds ``[B, T, D]`` [m/s] that the drives make of commanded ones.

        Args:
            speeds: commanded, the time before the start included.
            values: parameters.
            time_step: between the speeds [s].
            offsets: lateral offset of each drive ``[D]`` [m], left positive.
        """
        return speeds

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect in it."""
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


def per_trajectory(value: Tensor, dimensions: int) -> Tensor:
    """A scalar or ``[B]`` shaped to multiply a tensor of ``dimensions`` dimensions whose first is the batch."""
    return value if value.ndim == 0 else value.reshape(-1, *[1] * (dimensions - 1))
