"""Sensor findings: what gyro, wheel speeds and joint angles measure, as effects and estimates of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from monoforce_ros.discrepancy.clocks import GyroFinding, compare_with_gyro, heading_disagreement
from monoforce_ros.discrepancy.comparison import HORIZONS, GapRow
from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.fit import robust
from monoforce_ros.discrepancy.flippers import BLOCKED, FlipperFinding, compare_with_commands
from monoforce_ros.discrepancy.healthy_wheels import HealthyWheels
from monoforce_ros.discrepancy.hypothesis import Effects, Predictions
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.thresholds import Thresholds
from monoforce_ros.discrepancy.wheels import WheelFinding, changed_drives, compare_with_wheels
from monoforce_ros.effects import CATALOGUE, only_effect
from monoforce_ros.robots import RobotModel

_CLOCK = only_effect(lambda effect: effect.gyro_measures and effect.shifts)
"""Effect by which the poses' clock differs from the gyro's."""
_BIAS = only_effect(lambda effect: effect.gyro_measures and not effect.identified)
"""Effect of the gyro itself, which its readings show."""


@dataclass(frozen=True)
class SensorFindings:
    """What sensors beside the localisation say of a recording."""

    gyro: GyroFinding | None
    wheels: WheelFinding | None
    known: Effects = ()
    """Effects that a sensor measured: they act in every hypothesis."""
    hints: Effects = ()
    """Values that a sensor suggests."""
    excluded: tuple[str, ...] = ()
    """Effects that a sensor rules out."""
    flippers: FlipperFinding | None = None

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        robot: RobotModel,
        *,
        commissioned: bool,
        healthy: HealthyWheels | None = None,
        thresholds: Thresholds = Thresholds(),  # noqa: B008
    ) -> SensorFindings:
        """Compare the sensors of a recording with its poses and commands.

        The gyro measures the offset of the pose clock, or that there is none. A commissioned file knows how the drives
        respond. What the wheels show may be different now, or only look so: the motion decides, against how much it
        varies on the healthy robot.

        Args:
            evidence: the recording.
            robot: the nominal model with the effects of its file.
            commissioned: whether the healthy robot is known.
            healthy: what commissioning learned of its wheels; None if unknown.
            thresholds: how much healthy drives differ.
        """
        if healthy is not None and not healthy.known_to(robot):
            healthy = None
        gyro = compare_with_gyro(evidence.smoothed, evidence.gyro)
        wheels = compare_with_wheels(evidence.commands, evidence.wheels, robot, healthy, thresholds.drive_spread)
        excluded: tuple[str, ...] = () if gyro is None else (_CLOCK,)
        stamps = evidence.smoothed.motion.stamps
        spans = [(stamps[part.start], stamps[part.stop - 1]) for part in evidence.smoothed.stretches]
        flippers = compare_with_commands(evidence.joints, robot, np.array(spans, np.int64).reshape(-1, 2))
        if not commissioned and not any(CATALOGUE[name].stage == "command" for name, _ in robot.effects):
            known = measured_effects(gyro, wheels, flippers)
            return cls(gyro, wheels, known, excluded=excluded, flippers=flippers)
        hints, unchanged = ((), ()) if wheels is None else changed_drives(wheels, robot, healthy)
        known = measured_effects(gyro, None, flippers)
        return cls(gyro, wheels, known, hints, excluded + unchanged, flippers)

    def with_interval(self, estimate: EffectEstimate, search: Search) -> EffectEstimate:
        """The estimate with the confidence interval of the sensor that measured it, if one did."""
        if estimate.name not in dict(search.known):
            return estimate
        if self.flippers is not None and estimate.name == BLOCKED:
            return self.flippers.estimate
        half_widths: Mapping[str, float]
        if self.gyro is not None and estimate.name == _CLOCK:
            half_widths = {"offset": self.gyro.offset_half_width}
        elif self.wheels is not None and estimate.name in dict(self.wheels.effects):
            names = [name for name, _ in self.wheels.effects]
            half_widths = self.wheels.half_widths[names.index(estimate.name)]
        else:
            return estimate
        parameters = {key: value.with_half_width(half_widths[key]) for key, value in estimate.parameters.items()}
        return EffectEstimate(estimate.name, parameters, in_file=estimate.in_file)


def measured_effects(gyro: GyroFinding | None, wheels: WheelFinding | None, flippers: FlipperFinding | None) -> Effects:
    """Effects that the gyro, the wheel speeds and the joint angles measure, that of the gyro first."""
    measured: Effects = ()
    if gyro is not None and gyro.poses_late:
        measured = ((_CLOCK, {"offset": gyro.offset}),)
    if wheels is not None:
        measured += wheels.effects
    return measured if flippers is None else (*measured, flippers.effect)


def refined_clock(known: Effects, gyro: GyroFinding, predictions: Predictions, scale: np.ndarray) -> Effects:
    """The measured effects with the gyro's estimate of the pose clock improved by the motion.

    The motion tells more now that the delay of the drives is known.

    Args:
        known: measured effects.
        gyro: what the gyro says.
        predictions: of the recording's windows.
        scale: expected size of a residual, ``[W, K, 3]``.
    """
    if not known or known[0][0] != _CLOCK:
        return known
    offsets = gyro.offset + gyro.offset_half_width * np.linspace(-1.5, 1.5, 13)
    tried: Sequence[Effects] = [((_CLOCK, {"offset": float(offset)}), *known[1:]) for offset in offsets]
    return min(tried, key=lambda effects: float(robust(predictions.residuals([effects])[0] / scale).mean()))


def heading_noise(evidence: Evidence, gyro: GyroFinding | None) -> dict[float, float]:
    """By how much poses and gyro turn apart, by horizon of a comparison [deg]; empty without a gyro."""
    if gyro is None or evidence.gyro is None:
        return {}
    found = {horizon: heading_disagreement(evidence.smoothed, evidence.gyro, gyro, horizon) for horizon in HORIZONS}
    return {horizon: float(np.degrees(apart)) for horizon, apart in found.items() if apart is not None}


def changed_bias(gyro: GyroFinding | None, robot: RobotModel) -> EffectEstimate | None:
    """The gyro's bias with its interval; None where it is what the robot's file says, or that of a healthy gyro."""
    in_file = {key: float(value) for key, value in dict(robot.effects).get(_BIAS, {}).items()}
    if gyro is None or not gyro.biased(in_file.get("bias", 0.0)):
        return None
    bias = ParameterEstimate(gyro.bias, gyro.bias, gyro.bias, "rad/s").with_half_width(gyro.bias_half_width)
    return EffectEstimate(_BIAS, {"bias": bias}, in_file=in_file)


def bias_row(gyro: GyroFinding) -> GapRow:
    """Difference of the yaw rates of gyro and poses, without and with the bias."""
    gain = abs(gyro.bias)
    return GapRow(
        horizon=0.0,
        before=gyro.spread,
        after=gyro.spread_without,
        gain_low=gain - gyro.bias_half_width,
        gain_high=gain + gyro.bias_half_width,
        unit="rad/s",
        noise=gyro.spread_without,
    )
