"""The predictor node: sensor data, odometry and commands in; terrain, path and contact forces out."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import torch
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import GridCells, Odometry, Path
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, PointCloud2
from visualization_msgs.msg import MarkerArray

from monoforce_ros.bags import camera_info_topics, is_rectified
from monoforce_ros.core import NANOSECOND, CommandTrack, MotionState, RobotFrames, TransformHistory, pose_matrix
from monoforce_ros.effects import corrected_commands, corrected_motion
from monoforce_ros.messages import decoding
from monoforce_ros.nodes import prediction_messages as encoders
from monoforce_ros.nodes.background_worker import BackgroundWorker
from monoforce_ros.nodes.candidate_output import CandidateOutput
from monoforce_ros.nodes.clocks import STEADY
from monoforce_ros.nodes.costmap_output import CostmapOutput
from monoforce_ros.nodes.ensemble_output import EnsembleOutput
from monoforce_ros.nodes.frames import TransformListener
from monoforce_ros.nodes.health import ERROR, OK, STALE, WARN, Health
from monoforce_ros.nodes.inputs import TIME_JUMP, Inputs, Received
from monoforce_ros.nodes.joint_input import JointInput
from monoforce_ros.nodes.managed import ManagedNode
from monoforce_ros.nodes.monitor_output import MonitorOutput
from monoforce_ros.nodes.odometry_reader import ZERO_STAMPS, OdometryReader
from monoforce_ros.nodes.parameters import declare_parameters, follow_changes, settings_without_effect
from monoforce_ros.nodes.process import run_schema_node
from monoforce_ros.nodes.rate_limiter import RateLimiter
from monoforce_ros.nodes.schema import read_schema, schema_path
from monoforce_ros.nodes.sensor_decoder import LIDAR, SensorDecoder
from monoforce_ros.nodes.subscriptions import AdaptiveSubscription, command_types
from monoforce_ros.nodes.terrain_health import TerrainHealth
from monoforce_ros.perception import Observation, TerrainSource, choose_terrain_source, ground_around
from monoforce_ros.physics import PhysicsOptions, read_soil
from monoforce_ros.prediction import FORCE_INTERVAL, Prediction, Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults

_MOST_ODD = 5
"""Commands of another time in a row that are reported: when a bag starts anew, the first ones precede its odometry."""
_LATE = 0.6
"""Age from which candidates are late [s]: the default `timeout` of path_selector, which stops the robot then."""
_COARSE = 0.01
"""Distance of the 32-bit numbers of clouds at the robot [m] that is mentioned; 10 km from the origin it is 1 mm."""


@dataclass(frozen=True)
class ComparisonJob:
    """A prediction whose candidates and ensemble are to be rolled out."""

    prediction: Prediction
    commands: CommandTrack
    """Commands up to the prediction."""
    twists: np.ndarray
    """Commands of the prediction ``[history + T, 2]`` [m/s, rad/s]."""
    frame_id: str
    """Of the odometry."""


class PredictorNode(ManagedNode):
    """Predicts from the newest data in a worker thread, so that callbacks never wait for the physics."""

    def __init__(self) -> None:
        super().__init__("predictor")
        self._entries = entries = read_schema(schema_path("predictor"))
        changeable = [entry.name for entry in entries if entry.name != "autostart"]
        self.settings = declare_parameters(self, entries, changeable=changeable)
        self.candidates: CandidateOutput | None = None
        self.ensemble: EnsembleOutput | None = None
        self.costmap: CostmapOutput | None = None
        self._comparison: BackgroundWorker[ComparisonJob] | None = None
        follow_changes(self, entries, lambda: self.settings, self._change_settings, self._fixed)
        if self.settings.autostart:
            self.autostart()
        else:
            self.get_logger().info("waiting to be configured")

    def set_up(self) -> None:
        """Load robot and encoder, subscribe to inputs, advertise outputs."""
        settings = self.settings
        for text in settings_without_effect(self._entries, settings):
            self.get_logger().warning(text)
        self.robot = load_robot(settings.robot)
        if settings.flipper_motion == "continue" and not self.robot.flippers:
            self.get_logger().warning(f"flipper_motion has no effect: {self.robot.name} has no flippers")
        self.predictor = Predictor(
            self.robot,
            self._terrain_source(),
            horizon=settings.horizon,
            options=PhysicsOptions(time_step=settings.time_step, soil=read_soil(settings.soil)),
        )
        self._force_every = max(1, round(FORCE_INTERVAL / settings.time_step))
        self.get_logger().info("preparing the physics; on first use the kernels are compiled, which takes about 10 s")
        self.predictor.warm_up()
        self.sensor_topics = self._sensor_topics()
        self.health = Health(self, ["odometry", "commands", *self.sensor_topics, "prediction", "live gap"])
        self._terrain_health = TerrainHealth(self.health, self.predictor.source, settings.robot, settings.checkpoint)
        self.frames = RobotFrames(
            settings.base_frame or self.robot.base_frame,
            {name: pose.double().numpy() for name, pose in self.robot.sensors.items()},
            pose_matrix(settings.odometry_child_pose) if settings.odometry_child_pose else None,
            file_frame=self.robot.base_frame,
        )
        history = TransformHistory()
        self.transforms = TransformListener(self, history)
        if self.transforms.unavailable:
            self.get_logger().info(f"sensor poses are those of the robot file: {self.transforms.unavailable}")
        self._odometry = OdometryReader(
            self.frames, self.transforms, self.health,
            publishers=lambda: self._subscriptions_by_part["odometry"].publisher_names,
        )  # fmt: skip
        self.decoder = SensorDecoder(self.frames, history, self.health)
        self.inputs = Inputs(
            list(self.sensor_topics.values()),
            slop=settings.camera_slop,
            patience=settings.data_timeout,
            on_time_jump=self._on_time_jump,
            command_width=3 if self._crabs else 2,
        )
        self.joints: JointInput | None = None
        if self.robot.joints:
            continues = settings.flipper_motion == "continue"
            self.joints = JointInput(self.robot, continues=continues, timeout=settings.odometry_timeout)
        self._arrivals: dict[str, float] = {}
        self._motion_arrival = 0.0
        self._frame_changes: deque[float] = deque(maxlen=2)
        """When the odometry's frame changed last."""
        self._odd_commands = 0
        self._started = time.monotonic()
        self._predictions = 0
        self._last_prediction = self._started
        self._durations: list[float] = []
        self.monitor = MonitorOutput(self, self.predictor, self.health, settings.command_timeout)
        with_candidates = settings.candidates or settings.candidate_topic
        self.candidates = CandidateOutput(self, self.predictor, settings, self.health) if with_candidates else None
        self.ensemble = EnsembleOutput(self, self.predictor, settings) if settings.ensemble else None
        self.costmap = CostmapOutput(self, settings, always=bool(with_candidates))
        self._subscribe()
        reliabilities = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}
        newest = QoSProfile(depth=1, reliability=reliabilities[settings.output_qos], history=HistoryPolicy.KEEP_LAST)
        self._outputs = {
            "height_map": self.create_publisher(GridCells, "predicted/height_map", newest),
            "terrain": self.create_publisher(PointCloud2, "predicted/terrain", newest),
            "path": self.create_publisher(Path, "predicted/path", newest),
            "contact_forces": self.create_publisher(MarkerArray, "predicted/contact_forces", newest),
        }

    def begin(self) -> None:
        """Start predicting."""
        self._started = self._last_prediction = time.monotonic()
        self.inputs.forget()
        self._watch = self.create_timer(0.5, self._watch_inputs, clock=STEADY)
        self._running = True
        self._comparison = BackgroundWorker("comparison", self._compare, self.settings.comparison_niceness)
        self._worker = threading.Thread(target=self._work, name="prediction", daemon=True)
        self._worker.start()
        settings = self.settings
        self.get_logger().info(
            f"predicting {settings.horizon:g} s ahead for {self.robot.name} with terrain from {settings.terrain_source}"
        )

    def pause(self) -> None:
        """Stop predicting."""
        self._running = False
        self.destroy_timer(self._watch)
        with self.inputs.changed:
            self.inputs.changed.notify_all()
        self._worker.join(timeout=10.0)
        if self._comparison is not None:
            self._comparison.stop()
        if self.context.ok():
            self.health.report("prediction", STALE, "deactivated: no predictions", reason="deactivated")

    def _fixed(self, name: str) -> str:
        """Why a parameter that is not dynamic may not change now; empty while the node is unconfigured."""
        if not self.configured:
            return ""
        return f"{name} is read-only while the node is configured: deactivate and clean up first (ros2 lifecycle set)"

    def _change_settings(self, changed: SimpleNamespace) -> None:
        """Apply changed parameters, all or none; raises ``ValueError`` if they are out of range."""
        if not self.configured:
            self.settings = changed
            return
        if self.candidates is not None:
            self.candidates.apply(changed)
        if self.ensemble is not None:
            self.ensemble.apply(changed)
        if self.costmap is not None:
            self.costmap.apply(changed)
        if self.joints is not None:
            self.joints.timeout = changed.odometry_timeout
        self.monitor.command_timeout = changed.command_timeout
        self.settings = changed

    def _terrain_source(self) -> TerrainSource:
        settings = self.settings
        if settings.device == "cuda" and not torch.cuda.is_available():
            raise ValueError(
                "parameter device: got 'cuda', but PyTorch finds no CUDA device: install its CUDA build and NVIDIA's "
                "driver, or use device:=auto"
            )
        cuda = settings.device == "cuda" or (settings.device == "auto" and torch.cuda.is_available())
        return choose_terrain_source(
            settings.terrain_source,
            self.robot,
            grid=Grid.square(settings.map_size, settings.map_resolution),
            material=TerrainDefaults(settings.stiffness, settings.damping, settings.friction),
            checkpoint=settings.checkpoint,
            device="cuda" if cuda else "cpu",
            precision=settings.encoder_precision,
            threads=min(settings.encoder_threads, os.cpu_count() or 1),
            retention_time=settings.camera_retention_time,
            lidar_retention_time=settings.lidar_retention_time,
            motion_stereo=settings.motion_stereo,
            fallback=settings.camera_fallback,
            warn=self.get_logger().warning,
        )

    def _sensor_topics(self) -> dict[str, str]:
        """Part name → resolved topic of every sensor that the terrain source uses."""
        settings, sensors = self.settings, self.predictor.source.sensors
        topics = {}
        if "lidar" in sensors:
            topics[LIDAR] = self.resolve_topic_name(settings.cloud_topic)
        if "camera" in sensors:
            topics |= {f"camera {topic}": self.resolve_topic_name(topic) for topic in settings.image_topics if topic}
        return topics

    def _subscribe(self) -> None:
        settings = self.settings
        # Only the newest sensor data are used, but all odometry and commands.
        small, large = 50, 2
        self._subscriptions_by_part = {
            "odometry": AdaptiveSubscription(
                self, settings.odometry_topic, {"nav_msgs/msg/Odometry": Odometry}, self._on_odometry, depth=small
            ),
            "commands": AdaptiveSubscription(
                self,
                settings.command_topic,
                command_types(steering_angles=self.robot.steered is not None),
                self._on_command,
                depth=small,
                follow_listeners=True,
            ),
        }
        if self.joints is not None:
            kinds = {"sensor_msgs/msg/JointState": JointState}
            # These inputs are optional: their silence is not a fault.
            self._joint_subscriptions = [
                AdaptiveSubscription(self, topic, kinds, partial(self._on_joints, part), depth=small)
                for part, topic in (("joints", settings.joint_topic), ("flippers", settings.flipper_command_topic))
            ]
        images = {"sensor_msgs/msg/CompressedImage": CompressedImage, "sensor_msgs/msg/Image": Image}
        self._camera_info_subscriptions: list[AdaptiveSubscription] = []
        info_topics = iter([*settings.camera_info_topics, *[""] * len(self.sensor_topics)])
        for part, topic in self.sensor_topics.items():
            types = {"sensor_msgs/msg/PointCloud2": PointCloud2} if part == LIDAR else images
            self._subscriptions_by_part[part] = AdaptiveSubscription(
                self, topic, types, partial(self._on_sensor, part), depth=large, reliability=settings.image_qos
            )
            if part != LIDAR:
                given = next(info_topics)
                infos = [
                    AdaptiveSubscription(
                        self,
                        info_topic,
                        {"sensor_msgs/msg/CameraInfo": CameraInfo},
                        partial(self.decoder.set_camera_info, part),
                        depth=small,
                    )
                    for info_topic in ([given] if given else camera_info_topics(topic))
                ]
                self.decoder.add_camera(part, " or ".join(info.topic for info in infos), rectified=is_rectified(topic))
                self._camera_info_subscriptions += infos

    @property
    def _crabs(self) -> bool:
        """Whether the robot can move sideways."""
        return self.robot.steered is not None and self.robot.steered.crabs

    # Callbacks decode small messages, keep large ones undecoded, and never raise.

    def _on_odometry(self, message: Odometry) -> None:
        self._arrivals["odometry"] = time.monotonic()
        received = self._odometry.read(message)
        if received is None:
            if self._odometry.alternates:
                # What came before is mixed, too.
                self.inputs.forget()
            return
        state, frame_id = received.motion, received.frame_id
        if (before := self.inputs.frame_id) and frame_id != before:
            self._frame_changes.append(time.monotonic())
        self.inputs.add_motion("odometry", state, frame_id, received.child_frame_id)
        self._motion_arrival = time.monotonic()
        recent = [change for change in self._frame_changes if time.monotonic() - change < self.settings.data_timeout]
        if len(recent) > 1:
            message = f"its frame changes between {before!r} and {frame_id!r}: do two nodes publish on the topic?"
            self.health.report("odometry", ERROR, message, reason="frames")
            return
        if state.rounding > _COARSE:
            message = (
                f"positions {np.abs(state.position).max() / 1e3:.0f} km from the origin of {frame_id!r}: point clouds "
                f"hold 32-bit numbers, which are {100 * state.rounding:.0f} cm apart there; use an odometry frame that "
                "begins near the robot (REP 105), and map for the world"
            )
            self.health.report("odometry", WARN, message, reason="far")
            return
        self.health.report("odometry", OK, "receiving odometry")

    def _on_command(self, message: Twist | TwistStamped) -> None:
        self._arrivals["commands"] = time.monotonic()
        try:
            if hasattr(message, "drive") and self.robot.steered is not None:
                twist = decoding.decode_ackermann(message, self.robot.steered.wheelbase)
                twist = np.append(twist, 0.0) if self._crabs else twist
            else:
                twist = decoding.decode_command(message, lateral=self._crabs)
        except decoding.MessageError as error:
            self.health.report("commands", ERROR, str(error), reason="unusable")
            return
        stamp = decoding.stamp_of(message)
        self.inputs.add_command(stamp, twist)
        problem = self._command_clock(stamp)
        self._odd_commands = self._odd_commands + 1 if problem else 0
        if self._odd_commands >= _MOST_ODD:
            self.health.report("commands", WARN, problem, reason="clock")
        else:
            self.health.report("commands", OK, "receiving commands")

    def _command_clock(self, stamp: int) -> str:
        """Why a command that has just arrived cannot take effect: its stamp is of another clock; empty if it can."""
        odometry = self.inputs.motion_stamp
        if not stamp or not odometry:
            return ""
        silence, limit = time.monotonic() - self._motion_arrival, self.settings.command_timeout
        late = (odometry - stamp) * NANOSECOND
        if late > limit:
            what = f"are stamped {late:.1f} s before the odometry and ignored (command_timeout: {limit:g} s)"
        elif silence < 0.5 * self.settings.data_timeout and -late - silence > TIME_JUMP * NANOSECOND:
            what = f"are stamped {-late - silence:.1f} s after the odometry and take effect only then"
        else:
            return ""
        return f"commands {what}: synchronise the clocks of the computers that stamp them, or stamp commands with zero"

    def _on_joints(self, part: str, message: JointState) -> None:
        assert self.joints is not None
        try:
            if part == "joints":
                self.joints.measure(message)
            else:
                self.joints.command(message)
        except decoding.MessageError as error:
            self.health.report(part, ERROR, str(error), reason="unusable")
            return
        self.health.report(part, OK, f"receiving {part}")

    def _on_sensor(self, part: str, message: PointCloud2 | Image | CompressedImage) -> None:
        self._arrivals[part] = time.monotonic()
        stamp = decoding.stamp_of(message)
        if stamp == 0:
            self.health.report(part, ERROR, ZERO_STAMPS.format("sensor driver"), reason="zero stamp")
            return
        self.inputs.add_sensor(part, stamp, message)

    def _on_time_jump(self, topic: str, seconds: float) -> None:
        self.monitor.clear()
        if self.joints is not None:
            self.joints.clear()
        self.health.report(
            "prediction",
            WARN,
            f"time went back by {seconds:.1f} s on {topic} (has a bag been restarted?): older data were discarded",
            reason="time jump",
        )

    def _watch_inputs(self) -> None:
        """Report silent inputs; a past prediction is never published again."""
        now, limit = time.monotonic(), self.settings.data_timeout
        for part, subscription in self._subscriptions_by_part.items():
            silence = now - self._arrivals.get(part, self._started)
            if silence < limit:
                continue
            cause = subscription.silence_cause
            if part == "commands":
                level, message = WARN, f"no commands for {silence:.1f} s; assuming zero velocity ({cause})"
            else:
                level, message = ERROR, f"no messages for {silence:.1f} s ({cause})"
            self.health.report(part, level, message, reason=f"silent, {cause}")
        if now - self._last_prediction > limit and self.health.level("prediction") == OK:
            self.health.report("prediction", STALE, f"no new input data for {limit:g} s", reason="no data")
        if self._durations:
            recent = sorted(self._durations[-50:])
            self.health.report_values("prediction", self._statistics(recent))

    def _statistics(self, recent: list[float]) -> dict[str, str]:
        return {
            "predictions": str(self._predictions),
            "dropped inputs": str(self.inputs.dropped),
            "median duration [ms]": f"{1e3 * recent[len(recent) // 2]:.0f}",
            **(self.candidates.statistics if self.candidates is not None else {}),
        }

    # The prediction thread: one prediction after the other, always from the newest data.

    def _work(self) -> None:
        limiter = RateLimiter()
        last = 0
        while self._running:
            if self.sensor_topics:
                received = self.inputs.take(odometry_timeout=self.settings.odometry_timeout, wait=0.5)
            else:
                # Flat ground needs no sensor: predict from each new odometry.
                received = self.inputs.take_motion(last, wait=0.5)
            if received is None or not self._running:
                continue
            if not limiter.due(time.monotonic(), self.settings.rate):
                self.inputs.drop(received)
                continue
            last = max(entry.stamp for entry in received.values())
            self._predict(received)

    def _predict(self, received: dict[str, Received]) -> None:
        started = time.monotonic()
        stamp = max(entry.stamp for entry in received.values())
        try:
            track = corrected_motion(self.inputs.motion(), self.robot.effects)
            observation = self.decoder.observe(stamp, received, track, maximum_gap=self.settings.odometry_timeout)
            for part, seconds in self.inputs.apart.items():
                side = "behind" if seconds > 0 else "ahead of"
                text = f"{abs(seconds):.2f} s {side} the other sensors and not used with them: another clock, or slow?"
                self.health.report(part, WARN, text, reason="apart")
            if observation is None:
                self.health.report(
                    "prediction",
                    ERROR,
                    "nothing published: no usable sensor data, see the sensor entries in /diagnostics",
                    reason="sensors",
                )
                return
            motion = track.at(stamp, maximum_gap=self.settings.odometry_timeout)
            self._report_ground(observation, motion)
            # The newest command is held over the horizon, unless it has expired.
            stamps = np.minimum(self.predictor.command_stamps(stamp), stamp)
            commands = corrected_commands(self.inputs.commands(), self.robot.effects)
            twists = commands.sample(stamps, timeout=self.settings.command_timeout)
            joints = None if self.joints is None else self.joints.at(stamp)
            if joints is not None and self.robot.flippers:
                observation = replace(observation, flipper_angles=joints.start[-len(self.robot.flippers) :])
            prediction = self.predictor.predict(
                observation, motion, twists, force_every=self._force_every, joints=joints
            )
            if not bool(prediction.rollout.valid.all()):
                raise ValueError("the rollout diverged")
            frame_id = self.inputs.frame_id or "odom"
            # Outputs for planners come first, those for people last.
            self._publish("path", encoders.path(prediction, frame_id, self.settings.path_time_step))
            if self._comparison is not None:
                self._comparison.submit(ComparisonJob(prediction, commands, twists, frame_id))
            self._publish("height_map", encoders.height_map(prediction, frame_id))
            self._publish("terrain", encoders.terrain_cloud(prediction, frame_id))
            self._publish("contact_forces", encoders.contact_forces(prediction, self.robot, frame_id))
            self.monitor.update(prediction, track, commands)
        except Exception as error:  # no input may end the node
            text = _explained(error)
            if not len(self.inputs.motion()) and self.health.level("odometry") == ERROR:
                text = "the odometry cannot be used, see its entry in /diagnostics"
            self.health.report("prediction", ERROR, f"nothing published: {text}", reason=type(error).__name__)
            return
        self._terrain_health.report()
        self._predictions += 1
        if self._predictions == 1:
            topic = self.resolve_topic_name("predicted/path")
            self.get_logger().info(
                f"first prediction: {self.settings.horizon:g} s ahead, in frame {frame_id!r}, published on {topic} "
                f"{1e3 * (time.monotonic() - started):.0f} ms after its data were complete"
            )
        self._last_prediction = time.monotonic()
        self._durations = [*self._durations[-199:], time.monotonic() - started]
        self.health.report("prediction", OK, "predicting", latency_ms=f"{1e3 * self._durations[-1]:.0f}")

    def _report_ground(self, observation: Observation, motion: MotionState) -> None:
        """Report whether the ground that a lidar sees around the robot is that on which it stands."""
        if observation.cloud is None:
            return
        apart = ground_around(observation.cloud, self.robot, motion, TerrainDefaults().stiffness)
        if apart:
            where = f"{abs(apart):.1f} m {'above' if apart > 0 else 'below'} its wheels on all sides"
            message = (
                f"the ground around the robot lies {where}: check how the sensors are mounted (the transforms from the "
                "base frame), and that their axes and units are right"
            )
            self.health.report("ground", WARN, message, reason="apart")
        else:
            self.health.report("ground", OK, "the ground around the robot is as high as its wheels")

    def _compare(self, job: ComparisonJob) -> None:
        """Publish candidates, ensemble and costmap of a prediction while the next one is made."""
        try:
            if self.costmap is not None:
                self.costmap.publish(job.prediction, job.frame_id)
            if self.candidates is not None:
                self.candidates.publish(job.prediction, job.commands, job.frame_id)
                self.candidates.latency.add((self.inputs.motion_stamp - job.prediction.stamp) * NANOSECOND)
            if self.ensemble is not None:
                self.ensemble.publish(job.prediction, job.twists, job.frame_id)
        except Exception as error:  # no input may end the node
            if not self.context.ok():
                return  # a signal has shut rclpy down meanwhile
            text = _explained(error)
            self.health.report("comparison", ERROR, f"nothing published: {text}", reason=type(error).__name__)
            return
        if self.candidates is None and self.ensemble is None:
            return
        dropped = self._comparison.dropped if self._comparison is not None else 0
        behind = (self.inputs.motion_stamp - job.prediction.stamp) * NANOSECOND
        if behind > _LATE:
            message = (
                f"candidates and ensemble are {behind:.1f} s behind the odometry: this computer is too slow for them; "
                "fewer `candidates`, a lower `rate` or a shorter `horizon`"
            )
            self.health.report("comparison", WARN, message, reason="slow", skipped_predictions=dropped)
            return
        self.health.report("comparison", OK, "candidates and ensemble are up to date", skipped_predictions=dropped)

    def _publish(self, name: str, data: bytes) -> None:
        if self.context.ok():
            self._outputs[name].publish(data)


def _explained(error: Exception) -> str:
    """An error in words: a ``ValueError`` explains itself, other types need to be named."""
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"


def main(arguments: list[str] | None = None) -> int:
    """Run the node; ``--help`` lists its parameters, which config/predictor.schema.yaml defines."""
    # The physics consists of many small operations, which are fastest on one thread; the encoder has its own setting.
    torch.set_num_threads(1)
    return run_schema_node("predictor", PredictorNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
