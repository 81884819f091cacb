"""External failures: killed processes, a full disk, truncated files."""

import os
import signal
import subprocess
import time

import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from monoforce_ros.bags import BagReader, builders
from monoforce_ros.core import share_directory
from monoforce_ros.encoder.checkpoint import shipped_checkpoint

# What remains of a process that was killed does not depend on when.
pytestmark = pytest.mark.unhurried_nodes

START = 1_700_000_000_000_000_000


def publish_commands(peer, recorder, count: int) -> None:
    """Publish commands until the recorder receives them, and then ``count`` more."""
    sent = 0

    def publish():
        nonlocal sent
        peer.publish("/cmd_vel", builders.twist_stamped(START + sent, "base_link", 0.1, 0.0))
        sent += 1
        peer.spin(0.05)

    deadline = time.monotonic() + 30
    while "recording /cmd_vel" not in recorder.output:
        assert recorder.running and time.monotonic() < deadline, recorder.output
        publish()
    for _ in range(count):
        publish()


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_recording_that_is_killed_is_not_lost(start, peer, tmp_path, storage):
    recorder = start("bag_recorder", tmp_path / "out", "--topics", "/cmd_vel", "--storage", storage)
    publish_commands(peer, recorder, 60)
    recorder.stop(signal.SIGKILL)
    (left,) = tmp_path.glob(".out.unfinished-*")
    with BagReader(left) as bag:
        # Messages of the last second may not have been written yet.
        assert len(list(bag.messages(["/cmd_vel"]))) >= 30
        assert bag.warnings
    again = start("bag_recorder", tmp_path / "out", "--topics", "/cmd_vel")
    again.wait_for(f"an earlier recording was killed and is in {left}")
    again.stop()


def test_a_recorder_with_a_full_disk_keeps_its_messages_and_reports_where(executables, ros_environment, peer, tmp_path):
    # A limit on file sizes emulates a full disk: the same call fails.
    log = tmp_path / "log"
    with log.open("w") as output:
        recorder = subprocess.Popen(
            ["bash", "-c", f"ulimit -f 1500; exec {executables / 'bag_recorder'} {tmp_path / 'out'} --topics /noise"],
            stdout=output, stderr=subprocess.STDOUT, env=ros_environment,
        )  # fmt: skip
    publisher = peer.node.create_publisher(
        String, "/noise", QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
    )
    deadline = time.monotonic() + 60
    while recorder.poll() is None and time.monotonic() < deadline:
        # Noise does not compress.
        publisher.publish(String(data=os.urandom(4000).hex()))
        peer.spin(0.02)
    assert recorder.wait(timeout=10) == 1
    text = log.read_text()
    (left,) = tmp_path.glob(".out.unfinished-*")
    assert "too large" in text and f"lie in {left} and can be read as they are" in text and "Traceback" not in text
    with BagReader(left) as bag:
        assert len(list(bag.messages(["/noise"]))) >= 2


def test_a_report_that_does_not_fit_on_the_disk_leaves_the_old_one(executables, demo_bag, tmp_path):
    (tmp_path / "report.html").write_text("the old one")
    command = f"ulimit -f 60; exec {executables / 'evaluate'} {demo_bag} --terrain flat --out {tmp_path} --stride 2"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1, done.stderr
    assert "too large" in done.stderr and "Traceback" not in done.stderr
    assert (tmp_path / "report.html").read_text() == "the old one"
    assert not list(tmp_path.glob(".*unfinished*"))


def test_a_node_refuses_a_checkpoint_cut_in_half(start, tmp_path):
    whole = shipped_checkpoint()
    broken = tmp_path / "encoder.safetensors"
    broken.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    broken.with_suffix(".json").write_bytes(whole.with_suffix(".json").read_bytes())
    node = start("predictor", "--ros-args", "-p", "terrain_source:=camera", "-p", f"checkpoint:={broken}")
    assert node.wait(60) == 1
    assert f"{broken}: damaged" in node.output and "Traceback" not in node.output


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [("mass:", "mas:", "mas"), ("mass: 50", "mass: 50 kg", "50 kg"), ("mass: 50", "mass: -50", "mass")],
)
def test_a_node_refuses_a_robot_file_with_a_wrong_key_or_unit(start, tmp_path, old, new, said):
    text = (share_directory() / "config" / "robots" / "husky.yaml").read_text()
    assert old in text
    file = tmp_path / "robot.yaml"
    file.write_text(text.replace(old, new, 1))
    node = start("predictor", "--ros-args", "-p", f"robot:={file}")
    assert node.wait(60) == 1
    assert said in node.output and str(file) in node.output and "Traceback" not in node.output
