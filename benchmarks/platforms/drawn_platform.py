"""Platform: a skid-steered robot drawn at random, and the robot file that its user would write."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from monoforce_ros.core import write_text

GRAVITY = 9.81
"""[m/s²]."""
MEASURING_ERROR = 0.03
"""Largest relative error of the masses and lengths in a robot file."""
_REFERENCE_MASS, _REFERENCE_RADIUS, _REFERENCE_BASE, _REFERENCE_TRACK = 50.0, 0.165, 0.51, 0.57
"""A Clearpath Husky; lengths of a platform scale with the cube root of its mass."""


@dataclass(frozen=True, kw_only=True)
class PoseSensor:
    """Errors of the recorded poses.

    Attributes:
        rate: [Hz].
        position_noise: standard deviation of each coordinate [m].
        rotation_noise: standard deviation about each axis [rad].
        position_drift: random walk [m per square root of a driven metre].
        heading_drift: random walk [rad per square root of a driven metre].
    """

    rate: float
    position_noise: float
    rotation_noise: float
    position_drift: float
    heading_drift: float


@dataclass(frozen=True, kw_only=True)
class WheelSensor:
    """Errors of the measured wheel speeds; recorded at 50 Hz.

    Attributes:
        noise: standard deviation [rad/s].
        quantum: smallest difference between two speeds [rad/s]; 0 without quantisation.
    """

    noise: float
    quantum: float


@dataclass(frozen=True, kw_only=True)
class Gyro:
    """Errors of the gyro; recorded at 100 Hz.

    Attributes:
        noise: standard deviation [rad/s].
        bias: about z [rad/s], within the range of a healthy sensor.
    """

    noise: float
    bias: float


@dataclass(frozen=True, kw_only=True)
class Platform:
    """A skid-steered robot as it is, in its base frame: x forward, y left, z up, origin on the centre line.

    Attributes:
        seed: seed of the draw.
        mass: [kg], with wheels.
        radius, width: of a wheel [m].
        track: lateral distance of the wheels [m].
        wheelbase: distance of the first and the last axle [m].
        axles: two or three, evenly spaced.
        axle_height: of the wheel centres above the base frame's origin [m].
        centre_of_mass: ``(x, y, z)`` [m].
        box: edges of a solid box with the robot's mass and moments of inertia [m].
        tyre_deflection: static, under the robot's weight [m].
        contact_time: time constant of the contact between tyre and ground [s]; larger is softer.
        friction: Coulomb coefficient of the wheels.
        servo_stiffness: torque of a drive per error of its wheel's speed [N m s/rad].
        torque_limit: of a wheel [N m].
        lag: time constant of the healthy drives [s].
        dead_time: of the healthy base [s].
        maximum_speed, maximum_yaw_rate: to which the base limits commands [m/s, rad/s].
        controller_track, controller_radius: by which the base converts a twist into wheel speeds [m]; as in the
            robot file, and so wrong by up to 3 %.
        poses: the pose sensor.
        wheels: the wheel-speed sensor, or None.
        gyro: the gyro, or None.
    """

    seed: int
    mass: float
    radius: float
    width: float
    track: float
    wheelbase: float
    axles: int
    axle_height: float
    centre_of_mass: tuple[float, float, float]
    box: tuple[float, float, float]
    tyre_deflection: float
    contact_time: float
    friction: float
    servo_stiffness: float
    torque_limit: float
    lag: float
    dead_time: float
    maximum_speed: float
    maximum_yaw_rate: float
    controller_track: float
    controller_radius: float
    poses: PoseSensor
    wheels: WheelSensor | None
    gyro: Gyro | None

    @property
    def wheel_centres(self) -> np.ndarray:
        """``[2 axles, 3]`` [m]: the left wheels from front to rear, then the right ones."""
        stations = np.linspace(self.wheelbase / 2, -self.wheelbase / 2, self.axles)
        return np.array([[x, side * self.track / 2, self.axle_height] for side in (1, -1) for x in stations])

    @property
    def load(self) -> float:
        """Mean load of a wheel [N]."""
        return self.mass * GRAVITY / (2 * self.axles)


def draw_platform(seed: int) -> Platform:
    """A platform drawn at random; the ranges are those of README.md beside this file."""
    random = np.random.default_rng([seed, 1])
    mass = _between(random, 20.0, 600.0)
    size = (mass / _REFERENCE_MASS) ** (1 / 3)
    radius = _REFERENCE_RADIUS * size * random.uniform(0.8, 1.25)
    axles = 3 if random.uniform() < 0.3 else 2
    wheelbase = _REFERENCE_BASE * size * random.uniform(0.9, 1.4) * (1.25 if axles == 3 else 1.0)
    # Wheels must not overlap.
    wheelbase = max(wheelbase, 2.1 * radius * (axles - 1))
    # Longer robots hardly turn on their wheels; builders avoid them.
    track = max(_REFERENCE_TRACK * size * random.uniform(0.8, 1.35), (0.9 if axles == 2 else 1.05) * wheelbase)
    friction = random.uniform(0.3, 1.0)
    maximum_speed = random.uniform(0.8, 2.0)
    # Torque that makes a wheel slip on the grippiest ground of the benchmark.
    slip_torque = friction * mass * GRAVITY * radius / (2 * axles)
    speed_drop = _between(random, 0.02, 0.3)
    quantised = 2 * math.pi * 50.0 / _between(random, 300.0, 20_000.0)
    wheel_kind = random.choice(["absent", "noisy", "quantised"], p=[0.3, 0.4, 0.3])
    wheel_noise = _between(random, 0.005, 0.05) * maximum_speed / radius
    wheels = {
        "absent": None,
        "noisy": WheelSensor(noise=wheel_noise, quantum=0.0),
        "quantised": WheelSensor(noise=0.003 * maximum_speed / radius, quantum=quantised),
    }[str(wheel_kind)]
    position_noise = _between(random, 0.003, 0.03)
    rotation_noise = math.radians(_between(random, 0.1, 1.0))
    return Platform(
        seed=seed,
        mass=mass,
        radius=radius,
        width=0.6 * radius,
        track=track,
        wheelbase=wheelbase,
        axles=axles,
        axle_height=random.uniform(0.0, 0.3) * radius,
        centre_of_mass=(
            random.uniform(-0.1, 0.1) * wheelbase,
            random.uniform(-0.04, 0.04) * track,
            random.uniform(0.0, 0.6) * radius,
        ),
        box=(1.25 * wheelbase, 1.05 * track, random.uniform(1.0, 2.0) * radius),
        tyre_deflection=_between(random, 0.004, 0.02) * size,
        contact_time=_between(random, 0.008, 0.03),
        friction=friction,
        servo_stiffness=slip_torque / (speed_drop * maximum_speed / radius),
        torque_limit=slip_torque * random.uniform(1.1, 3.0),
        lag=_between(random, 0.02, 0.25),
        dead_time=random.uniform(0.0, 0.15),
        maximum_speed=maximum_speed,
        maximum_yaw_rate=min(random.uniform(1.0, 2.0), 1.6 * maximum_speed / track),
        controller_track=_measured(random, track),
        controller_radius=_measured(random, radius),
        poses=PoseSensor(
            rate=_between(random, 5.0, 50.0),
            position_noise=position_noise,
            rotation_noise=rotation_noise,
            position_drift=random.uniform(0.0, 1.0) * position_noise,
            heading_drift=random.uniform(0.0, 0.12) * rotation_noise,
        ),
        wheels=wheels,
        gyro=None
        if random.uniform() < 0.3
        else Gyro(noise=_between(random, 0.002, 0.02), bias=float(random.normal(0.0, 0.001))),
    )  # fmt: skip


def write_robot_file(platform: Platform, file: Path) -> Path:
    """Write the robot file of a platform as its user would: what a scale and a tape measure give, to ±3 %.

    Friction, compliance, lag and dead time are unknown; the track width and wheel radius of the base controller are
    read from its configuration.
    """
    random = np.random.default_rng([platform.seed, 2])

    def measured(value: float) -> float:
        return round(_measured(random, value), 4)

    wheelbase, track = measured(platform.wheelbase), round(platform.controller_track, 4)
    radius, width, height = (
        round(platform.controller_radius, 4),
        measured(platform.width),
        measured(platform.axle_height),
    )
    stations = np.linspace(wheelbase / 2, -wheelbase / 2, platform.axles)
    wheels = [
        {
            "name": f"{side}_{number}",
            "drive": side,
            "centre": [round(float(x), 4), sign * track / 2, height],
            "radius": radius,
            "width": width,
        }
        for side, sign in (("left", 1), ("right", -1))
        for number, x in enumerate(stations)
    ]
    offset = np.array(platform.centre_of_mass) + random.uniform(-0.03, 0.03, 3) * (wheelbase, track, radius)
    content = {
        "name": "platform",
        "mass": measured(platform.mass),
        "centre_of_mass": [round(float(value), 4) for value in offset],
        "inertia_box": [measured(edge) for edge in platform.box],
        "command": {
            "track_width": track,
            "maximum_speed": round(platform.maximum_speed, 4),
            "maximum_yaw_rate": round(platform.maximum_yaw_rate, 4),
        },
        "wheels": wheels,
        "sensors": {"imu_link": {"translation": [0.0, 0.0, 0.0], "rotation": [0.0, 0.0, 0.0]}},
    }
    write_text(file, yaml.safe_dump(content, sort_keys=False))
    return file


def _between(random: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniformly distributed."""
    return float(np.exp(random.uniform(math.log(low), math.log(high))))


def _measured(random: np.random.Generator, value: float) -> float:
    return float(value * (1.0 + random.uniform(-MEASURING_ERROR, MEASURING_ERROR)))
