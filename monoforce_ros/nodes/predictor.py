"""The predictor node: sensor data, odometry and commands in; terrain, path and contact forces out."""

from __future__ import annotations

import os
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import torch
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import GridCells, Odometry, Path
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from monoforce_ros.bags import camera_info_topic
from monoforce_ros.core import NANOSECOND, CameraModel, CommandTrack, MotionTrack, share_directory, transform_points
from monoforce_ros.effects import corrected_commands, corrected_motion
from monoforce_ros.messages import decoding
from monoforce_ros.nodes import prediction_messages as encoders
from monoforce_ros.nodes.background_worker import BackgroundWorker
from monoforce_ros.nodes.candidate_output import CandidateOutput
from monoforce_ros.nodes.frames import SensorFrames
from monoforce_ros.nodes.gap_output import GapOutput
from monoforce_ros.nodes.health import ERROR, OK, STALE, WARN, Health
from monoforce_ros.nodes.inputs import Inputs, Received
from monoforce_ros.nodes.managed import ManagedNode
from monoforce_ros.nodes.parameters import declare_parameters, follow_changes, parameter_help, read_parameter_file
from monoforce_ros.nodes.process import run_node
from monoforce_ros.nodes.rate_limiter import RateLimiter
from monoforce_ros.nodes.spread_output import SpreadOutput
from monoforce_ros.nodes.subscriptions import AdaptiveSubscription
from monoforce_ros.perception import Observation, TerrainSource, choose_terrain_source
from monoforce_ros.physics import PhysicsOptions
from monoforce_ros.prediction import FORCE_INTERVAL, Prediction, Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults

PARAMETER_FILE = share_directory() / "config" / "predictor.yaml"


class PredictorNode(ManagedNode):
    """Predicts from the newest data, in a thread of its own, so that callbacks never wait for physics."""

    def __init__(self):
        super().__init__("predictor")
        entries = read_parameter_file(PARAMETER_FILE)
        self.settings = declare_parameters(self, entries)
        self.candidates: CandidateOutput | None = None
        self.spread: SpreadOutput | None = None
        self._beside: BackgroundWorker | None = None
        follow_changes(self, entries, self._change_settings)
        if self.settings.autostart:
            self.autostart()
        else:
            self.get_logger().info("waiting to be configured")

    def set_up(self) -> None:
        """Load robot and encoder, subscribe to inputs, advertise outputs."""
        settings = self.settings
        # One thread: on a small computer PyTorch's pool costs more than it brings at these sizes.
        torch.set_num_threads(1)
        self.robot = load_robot(settings.robot)
        self.frames = SensorFrames(self, self.robot)
        self.predictor = Predictor(
            self.robot,
            self._terrain_source(),
            horizon=settings.horizon,
            options=PhysicsOptions(time_step=settings.time_step),
        )
        self._force_every = max(1, round(FORCE_INTERVAL / settings.time_step))
        self.get_logger().info(
            "preparing the physics; the first time on a machine its kernels are compiled, about 10 s"
        )
        self.predictor.warm_up()
        self.sensor_topics = self._sensor_topics()
        self.health = Health(self, ["odometry", "commands", *self.sensor_topics, "prediction", "live gap"])
        self.inputs = Inputs(
            list(self.sensor_topics.values()),
            slop=settings.camera_slop,
            patience=settings.data_timeout,
            on_time_jump=self._on_time_jump,
        )
        self.cameras: dict[str, CameraModel | decoding.MessageError] = {}
        self._arrivals: dict[str, float] = {}
        self._started = time.monotonic()
        self._predictions = 0
        self._last_prediction = self._started
        self._durations: list[float] = []
        self.gap = GapOutput(self, self.predictor, self.health)
        wanted = settings.candidates or settings.candidate_topic
        self.candidates = CandidateOutput(self, self.predictor, settings, self.health) if wanted else None
        self.spread = SpreadOutput(self, self.predictor, settings) if settings.ensemble else None
        self._subscribe()
        offered = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}
        newest = QoSProfile(depth=1, reliability=offered[settings.output_qos], history=HistoryPolicy.KEEP_LAST)
        self._outputs = {
            "height_map": self.create_publisher(GridCells, "predicted/height_map", newest),
            "terrain": self.create_publisher(PointCloud2, "predicted/terrain", newest),
            "path": self.create_publisher(Path, "predicted/path", newest),
            "contact_forces": self.create_publisher(MarkerArray, "predicted/contact_forces", newest),
        }

    def begin(self) -> None:
        """Predict from now on."""
        self._started = self._last_prediction = time.monotonic()
        self._watch = self.create_timer(0.5, self._watch_inputs)
        self._running = True
        compares = self.candidates is not None or self.spread is not None
        self._beside = (
            BackgroundWorker("comparison", self._compare, self.settings.comparison_niceness) if compares else None
        )
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
        if self._beside is not None:
            self._beside.stop()
        if self.context.ok():
            self.health.report("prediction", STALE, "deactivated: nothing is predicted", reason="deactivated")

    def _change_settings(self, changed: SimpleNamespace) -> None:
        """Take changed parameters as a whole; raises ``ValueError`` where they do not fit."""
        if self.candidates is not None:
            self.candidates.apply(changed)
        if self.spread is not None:
            self.spread.apply(changed)
        self.settings = changed

    def _terrain_source(self) -> TerrainSource:
        settings = self.settings
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
            retention_time=settings.camera_memory,
        )

    def _sensor_topics(self) -> dict[str, str]:
        """Part name → resolved topic of every sensor that the terrain source uses."""
        settings, sensors = self.settings, self.predictor.source.sensors
        topics = {}
        if "lidar" in sensors:
            topics["lidar"] = self.resolve_topic_name(settings.cloud_topic)
        if "camera" in sensors:
            topics |= {f"camera {topic}": self.resolve_topic_name(topic) for topic in settings.image_topics if topic}
        return topics

    def _subscribe(self) -> None:
        settings = self.settings
        # Of sensor data only the newest counts; motion and commands are all wanted.
        large = {"depth": 2, "reliability": settings.image_qos}
        small = {"depth": 50}
        self._subscriptions_by_part = {
            "odometry": AdaptiveSubscription(
                self, settings.odometry_topic, {"nav_msgs/msg/Odometry": Odometry}, self._on_odometry, **small
            ),
            "commands": AdaptiveSubscription(
                self,
                settings.command_topic,
                {"geometry_msgs/msg/TwistStamped": TwistStamped, "geometry_msgs/msg/Twist": Twist},
                self._on_command,
                **small,
            ),
        }
        images = {"sensor_msgs/msg/CompressedImage": CompressedImage, "sensor_msgs/msg/Image": Image}
        info_topics = [*settings.camera_info_topics, *[""] * len(self.sensor_topics)]
        index = 0
        for part, topic in self.sensor_topics.items():
            types = {"sensor_msgs/msg/PointCloud2": PointCloud2} if part == "lidar" else images
            self._subscriptions_by_part[part] = AdaptiveSubscription(
                self, topic, types, lambda message, part=part: self._on_sensor(part, message), **large
            )
            if part != "lidar":
                info = info_topics[index] or camera_info_topic(topic)
                index += 1
                self._subscriptions_by_part[f"{part} info"] = AdaptiveSubscription(
                    self,
                    info,
                    {"sensor_msgs/msg/CameraInfo": CameraInfo},
                    lambda message, part=part: self._on_camera_info(part, message),
                    **small,
                )

    # Callbacks: decode what is small, keep what is large, never raise.

    def _on_odometry(self, message: Odometry) -> None:
        self._arrivals["odometry"] = time.monotonic()
        try:
            state, frame_id, child_frame_id = decoding.decode_odometry(message)
        except decoding.MessageError as error:
            self.health.report("odometry", ERROR, str(error), reason="unusable")
            return
        self.inputs.add_motion("odometry", state, frame_id, child_frame_id)
        if child_frame_id.lstrip("/") not in ("", self.robot.base_frame):
            self.health.report(
                "odometry",
                WARN,
                f"its child frame is {child_frame_id!r}, the robot file's base frame {self.robot.base_frame!r}: "
                "taken as the same place",
                reason="frame",
            )
        else:
            self.health.report("odometry", OK, "fresh")

    def _on_command(self, message: Twist | TwistStamped) -> None:
        self._arrivals["commands"] = time.monotonic()
        try:
            twist = decoding.decode_command(message)
        except decoding.MessageError as error:
            self.health.report("commands", ERROR, str(error), reason="unusable")
            return
        self.inputs.add_command("commands", decoding.stamp_of(message), twist)
        self.health.report("commands", OK, "fresh")

    def _on_sensor(self, part: str, message: PointCloud2 | Image | CompressedImage) -> None:
        self._arrivals[part] = time.monotonic()
        stamp = decoding.stamp_of(message)
        if stamp == 0:
            self.health.report(part, ERROR, "its stamps are zero: the driver does not set them", reason="zero stamp")
            return
        self.inputs.add_sensor(part, stamp, message)

    def _on_camera_info(self, part: str, message: CameraInfo) -> None:
        try:
            self.cameras[part] = decoding.decode_camera_info(message)
        except decoding.MessageError as error:
            # Reported with the next image, which it keeps from being used.
            self.cameras[part] = error

    def _on_time_jump(self, topic: str, seconds: float) -> None:
        self.gap.clear()
        self.health.report(
            "prediction",
            WARN,
            f"time went back by {seconds:.1f} s on {topic} (a bag that starts over?): older data were forgotten",
            reason="time jump",
        )

    def _watch_inputs(self) -> None:
        """Say which input has fallen silent; what was predicted before is never repeated."""
        now, limit = time.monotonic(), self.settings.data_timeout
        for part, subscription in self._subscriptions_by_part.items():
            silence = now - self._arrivals.get(part, self._started)
            if part.endswith(" info") or silence < limit:
                continue
            if subscription.wrong_type:
                cause = f"{subscription.topic} carries {subscription.wrong_type}, which is not usable here"
            elif not subscription.publishers:
                cause = f"nobody publishes {subscription.topic}"
            else:
                cause = f"{subscription.publishers} publisher(s) on {subscription.topic} send nothing"
            level = WARN if part == "commands" else ERROR
            suffix = "; the robot is predicted to stand still" if part == "commands" else ""
            self.health.report(part, level, f"nothing for {silence:.1f} s: {cause}{suffix}", reason=f"silent, {cause}")
        if now - self._last_prediction > limit and self.health.level("prediction") == OK:
            self.health.report("prediction", STALE, f"no new data to predict from for {limit:g} s", reason="no data")
        if self._durations:
            recent = sorted(self._durations[-50:])
            self.health.report_values("prediction", self._figures(recent))

    def _figures(self, recent: list[float]) -> dict[str, str]:
        return {
            "predictions": str(self._predictions),
            "dropped inputs": str(self.inputs.dropped),
            "median duration [ms]": f"{1e3 * recent[len(recent) // 2]:.0f}",
            **(self.candidates.figures if self.candidates is not None else {}),
        }

    # The worker: one prediction after the other, always from the newest data.

    def _work(self) -> None:
        pace = RateLimiter()
        last = 0
        while self._running:
            if self.sensor_topics:
                received = self.inputs.take(odometry_timeout=self.settings.odometry_timeout, wait=0.5)
            else:
                # Flat ground needs no sensor: predict from each new odometry.
                received = self.inputs.take_motion(last, wait=0.5)
            if received is None or not self._running:
                continue
            if not pace.due(time.monotonic(), self.settings.rate):
                self.inputs.drop(received)
                continue
            last = max(entry.stamp for entry in received.values())
            self._predict(received)

    def _predict(self, received: dict[str, Received]) -> None:
        started = time.monotonic()
        stamp = max(entry.stamp for entry in received.values())
        try:
            track = corrected_motion(self.inputs.motion(), self.robot.effects)
            observation = self._observe(stamp, received, track)
            if observation is None:
                return
            motion = track.at(stamp, maximum_gap=self.settings.odometry_timeout)
            # The newest command is held over the horizon, unless it is too old to count at all.
            stamps = np.minimum(self.predictor.command_stamps(stamp), stamp)
            commands = corrected_commands(self.inputs.commands(), self.robot.effects)
            twists = commands.sample(stamps, timeout=self.settings.command_timeout)
            prediction = self.predictor.predict(observation, motion, twists, force_every=self._force_every)
            if not bool(prediction.rollout.valid.all()):
                raise ValueError("the rollout diverged")
            frame_id = self.inputs.frame_id or "odom"
            # What is steered by comes first, what is looked at last.
            self._publish("path", encoders.path(prediction, frame_id, self.settings.path_time_step))
            if self._beside is not None:
                self._beside.give((prediction, commands, twists, frame_id))
            self._publish("height_map", encoders.height_map(prediction, frame_id))
            self._publish("terrain", encoders.terrain_cloud(prediction, frame_id))
            self._publish("contact_forces", encoders.contact_forces(prediction, self.robot, frame_id))
            self.gap.update(prediction, track, commands)
        except Exception as error:  # the node must outlive whatever its input brings about
            # Errors that say what is wrong with the input are ValueErrors; others need their kind to be understood.
            text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            self.health.report("prediction", ERROR, f"nothing published: {text}", reason=type(error).__name__)
            return
        self._predictions += 1
        self._last_prediction = time.monotonic()
        self._durations = [*self._durations[-199:], time.monotonic() - started]
        self.health.report("prediction", OK, "predicting", latency_ms=f"{1e3 * self._durations[-1]:.0f}")

    def _compare(self, job: tuple[Prediction, CommandTrack, np.ndarray, str]) -> None:
        """Candidates and spread of a prediction, while the next one is made."""
        prediction, commands, twists, frame_id = job
        try:
            if self.candidates is not None:
                self.candidates.publish(prediction, commands, frame_id)
            if self.spread is not None:
                self.spread.publish(prediction, twists, frame_id)
        except Exception as error:  # the node must outlive whatever its input brings about
            text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            self.health.report("comparison", ERROR, f"nothing published: {text}", reason=type(error).__name__)
            return
        self.health.report("comparison", OK, "candidates and spread are up to date", left_out=self._beside.dropped)

    def _observe(self, stamp: int, received: dict[str, Received], track: MotionTrack) -> Observation | None:
        """Decode sensor messages; a fault is reported on its part, and None returned where nothing usable remains.

        What was seen before ``stamp`` is given as seen from where the robot is at ``stamp``.
        """
        cloud, images, cameras, poses = None, {}, {}, {}
        for part, entry in received.items():
            if part == "odometry":
                continue
            try:
                pose_of = self.frames.base_from(entry.message.header.frame_id)
                limit = self.settings.odometry_timeout
                pose_of = track.base_between(entry.stamp, stamp, maximum_gap=limit) @ pose_of
                if part == "lidar":
                    cloud = transform_points(pose_of, decoding.decode_cloud(entry.message))
                else:
                    images[part], cameras[part] = self._view(part, entry.message)
                    poses[part] = pose_of
            except (decoding.MessageError, ValueError) as error:
                self.health.report(part, ERROR, str(error), reason=str(error)[:40])
                continue
            age = (stamp - entry.stamp) * NANOSECOND
            self.health.report(part, OK, "fresh", age_in_set_s=f"{age:.3f}")
        if not received.keys() <= {"odometry"} and cloud is None and not images:
            self.health.report(
                "prediction", ERROR, "nothing published: no usable sensor data, see the sensors", reason="sensors"
            )
            return None
        return Observation(stamp, cloud, images, cameras, poses)

    def _view(self, part: str, message: Image | CompressedImage):
        camera = self.cameras.get(part)
        if isinstance(camera, decoding.MessageError):
            raise camera
        if camera is None:
            topic = self._subscriptions_by_part[f"{part} info"].topic
            raise decoding.MessageError(
                f"no usable CameraInfo on {topic}, which the camera needs; name its topic in `camera_info_topics`"
            )
        image = decoding.decode_image(message)
        if image.shape[:2] != (camera.height, camera.width):
            raise decoding.MessageError(
                f"images are {image.shape[1]} × {image.shape[0]} px, but CameraInfo says {camera.width} × "
                f"{camera.height} px"
            )
        return image, camera

    def _publish(self, name: str, data: bytes) -> None:
        if self.context.ok():
            self._outputs[name].publish(data)


def main(arguments: list[str] | None = None) -> int:
    """Run the predictor node; ``--help`` lists its parameters, which config/predictor.yaml defines."""
    given = sys.argv[1:] if arguments is None else arguments
    if {"-h", "--help"} & set(given):
        print(parameter_help("predictor", read_parameter_file(PARAMETER_FILE)))
        return 0
    return run_node(PredictorNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
