"""The predictor under a manager: states, parameters that change while it runs, simulated time, and two robots or two
nodes of one name side by side."""

import subprocess
import sys

import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import DescribeParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from monoforce_ros.bags import builders
from monoforce_ros.messages.message_types import message_class

PATHS = "nav_msgs/msg/Path"


def call(peer, kind, service: str, request):
    """Call a service; again where no answer comes, for it is lost if the server has not yet discovered who asks."""
    client = peer.node.create_client(kind, service)
    assert client.wait_for_service(timeout_sec=10.0), f"{service} is not available"
    for _ in range(4):
        future = client.call_async(request)
        if peer.until(future.done, 8.0):
            break
    assert future.done(), f"{service} does not answer"
    peer.node.destroy_client(client)
    return future.result()


def change(peer, node: str, transition: int) -> bool:
    """Whether a transition succeeded; one whose answer is lost is judged by the state that it left."""
    before = state(peer, node)
    request = ChangeState.Request(transition=Transition(id=transition))
    client = peer.node.create_client(ChangeState, f"{node}/change_state")
    assert client.wait_for_service(timeout_sec=10.0), f"{node} is not managed"
    try:
        for _ in range(3):
            future = client.call_async(request)
            if peer.until(future.done, 20.0):
                return future.result().success
            if state(peer, node) != before:
                return True
    finally:
        peer.node.destroy_client(client)
    raise AssertionError(f"{node} does not answer to transition {transition}")


def state(peer, node: str) -> int:
    return call(peer, GetState, f"{node}/get_state", GetState.Request()).current_state.id


def test_a_manager_configures_activates_pauses_and_takes_down(peer, start):
    process = start("predictor", "--ros-args", "-p", "autostart:=false", "-r", "__node:=managed")
    process.wait_for("waiting to be configured")
    assert state(peer, "/managed") == State.PRIMARY_STATE_UNCONFIGURED
    peer.clear()
    peer.drive(1.0)
    assert not peer.received["/predicted/path"]
    assert change(peer, "/managed", Transition.TRANSITION_CONFIGURE)
    assert state(peer, "/managed") == State.PRIMARY_STATE_INACTIVE
    peer.drive(1.5)
    assert not peer.received["/predicted/path"], "an inactive node predicts"
    assert change(peer, "/managed", Transition.TRANSITION_ACTIVATE)
    for _ in range(6):
        peer.drive(1.0)
        if peer.received["/predicted/path"]:
            break
    assert peer.received["/predicted/path"]
    assert change(peer, "/managed", Transition.TRANSITION_DEACTIVATE)
    peer.drive(0.5)
    peer.clear()
    peer.drive(1.5)
    assert not peer.received["/predicted/path"]
    # What came meanwhile is old by now.
    assert change(peer, "/managed", Transition.TRANSITION_ACTIVATE)
    peer.spin(1.5)
    assert not peer.received["/predicted/path"], "an old prediction"
    assert change(peer, "/managed", Transition.TRANSITION_DEACTIVATE)
    assert change(peer, "/managed", Transition.TRANSITION_CLEANUP)
    # A second life is like the first.
    assert change(peer, "/managed", Transition.TRANSITION_CONFIGURE)
    assert change(peer, "/managed", Transition.TRANSITION_ACTIVATE)
    for _ in range(6):
        peer.drive(1.0)
        if peer.received["/predicted/path"]:
            break
    assert peer.received["/predicted/path"], process.output[-2000:]
    assert process.stop() == 0


@pytest.mark.unhurried_nodes
def test_a_node_that_cannot_be_configured_keeps_running_and_logs_the_reason(peer, start):
    process = start(
        "predictor", "--ros-args", "-p", "autostart:=false", "-p", "robot:=no_such_robot", "-r", "__node:=wrong"
    )
    process.wait_for("waiting to be configured")
    assert not change(peer, "/wrong", Transition.TRANSITION_CONFIGURE)
    process.wait_for("no_such_robot")
    assert state(peer, "/wrong") == State.PRIMARY_STATE_UNCONFIGURED and process.running
    assert process.stop() == 0


@pytest.mark.unhurried_nodes
def test_the_robot_may_change_while_the_node_is_unconfigured(peer, start):
    process = start(
        "predictor", "--ros-args", "-p", "autostart:=false", "-p", "terrain_source:=flat", "-r", "__node:=changing"
    )
    process.wait_for("waiting to be configured")
    assert set_parameters(peer, "/changing", robot="warthog").successful
    # It is never a managed node's own business to start by itself later.
    assert "read-only" in set_parameters(peer, "/changing", autostart=True).reason.lower()
    assert change(peer, "/changing", Transition.TRANSITION_CONFIGURE)
    refused = set_parameters(peer, "/changing", robot="husky")
    assert not refused.successful and "robot is read-only while the node is configured" in refused.reason
    assert change(peer, "/changing", Transition.TRANSITION_ACTIVATE)
    process.wait_for("predicting 5 s ahead for warthog")
    assert change(peer, "/changing", Transition.TRANSITION_DEACTIVATE)
    assert change(peer, "/changing", Transition.TRANSITION_CLEANUP)
    assert set_parameters(peer, "/changing", robot="no_such_robot").successful
    assert not change(peer, "/changing", Transition.TRANSITION_CONFIGURE)
    assert process.stop() == 0


BROKEN = """
import sys, rclpy
from monoforce_ros.nodes.managed import ManagedNode
from monoforce_ros.nodes.process import run_node

class Broken(ManagedNode):
    def __init__(self):
        super().__init__("broken")
        if {autostart}:
            self.autostart()

    def {step}(self):
        self.create_timer(1.0, self.pause)
        self.no_such_attribute.load()

def work(node, executor, signals):
    configured = node.trigger_configure()
    print(configured.name, [node._state_machine.current_state[1]], len(list(node.timers)))

sys.exit(run_node(Broken, [], work))
"""


def run_broken(ros_environment, **how) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", BROKEN.format(**how)],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(("step", "outcome"), [("set_up", "configured"), ("begin", "activated")])
def test_an_unexpected_error_at_the_start_is_named_with_its_traceback(ros_environment, step, outcome):
    done = run_broken(ros_environment, step=step, autostart=True)
    error = "AttributeError: 'Broken' object has no attribute 'no_such_attribute'"
    assert done.returncode == 1
    assert f"error: broken could not be {outcome}: {error}" in done.stderr
    assert f"not {outcome}: {error}\nTraceback" in done.stderr and f"in {step}\n" in done.stderr


def test_a_manager_sees_an_unexpected_error_as_a_failed_transition(ros_environment):
    done = run_broken(ros_environment, step="set_up", autostart=False)
    assert done.returncode == 0 and done.stdout.split("\n")[0] == "FAILURE ['unconfigured'] 0"
    assert "not configured: AttributeError" in done.stderr and "in set_up\n" in done.stderr


@pytest.fixture(scope="module")
def tunable(start):
    process = start("predictor", "--ros-args", "-r", "__node:=tunable", "-p", "candidates:=5", "-p", "horizon:=2.0")
    process.wait_for("predicting 2 s ahead")
    return process


def set_parameters(peer, node: str, **values):
    request = SetParametersAtomically.Request()
    request.parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return call(peer, SetParametersAtomically, f"{node}/set_parameters_atomically", request).result


def test_parameters_change_while_it_runs_all_or_none(peer, tunable):
    assert set_parameters(peer, "/tunable", weight_roll=2.5, rate=5.0).successful
    # A value out of its range keeps the others from being taken over too.
    refused = set_parameters(peer, "/tunable", weight_roll=7.0, limit_roll=-1.0)
    assert not refused.successful and refused.reason
    fixed = set_parameters(peer, "/tunable", robot="marv")
    assert not fixed.successful and "read-only" in fixed.reason.lower()
    from rcl_interfaces.srv import GetParameters

    request = GetParameters.Request(names=["weight_roll", "rate"])
    values = call(peer, GetParameters, "/tunable/get_parameters", request).values
    assert [v.double_value for v in values] == [2.5, 5.0]
    assert tunable.running


def test_every_parameter_is_described_with_its_range(peer, tunable):
    request = DescribeParameters.Request(names=["rate", "weight_roll", "robot", "autostart"])
    rate, weight, robot, autostart = call(peer, DescribeParameters, "/tunable/describe_parameters", request).descriptors
    assert "Largest rate" in rate.description and rate.floating_point_range[0].to_value == 100.0
    assert not rate.read_only and not weight.read_only and autostart.read_only
    assert not robot.read_only and robot.additional_constraints == "read-only while the node is configured"


def test_a_changed_rate_is_kept_to(peer, tunable):
    assert set_parameters(peer, "/tunable", rate=2.0).successful
    peer.drive(1.0)
    peer.clear()
    peer.drive(4.0)
    assert 4 <= len(peer.received["/predicted/path"]) <= 11
    tunable.stop()


def test_two_robots_in_namespaces_do_not_hear_each_other(peer, start):
    processes = [
        start("predictor", "--ros-args", "-r", f"__ns:=/{name}", "-p", "robot:=husky", "-p", "terrain_source:=flat")
        for name in ("left", "right")
    ]
    for process in processes:
        process.wait_for("predicting 5 s ahead for husky")
    paths: dict[str, list] = {"left": [], "right": []}
    for name, received in paths.items():
        peer.node.create_subscription(
            message_class(PATHS), f"/{name}/predicted/path", received.append, QoSProfile(depth=10)
        )

    def feed(name: str, x: float) -> None:
        for _ in range(40):
            peer.now += 50_000_000
            pose = [x, 0.0, 0.1323]
            peer.publish(
                f"/{name}/odom", builders.odometry(peer.now, "odom", "base_link", pose, [0, 0, 0, 1], [0] * 3, [0] * 3)
            )
            peer.publish(f"/{name}/cmd_vel", builders.twist_stamped(peer.now, "base_link", 0.5, 0.0))
            peer.spin(0.05)

    for _ in range(5):
        feed("left", 10.0)
        if paths["left"]:
            break
    assert paths["left"] and not paths["right"]
    for _ in range(5):
        feed("right", 20.0)
        if paths["right"]:
            break
    assert abs(paths["left"][-1].poses[0].pose.position.x - 10.0) < 0.1
    assert abs(paths["right"][-1].poses[0].pose.position.x - 20.0) < 0.1
    assert all(process.stop() == 0 for process in processes)


def test_simulated_time_that_jumps_back_is_reported_and_handled(start, peer):
    """`use_sim_time` with a /clock that goes back, as a looping bag brings it."""
    node = start("predictor", "--ros-args", "-p", "use_sim_time:=true", "-r", "__node:=dreaming")
    node.wait_for("predicting 5 s ahead for husky")
    clock = peer.node.create_publisher(Clock, "/clock", 10)

    def drive(seconds: float) -> None:
        for _ in range(round(2 * seconds)):
            message = Clock()
            message.clock.sec, message.clock.nanosec = divmod(peer.now, 10**9)
            clock.publish(message)
            peer.drive(0.5)

    before = peer.now
    peer.clear()
    # New publishers need a moment to be found, longer on a busy machine.
    for _ in range(10):
        drive(1.5)
        if peer.received["/predicted/path"]:
            break
    assert peer.received["/predicted/path"], node.output[-3000:]
    peer.settle()
    peer.clear()
    peer.now = before - 100 * 10**9
    drive(4.0)
    for _ in range(10):
        if len(peer.received["/predicted/path"]) > 3:
            break
        drive(1.0)
    assert peer.received["/predicted/path"]
    stamps = [m.header.stamp.sec for m in peer.received["/predicted/path"]]
    assert all(stamp < before // 10**9 for stamp in stamps[-3:])
    assert "time went back" in node.output and node.stop() == 0


def test_two_nodes_of_one_name_both_predict(start, peer):
    nodes = [start("predictor", "--ros-args", "-p", "terrain_source:=flat") for _ in range(2)]
    for node in nodes:
        node.wait_for("predicting 5 s ahead for husky")
    peer.clear()
    for _ in range(10):
        peer.drive(1.5)
        if peer.until(lambda: len(peer.received["/predicted/path"]) > 10, 0.5):
            break
    assert len(peer.received["/predicted/path"]) > 10
    peer.drive(0.5)
    for node in nodes:
        assert node.stop() == 0, node.output
