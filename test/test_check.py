"""`evaluate --check`: what is there, what is missing, and what is odd, each in a sentence."""

import re
import subprocess

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, builders
from monoforce_ros.evaluation.check import check_bag, check_text
from monoforce_ros.robots import load_robot

START = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def write(path, *, delay=0.2, commands=True, clock=0.0, gap=False, info=True, frame="base_link", sign=1.0, camera=True):
    """Twenty seconds of a drive in which motion follows commands by ``delay``."""
    times = np.arange(0.0, 20.0, 0.05)

    def told(t):
        return 0.5 + 0.3 * np.sin(0.9 * t), 0.5 * np.sin(1.7 * t)

    heading = np.cumsum(told(times - delay)[1]) * 0.05
    speed = told(times - delay)[0]
    place = np.cumsum(np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=1), axis=0) * 0.05
    with BagWriter(path) as bag:
        bag.write("/tf_static", builders.static_transforms(START, "base_link", {"lidar": np.eye(4)}), START)
        for i, time in enumerate(times):
            at = START + round(1e9 * time)
            if not (gap and 8.0 < time < 11.0):
                turn = Rotation.from_euler("z", heading[i]).as_quat()
                stamp = at - round(1e9 * clock)
                odometry = builders.odometry(
                    stamp, "odom", frame, [*place[i], 0], turn, [sign * speed[i], 0, 0], [0, 0, told(time - delay)[1]]
                )
                bag.write("/odom", odometry, at)
            if commands:
                bag.write("/cmd_vel", builders.twist_stamped(at, "base_link", *told(time)), at)
            if i % 4 == 0:
                bag.write("/points", builders.point_cloud(at, "lidar", np.ones((5, 3))), at)
                if camera:
                    image = builders.image(at, "camera_front", np.full((4, 6, 3), 9, np.uint8))
                    bag.write("/camera_front/image_raw", image, at)
                if camera and info:
                    calibration = builders.camera_info(at, "camera_front", 6, 4, np.diag([5.0, 5, 1]), [0] * 5)
                    bag.write("/camera_front/camera_info", calibration, at)
    return path


def said(check, level):
    return " | ".join(text for kind, text in check.findings if kind == level)


def test_a_good_bag_has_everything_and_tells_its_rates(tmp_path, husky):
    check = check_bag(write(tmp_path / "drive"), husky)
    assert check.usable
    assert not said(check, "missing")
    assert not said(check, "warning")
    assert re.search(r"motion follows commands 0\.(15|18|2.) s later", said(check, "note"))
    assert "images /camera_front/image_raw: 100, 6 × 4" in said(check, "ok")
    topics = {topic.topic: topic for topic in check.topics}
    assert topics["/odom"].rate == pytest.approx(20.0, rel=0.01)
    assert topics["/points"].rate == pytest.approx(5.0, rel=0.01)
    assert topics["/points"].frames == {"lidar"}
    text = check_text(check)
    assert "usable: predictions" in text
    assert "/cmd_vel" in text


@pytest.mark.parametrize(
    ("fault", "level", "message"),
    [
        ({"commands": False}, "missing", "record what the base controller is told"),
        ({"clock": 1.3}, "warning", r"\+1.30 s away from when it was received"),
        ({"clock": 100.0}, "missing", "do not overlap in time"),
        ({"gap": True}, "warning", "silent for 3"),
        ({"info": False}, "warning", "no CameraInfo on /camera_front/camera_info"),
        ({"frame": "imu"}, "warning", "odometry is of 'imu', the robot's base frame is 'base_link'"),
        ({"sign": -1.0}, "warning", "the other sign than its poses"),
    ],
)
def test_each_fault_is_said(tmp_path, husky, fault, level, message):
    check = check_bag(write(tmp_path / "drive", **fault), husky)
    assert re.search(message, said(check, level))
    assert check.usable == (level != "missing")


def test_the_executable_tells_by_its_status(tmp_path, executables, ros_environment, real_data):
    def run(bag):
        return subprocess.run(
            [executables / "evaluate", "--check", bag], env=ros_environment, capture_output=True, text=True,
            timeout=120, check=False,
        )  # fmt: skip

    good = run(write(tmp_path / "drive"))
    assert good.returncode == 0, good.stderr
    real = run(next((real_data / "husky_outdoor").glob("*.bag")))
    assert real.returncode == 1
    assert "MISSING  commands" in real.stdout
    nothing = run(tmp_path / "nowhere")
    assert nothing.returncode == 1
    assert "does not exist" in nothing.stderr
