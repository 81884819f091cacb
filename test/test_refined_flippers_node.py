"""The installed predictor that refines the flipper angles of its best candidate."""

import numpy as np
from sensor_msgs.msg import JointState

from monoforce_ros.bags import builders

NAMES = ["front_left", "front_right", "rear_left", "rear_right"]
ANGLES = [0.2, 0.2, -0.1, -0.1]


def test_the_best_candidate_s_flipper_angles_are_published(peer, start):
    process = start(
        "predictor", "--ros-args", "-p", "robot:=marv", "-p", "terrain_source:=flat", "-p", "horizon:=1.0",
        "-p", "candidates:=4", "-p", "candidate_delay:=0.2", "-p", "refine_seconds:=0.5",
    )  # fmt: skip
    process.wait_for("predicting 1 s ahead for marv", 240.0)
    heard: list = []
    peer.node.create_subscription(JointState, "/predicted/flipper_angles", heard.append, 1)

    def odometry(stamp):
        peer.publish("/joint_states", builders.joint_state(stamp, NAMES, ANGLES, [0.0] * 4))
        return builders.odometry(stamp, "odom", "base_link", [0.0, 0.0, 0.1], [0, 0, 0, 1], [0] * 3, [0] * 3)

    for _ in range(40):
        peer.drive(1.0, odometry=odometry, cloud=lambda stamp: None, speed=0.0)
        if heard:
            break
    assert heard, process.output[-2000:]
    assert list(heard[-1].name) == NAMES
    assert np.abs(np.array(heard[-1].position) - ANGLES).max() < 0.5
    assert process.stop() == 0
