"""The log of a part's states: nothing new is lost, and a part that flickers does not fill it."""

import time

import pytest
import rclpy

from monoforce_ros.nodes.health import ERROR, OK, WARN, Health


@pytest.fixture
def node(ros_environment, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", ros_environment["ROS_DOMAIN_ID"])
    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("watched", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def spun(node, seconds):
    executor = rclpy.executors.SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.05)


def lines(capfd, part):
    return [line for line in capfd.readouterr().err.splitlines() if f"{part}: " in line]


def test_a_part_that_flickers_does_not_fill_the_log_and_its_last_state_is_in_it(node, capfd):
    health = Health(node, ["choice"])
    for number in range(20):
        health.report("choice", WARN, f"stopped: candidates are 0.{60 + number} s old", reason="late")
        health.report("choice", OK, "driving")
    health.report("choice", WARN, "stopped: candidates are 0.99 s old", reason="late")
    spun(node, 3.5)
    seen = lines(capfd, "choice")
    assert 3 <= len(seen) <= 4
    assert "0.60 s old" in seen[0] and "driving" in seen[1] and "0.99 s old" in seen[-1]


def test_every_new_state_is_logged_at_once(node, capfd):
    health = Health(node, ["lidar"])
    for text in ("a", "b", "c", "c"):
        health.report("lidar", ERROR, text)
    assert [line.rpartition(" ")[2] for line in lines(capfd, "lidar")] == ["a", "b", "c"]
    spun(node, 1.3)
    assert not lines(capfd, "lidar")
