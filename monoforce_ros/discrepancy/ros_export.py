"""ROS export: identified effects as parameters of ros2_control's diff_drive_controller and of Nav2."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.discrepancy.turning_ratio import separation_multiplier
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainDefaults

_GRAVITY = 9.81
_NO_PARAMETER = "has no parameter here"
_NOT_IN_DIFF_DRIVE = {
    "command_delay": "the controller cannot send a command earlier; give it to the planner (nav2)",
    "actuator_lag": "the controller has no model of the drives",
    "actuator_deadband": "the controller has no dead band; give it to the planner (nav2)",
    "drive_compliance": "the motor drivers need an integral part",
    "payload": "the controller has no mass; tune the gains of the motor drivers",
}
_NOT_IN_NAV2 = {
    "actuator_lag": "MPPI's model follows velocities at once, within its acceleration limits",
    "drive_gain": "correct it in the base controller (diff_drive)",
    "drive_asymmetry": "correct it in the base controller (diff_drive)",
    "drive_compliance": "the motor drivers need an integral part",
    "turning_scrub": "correct it in the base controller (diff_drive)",
    "payload": "MPPI's model has no mass",
}


def diff_drive_text(robot: RobotModel, effects: Mapping[str, EffectEstimate]) -> tuple[str, tuple[str, ...]]:
    """Parameters of ``diff_drive_controller`` that make the robot drive as commanded, and what they lack.

    The controller divides wheel speeds by the radius: multipliers equal to the effects cancel them, for commands and
    odometry alike. It multiplies yaw rates by the separation: the multiplier makes up for the scrub of the model's
    contact physics, too, of which the effect is a factor. Limits are those of the twist.

    Args:
        robot: the nominal model.
        effects: by name.
    """
    gain, difference, scrub = (
        effects.get(name) for name in ("drive_gain", "drive_asymmetry", "turning_scrub")
    )  # fmt: skip
    lines = [
        *_heading(robot, "ros2_control diff_drive_controller"),
        "# Multipliers on the wheel_separation and wheel_radius that the controller had during the recording;",
        "# where it had multipliers already, multiply both.",
        "diff_drive_controller:",
        "  ros__parameters:",
    ]
    if scrub is not None:
        value = scrub.parameters["track_width_factor"]
        wanted = separation_multiplier(_turning_robot(robot, effects))
        low, high = (wanted * end / value.value for end in (value.low, value.high))
        lines += [
            f"    # Beside the model's own scrub, {_interval(scrub, 'track_width_factor')}. With it the robot turns as",
            "    # commanded:",
            f"    wheel_separation_multiplier: {wanted:.4f}  # {low:.3g} to {high:.3g}",
        ]
    if gain is not None or difference is not None:
        one = ParameterEstimate(1.0, 1.0, 1.0, "-")
        speed = one if gain is None else gain.parameters["gain"]
        half = 0.0 if difference is None else 0.5 * difference.parameters["difference"].value
        said = "; ".join(
            _interval(effect, key) for effect, key in ((gain, "gain"), (difference, "difference")) if effect is not None
        )
        lines += [
            f"    left_wheel_radius_multiplier: {speed.value * (1 - half):.4f}  # {said}",
            f"    right_wheel_radius_multiplier: {speed.value * (1 + half):.4f}  # {said}",
        ]
    limit = effects.get("actuator_saturation")
    if limit is not None:
        lines += [
            f"    # {_interval(limit, 'limit')}. Speed and yaw rate share it: |v| + |w| {_half_track(robot):.3f} m",
            "    # stays below; each alone may reach its maximum.",
            "    linear.x.has_velocity_limits: true",
            *(f"    linear.x.{key}: {value:.4f}" for key, value in _bounds(_speed(robot, effects))),
            "    angular.z.has_velocity_limits: true",
            *(f"    angular.z.{key}: {value:.4f}" for key, value in _bounds(_yaw_rate(robot, effects))),
        ]
    known = {"drive_gain", "drive_asymmetry", "turning_scrub", "actuator_saturation"}
    return _finished(lines, effects, known, _NOT_IN_DIFF_DRIVE)


def nav2_text(robot: RobotModel, effects: Mapping[str, EffectEstimate]) -> tuple[str, tuple[str, ...]]:
    """Parameters of Nav2's velocity smoother and MPPI controller by which a planner respects the effects.

    Args:
        robot: the nominal model; its maximum speeds apply where no effect lowers them.
        effects: by name.
    """
    speed, yaw_rate = _speed(robot, effects), _yaw_rate(robot, effects)
    limit, band, delay = (
        effects.get(name) for name in ("actuator_saturation", "actuator_deadband", "command_delay")
    )  # fmt: skip
    grip = effects.get("friction_scale")
    limited = f"  # {_interval(limit, 'limit')}" if limit is not None else "  # the robot file's"
    smoother, mppi = [], []
    if limit is not None:
        smoother += [
            f"    max_velocity: [{speed:.4f}, 0.0, {yaw_rate:.4f}]{limited}",
            f"    min_velocity: [{-speed:.4f}, 0.0, {-yaw_rate:.4f}]{limited}",
        ]
        mppi += [
            f"      vx_max: {speed:.4f}{limited}",
            f"      vx_min: {-speed:.4f}{limited}",
            f"      wz_max: {yaw_rate:.4f}{limited}",
        ]
    if band is not None:
        width = band.parameters["width"].value
        smoother.append(
            f"    deadband_velocity: [{width:.4f}, 0.0, {width / _half_track(robot):.4f}]  # {_interval(band, 'width')}"
        )
    if grip is not None:
        factor = grip.parameters["factor"]
        nominal = TerrainDefaults().friction * _GRAVITY
        mppi += [
            f"      ax_max: {nominal * factor.value:.3f}  # grip: {_interval(grip, 'factor')} of {nominal:.2f} m/s²",
            f"      ax_min: {-nominal * factor.value:.3f}",
        ]
    if delay is not None:
        said = _interval(delay, "delay")
        mppi += [
            "      # Nav2 releases after Lyrical; older ones have no such parameters and ignore them.",
            f"      model_delay_vx: {delay.parameters['delay'].value:.4f}  # {said}",
            f"      model_delay_wz: {delay.parameters['delay'].value:.4f}  # {said}",
        ]
    lines = _heading(robot, "Nav2")
    if smoother:
        lines += ["velocity_smoother:", "  ros__parameters:", *smoother]
    if mppi:
        lines += [
            "controller_server:",
            "  ros__parameters:",
            "    FollowPath:  # an MPPI controller (nav2_mppi_controller::MPPIController)",
            *mppi,
        ]
    return _finished(
        lines, effects, {"actuator_saturation", "actuator_deadband", "friction_scale", "command_delay"}, _NOT_IN_NAV2
    )


def _turning_robot(robot: RobotModel, effects: Mapping[str, EffectEstimate]) -> RobotModel:
    """The robot with the effects that decide how fast it turns in the end; others are corrected by themselves."""
    turning = ("turning_scrub", "friction_scale", "friction_anisotropy", "tyre_slip", "payload", "rotation_centre",
               "terrain_softness")  # fmt: skip
    values = {name: {key: entry.value for key, entry in effects[name].parameters.items()} for name in turning
              if name in effects}  # fmt: skip
    return replace(robot, effects=tuple(values.items()))


def _heading(robot: RobotModel, tool: str) -> list[str]:
    return [f"# Parameters of {tool} for {robot.name}, from effects found by monoforce_ros diagnose; 95 % intervals."]


def _finished(
    lines: list[str], effects: Mapping[str, EffectEstimate], known: set[str], reasons: Mapping[str, str]
) -> tuple[str, tuple[str, ...]]:
    """The text with what it lacks at its end."""
    missing = []
    for name in effects:
        if name in known:
            continue
        reason = reasons.get(name, _NO_PARAMETER)
        if CATALOGUE[name].stage == "measurement":
            reason = "an error of the recording, not of the robot: correct the sensor or its clock"
        missing.append(f"{name}: {reason}")
    if not any(name in known for name in effects):
        lines = [lines[0], "# None of the effects has a parameter here.", "{}"]
    return "\n".join([*lines, *(f"# Not exported: {text}." for text in missing), ""]), tuple(missing)


def _interval(effect: EffectEstimate, key: str) -> str:
    value = effect.parameters[key]
    unit = "" if value.unit == "-" else f" {value.unit}"
    return f"{effect.name} {value.value:.4g}{unit}, {value.low:.4g} to {value.high:.4g}"


def _bounds(largest: float) -> tuple[tuple[str, float], ...]:
    return (("max_velocity", largest), ("min_velocity", -largest))


def _half_track(robot: RobotModel) -> float:
    return 0.5 * float((robot.drive_offsets.max() - robot.drive_offsets.min()).abs())


def _speed(robot: RobotModel, effects: Mapping[str, EffectEstimate]) -> float:
    """Largest forward command that the drives follow [m/s]."""
    limit = effects.get("actuator_saturation")
    return robot.maximum_speed if limit is None else min(robot.maximum_speed, limit.parameters["limit"].value)


def _yaw_rate(robot: RobotModel, effects: Mapping[str, EffectEstimate]) -> float:
    """Largest commanded yaw rate on the spot that the drives follow [rad/s]."""
    limit = effects.get("actuator_saturation")
    if limit is None:
        return robot.maximum_yaw_rate
    return min(robot.maximum_yaw_rate, limit.parameters["limit"].value / _half_track(robot))
