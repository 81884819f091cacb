"""Bag check: which data for training, evaluation and diagnosis a bag contains, lacks, or has with faults."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import (
    DETECTED,
    FIXED,
    BagError,
    BagReader,
    ReadOptions,
    Recording,
    SmoothedMotion,
    smooth,
)
from monoforce_ros.core import NANOSECOND, MotionTrack
from monoforce_ros.discrepancy import choose_ground, command_delay, motion_faults
from monoforce_ros.evaluation.findings import Finding, Level, missing, note, ok, warning
from monoforce_ros.evaluation.sensor_check import cloud_findings, image_findings
from monoforce_ros.evaluation.topic_check import IMU, TopicCheck
from monoforce_ros.evaluation.twist_check import twist_fault
from monoforce_ros.robots import RobotModel

_FASTEST_TURN = 2.0 * np.pi
"""Yaw rate of a turn in a second [rad/s], faster than any base on wheels or tracks is driven."""


@dataclass(frozen=True)
class BagCheck:
    """The topics of a bag, and what follows from them."""

    path: Path
    duration: float
    """[s]."""
    topics: tuple[TopicCheck, ...]
    findings: tuple[Finding, ...]
    """The most severe first."""

    @property
    def usable(self) -> bool:
        """Whether predictions along this bag can be evaluated."""
        return not any(finding.level is Level.MISSING for finding in self.findings)


def check_bag(path: str | Path, robot: RobotModel, reading: ReadOptions = DETECTED) -> BagCheck:
    """Read a bag once and report its contents, missing data and faults.

    Args:
        path: the bag.
        robot: its file may define sensor poses that the bag lacks; commands are compared with its limits.
        reading: topics and frames that replace those that the bag says.

    Raises:
        BagError: nothing of the bag can be read.
    """
    topics: dict[str, TopicCheck] = {}
    findings: list[Finding] = []
    with BagReader(path) as bag:
        findings += [warning(text) for text in bag.warnings]
        duration = bag.duration
        try:
            for message in bag.messages():
                topic = topics.setdefault(message.topic, TopicCheck(message.topic, message.message_type))
                topic.add(message, is_ros2=bag.is_ros2)
        except BagError as error:
            findings.append(warning(str(error)))
    for topic in topics.values():
        findings += topic.findings()
    findings += _contents(path, robot, topics.values(), reading)
    return BagCheck(
        Path(path), duration, tuple(sorted(topics.values(), key=lambda topic: topic.topic)),
        tuple(sorted(findings, key=lambda finding: finding.level.rank)),
    )  # fmt: skip


def _contents(
    path: str | Path, robot: RobotModel, topics: Collection[TopicCheck], reading: ReadOptions
) -> Iterator[Finding]:
    """Findings about the odometry, commands and sensors of a bag."""
    try:
        recording = reading.open_as_measured(path, robot)
    except BagError as error:
        yield missing(f"odometry: {error}. Record nav_msgs/Odometry from wheels, lidar or visual SLAM")
        return
    yield from (warning(text) for text in recording.choices)
    in_file, robot = robot, reading.robot_in_bag(robot)
    motion = recording.motion
    span = (int(motion.stamps[-1]) - int(motion.stamps[0])) * NANOSECOND
    yield ok(f"odometry {recording.topics['odometry']}: {motion.frame_id} → {motion.child_frame_id}, {span:.1f} s")
    try:
        recording = reading.at_base(recording, in_file)
    except BagError as error:
        yield missing(f"frames: {error}")
    else:
        yield from _offset_findings(motion, recording.motion)
        motion = recording.motion
    smoothed = smooth(motion)
    faults = motion_faults(smoothed, recording.commands, recording.wheels, recording.efforts)
    yield from (missing(text) for text in faults)
    yield from _motion_findings(recording, smoothed, span)
    if len(recording.commands):
        yield from _command_findings(recording, smoothed.motion, robot, follows=not faults)
    sensors = [*cloud_findings(recording, robot), *image_findings(recording, robot)]
    yield from sensors
    if not any(finding.level is Level.OK for finding in sensors):
        yield note("neither clouds nor images can be used: only `--terrain flat` is possible")
    ground = choose_ground("auto", recording, smoothed, robot)
    if doubt := ground.complaint or ground.unexplained:
        yield warning(f"ground, for diagnose: {doubt}")
    if not any(topic.message_type == IMU for topic in topics):
        yield note("no IMU: a gyro bias or a delayed pose clock is harder to identify")


def _offset_findings(measured: MotionTrack, base: MotionTrack) -> Iterator[Finding]:
    """How the base lies relative to the frame that the odometry describes."""
    if measured.child_frame_id == base.child_frame_id:
        return
    turn = Rotation.from_quat(measured.quaternions[0]).inv()
    # Rounded, and without the sign of a negative zero.
    x, y, z = np.round(turn.apply(base.positions[0] - measured.positions[0]), 3) + 0.0
    angle = float((turn * Rotation.from_quat(base.quaternions[0])).magnitude())
    offsets = Rotation.from_quat(measured.quaternions).inv().apply(base.positions - measured.positions)
    moves = float(np.ptp(offsets, axis=0).max())
    varies = f" at first (by the transforms on /tf it moves by {100 * moves:.0f} cm)" if moves > FIXED else ""
    yield ok(
        f"frames: {base.child_frame_id} is at ({x:.3f}, {y:.3f}, {z:.3f}) m and turned by {np.degrees(angle):.1f}° in "
        f"{measured.child_frame_id}{varies}; this offset is applied to the odometry"
    )


def _motion_findings(recording: Recording, smoothed: SmoothedMotion, span: float) -> Iterator[Finding]:
    motion = recording.motion
    speeds = smoothed.motion.linear_velocities[:, 0]
    yaw_rates = smoothed.motion.angular_velocities[:, 2]
    distance = float(np.linalg.norm(np.diff(smoothed.motion.positions, axis=0), axis=1).sum())
    moving = float(np.mean((np.abs(speeds) > 0.05) | (np.abs(yaw_rates) > 0.05)))
    yield ok(
        f"motion: {distance:.1f} m, {100 * moving:.0f} % of the time moving, up to {np.abs(speeds).max():.2f} m/s "
        f"and {np.abs(yaw_rates).max():.2f} rad/s"
    )
    yield note(f"pose noise: {100 * smoothed.position_noise:.1f} cm, {np.degrees(smoothed.rotation_noise):.2f}°")
    if len(smoothed.stretches) > 1:
        yield warning(f"the odometry jumps or pauses {len(smoothed.stretches) - 1} times")
    if distance < 2.0 or moving * span < 5.0:
        yield warning("the robot hardly moves: too little motion for training or comparison")
    if len(motion) > 20 and (fault := twist_fault(motion, smoothed.motion)):
        yield warning(f"{fault}; offline, velocities are taken from the smoothed poses, but the node needs them")


def _command_findings(
    recording: Recording, motion: MotionTrack, robot: RobotModel, *, follows: bool
) -> Iterator[Finding]:
    """Findings about commands; whether motion follows them is of interest where nothing worse was found."""
    commands = recording.commands
    largest_speed, largest_yaw_rate, *lateral = np.abs(commands.twists).max(axis=0).tolist()
    sideways = f", {lateral[0]:.2f} m/s sideways" if lateral else ""
    yield ok(
        f"commands {recording.topics['commands']}: {len(commands)}, up to {largest_speed:.2f} m/s and "
        f"{largest_yaw_rate:.2f} rad/s{sideways}"
    )
    if largest_speed > 1.5 * robot.maximum_speed:
        yield warning(
            f"commands far exceed the maximum speed of {robot.name}, {robot.maximum_speed:g} m/s: wrong robot or unit?"
        )
    if largest_yaw_rate > _FASTEST_TURN:
        yield warning(
            f"commands reach {largest_yaw_rate:.1f} rad/s, {largest_yaw_rate / (2.0 * np.pi):.1f} turns in a second: "
            "are they in degrees?"
        )
    if not follows:
        return
    delay, correlation = command_delay(motion, commands)
    if correlation > 0.5:
        yield note(f"motion follows commands {delay:.2f} s later (correlation {correlation:.2f})")
    elif max(largest_speed, largest_yaw_rate) > 0.05:
        yield warning(
            f"motion does not follow the commands (correlation {correlation:.2f}): wrong topic, unsynchronised clock, "
            "or another source of commands"
        )


def check_text(check: BagCheck) -> str:
    """The check as lines for a terminal."""
    lines = [f"{check.path}: {check.duration:.1f} s", "", *_topic_lines(check.topics), ""]
    marks = {Level.MISSING: "MISSING", Level.WARNING: "WARNING", Level.NOTE: "note", Level.OK: "ok"}
    lines += [f"{marks[finding.level]:>8}  {finding.text}" for finding in check.findings]
    verdict = "predictions along this bag can be evaluated" if check.usable else "see the MISSING data above"
    return "\n".join([*lines, "", f"{'usable' if check.usable else 'not usable yet'}: {verdict}"])


def _topic_lines(topics: Iterable[TopicCheck]) -> Iterator[str]:
    topics = list(topics)
    width = max([len(topic.topic) for topic in topics] + [5])
    types = max([len(topic.message_type) for topic in topics] + [4])
    yield f"{'topic':<{width}}  {'type':<{types}} {'count':>7} {'Hz':>7} {'gap s':>7} {'clock s':>8}  frames"
    for topic in topics:
        frames = ", ".join(sorted(frame or "''" for frame in topic.frames))
        rate = f"{topic.rate:.1f}" if np.isfinite(topic.rate) else "–"
        offset = f"{topic.clock_offset:+.3f}" if np.isfinite(topic.clock_offset) else "–"
        yield (
            f"{topic.topic:<{width}}  {topic.message_type:<{types}} {topic.count:>7} {rate:>7} "
            f"{topic.longest_gap:>7.2f} {offset:>8}  {frames}"
        )
