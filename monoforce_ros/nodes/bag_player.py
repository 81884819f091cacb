"""bag_player: publishes the messages of a bag with their recorded timing."""

from __future__ import annotations

import argparse
import os
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from monoforce_ros.bags import BagError, BagMessage, BagReader, type_store
from monoforce_ros.core import OptionParser, TransformTree, nearest, share_directory
from monoforce_ros.messages import decoding, message_class, missing_package
from monoforce_ros.nodes.arguments import (
    idle_remappings,
    own_arguments,
    refuse_given_parameters,
    seconds,
)
from monoforce_ros.nodes.frames import TRANSFORMS
from monoforce_ros.nodes.odometry_transform import odometry_transform
from monoforce_ros.nodes.parameters import refuse_unknown_parameters
from monoforce_ros.nodes.process import initialise
from monoforce_ros.reporting import progress_bar

# Fast DDS 2 (Jazzy) reads the first, Fast DDS 3 the second.
_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")


_SEARCHED = 5_000_000_000
"""Part of a bag in which transforms are looked for [ns]: state estimators publish theirs many times a second."""


def _arguments(arguments: list[str]) -> argparse.Namespace:
    parser = OptionParser(
        prog="bag_player", description="Publish the messages of a bag (ROS 2 or ROS 1) with their recorded timing."
    )
    parser.add_argument("bag", nargs="?", help="rosbag2 folder or ROS 1 .bag file (default: the demo bag)")
    parser.add_argument("--rate", type=float, default=1.0, help="speed relative to the recording (default 1)")
    parser.add_argument("--start", type=seconds, default=0.0, help="seconds to skip at the beginning")
    parser.add_argument("--duration", type=seconds, default=None, help="seconds of the bag to play")
    parser.add_argument("--loop", action="store_true", help="start over at the end")
    parser.add_argument("--clock", action="store_true", help="publish /clock with the bag's time")
    parser.add_argument("--topics", nargs="+", default=None, metavar="TOPIC", help="play only these topics")
    parser.add_argument(
        "--wait", type=seconds, default=3.0, help="seconds to wait for the first subscriber before playing (default 3)"
    )
    parser.add_argument(
        "--no-tf",
        action="store_true",
        help="do not derive the robot's pose on /tf from the odometry of a bag that lacks it",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    options = parser.parse_args(arguments)
    if not 0.001 <= options.rate <= 1000:
        parser.error(f"--rate: got {options.rate}, expected 0.001 to 1000")
    if options.duration == 0:
        parser.error("--duration: got 0, expected a positive number of seconds")
    return options


class BagPlayer(Node):
    """Publishes the serialized messages of a bag without decoding them."""

    def __init__(self, bag: BagReader, options: argparse.Namespace):
        super().__init__("bag_player")
        refuse_unknown_parameters(self)
        self.bag = bag
        self.options = options
        self.playable: dict[str, Publisher] = {}
        # Names in a bag are absolute; a name without its first slash is meant for one of them.
        wanted = {f"/{topic.lstrip('/')}" for topic in options.topics} if options.topics else None
        missing = sorted((wanted or set()) - set(bag.topics))
        if missing:
            meant = nearest(missing[0], bag.topics)
            raise BagError(f"{bag.path} has no topics {missing}{meant or ';'} its topics are {sorted(bag.topics)}")
        if 1e9 * options.start > bag.end - bag.start:
            raise BagError(f"--start: got {options.start:g} s, but {bag.path} lasts {bag.duration:.1f} s")
        for topic, message_type in bag.topics.items():
            if wanted is not None and topic not in wanted:
                continue
            if topic == "/clock" and options.clock:
                self.get_logger().info("the bag's own /clock is not played: --clock publishes the time of reception")
                continue
            message_type_class = message_class(message_type)
            if message_type_class is None:
                self.get_logger().warning(f"{topic} is not played: {missing_package(message_type)}")
                continue
            latched = topic in bag.latched
            quality = QoSProfile(
                depth=100 if _is_static(topic) else 1 if latched else 10,
                reliability=ReliabilityPolicy.RELIABLE,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
            )
            self.playable[topic] = self.create_publisher(message_type_class, topic, quality)
        self.clock = self.create_publisher(Clock, "/clock", 10) if options.clock else None
        self._odometry, self._transforms = self._prepare_transforms()

    def _prepare_transforms(self) -> tuple[str, Publisher | None]:
        """The odometry topic whose poses are published on /tf, and the publisher; None if there is nothing to do."""
        played = [topic for topic in self.bag.of_type("nav_msgs/msg/Odometry") if topic in self.playable]
        recorded = [topic for topic in self.bag.of_type(TRANSFORMS) if not _is_static(topic)]
        kind = message_class(TRANSFORMS)
        if self.options.no_tf or not played or kind is None:
            return "", None
        topic = max(played, key=lambda name: self.bag.counts[name])
        if recorded:
            missing = self._missing_transform(topic)
            target = next((name for name in recorded if name in self.playable), "")
            if not missing or not target:
                return "", None
            self.get_logger().info(
                f"the bag's {target} has no {missing}: it is derived from {topic} (--no-tf disables this)"
            )
            return topic, self.playable[target]
        # A robot in a namespace may have a /tf of its own; then its static transforms are there, too.
        static = sorted(topic for topic in self.playable if _is_static(topic))
        target = static[0].removesuffix("_static") if static else "/tf"
        self.get_logger().info(f"the bag has no {target}: it is derived from {topic} (--no-tf disables this)")
        return topic, self.create_publisher(kind, target, 100)

    def _missing_transform(self, odometry: str) -> str:
        """The transform of an odometry topic, in words, if the transforms at the start of the bag do not contain it."""
        tree, frames = TransformTree(), ("", "")
        topics = [odometry, *self.bag.of_type(TRANSFORMS)]
        for message in self.bag.messages(topics, stop=self.bag.start + _SEARCHED):
            try:
                decoded = message.decode()
                if message.topic != odometry:
                    for (parent, child), matrix in decoding.decode_transforms(decoded).items():
                        tree.add(parent, child, matrix)
                elif not frames[0]:
                    frames = decoded.header.frame_id or "odom", decoded.child_frame_id or "base_link"
            except ValueError:
                continue
            if frames[0] and tree.find(*frames) is not None:
                return ""
        return f"{frames[0]} → {frames[1]}" if frames[0] else ""

    def wait_for_subscribers(self) -> None:
        """Wait for a first subscriber, and then a little longer for further ones."""
        deadline = time.monotonic() + self.options.wait
        while time.monotonic() < deadline and self.context.ok():
            publishers = [*self.playable.values(), *filter(None, [self._transforms])]
            if any(publisher.get_subscription_count() for publisher in publishers):
                self._sleep(min(1.0, self.options.wait))
                return
            self._sleep(0.05)
        if self.options.wait and self.context.ok():
            self.get_logger().warning("no subscribers on the bag's topics; playing anyway")

    def play(self) -> int:
        """Play once or in a loop; returns the number of messages published."""
        self.wait_for_subscribers()
        published = 0
        while self.context.ok():
            published += self._play_once()
            if not self.options.loop:
                break
        return published

    def _publish_earlier(self, start: int) -> None:
        """Publish what holds since before the start: all static transforms, and the last message of latched topics."""
        latched = self.bag.latched & set(self.playable)
        last: dict[str, BagMessage] = {}
        for message in self.bag.messages(latched, stop=start) if latched and start > self.bag.start else ():
            if _is_static(message.topic):
                self.playable[message.topic].publish(message.cdr())
            else:
                last[message.topic] = message
        for message in last.values():
            self.playable[message.topic].publish(message.cdr())

    def _publish_pose(self, message: BagMessage) -> None:
        """Publish an odometry message's pose on /tf."""
        if self._transforms is None or message.topic != self._odometry:
            return
        try:
            transform = odometry_transform(message.decode())
        except ValueError as error:
            self.get_logger().warning(f"/tf: {error}", throttle_duration_sec=10.0)
            return
        self._transforms.publish(bytes(type_store().serialize_cdr(transform, TRANSFORMS)))

    def _play_once(self) -> int:
        start = self.bag.start + int(self.options.start * 1e9)
        self._publish_earlier(start)
        length = self.options.duration if self.options.duration is not None else (self.bag.end - start) * 1e-9
        stop = start + int(length * 1e9)
        published = 0
        began = time.monotonic()
        bar = progress_bar(
            round(max(length, 0.0), 1),
            label="playing",
            unit="s",
            bar_format="{desc} {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s",
            quiet=self.options.quiet,
        )
        with bar:
            for message in self.bag.messages(self.playable, start=start, stop=stop + 1):
                elapsed = (message.received - start) * 1e-9
                self._sleep(elapsed / self.options.rate - (time.monotonic() - began))
                if not self.context.ok():
                    break
                if self.clock:
                    now = Clock()
                    now.clock.sec, now.clock.nanosec = divmod(message.received, 10**9)
                    self.clock.publish(now)
                self._publish_pose(message)
                self.playable[message.topic].publish(message.cdr())
                published += 1
                bar.update(elapsed - bar.n)
        return published

    def linger(self) -> None:
        """Wait after the last message: slow readers may drop it if its publisher disappears at once."""
        self._sleep(0.5)

    def _sleep(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while self.context.ok() and (remaining := deadline - time.monotonic()) > 0:
            time.sleep(min(remaining, 0.1))


def _is_static(topic: str) -> bool:
    return topic.rsplit("/", 1)[-1] == "tf_static"


def main(arguments: list[str] | None = None) -> int:
    """Run the player; see ``--help``."""
    command_line = sys.argv if arguments is None else ["bag_player", *arguments]
    options = _arguments(own_arguments(command_line[1:]))
    # Raw images do not fit into the default shared memory segment; this must be set before the first node.
    for variable in _PROFILES:
        os.environ.setdefault(variable, str(share_directory() / "config" / "fastdds_large_messages.xml"))
    try:
        refuse_given_parameters(command_line, "bag_player")
        initialise(command_line, SignalHandlerOptions.ALL)
        with BagReader(options.bag or share_directory() / "bags" / "demo") as bag:
            player = BagPlayer(bag, options)
            player.get_logger().info(
                f"playing {bag.path}: {bag.duration:.1f} s, {len(player.playable)} topics, {bag.message_count} messages"
            )
            for warning in (*bag.warnings, *idle_remappings(command_line, player)):
                player.get_logger().warning(warning)
            published = player.play()
            player.get_logger().info(f"published {published} messages")
            # Messages in transit are lost with their publisher: wait for acknowledgement of the reliable ones, and a
            # moment for the others.
            for publisher in player.playable.values():
                if player.context.ok():
                    publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=1.0))
            player.linger()
            player.destroy_node()
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
