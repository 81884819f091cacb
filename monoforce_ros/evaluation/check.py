"""Check: what a bag holds for training, evaluation and diagnosis, what it lacks, and what is odd about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import (
    CAMERA_INFO,
    CLOUD,
    COMMANDS,
    IMAGES,
    ODOMETRY,
    BagError,
    BagReader,
    Recording,
    SmoothedMotion,
    camera_info_topic,
    smooth,
)
from monoforce_ros.core import CommandTrack, DelayCorrelation, MotionTrack
from monoforce_ros.messages import decoding
from monoforce_ros.robots import RobotModel

IMU, JOINTS = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState"
LONG_GAP = 0.5
"""A silence this long in a topic that is needed throughout is worth a word [s]."""
CLOCK_TOLERANCE = 0.5
"""Difference of a header's stamp to the time of reception that is worth a word [s]."""
_LAGS = np.arange(-0.5, 1.525, 0.025)


@dataclass
class TopicCheck:
    """What was found of a topic."""

    topic: str
    message_type: str
    count: int = 0
    bad: int = 0
    unordered: int = 0
    unstamped: int = 0
    frames: set[str] = field(default_factory=set)
    error: str = ""
    stamps: list[int] = field(default_factory=list)
    offsets: list[float] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Median rate [Hz], or NaN."""
        if len(self.stamps) < 2:
            return float("nan")
        step = float(np.median(np.diff(np.sort(self.stamps)))) * 1e-9
        return 1.0 / step if step > 0 else float("nan")

    @property
    def longest_gap(self) -> float:
        """[s]."""
        return float(np.diff(np.sort(self.stamps)).max()) * 1e-9 if len(self.stamps) > 1 else 0.0

    @property
    def clock_offset(self) -> float:
        """Median of reception minus header stamp [s], or NaN where there are no stamps."""
        return float(np.median(self.offsets)) if self.offsets else float("nan")


@dataclass(frozen=True)
class BagCheck:
    """Findings, each ``ok``, ``note``, ``warning`` or ``missing``, with a sentence."""

    path: Path
    duration: float
    topics: tuple[TopicCheck, ...]
    findings: tuple[tuple[str, str], ...]

    @property
    def usable(self) -> bool:
        """Whether predictions along this bag can be evaluated."""
        return not any(level == "missing" for level, _ in self.findings)


def check_bag(path: str | Path, robot: RobotModel) -> BagCheck:
    """Look through a bag once and say what is there, what is missing, and what is odd.

    Args:
        path: the bag.
        robot: whose file may know where sensors sit, and whose limits commands are compared with.

    Raises:
        BagError: nothing of the bag can be read.
    """
    topics: dict[str, TopicCheck] = {}
    findings: list[tuple[str, str]] = []
    known = {ODOMETRY, *COMMANDS, CLOUD, *IMAGES, CAMERA_INFO, IMU, JOINTS}
    with BagReader(path) as bag:
        findings += [("warning", warning) for warning in bag.warnings]
        duration = bag.duration
        try:
            for message in bag.messages():
                entry = topics.setdefault(message.topic, TopicCheck(message.topic, message.message_type))
                _look(entry, message, known, bag.is_ros2)
        except BagError as error:
            findings.append(("warning", str(error)))
    for topic in topics.values():
        findings += _topic_findings(topic, known)
    findings += _contents(path, robot, topics)
    order = {"missing": 0, "warning": 1, "note": 2, "ok": 3}
    return BagCheck(
        Path(path), duration, tuple(sorted(topics.values(), key=lambda t: t.topic)),
        tuple(sorted(findings, key=lambda finding: order[finding[0]])),
    )  # fmt: skip


def _look(entry: TopicCheck, message, known: set[str], is_ros2: bool) -> None:
    entry.count += 1
    stamp = 0
    if message.message_type in known:
        try:
            if message.message_type in (*IMAGES, CLOUD) and is_ros2 and entry.count > 1:
                # One is looked into; of the others the header suffices.
                stamp = decoding.stamp_of_cdr(message.data)
            else:
                decoded = message.decode()
                stamp = decoding.stamp_of(decoded)
                _decode(message.message_type, decoded)
                header = getattr(decoded, "header", None)
                if header is not None:
                    entry.frames.add(header.frame_id)
        except (ValueError, BagError) as error:
            entry.bad += 1
            entry.error = entry.error or str(error)
    if stamp:
        entry.offsets.append((message.received - stamp) * 1e-9)
    elif message.message_type in known and message.message_type != "geometry_msgs/msg/Twist":
        entry.unstamped += 1
    shown = stamp or message.received
    if entry.stamps and shown < entry.stamps[-1]:
        entry.unordered += 1
    entry.stamps.append(shown)


def _decode(message_type: str, message) -> None:
    decoders = {
        ODOMETRY: decoding.decode_odometry,
        CLOUD: decoding.decode_cloud,
        CAMERA_INFO: decoding.decode_camera_info,
    }
    decoders.update(dict.fromkeys(COMMANDS, decoding.decode_command))
    decoders.update(dict.fromkeys(IMAGES, decoding.decode_image))
    if message_type in decoders:
        decoders[message_type](message)


def _topic_findings(topic: TopicCheck, known: set[str]) -> Iterable[tuple[str, str]]:
    if topic.message_type not in known:
        return
    if topic.bad:
        yield "warning", f"{topic.topic}: {topic.bad} of {topic.count} messages cannot be used: {topic.error}"
    if topic.unstamped and topic.message_type != CAMERA_INFO:
        yield "warning", f"{topic.topic}: {topic.unstamped} headers have no stamp; the time of reception stands for it"
    if topic.unordered:
        yield "note", f"{topic.topic}: {topic.unordered} messages are out of order; they are sorted when read"
    if abs(topic.clock_offset) > CLOCK_TOLERANCE:
        yield (
            "warning",
            f"{topic.topic}: its stamps are {topic.clock_offset:+.2f} s away from when it was received: another clock? "
            "Synchronise the computers (chrony, PTP), or let the driver stamp with ROS time",
        )
    throughout = topic.message_type in (ODOMETRY, CLOUD, *IMAGES)
    if throughout and topic.longest_gap > max(LONG_GAP, 3.0 / max(topic.rate, 1e-3)):
        yield "warning", f"{topic.topic}: silent for {topic.longest_gap:.1f} s; nothing is predicted across that"


def _contents(path: str | Path, robot: RobotModel, topics: dict[str, TopicCheck]) -> list[tuple[str, str]]:
    try:
        recording = Recording.open(path)
    except BagError as error:
        return [("missing", f"odometry: {error}. Record nav_msgs/Odometry from wheels, lidar or visual SLAM")]
    findings: list[tuple[str, str]] = []
    motion = recording.motion
    span = (int(motion.stamps[-1]) - int(motion.stamps[0])) * 1e-9
    findings.append(
        ("ok", f"odometry {recording.topics['odometry']}: {motion.frame_id} → {motion.child_frame_id}, {span:.1f} s")
    )
    if motion.child_frame_id != robot.base_frame:
        findings.append(
            (
                "warning",
                f"odometry is of {motion.child_frame_id!r}, the robot's base frame is {robot.base_frame!r}: set "
                "base_frame in the robot's file, or transform the odometry",
            )
        )
    smoothed = smooth(motion)
    findings += _motion_findings(recording, smoothed, span)
    if len(recording.commands):
        findings += _command_findings(recording, smoothed.motion, robot)
    else:
        findings.append(
            ("missing", "commands: no Twist or TwistStamped; record what the base controller is told (cmd_vel)")
        )
    seen = False
    if recording.clouds:
        points, frame = recording.cloud(recording.clouds[0])
        try:
            recording.sensor_pose(frame, robot.base_frame, robot.sensors)
            findings.append(("ok", f"clouds {recording.topics['cloud']}: {len(recording.clouds)}, frame {frame}"))
            seen = True
        except BagError as error:
            findings.append(("warning", f"clouds cannot be used: {error}"))
        if not len(points):
            findings.append(("warning", f"{recording.topics['cloud']}: the first cloud is empty"))
    for topic, frames in recording.images.items():
        if topic not in recording.cameras:
            findings.append(
                ("warning", f"{topic}: no CameraInfo on {camera_info_topic(topic)}; without it images cannot be used")
            )
            continue
        camera = recording.cameras[topic]
        try:
            recording.sensor_pose(camera.frame_id, robot.base_frame, robot.sensors)
        except BagError as error:
            findings.append(("warning", f"{topic}: {error}"))
            continue
        seen = True
        findings.append(
            ("ok", f"images {topic}: {len(frames)}, {camera.width} × {camera.height}, {camera.distortion_model}")
        )
    if not seen:
        findings.append(("note", "neither clouds nor images can be used: only `--terrain flat` is possible"))
    if not any(t.message_type == IMU for t in topics.values()):
        findings.append(("note", "no IMU: a bias of the gyro or a late pose clock is harder to tell"))
    return findings


def _motion_findings(recording: Recording, smoothed: SmoothedMotion, span: float) -> list[tuple[str, str]]:
    motion = recording.motion
    findings: list[tuple[str, str]] = []
    speeds = smoothed.motion.linear_velocities[:, 0]
    turns = smoothed.motion.angular_velocities[:, 2]
    driven = float(np.linalg.norm(np.diff(smoothed.motion.positions, axis=0), axis=1).sum())
    moving = float(np.mean((np.abs(speeds) > 0.05) | (np.abs(turns) > 0.05)))
    findings.append(
        (
            "ok",
            f"motion: {driven:.1f} m, {100 * moving:.0f} % of the time moving, up to {np.abs(speeds).max():.2f} m/s "
            f"and {np.abs(turns).max():.2f} rad/s",
        )
    )
    findings.append(
        (
            "note",
            f"noise of the poses: {100 * smoothed.position_noise:.1f} cm, {np.degrees(smoothed.rotation_noise):.2f}°",
        )
    )
    if len(smoothed.stretches) > 1:
        findings.append(("warning", f"the odometry jumps or pauses {len(smoothed.stretches) - 1} times"))
    if driven < 2.0 or moving * span < 5.0:
        findings.append(("warning", "there is hardly any motion: nothing can be learned or compared"))
    if len(motion) > 20:
        stated, shown = motion.linear_velocities[:, 0], speeds
        moved = np.abs(shown) > 0.1
        if moved.sum() > 20 and np.abs(stated[moved]).max() < 1e-6:
            findings.append(("note", "the odometry's twists are zero; velocities are taken from the smoothed poses"))
        elif moved.sum() > 20 and np.median(np.sign(stated[moved]) * np.sign(shown[moved])) < 0:
            findings.append(
                ("warning", "the odometry's speed has the other sign than its poses: wrong frame of twist?")
            )
    up = Rotation.from_quat(motion.quaternions).as_matrix()[:, 2, 2]
    if np.median(up) < 0.7:
        findings.append(("warning", "the robot lies on its side or head by its odometry: is z up in that frame?"))
    return findings


def _command_findings(recording: Recording, motion: MotionTrack, robot: RobotModel) -> list[tuple[str, str]]:
    commands = recording.commands
    findings: list[tuple[str, str]] = [
        (
            "ok",
            f"commands {recording.topics['commands']}: {len(commands)}, up to "
            f"{np.abs(commands.twists[:, 0]).max():.2f} m/s and {np.abs(commands.twists[:, 1]).max():.2f} rad/s",
        )
    ]
    overlap = min(int(commands.stamps[-1]), int(motion.stamps[-1])) - max(
        int(commands.stamps[0]), int(motion.stamps[0])
    )
    if overlap < 0:
        findings.append(
            ("missing", "commands and odometry do not overlap in time: they were stamped by different clocks")
        )
        return findings
    if np.abs(commands.twists[:, 0]).max() > 1.5 * robot.maximum_speed:
        findings.append(
            (
                "warning",
                f"commands exceed the {robot.maximum_speed:g} m/s of {robot.name} by far: another robot or unit?",
            )
        )
    delay, strength = command_delay(motion, commands)
    if strength > 0.5:
        findings.append(("note", f"motion follows commands {delay:.2f} s later (correlation {strength:.2f})"))
    elif np.abs(commands.twists).max() > 0.05:
        findings.append(
            (
                "warning",
                f"motion does not follow the commands (correlation {strength:.2f}): the wrong topic, a clock that is "
                "off, or somebody else drove",
            )
        )
    return findings


def command_delay(motion: MotionTrack, commands: CommandTrack) -> tuple[float, float]:
    """How much later the robot moves as commanded [s], and the correlation of both at that delay, 0 to 1."""
    first, last = int(motion.stamps[0]), int(motion.stamps[-1])
    stamps = np.arange(first, last, 25_000_000, dtype=np.int64)
    if len(stamps) < 80:
        return float("nan"), 0.0
    seconds, times = (stamps - first) * 1e-9, (motion.stamps - first) * 1e-9
    pieces = []
    for axis, values in enumerate((motion.linear_velocities[:, 0], motion.angular_velocities[:, 2])):
        measured = np.interp(seconds, times, values)

        def delayed(lag: float, axis: int = axis) -> tuple[np.ndarray, np.ndarray]:
            commanded = commands.sample(stamps - round(1e9 * lag))[:, axis]
            # A command that hardly changes tells no delay.
            return commanded - commanded.mean(), np.full(len(stamps), commanded.std() > 0.02)

        pieces.append((measured - measured.mean(), delayed))
    found = DelayCorrelation.of(pieces, _LAGS)
    if not len(found) or found.values.max() <= 0.0:
        return float("nan"), 0.0
    best = int(np.argmax(found.values))
    return float(_LAGS[best]), float(found.values[best])


def check_text(check: BagCheck) -> str:
    """The check as lines for a terminal."""
    width = max([len(topic.topic) for topic in check.topics] + [5])
    types = max([len(topic.message_type) for topic in check.topics] + [4])
    lines = [f"{check.path}: {check.duration:.1f} s", ""]
    lines.append(f"{'topic':<{width}}  {'type':<{types}} {'count':>7} {'Hz':>7} {'gap s':>7} {'clock s':>8}  frames")
    for topic in check.topics:
        frames = ", ".join(sorted(frame or "''" for frame in topic.frames))
        rate, offset = (f"{value:.1f}" if np.isfinite(value) else "–" for value in (topic.rate, topic.clock_offset))
        offset = f"{topic.clock_offset:+.3f}" if np.isfinite(topic.clock_offset) else "–"
        lines.append(
            f"{topic.topic:<{width}}  {topic.message_type:<{types}} {topic.count:>7} {rate:>7} "
            f"{topic.longest_gap:>7.2f} {offset:>8}  {frames}"
        )
    lines.append("")
    marks = {"missing": "MISSING", "warning": "WARNING", "note": "note", "ok": "ok"}
    lines += [f"{marks[level]:>8}  {text}" for level, text in check.findings]
    lines.append("")
    lines.append(
        "usable: predictions along this bag can be evaluated"
        if check.usable
        else "not usable yet: see what is MISSING above"
    )
    return "\n".join(lines)
