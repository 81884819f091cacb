"""bag_recorder: records topics into a bag, for computers without ros2 bag."""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from monoforce_ros.bags import BagWriter
from monoforce_ros.core import OptionParser
from monoforce_ros.messages import message_class, missing_package
from monoforce_ros.nodes.arguments import own_arguments, refuse_given_parameters, topic_name
from monoforce_ros.nodes.clocks import STEADY
from monoforce_ros.nodes.parameters import refuse_unknown_parameters
from monoforce_ros.nodes.process import Signals, initialise
from monoforce_ros.nodes.subscriptions import AdaptiveSubscription


def _arguments(arguments: list[str]) -> argparse.Namespace:
    parser = OptionParser(
        prog="bag_recorder", description="Record topics into a rosbag2 bag until interrupted (SIGINT or SIGTERM)."
    )
    parser.add_argument("out", help="folder of the bag; must not exist")
    parser.add_argument("--topics", nargs="+", type=topic_name, metavar="TOPIC", help="topics (default: all)")
    parser.add_argument("--storage", choices=["mcap", "sqlite3"], default="mcap", help="storage format (default mcap)")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing bag")
    return parser.parse_args(arguments)


class BagRecorder(Node):
    """Subscribes to topics as they appear and writes their messages without decoding them."""

    def __init__(self, bag: BagWriter, topics: list[str] | None):
        super().__init__("bag_recorder")
        refuse_unknown_parameters(self)
        self._bag = bag
        self._topics = None if topics is None else {self.resolve_topic_name(topic) for topic in topics}
        self._subscribed: set[str] = set()
        self._subscriptions_by_topic: dict[str, AdaptiveSubscription] = {}
        self._failed: set[str] = set()
        self.recorded = 0
        self._timer = self.create_timer(0.2, self._subscribe_new, clock=STEADY)
        self._flusher = self.create_timer(1.0, bag.flush, clock=STEADY)
        self._subscribe_new()

    @property
    def missing(self) -> list[str]:
        """Topics that were asked for and never published."""
        return sorted((self._topics or set()) - self._subscribed)

    def _subscribe_new(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            if topic in self._subscribed or (self._topics is not None and topic not in self._topics):
                continue
            if not self.count_publishers(topic):
                continue
            self._subscribed.add(topic)
            kind = message_class(types[0])
            if kind is None:
                self.get_logger().warning(f"{topic} is not recorded: {missing_package(types[0])}")
                continue
            if not self._bag.knows(types[0]):
                package = types[0].partition("/")[0]
                self.get_logger().warning(
                    f"{topic} is not recorded: no definition of {types[0]} is in share/{package}/msg of a prefix on "
                    "AMENT_PREFIX_PATH"
                )
                continue
            # Follows a driver that starts again with another quality of service.
            self._subscriptions_by_topic[topic] = AdaptiveSubscription(
                self, topic, {types[0]: kind}, partial(self._write, topic, types[0]), depth=100, raw=True
            )
            self.get_logger().info(f"recording {topic} ({types[0]})")

    def _write(self, topic: str, message_type: str, data: bytes) -> None:
        if topic in self._failed:
            return
        latched = self._subscriptions_by_topic[topic].latched
        try:
            self._bag.write_serialized(topic, message_type, data, time.time_ns(), latched=latched)
        except OSError:
            # The disk is full, or gone: nothing more can be recorded.
            raise
        except Exception as error:  # one topic must not end the recording of the others
            self._failed.add(topic)
            self.get_logger().error(f"{topic} is not recorded any more: {type(error).__name__}: {error}")
            return
        self.recorded += 1


def main(arguments: list[str] | None = None) -> int:
    """Run the recorder; see ``--help``."""
    command_line = sys.argv if arguments is None else ["bag_recorder", *arguments]
    options = _arguments(own_arguments(command_line[1:]))
    try:
        refuse_given_parameters(command_line, "bag_recorder")
        signals = Signals()
        initialise(command_line)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for unfinished in BagWriter.unfinished(options.out):
        print(f"an earlier recording was killed and is in {unfinished}; it can be read as it is", file=sys.stderr)
    try:
        with BagWriter(options.out, storage=options.storage, overwrite=options.overwrite, keep=True) as bag:
            recorder = BagRecorder(bag, options.topics)
            executor = SingleThreadedExecutor()
            executor.add_node(recorder)
            try:
                signals.spin(executor)
            except (KeyboardInterrupt, ExternalShutdownException):
                pass
            finally:
                print(f"recorded {recorder.recorded} messages into {options.out}", file=sys.stderr)
                if recorder.missing:
                    print(f"nobody published {', '.join(recorder.missing)}", file=sys.stderr)
                recorder.destroy_node()
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
