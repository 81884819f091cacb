"""JointInput: angles of joints that several drivers publish, each with its own age."""

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from monoforce_ros.messages import MessageError
from monoforce_ros.nodes.joint_input import JointInput
from monoforce_ros.robots import load_robot

FRONT, REAR = ["front_left", "front_right"], ["rear_left", "rear_right"]


def state(seconds, names, angles):
    message = JointState(name=list(names), position=[float(angle) for angle in angles])
    message.header.stamp.sec, rest = divmod(round(seconds * 1e9), 10**9)
    message.header.stamp.nanosec = rest
    return message


@pytest.fixture
def joints():
    found = JointInput(load_robot("marv"), continues=False, timeout=0.5)
    found.measure(state(100.0, FRONT + REAR, [-0.7, -0.7, -0.14, -0.14]))
    return found


def at(joints, seconds):
    motion = joints.at(round(seconds * 1e9))
    return None if motion is None else motion.start.tolist()


def test_joints_of_another_driver_on_the_topic_change_nothing(joints):
    joints.measure(state(100.01, ["arm_1", "arm_2"], [0.3, 0.2]))
    assert at(joints, 100.02) == pytest.approx([-0.7, -0.7, -0.14, -0.14])
    # Once there is nothing else on the topic, the names are wrong.
    with pytest.raises(MessageError, match="expected some of"):
        joints.measure(state(101.0, ["arm_1"], [0.3]))
    with pytest.raises(ValueError, match="got the joints .'arm_1'."):
        joints.at(101_000_000_000)


def test_each_joint_has_an_age_of_its_own(joints):
    for count in range(1, 31):
        joints.measure(state(100.0 + 0.05 * count, REAR, [-0.2, -0.2]))
        if count == 8:
            assert at(joints, 100.4) == pytest.approx([-0.7, -0.7, -0.2, -0.2])
    with pytest.raises(ValueError, match=r"newest of front_left is 1\.5 s older than the sensor data"):
        joints.at(101_500_000_000)
    joints.measure(state(101.5, FRONT, [-0.6, -0.6]))
    assert at(joints, 101.5) == pytest.approx([-0.6, -0.6, -0.2, -0.2])


def test_a_measurement_of_another_clock_is_refused(joints):
    with pytest.raises(ValueError, match=r"100\.0 s newer than the sensor data"):
        joints.at(1)
    assert at(joints, 99.8) is not None, "joint states may be younger than a processed image"


@pytest.mark.parametrize("bad", [[np.nan, 0.0], [np.inf, 0.0], [-40.0, 0.0], [1e6, 0.0]])
def test_after_an_unusable_message_there_are_no_angles_until_a_usable_one(joints, bad):
    with pytest.raises(MessageError):
        joints.measure(state(100.1, FRONT, bad))
    with pytest.raises(ValueError, match="front_left"):
        joints.at(100_100_000_000)
    joints.measure(state(100.2, FRONT, [-0.5, -0.5]))
    assert at(joints, 100.2) == pytest.approx([-0.5, -0.5, -0.14, -0.14])


def test_before_the_first_measurement_there_are_none():
    joints = JointInput(load_robot("marv"), continues=False, timeout=0.5)
    assert joints.at(1) is None
