"""The installed predictor with a robot that has flippers: measured angles, commands, and bad input."""

import numpy as np
import pytest

from monoforce_ros.bags import builders

OK, ERROR = 0, 2
NAMES = ["front_left", "front_right", "rear_left", "rear_right"]


@pytest.fixture(scope="module")
def predictor(start, peer):
    """One node for all tests of this file: the input of one test must not affect the next."""
    process = start(
        "predictor", "--ros-args", "-p", "robot:=marv", "-p", "terrain_source:=flat", "-p", "horizon:=3.0",
        "-p", "data_timeout:=1.0",
    )  # fmt: skip
    process.wait_for("predicting 3 s ahead for marv")
    assert peer.until(lambda: peer.node.count_subscribers("/diagnostics") > 0)
    return process


def drive(peer, *, seconds=1.0, joints=None, commands=None):
    """Stand on the flippers; ``joints`` and ``commands`` take a stamp and return a message or None."""

    def odometry(stamp):
        for topic, make in (("/joint_states", joints), ("/flipper_commands", commands)):
            message = None if make is None else make(stamp)
            if message is not None:
                peer.publish(topic, message)
        return builders.odometry(stamp, "odom", "base_link", [0.0, 0.0, 0.1], [0, 0, 0, 1], [0] * 3, [0] * 3)

    peer.drive(seconds, odometry=odometry, cloud=lambda stamp: None, speed=0.0)


def measured(angles, names=None, rates=None):
    listed = list(names or NAMES)
    return lambda stamp: builders.joint_state(stamp, listed, angles, rates or [0.0] * len(listed))


def ends(peer):
    """Height gained and pitch (nose up) [rad] at the end of the newest path."""
    poses = peer.received["/predicted/path"][-1].poses
    last = poses[-1].pose.orientation
    return poses[-1].pose.position.z - poses[0].pose.position.z, -2.0 * (last.w * last.y - last.x * last.z)


def predicted(peer, predictor, **given):
    """Feed data until predictions are made from them."""
    peer.begin()
    for _ in range(12):
        drive(peer, **given)
        if peer.received["/predicted/path"] and peer.until(
            lambda: peer.status("prediction") == (OK, "predicting"), 1.0
        ):
            # Once more, so that the newest path follows from the newest joints.
            peer.clear()
            drive(peer, seconds=0.6, **given)
            if peer.received["/predicted/path"]:
                return ends(peer)
    pytest.fail(f"no prediction: {peer.status('prediction')}, {peer.status('joints')}\n{predictor.output[-3000:]}")


def test_measured_angles_pose_the_flippers_in_any_order(peer, predictor):
    level = predicted(peer, predictor)
    # Front flippers pressed down lift the nose; foreign joints and another order do not matter.
    names = ["rear_right", "arm_joint", "front_right", "rear_left", "front_left"]
    _, pitch = predicted(peer, predictor, joints=measured([-0.14, 1.0, -0.7, -0.14, -0.7], names))
    assert abs(level[1]) < 0.02
    assert pitch > 0.1
    assert peer.until(lambda: peer.status("joints") == (OK, "receiving joints"), 5.0), peer.status("joints")


def test_commanded_angles_move_the_flippers_over_the_horizon(peer, predictor):
    down = measured([-0.8, -0.8], ["front_left", "front_right"])
    _, pitch = predicted(peer, predictor, joints=measured([0.3, 0.3, -0.14, -0.14]), commands=down)
    assert pitch > 0.1
    # As rates: without positions.
    rates = [-1.0, -1.0]

    def turning(stamp):
        return builders.joint_state(stamp, ["front_left", "front_right"], np.zeros(0), rates)

    _, pitch = predicted(peer, predictor, joints=measured([0.3, 0.3, -0.14, -0.14]), commands=turning)
    assert pitch > 0.1


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        (measured([np.nan, 0.0, 0.0, 0.0]), "got no finite position of ['front_left'], expected finite numbers"),
        (measured([0.1], ["elbow"]), "got the joints ['elbow'], expected some of"),
        (measured([-40.0, 0.0, 0.0, 50.0]), "got -40, 50 for ['front_left', 'rear_right'], expected angles within"),
        (lambda stamp: builders.joint_state(stamp, NAMES, [0.1], [0.0]), "got 1 values of position for 4 names"),
        (lambda stamp: builders.joint_state(0, NAMES, [0.1] * 4, [0.0] * 4), "the stamps are zero"),
    ],
)
def test_bad_joint_states_are_named(peer, predictor, bad, text):
    predicted(peer, predictor, joints=measured([-0.14] * 4))
    drive(peer, joints=bad)
    assert peer.until(lambda: peer.status("joints")[0] == ERROR and text in peer.status("joints")[1], 5.0), peer.status(
        "joints"
    )
    assert predictor.running
    # Nothing is predicted from the angles of the robot's file instead.
    peer.settle()
    peer.clear()
    drive(peer, joints=bad)
    peer.settle()
    assert not peer.received["/predicted/path"]


def test_late_joint_states_stop_the_predictions(peer, predictor):
    predicted(peer, predictor, joints=measured([-0.14] * 4))
    drive(peer, seconds=1.0)  # they end
    peer.settle()
    peer.begin()
    drive(peer, seconds=1.0)
    assert peer.until(lambda: "joint states: the newest of" in (peer.status("prediction") or (0, ""))[1], 5.0)
    assert not peer.received["/predicted/path"]
    predicted(peer, predictor, joints=measured([-0.14] * 4))
