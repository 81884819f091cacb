"""Hidden effect: kinds with the distributions of their strength, and how each is injected."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from command_faults import (
    Backlash,
    DeadBand,
    Delay,
    DriveFactors,
    Dropouts,
    Lag,
    SpeedCurve,
    SpeedLimit,
    SupplySag,
    ThermalCutout,
    TurnSignGain,
    TwistLimits,
)
from drawn_platform import GRAVITY, Platform
from force_faults import (
    BodyForce,
    Drag,
    Furrows,
    GustingWind,
    RollingResistance,
    SloshingLoad,
    SpeedPull,
    SteeringHunt,
    Tether,
    TractionAssist,
    TurnResistance,
    WorldForce,
)
from injection import Build, Injection, Measurement

Random = np.random.Generator
Values = Mapping[str, float]


@dataclass(frozen=True)
class Kind:
    """One kind of hidden effect.

    Attributes:
        strengths: range of the strength, whose logarithm is uniformly distributed.
        values: parameters of an effect of this strength on a platform.
        inject: the injection of these parameters on a platform.
        names: names in the catalogue of ``diagnose`` that are right; empty outside the catalogue.
        estimated: parameters whose true value is that of the catalogue's parameter of the same name and unit.
        needs: ``wheels`` or ``gyro``, if no other sensor can show the effect.
        moves: whether it changes the motion; a gyro's bias does not.
    """

    strengths: tuple[float, float]
    values: Callable[[float, Random, Platform], Values]
    inject: Callable[[Values, Platform], Injection]
    names: tuple[str, ...] = ()
    estimated: tuple[str, ...] = ()
    needs: str = ""
    moves: bool = True


@dataclass(frozen=True)
class HiddenEffect:
    """An effect that is hidden in a drive.

    Attributes:
        name: of its kind.
        values: its parameters.
        onset: time at which it begins [s]; 0 for the whole drive.
    """

    name: str
    values: Values
    onset: float = 0.0

    @property
    def kind(self) -> Kind:
        """Its kind."""
        return KINDS[self.name]

    def injection(self, platform: Platform) -> Injection:
        """A new injection, which holds the state of one drive."""
        injection = self.kind.inject(self.values, platform)
        injection.onset = self.onset
        return injection


def draw_effect(name: str, random: Random, platform: Platform, onset: float = 0.0) -> HiddenEffect:
    """An effect of a kind with a strength drawn at random."""
    kind = KINDS[name]
    low, high = kind.strengths
    strength = float(np.exp(random.uniform(math.log(low), math.log(high))))
    return HiddenEffect(name, {key: float(v) for key, v in kind.values(strength, random, platform).items()}, onset)


def _either(random: Random) -> float:
    return float(random.choice([-1.0, 1.0]))


def _weight(platform: Platform) -> float:
    return platform.mass * GRAVITY


def _one(name: str, scale: Callable[[Platform], float] = lambda platform: 1.0, *, signed: bool = False):
    """Values of an effect with one parameter: its strength times a scale of the platform."""

    def values(strength: float, random: Random, platform: Platform) -> Values:
        return {name: strength * scale(platform) * (_either(random) if signed else 1.0)}

    return values


def _deviation(name: str) -> Callable[[float, Random, Platform], Values]:
    """A factor that is above or below 1 by the strength."""
    return lambda strength, random, platform: {name: math.exp(_either(random) * strength)}


def _direction(strength: float, random: Random, platform: Platform) -> Values:
    """A force forward or backward, or to a side, as a share of the weight."""
    size = strength * _weight(platform) * _either(random)
    return {"x": size, "y": 0.0} if random.uniform() < 0.5 else {"x": 0.0, "y": size}


def _arm(strength: float, random: Random, platform: Platform) -> Values:
    angle = random.uniform(0.0, 2 * math.pi)
    return {"x": strength * math.cos(angle), "y": strength * math.sin(angle)}


def _tilt(strength: float, random: Random, platform: Platform) -> Values:
    angle = random.uniform(0.0, 2 * math.pi)
    return {"about_x": strength * math.cos(angle), "about_y": strength * math.sin(angle)}


def _tilt_force(values: Values, platform: Platform) -> Injection:
    """Gravity turned about x, then y, less gravity itself."""
    x, y = values["about_x"], values["about_y"]
    down = np.array([-math.sin(y), math.sin(x) * math.cos(y), -math.cos(x) * math.cos(y)])
    return WorldForce(force=_weight(platform) * (down + np.array([0.0, 0.0, 1.0])))


def _payload(strength: float, random: Random, platform: Platform) -> Values:
    return {
        "mass": strength * platform.mass,
        "x": random.uniform(-0.5, 0.5) * platform.wheelbase,
        "y": random.uniform(-0.35, 0.35) * platform.track,
        "z": random.uniform(0.5, 2.0) * platform.radius,
    }


def _limits(strength: float, random: Random, platform: Platform) -> Values:
    """A strength of 1 halves the yaw rate and reaches the top speeds in a second; 2 in two, and so on."""
    return {
        "yaw_rate": platform.maximum_yaw_rate / (1.0 + strength),
        "acceleration": platform.maximum_speed / strength,
        "yaw_acceleration": platform.maximum_yaw_rate / strength,
    }


def _one_side(strength: float, random: Random, platform: Platform) -> Values:
    """One drive turns at most half as fast as the other."""
    return {"left": 1.0, "right": strength} if random.uniform() < 0.5 else {"left": strength, "right": 1.0}


def _friction(values: Values, platform: Platform) -> Injection:
    return Injection(build=Build(friction=(values["factor"],) * 2))


def _rotation_centre(values: Values, platform: Platform) -> Injection:
    shift = values["front_minus_rear"] / 2
    return Injection(build=Build(friction=(1.0 + shift, 1.0 - shift)))


def _slippery_across(values: Values, platform: Platform) -> Injection:
    grip = (1.0 - values["factor"]) * platform.friction * _weight(platform) / 2
    build = Build(friction=(values["factor"],) * 2)
    return TractionAssist(build=build, grip=grip, radius=platform.radius, track=platform.track)


def _soft(values: Values, platform: Platform) -> Injection:
    return _resistance(values["resistance"], platform, Build(contact_time=4.0))


def _resistance(coefficient: float, platform: Platform, build: Build) -> Injection:
    """A share of each wheel's load resists its rolling."""
    ground = platform.wheel_centres - np.array([0.0, 0.0, platform.radius])
    centre = np.array(platform.centre_of_mass)
    return RollingResistance(build=build, force=coefficient * platform.load, wheels=ground, centre=centre)


def _load(values: Values, platform: Platform) -> Injection:
    position = (values["x"], values["y"], values["z"])
    return Injection(build=Build(payload=values["mass"], payload_position=position))


def _measured(**named: Callable[[Values], float | tuple[float, float]]) -> Callable[[Values, Platform], Injection]:
    return lambda values, platform: Injection(
        measurement=Measurement(**{key: value(values) for key, value in named.items()})
    )


_LATE = ("command_delay", "command_clock_offset", "pose_clock_offset")
"""Dead time, late pose stamps and early command stamps are the same in a recording without gyro or wheel speeds."""
_TURNING = ("turning_scrub", "friction_anisotropy", "friction_scale")
_SLOWING = ("viscous_drag", "quadratic_drag", "rolling_resistance", "vegetation_drag")
_SUPPLY = ("supply_drain", "supply_sag")
_RAMPS = ("command_limits", "yaw_rate_limit", "acceleration_limit", "yaw_acceleration_limit", "twist_limits")

KINDS: dict[str, Kind] = {
    "command_delay": Kind(
        (0.1, 0.5), _one("delay"), lambda v, p: Delay(delay=v["delay"]), _LATE, ("delay",)
    ),
    "actuator_lag": Kind(
        (0.15, 0.8), _one("time_constant"), lambda v, p: Lag(time_constant=v["time_constant"]), ("actuator_lag",)
    ),
    "actuator_saturation": Kind(
        (0.25, 0.75), _one("limit", lambda p: p.maximum_speed), lambda v, p: SpeedLimit(limit=v["limit"]),
        ("actuator_saturation",), ("limit",),
    ),
    "actuator_deadband": Kind(
        (0.04, 0.25), _one("width"), lambda v, p: DeadBand(width=v["width"]), ("actuator_deadband",), ("width",)
    ),
    "drive_gain": Kind(
        (0.06, 0.5), _deviation("gain"), lambda v, p: DriveFactors(left=v["gain"], right=v["gain"]), ("drive_gain",),
        ("gain",),
    ),
    "drive_asymmetry": Kind(
        (0.03, 0.3), _one("difference", signed=True),
        lambda v, p: DriveFactors(left=1 - v["difference"] / 2, right=1 + v["difference"] / 2),
        ("drive_asymmetry",), ("difference",),
    ),
    "friction_scale": Kind((0.1, 0.6), _one("factor"), _friction, ("friction_scale",)),
    "rolling_resistance": Kind(
        (0.1, 0.8), _one("coefficient", lambda p: 0.7 * p.friction),
        lambda v, p: _resistance(v["coefficient"], p, Build()), _SLOWING, ("coefficient",),
    ),
    "viscous_drag": Kind(
        (0.1, 0.8), _one("coefficient", lambda p: 0.7 * p.friction * _weight(p) / p.maximum_speed),
        lambda v, p: Drag(linear=v["coefficient"]), _SLOWING, ("coefficient",),
    ),
    "quadratic_drag": Kind(
        (0.1, 0.8), _one("coefficient", lambda p: 0.7 * p.friction * _weight(p) / p.maximum_speed**2),
        lambda v, p: Drag(quadratic=v["coefficient"]), _SLOWING, ("coefficient",),
    ),
    "turning_scrub": Kind(
        (0.05, 0.5), _one("torque", lambda p: p.friction * _weight(p) * p.track / 2),
        lambda v, p: TurnResistance(coulomb=0.5 * v["torque"], viscous=v["torque"] / p.maximum_yaw_rate), _TURNING,
    ),
    "constant_force": Kind(
        (0.04, 0.3), _direction, lambda v, p: BodyForce(x=v["x"], y=v["y"]), ("constant_force", "gravity_tilt"),
        ("x", "y"),
    ),
    "gravity_tilt": Kind((0.04, 0.2), _tilt, _tilt_force, ("gravity_tilt",), ("about_x", "about_y")),
    "payload": Kind((0.2, 0.8), _payload, _load, ("payload",), ("mass",)),
    "pose_clock_offset": Kind(
        (0.05, 0.5), _one("offset", signed=True), _measured(pose_offset=lambda v: v["offset"]), _LATE, ("offset",)
    ),
    "command_clock_offset": Kind(
        (0.1, 0.5), _one("offset", signed=True), _measured(command_offset=lambda v: v["offset"]), _LATE, ("offset",)
    ),
    "sensor_yaw_offset": Kind(
        (0.03, 0.5), _one("angle", signed=True), _measured(sensor_yaw=lambda v: v["angle"]), ("sensor_yaw_offset",),
        ("angle",),
    ),
    "sensor_lever_arm": Kind(
        (0.1, 0.8), _arm, _measured(lever_arm=lambda v: (v["x"], v["y"])), ("sensor_lever_arm",), ("x", "y")
    ),
    "gyro_bias": Kind(
        (0.01, 0.1), _one("bias", signed=True), _measured(gyro_bias=lambda v: v["bias"]), ("gyro_bias",), ("bias",),
        needs="gyro", moves=False,
    ),
    # Not in every catalogue of the package; a name that it lacks cannot be found.
    "vegetation_drag": Kind(
        (0.1, 0.8), _one("force", lambda p: 0.35 * p.friction * _weight(p)),
        lambda v, p: Drag(coulomb=v["force"], linear=v["force"] / p.maximum_speed), _SLOWING,
    ),
    "terrain_softness": Kind(
        (0.1, 0.7), _one("resistance", lambda p: 0.7 * p.friction), _soft, ("terrain_softness", "rolling_resistance")
    ),
    "friction_anisotropy": Kind((0.15, 0.6), _one("factor"), _slippery_across, _TURNING),
    "rotation_centre": Kind((0.2, 1.4), _one("front_minus_rear", signed=True), _rotation_centre, ("rotation_centre",)),
    "command_limits": Kind(
        (0.3, 3.0), _limits, lambda v, p: TwistLimits(**v), _RAMPS,
    ),
    "drive_loss": Kind(
        (0.05, 0.5), _one_side, lambda v, p: DriveFactors(left=v["left"], right=v["right"]),
        ("drive_loss", "drive_asymmetry"),
    ),
    "supply_sag": Kind((0.003, 0.012), _one("rate"), lambda v, p: SupplySag(rate=v["rate"]), _SUPPLY),
    # Outside the catalogue.
    "gusting_wind": Kind(
        (0.05, 0.4), lambda s, r, p: {"force": s * _weight(p) * p.friction, "seed": r.integers(1 << 30)},
        lambda v, p: GustingWind(force=v["force"], seed=int(v["seed"])),
    ),
    "eccentric_wheel": Kind(
        (0.05, 0.3), _one("eccentricity", lambda p: p.radius),
        lambda v, p: Injection(build=Build(eccentricity=v["eccentricity"])),
    ),
    "tether": Kind(
        (0.02, 0.15), _one("stiffness", lambda p: p.friction * _weight(p)),
        lambda v, p: Tether(stiffness=v["stiffness"], slack=2.0, largest=0.5 * p.friction * _weight(p)),
    ),
    "command_dropouts": Kind(
        (0.05, 0.4), lambda s, r, p: {"share": s, "seed": r.integers(1 << 30)},
        lambda v, p: Dropouts(share=v["share"], seed=int(v["seed"])),
    ),
    "turn_sign_gain": Kind((0.15, 0.9), _one("difference", signed=True), lambda v, p: TurnSignGain(**v)),
    "backlash": Kind((0.05, 0.3), _one("play", lambda p: p.maximum_speed), lambda v, p: Backlash(play=v["play"])),
    "thermal_cutout": Kind(
        (0.3, 2.0), lambda s, r, p: {"off": s, "period": r.uniform(4.0, 9.0)},
        lambda v, p: ThermalCutout(off=v["off"], period=v["period"]),
    ),
    "speed_curve": Kind(
        (0.15, 0.9), _one("bend"), lambda v, p: SpeedCurve(bend=v["bend"], top=p.maximum_speed),
    ),
    "sloshing_load": Kind(
        (0.2, 1.0), _one("mass", lambda p: p.mass), lambda v, p: SloshingLoad(mass=v["mass"]),
    ),
    "furrows": Kind(
        (0.1, 0.8), lambda s, r, p: {"force": s * 0.7 * p.friction * _weight(p), "direction": r.uniform(0.0, math.pi)},
        lambda v, p: Furrows(force=v["force"], direction=v["direction"]),
    ),
    "speed_pull": Kind(
        (0.05, 0.6), _one("torque", lambda p: p.friction * _weight(p) * p.track / 2 / p.maximum_speed**2, signed=True),
        lambda v, p: SpeedPull(torque=v["torque"]),
    ),
    "steering_hunt": Kind(
        (0.1, 0.8),
        lambda s, r, p: {"torque": s * p.friction * _weight(p) * p.track / 2, "period": r.uniform(2.0, 5.0)},
        lambda v, p: SteeringHunt(torque=v["torque"], period=v["period"]),
    ),
    "compass_deviation": Kind((0.08, 0.5), _one("amplitude"), _measured(compass=lambda v: v["amplitude"])),
    # The wheels turn and the robot does not.
    "wheels_in_the_air": Kind(
        (1.0, 1.0001), lambda s, r, p: {}, lambda v, p: Injection(build=Build(lifted=True)),
        ("wheels_without_motion",), needs="wheels",
    ),
}  # fmt: skip
"""Every kind by name."""

SINGLES = tuple(name for name, kind in KINDS.items() if kind.names and name != "wheels_in_the_air")
"""Kinds in the catalogue, or missing from it, that count as single effects."""
OUTSIDE = tuple(name for name, kind in KINDS.items() if not kind.names)
"""Kinds that no effect of the catalogue describes."""
WITH_ONSET = ("drive_gain", "drive_asymmetry", "actuator_saturation", "constant_force", "rolling_resistance",
              "turning_scrub", "actuator_lag")  # fmt: skip
"""Kinds that may begin in the middle of a drive."""
PAIRED = ("command_delay", "actuator_lag", "actuator_saturation", "actuator_deadband", "drive_gain", "drive_asymmetry",
          "friction_scale", "turning_scrub", "constant_force", "payload", "pose_clock_offset", "sensor_yaw_offset",
          "sensor_lever_arm", "viscous_drag")  # fmt: skip
"""Kinds that are drawn as pairs."""
