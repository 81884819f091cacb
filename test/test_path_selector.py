"""The path selector with the real predictor: to the goal, around a wall, and stopping when it must."""

import math

import pytest
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.qos import QoSProfile
from test_candidates_node import walled

from monoforce_ros.bags import builders


@pytest.fixture(scope="module")
def nodes(start, peer):
    predictor = start(
        "predictor", "--ros-args", "-p", "candidates:=15", "-p", "candidate_speeds:=[0.8]", "-p", "horizon:=3.0",
        "-p", "candidate_yaw_rate:=1.0",
    )  # fmt: skip
    # Twice the default: what is tested is that the robot stops, not how fast a busy machine predicts.
    selector = start("path_selector", "--ros-args", "-r", "cmd_vel:=commanded", "-p", "timeout:=1.2")
    predictor.wait_for("predicting 3 s ahead for husky")
    selector.wait_for("waiting for a goal")
    return selector


@pytest.fixture(scope="module")
def sent(peer, nodes):
    commands: list[TwistStamped] = []
    peer.node.create_subscription(TwistStamped, "/commanded", commands.append, QoSProfile(depth=50))
    return commands


def send(peer, x: float, y: float, frame: str = "odom") -> None:
    if not hasattr(peer, "goals"):
        peer.goals = peer.node.create_publisher(PoseStamped, "/goal_pose", 1)
        peer.until(lambda: peer.goals.get_subscription_count() > 0, 10.0)
    goal = PoseStamped()
    goal.header.frame_id = frame
    goal.pose.position.x, goal.pose.position.y = x, y
    peer.goals.publish(goal)
    peer.spin(0.2)


def status(peer) -> tuple[int, str]:
    for array in reversed(peer.received["/diagnostics"]):
        for entry in array.status:
            if entry.name == "path_selector: choice":
                return int.from_bytes(entry.level, "little"), entry.message
    return -1, ""


def moves(peer, sent, **world) -> TwistStamped:
    """Feed a world until the robot is commanded to move; returns the last command."""
    for _ in range(10):
        sent.clear()
        peer.drive(0.8, **world)
        if len(sent) >= 3 and sent[-1].twist.linear.x > 0:
            return sent[-1]
    pytest.fail(f"not commanded to move: {status(peer)}")


def test_the_robot_is_sent_towards_its_goal(peer, nodes, sent):
    # The robot stands at (1, 2) and looks along x.
    send(peer, 9.0, 2.0)
    straight = moves(peer, sent)
    assert straight.twist.linear.x == pytest.approx(0.8) and abs(straight.twist.angular.z) < 0.2
    send(peer, 3.0, 7.0)
    assert moves(peer, sent).twist.angular.z > 0.3
    send(peer, 3.0, -3.0)
    assert moves(peer, sent).twist.angular.z < -0.3


def test_it_goes_around_a_wall(peer, nodes, sent):
    send(peer, 9.0, 2.0)
    # On a busy machine predictions of the world without the wall are still under way.
    peer.drive(2.4, cloud=walled, speed=0.0)
    command = moves(peer, sent, cloud=walled, speed=0.0)
    assert abs(command.twist.angular.z) > 0.2


def test_it_stops_when_predictions_are_late_and_goes_on_with_them(peer, nodes, sent):
    send(peer, 9.0, 2.0)
    moves(peer, sent)
    peer.drive(2.4, cloud=lambda stamp: None)
    assert sent[-1].twist.linear.x == 0.0 and sent[-1].twist.angular.z == 0.0
    assert peer.until(lambda: "s old" in status(peer)[1], 5.0), status(peer)
    moves(peer, sent)


def test_it_stops_when_all_inputs_are_silent(peer, nodes, sent):
    """Without odometry there are no new candidates: by their stamps alone neither would expire."""
    send(peer, 9.0, 2.0)
    moves(peer, sent)
    assert peer.until(lambda: sent[-1].twist.linear.x == 0.0, 5.0), "it keeps driving without odometry"
    sent.clear()
    peer.spin(0.5)
    assert sent and not any(command.twist.linear.x for command in sent)
    assert peer.until(lambda: "no odometry for" in status(peer)[1], 5.0), status(peer)
    moves(peer, sent)


def test_it_stops_when_odometry_repeats_one_stamp(peer, nodes, sent):
    """Candidates do not grow old then either: by stamps alone the robot would drive on for ever."""
    send(peer, 9.0, 2.0)
    moves(peer, sent)
    frozen = peer.now
    place = ([1.0, 2.0, 0.3], [0, 0, 0, 1], [0] * 3, [0] * 3)
    peer.drive(
        2.0, cloud=lambda stamp: None, odometry=lambda stamp: builders.odometry(frozen, "odom", "base_link", *place)
    )
    assert sent[-1].twist.linear.x == 0.0 and sent[-1].twist.angular.z == 0.0
    assert "repeated the same stamp" in status(peer)[1], status(peer)
    moves(peer, sent)


def test_it_stops_at_the_goal_and_for_a_goal_in_another_frame(peer, nodes, sent):
    send(peer, 9.0, 2.0, frame="map")
    peer.drive(1.0)
    assert sent[-1].twist.linear.x == 0.0
    assert peer.until(lambda: "the goal is in frame 'map'" in status(peer)[1], 5.0), status(peer)
    send(peer, 1.2, 2.1)
    peer.drive(1.0)
    assert peer.until(lambda: "the goal is reached" in status(peer)[1], 5.0), status(peer)
    assert sent[-1].twist.linear.x == 0.0
    # After a few more commands to stand nothing is published.
    peer.drive(1.0)
    sent.clear()
    peer.drive(1.0)
    assert not sent


def test_bad_goals_and_bad_candidates_do_not_move_it(peer, nodes, sent):
    sent.clear()
    send(peer, math.nan, 0.0)
    peer.drive(0.6)
    assert not [command for command in sent if command.twist.linear.x]
    assert peer.until(lambda: "not finite" in status(peer)[1], 5.0), status(peer)
    # Another publisher with a cloud that holds no candidates.
    send(peer, 9.0, 2.0)
    moves(peer, sent)
    for _ in range(5):
        peer.publish("/predicted/candidate_costs", builders.point_cloud(peer.now, "odom", [[1.0, 2.0, 3.0]]))
        peer.drive(0.2, cloud=lambda stamp: None)
    assert nodes.running and "Traceback" not in nodes.output
    assert nodes.stop() == 0
