"""Wording: what an effect means, in the words of somebody who repairs robots."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.learned import LEARNED, formula
from monoforce_ros.effects import CATALOGUE

_Values = Mapping[str, float]


def finding(estimate: EffectEstimate) -> str:
    """What an estimate means for the robot, as one sentence with its values.

    An effect without a sentence of its own here is described by the summary in its file.
    """
    values = _beyond_model(estimate)
    if estimate.name == LEARNED:
        return f"An unnamed force or torque acts on the robot: {formula(values)} [N, N m]."
    described = _FINDINGS.get(estimate.name)
    try:
        if described is not None:
            return described(values) + _determined(estimate) + _in_file(estimate)
    except KeyError:
        # An estimate with other parameters than this sentence expects.
        pass
    summary = CATALOGUE[estimate.name].summary if estimate.name in CATALOGUE else estimate.name
    listed = ", ".join(f"{key} {value.value:.3g} {value.unit}" for key, value in estimate.parameters.items())
    return f"{summary.rstrip('.')}: {listed}." + _in_file(estimate)


def _beyond_model(estimate: EffectEstimate) -> dict[str, float]:
    """Values as a sentence states them: of effects that it compares with the model, beyond what the file says."""
    values = {key: parameter.value for key, parameter in estimate.parameters.items()}
    if estimate.name == "payload" and "mass" in values and estimate.in_file.get("mass"):
        return _further_load(values, estimate.in_file, estimate)
    for key, file_value in estimate.in_file.items():
        if key in values and estimate.name in _FACTORS_ON_MODEL:
            values[key] /= file_value
        elif key in values and estimate.name in _DISTANCES_FROM_MODEL:
            values[key] -= file_value
    return values


def _further_load(values: _Values, in_file: _Values, estimate: EffectEstimate) -> dict[str, float]:
    """The point mass that makes the file's load the one that was found; where it would weigh little, how far the load
    lies from the file's place, if that is beyond its interval, or only how much heavier it is.

    Its moment is the difference of both loads' moments.
    """
    mass = values["mass"] - in_file["mass"]
    further = {"mass": mass}
    elsewhere = any(
        key in estimate.parameters and not estimate.parameters[key].holds(in_file.get(key, 0.0)) for key in "xy"
    )
    for key in ("x", "y", "z"):
        if key in values and abs(mass) > _LITTLE * max(abs(values["mass"]), abs(in_file["mass"])):
            further[key] = (values["mass"] * values[key] - in_file["mass"] * in_file.get(key, 0.0)) / mass
        elif key in values and elsewhere:
            further[f"moved_{key}"] = values[key] - in_file.get(key, 0.0)
    return further


def _in_file(estimate: EffectEstimate) -> str:
    """A sentence on what the robot's file says of the same effect; empty where it says nothing."""
    if not estimate.in_file:
        return ""
    known = {parameter.name: parameter for parameter in CATALOGUE[estimate.name].parameters}
    said = [
        f"{key.replace('_', ' ')} {value:.3g}{'' if known[key].unit == '-' else ' ' + known[key].unit}"
        for key, value in estimate.in_file.items()
        if key in known and value != known[key].neutral
    ]
    if not said:
        return ""
    return f" The robot's file says {', '.join(said)}{', which is more' if eased(estimate) else ''}."


def eased(estimate: EffectEstimate) -> bool:
    """Whether an effect is in the robot's file already, and has become less beyond its interval.

    Only of those that have one size, of which none is the least, such as a delay: factors and forces have no such end.
    """
    effect = CATALOGUE.get(estimate.name)
    if effect is None or len(effect.identified) != 1 or effect.identified[0] not in estimate.in_file:
        return False
    (key,) = effect.identified
    known, value = next(p for p in effect.parameters if p.name == key), estimate.parameters.get(key)
    return value is not None and known.low == known.neutral and value.high < estimate.in_file[key]


_FACTORS_ON_MODEL = frozenset({"friction_scale", "terrain_softness", "turning_scrub"})
"""Effects whose sentence compares a factor with what the model assumes."""
_DISTANCES_FROM_MODEL = frozenset({"rotation_centre"})
"""Effects whose sentence says how far from the model's a place is."""
_LITTLE = 0.1
"""Share of a load below which a difference of two loads says how heavy they are, and not where the difference lies."""


def _determined(estimate: EffectEstimate) -> str:
    """A sentence on products that a recording determines where it does not determine their factors; else empty."""
    if not estimate.products:
        return ""
    effect, sentences = CATALOGUE[estimate.name], []
    neutral = {parameter.name: parameter.neutral for parameter in effect.parameters}
    for product in effect.products:
        if product.name not in estimate.products:
            continue
        value, (main, _) = estimate.products[product.name], product.factors
        if not value.holds(0.0) and estimate.parameters[main].holds(neutral[main]):
            sentences.append(f" Only its {product.meaning} is certain: {value.value:.3g} {value.unit}.")
    return "".join(sentences)


def remedy(name: str) -> str:
    """What to check on the robot where this effect was found."""
    return _REMEDIES.get(name, "use the written robot file, or mend the robot and record again")


def cause(name: str) -> str:
    """The effect in a few words, for lists of what else it could be."""
    return _CAUSES.get(name, name.replace("_", " "))


def _change(factor: float, less: str, more: str) -> str:
    """A factor as a change in percent."""
    return f"{100 * abs(1 - factor):.0f} % {less if factor < 1 else more}"


def _sides(x: float, y: float, unit: str) -> str:
    """A vector in the base frame (x forward, y left), without components that round to nothing beside the larger."""
    largest = max(abs(x), abs(y))
    parts = []
    if abs(x) > 0.1 * largest:
        parts.append(f"{abs(x):.3g} {unit} {'forward' if x > 0 else 'backward'}")
    if abs(y) > 0.1 * largest:
        parts.append(f"{abs(y):.3g} {unit} to the {'left' if y > 0 else 'right'}")
    return " and ".join(parts) or f"0 {unit}"


def _clock(what: str) -> Callable[[_Values], str]:
    def sentence(values: _Values) -> str:
        # Offset: recorded minus true time.
        return f"{what} are stamped {abs(values['offset']):.2f} s {'late' if values['offset'] > 0 else 'early'}."

    return sentence


def _asymmetry(values: _Values) -> str:
    difference = values["difference"]
    fast, slow = ("right", "left") if difference > 0 else ("left", "right")
    percent = f"{100 * abs(difference):.0f} %"
    return f"The {fast} side runs {percent} faster than the {slow} side: the robot pulls to the {slow}."


def _scrub(values: _Values) -> str:
    factor = values["track_width_factor"]
    return f"The robot turns {_change(1 / factor, 'less', 'more')} than its model does with these wheel speeds."


def _friction(values: _Values) -> str:
    factor = values["factor"]
    return f"The ground grips {_change(factor, 'less than assumed: it is slippery', 'more than assumed')}."


def _payload(values: _Values) -> str:
    mass = values["mass"]
    if "moved_x" in values or "moved_y" in values:
        moved = _sides(values.get("moved_x", 0.0), values.get("moved_y", 0.0), "m")
        return f"The robot's load lies {moved} of where its model has it."
    place = ""
    if "x" in values and "y" in values:
        x, y = values["x"], values["y"]
        ahead = f"{abs(x):.2f} m {'ahead of' if x > 0 else 'behind'} the base frame's origin"
        place = f", {ahead} and {abs(y):.2f} m to its {'left' if y > 0 else 'right'}"
    if "z" in values:
        place += f", {abs(values['z']):.2f} m {'above' if values['z'] > 0 else 'below'} it"
    if mass < 0:
        return f"The robot is {-mass:.0f} kg lighter than modelled{place}."
    return f"The robot carries {mass:.0f} kg that its model does not have{place}."


def _tilt(values: _Values) -> str:
    angle = math.degrees(math.hypot(values.get("about_x", 0.0), values.get("about_y", 0.0)))
    return f"Down is {angle:.1f}° off: the ground slopes, or the localisation is tilted."


def _drive_loss(values: _Values) -> str:
    loss = values["loss"]
    side, share = "left" if loss > 0 else "right", abs(loss)
    if share > 0.95:
        return f"The drives of the {side} side do not run."
    return f"The drives of the {side} side run {100 * share:.0f} % slower than commanded."


def _flippers(values: _Values) -> str:
    lost = [f"the {place.replace('_', ' ')} one {100 * share:.0f} %" for place, share in values.items() if share > 0.0]
    return f"Flippers lose a part of their commanded motion: {', '.join(lost)}."


_FINDINGS: dict[str, Callable[[_Values], str]] = {
    "command_delay": lambda v: f"The drives react {v['delay']:.2f} s late to every command.",
    "actuator_lag": lambda v: (
        f"The drives are sluggish: {v['time_constant'] + v.get('second_time_constant', 0.0):.2f} s after a change of"
        " the command a third is still missing."
    ),
    "actuator_saturation": lambda v: f"The drives run no faster than {v['limit']:.2f} m/s, whatever is commanded.",
    "actuator_deadband": lambda v: (
        f"The drives ignore commands below {v['width']:.2f} m/s, and run slower by as much above."
    ),
    "drive_gain": lambda v: f"The drives run {_change(v['gain'], 'slower', 'faster')} than commanded.",
    "drive_asymmetry": _asymmetry,
    "drive_compliance": lambda v: (
        f"The drives give way: a wheel that pulls with as much as its load runs {v['speed_loss']:.2f} m/s slower."
    ),
    "drive_loss": _drive_loss,
    "supply_sag": lambda v: (
        f"The faster the drives run, the more of their speed they lose, {100 * v['sag'] / (1.0 + v['sag']):.0f} % at "
        "1 m/s: their supply sags."
    ),
    "supply_drain": lambda v: (
        f"The drives lose {100 * v['drain']:.0f} % of their speed every minute, as when a battery empties."
    ),
    "yaw_rate_limit": lambda v: f"The base turns no faster than {v['limit']:.2f} rad/s, whatever is commanded.",
    "acceleration_limit": lambda v: f"The base changes its speed by no more than {v['limit']:.2f} m/s in a second.",
    "yaw_acceleration_limit": lambda v: (
        f"The base changes its yaw rate by no more than {v['limit']:.2f} rad/s in a second."
    ),
    "drive_torque_limit": lambda v: (
        f"The motors reach their largest torque: they change their speed by no more than {v['acceleration']:.2f} m/s "
        f"in a second, and the scrub of a turn takes {100 * v['scrub']:.0f} % of that."
    ),
    "drive_droop": lambda v: (
        f"The drives droop when a turn begins: each side loses {v['loss']:.2f} m/s, and needs {v['recovery']:.1f} s "
        "to win back most of it."
    ),
    "turning_scrub": _scrub,
    "friction_scale": _friction,
    "friction_anisotropy": lambda v: f"Sideways, tyres grip {_change(v['factor'], 'less', 'more')} than lengthways.",
    "tyre_slip": lambda v: (
        f"The tyres give way: rolling with {100 * v['ratio']:.0f} % of slip they have 71 % of the grip that the ground "
        "offers."
    ),
    "friction_creep": lambda v: (
        f"Where friction holds the robot, it creeps {_change(v['factor'], 'less', 'more')} than assumed."
    ),
    "rotation_centre": lambda v: (
        f"The robot turns about a point {abs(v['x']):.2f} m {'ahead of' if v['x'] > 0 else 'behind'} the one that its "
        "model turns about."
    ),
    "terrain_softness": lambda v: (
        f"The ground or the tyres are {v['factor']:.1f} times as soft as assumed."
        if v["factor"] >= 1.0
        else f"The ground or the tyres are {1.0 / v['factor']:.1f} times as hard as assumed."
    ),
    "vegetation_drag": lambda v: (
        f"Plants hold the robot back: {v['coefficient']:.0f} N per metre of height, square metre and m/s."
    ),
    "rolling_resistance": lambda v: (
        f"The robot rolls heavily: it is held back by {100 * v['coefficient']:.0f} % of its weight at any speed."
    ),
    "viscous_drag": lambda v: (
        f"The faster the robot drives, the more it is held back: by {v['coefficient']:.0f} N at 1 m/s."
    ),
    "quadratic_drag": lambda v: (
        f"The robot is held back by {v['coefficient']:.0f} N at 1 m/s, and four times as much at twice the speed."
    ),
    "constant_force": lambda v: f"Something pulls the robot with {_sides(v['x'], v['y'], 'N')} all the time.",
    "gravity_tilt": _tilt,
    "payload": _payload,
    "pose_clock_offset": _clock("The poses"),
    "command_clock_offset": _clock("The commands"),
    "sensor_yaw_offset": lambda v: (
        f"The localisation's forward is turned {abs(math.degrees(v['angle'])):.1f}° to the "
        f"{'left' if v['angle'] > 0 else 'right'} of the robot's."
    ),
    "sensor_lever_arm": lambda v: (
        f"The poses are those of a point {_sides(v['x'], v['y'], 'm')} of the robot's base frame."
    ),
    "steering_lag": lambda v: (
        f"The steering is sluggish: {v['time_constant']:.2f} s after a change of the command a third is still missing."
    ),
    "steering_offset": lambda v: (
        f"At a straight command the wheels point {abs(math.degrees(v['offset'])):.1f}° to the "
        f"{'left' if v['offset'] > 0 else 'right'}."
    ),
    "steering_gain": lambda v: f"The wheels turn {_change(v['gain'], 'less', 'further')} than commanded.",
    "steering_deadband": lambda v: f"The steering has a play of ±{math.degrees(v['width']):.1f}°.",
    "blocked_flipper": lambda v: _flippers(v),
    "gyro_bias": lambda v: f"The gyro reads {math.degrees(v['bias']):+.2f}°/s at rest.",
}
_REMEDIES = {
    "command_delay": "look for the delay between planner and motor driver: network, bridges, controller rate",
    "actuator_lag": "look at the gains and ramps of the motor controller, and at the battery",
    "actuator_saturation": "look at the controller's speed limit, at battery and load; plan below this speed",
    "actuator_deadband": "look at the smallest output of the motor controller, and for friction in motor and gear",
    "drive_gain": "measure the wheels and compare with the radius that the base controller has",
    "drive_asymmetry": "compare tyre pressure, wear, chain and motor of both sides",
    "drive_loss": "look at motor, gear, chain, fuse and motor driver of this side",
    "supply_sag": "look at charge and age of the battery, and at the resistance of its cables",
    "supply_drain": "charge the battery, and look at its age; look at the temperature of motors and motor drivers",
    "yaw_rate_limit": "look at the base controller's limit of the yaw rate, and enter it in the robot's file",
    "acceleration_limit": "look at the base controller's limit of the acceleration; plan with it",
    "yaw_acceleration_limit": "look at the base controller's limit of the yaw acceleration; plan with it",
    "drive_torque_limit": "look at the current limit of the motor drivers, at battery and load; plan with this ramp",
    "friction_anisotropy": "look at the tread of the tyres, and for ruts that guide them",
    "tyre_slip": "look at the tyres' pressure and tread; plan fast turns with the new robot file",
    "friction_creep": "nothing is to be done: it is a property of tyres and ground",
    "terrain_softness": "look at the tyres' pressure, and for mud, sand or snow",
    "vegetation_drag": "look at how high and how dense the plants are; record a lidar so that the map shows them",
    "rotation_centre": "look for a load ahead or behind, and for tyres of unequal grip or pressure",
    "drive_compliance": "give the motor controllers an integral part, or a larger gain",
    "drive_droop": "raise the gains of the motors' speed controllers, first of the integral part",
    "turning_scrub": "set the wheel separation multiplier of the base controller (diagnose --export)",
    "friction_scale": "look at tyres and ground; drive slower in turns and when braking",
    "rolling_resistance": "look for soft ground, low tyre pressure, a dragging brake or a tight bearing",
    "viscous_drag": "look for a dragging brake or gear, tall grass, mud or water",
    "quadratic_drag": "look for wind, tall grass or water",
    "constant_force": "look for a tether, wind, or a slope that the map does not have",
    "gravity_tilt": "level the localisation's map frame, or give a map of the ground (--terrain)",
    "payload": "weigh the robot, and enter the load in its file",
    "pose_clock_offset": "correct the stamps of the localisation, or synchronise its clock",
    "command_clock_offset": "synchronise the clocks of planner and base",
    "sensor_yaw_offset": "measure how the localisation's sensor is mounted, and correct its transform",
    "sensor_lever_arm": "measure where the localisation's sensor is mounted, and correct its transform",
    "steering_lag": "look at the steering servo, its supply and its gear",
    "steering_offset": "centre the steering: rod, toe and the servo's zero",
    "steering_gain": "compare the wheels' angles with the commanded ones, and correct the linkage or its ratio",
    "steering_deadband": "look for play in rods, joints and gear of the steering",
    "blocked_flipper": "look at gear, clutch and motor of this flipper",
    "gyro_bias": "calibrate the gyro while the robot stands",
    LEARNED: "repeat the manoeuvre with the largest error at half the speed, and look at the robot meanwhile",
}
_CAUSES = {
    "command_delay": "drives that react late",
    "actuator_lag": "sluggish drives",
    "actuator_saturation": "a speed limit of the drives",
    "actuator_deadband": "small commands that the drives ignore",
    "drive_gain": "drives that run too slow or too fast",
    "drive_asymmetry": "sides of unequal speed",
    "drive_compliance": "drives that give way under load",
    "drive_loss": "a side that runs slow or not at all",
    "supply_sag": "a supply that sags",
    "supply_drain": "a supply that drains",
    "yaw_rate_limit": "a limit of the yaw rate",
    "acceleration_limit": "a limit of the acceleration",
    "yaw_acceleration_limit": "a limit of the yaw acceleration",
    "drive_torque_limit": "motors that reach their largest torque",
    "rotation_centre": "turning about another point",
    "terrain_softness": "soft ground or tyres",
    "tyre_slip": "tyres that give way",
    "friction_creep": "creeping against friction",
    "vegetation_drag": "plants",
    "drive_droop": "drives that droop when a turn begins",
    "turning_scrub": "turning faster or slower than the model",
    "friction_scale": "slippery or grippy ground",
    "friction_anisotropy": "tyres that slip sideways",
    "rolling_resistance": "rolling heavily",
    "viscous_drag": "drag that grows with speed",
    "quadratic_drag": "drag that grows with the square of the speed",
    "constant_force": "a steady pull",
    "gravity_tilt": "a slope or a tilted localisation",
    "payload": "a load",
    "pose_clock_offset": "late poses",
    "command_clock_offset": "a wrong command clock",
    "sensor_yaw_offset": "a localisation sensor mounted at an angle",
    "sensor_lever_arm": "a localisation sensor mounted elsewhere",
    "steering_lag": "sluggish steering",
    "steering_offset": "wheels that do not point straight",
    "steering_gain": "wheels that turn more or less than commanded",
    "steering_deadband": "play in the steering",
    "blocked_flipper": "a flipper that does not follow",
}
