"""The evaluation: metrics in closed form, and the installed command on a recorded drive."""

import json
import subprocess

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, builders
from monoforce_ros.core import MotionState
from monoforce_ros.evaluation.metrics import Poses, bootstrap_interval, position_errors, rotation_errors, summarise
from monoforce_ros.evaluation.recording_evaluation import constant_velocity


def test_errors_are_metres_and_degrees():
    turn = Rotation.from_euler("z", [[0.0], [30.0]], degrees=True).as_matrix()
    measured = Poses(np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))
    predicted = Poses(np.array([[0, 0, 0], [3.0, 4.0, 0]]), turn)
    np.testing.assert_allclose(position_errors(predicted, measured), [0, 5])
    np.testing.assert_allclose(rotation_errors(predicted, measured), [0, 30], atol=1e-9)


def test_a_summary_counts_only_windows_that_stay_on_the_map_and_are_measured():
    errors = np.array([[0, 1, 2.0], [0, 2, 4.0], [0, 9, np.nan], [0, 100, 100.0]])
    usable = np.ones((4, 3), bool)
    usable[3, 1] = False
    summary = summarise(errors, usable, 2)
    assert (summary.windows, summary.mean, summary.median) == (2, 3.0, 3.0)
    assert summary.mean_along == pytest.approx(np.mean([1, 2, 2, 4]))
    assert summarise(errors, usable, 1).windows == 3
    assert summarise(errors, np.zeros((4, 3), bool), 1).windows == 0


def test_the_interval_of_a_mean_covers_it():
    generator = np.random.default_rng(5)
    hits = 0
    for _ in range(60):
        low, high = bootstrap_interval(generator.normal(2.0, 1.0, 60))
        hits += low <= 2.0 <= high
    assert hits >= 50


@pytest.mark.parametrize("rate", [0.0, 0.7])
def test_the_baseline_follows_an_arc(rate):
    times = np.linspace(0, 3, 31)
    start = Rotation.from_euler("z", 0.4).as_matrix()
    state = MotionState(0, np.array([1.0, 2.0, 3.0]), start, np.array([1.5, 0, 0]), np.array([0, 0, rate]))
    poses = constant_velocity(state, times)
    fine = np.linspace(0, 3, 30_001)
    heading = 0.4 + rate * fine
    x = 1.0 + np.trapezoid(1.5 * np.cos(heading), fine)
    y = 2.0 + np.trapezoid(1.5 * np.sin(heading), fine)
    np.testing.assert_allclose(poses.positions[-1], [x, y, 3.0], atol=1e-6)
    assert np.arctan2(poses.rotations[-1, 1, 0], poses.rotations[-1, 0, 0]) == pytest.approx(heading[-1])


@pytest.fixture(scope="module")
def report(executables, demo_bag, tmp_path_factory):
    out = tmp_path_factory.mktemp("evaluation")
    done = subprocess.run(
        [str(executables / "evaluate"), str(demo_bag), "--out", str(out), "--stride", "0.8", "--quiet"],
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    return out, json.loads((out / "report.json").read_text()), done.stdout


def test_the_report_compares_with_the_baseline_at_every_horizon(report):
    _, content, printed = report
    assert set(content["methods"]) == {"physics", "physics, flat ground", "constant velocity, flat ground"}
    for rows in content["methods"].values():
        assert set(rows) == {"1", "2", "5"}
        assert rows["1"]["position_error_m"]["windows"] >= 10
        assert rows["5"]["rotation_error_deg"]["mean"] > 0
    assert "Δx 5 s [m]" in printed and "report.html" in printed


def test_physics_beats_constant_velocity_on_the_demo_drive(report):
    methods = report[1]["methods"]
    for horizon in ("2", "5"):
        physics = methods["physics"][horizon]["position_error_m"]["mean"]
        assert physics < methods["constant velocity, flat ground"][horizon]["position_error_m"]["mean"]


def test_the_page_is_self_contained(report):
    page = (report[0] / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4
    assert 'src="http' not in page and "<script" not in page and "<link" not in page
    assert (report[0] / "prediction_typical.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "does not exist"),
        (["{bag}", "--terrain", "camera", "--checkpoint", "/nowhere/encoder.safetensors"], "does not exist"),
        (["{bag}", "--robot", "huskey"], "no robot named"),
        (["{bag}", "--cloud", "/odom"], "topic /odom is nav_msgs/msg/Odometry, expected sensor_msgs"),
    ],
)
def test_errors_are_one_line(executables, demo_bag, tmp_path, arguments, message):
    words = [str(demo_bag) if word == "{bag}" else word for word in arguments]
    done = subprocess.run(
        [str(executables / "evaluate"), *words, "--out", str(tmp_path)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert message in done.stderr and done.stderr.count("\n") == 1 and done.stderr.startswith("error: ")


def test_a_bag_without_camera_info_or_clouds_says_what_it_lacks(executables, tmp_path):
    with BagWriter(tmp_path / "drive") as bag:
        for i in range(100):
            at = 10**18 + i * 20_000_000
            bag.write(
                "/odom", builders.odometry(at, "odom", "base_link", [0, 0, 0], [0, 0, 0, 1], [0] * 3, [0] * 3), at
            )
            bag.write("/cmd_vel", builders.twist(0.0, 0.0), at)
    done = subprocess.run(
        [str(executables / "evaluate"), str(tmp_path / "drive"), "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert "no point clouds to predict from; with `--terrain flat`" in done.stderr
    done = subprocess.run(
        [str(executables / "evaluate"), str(tmp_path / "drive"), "--terrain", "flat", "--horizons", "0.5", "1",
         "--out", str(tmp_path / "out"), "--quiet"],
        capture_output=True,
        text=True,
        timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out" / "report.json").read_text())
    assert content["methods"]["physics"]["1"]["position_error_m"]["mean"] < 0.01
