"""What path_selector says and does for each of its inputs: missing, of another type, quality of service or frame."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, PointCloud2

from monoforce_ros.bags import builders, type_store
from monoforce_ros.core import pose_matrix
from monoforce_ros.messages import encoding, message_class
from monoforce_ros.nodes.progress_check import ProgressCheck
from monoforce_ros.planning import WAYPOINTS, plan_target

# Every test waits for a state, for as long as it takes, and the robot's world goes at the pace of the test.
pytestmark = pytest.mark.unhurried_nodes

BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
OK, WARN = 0, 1


class Robot:
    """The surroundings of a selector: odometry, candidates that turn left, go straight and turn right, and a base."""

    def __init__(self, peer, prefix: str):
        self.peer, self.prefix = peer, prefix
        node = peer.node
        self.odometry = node.create_publisher(Odometry, f"/{prefix}/odom", BEST_EFFORT)
        self.candidates = node.create_publisher(PointCloud2, f"/{prefix}/predicted/candidate_costs", 1)
        self.goals = node.create_publisher(PoseStamped, f"/{prefix}/goal_pose", 1)
        self.transforms: dict = {}
        self.place, self.heading, self.speed = np.zeros(2), 0.0, 0.0
        self.child, self.frame, self.odometry_frame = "base_link", "odom", "odom"
        self.origin = np.zeros(2)
        self.commands: list = []
        self.base = None
        self.obeys = False
        self.drift = np.zeros(2)
        """Velocity that no command causes [m/s]."""
        self.signs = np.ones(2)
        """Factors of forward speed and yaw rate with which the robot obeys."""
        self.travelled = 0.0
        self.late, self.start = 0.0, None
        """Age of the candidates as they arrive, and what they tell of their start [s]; None: nothing."""

    def listen(self, kind: type, quality: QoSProfile = BEST_EFFORT) -> None:
        """Become a base that listens to one type of command."""
        node = self.peer.node
        if self.base is not None:
            node.destroy_subscription(self.base)
        self.commands.clear()
        self.base = node.create_subscription(kind, f"/{self.prefix}/cmd_vel", self.commands.append, quality)

    def send_goal(self, x: float, y: float, frame: str = "odom", stamp: int = 0) -> None:
        assert self.peer.until(lambda: self.goals.get_subscription_count() > 1, 10.0)
        goal = PoseStamped()
        goal.header.frame_id = frame
        goal.header.stamp.sec, goal.header.stamp.nanosec = divmod(stamp, 10**9)
        goal.pose.position.x, goal.pose.position.y = x, y
        self.goals.publish(goal)

    def live(self, seconds: float, *, odometry: bool = True, candidates: bool = True, until=None) -> bool:
        """Publish odometry at 20 Hz and candidates at 5 Hz, until a condition holds or time is over."""
        end, step = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            self.peer.now += 50_000_000
            if self.obeys and self.commands:
                twist = getattr(self.commands[-1], "twist", self.commands[-1])
                self.speed = self.signs[0] * twist.linear.x
                self.heading += 0.05 * self.signs[1] * twist.angular.z
            self.travelled += 0.05 * self.speed
            self.place = self.place + 0.05 * self.speed * np.array([np.cos(self.heading), np.sin(self.heading)])
            self.place = self.place + 0.05 * self.drift
            stamp = self.peer.now
            if odometry:
                turn = [0, 0, np.sin(self.heading / 2), np.cos(self.heading / 2)]
                message = builders.odometry(
                    stamp, self.odometry_frame, self.child, [*(self.place + self.origin), 0], turn, [0] * 3, [0] * 3
                )
                self.odometry.publish(bytes(type_store().serialize_cdr(message, message.__msgtype__)))
            if candidates and step % 4 == 0:
                self.candidates.publish(self._fan(stamp - round(1e9 * self.late)))
            step += 1
            self.peer.spin(0.05)
            if until is not None and until():
                return True
        return until is None

    def _fan(self, stamp: int) -> bytes:
        angles = self.heading + np.array([0.8, 0.0, -0.8])
        fields = {"x": self.place[0] + 2 * np.cos(angles), "y": self.place[1] + 2 * np.sin(angles), "z": np.zeros(3)}
        fields |= {"heading": angles, "speed": np.full(3, 0.5), "yaw_rate": np.array([0.4, 0.0, -0.4])}
        fields |= {"cost": np.zeros(3), "feasible": np.ones(3)}
        fields |= {} if self.start is None else {"start": np.full(3, self.start)}
        for share in WAYPOINTS:
            along = share / 100
            fields |= {f"x_{share}": self.place[0] + along * (fields["x"] - self.place[0])}
            fields |= {f"y_{share}": self.place[1] + along * (fields["y"] - self.place[1])}
        return encoding.point_cloud(stamp, self.frame, fields)

    def send_transform(self, parent: str, child: str, pose: list[float], *, static: bool = False) -> None:
        """Publish a transform; the pose is x, y, z [m], roll, pitch, yaw [rad]."""
        kind = message_class("tf2_msgs/msg/TFMessage")
        if kind is None:
            pytest.skip("tf2_msgs is not installed (make interfaces builds it)")
        topic = f"/{self.prefix}/{'tf_static' if static else 'tf'}"
        if topic not in self.transforms:
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.transforms[topic] = self.peer.node.create_publisher(kind, topic, latched if static else 100)
            assert self.peer.until(lambda: self.transforms[topic].get_subscription_count() > 0, 10.0)
        message = builders.transforms(self.peer.now, parent, {child: pose_matrix(pose)})
        self.transforms[topic].publish(bytes(type_store().serialize_cdr(message, message.__msgtype__)))

    def status(self, part: str = "choice") -> tuple[int, str]:
        for array in reversed(self.peer.received["/diagnostics"]):
            for entry in array.status:
                if entry.name == f"{self.prefix}/path_selector: {part}":
                    return int.from_bytes(entry.level, "little"), entry.message
        return -1, ""

    def says(self, text: str, part: str = "choice"):
        return lambda: text in self.status(part)[1]

    @property
    def driven(self) -> bool:
        twist = getattr(self.commands[-1], "twist", self.commands[-1]) if self.commands else Twist()
        return twist.linear.x > 0.0


@pytest.fixture
def robot(peer, start, request):
    """A robot in a namespace of its own, with a selector that may have one parameter."""
    prefix = f"robot{abs(hash(request.node.name)) % 10**6}"
    arguments = ["-p", request.param] if hasattr(request, "param") else []
    transforms = "-r", "/tf:=tf", "-r", "/tf_static:=tf_static"
    process = start("path_selector", "--ros-args", "-r", f"__ns:=/{prefix}", *transforms, *arguments)
    process.wait_for("waiting for a")
    robot = Robot(peer, prefix)
    robot.process = process
    yield robot
    assert process.stop() == 0
    assert "Traceback" not in process.output


@pytest.mark.parametrize("robot", ["flipper_output_topic:=flipper_commands", "command_rate:=10.0"], indirect=True)
def test_flipper_angles_are_passed_on_only_where_a_topic_is_named_and_while_driving(robot, request):
    node, prefix = robot.peer.node, robot.prefix
    heard: list = []
    node.create_subscription(JointState, f"/{prefix}/flipper_commands", heard.append, 1)
    # From a node of its own: one that publishes two predictions is a predictor, which is no base.
    climber = rclpy.create_node("climber", context=node.context)
    angles = climber.create_publisher(JointState, f"/{prefix}/predicted/flipper_angles", 1)
    message = JointState(name=["front_left", "front_right"], position=[0.4, 0.4])
    robot.listen(TwistStamped)

    def drives() -> bool:
        angles.publish(message)
        return robot.driven and bool(heard)

    robot.live(2.0, until=lambda: drives() and False)
    assert not heard, "no goal yet"
    robot.send_goal(50.0, 0.0)
    if "flipper" in request.node.callspec.id:
        assert robot.live(10.0, until=drives), robot.status()
        assert list(heard[-1].position) == [0.4, 0.4] and list(heard[-1].name) == message.name
        # Angles that are not finite, or old, are not.
        message.position = [float("nan"), 0.4]
        robot.live(1.0, until=lambda: drives() and False)
        heard.clear()
        robot.live(1.0)
        assert robot.driven and not heard
    else:
        assert robot.live(10.0, until=lambda: drives() or robot.driven)
        robot.live(1.0, until=lambda: drives() and False)
        assert not heard
    climber.destroy_node()


def test_without_odometry_it_says_so_and_claims_nothing(robot):
    robot.listen(TwistStamped)
    robot.send_goal(5.0, 0.0)
    assert robot.live(10.0, odometry=False, until=robot.says("stopped: no odometry: the position is unknown"))
    assert robot.live(5.0, odometry=False, until=lambda: robot.status("odometry")[0] == WARN)
    assert "no messages for" in robot.status("odometry")[1]
    assert not robot.driven and "driving" not in robot.process.output


def test_best_effort_odometry_is_received_and_a_moving_robot_drives(robot):
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    robot.speed = 0.5
    assert robot.live(10.0, until=robot.says("driving to the goal")), robot.status()
    assert robot.status()[0] == OK


def test_candidates_of_a_slow_predictor_are_driven_if_they_start_as_late_as_they_arrive(robot):
    """They stop it otherwise, and what claims to start in an hour is late all the same."""
    robot.listen(Twist)
    robot.obeys = True
    robot.live(1.0)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven)
    robot.late = 0.62
    assert robot.live(10.0, until=robot.says("the limit is 0.6 s")), robot.status()
    robot.start = 0.6
    assert robot.live(10.0, until=robot.says("driving to the goal")), robot.status()
    robot.live(1.0)
    assert robot.driven
    robot.late, robot.start = 2.5, 3600.0
    assert robot.live(10.0, until=robot.says("the limit is 2.3 s")), robot.status()


@pytest.mark.parametrize("robot", ["use_sim_time:=true"], indirect=True)
def test_simulated_time_that_stands_still_stops_nothing(robot):
    """A /clock that nobody publishes any more: commands, and above all the command to stop, still reach the base."""
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    assert robot.live(5.0, until=robot.says("there are no messages on /clock", "clock"))
    assert robot.live(10.0, odometry=False, until=lambda: not robot.driven), robot.status()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_robot_that_drives_is_stopped_when_the_selector_ends(robot, how):
    robot.listen(Twist)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    assert robot.process.stop(how) == 0
    assert robot.peer.until(lambda: not robot.driven, 10.0)


LISTENER = """
import rclpy
from geometry_msgs.msg import Twist
rclpy.init()
node = rclpy.create_node("{name}")
node.create_subscription(Twist, "{topic}", lambda message: None, 1)
rclpy.spin(node)
"""


def test_a_base_is_stopped_before_another_type_is_published(robot, ros_environment):
    """A dashboard that listens to the other type takes the commands from a base, which may keep its last one."""
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    code = LISTENER.format(name="dashboard", topic=f"/{robot.prefix}/cmd_vel")
    listener = subprocess.Popen([sys.executable, "-c", code], env=ros_environment)
    try:
        assert robot.live(20.0, until=lambda: "no longer hears the commands" in robot.process.output)
        assert robot.peer.until(lambda: not robot.driven, 10.0), "the base keeps the last command"
        # One message may be lost on its way to a base that listens with best effort.
        assert all(command.twist.linear.x == 0.0 for command in robot.commands[-2:])
    finally:
        listener.kill()
        listener.wait()


def test_odometry_with_stamps_of_zero_is_refused(robot):
    robot.listen(TwistStamped)
    robot.send_goal(5.0, 0.0)
    robot.peer.now, now = -50_000_000, robot.peer.now
    for _ in range(60):
        robot.peer.now = -50_000_000
        robot.live(0.05)
        if robot.says("stopped: the stamps are zero")():
            break
    robot.peer.now = now
    assert robot.says("stopped: the stamps are zero")() and not robot.driven, robot.status()


def test_odometry_without_a_frame_is_in_odom_as_the_predictor_takes_it(robot):
    robot.odometry_frame = ""
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()


def test_a_robot_that_stands_is_not_said_to_drive(robot):
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    assert robot.live(15.0, until=robot.says("the robot does not move: 0.50 m/s")), robot.status()
    assert "heard by /peer" in robot.status()[1]
    assert robot.status()[0] == WARN and "driving" not in robot.process.output


@pytest.mark.parametrize("kind", [Twist, TwistStamped])
def test_commands_have_the_type_that_the_base_listens_to(robot, kind):
    robot.listen(kind)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    names = [info.topic_type for info in robot.peer.node.get_publishers_info_by_topic(f"/{robot.prefix}/cmd_vel")]
    assert names == [f"geometry_msgs/msg/{kind.__name__}"]
    # The base is exchanged for one of the other type.
    other = Twist if kind is TwistStamped else TwistStamped
    robot.listen(other)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    assert isinstance(robot.commands[-1], other)


def test_a_predictor_beside_the_base_hears_the_base_s_type(robot, start):
    """The predictor listens to commands, too: it must not make the selector publish a type that the base ignores."""
    predictor = start("predictor", "--ros-args", "-r", f"__ns:=/{robot.prefix}", "-p", "terrain_source:=flat")
    predictor.wait_for("with terrain from flat", 120.0)
    robot.listen(Twist)
    robot.send_goal(50.0, 0.0)
    topic, node = f"/{robot.prefix}/cmd_vel", robot.peer.node

    def settled() -> bool:
        sent = [info.topic_type for info in node.get_publishers_info_by_topic(topic)]
        heard = {info.topic_type for info in node.get_subscriptions_info_by_topic(topic)}
        return robot.driven and sent == ["geometry_msgs/msg/Twist"] and heard == {"geometry_msgs/msg/Twist"}

    assert robot.live(20.0, until=settled), robot.status()

    def heard() -> bool:
        statuses = [entry for array in robot.peer.received["/diagnostics"] for entry in array.status]
        return any(s.name.endswith("predictor: commands") and s.message == "receiving commands" for s in statuses)

    assert robot.live(10.0, until=heard)
    assert predictor.stop() == 0


def test_a_predictor_is_no_base(robot, start):
    """Whatever its name: it listens to commands, but moves nothing."""
    names = ("-r", f"__ns:=/{robot.prefix}", "-r", "__node:=foresight")
    predictor = start("predictor", "--ros-args", *names, "-p", "terrain_source:=flat")
    predictor.wait_for("with terrain from flat", 120.0)
    robot.send_goal(50.0, 0.0)
    space = f"/{robot.prefix}"
    alone = f"nothing listens to {space}/cmd_vel but {space}/foresight, which cannot move the robot"
    assert robot.live(10.0, until=robot.says(alone)), robot.status()
    assert "driving" not in robot.process.output and not robot.driven
    robot.listen(Twist)
    assert robot.live(10.0, until=robot.says("commands are sent to /peer, odometry shows no motion")), robot.status()
    assert robot.live(5.0, until=lambda: robot.driven) and predictor.stop() == 0


def test_commands_that_nobody_hears_are_no_drive(robot):
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=robot.says(f"stopped: nothing listens to /{robot.prefix}/cmd_vel")), robot.status()
    assert "driving" not in robot.process.output


def test_a_base_that_the_commands_do_not_reach_is_no_listener(robot):
    """A latched subscription gets nothing from a publisher of commands, which are never latched."""
    robot.listen(TwistStamped, QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=robot.says("asks for a quality of service that is not offered (/peer: ")), (
        robot.status()
    )
    assert "driving" not in robot.process.output and "odometry shows no motion" not in robot.process.output
    robot.listen(TwistStamped)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()


def test_other_drivers_on_the_same_topic_are_named(robot):
    robot.listen(TwistStamped)
    joystick = rclpy.create_node("joystick", namespace=f"/{robot.prefix}", context=robot.peer.node.context)
    joystick.create_publisher(TwistStamped, "cmd_vel", 1)
    robot.send_goal(50.0, 0.0)
    named = f"/{robot.prefix}/cmd_vel is also published by /{robot.prefix}/joystick"
    assert robot.live(10.0, until=lambda: named in robot.process.output), robot.process.output
    joystick.destroy_node()


def test_a_robot_that_moves_against_its_commands_is_stopped_and_its_goal_dropped(robot):
    """With a wrong sign the robot would run away from its goal, ever faster."""
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    robot.speed = -0.5
    assert robot.live(10.0, until=robot.says("the goal is dropped and the robot stopped: it moves against")), (
        robot.status()
    )
    robot.live(1.5)
    robot.commands.clear()
    robot.live(1.0)
    assert not robot.commands, "it is commanded although its goal was dropped"


def test_a_robot_that_turns_the_wrong_way_is_stopped_and_its_goal_dropped(robot):
    robot.listen(TwistStamped)
    robot.obeys, robot.signs = True, np.array([1.0, -1.0])
    robot.send_goal(-2.0, 5.0)
    assert robot.live(20.0, until=robot.says("the goal is dropped and the robot stopped: ")), robot.status()
    robot.live(1.5)
    assert not robot.driven and robot.travelled < 8.0, (robot.travelled, robot.status())


@pytest.mark.parametrize("frozen", [True, False])
def test_a_robot_that_does_not_follow_its_commands_is_stopped_in_the_end(robot, frozen):
    """Stuck, or with odometry whose positions stand while its stamps go on; or a heading that is off by a quarter."""
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    if not frozen:
        robot.obeys, robot.signs = True, np.array([0.0, 0.0])
        robot.drift = np.array([0.0, 0.5])
        sideways = "the robot moves, but not as commanded: 0.50 m/s and 0.00 rad/s are sent to"
        assert robot.live(10.0, until=robot.says(sideways)), robot.status()
        assert "0.00 m/s forward, 0.50 m/s to the left" in robot.status()[1], robot.status()
    assert robot.live(15.0, until=robot.says("it has not followed its commands for")), robot.status()
    robot.live(1.5)
    robot.commands.clear()
    robot.live(1.0)
    assert not robot.commands, "once it is free, it must not drive on by itself"


@pytest.mark.parametrize("robot", ["progress_timeout:=3.0"], indirect=True)
def test_a_goal_that_comes_no_nearer_is_dropped(robot):
    """Behind a wall that no candidate avoids, the robot drives to and fro for ever."""
    robot.listen(TwistStamped)
    robot.obeys = True
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.place[0] > 0.5), robot.status()
    robot.signs = np.array([0.15, 1.0])
    robot.live(2.0)
    assert "dropped" not in robot.process.output
    robot.signs = np.array([0.12, 1.0])
    robot.drift = np.array([-0.06, 0.0])
    assert robot.live(15.0, until=robot.says("it has come no nearer to its goal for 3 s, 4")), robot.status()


@pytest.mark.parametrize("robot", ["progress_timeout:=3.0"], indirect=True)
def test_a_goal_does_not_outlive_a_long_stop(robot):
    """Candidates that come back must not move a robot that people have stopped watching."""
    robot.listen(TwistStamped)
    robot.obeys = True
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.place[0] > 0.5), robot.status()
    robot.live(6.0, candidates=False)
    robot.commands.clear()
    robot.live(2.0)
    assert not robot.driven, robot.status()
    assert "the goal is dropped: stopped for 3 s (candidates are" in robot.process.output
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()


def test_odometry_that_begins_anew_drops_the_goal(robot):
    """Where the goal is in the new frame is unknown: a robot that restarts must not drive on by itself."""
    robot.listen(TwistStamped)
    robot.obeys = True
    robot.send_goal(9.0, 0.0)
    assert robot.live(20.0, until=lambda: robot.place[0] > 3.5), robot.status()
    robot.live(2.0, odometry=False)
    assert not robot.driven
    robot.place = np.zeros(2)
    assert robot.live(5.0, until=robot.says("the goal is dropped and the robot stopped: odometry jumped by")), (
        robot.status()
    )
    robot.live(1.0)
    robot.commands.clear()
    robot.live(1.0)
    assert not robot.commands


@pytest.mark.parametrize("name", ["_ros2cli_1234", "dashboard"])
def test_only_nodes_that_expect_the_published_type_count_as_listeners(robot, ros_environment, name):
    """A base that expects TwistStamped, beside another listener that expects Twist from the start."""
    code = LISTENER.format(name=name, topic=f"/{robot.prefix}/cmd_vel")
    listener = subprocess.Popen([sys.executable, "-c", code], env=ros_environment)
    try:
        count = robot.peer.node.count_subscribers
        assert robot.peer.until(lambda: count(f"/{robot.prefix}/cmd_vel") > 0, 20.0)
        robot.listen(TwistStamped)
        robot.obeys = True
        robot.send_goal(50.0, 0.0)
        if name == "dashboard":
            # Twist has precedence; it must not be said that the base hears it.
            warned = "is heard by /dashboard, but not by /peer: expects geometry_msgs/msg/TwistStamped"
            assert robot.live(20.0, until=lambda: warned in robot.process.output), robot.process.output
            assert robot.live(10.0, until=robot.says("the robot does not move")), robot.status()
            assert "heard by /dashboard)" in robot.status()[1]
        else:
            assert robot.live(20.0, until=robot.says("driving to the goal")), robot.status()
    finally:
        listener.kill()
        listener.wait()


def test_several_commands_to_stand_follow_the_last_one_that_moves(robot):
    """A base with a best-effort subscription may miss one, and hold its last command."""
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    robot.commands.clear()
    robot.send_goal(*robot.place)
    assert robot.live(10.0, until=robot.says("the goal is reached")), robot.status()
    robot.live(1.5)
    still = [command for command in robot.commands if command.twist.linear.x == 0.0]
    assert len(still) >= 4 and robot.commands[-1].twist.linear.x == 0.0
    robot.commands.clear()
    robot.live(1.0)
    assert not robot.commands


def test_far_from_the_origin_of_odometry_candidates_are_too_coarse(robot):
    """In UTM coordinates the 32-bit numbers of a cloud are half a metre apart."""
    robot.origin = np.array([443_000.0, 5_540_000.0])
    robot.listen(TwistStamped)
    robot.send_goal(443_050.0, 5_540_000.0)
    assert robot.live(10.0, until=robot.says("odometry is 5540 km from the origin of 'odom'")), robot.status()
    assert not robot.driven


def test_a_transform_that_is_not_sent_any_more_is_named(robot):
    robot.listen(TwistStamped)
    robot.obeys = True
    robot.send_goal(50.0, 0.0, frame="map_9")
    robot.send_transform("map_9", "odom", [0.0] * 6)
    assert robot.live(10.0, until=robot.says("driving to the goal")), robot.status()
    silent = "driving on an old transform: map_9 → odom has not been sent for"
    assert robot.live(10.0, until=robot.says(silent)), robot.status()
    assert robot.status()[0] == WARN
    robot.send_transform("map_9", "odom", [0.0] * 6)
    assert robot.live(5.0, until=robot.says("driving to the goal")), robot.status()


@pytest.mark.parametrize("robot", ["plan_topic:=plan"], indirect=True)
def test_the_point_of_a_plan_that_is_not_finite_is_named(robot):
    plans = robot.peer.node.create_publisher(Path, f"/{robot.prefix}/plan", 1)
    assert robot.peer.until(lambda: plans.get_subscription_count() > 0, 10.0)
    plan = Path()
    plan.header.frame_id = "odom"
    plan.poses = [PoseStamped() for _ in range(5)]
    plan.poses[2].pose.position.y = float("nan")
    plans.publish(plan)
    assert robot.live(5.0, until=robot.says("the plan is not finite at point 3 of 5 (0, nan, 0)")), robot.status()


@pytest.mark.parametrize("robot", ["command_type:=twist"], indirect=True)
def test_a_fixed_type_that_the_base_does_not_expect_is_named(robot):
    robot.listen(TwistStamped)
    robot.send_goal(50.0, 0.0)
    expected = "its listeners expect geometry_msgs/msg/TwistStamped"
    assert robot.live(10.0, until=robot.says(expected)), robot.status()


def test_the_frame_of_a_goal_comes_before_its_distance(robot):
    robot.listen(TwistStamped)
    robot.place = np.array([3.0, 4.0])
    # In its own frame the goal is where the robot stands; what that means in the odometry frame is unknown.
    robot.send_goal(3.0, 4.0, frame="map")
    assert robot.live(10.0, until=robot.says("the goal is in frame 'map', odometry in 'odom'")), robot.status()
    assert not robot.driven and "reached" not in robot.process.output
    # The same numbers in another frame are another goal.
    robot.send_goal(3.0, 4.0, frame="odom")
    assert robot.live(10.0, until=lambda: "new goal: to (3.00, 4.00) in frame 'odom'" in robot.process.output)


def test_goals_in_the_map_are_transformed_by_tf(robot):
    # The map is turned by a quarter: what lies ahead of the robot there is to its right in the odometry frame.
    robot.send_transform("map_2", "odom", [1.0, 2.0, 0.0, 0.0, 0.0, np.pi / 2], static=True)
    robot.listen(Twist)
    robot.send_goal(10.0, 2.0, frame="map_2")
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    assert robot.commands[-1].angular.z < 0.0
    # It is reached where the map says: (1, 7) in the map is 5 m ahead in the odometry frame.
    robot.place = np.array([5.0, 0.1])
    robot.live(0.5)
    robot.send_goal(1.0, 7.0, frame="map_2")
    assert robot.live(10.0, until=robot.says("the goal is reached: 0.10 m away")), robot.status()


@pytest.mark.parametrize(("frame", "goal"), [("base_link", (2.0, 0.0)), ("lidar_7", (-0.5, -2.0))])
def test_a_goal_that_moves_with_the_robot_is_reached_and_the_robot_stops_there(robot, frame, goal):
    robot.listen(Twist)
    robot.place, robot.heading = np.array([3.0, 1.0]), np.pi / 2
    # The lidar looks to the left.
    robot.send_transform("base_link", "lidar_7", [1.5, 0.0, 0.4, 0.0, 0.0, np.pi / 2], static=True)
    robot.obeys = True
    robot.live(1.0)
    robot.send_goal(*goal, frame=frame)
    # (-0.5, -2) from the lidar is (1.5 + 2, -0.5) from the base, which looks along y.
    expected = np.array([3.0, 3.0] if frame == "base_link" else [3.5, 4.5])
    assert robot.live(20.0, until=robot.says("the goal is reached")), robot.status()
    robot.live(2.0)
    assert np.linalg.norm(robot.place - expected) < 0.6 and robot.travelled < 5.0, (robot.place, robot.travelled)
    assert robot.speed == 0.0 and not robot.driven
    assert f"'{frame}' moves with the robot: the goal is kept at ({expected[0]:.2f}, {expected[1]:.2f}) in 'odom'" in (
        robot.process.output
    )


def test_a_goal_that_moves_with_the_robot_counts_from_its_stamp(robot):
    robot.listen(Twist)
    robot.speed = 1.0
    robot.live(3.0)
    # Where the robot was a second ago, 2 m ahead of it then: 1 m ahead of it now.
    place, stamp = robot.place.copy(), robot.peer.now
    robot.live(1.0)
    robot.send_goal(2.0, 0.0, frame="base_link", stamp=stamp)
    kept = f"is kept at ({place[0] + 2.0:.2f}, 0.00) in 'odom'"
    assert robot.live(10.0, until=lambda: kept in robot.process.output), (kept, robot.process.output)


def test_a_stamp_that_the_odometry_does_not_reach_is_refused(robot):
    robot.listen(Twist)
    robot.live(1.0)
    robot.send_goal(2.0, 0.0, frame="base_link", stamp=robot.peer.now + 60 * 10**9)
    assert robot.live(2.0, until=robot.says("waiting for a transform: the goal is in frame 'base_link'"))
    assert robot.live(10.0, until=robot.says("the goal is refused, not transformed within 2 s")), robot.status()
    assert "no odometry: the newest one is 5" in robot.status()[1] and not robot.driven


def test_a_goal_in_the_map_follows_a_correction(robot):
    robot.listen(Twist)
    robot.send_transform("map_3", "odom", [0.0] * 6, static=True)
    robot.obeys = True
    robot.send_goal(3.0, 0.0, frame="map_3")
    assert robot.live(10.0, until=lambda: robot.place[0] > 0.5), robot.status()
    # Localisation finds that the odometry frame lies 2 m further back: the goal is at (5, 0) in it.
    robot.send_transform("map_3", "odom", [-2.0, 0.0, 0.0, 0.0, 0.0, 0.0], static=True)
    assert robot.live(20.0, until=robot.says("the goal is reached")), robot.status()
    robot.live(1.0)
    assert np.linalg.norm(robot.place - [5.0, 0.0]) < 0.6 and robot.speed == 0.0, robot.place


def test_a_goal_without_a_transform_is_refused_and_the_robot_stands(robot):
    robot.listen(Twist)
    robot.send_goal(3.0, 0.0, frame="nowhere")
    assert robot.live(10.0, until=robot.says("the goal is refused, not transformed within 2 s")), robot.status()
    assert "in frame 'nowhere', odometry in 'odom': no transform has" in robot.status()[1]
    # A transform that comes after that moves nothing: the goal has to be sent again.
    robot.send_transform("nowhere", "odom", [0.0] * 6, static=True)
    robot.live(1.5)
    assert not robot.driven
    robot.send_goal(3.0, 0.0, frame="nowhere")
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()


@pytest.mark.parametrize("robot", ["odometry_child_pose:=[2.0, 0.0, 0.0, 0.0, 0.0, 0.0]"], indirect=True)
def test_the_offset_of_the_odometry_s_frame_counts(robot):
    robot.listen(Twist)
    robot.child = "gps"
    robot.place = np.array([7.0, 0.0])
    robot.send_goal(5.0, 0.2)
    assert robot.live(10.0, until=robot.says("the goal is reached: 0.20 m away")), robot.status()


def test_odometry_of_an_unknown_frame_names_both_frames_and_the_missing_path(robot):
    robot.listen(Twist)
    robot.child = "gps"
    robot.send_goal(5.0, 0.0)
    assert robot.live(10.0, until=robot.says("odometry describes the frame 'gps'")), robot.status()
    assert "refer to 'base_link'" in robot.status()[1] and "no transform has 'base_link' or 'gps'" in robot.status()[1]
    assert not robot.driven


@pytest.mark.parametrize("robot", ["plan_topic:=plan"], indirect=True)
def test_it_follows_a_plan_instead_of_heading_for_its_end(robot):
    robot.listen(Twist)
    plans = robot.peer.node.create_publisher(Path, f"/{robot.prefix}/plan", 1)
    assert robot.peer.until(lambda: plans.get_subscription_count() > 1, 10.0)
    plan = Path()
    plan.header.frame_id = "odom"
    # Left first, although the end lies to the right.
    for x, y in ((0.0, 0.0), (1.0, 1.0), (3.0, 6.0), (6.0, 6.0), (6.0, -9.0)):
        pose = PoseStamped()
        pose.pose.position.x, pose.pose.position.y = x, y
        plan.poses.append(pose)
    plans.publish(plan)
    assert robot.live(10.0, until=lambda: robot.driven), robot.status()
    assert robot.commands[-1].angular.z > 0.0
    plans.publish(Path())
    assert robot.live(10.0, until=lambda: not robot.driven) and "the plan is empty" in robot.status()[1]


@pytest.mark.parametrize("robot", ["plan_topic:=plan"], indirect=True)
def test_a_plan_that_the_robot_did_not_follow_does_not_set_it_in_motion_when_it_is_sent_again(robot):
    """Planners repeat their plan every second: a robot with a wrong sign would drive the wrong way again and again."""
    robot.listen(Twist)
    robot.obeys, robot.signs = True, np.array([-1.0, 1.0])
    plans = robot.peer.node.create_publisher(Path, f"/{robot.prefix}/plan", 1)
    assert robot.peer.until(lambda: plans.get_subscription_count() > 1, 10.0)

    def plan(end: float) -> Path:
        message = Path()
        message.header.frame_id = "odom"
        for x in np.linspace(0.0, end, 5):
            pose = PoseStamped()
            pose.pose.position.x = float(x)
            message.poses.append(pose)
        return message

    def live(seconds: float, end: float, until=None) -> bool:
        for _ in range(round(seconds)):
            plans.publish(plan(end))
            if robot.live(1.0, until=until) and until is not None:
                return True
        return until is None

    assert live(15.0, 30.0, robot.says("it moves against its commands")), robot.status()
    assert "the same plan is ignored until" in robot.status()[1]
    robot.live(1.5)
    before = robot.travelled
    live(6.0, 30.0)
    assert robot.travelled == before and "dropped" in robot.status()[1]
    # Another end is another plan; so is the same one after a pause.
    robot.signs = np.ones(2)
    assert live(4.0, 20.0, lambda: robot.driven), robot.status()


def test_the_target_lies_ahead_on_the_plan():
    plan = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.2]])
    target, remaining = plan_target(plan, np.array([1.0, 0.3]), 2.0)
    np.testing.assert_allclose(target, [3.0, 0.0])
    assert remaining == pytest.approx(3.0 + 4.0 + 4.0 + 3.8)
    np.testing.assert_allclose(plan_target(plan, np.array([3.5, 0.1]), 2.0)[0], [4.0, 1.5])
    # At the start of a loop its end is as near, and must not be taken for the robot's place on it.
    assert plan_target(plan, np.array([0.0, 0.1]), 2.0)[1] > 14.0
    np.testing.assert_allclose(plan_target(plan, np.array([0.0, 3.0]), 9.0)[0], [0.0, 0.2])
    assert plan_target(plan[:1], np.array([9.0, 9.0]), 1.0)[1] == 0.0
    with pytest.raises(ValueError, match="at least one finite position"):
        plan_target(np.array([[np.nan, 0.0]]), np.zeros(2), 1.0)


def progress(noise: float, rate: int, speed: float, share: float, generator: np.random.Generator, seconds: float = 5.0):
    """What ProgressCheck says after each pose of a robot that carries out a share of its commanded speed [m/s].

    The noise of positions is in m per axis, that of the heading is half as many rad.
    """
    check, found = ProgressCheck(), []
    for step in range(round(seconds * rate)):
        place = np.array([share * speed * step / rate, 0.0]) + generator.normal(0.0, noise, 2)
        check.add(step / rate, (speed, 0.0), place, generator.normal(0.0, noise / 2))
        found.append(check.moving)
    return np.array(found)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03, 0.05])
def test_noise_of_the_odometry_is_not_taken_for_motion_and_motion_is_found_in_it(noise):
    generator = np.random.default_rng(950124)
    for rate in (10, 50):
        for speed in (0.2, 0.4, 1.0):
            case = f"{rate} Hz, {speed} m/s"
            stuck = [progress(noise, rate, speed, 0.0, generator) for _ in range(15)]
            claimed = np.mean([found[2 * rate :] == True for found in stuck])  # noqa: E712  (elementwise)
            assert claimed <= 0.02, f"{case}: stuck, and said to drive {claimed:.1%} of the time"
            named = np.mean([(found[2 * rate :] == False).any() for found in stuck])  # noqa: E712
            assert named > 0.9, f"{case}: stuck, and said so in {named:.0%} of the runs"
            slow = [progress(noise, rate, speed, 0.5, generator, 3.0) for _ in range(15)]
            recognised = np.mean([(found == True).any() for found in slow])  # noqa: E712
            assert recognised >= 0.95, f"{case}: half as fast as commanded, recognised in {recognised:.0%} of the runs"
            assert not any((found == False).any() for found in slow), f"{case}: moving, and said to stand"  # noqa: E712


def test_poses_are_taken_once_and_a_backward_jump_starts_anew():
    check = ProgressCheck()
    for step in range(60):
        # Each pose comes three times, as when commands are sent faster than odometry arrives.
        time = 0.1 * (step // 3)
        check.add(time, (0.5, 0.0), np.array([0.25 * time, 0.0]), 0.0)
    assert check.moving
    check.add(0.0, (0.5, 0.0), np.zeros(2), 0.0)
    assert check.moving is None


@pytest.mark.parametrize(("speed", "moving"), [(0.5, True), (0.1, True), (0.0, False), (0.005, False)])
def test_progress_is_what_odometry_shows_of_the_commanded_motion(speed, moving):
    check = ProgressCheck()
    for step in range(30):
        check.add(0.1 * step, (0.5, 0.0), np.array([0.1 * step * speed, 0.0]), 0.0)
    assert check.moving is moving
    check.clear()
    assert check.moving is None
    for step in range(30):
        check.add(0.1 * step, (0.0, 0.0), np.zeros(2), 0.0)
    assert check.moving is None, "a robot that is commanded to stand does not fail to move"
    for step in range(30, 60):
        check.add(0.1 * step, (0.0, 0.6), np.zeros(2), 0.1 * step * 0.4)
    assert check.moving, "turning on the spot is motion"


def against(speed: float, yaw_rate: float, share: float, *, seconds: float = 4.0, turns: float = 0.0) -> set[str]:
    """What ProgressCheck says of a robot that carries out a share of its command, which may change its sign."""
    check, random, said = ProgressCheck(), np.random.default_rng(2), set()
    place, heading, actual = np.zeros(2), 0.0, np.zeros(2)
    for step in range(round(20 * seconds)):
        sign = -1.0 if turns and (0.05 * step) % (2 * turns) >= turns else 1.0
        # The base follows with a lag of 0.5 s.
        actual += 0.1 * (sign * share * np.array([speed, yaw_rate]) - actual)
        place = place + 0.05 * actual[0] * np.array([np.cos(heading), np.sin(heading)])
        heading += 0.05 * actual[1]
        measured = place + 0.02 * random.standard_normal(2)
        check.add(0.05 * step, (sign * speed, sign * yaw_rate), measured, heading + 0.01 * random.standard_normal())
        said.add(check.opposed)
    return said - {""}


def test_motion_against_the_command_is_found_and_nothing_else_is_taken_for_it():
    assert against(0.5, 0.0, -1.0) == {"speed"} and against(-0.5, 0.0, -0.8) == {"speed"}
    assert against(0.0, 0.6, -1.0) == {"yaw rate"} and against(0.5, 0.5, -0.9) == {"speed"}
    # Slow, stuck, and sliding back a little; and changes of direction, after which the base still moves the other way.
    for share in (1.0, 0.3, 0.0, -0.2):
        assert not against(0.5, 0.5, share)
    for turns in (0.5, 1.0, 2.0, 3.0):
        assert not against(0.5, 0.6, 1.0, seconds=12.0, turns=turns)
    # A wrong sign is found although the commands change theirs, as those of a closed loop do.
    for turns in (2.5, 4.0):
        assert against(0.0, 0.6, -1.0, seconds=16.0, turns=turns) == {"yaw rate"}


@pytest.mark.parametrize("command", [(0.0, 0.0, 0.4), (0.0, 0.0, -0.4), (0.8, 0.0, 0.4)])
def test_motion_to_the_side_is_compared_with_the_commands_too(command):
    def check(share):
        """The robot carries out a share of its speed to the left, and all of its forward speed."""
        found, random = ProgressCheck(), np.random.default_rng(3)
        for step in range(100):
            place = 0.1 * step * np.array([command[0], share * command[2]]) + 0.005 * random.standard_normal(2)
            turn = np.array([[0.0, -1.0], [1.0, 0.0]])
            found.add(0.1 * step, command, turn @ place, np.pi / 2)
        return found

    assert check(1.0).moving and check(1.0).unfollowed < 1.0 and not check(1.0).opposed
    if command[0] == 0.0:
        stuck = check(0.0)
        assert stuck.moving is False and stuck.unfollowed > 6.0
        assert check(-1.0).opposed == "speed"


def test_the_time_without_motion_as_commanded_is_counted():
    check = ProgressCheck()
    for step in range(80):
        check.add(0.1 * step, (0.5, 0.0), np.array([0.05 * step, 0.0]), 0.0)
    assert check.unfollowed < 1.0 and check.velocity.forward == pytest.approx(0.5)
    for step in range(80, 140):
        check.add(0.1 * step, (0.5, 0.0), np.array([4.0, 0.05 * (step - 80)]), 0.0)
    assert check.unfollowed == pytest.approx(5.0, abs=1.0)
    assert check.velocity.left == pytest.approx(0.5) and check.velocity.forward == pytest.approx(0.0, abs=1e-6)
    for step in range(140, 180):
        check.add(0.1 * step, (0.0, 0.0), np.array([4.0, 3.0]), 0.0)
    assert check.unfollowed < 0.1 and check.velocity is None, "a robot that is commanded to stand follows"


@pytest.mark.parametrize(("yaw_rate", "drift"), [(0.02, 0.003), (0.05, 0.01), (0.17, 0.02)])
def test_a_heading_that_drifts_is_no_motion_of_a_robot_that_is_stuck(yaw_rate, drift):
    check, random = ProgressCheck(), np.random.default_rng(1)
    for step in range(60):
        check.add(0.05 * step, (0.5, yaw_rate), 0.001 * random.standard_normal(2), 0.05 * step * drift)
        assert not check.moving
    assert check.moving is False
