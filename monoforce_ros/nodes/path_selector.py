"""path_selector: drives the robot to a goal with the predictor's candidates; an example of their use."""

from __future__ import annotations

import sys
import time

import numpy as np
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from monoforce_ros.core import NANOSECOND, MotionState, share_directory
from monoforce_ros.messages import decoding
from monoforce_ros.nodes.health import ERROR, OK, WARN, Health
from monoforce_ros.nodes.parameters import declare_parameters, parameter_help, read_parameter_file
from monoforce_ros.nodes.process import run_node
from monoforce_ros.planning import CostToGo, SelectionWeights, cost_to_go, select_candidate

PARAMETER_FILE = share_directory() / "config" / "path_selector.yaml"
PART = "choice"
DISTANCE = "distance to the goal [m]"


class PathSelectorNode(Node):
    """Publishes the best candidate's command; stops the robot if there is no reliable one."""

    def __init__(self) -> None:
        super().__init__("path_selector")
        self.settings = settings = declare_parameters(self, read_parameter_file(PARAMETER_FILE))
        self.weights = SelectionWeights(
            settings.weight_cost,
            settings.weight_distance,
            settings.weight_heading,
            settings.weight_clearance,
            settings.weight_change,
        )
        self.health = Health(self, [PART])
        self._goal: tuple[np.ndarray, str] | None = None
        self._motion: MotionState | None = None
        self._odometry_arrival = 0.0
        self._candidates: tuple[int, str, dict[str, np.ndarray]] | None = None
        self._moving = False
        self._last_command = (0.0, 0.0)
        self._map: tuple[np.ndarray, float, np.ndarray] | None = None
        self._cost_to_go: CostToGo | None = None
        self._commands = self.create_publisher(TwistStamped, settings.command_topic, 10)
        newest = QoSProfile(depth=1)
        self._inputs = (
            self.create_subscription(PoseStamped, settings.goal_topic, self._on_goal, newest),
            self.create_subscription(Odometry, settings.odometry_topic, self._on_odometry, newest),
            self.create_subscription(PointCloud2, settings.candidate_topic, self._on_candidates, newest),
            self.create_subscription(OccupancyGrid, settings.occupancy_topic, self._on_occupancy, newest),
        )
        self._command_timer = self.create_timer(1.0 / settings.rate, self._publish_command)
        self.get_logger().info(f"waiting for a goal on {self.resolve_topic_name(settings.goal_topic)}")

    def _on_goal(self, message: PoseStamped) -> None:
        position = np.array([message.pose.position.x, message.pose.position.y])
        if not np.isfinite(position).all():
            self.health.report(PART, ERROR, f"the goal {position.tolist()} is not finite and is ignored", reason="goal")
            return
        self._goal, self._cost_to_go = (position, message.header.frame_id), None
        self.get_logger().info(f"driving to ({position[0]:.2f}, {position[1]:.2f})")

    def _on_odometry(self, message: Odometry) -> None:
        try:
            self._motion, self._odometry_arrival = decoding.decode_odometry(message)[0], time.monotonic()
        except decoding.MessageError as error:
            self.health.report(PART, ERROR, f"odometry: {error}", reason="odometry")

    def _on_candidates(self, message: PointCloud2) -> None:
        try:
            fields = decoding.decode_fields(message)
        except decoding.MessageError as error:
            self.health.report(PART, ERROR, f"candidates: {error}", reason="candidates")
            return
        self._candidates = decoding.stamp_of(message), message.header.frame_id, fields

    def _on_occupancy(self, message: OccupancyGrid) -> None:
        try:
            self._map, self._cost_to_go = decoding.decode_occupancy(message), None
        except decoding.MessageError as error:
            self.health.report(PART, ERROR, str(error), reason="occupancy")

    def _publish_command(self) -> None:
        command = self._command()
        # Without a goal nothing is published; a robot that was moving is commanded to stop first.
        if command is None and not self._moving:
            return
        speed, rate = self._last_command = command or (0.0, 0.0)
        self._moving = command is not None or self._goal is not None
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "base_link"
        message.twist.linear.x, message.twist.angular.z = speed, rate
        self._commands.publish(message)

    def _command(self) -> tuple[float, float] | None:
        """Speed [m/s] and yaw rate [rad/s] to publish; None to stop."""
        if self._goal is None or self._motion is None:
            return None
        goal, goal_frame = self._goal
        distance = float(np.linalg.norm(goal - self._motion.position[:2]))
        if distance < self.settings.goal_tolerance:
            self._goal = None
            self.health.report(PART, OK, f"the goal is reached: {distance:.2f} m away", reason="reached")
            return None
        # Stamps cannot detect this: without odometry there are no new candidates either, so their age stays constant.
        silence = time.monotonic() - self._odometry_arrival
        if silence > self.settings.timeout:
            self._report_stop(f"no odometry for {silence:.1f} s: the position is unknown", "silent")
            return None
        if self._candidates is None:
            self._report_stop("no candidates received: is the predictor running with `candidates`?", "none")
            return None
        stamp, frame, fields = self._candidates
        if goal_frame.lstrip("/") not in ("", frame.lstrip("/")):
            self._report_stop(f"the goal is in frame {goal_frame!r}, candidates are in {frame!r}", "frame")
            return None
        age = (self._motion.stamp - stamp) * NANOSECOND
        if abs(age) > self.settings.timeout:
            self._report_stop(f"candidates are {age:.2f} s old, the limit is {self.settings.timeout:g} s", "late")
            return None
        try:
            if self._cost_to_go is None and self._map is not None:
                self._cost_to_go = cost_to_go(*self._map, goal, radius=self.settings.robot_radius)
            position = self._motion.position[:2]
            best = select_candidate(fields, position, goal, self.weights, self._cost_to_go, self._last_command)
        except ValueError as error:
            self._report_stop(str(error), "fields")
            return None
        if best is None:
            self._report_stop("no candidate is feasible", "infeasible")
            return None
        self.health.report(PART, OK, "driving to the goal", reason="driving", **{DISTANCE: f"{distance:.2f}"})
        return float(fields["speed"][best]), float(fields["yaw_rate"][best])

    def _report_stop(self, cause: str, reason: str) -> None:
        self.health.report(PART, WARN, f"stopped: {cause}", reason=reason)


def main(arguments: list[str] | None = None) -> int:
    """Run the node; ``--help`` lists its parameters, which config/path_selector.yaml defines."""
    command_line = sys.argv[1:] if arguments is None else arguments
    if {"-h", "--help"} & set(command_line):
        print(parameter_help("path_selector", read_parameter_file(PARAMETER_FILE)))
        return 0
    return run_node(PathSelectorNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
