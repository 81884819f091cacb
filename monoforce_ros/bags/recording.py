"""Recording: motion, commands and cameras of a bag, and an index of its clouds and images."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags.builders import Message
from monoforce_ros.bags.command_timeout import TIMEOUT, expired
from monoforce_ros.bags.joint_record import JointRecord
from monoforce_ros.bags.open_bags import opened
from monoforce_ros.bags.reader import BagError, BagMessage, BagReader
from monoforce_ros.bags.recorded_clock import from_reception, longest_part
from monoforce_ros.bags.recorded_transforms import RecordedTransforms
from monoforce_ros.bags.topic_choice import (
    ACKERMANN,
    CAMERA_INFO,
    CLOUD,
    COMMANDS,
    IMAGES,
    IMU,
    JOINTS,
    ODOMETRY,
    TRANSFORMS,
    camera_info_topics,
    chosen_topic,
    is_commanded,
    is_rectified,
    topic_choices,
)
from monoforce_ros.bags.wheel_joints import EffortSample, WheelSample, effort_track, wheel_track
from monoforce_ros.core import (
    AngularVelocityTrack,
    CameraModel,
    CommandTrack,
    EffortTrack,
    FrameError,
    JointTrack,
    MotionState,
    MotionTrack,
    PoseTrack,
    RobotFrames,
    TransformTree,
    WheelTrack,
    nearest_stamp,
)
from monoforce_ros.messages import decoding

if TYPE_CHECKING:
    # Players of bags start without physics.
    from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class Frame:
    """Reference to a cloud or image in a bag."""

    topic: str
    stamp: int
    """Header stamp [ns]; the time of reception if the driver did not set one."""
    received: int
    """Time of reception [ns], by which the message is found."""
    stamped: bool = True
    """Whether the header has a stamp."""

    @property
    def header_stamp(self) -> int:
        """Stamp in the message's header [ns]."""
        return self.stamp if self.stamped else 0


@dataclass(frozen=True)
class Recording:
    """Contents of a bag. Motion and commands are in memory; clouds and images are read on demand."""

    path: Path
    motion: MotionTrack
    commands: CommandTrack
    clouds: tuple[Frame, ...]
    images: dict[str, tuple[Frame, ...]]
    cameras: dict[str, CameraModel]
    """Camera model of each image topic that has a CameraInfo topic."""
    static_transforms: dict[tuple[str, str], np.ndarray]
    """Poses ``[4, 4]`` by parent and child frame: those on /tf_static, and those on /tf that hold still."""
    topics: dict[str, str]
    """Topic used for each of ``odometry``, ``commands``, ``cloud``, ``imu``, ``joints`` and ``flipper_commands``."""
    moving: dict[tuple[str, str], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """Stamps ``[M]`` [ns] and poses ``[M, 4, 4]`` by parent and child frame: those on /tf that move, one of them being
    the odometry's child frame."""
    warnings: tuple[str, ...] = ()
    """Defects of the bag and of single messages, which were skipped."""
    angular_velocity: AngularVelocityTrack | None = None
    """Measurements of the IMU, if there is one."""
    wheels: WheelTrack | None = None
    """Measured wheel speeds, if there are any."""
    efforts: EffortTrack | None = None
    """Currents or torques of the drive wheels' motors, if there are any."""
    choices: tuple[str, ...] = ()
    """Topics that were chosen among several of their type; also among the warnings."""
    odometry_child_frame: str = ""
    """The frame that the odometry messages describe; ``motion`` may be that of the base."""
    joints: JointRecord | None = None
    """Measured and commanded joints of the robot for which the bag was opened, if there are any."""
    info_topics: dict[str, str] = field(default_factory=dict)
    """Topic of the CameraInfo of each image topic that has one."""
    moving_transforms: dict[tuple[str, str], PoseTrack] = field(default_factory=dict)
    """Poses by parent and child frame on /tf that move beside the odometry frame, as those of a pan-tilt head."""

    @classmethod
    def open(
        cls,
        path: str | Path,
        *,
        odometry: str | None = None,
        commands: str | None = None,
        cloud: str | None = None,
        joints: str | None = None,
        flipper_commands: str | None = None,
        robot: RobotModel | None = None,
    ) -> Recording:
        """Read a bag's motion and index its clouds and images.

        Args:
            path: the bag (see :class:`BagReader`).
            odometry, commands, cloud, joints, flipper_commands: topics to use; by default the one of the required type
                with the most messages. Of joint states those with ``command`` in their name are commands.
            robot: of a robot that steers, steering angles as commands are read; of one that crabs, lateral speeds; and
                the angles of its joints.

        Raises:
            BagError: the bag cannot be read, a named topic is absent or of another type, or there is no odometry.
        """
        command_types = COMMANDS if robot is None or robot.steered is None else (*COMMANDS, *ACKERMANN)
        with BagReader(path) as bag:
            chosen = {
                "odometry": chosen_topic(bag, odometry, (ODOMETRY,)),
                "commands": chosen_topic(bag, commands, command_types),
                "cloud": chosen_topic(bag, cloud, (CLOUD,)),
                "imu": chosen_topic(bag, None, (IMU,)),
                "joints": chosen_topic(bag, joints, (JOINTS,), lambda topic: not is_commanded(topic)),
            }
            if robot is not None and robot.flippers:
                chosen["flipper_commands"] = chosen_topic(bag, flipper_commands, (JOINTS,), is_commanded)
            if chosen["odometry"] is None:
                raise BagError(f"{bag.path} has no {ODOMETRY} topic; it contains {sorted(set(bag.topics.values()))}")
            image_topics = bag.of_type(*IMAGES)
            topics = {topic for topic in chosen.values() if topic}
            topics.update(image_topics, bag.of_type(CAMERA_INFO), bag.of_type(TRANSFORMS))
            collected = _Collector(bag, chosen, robot)
            collected.warnings.extend(bag.warnings)
            named = {"odometry": odometry, "commands": commands, "cloud": cloud}
            collected.choices = topic_choices(bag, chosen, named, command_types)
            collected.warnings.extend(collected.choices)
            try:
                for message in bag.messages(topics):
                    collected.take(message)
            except BagError as error:
                # Messages before the damage are usable.
                if not collected.states:
                    raise
                collected.warnings.append(str(error))
            return collected.recording(image_topics)

    def cloud(self, frame: Frame) -> tuple[np.ndarray, str]:
        """Points ``[n, 3]`` [m] of a cloud in its sensor frame, and the name of that frame."""
        message = self._read(frame)
        return decoding.decode_cloud(message), message.header.frame_id

    def clouds_between(self, start: int, stop: int) -> Iterator[tuple[Frame, np.ndarray, str]]:
        """Clouds with stamps from ``start`` to ``stop`` [ns] as :meth:`cloud` gives them, in one pass over the bag.

        Clouds that cannot be decoded are skipped.
        """
        chosen = [frame for frame in self.clouds if start <= frame.stamp <= stop]
        for frame, message in self._decoded(chosen):
            try:
                points = decoding.decode_cloud(message)
            except ValueError:
                continue
            yield frame, points, message.header.frame_id

    def images_of(self, frames: Sequence[Frame]) -> Iterator[tuple[Frame, np.ndarray]]:
        """Images of one topic as :meth:`image` gives them, in one pass over the bag; undecodable ones are skipped."""
        for frame, message in self._decoded(frames):
            try:
                yield frame, decoding.decode_image(message)
            except ValueError:
                continue

    def image(self, frame: Frame) -> np.ndarray:
        """RGB pixels ``[height, width, 3]`` of an image."""
        return decoding.decode_image(self._read(frame))

    def base_from(self, frame_id: str, base_frame: str) -> np.ndarray | None:
        """Pose ``[4, 4]`` of a sensor frame in the base frame by the bag's static transforms; None if unconnected."""
        return find_transform(self.static_transforms, base_frame, frame_id)

    def sensor_pose(self, frame_id: str, base_frame: str, known: Mapping[str, object], stamp: int) -> np.ndarray:
        """Pose ``[4, 4]`` of a sensor in the base frame: from the bag's transforms, else from ``known``.

        Args:
            frame_id: frame of the sensor.
            base_frame: base frame of the robot.
            known: poses ``[4, 4]`` of the sensors in the robot file, by frame.
            stamp: of the sensor's data [ns]; a sensor may move on the robot.

        Raises:
            BagError: neither has the frame.
        """
        if frame_id.lstrip("/") == (self.motion.frame_id or "odom").lstrip("/"):
            raise BagError(
                f"{self.path}: data in the odometry frame {frame_id!r} do not say where their sensor is on the robot: "
                "record the driver's own topic, in the sensor's frame"
            )
        try:
            return RobotFrames(base_frame, known).sensor_pose(frame_id, self._transforms_at(stamp))
        except FrameError as error:
            raise BagError(f"{self.path}: {error}") from error

    def _transforms_at(self, stamp: int) -> TransformTree:
        tree = TransformTree(self.static_transforms)
        for (parent, child), track in self.moving_transforms.items():
            tree.add(parent, child, track.at(stamp))
        return tree

    def in_base_frame(
        self, base_frame: str, odometry_child_pose: np.ndarray | None = None, *, file_frame: str = ""
    ) -> Recording:
        """The recording with the motion of the robot's base instead of that of the odometry's child frame.

        Args:
            base_frame: frame that lengths in the robot file refer to.
            odometry_child_pose: pose ``[4, 4]`` of the odometry's child frame in it; by default from the bag's
                transforms.
            file_frame: the robot file's own name of the base frame, if ``base_frame`` replaces it.

        Raises:
            BagError: the frames differ, and the bag has no path between them.
        """
        frames = RobotFrames(base_frame, odometry_child_pose=odometry_child_pose, file_frame=file_frame)
        child, tree = self.motion.child_frame_id, TransformTree(self.static_transforms)
        name = frames.base_name(child, {*tree.frames, *(frame.lstrip("/") for pair in self.moving for frame in pair)})
        try:
            pose = frames.odometry_child(child, tree)
        except FrameError as error:
            moving = self._moving_child(name)
            if moving is None:
                raise BagError(f"{self.path}: {error}") from error
            pose = moving
        return replace(self, motion=self.motion.of_base(pose, name))

    def _moving_child(self, base: str) -> np.ndarray | None:
        """Pose of the odometry's child frame in the base frame at each pose, ``[N, 4, 4]``; None if /tf has none."""
        child = self.motion.child_frame_id.lstrip("/")
        for pair, (stamps, poses) in self.moving.items():
            parent, other = (frame.lstrip("/") for frame in pair)
            beside = parent if other == child else other
            fixed = TransformTree(self.static_transforms).find(base, beside) if beside != base else np.eye(4)
            if fixed is not None:
                # The newest one at the time, as online.
                found = poses[np.clip(np.searchsorted(stamps, self.motion.stamps, side="right") - 1, 0, None)]
                return fixed @ (found if other == child else np.linalg.inv(found))
        return None

    def _decoded(self, frames: Sequence[Frame]) -> Iterator[tuple[Frame, Message]]:
        """Messages of frames of one topic, each once, in the order of the bag."""
        # Several messages may have been received at one time, by a clock with coarse steps.
        wanted = {(frame.received, frame.header_stamp): frame for frame in frames}
        if not wanted:
            return
        received = {frame.received for frame in frames}
        with opened(self.path) as bag:
            for message in bag.messages([frames[0].topic], start=min(received), stop=max(received) + 1):
                if message.received in received:
                    try:
                        decoded = message.decode()
                    except ValueError:
                        continue
                    frame = wanted.pop((message.received, decoding.stamp_of(decoded)), None)
                    if frame is not None:
                        yield frame, decoded

    def _read(self, frame: Frame) -> Message:
        with opened(self.path) as bag:
            for message in bag.messages([frame.topic], start=frame.received, stop=frame.received + 1):
                decoded = message.decode()
                if decoding.stamp_of(decoded) == frame.header_stamp:
                    return decoded
        raise BagError(f"{self.path}: the message on {frame.topic} at {frame.received} ns is gone; the bag has changed")


def nearest_frame(frames: Sequence[Frame], stamp: int, *, limit: float = np.inf) -> Frame | None:
    """The frame nearest to a stamp [ns], at most ``limit`` [s] away; None if there is none."""
    index = nearest_stamp(np.array([frame.stamp for frame in frames], np.int64), stamp, limit=limit)
    return None if index is None else frames[index]


def find_transform(transforms: dict[tuple[str, str], np.ndarray], parent: str, child: str) -> np.ndarray | None:
    """``[4, 4]`` parent ← child along any chain of transforms, or None if they are not connected."""
    return TransformTree(transforms).find(parent, child)


class _Collector:
    """Collects the messages of one pass over a bag."""

    def __init__(self, bag: BagReader, chosen: dict[str, str | None], robot: RobotModel | None = None):
        self.bag = bag
        self.chosen = chosen
        self.robot = robot
        self._crabs = robot is not None and robot.steered is not None and robot.steered.crabs
        self.states: list[tuple[int, MotionState]] = []
        self.frames = ("odom", "base_link")
        self.twists: list[tuple[int, np.ndarray]] = []
        self.angular_velocities: list[tuple[int, np.ndarray]] = []
        self.imu_frame = ""
        self.wheels: list[WheelSample] = []
        self.efforts: list[EffortSample] = []
        self.joints: list[tuple[int, np.ndarray]] = []
        self.flipper_commands: list[tuple[int, np.ndarray]] = []
        self._unknown_joints: dict[str, list[str]] = {}
        self._stamped: set[str] = set()
        """Topics of which a header had a stamp."""
        self._received: dict[int, int] = {}
        """Time of reception of the odometry by its stamp [ns]."""
        self._unstamped: dict[str, set[int]] = {}
        """Times of reception of messages without one, by topic [ns]."""
        self.indexed: dict[str, list[Frame]] = {}
        self.cameras: dict[str, CameraModel] = {}
        self.rectified: dict[str, CameraModel] = {}
        """Projections of rectified images, by the topic of their CameraInfo."""
        self._of_rectified = {
            info for topic in bag.of_type(*IMAGES) if is_rectified(topic) for info in camera_info_topics(topic)
        }
        self.transforms = RecordedTransforms()
        self.warnings: list[str] = []
        self.choices: list[str] = []

    def take(self, message: BagMessage) -> None:
        try:
            if message.message_type in (*IMAGES, CLOUD) and self.bag.is_ros2:
                # Large messages are indexed by their headers and decoded on demand.
                self._index(message, decoding.stamp_of_cdr(message.data))
                return
            decoded = message.decode()
            header = decoding.stamp_of(decoded)
            if message.message_type in (*IMAGES, CLOUD):
                self._index(message, header)
                return
            timeless = message.message_type in (CAMERA_INFO, TRANSFORMS)
            stamp = header or message.received if timeless else self._time(message, header)
            if stamp is None:
                return
            if message.topic == self.chosen["odometry"]:
                state, frame_id, child_frame_id = decoding.decode_odometry(decoded)
                self.frames = (frame_id, child_frame_id)
                self.states.append((stamp, state))
                self._received[stamp] = message.received
                self.transforms.sample(stamp)
            elif message.topic == self.chosen["commands"]:
                self.twists.append((stamp, self._command(decoded)))
            elif message.topic == self.chosen["imu"]:
                rate, self.imu_frame = decoding.decode_angular_velocity(decoded)
                self.angular_velocities.append((stamp, rate))
            elif message.topic == self.chosen["joints"]:
                if wheels := decoding.decode_wheels(decoded):
                    self.wheels.append((stamp, wheels))
                if efforts := decoding.decode_efforts(decoded):
                    self.efforts.append((stamp, efforts))
                self._take_joints(message.topic, stamp, decoded, self.joints)
            elif message.topic == self.chosen.get("flipper_commands"):
                self._take_joints(message.topic, stamp, decoded, self.flipper_commands)
            elif message.message_type == CAMERA_INFO:
                if message.topic in self._of_rectified and message.topic not in self.rectified:
                    self.rectified[message.topic] = decoding.decode_camera_info(decoded, rectified=True)
                if message.topic not in self.cameras:
                    self.cameras[message.topic] = decoding.decode_camera_info(decoded)
            elif message.message_type == TRANSFORMS:
                self._take_transforms(decoded, message.topic)
        except ValueError as error:
            if len(self.warnings) < 20:
                self.warnings.append(f"{message.topic}: {error}")

    def _index(self, message: BagMessage, header: int) -> None:
        """Keep a reference to a cloud or image."""
        stamp = self._time(message, header)
        if stamp is not None:
            frame = Frame(message.topic, stamp, message.received, stamped=header != 0)
            self.indexed.setdefault(message.topic, []).append(frame)

    def _time(self, message: BagMessage, header: int) -> int | None:
        """Time of a message [ns]: its header's stamp or, where the topic has none, that of its reception.

        A topic has one clock: messages without a stamp among others, as a simulation publishes before its clock runs,
        are left out (None), for their times of reception may be those of another one.
        """
        topic = message.topic
        if header:
            if topic not in self._stamped and self._unstamped.get(topic):
                self._forget_unstamped(topic)
            self._stamped.add(topic)
            return header
        self._unstamped.setdefault(topic, set()).add(message.received)
        return None if topic in self._stamped else message.received

    def _forget_unstamped(self, topic: str) -> None:
        received = self._unstamped[topic]
        for track in self._tracks().get(topic, []):
            track[:] = [entry for entry in track if entry[0] not in received]
        self.indexed.pop(topic, None)

    def _tracks(self) -> dict[str | None, list[list[Any]]]:
        """What is kept of each topic: lists of stamps and values."""
        chosen = self.chosen
        return {
            chosen["odometry"]: [self.states, *self.transforms.beside_odometry.values()],
            chosen["commands"]: [self.twists],
            chosen["imu"]: [self.angular_velocities],
            chosen["joints"]: [self.wheels, self.efforts, self.joints],
            chosen.get("flipper_commands"): [self.flipper_commands],
        }

    def _translate_unstamped(self) -> None:
        """Give messages without stamps the time of the poses' clock, where that is another one than the recorder's."""
        translated = from_reception(self._received)
        if translated is None:
            return
        topics, tracks = sorted(set(self._unstamped) - self._stamped), self._tracks()
        for topic in topics:
            for track in tracks.get(topic, []):
                track[:] = [(translated(entry[0]), *entry[1:]) for entry in track]
            if topic in self.indexed:
                self.indexed[topic] = [replace(frame, stamp=translated(frame.stamp)) for frame in self.indexed[topic]]
        used = [topic for topic in topics if topic in self.indexed or any(tracks.get(topic, []))]
        if used:
            self.warnings.append(
                f"{', '.join(used)}: no stamps, and the poses have another clock than the recorder (simulated time?): "
                "times of reception are translated; record stamped messages, or ros2 bag record --use-sim-time"
            )

    def _keep_one_clock(self) -> None:
        found = longest_part(np.array([stamp for stamp, _ in self.states], np.int64))
        if found is None:
            return
        start, stop, text = found
        for track in itertools.chain.from_iterable(self._tracks().values()):
            track[:] = [entry for entry in track if start <= entry[0] <= stop]
        for topic, frames in self.indexed.items():
            self.indexed[topic] = [frame for frame in frames if start <= frame.stamp <= stop]
        self.warnings.append(text)

    def _command(self, message: Message) -> np.ndarray:
        if hasattr(message, "drive") or hasattr(message, "steering_angle"):
            assert self.robot is not None
            assert self.robot.steered is not None
            twist = decoding.decode_ackermann(message, self.robot.steered.wheelbase)
            return np.append(twist, 0.0) if self._crabs else twist
        return decoding.decode_command(message, lateral=self._crabs)

    def _take_joints(self, topic: str, stamp: int, message: Message, kept: list[tuple[int, np.ndarray]]) -> None:
        if self.robot is None or not self.robot.joints:
            return
        if not set(message.name) & set(self.robot.joint_names):
            if any(joint.kind in ("steering", "flipper") for joint in self.robot.joints):
                self._unknown_joints[topic] = sorted(str(name) for name in message.name)
            return
        kept.append((stamp, decoding.decode_joints(message, self.robot.joint_names)[0]))

    def _take_transforms(self, message: Message, topic: str) -> None:
        found = decoding.decode_transforms(message)
        if topic.endswith("tf_static"):
            self.transforms.add_static(found)
        else:
            self.transforms.add(found, decoding.transform_stamps(message), self.frames)

    def recording(self, image_topics: list[str]) -> Recording:
        if not self.states:
            raise BagError(f"{self.bag.path}: no usable message on {self.chosen['odometry']}: {self.warnings[:1]}")
        self._translate_unstamped()
        self._keep_one_clock()
        for topic in sorted(self._stamped & set(self._unstamped)):
            count = len(self._unstamped[topic])
            self.warnings.append(f"{topic}: {count} messages without a stamp among others with one are left out")
        stamps, states = _in_order(self.states)
        for topic, names in self._unknown_joints.items():
            if not (self.joints if topic == self.chosen["joints"] else self.flipper_commands):
                assert self.robot is not None
                self.warnings.append(
                    f"{topic}: got the joints {names}, expected some of {list(self.robot.joint_names)}; none is used"
                )
        self.twists.sort(key=lambda entry: entry[0])
        cloud_topic = self.chosen["cloud"] or ""
        motion = MotionTrack(
            stamps=stamps,
            positions=np.array([s.position for s in states]),
            quaternions=Rotation.from_matrix(np.array([s.rotation for s in states])).as_quat(),
            linear_velocities=np.array([s.linear_velocity for s in states]),
            angular_velocities=np.array([s.angular_velocity for s in states]),
            frame_id=self.frames[0],
            child_frame_id=self.frames[1],
        )
        commands = CommandTrack(
            stamps=np.array([stamp for stamp, _ in self.twists], np.int64),
            twists=np.array([twist for _, twist in self.twists]).reshape(-1, 3 if self._crabs else 2),
        )
        commands, count = expired(commands, motion)
        if count:
            self.choices.append(
                f"{self.chosen['commands']}: the base stops when commands fall silent; {count} commands before a "
                f"silence expire after {TIMEOUT:g} s instead of being held"
            )
        wheels = self._wheel_track(commands, motion)
        known = {topic: self.rectified if is_rectified(topic) else self.cameras for topic in image_topics}
        info_topics = {
            topic: found[0]
            for topic, cameras in known.items()
            if (found := [info for info in camera_info_topics(topic) if info in cameras])
        }
        return Recording(
            path=self.bag.path,
            motion=motion,
            commands=commands,
            clouds=tuple(sorted(self.indexed.get(cloud_topic, ()), key=lambda frame: frame.stamp)),
            images={
                topic: tuple(sorted(self.indexed.get(topic, ()), key=lambda frame: frame.stamp))
                for topic in image_topics
            },
            cameras={topic: known[topic][info] for topic, info in info_topics.items()},
            info_topics=info_topics,
            static_transforms=self.transforms.fixed,
            moving={
                frames: (stamps, np.array(poses))
                for frames, kept in self.transforms.beside_odometry.items()
                if self.transforms.changed(frames)
                for stamps, poses in (_in_order(kept),)
            },
            moving_transforms=self.transforms.tracks(self.frames[0]),
            topics={role: topic for role, topic in self.chosen.items() if topic},
            warnings=tuple(self.warnings),
            choices=tuple(self.choices),
            odometry_child_frame=self.frames[1],
            angular_velocity=self._angular_velocity_track(),
            wheels=wheels,
            efforts=effort_track(self.efforts, self._sides(self.efforts)),
            joints=self._joint_record(),
        )

    def _wheel_track(self, commands: CommandTrack, motion: MotionTrack) -> WheelTrack | None:
        track, texts = wheel_track(self.wheels, self._sides(self.wheels), commands, motion)
        self.choices += [f"{self.chosen['joints']}: {text}" for text in texts]
        return track

    @staticmethod
    def _sides(samples: Sequence[tuple[int, Mapping[str, Any]]]) -> dict[str, str]:
        """Side of each wheel in the samples."""
        return {name: decoding.wheel_side(name) or "" for name in {name for _, found in samples for name in found}}

    def _joint_record(self) -> JointRecord | None:
        if self.robot is None:
            return None
        tracks = []
        for samples in (self.joints, self.flipper_commands):
            stamps, angles = _in_order(samples)
            found = JointTrack(stamps, self.robot.joint_names, np.array(angles)) if len(stamps) else None
            tracks.append(found if found is not None and np.isfinite(found.angles).any() else None)
        if tracks == [None, None]:
            return None
        return JointRecord(tracks[0], tracks[1], len(self.robot.flippers))

    def _angular_velocity_track(self) -> AngularVelocityTrack | None:
        if not self.angular_velocities:
            return None
        stamps, rates = _in_order(self.angular_velocities)
        return AngularVelocityTrack(stamps, np.array(rates), self.imu_frame)


def _in_order[Value](samples: list[tuple[int, Value]]) -> tuple[np.ndarray, list[Value]]:
    """Stamps ``[n]`` int64 [ns], strictly increasing, and the first value of each."""
    stamps, first = np.unique(np.array([stamp for stamp, _ in samples], np.int64), return_index=True)
    return stamps, [samples[index][1] for index in first]
