"""path_selector: drives the robot to a goal, or along a plan, with the predictor's candidates."""

from __future__ import annotations

import contextlib
import sys
import time

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from monoforce_ros.core import NANOSECOND, FrameError, MotionState, RobotFrames, TransformHistory, pose_matrix
from monoforce_ros.messages import decoding
from monoforce_ros.nodes.candidate_input import CandidateInput
from monoforce_ros.nodes.clocks import STEADY
from monoforce_ros.nodes.command_output import CommandOutput
from monoforce_ros.nodes.course import TRANSFORM_TIMEOUT, Course, CourseFrames
from monoforce_ros.nodes.flipper_output import FlipperOutput
from monoforce_ros.nodes.frames import TransformListener
from monoforce_ros.nodes.health import ERROR, OK, WARN, Health
from monoforce_ros.nodes.odometry_input import OdometryInput
from monoforce_ros.nodes.odometry_reader import OdometryReader
from monoforce_ros.nodes.parameters import declare_parameters, settings_without_effect
from monoforce_ros.nodes.process import run_schema_node
from monoforce_ros.nodes.progress_check import PATIENCE, WINDOW, MeasuredVelocity, ProgressCheck
from monoforce_ros.nodes.schema import read_schema, schema_path
from monoforce_ros.nodes.stop import Refusal, Stop, Unfollowed
from monoforce_ros.nodes.subscriptions import AdaptiveSubscription
from monoforce_ros.planning import (
    COMMAND_FIELDS,
    CostToGo,
    SelectionWeights,
    cost_to_go,
    plan_target,
    select_candidate,
)

PART = "choice"
DISTANCE = "distance to the goal [m]"
_BASE_FRAME = "base_link"
"""Of REP 105; used unless the parameter names another one."""
HALTS = 5
"""Commands to stand after the last one that moves: a best-effort base may miss some."""
_NEARER = 0.2
"""Smallest approach to the goal that counts as progress [m]."""
_LONGER = 2.0
"""What a plan grows by at once [m] if it was planned anew around something."""
_JUMP = 1.0
"""Distance by which odometry may jump without being another one [m]; and it may move at three times the speed."""
_PAUSE = 0.03
"""Time between the commands to stand at the end of the node [s]."""
_PLANNING_ENDED = 5.0
"""Time without a plan from which on a planner starts anew [s]: planners repeat theirs every second or two."""
_TWICE = 0.2
"""Time within which the same goal from the other subscription arrives [s]."""


class PathSelectorNode(Node):
    """Publishes the best candidate's command; stops the robot if there is no reliable one."""

    def __init__(self) -> None:
        super().__init__("path_selector")
        entries = read_schema(schema_path("path_selector"))
        self.settings = settings = declare_parameters(self, entries)
        for text in settings_without_effect(entries, settings):
            self.get_logger().warning(text)
        self.weights = SelectionWeights(
            settings.weight_cost,
            settings.weight_distance,
            settings.weight_heading,
            settings.weight_clearance,
            settings.weight_change,
        )
        self.frames = RobotFrames(
            settings.base_frame or _BASE_FRAME,
            odometry_child_pose=pose_matrix(settings.odometry_child_pose) if settings.odometry_child_pose else None,
        )
        self.health = Health(self, ["odometry", "candidates", PART])
        history = TransformHistory()
        self.transforms = TransformListener(self, history)
        self._course_frames = CourseFrames(self.transforms, history)
        self._course: Course | None = None
        self._received: Course | None = None
        self._given_up: Course | None = None
        """The last plan to an end that the robot did not follow."""
        self._started = time.monotonic()
        reader = OdometryReader(
            self.frames, self.transforms, self.health, publishers=lambda: self._inputs["odometry"].publisher_names
        )
        self._odometry = OdometryInput(reader, settings.timeout)
        self._candidates = CandidateInput(self.health, settings.timeout)
        self._driving = False
        self._stopped_since = np.inf
        """Since when there has been no reliable command [s]."""
        self._halting = 0
        """Commands to stand that are still to be sent."""
        self._last_command: tuple[float, ...] = (0.0, 0.0)
        # Smallest distance that was left [m] and when [s]; the distance that was left at the last command.
        self._nearest, self._remaining = (np.inf, 0.0), np.inf
        self._progress = ProgressCheck()
        self._map: tuple[np.ndarray, float, np.ndarray] | None = None
        self._map_frame = ""
        self._cost_to_go: CostToGo | None = None
        self._commands = CommandOutput(self, settings.command_topic, settings.command_type)
        self._flippers = FlipperOutput(self, settings.flipper_output_topic, settings.timeout)
        self._inputs = {
            "odometry": self._subscribe(settings.odometry_topic, "nav_msgs/msg/Odometry", Odometry, self._on_odometry),
            "candidates": self._subscribe(
                settings.candidate_cost_topic, "sensor_msgs/msg/PointCloud2", PointCloud2, self._candidates.receive
            ),
            "occupancy": self._subscribe(
                settings.occupancy_topic, "nav_msgs/msg/OccupancyGrid", OccupancyGrid, self._on_occupancy
            ),
        }
        wanted = ("plan", settings.plan_topic) if settings.plan_topic else ("goal", settings.goal_topic)
        kind, callback = (Path, self._on_plan) if settings.plan_topic else (PoseStamped, self._on_goal)
        # Goals are sent once: a subscription that is replaced on discovery might miss one. Of a reliable publisher each
        # arrives twice; the second is ignored.
        self._goal_inputs = [
            self.create_subscription(kind, wanted[1], callback, QoSProfile(depth=1, reliability=reliability))
            for reliability in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)
        ]
        self._command_timer = self.create_timer(1.0 / settings.command_rate, self._publish_command, clock=STEADY)
        self._watch_timer = self.create_timer(0.5, self._watch_inputs, clock=STEADY)
        waiting = f"waiting for a {wanted[0]} on {self.resolve_topic_name(wanted[1])}"
        self.health.report(PART, OK, waiting, reason="waiting")
        self.get_logger().info(waiting)
        if self.transforms.unavailable:
            self.get_logger().warning(f"goals must be in the odometry frame: {self.transforms.unavailable}")

    def _subscribe(self, topic: str, name: str, kind: type, callback) -> AdaptiveSubscription:  # type: ignore[no-untyped-def]
        return AdaptiveSubscription(self, topic, {name: kind}, callback, depth=1)

    def _on_goal(self, message: PoseStamped) -> None:
        place = message.pose.position
        self._set_course("goal", message.header.frame_id, decoding.stamp_of(message), [[place.x, place.y, place.z]])

    def _on_plan(self, message: Path) -> None:
        places = [pose.pose.position for pose in message.poses]
        if not places:
            self._course = self._received = self._given_up = None
            self.health.report(PART, OK, "the plan is empty: standing", reason="empty plan")
            return
        header = message.header if message.header.frame_id else message.poses[0].header
        frames = {pose.header.frame_id for pose in message.poses} - {"", header.frame_id}
        if frames:
            named = f"{header.frame_id!r}, and has poses in {', '.join(map(repr, sorted(frames)))}"
            self.health.report(PART, ERROR, f"the plan is in {named}: it is ignored", reason="goal")
            return
        stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
        self._set_course("plan", header.frame_id, stamp, [[place.x, place.y, place.z] for place in places])

    def _set_course(self, kind: str, frame_id: str, stamp: int, places: list[list[float]]) -> None:
        points = np.array(places)
        if len(bad := np.flatnonzero(~np.isfinite(points).all(axis=1))):
            place = f"({points[bad[0], 0]:g}, {points[bad[0], 1]:g}, {points[bad[0], 2]:g})"
            which = f" at point {bad[0] + 1} of {len(points)}" if len(points) > 1 else ""
            # Whoever sent it meant another goal than the one that the robot drives to.
            self._drop(f"the {kind} is not finite{which} {place}: the robot stands; send it again")
            return
        course, previous = Course(kind, frame_id, stamp, points, time.monotonic()), self._received
        if course.repeats(previous) and previous is not None and course.received - previous.received < _TWICE:
            return
        if self._repeats_given_up(course):
            self._received = self._given_up = course
            return
        self._course, self._received, self._given_up = course, course, None
        # A plan is sent again and again; the same numbers in another frame are another goal.
        same = previous is not None and (previous.frame_id, *previous.points[-1]) == (frame_id, *points[-1])
        if not same:
            end = points[-1]
            self.get_logger().info(f"new {kind}: to ({end[0]:.2f}, {end[1]:.2f}) in frame {frame_id or 'odometry'!r}")
            self._progress.clear()
            self._nearest = np.inf, time.monotonic()
        # At once, as the robot may be moving; what is missing now may be there at the next command.
        with contextlib.suppress(Stop, Refusal):
            self._odometry.usable("")
            self._in_odometry(course)

    def _repeats_given_up(self, course: Course) -> bool:
        """Whether a planner goes on sending a plan that the robot did not follow."""
        former = self._given_up
        if former is None or course.kind != "plan" or course.received - former.received > _PLANNING_ENDED:
            return False
        apart = float(np.linalg.norm(course.points[-1] - former.points[-1]))
        return course.frame_id == former.frame_id and apart <= self.settings.goal_tolerance

    def _on_odometry(self, message: Odometry) -> None:
        before = self._odometry.motion
        motion = self._odometry.motion if self._odometry.receive(message) else None
        if motion is None:
            return
        self._drop_course_after_jump(before, motion)
        self._course_frames.add_odometry(self._odometry.frame, motion, self._odometry.on_robot)
        if self._driving:
            self._progress.add(motion.stamp * NANOSECOND, self._last_command, motion.position[:2], motion.heading)

    def _drop_course_after_jump(self, before: MotionState | None, now: MotionState) -> None:
        """Forget the goal if the odometry goes on elsewhere: the place of a goal in its frame is unknown then."""
        if before is None or self._course is None:
            return
        seconds = abs(now.stamp - before.stamp) * NANOSECOND
        measured = (float(np.linalg.norm(motion.linear_velocity)) for motion in (before, now))
        speed = max(*measured, float(np.hypot(self._last_command[0], sum(self._last_command[2:]))))
        # Where a robot comes to rest after its odometry has become silent is no jump, however long that was.
        moved = float(np.linalg.norm(now.position - before.position))
        if moved <= _JUMP + 3.0 * speed * min(seconds, self.settings.timeout):
            return
        self._drop(
            f"the {self._course.kind} is dropped and the robot stopped: odometry jumped by {moved:.1f} m within "
            f"{seconds:.1f} s: has it begun anew? Send it again"
        )

    def _drop(self, message: str) -> None:
        self._course = None
        self.health.report(PART, ERROR, message, reason="refused")

    def _on_occupancy(self, message: OccupancyGrid) -> None:
        try:
            self._map, self._cost_to_go = decoding.decode_occupancy(message), None
        except decoding.MessageError as error:
            self.health.report("occupancy", ERROR, str(error), reason="unusable")
            return
        self._map_frame = message.header.frame_id
        self.health.report("occupancy", OK, "receiving occupancy")

    def _watch_inputs(self) -> None:
        now = time.monotonic()
        for part, arrival in (("odometry", self._odometry.arrival), ("candidates", self._candidates.arrival)):
            silence = now - (self._started if arrival is None else arrival)
            if silence > self.settings.data_timeout:
                cause = self._inputs[part].silence_cause
                message = f"no messages for {silence:.1f} s ({cause})"
                self.health.report(part, WARN, message, reason=f"silent, {cause}")

    def _publish_command(self) -> None:
        command = self._command()
        self._driving = command is not None
        if command is None:
            self._progress.clear()
        # Without a goal nothing is published; a robot that was moving is commanded to stop first.
        if command is not None or self._course is not None:
            self._halting = HALTS
        elif self._halting:
            self._halting -= 1
        else:
            return
        self._last_command = command or (0.0, 0.0)
        self._commands.publish(self._last_command, self._odometry.base_name or self.settings.base_frame or _BASE_FRAME)
        if command is not None:
            self._flippers.forward()

    def stand(self) -> None:
        """Command a robot that was moving to stop: the node ends."""
        self._course = None
        # A best-effort base acknowledges nothing, and what this process still holds when it ends is lost.
        while self._halting:
            self._publish_command()
            self._commands.flush(0.5)
            time.sleep(_PAUSE)

    def _command(self) -> tuple[float, ...] | None:
        """Speed [m/s], yaw rate [rad/s] and, of robots that move sideways, lateral speed [m/s]; None to stop."""
        if self._course is None:
            return None
        try:
            command = self._drive(self._course)
            self._stopped_since = np.inf
            return command
        except Stop as stop:
            limit, now = self.settings.progress_timeout, time.monotonic()
            self._stopped_since = min(self._stopped_since, now)
            if limit and now - max(self._stopped_since, self._course.received) > limit:
                # A robot must not drive on by itself once what stopped it is gone and people are around it.
                kind = self._course.kind
                self._drop(f"the {kind} is dropped: stopped for {limit:g} s ({stop}); send it again (progress_timeout)")
                return None
            self.health.report(PART, WARN, f"stopped: {stop}", reason=stop.reason)
            return None
        except Refusal as refusal:
            message = str(refusal)
            if isinstance(refusal, Unfollowed) and self._course.kind == "plan":
                self._given_up = self._received
                message += "; the same plan is ignored until the planner pauses or plans to another end"
            self._drop(message)
            return None

    def _drive(self, course: Course) -> tuple[float, ...] | None:
        """The best candidate's command; None if the goal is reached.

        Raises:
            Stop: there is no reliable command.
            Refusal: the course has no place in the odometry frame.
        """
        motion = self._odometry.usable(self._inputs["odometry"].silence_cause)
        plan = self._in_odometry(course)[:, :2]
        position = motion.position[:2]
        target, remaining = plan_target(plan, position, self.settings.plan_lookahead)
        distance = float(np.linalg.norm(plan[-1] - position))
        # A plan that comes back to its start is not finished there.
        if distance < self.settings.goal_tolerance and remaining < self.settings.plan_lookahead:
            self._course = None
            self.health.report(PART, OK, f"the goal is reached: {distance:.2f} m away", reason="reached")
            return None
        cause = self._inputs["candidates"].silence_cause
        candidates = self._candidates.usable(motion, self._odometry.frame, cause)
        if deaf := self._commands.deaf:
            raise Stop(f"{deaf}: is the base running, and is `command_topic` right?", "deaf")
        try:
            best = select_candidate(
                candidates, position, target, self.weights, self._cost_to(target), self._last_command
            )
        except ValueError as error:
            raise Stop(str(error), "fields") from error
        if best is None:
            raise Stop("no candidate is feasible", "infeasible")
        command = tuple(float(candidates[name][best]) for name in COMMAND_FIELDS if name in candidates)
        self._check_progress(course, remaining if len(plan) > 1 else distance)
        self._report_driving(course, distance, command)
        return command

    def _in_odometry(self, course: Course) -> np.ndarray:
        """Points of the course ``[n, 3]`` in the odometry frame.

        Raises:
            Stop: the transform is missing so far.
            Refusal: it has been missing for too long.
        """
        now = time.monotonic()
        try:
            self._course, points = self._course_frames.resolved(course, now)
        except FrameError as error:
            # Without odometry the frame that the transform leads to is unknown.
            if now - max(course.received, self._odometry.first_arrival) < TRANSFORM_TIMEOUT:
                raise Stop(f"waiting for a transform: {error}", "frame") from error
            wait = f"not transformed within {TRANSFORM_TIMEOUT:g} s"
            raise Refusal(f"the {course.kind} is refused, {wait}: {error}; send it again") from error
        if self._course is not course:
            end, frame = points[-1], self._odometry.frame
            place = f"({end[0]:.2f}, {end[1]:.2f}) in {frame!r}"
            self.get_logger().info(
                f"{course.frame_id!r} moves with the robot: the {course.kind} is kept at {place}",
                throttle_duration_sec=1.0,
            )
        return points

    def _cost_to(self, target: np.ndarray) -> CostToGo | None:
        """Path lengths around obstacles to a target; None without a map in the odometry frame."""
        if self._map is None:
            return None
        if self._map_frame.lstrip("/") != self._odometry.frame.lstrip("/"):
            message = f"not used: it is in frame {self._map_frame!r}, odometry in {self._odometry.frame!r}"
            self.health.report("occupancy", WARN, message, reason="frame")
            return None
        found = self._cost_to_go
        # Within a cell of the search the path is the same.
        if found is None or float(np.linalg.norm(found.goal - target)) > found.resolution:
            found = cost_to_go(*self._map, target, radius=self.settings.robot_radius)
            self._cost_to_go = found
        return found

    def _check_progress(self, course: Course, remaining: float) -> None:
        """Raise ``Unfollowed`` for a robot that does not follow its commands, or comes no nearer to the goal.

        Args:
            course: what is driven to.
            remaining: distance to the goal, or length of the plan that is left [m].
        """
        dropped = f"the {course.kind} is dropped and the robot stopped"
        if opposed := self._progress.opposed:
            sent = f"{self._sent(self._last_command)}, odometry shows the opposite {opposed}"
            advice = "does somebody else drive it, or has the base or the odometry a wrong sign?"
            raise Unfollowed(f"{dropped}: it moves against its commands ({sent}): {advice}")
        if (seconds := self._progress.unfollowed) > PATIENCE:
            velocity = self._progress.velocity
            shown = "no motion" if velocity is None else _shown(velocity)
            sent = f"{self._sent(self._last_command)}, odometry shows {shown}"
            advice = "free it, or repair what commands or odometry pass through, then send it again"
            raise Unfollowed(f"{dropped}: it has not followed its commands for {seconds:.0f} s ({sent}): {advice}")
        now = time.monotonic()
        nearest, since = self._nearest
        # A plan around an obstacle that was not known before is longer at once.
        if remaining < nearest - _NEARER or remaining > self._remaining + _LONGER or not self._driving:
            self._nearest = nearest, since = remaining, now
        self._remaining = remaining
        if (limit := self.settings.progress_timeout) and now - since > limit:
            raise Unfollowed(
                f"{dropped}: it has come no nearer to its goal for {limit:g} s, {remaining:.1f} m are left: is it "
                "within reach? (progress_timeout)"
            )

    def _sent(self, command: tuple[float, ...]) -> str:
        sideways = f", {command[2]:.2f} m/s to the left" if sum(command[2:]) else ""
        return f"{command[0]:.2f} m/s{sideways} and {command[1]:.2f} rad/s are sent to {self._commands.topic}"

    def _silent_transform(self, course: Course) -> str:
        """Which transform from the course's frame is not sent any more, as when localisation has ended; or empty."""
        name, silence = self.transforms.silence(course.frame_id, self._odometry.frame) if course.frame_id else ("", 0.0)
        if silence <= self.settings.data_timeout:
            return ""
        return f"{name} has not been sent for {silence:.1f} s (is localisation running?)"

    def _report_driving(self, course: Course, distance: float, command: tuple[float, ...]) -> None:
        """Say that the robot drives only if its odometry shows it."""
        moving, values = self._progress.moving, {DISTANCE: f"{distance:.2f}"}
        if others := self._commands.rivals:
            self.get_logger().warning(
                f"{self._commands.topic} is also published by {others}: a base that hears two drivers follows neither",
                throttle_duration_sec=60.0,
            )
        values["other publishers of commands"] = others or "none"
        values["not reached by commands"] = self._commands.unreached or "none"
        # Every base takes a while to follow a new command.
        late = not moving and self._progress.unfollowed > WINDOW
        velocity = self._progress.velocity if late else None
        if velocity is not None:
            message = f"the robot moves, but not as commanded: {self._sent(command)}, odometry shows {_shown(velocity)}"
            self.health.report(PART, WARN, message, reason="astray", **values)
        elif moving and (silent := self._silent_transform(course)):
            self.health.report(PART, WARN, f"driving on an old transform: {silent}", reason="old transform", **values)
        elif moving:
            self.health.report(PART, OK, "driving to the goal", reason="driving", **values)
        elif moving is None:
            message = f"commands are sent to {self._commands.listeners}, odometry shows no motion yet"
            self.health.report(PART, OK, message, reason="starting", **values)
        else:
            heard = f"{self._commands.type}, heard by {self._commands.listeners}"
            message = (
                f"the robot does not move: {self._sent(command)} ({heard}), odometry has shown no motion for "
                f"{WINDOW:g} s"
            )
            self.health.report(PART, WARN, message, reason="no motion", **values)


def _shown(velocity: MeasuredVelocity) -> str:
    sideways = f", {abs(velocity.left):.2f} m/s to the {'left' if velocity.left > 0 else 'right'}"
    return (
        f"{velocity.forward:.2f} m/s forward{sideways if abs(velocity.left) >= 0.05 else ''} and "
        f"{velocity.yaw_rate:.2f} rad/s"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the node; ``--help`` lists its parameters, which config/path_selector.schema.yaml defines."""
    return run_schema_node("path_selector", PathSelectorNode, arguments, at_the_end=PathSelectorNode.stand)


if __name__ == "__main__":
    sys.exit(main())
