"""ROS export: identified effects as parameters of ros2_control's controllers and of Nav2.

Names of parameters are those of Jazzy. A base that is corrected by the controller's parameters reaches the limits of
its drives at another twist than without: limits are those of the corrected base, in both files.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.exported_value import scaled_interval, stated_effect
from monoforce_ros.discrepancy.turning_ratio import separation_multiplier
from monoforce_ros.discrepancy.twist_limits import TwistLimits
from monoforce_ros.discrepancy.wheel_motion import half_track
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainDefaults

_GRAVITY = 9.81
"""[m/s²]."""
_NO_PARAMETER = "has no parameter here"
_LIMITS = ("actuator_saturation", "yaw_rate_limit", "acceleration_limit", "yaw_acceleration_limit")
_RAMPS = (("acceleration_limit", "limit"), ("yaw_acceleration_limit", "limit"), ("drive_torque_limit", "acceleration"))
"""Effects that limit accelerations, with the parameter that says by how much."""
_NOT_IN_DIFF_DRIVE = {
    "command_delay": "the controller cannot send a command earlier; give it to the planner (nav2)",
    "actuator_lag": "the controller has no model of the drives",
    "actuator_deadband": "the controller has no dead band; give it to the planner (nav2)",
    "drive_compliance": "the motor drivers need an integral part",
    "payload": "the controller has no mass; tune the gains of the motor drivers",
    "turning_scrub": "a drive in the middle turns no robot",
}
_NOT_IN_ACKERMANN = _NOT_IN_DIFF_DRIVE | {
    "drive_asymmetry": "the controller has one radius for the wheels of both sides",
    "turning_scrub": "the steered wheels decide how much a car turns",
    "steering_gain": "the controller has no factor on angles; correct the ratio of the servo or the linkage",
    "steering_offset": "the controller has no offset of angles; centre the servo",
    **dict.fromkeys(_LIMITS, "the steering controllers limit no speeds; give it to the planner (nav2)"),
}
_NO_CONTROLLER = "ros2_controllers has no controller for robots that steer all their wheels"
_NOT_IN_NAV2 = {
    "actuator_lag": "MPPI's model follows velocities at once, within its acceleration limits",
    "drive_gain": "correct it in the base controller (ros2_control)",
    "drive_asymmetry": "correct it in the base controller (ros2_control)",
    "drive_compliance": "the motor drivers need an integral part",
    "turning_scrub": "correct it in the base controller (ros2_control)",
    "payload": "MPPI's model has no mass",
}
_SMOOTHER_VELOCITY, _SMOOTHER_ACCELERATION = (0.5, 2.5), (2.5, 3.2)
"""Nav2's defaults of the velocity smoother, speed and yaw rate [m/s, rad/s], and their changes [m/s², rad/s²]: its
vectors need a value for both where only one is known."""

_Effects = Mapping[str, EffectEstimate]


@dataclass(frozen=True)
class _Correction:
    """What the base controller's parameters correct."""

    gain: float
    difference: float
    separation: float

    @classmethod
    def of(cls, robot: RobotModel, effects: _Effects) -> _Correction:
        if robot.steered is not None and robot.steered.crabs:
            # No controller has parameters for it.
            return cls(1.0, 0.0, 1.0)
        gain = effects["drive_gain"].parameters["gain"].value if "drive_gain" in effects else 1.0
        if robot.steered is not None:
            return cls(gain, 0.0, 1.0)
        difference = 0.0
        if "drive_asymmetry" in effects:
            difference = effects["drive_asymmetry"].parameters["difference"].value
        scrubs = "turning_scrub" in effects and half_track(robot) > 0.0
        return cls(gain, difference, separation_multiplier(_turning_robot(robot, effects)) if scrubs else 1.0)

    def limits(self, robot: RobotModel, effects: _Effects) -> TwistLimits:
        """Those of the corrected base; the slower side reaches its limit first."""
        share = self.gain * (1.0 - 0.5 * abs(self.difference))
        return TwistLimits.of(robot, effects, share=share, separation=self.separation)


def controller_text(robot: RobotModel, effects: _Effects) -> tuple[str, tuple[str, ...]]:
    """Parameters of the base controller that make the robot drive as commanded, and what they lack.

    Args:
        robot: the nominal model; a car has ``ackermann_steering_controller``, a robot that turns by its sides
            ``diff_drive_controller``.
        effects: by name.
    """
    if robot.steered is None:
        return _diff_drive_text(robot, effects)
    if not robot.steered.crabs:
        return _ackermann_text(robot, effects)
    lines = _heading(robot, "ros2_control")
    return _finished(lines, effects, (), dict.fromkeys(effects, _NO_CONTROLLER))


def _diff_drive_text(robot: RobotModel, effects: _Effects) -> tuple[str, tuple[str, ...]]:
    """Of ``diff_drive_controller``.

    It divides wheel speeds by the radius: multipliers equal to the effects cancel them, for commands and odometry
    alike. It multiplies yaw rates by the separation: the multiplier makes up for the scrub of the model's contact
    physics, too, of which the effect is a factor. Limits are those of the twist.
    """
    correction = _Correction.of(robot, effects)
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
    done = {"drive_gain", "drive_asymmetry", "drive_torque_limit", *_LIMITS}
    if scrub is not None and half_track(robot) > 0.0:
        done.add("turning_scrub")
        wanted = correction.separation
        lines += [
            f"    # Beside the model's own scrub, {stated_effect(scrub, 'track_width_factor')}. With it the robot",
            "    # turns as commanded:",
            f"    wheel_separation_multiplier: {wanted:.4f}  # "
            f"{scaled_interval(scrub.parameters['track_width_factor'], wanted)}",
        ]
    if gain is not None or difference is not None:
        said = "; ".join(
            stated_effect(effect, key)
            for effect, key in ((gain, "gain"), (difference, "difference"))
            if effect is not None
        )
        half = 0.5 * correction.difference
        lines += [
            f"    left_wheel_radius_multiplier: {correction.gain * (1 - half):.4f}  # {said}",
            f"    right_wheel_radius_multiplier: {correction.gain * (1 + half):.4f}  # {said}",
        ]
    lines += _controller_limits(robot, effects, correction.limits(robot, effects))
    return _finished(lines, effects, done, _NOT_IN_DIFF_DRIVE)


def _controller_limits(robot: RobotModel, effects: _Effects, limits: TwistLimits) -> list[str]:
    """Limits of the twist in ``diff_drive_controller``; those that an effect says."""
    lines = []
    drives = effects.get("actuator_saturation")
    if drives is not None:
        lines.append(f"    # {stated_effect(drives, 'limit')}, of each drive's command, with the multipliers above.")
        if half_track(robot) > 0.0:
            lines += [
                "    # Speed and yaw rate share it: where one is at its maximum the other has none.",
            ]
    for axis, names, largest, ramp in (
        ("linear.x", ("actuator_saturation", "acceleration_limit"), limits.speed, limits.acceleration),
        ("angular.z", ("actuator_saturation", "yaw_rate_limit", "yaw_acceleration_limit"), limits.yaw_rate,
         limits.yaw_acceleration),
    ):  # fmt: skip
        own = [effects[name] for name in names if name in effects]
        if any(not effect.name.endswith("acceleration_limit") for effect in own) and math.isfinite(largest):
            lines += [f"    # {stated_effect(effect, 'limit')}" for effect in own if effect.name == "yaw_rate_limit"]
            lines += [
                f"    {axis}.has_velocity_limits: true",
                f"    {axis}.max_velocity: {largest:.4f}",
                f"    {axis}.min_velocity: {-largest:.4f}",
            ]
        if math.isfinite(ramp):
            other = "yaw_acceleration_limit" if axis == "linear.x" else "acceleration_limit"
            lines += [f"    # {_stated_ramps(effects, other)}", f"    {axis}.has_acceleration_limits: true"]
            # Two signs for each direction of travel (control_toolbox' RateLimiter).
            lines += [
                f"    {axis}.{key}: {sign * ramp:.4f}"
                for key, sign in (("max_acceleration", 1), ("max_deceleration", -1),
                                  ("max_acceleration_reverse", -1), ("max_deceleration_reverse", 1))
            ]  # fmt: skip
    return lines


def _ackermann_text(robot: RobotModel, effects: _Effects) -> tuple[str, tuple[str, ...]]:
    """Of ``ackermann_steering_controller``, which divides wheel speeds by the radius."""
    gain = effects.get("drive_gain")
    done: set[str] = set()
    lines = [
        *_heading(robot, "ros2_control ackermann_steering_controller"),
        "ackermann_steering_controller:",
        "  ros__parameters:",
    ]
    if gain is not None and robot.wheel_radius is not None:
        done.add("drive_gain")
        lines += [
            f"    # {robot.wheel_radius:.4g} m of the robot's file, times {stated_effect(gain, 'gain')}",
            f"    traction_wheels_radius: {robot.wheel_radius * gain.parameters['gain'].value:.4f}",
        ]
    return _finished(lines, effects, done, _NOT_IN_ACKERMANN)


def nav2_text(robot: RobotModel, effects: _Effects) -> tuple[str, tuple[str, ...]]:
    """Parameters of Nav2's velocity smoother and MPPI controller by which a planner respects the effects.

    Args:
        robot: the nominal model; its maximum speeds apply where no effect lowers them.
        effects: by name.
    """
    # A correction changes nothing but at which twist the drives reach their limit, or leave their dead band.
    correction = _Correction.of(robot, effects)
    limits = correction.limits(robot, effects)
    band, delay = (effects.get(name) for name in ("actuator_deadband", "command_delay"))
    smoother, mppi = _planned_speeds(robot, effects, limits)
    for own, more in zip((smoother, mppi), _planned_ramps(effects, limits), strict=True):
        own += more
    half = half_track(robot)
    if band is not None:
        width = correction.gain * band.parameters["width"].value
        turning = width / (half * correction.separation) if half > 0.0 and robot.steered is None else 0.0
        smoother.append(f"    deadband_velocity: [{width:.4f}, 0.0, {turning:.4f}]  # {stated_effect(band, 'width')}")
    if delay is not None:
        said = stated_effect(delay, "delay")
        mppi += [
            "      # Nav2 releases after Lyrical; older ones have no such parameters and ignore them.",
            f"      model_delay_vx: {delay.parameters['delay'].value:.4f}  # {said}",
            f"      model_delay_wz: {delay.parameters['delay'].value:.4f}  # {said}",
        ]
    lines = _heading(robot, "Nav2")
    corrected = [name for name in ("drive_gain", "drive_asymmetry", "turning_scrub") if name in effects]
    if corrected and (smoother or mppi) and not (robot.steered is not None and robot.steered.crabs):
        lines.append("# For a base whose controller has the parameters of the export for ros2_control.")
    if smoother:
        lines += ["velocity_smoother:", "  ros__parameters:", *smoother]
    if mppi:
        lines += [
            "controller_server:",
            "  ros__parameters:",
            "    FollowPath:  # an MPPI controller (nav2_mppi_controller::MPPIController)",
            *mppi,
        ]
    done = {*_LIMITS, "drive_torque_limit", "actuator_deadband", "friction_scale", "command_delay"}
    return _finished(lines, effects, done, _NOT_IN_NAV2)


def _planned_speeds(robot: RobotModel, effects: _Effects, limits: TwistLimits) -> tuple[list[str], list[str]]:
    """Lines of the velocity smoother and of MPPI on speeds; none where no effect limits them.

    A limit of the yaw rate says nothing of the speed, which then stays Nav2's.
    """
    own = [effects[name] for name in ("actuator_saturation", "yaw_rate_limit") if name in effects]
    if not own:
        return [], []
    said = "; ".join(stated_effect(effect, "limit") for effect in own)
    speed = limits.speed if "actuator_saturation" in effects else math.inf
    known, default = (speed, limits.yaw_rate), _SMOOTHER_VELOCITY
    vector = [value if math.isfinite(value) else other for value, other in zip(known, default, strict=True)]
    sideways = robot.maximum_lateral_speed
    aside = min(sideways, vector[0]) if robot.steered is not None and robot.steered.crabs else 0.0
    lines = [
        f"    max_velocity: [{vector[0]:.4f}, {aside:.4f}, {vector[1]:.4f}]  # {said}{_defaults(known)}",
        f"    min_velocity: [{-vector[0]:.4f}, {-aside:.4f}, {-vector[1]:.4f}]",
    ]
    mppi = []
    if math.isfinite(speed):
        mppi += [f"      vx_max: {speed:.4f}  # {said}", f"      vx_min: {-speed:.4f}"]
    if math.isfinite(limits.yaw_rate):
        mppi.append(f"      wz_max: {limits.yaw_rate:.4f}  # {said}")
    return lines, mppi


def _planned_ramps(effects: _Effects, limits: TwistLimits) -> tuple[list[str], list[str]]:
    """Lines of the velocity smoother and of MPPI on accelerations: limits of the base, and of MPPI those of grip."""
    said = _stated_ramps(effects)
    lines, mppi = [], []
    known = (limits.acceleration, limits.yaw_acceleration)
    if said:
        vector = [
            value if math.isfinite(value) else other
            for value, other in zip(known, _SMOOTHER_ACCELERATION, strict=True)
        ]  # fmt: skip
        lines = [
            f"    max_accel: [{vector[0]:.4f}, 0.0, {vector[1]:.4f}]  # {said}{_defaults(known)}",
            f"    max_decel: [{-vector[0]:.4f}, 0.0, {-vector[1]:.4f}]",
        ]
    grip, forward = effects.get("friction_scale"), limits.acceleration
    if grip is not None:
        nominal = TerrainDefaults().friction * _GRAVITY
        forward = min(forward, nominal * grip.parameters["factor"].value)
        grips = f"grip: {stated_effect(grip, 'factor')} of {nominal:.2f} m/s²"
        said = f"{grips}; {said}" if said else grips
    if math.isfinite(forward):
        mppi += [f"      ax_max: {forward:.3f}  # {said}", f"      ax_min: {-forward:.3f}"]
    if math.isfinite(limits.yaw_acceleration):
        mppi.append(f"      az_max: {limits.yaw_acceleration:.3f}  # {said}")
    return lines, mppi


def _stated_ramps(effects: _Effects, without: str = "") -> str:
    """The effects that limit accelerations, in one line."""
    return "; ".join(stated_effect(effects[name], key) for name, key in _RAMPS if name in effects and name != without)


def _defaults(known: tuple[float, float]) -> str:
    """Which entries of a vector are Nav2's, since neither an effect nor the robot's file says them."""
    unknown = [f"{what} is Nav2's default" for what, value in zip(("x", "yaw"), known, strict=True)
               if not math.isfinite(value)]  # fmt: skip
    return "".join(f"; {text}" for text in unknown)


def _turning_robot(robot: RobotModel, effects: _Effects) -> RobotModel:
    """The robot with the effects that decide how fast it turns in the end; others are corrected by themselves."""
    turning = ("turning_scrub", "friction_scale", "friction_anisotropy", "tyre_slip", "friction_creep", "payload",
               "rotation_centre", "terrain_softness")  # fmt: skip
    values = {name: {key: entry.value for key, entry in effects[name].parameters.items()} for name in turning
              if name in effects}  # fmt: skip
    return replace(robot, effects=tuple(values.items()))


def _heading(robot: RobotModel, tool: str) -> list[str]:
    return [f"# Parameters of {tool} for {robot.name}, from effects found by monoforce_ros diagnose; 95 % intervals."]


def _finished(
    lines: list[str], effects: _Effects, done: Collection[str], reasons: Mapping[str, str]
) -> tuple[str, tuple[str, ...]]:
    """The text with what it lacks at its end."""
    missing = []
    for name in effects:
        if name in done:
            continue
        reason = reasons.get(name, _NO_PARAMETER)
        if CATALOGUE[name].stage == "measurement":
            reason = "an error of the recording, not of the robot: correct the sensor or its clock"
        missing.append(f"{name}: {reason}")
    if not any(name in done for name in effects):
        lines = [lines[0], "# None of the effects has a parameter here.", "{}"]
    return "\n".join([*lines, *(f"# Not exported: {text}." for text in missing), ""]), tuple(missing)
