"""Sensor recording: a simulated drive as a bag of what the platform's sensors measure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from drawn_platform import Platform, PoseSensor
from drive_commands import RATE
from drive_session import Trace
from injection import TICK, Measurement
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, builders

START_STAMP = 1_700_000_000 * 10**9
"""Stamp of the start of every recording [ns]."""
_WHEEL_RATE, _GYRO_RATE = 50.0, 100.0


def write_bag(trace: Trace, platform: Platform, measurement: Measurement, seed: int, bag: Path) -> None:
    """Write a drive: poses, commands, and wheel speeds and gyro where the platform has them.

    Poses are those of the base frame in the odometry frame, the world frame shifted to the start.

    Args:
        trace: the true motion.
        platform: its sensors.
        measurement: hidden errors of stamps and sensors, beside the noise of the healthy ones.
        seed: seed of the noise.
        bag: folder of the new bag.
    """
    messages = [
        *_commands(trace, measurement),
        *_poses(trace, platform.poses, measurement, np.random.default_rng([seed, 6])),
        *_wheel_speeds(trace, platform, np.random.default_rng([seed, 7])),
        *_angular_velocities(trace, platform, measurement, np.random.default_rng([seed, 8])),
    ]
    with BagWriter(bag) as writer:
        for received, topic, message in sorted(messages, key=lambda entry: entry[:2]):
            writer.write(topic, message, received)


def measured_poses(
    positions: np.ndarray, rotations: np.ndarray, measurement: Measurement
) -> tuple[np.ndarray, Rotation]:
    """Poses ``[n, 3]`` [m] and rotations as a hidden error of the pose sensor shows them, without noise.

    Args:
        positions: ``[n, 3]`` of the base frame from its start [m].
        rotations: ``[n, 3, 3]``.
        measurement: the hidden errors; those of stamps are not applied.
    """
    turn = Rotation.from_matrix(rotations)
    arm = np.array([*measurement.lever_arm, 0.0])
    heading = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    deviation = _about_z(measurement.compass * np.sin(heading))
    shown = measurement.scale * positions + turn.apply(arm)
    return shown, deviation * turn * Rotation.from_euler("z", measurement.sensor_yaw)


def _about_z(angles: np.ndarray) -> Rotation:
    """Rotations by ``[n]`` angles [rad]."""
    return Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0]))


def _ticks(trace: Trace, rate: float) -> np.ndarray:
    """Indices of the states nearest to the instants of a sensor."""
    duration = (len(trace.positions) - 1) * TICK
    return np.rint(np.arange(0.0, duration + 1e-9, 1.0 / rate) / TICK).astype(int)


def _commands(trace: Trace, measurement: Measurement) -> list[tuple[int, str, object]]:
    entries = []
    for number, (speed, rate) in enumerate(trace.commands.tolist()):
        received = START_STAMP + round(1e9 * number / RATE)
        stamp = received + round(1e9 * measurement.command_offset)
        entries.append((received, "/cmd_vel", builders.twist_stamped(stamp, "base_link", speed, rate)))
    return entries


def _poses(
    trace: Trace, sensor: PoseSensor, measurement: Measurement, random: np.random.Generator
) -> list[tuple[int, str, object]]:
    index = _ticks(trace, sensor.rate)
    positions, rotations = measured_poses(
        trace.positions[index] - trace.positions[0], trace.rotations[index], measurement
    )
    driven = np.sqrt(np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1))
    wander = np.cumsum(sensor.position_drift * driven[:, None] * random.standard_normal(positions.shape), axis=0)
    turning = np.cumsum(sensor.heading_drift * driven * random.standard_normal(len(driven)))
    drift = _about_z(turning)
    noise = Rotation.from_rotvec(sensor.rotation_noise * random.standard_normal(positions.shape))
    shown = drift.apply(positions) + wander + sensor.position_noise * random.standard_normal(positions.shape)
    quaternions = (drift * rotations * noise).as_quat()
    arm = np.array([*measurement.lever_arm, 0.0])
    side = Rotation.from_euler("z", measurement.sensor_yaw).inv()
    linear = side.apply(trace.velocities[index] + np.cross(trace.rates[index], arm))
    linear += 3.0 * sensor.position_noise * random.standard_normal(linear.shape)
    angular = side.apply(trace.rates[index]) + 2.0 * sensor.rotation_noise * random.standard_normal(linear.shape)
    entries = []
    for number, tick in enumerate(index):
        received = START_STAMP + round(1e9 * TICK * tick)
        stamp = received + round(1e9 * measurement.pose_offset)
        motion = (shown[number], quaternions[number], linear[number], angular[number])
        entries.append((received, "/odom", builders.odometry(stamp, "odom", "base_link", *motion)))
    return entries


def _wheel_speeds(trace: Trace, platform: Platform, random: np.random.Generator) -> list[tuple[int, str, object]]:
    sensor = platform.wheels
    if sensor is None:
        return []
    index = _ticks(trace, _WHEEL_RATE)
    speeds = trace.wheel_speeds[index]
    speeds = speeds + sensor.noise * random.standard_normal(speeds.shape)
    if sensor.quantum:
        speeds = sensor.quantum * np.rint(speeds / sensor.quantum)
    names = [f"{side}_{number}_wheel" for side in ("left", "right") for number in range(platform.axles)]
    turned = np.zeros(len(names))
    entries = []
    for tick, measured in zip(index, speeds, strict=True):
        turned = turned + measured / _WHEEL_RATE
        stamp = START_STAMP + round(1e9 * TICK * tick)
        entries.append((stamp, "/joint_states", builders.joint_state(stamp, names, turned, measured)))
    return entries


def _angular_velocities(
    trace: Trace, platform: Platform, measurement: Measurement, random: np.random.Generator
) -> list[tuple[int, str, object]]:
    gyro = platform.gyro
    if gyro is None:
        return []
    index = _ticks(trace, _GYRO_RATE)
    rates = trace.rates[index] + gyro.noise * random.standard_normal((len(index), 3))
    rates[:, 2] += gyro.bias + measurement.gyro_bias
    up = trace.rotations[index][:, 2] * 9.81
    entries = []
    for number, tick in enumerate(index):
        stamp = START_STAMP + round(1e9 * TICK * tick)
        entries.append((stamp, "/imu/data", builders.imu(stamp, "imu_link", rates[number], up[number])))
    return entries
