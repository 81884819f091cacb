"""End of a node's process: orderly after a signal, with a traceback after a fault of its own."""

import signal
import subprocess
import sys

import pytest

NODE = """
import sys, rclpy
from rclpy.node import Node
from monoforce_ros.nodes.process import run_node

class Ending(Node):
    def __init__(self):
        super().__init__("ending")
        self.create_timer(0.05, self.tick)

    def tick(self):
        if {shut_down}:
            rclpy.shutdown()
        self.count_publishers("/anything")
        raise ValueError("a fault of the node")

sys.exit(run_node(Ending, []))
"""


@pytest.mark.parametrize("shut_down", [True, False])
def test_a_callback_that_outlives_its_context_is_no_fault(shut_down, ros_environment):
    done = subprocess.run(
        [sys.executable, "-c", NODE.format(shut_down=shut_down)],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode == 0) == shut_down, done.stderr
    assert ("a fault of the node" in done.stderr) != shut_down


WORKING = """
import os, signal, sys, time
from rclpy.node import Node
from monoforce_ros.nodes.process import run_node

class Working(Node):
    def __init__(self):
        super().__init__("working")
        self.create_timer(0.05, self.tick)

    def tick(self):
        os.kill(os.getpid(), signal.{name})
        time.sleep(0.2)
        self.count_publishers("/anything")
        print("finished", flush=True)

sys.exit(run_node(Working, []))
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_interrupts_no_callback(name, ros_environment):
    # Python's exception inside rclpy's C++ part, which takes a message or waits, ended nodes with a crash.
    done = subprocess.run(
        [sys.executable, "-c", WORKING.format(name=name)],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "finished\n"), done.stderr


INTERRUPTED = """
import os, signal, sys, time, rclpy
from rclpy.node import Node
from std_msgs.msg import String
from monoforce_ros.nodes.process import run_node

class Starting(Node):
    def __init__(self):
        super().__init__("starting")
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.5)
        except KeyboardInterrupt:
            pass
        {next}

sys.exit(run_node(Starting, []))
"""


def test_signals_are_handled_before_anything_that_takes_time_is_imported():
    code = "import sys, monoforce_ros.nodes.executables; sys.exit(str({'numpy', 'yaml', 'rclpy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr.strip() == "set()"


@pytest.mark.parametrize("following", ["self.create_publisher(String, 'x', 1)", "pass", "raise KeyboardInterrupt"])
def test_a_signal_while_a_node_starts_is_no_fault(following, ros_environment):
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED.format(next=following)],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr


LOADING = """
import os, signal, sys
from importlib.abc import MetaPathFinder

class Interrupts(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "rclpy":
            os.kill(os.getpid(), {number})

sys.meta_path.insert(0, Interrupts())
from importlib.metadata import entry_points
(point,) = [p for p in entry_points(group="console_scripts") if p.name == {name!r} and "monoforce" in p.value]
sys.exit(point.load()([]))
"""


@pytest.mark.parametrize("name", ["predictor", "path_selector", "simulator", "bag_player", "bag_recorder"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_an_executable_is_loaded_is_no_fault(name, number, ros_environment):
    done = subprocess.run(
        [sys.executable, "-c", LOADING.format(name=name, number=int(number))],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and not done.stderr, done.stderr


def test_choosing_among_candidates_needs_no_physics_engine():
    """A second process of half a gigabyte matters on the small computer of a robot."""
    loaded = (
        "import sys, monoforce_ros.nodes.path_selector; print(sorted({'torch', 'warp', 'mujoco'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"
