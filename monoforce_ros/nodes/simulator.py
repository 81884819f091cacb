"""simulator: a MuJoCo robot in the loop; takes commands and publishes sensor data in real time."""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial
from typing import Any

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState

from monoforce_ros.bags import builders, type_store
from monoforce_ros.core import OptionParser
from monoforce_ros.messages import decoding, message_class, missing_package
from monoforce_ros.nodes.arguments import own_arguments, refuse_given_parameters, seconds, seed
from monoforce_ros.nodes.frames import TRANSFORMS
from monoforce_ros.nodes.odometry_transform import odometry_transform
from monoforce_ros.nodes.parameters import refuse_unknown_parameters
from monoforce_ros.nodes.process import Signals, run_node
from monoforce_ros.nodes.subscriptions import AdaptiveSubscription, command_types
from monoforce_ros.synthetic import GROUNDS, LiveSettings, LiveWorld

_ODOMETRY_RATE = 50.0
_TICK = 0.01
_COMMAND_TIMEOUT = 0.5
"""Commands older than this are ignored and the robot stops, as real bases do [s]."""
_MAXIMUM_LAG = 0.5
"""Largest lag of the simulation behind real time; a larger lag is discarded [s]."""


def _arguments(arguments: list[str]) -> argparse.Namespace:
    parser = OptionParser(
        prog="simulator",
        description="Drive a simulated robot through ROS: cmd_vel (and flipper_commands) in; odom, joint_states, "
        "points and images out.",
    )
    parser.add_argument("--seed", type=seed, default=12, help="seed of the world (%(default)s)")
    parser.add_argument("--robot", default="husky", metavar="NAME|FILE.yaml", help="robot name or file (%(default)s)")
    parser.add_argument("--ground", choices=GROUNDS, default="mixed", help="type of ground (%(default)s)")
    parser.add_argument("--flat", action="store_true", help="level ground without obstacles")
    parser.add_argument("--course", action="store_true", help="test course: a wall across the path and a "
                        "band of tall grass behind it")  # fmt: skip
    parser.add_argument("--lidar-rate", type=float, default=5.0, metavar="HZ", help="0 disables it (%(default)s)")
    parser.add_argument("--camera-rate", type=float, default=0.0, metavar="HZ", help="0 disables it (%(default)s)")
    parser.add_argument(
        "--duration", type=seconds, default=float("inf"), metavar="S", help="simulated time (default: until stopped)"
    )
    options = parser.parse_args(arguments)
    for name in ("lidar_rate", "camera_rate"):
        if not 0.0 <= getattr(options, name) <= 50.0:
            parser.error(f"--{name.replace('_', '-')}: got {getattr(options, name)}, expected 0 to 50 Hz")
    return options


class SimulatorNode(Node):
    """Publishes the sensor data of a live world and executes the newest command."""

    def __init__(self, world: LiveWorld, options: argparse.Namespace):
        super().__init__("simulator")
        refuse_unknown_parameters(self)
        self._world = world
        self._options = options
        self._outputs: dict[str, Publisher] = {}
        self._last_command = float("-inf")
        self._subscription = AdaptiveSubscription(
            self,
            "cmd_vel",
            command_types(steering_angles=world.robot.wheelbase is not None),
            self._on_command,
            depth=5,
            follow_listeners=True,
        )
        self._flippers = np.array([arm.angle for arm in world.robot.flippers])
        if len(self._flippers):
            self._flipper_subscription = AdaptiveSubscription(
                self, "flipper_commands", {"sensor_msgs/msg/JointState": JointState}, self._on_flippers, depth=5
            )
        if message_class(TRANSFORMS) is None:
            self.get_logger().warning(f"no transforms are published on /tf: {missing_package(TRANSFORMS)}")
        else:
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._outputs["/tf_static"] = self.create_publisher(message_class(TRANSFORMS), "/tf_static", latched)
            self._outputs["/tf"] = self.create_publisher(message_class(TRANSFORMS), "/tf", 100)
            stamp = self.get_clock().now().nanoseconds
            sensors = builders.transforms(stamp, world.robot.base_frame, world.robot.sensors)
            self._publish("/tf_static", sensors)
        self._next_output = dict.fromkeys(("odometry", "cloud", "images"), 0.0)

    def _on_command(self, message: Any) -> None:
        robot = self._world.robot
        try:
            if hasattr(message, "drive") and robot.wheelbase is not None:
                command = decoding.decode_ackermann(message, robot.wheelbase)
            else:
                command = decoding.decode_command(message, lateral=robot.crabs)
        except decoding.MessageError as error:
            self.get_logger().warning(f"cmd_vel: {error}", throttle_duration_sec=2.0)
            return
        self._last_command = self._world.time
        self._world.simulation.drive(*command.tolist())

    def _on_flippers(self, message: JointState) -> None:
        """Move to the commanded angles; flippers that the message does not name hold theirs."""
        names = [arm.name for arm in self._world.robot.flippers]
        try:
            angles, _ = decoding.decode_joints(message, names)
        except decoding.MessageError as error:
            self.get_logger().warning(f"flipper_commands: {error}", throttle_duration_sec=2.0)
            return
        self._flippers = np.where(np.isfinite(angles), angles, self._flippers)
        self._world.simulation.move_flippers(self._flippers)

    def advance(self, until: float, origin: float) -> None:
        """Simulate up to a time and publish the outputs that are due.

        Args:
            until: simulated time [s].
            origin: time of the node's clock at simulated time zero [s].
        """
        world = self._world
        if world.time - self._last_command > _COMMAND_TIMEOUT:
            world.simulation.drive(0.0, 0.0)
        world.advance(until)
        stamp = round((origin + world.time) * 1e9)
        if self._due("cloud", self._options.lidar_rate):
            self._publish("points", world.cloud(stamp))
        if self._due("images", self._options.camera_rate):
            for frame, image, info in world.images(stamp):
                self._publish(f"{frame}/camera_info", info)
                self._publish(f"{frame}/image_raw/compressed", image)
        if self._due("odometry", _ODOMETRY_RATE):
            odometry = world.odometry(stamp)
            self._publish("odom", odometry)
            self._publish("joint_states", world.joint_states(stamp))
            if "/tf" in self._outputs:
                self._publish("/tf", odometry_transform(odometry))

    def _due(self, name: str, rate: float) -> bool:
        if not rate or self._world.time < self._next_output[name] - 1e-6:
            return False
        self._next_output[name] = max(self._next_output[name] + 1.0 / rate, self._world.time)
        return True

    def _publish(self, topic: str, message: Any | None) -> None:
        """Publish a message of the bag builders, whose types the rosbags library creates at run time."""
        if message is None or not self.context.ok():
            return
        name = message.__msgtype__
        if topic not in self._outputs:
            self._outputs[topic] = self.create_publisher(message_class(name), topic, 5)
        self._outputs[topic].publish(bytes(type_store().serialize_cdr(message, name)))


def _settings(options: argparse.Namespace) -> LiveSettings:
    from monoforce_ros.synthetic import CameraSettings, CourseSettings, LidarSettings, TerrainSettings

    return LiveSettings(
        seed=options.seed,
        robot=options.robot,
        terrain=TerrainSettings(flat=options.flat, ground=options.ground),
        course=CourseSettings.draw(options.seed) if options.course else None,
        camera=CameraSettings() if options.camera_rate else None,
        lidar=LidarSettings() if options.lidar_rate else None,
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the simulator; see ``--help``."""
    command_line = sys.argv if arguments is None else ["simulator", *arguments]
    options = _arguments(own_arguments(command_line[1:]))
    try:
        refuse_given_parameters(command_line, "simulator")
        world = LiveWorld(_settings(options))
    except (ValueError, OSError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1

    def make_node() -> SimulatorNode:
        node = SimulatorNode(world, options)
        node.get_logger().info(f"simulating {world.robot.name} in world {options.seed}")
        return node

    try:
        return run_node(make_node, command_line, partial(_run, world=world, duration=options.duration))
    finally:
        world.close()


def _run(
    node: SimulatorNode, executor: SingleThreadedExecutor, signals: Signals, *, world: LiveWorld, duration: float
) -> None:
    """Keep the simulated time in step with real time."""
    began = time.monotonic()
    origin = node.get_clock().now().nanoseconds * 1e-9
    while signals.running and world.time < duration:
        now = time.monotonic() - began
        if now - world.time > _MAXIMUM_LAG:
            # The computer is too slow: the world and its stamps fall behind instead of jumping.
            node.get_logger().warning("the simulation is slower than real time", throttle_duration_sec=5.0)
            began += now - world.time - _TICK
            origin += now - world.time - _TICK
        if (mishap := world.simulation.mishap()) is not None:
            node.get_logger().error(f"the simulation ended early: {mishap}")
            return
        if now > world.time:
            node.advance(world.time + _TICK, origin)
        executor.spin_once(timeout_sec=max(0.0, world.time - (time.monotonic() - began)))


if __name__ == "__main__":
    sys.exit(main())
