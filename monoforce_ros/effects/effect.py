"""Effect: a named physical effect whose parameters leave a rollout unchanged at their neutral values."""

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
from monoforce_ros.robots import Flipper, RobotModel
from monoforce_ros.terrain import TerrainMap

STAGES = ("command", "contact", "body", "measurement")
REFERENCE_MASS = 50.0
"""Of the robot for which typical forces and loads are listed [kg]: a Clearpath Husky."""
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
    """Typical deviation from neutral: standard deviation of the prior."""
    meaning: str
    resolution: float = 0.0
    """Smallest change that predictions show; finite differences are at least as large."""
    attainable: bool = False
    """Whether a robot can have the values at the bounds, as the whole of a share; else they only limit a search."""
    of_mass: bool = False
    """Whether ``scale`` is that of a robot of ``REFERENCE_MASS`` and grows with the mass, as forces and loads do."""

    def typical(self, robot: RobotModel) -> float:
        """Typical deviation from neutral on a robot."""
        return self.scale * float(robot.mass) / REFERENCE_MASS if self.of_mass else self.scale


@dataclass(frozen=True)
class Product:
    """A product or sum of two parameters, which a recording may determine better than either of them."""

    name: str
    factors: tuple[str, str]
    unit: str
    meaning: str
    adds: bool = False
    """Whether it is their sum."""

    def of(self, one: float, other: float) -> float:
        """Its value."""
        return one + other if self.adds else one * other

    def slopes(self, one: float, other: float) -> tuple[float, float]:
        """Its derivatives by both."""
        return (1.0, 1.0) if self.adds else (other, one)


@dataclass(frozen=True)
class Fastest:
    """Fastest commands of a recording."""

    speed: float
    """Of the wheels [m/s]."""
    yaw_rate: float
    """Of the robot [rad/s]."""


@dataclass(frozen=True)
class WheelResponse:
    """An effect in measured wheel speeds: how its parameters change commanded wheel speeds."""

    parameter: str
    """That says how large the effect is."""
    speeds: Callable[..., np.ndarray]
    """(commands, parameter value, those of ``further``, time step [s]) → changed commands. Commands are wheel speeds
    ``[..., 2, T]`` [m/s], left and right, or, with ``of_twist``, forward speed [m/s], yaw rate [rad/s] and, of a robot
    that crabs, lateral speed [m/s], ``[..., 2 or 3, T]``. Values are scalars, or ``[..., 1, 1]``."""
    starts: Callable[[Fastest], tuple[float, ...]]
    """Initial values of a fit."""
    bounds: Callable[[Fastest], tuple[float, float]]
    """Bounds of the fit."""
    counts: Callable[[float, Fastest], bool]
    """Whether a fitted value is large enough to count as an effect: where wheels show a smaller one beyond chance, it
    is not named, and where their interval holds only smaller ones, the effect is ruled out (a test of equivalence needs
    such a margin, which no standard error supplies)."""
    wording: str
    """Text for reports, with braces for the values."""
    further: tuple[str, ...] = ()
    """Further parameters; they start at their neutral values and keep to the catalogue's bounds."""
    of_twist: bool = False
    """Whether the effect changes the commanded twist rather than the wheel speeds."""
    of_time: bool = False
    """Whether ``speeds`` also takes the times of the commands since the recording's start, ``[n, 1, T]`` [s]."""
    excludes: tuple[str, ...] = ()
    """Effects that a wheel model does not combine with this one because they are too similar to be fitted together;
    ``drive_gain`` stands for a ratio of wheel speeds and commands that is fitted."""


class Effect(ABC):
    """Base class of the catalogue's effects. One small file defines each effect completely.

    A command effect changes commanded twists or drive speeds, a contact or body effect changes the setup of the
    rollout, and a measurement effect changes recorded data. The methods below do nothing; an effect overrides those it
    needs. ``diagnose`` reads the class attributes; :mod:`monoforce_ros.effects.catalogue` checks them at import.
    """

    name: ClassVar[str]
    stage: ClassVar[str]
    summary: ClassVar[str]
    formula: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    cause: ClassVar[str] = ""
    """The effect in a few words of somebody who repairs robots, for lists of what else it could be."""
    remedy: ClassVar[str] = "use the written robot file, or mend the robot and record again"
    """What to check on the robot where it was found, as an order without a full stop."""
    compared: ClassVar[str] = ""
    """How its sentence compares it with the model: as a ``factor`` on what the robot's file says, or as a ``distance``
    from that; empty where it gives values as they are."""
    uncertainty: ClassVar[str] = ""
    """Setting of a prediction's ensemble, ``friction`` or ``gain``, that is the standard deviation of the first
    parameter: about its value where that is a factor, else absolute."""
    one_sided: ClassVar[bool] = False
    """Whether it changes both sides differently, so that the robot's mirror image moves otherwise."""
    like_ratio: ClassVar[bool] = False
    """Whether wheels show it as another ratio of their speeds to the commanded ones."""
    like_track_width: ClassVar[bool] = False
    """Whether wheels show it as another distance of both sides."""
    limits: ClassVar[str] = ""
    """What it limits for a planner: ``drives`` (their speed), ``yaw_rate``, ``acceleration``, ``yaw_acceleration`` of
    the base, or ``motors`` (both accelerations)."""
    nameless: ClassVar[bool] = False
    """Whether it is a formula for what the catalogue has no name for."""
    fitted_in_training: ClassVar[bool] = False
    """Whether the training of an encoder fits it to the vegetation that a robot drove through."""
    joints_measure: ClassVar[bool] = False
    """Whether comparing measured joint angles with commanded ones measures it."""
    order: ClassVar[int | None] = None
    """Position among the effects on commands, smallest first: the base controller, electronics, mechanics, ground.
    Required for every effect that overrides :meth:`twists` or :meth:`drive_speeds`; all twists change first."""
    like_a_slope: ClassVar[bool] = True
    """Whether a contact or body effect may be the pull of slopes that no map shows. One that only changes how the robot
    turns is none: a slope pulls whichever way the robot turns."""
    acts_on_steering: ClassVar[bool] = False
    """Whether :meth:`drive_speeds` also acts on steering angles, as a delay of all commands does."""
    shifts: ClassVar[str] = ""
    """Parameter by which the motion is shifted in time against the commands, as by a dead time or a clock [s]."""
    shifts_cycle: ClassVar[bool] = False
    """Whether it shifts commands to both sides, as where a controller's cycle begins at another time than before."""
    clock: ClassVar[str] = ""
    """Parameter that is the time since a recording's start: predictions of recordings set it for each trajectory."""
    needs: ClassVar[str] = ""
    """``steering`` or ``flippers`` for an effect on these joints: it does nothing on robots without them, and is no
    candidate there."""
    identified: ClassVar[tuple[str, ...]] = ()
    """Parameters that a recording of motion and commands can identify, the most important first. If empty, ``diagnose``
    does not test this effect."""
    manoeuvre: ClassVar[str] = ""
    """Manoeuvre that makes the effect observable."""
    separated_by: ClassVar[Mapping[str, str]] = {}
    """Similar effects and the manoeuvre that separates each from this one. One of the two files is enough."""
    separated_by_sensor: ClassVar[Mapping[str, str]] = {}
    """Effects that no manoeuvre separates from this one, and the sensor that does."""
    refined: ClassVar[tuple[str, ...]] = ()
    """Parameters that are fitted in addition where a recording shows them beyond chance."""
    products: ClassVar[tuple[Product, ...]] = ()
    """Products of parameters that act on the motion by themselves, as a load's moment does."""
    formula_terms: ClassVar[tuple[str, ...]] = ()
    """Terms of ``learned_term`` that are equivalent to this effect."""
    commissioning_start: ClassVar[Mapping[str, float]] = {}
    """Initial values for commissioning on a healthy robot; empty if commissioning does not fit this effect."""
    often_commissioned: ClassVar[Mapping[str, float]] = {}
    """Values at which commissioning also begins, of an effect that many robots have and that others stand in for if
    they are fitted without it."""
    commissioned_over: ClassVar[str] = ""
    """``vegetation`` for an effect that commissioning fits only to recordings with it on their map: elsewhere it does
    nothing."""
    wheel_response: ClassVar[WheelResponse | None] = None
    """The effect in measured wheel speeds."""
    gyro_measures: ClassVar[str] = ""
    """Parameter that comparing poses with a gyro measures directly."""

    def twists(self, twists: Tensor, values: Values, time_step: float) -> Tensor:
        """Twists ``[B, T, 2]`` [m/s, rad/s] that the base controller makes of commanded ones.

        Args:
            twists: commanded forward speed and yaw rate ``[B, T, 2]``, including those before the start.
            values: parameter values.
            time_step: time between twists [s].
        """
        return twists

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds ``[B, T, D]`` [m/s] from commanded ones.

        Args:
            speeds: commanded drive speeds ``[B, T, D]`` [m/s], including those before the start.
            values: parameter values.
            time_step: time between speeds [s].
            offsets: lateral offset of each drive ``[D]`` [m], left positive.
        """
        return speeds

    def steering_angles(self, angles: Tensor, speeds: Tensor, values: Values, time_step: float) -> Tensor:
        """Steering angles ``[B, T, S]`` [rad] from commanded ones, of an effect that needs ``steering``.

        Args:
            angles: commanded angles ``[B, T, S]`` [rad], including those before the start.
            speeds: of the drives at the same times ``[B, T, D]`` [m/s].
            values: parameter values.
            time_step: time between angles [s].
        """
        return angles

    def flipper_angles(self, targets: Tensor, start: Tensor, values: Values, flippers: tuple[Flipper, ...]) -> Tensor:
        """Angles ``[B, T, F]`` [rad] that flippers follow, from commanded ones, of an effect that needs ``flippers``.

        Args:
            targets: commanded angles ``[B, T, F]`` [rad].
            start: their angles at the start ``[B, F]`` [rad].
            values: parameter values.
            flippers: of the robot.
        """
        return targets

    def applies_to(self, robot: RobotModel | None) -> bool:
        """Whether a robot has the joints that this effect needs; None stands for one that has all."""
        if robot is None or not self.needs:
            return True
        return bool(robot.flippers) if self.needs == "flippers" else robot.steered is not None

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        return setup

    def ground(self, terrain: TerrainMap, values: Values, usual: Values, part: Tensor) -> TerrainMap | None:
        """The map under this effect on a part of the ground; None for an effect that is no property of the ground.

        Args:
            terrain: one map.
            values: parameter values on the part, scalars.
            usual: those that the robot has everywhere.
            part: cells of it, ``[rows, columns]`` bool.
        """
        return None

    @property
    def of_base(self) -> bool:
        """Whether it is one of the base controller, which changes twists before they become speeds of drives."""
        return type(self).twists is not Effect.twists

    @property
    def everywhere(self) -> bool:
        """Whether it acts wherever the robot is: what happens to commands and measurements has nothing to do with the
        ground."""
        return self.stage in ("command", "measurement")

    @property
    def of_ground(self) -> bool:
        """Whether it is a property of the ground, so that :meth:`ground` can change it on a part."""
        return type(self).ground is not Effect.ground

    def turned(self, values: Mapping[str, float | Tensor], heading: Tensor) -> Mapping[str, float | Tensor]:
        """Odometry-frame parameters expressed in frames yawed by ``heading`` ``[B]`` [rad]."""
        return values

    def motion(self, motion: MotionTrack, values: Mapping[str, float]) -> MotionTrack:
        """Motion as recorded under this effect."""
        return motion

    def commands(self, commands: CommandTrack, values: Mapping[str, float]) -> CommandTrack:
        """Commands as recorded under this effect."""
        return commands

    def sentence(self, values: Mapping[str, float]) -> str:
        """What the effect means for the robot, as one sentence in the words of somebody who repairs robots.

        Args:
            values: the parameters that were estimated; not all need be there.

        Raises:
            KeyError: a parameter that the sentence needs is missing.
        """
        listed = ", ".join(f"{p.name} {values[p.name]:.3g} {p.unit}" for p in self.parameters if p.name in values)
        return f"{self.summary.rstrip('.')}: {listed}."

    def beyond(
        self, values: Mapping[str, float], in_file: Mapping[str, float], outside: frozenset[str]
    ) -> Mapping[str, float]:
        """Values for :meth:`sentence` where the robot's file has the effect already: those beyond the file's of an
        effect that the sentence compares with the model.

        Args:
            values: estimated.
            in_file: of the robot's file.
            outside: parameters whose confidence interval does not hold the file's value.
        """
        apart = {key: value for key, value in in_file.items() if key in values}
        if self.compared == "factor":
            return {**values, **{key: values[key] / value for key, value in apart.items()}}
        if self.compared == "distance":
            return {**values, **{key: values[key] - value for key, value in apart.items()}}
        return values

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Initial values of the identified parameters for a fit on a robot, spread over the typical range."""
        known = {parameter.name: parameter for parameter in self.parameters}
        neutral = {key: known[key].neutral for key in self.identified}
        main = known[self.identified[0]]
        starts = [main.neutral + factor * main.typical(robot) for factor in (-2.0, -1.0, -0.4, 0.4, 1.0, 2.0)]
        return [neutral | {main.name: float(value)} for value in starts if main.low <= value <= main.high]

    def complaint(self) -> str:
        """Error in this effect's class attributes; empty if there is none."""
        known = [parameter.name for parameter in self.parameters]
        missing = [key for key in ("name", "stage", "summary", "formula", "source") if not getattr(self, key, "")]
        if missing:
            return f"has no {', '.join(missing)}"
        if self.stage not in STAGES:
            return f"stage: got {self.stage!r}, expected one of {STAGES}"
        kind = type(self)
        changes_speeds = kind.drive_speeds is not Effect.drive_speeds or kind.twists is not Effect.twists
        if self.needs not in ("", "steering", "flippers"):
            return f"needs: got {self.needs!r}, expected steering, flippers or nothing"
        if self.commissioned_over not in ("", "vegetation"):
            return f"commissioned_over: got {self.commissioned_over!r}, expected vegetation or nothing"
        if self.order is not None and not isinstance(self.order, int):
            return f"order: got {self.order!r}, expected a whole number"
        if (changes_speeds or self.stage == "command") and self.order is None:
            return "changes drive speeds but has no order: set its position among the command effects"
        if self.uncertainty not in ("", "friction", "gain"):
            return f"uncertainty: got {self.uncertainty!r}, expected friction, gain or nothing"
        if self.compared not in ("", "factor", "distance"):
            return f"compared: got {self.compared!r}, expected factor, distance or nothing"
        if self.limits not in ("", "drives", "yaw_rate", "acceleration", "yaw_acceleration", "motors"):
            return f"limits: got {self.limits!r}, expected drives, yaw_rate, acceleration, yaw_acceleration or motors"
        listed = {
            "identified": self.identified, "refined": self.refined,
            "commissioning_start": tuple(self.commissioning_start),
            "often_commissioned": tuple(self.often_commissioned),
            **{f"products: {product.name}": product.factors for product in self.products},
        }  # fmt: skip
        for label, keys in listed.items():
            unknown = sorted(set(keys) - set(known))
            if unknown:
                return f"{label}: parameters {unknown} are unknown; expected some of {known}"
        if self.identified and not self.manoeuvre:
            return "can be identified but has no manoeuvre: set the one that makes it observable"
        if self.wheel_response is not None:
            seen = {self.wheel_response.parameter, *self.wheel_response.further}
            if not seen <= set(known):
                return f"wheel_response: parameters {sorted(seen - set(known))} are unknown; expected some of {known}"
        unbounded = any(math.isinf(parameter.neutral) for parameter in self.parameters)
        if self.identified and unbounded and type(self).first_values is Effect.first_values:
            return "has an infinite neutral value: override first_values"
        return ""


def per_trajectory(value: Tensor, dimensions: int) -> Tensor:
    """Reshape a scalar or ``[B]`` to broadcast over a tensor of ``dimensions`` dimensions, batch first."""
    return value if value.ndim == 0 else value.reshape(-1, *[1] * (dimensions - 1))
