"""The log of a part's states: nothing new is lost, and a part that flickers does not fill it."""

import shlex
import time
from dataclasses import replace

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock

from monoforce_ros.nodes.clocks import STEADY
from monoforce_ros.nodes.health import ERROR, OK, WARN, Health
from monoforce_ros.nodes.terrain_health import PART, TerrainHealth
from monoforce_ros.perception import FlatTerrain, TrustedTerrain, TrustReport
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults
from monoforce_ros.training.train_cli import build_parser


@pytest.fixture
def node(ros_environment, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", ros_environment["ROS_DOMAIN_ID"])
    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("watched", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def spun(node, seconds, until=lambda: False):
    executor = rclpy.executors.SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    end = time.monotonic() + seconds
    while time.monotonic() < end and not until():
        executor.spin_once(timeout_sec=0.05)
    return until()


def seconds_of(seconds):
    message = Clock()
    message.clock.sec = seconds
    return message


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


def test_simulated_time_that_stands_still_is_reported(ros_environment, monkeypatch, capfd):
    """`use_sim_time` without /clock: the watch goes on, for it follows steady time."""
    monkeypatch.setenv("ROS_DOMAIN_ID", ros_environment["ROS_DOMAIN_ID"])
    context = rclpy.Context()
    context.init()
    simulated = rclpy.parameter.Parameter("use_sim_time", value=True)
    node = rclpy.create_node("watched", context=context, parameter_overrides=[simulated])
    health = Health(node, ["clock"])
    clock = node.create_publisher(Clock, "/clock", 10)
    time_of_bag = 0
    # A time of zero is none yet.
    timer = node.create_timer(0.1, lambda: clock.publish(seconds_of(time_of_bag)), clock=STEADY)
    assert spun(node, 10.0, lambda: health.level("clock") == WARN)
    timer.cancel()

    def tick():
        nonlocal time_of_bag
        time_of_bag += 1
        clock.publish(seconds_of(time_of_bag))

    timer = node.create_timer(0.1, tick, clock=STEADY)
    assert spun(node, 10.0, lambda: health.level("clock") == OK)
    timer.cancel()
    assert spun(node, 10.0, lambda: health.level("clock") == WARN)
    first, _, last = lines(capfd, "clock")
    assert "use_sim_time is true, but there are no messages on /clock" in first and "/clock stands still" in last
    node.destroy_node()
    context.try_shutdown()


def test_every_new_state_is_logged_at_once(node, capfd):
    health = Health(node, ["lidar"])
    for text in ("a", "b", "c", "c"):
        health.report("lidar", ERROR, text)
    assert [line.rpartition(" ")[2] for line in lines(capfd, "lidar")] == ["a", "b", "c"]
    spun(node, 1.3)
    assert not lines(capfd, "lidar")


def test_terrain_s_values_are_those_of_its_message_and_its_command_can_be_pasted(node):
    source = TrustedTerrain(FlatTerrain(load_robot("husky"), Grid.square(), TerrainDefaults()), None, [])
    health = TerrainHealth(Health(node, [PART]), source, "my robots/husky.yaml", "own.safetensors")
    published = []
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda array: published.append(array.status[0]), 10)
    # Nothing is published on a change before the subscription is matched.
    assert spun(node, 10.0, lambda: bool(published))
    trusted = TrustReport(True, 0.8, 3.0, 0.01, 0.1, 0.0, sensors=("camera",))
    for report, level in ((trusted, OK), (replace(trusted, trusted=False, share=0.0, error=0.4), WARN)):
        source.report = report
        health.report()
        assert spun(node, 10.0, lambda wanted=level: published[-1].level == wanted)
        first = next(status for status in published if status.level == level)
        values = {entry.key: entry.value for entry in first.values}
        assert values["used of what the encoder adds [%]"] == f"{100 * report.share:.0f}"
        assert values["error [cm] (level ground)"] == f"{100 * report.error:.1f} (10.0)"
    # Nothing follows the command, which a shell would take for a part of it.
    assert "checkpoint:=adapted/encoder.safetensors: ros2" in first.message
    command = shlex.split(first.message[first.message.index("ros2 run") :])
    assert command[:4] == ["ros2", "run", "monoforce_ros", "train"]
    found = build_parser().parse_args(command[4:])
    assert found.adapt and [str(bag) for bag in found.bags] == ["BAG"] and str(found.out) == "adapted"
    assert (found.robot, str(found.start_from)) == ("my robots/husky.yaml", "own.safetensors")
