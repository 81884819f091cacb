"""MuJoCo export: identified effects as XML fragments that a model includes.

Two fragments, because MuJoCo merges an included file where it is included: one for the top of a model (classes of tyres
and servos, options, forces as actuators), and one for the inside of the base body (a load, sites).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.exported_value import stated
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainDefaults

TYRE_CLASS, DRIVE_CLASS = "monoforce_tyre", "monoforce_drive_{}"
SERVO_GAIN = 100.0
"""Gain of the velocity servos in a fragment [N m s/rad]; to adapt it, scale gainprm and biasprm alike."""
_CONTACT_TIME = 0.02
"""MuJoCo's default time constant of a contact [s]."""
_TIME_STEP = 0.002
"""MuJoCo's default time step, for which the buffer of delayed commands is sized [s]."""
_GRAVITY = 9.81
"""[m/s²]."""
_NOT_IN_MUJOCO = {
    "actuator_deadband": "MuJoCo's actuators have no dead band: cut the commands before they reach the controls",
    "drive_compliance": "set the gain of each wheel's servo to N r² / speed_loss, for a wheel of load N and radius r",
    "turning_scrub": "no element of a model: divide the difference of both sides' commands by the factor",
    "friction_anisotropy": "friction of a geometry is equal in both directions: use a contact pair",
    "tyre_slip": "MuJoCo's friction does not depend on how fast a wheel rolls",
    "friction_creep": "MuJoCo's contacts creep by their own law: see impratio and solimp",
    "rolling_resistance": "a resistance on the wheels' joints would be overcome by their servos",
    "quadratic_drag": "MuJoCo's drag follows from density and shapes, not from a coefficient",
    "vegetation_drag": "a MuJoCo model has no vegetation",
    "learned_term": "a weighted sum of features is no element of a model: apply it as xfrc_applied",
    "pose_clock_offset": "a simulator has one clock: shift the stamps of what you record",
    "command_clock_offset": "a simulator has one clock: shift the stamps of what you record",
    "gyro_bias": "add it to the gyro's readings",
}


def mujoco_files(
    robot: RobotModel, effects: Mapping[str, EffectEstimate], path: Path
) -> tuple[dict[Path, str], tuple[str, ...]]:
    """Contents of the fragments by file, and what they lack.

    Args:
        robot: the nominal model; each drive becomes a class of velocity servos, with commands in rad/s (tracks: m/s).
        effects: by name.
        path: of the fragment for the top of a model; that for the base body is ``STEM_base.xml`` beside it.
    """
    base_path = path.with_name(f"{path.stem}_base{path.suffix}")
    base = _base_elements(effects)
    top = [*_default_elements(robot, effects), *_option_elements(effects), *_actuator_elements(effects)]
    if "viscous_drag" in effects:
        top += ["  <worldbody>", '    <site name="monoforce_world"/>', "  </worldbody>"]
    missing = tuple(
        f"{name}: {_NOT_IN_MUJOCO.get(name, 'no element of a MuJoCo model stands for it')}"
        for name in effects
        if name not in _EXPORTED
    )
    usage = [
        f"Effects of {robot.name} found by monoforce_ros diagnose, each value with its 95 % interval.",
        f'Include this file at the top of a model: <include file="{path.name}"/>.',
    ]
    if base:
        usage.append(f'Include the other inside the robot\'s base body: <include file="{base_path.name}"/>.')
    if any(name in effects for name in ("friction_scale", "terrain_softness")):
        usage.append(f'Give tyres or tracks the class: <geom class="{TYRE_CLASS}" .../>.')
    if _has_drives(effects):
        classes = " or ".join(DRIVE_CLASS.format(name) for name in robot.drive_names)
        usage.append(f'Drive each wheel by a servo of its side\'s class: <general class="{classes}" joint="..."/>.')
        usage.append(f"These are velocity servos with a gain of {SERVO_GAIN:g}: scale gainprm and biasprm alike.")
        usage.append('Light wheels need <option integrator="implicitfast"/> with them.')
    usage += [f"Not exported: {text}." for text in missing]
    # MuJoCo refuses to include a file without elements.
    named = f'  <custom><text name="monoforce_effects" data={quoteattr(" ".join(effects) or "none")}/></custom>'
    files = {path: _fragment(usage, [*top, named])}
    if base:
        files[base_path] = _fragment([f"Part of {path.name}, for the inside of the robot's base body."], base)
    return files, missing


_EXPORTED = frozenset({
    "command_delay", "actuator_lag", "actuator_saturation", "drive_gain", "drive_asymmetry", "friction_scale",
    "terrain_softness", "payload", "constant_force", "viscous_drag", "gravity_tilt", "sensor_yaw_offset",
    "sensor_lever_arm",
})  # fmt: skip


def _fragment(comments: list[str], elements: list[str]) -> str:
    said = "\n".join(f"  {line}" for line in comments).replace("--", "- -")
    return "\n".join(["<mujocoinclude>", f"  <!--\n{said}\n  -->", *elements, "</mujocoinclude>", ""])


def _interval(effect: EffectEstimate, key: str) -> str:
    """``name key: value unit, low to high`` as an XML comment."""
    return f"<!-- {effect.name} {key}: {stated(effect.parameters[key])} -->"


def _value(effects: Mapping[str, EffectEstimate], name: str, key: str) -> float:
    """A parameter, or its neutral value without the effect."""
    if name in effects and key in effects[name].parameters:
        return effects[name].parameters[key].value
    return next(parameter.neutral for parameter in CATALOGUE[name].parameters if parameter.name == key)


def _has_drives(effects: Mapping[str, EffectEstimate]) -> bool:
    return any(name in _EXPORTED and CATALOGUE[name].stage == "command" for name in effects)


def _default_elements(robot: RobotModel, effects: Mapping[str, EffectEstimate]) -> list[str]:
    lines = [*_tyre_class(effects), *(_drive_classes(robot, effects) if _has_drives(effects) else [])]
    return ["  <default>", *lines, "  </default>"] if lines else []


def _tyre_class(effects: Mapping[str, EffectEstimate]) -> list[str]:
    attributes, comments = [], []
    if "friction_scale" in effects:
        nominal = TerrainDefaults().friction
        # The larger friction of two geometries acts, unless one has priority.
        attributes.append(f'friction="{nominal * _value(effects, "friction_scale", "factor"):.5g}" priority="1"')
        comments.append(f"      {_interval(effects['friction_scale'], 'factor')} <!-- of {nominal:g} -->")
    if "terrain_softness" in effects:
        # The stiffness of a contact is proportional to the inverse square of its time constant.
        time = _CONTACT_TIME * math.sqrt(_value(effects, "terrain_softness", "factor"))
        attributes.append(f'solref="{time:.5g} 1"')
        comments.append(f"      {_interval(effects['terrain_softness'], 'factor')}")
    if not attributes:
        return []
    return [f'    <default class="{TYRE_CLASS}">', *comments, f"      <geom {' '.join(attributes)}/>", "    </default>"]


def _drive_classes(robot: RobotModel, effects: Mapping[str, EffectEstimate]) -> list[str]:
    """A class of velocity servos for each drive."""
    radius = robot.wheel_radius or 1.0
    difference = _value(effects, "drive_asymmetry", "difference")
    gain = _value(effects, "drive_gain", "gain")
    limit = _value(effects, "actuator_saturation", "limit") / radius
    delay = _value(effects, "command_delay", "delay")
    second, lag = sorted(_value(effects, "actuator_lag", key) for key in ("second_time_constant", "time_constant"))
    # MuJoCo's drives have one lag: half of a smaller one is lag, half dead time (Skogestad 2003, "half rule").
    delay, lag = delay + 0.5 * second, lag + 0.5 * second
    shared = f'biastype="affine" biasprm="0 0 {-SERVO_GAIN:g}"'
    if math.isfinite(limit):
        shared += f' ctrllimited="true" ctrlrange="{-limit:.6g} {limit:.6g}"'
    if delay > 0:
        shared += f' delay="{delay:.6g}" nsample="{math.ceil(delay / _TIME_STEP) + 2}"'
    if lag > 0:
        shared += f' dyntype="filterexact" dynprm="{lag:.6g}"'
    lines = [
        f"    {_interval(effects[name], key)}"
        for name in effects
        if name in _EXPORTED and CATALOGUE[name].stage == "command"
        for key in effects[name].parameters
    ]
    for name, side in zip(robot.drive_names, np.sign(robot.drive_offsets.numpy()), strict=True):
        factor = gain * (1.0 - 0.5 * difference * float(side))
        lines += [
            f"    <default class={quoteattr(DRIVE_CLASS.format(name))}>",
            f'      <general gainprm="{SERVO_GAIN * factor:.6g}" {shared}/>',
            "    </default>",
        ]
    return lines


def _option_elements(effects: Mapping[str, EffectEstimate]) -> list[str]:
    if "gravity_tilt" not in effects:
        return []
    turn = Rotation.from_rotvec(
        [_value(effects, "gravity_tilt", "about_x"), 0.0, 0.0]
    ) * Rotation.from_rotvec([0.0, _value(effects, "gravity_tilt", "about_y"), 0.0])  # fmt: skip
    gravity = " ".join(f"{value:.6g}" for value in turn.apply([0.0, 0.0, -_GRAVITY]))
    comments = [f"  {_interval(effects['gravity_tilt'], key)}" for key in effects["gravity_tilt"].parameters]
    return [*comments, f'  <option gravity="{gravity}"/>']


def _actuator_elements(effects: Mapping[str, EffectEstimate]) -> list[str]:
    """Forces on the base that need no parameter of the model."""
    lines = []
    for name in ("constant_force", "viscous_drag"):
        if name in effects:
            lines += [f"    {_interval(effects[name], key)}" for key in effects[name].parameters]
    if "constant_force" in effects:
        for axis, gear in (("x", "1 0 0"), ("y", "0 1 0")):
            force = _value(effects, "constant_force", axis)
            lines.append(
                f'    <general name="monoforce_force_{axis}" site="monoforce_base" gear="{gear} 0 0 0" '
                f'gaintype="fixed" gainprm="0" biastype="affine" biasprm="{force:.6g} 0 0"/>'
            )
    if "viscous_drag" in effects:
        drag = _value(effects, "viscous_drag", "coefficient")
        for axis, gear in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1")):
            lines.append(
                f'    <general name="monoforce_drag_{axis}" site="monoforce_base" refsite="monoforce_world" '
                f'gear="{gear} 0 0 0" gaintype="fixed" gainprm="0" biastype="affine" biasprm="0 0 {-drag:.6g}"/>'
            )
    return ["  <actuator>", *lines, "  </actuator>"] if lines else []


def _base_elements(effects: Mapping[str, EffectEstimate]) -> list[str]:
    """Elements inside the robot's base body."""
    lines: list[str] = []
    if "payload" in effects:
        payload = effects["payload"]
        mass = payload.parameters["mass"].value
        place = " ".join(f"{_value(effects, 'payload', axis):.6g}" for axis in ("x", "y", "z"))
        lines += [f"  {_interval(payload, key)}" for key in payload.parameters]
        # A point mass; MuJoCo asks for some inertia.
        inertia = " ".join(3 * [f"{1e-6 * abs(mass):.3g}"])
        lines += [
            f'  <body name="monoforce_payload" pos="{place}">',
            f'    <inertial pos="0 0 0" mass="{mass:.6g}" diaginertia="{inertia}"/>',
            "  </body>",
        ]
    if "constant_force" in effects or "viscous_drag" in effects:
        lines.append('  <site name="monoforce_base"/>')
    if "sensor_lever_arm" in effects or "sensor_yaw_offset" in effects:
        x, y = (_value(effects, "sensor_lever_arm", axis) for axis in ("x", "y"))
        half = 0.5 * _value(effects, "sensor_yaw_offset", "angle")
        for name in ("sensor_lever_arm", "sensor_yaw_offset"):
            if name in effects:
                lines += [f"  {_interval(effects[name], key)}" for key in effects[name].parameters]
        quaternion = f"{math.cos(half):.6g} 0 0 {math.sin(half):.6g}"
        lines.append(f'  <site name="monoforce_localisation" pos="{x:.6g} {y:.6g} 0" quat="{quaternion}"/>')
    return lines
