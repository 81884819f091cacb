"""The evaluation: metrics in closed form, and the installed command on a recording."""

import json
import re
import subprocess

import numpy as np
import pytest
from conftest import ROOT
from matplotlib.collections import PathCollection
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation
from test_training_guards import camera_bag

from monoforce_ros.bags import BagWriter, Recording, builders, observe
from monoforce_ros.bags.recorded_observation import MAXIMUM_SPREAD
from monoforce_ros.core import MotionState
from monoforce_ros.evaluation import evaluate_recording
from monoforce_ros.evaluation.cli import main
from monoforce_ros.evaluation.figures import prediction_figure
from monoforce_ros.evaluation.metrics import Poses, bootstrap_interval, position_errors, rotation_errors, summarise
from monoforce_ros.evaluation.recording_evaluation import constant_velocity
from monoforce_ros.evaluation.report import summary_table
from monoforce_ros.evaluation.view import LARGEST_DRAWN_FORCE, PredictionView
from monoforce_ros.perception import choose_terrain_source
from monoforce_ros.prediction import Predictor
from monoforce_ros.reporting import card, definition_list, folded_list, page, write_between
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap


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


def test_forces_that_would_cover_the_picture_are_shortened_in_their_direction():
    forces = np.array([[0.0, 0.0, 0.25], [30.0, 0.0, -40.0], [0.0, 0.0, 0.0]])
    map_, eye = TerrainMap.flat(Grid.square(2.0, 0.5)), np.eye(3)[None]
    still = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    view = PredictionView(still, map_, np.zeros(1), np.zeros((1, 3)), eye, np.zeros((3, 3)), forces)
    expected = [[0.0, 0.0, 0.25], [0.6 * LARGEST_DRAWN_FORCE, 0.0, -0.8 * LARGEST_DRAWN_FORCE], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(view.drawn_forces, expected)
    robot = load_robot("husky")
    (above, *_) = prediction_figure(view, robot).axes
    scattered = (found for found in above.collections if isinstance(found, PathCollection))
    (dots,) = (found for found in scattered if len(found.get_offsets()) == len(forces))
    assert dots.get_sizes().max() <= 260 * LARGEST_DRAWN_FORCE + 1e-6


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
    x = 1.0 + trapezoid(1.5 * np.cos(heading), fine)
    y = 2.0 + trapezoid(1.5 * np.sin(heading), fine)
    np.testing.assert_allclose(poses.positions[-1], [x, y, 3.0], atol=1e-6)
    assert np.arctan2(poses.rotations[-1, 1, 0], poses.rotations[-1, 0, 0]) == pytest.approx(heading[-1])


@pytest.fixture(scope="module")
def report(executables, demo_bag, tmp_path_factory):
    out = tmp_path_factory.mktemp("evaluation")
    done = subprocess.run(
        [str(executables / "evaluate"), str(demo_bag), "--out", str(out), "--quiet"],
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    return out, json.loads((out / "report.json").read_text()), done.stdout


def test_the_report_compares_with_the_baseline_at_every_horizon(report):
    _, content, printed = report
    assert list(content["methods"]) == [
        "physics", "physics, confirmed terrain", "physics, flat ground", "constant velocity, flat ground"
    ]  # fmt: skip
    for rows in content["methods"].values():
        assert set(rows) == {"1", "2", "5"}
        assert rows["1"]["position_error_m"]["windows"] >= 10
        assert rows["5"]["rotation_error_deg"]["mean"] > 0
    assert "Δx 5 s [m]" in printed and "report.html" in printed


def test_the_readme_states_the_errors_of_the_bundled_recording(report):
    """Of today's physics, as far as the last digit and other processors allow."""
    text = (ROOT / "README.md").read_text()
    rows = {
        "physics on lidar terrain": "physics",
        "physics on flat ground": "physics, flat ground",
        "constant velocity, flat ground": "constant velocity, flat ground",
    }
    for row, method in rows.items():
        cells = text.split(f"| {row} | ")[1].split("\n")[0].split(" | ")
        stated = [float(re.match(r"[\d.]+", cell).group()) for cell in cells]
        columns = [(name, h) for name in ("position_error_m", "rotation_error_deg") for h in ("1", "2", "5")]
        measured = [report[1]["methods"][method][h][name]["median"] for name, h in columns]
        np.testing.assert_allclose(stated, measured, rtol=0.15, atol=0.03, err_msg=row)


def test_physics_beats_constant_velocity_on_the_demo_recording(report):
    methods = report[1]["methods"]
    for horizon in ("2", "5"):
        physics = methods["physics"][horizon]["position_error_m"]["mean"]
        assert physics < methods["constant velocity, flat ground"][horizon]["position_error_m"]["mean"]


def test_terrain_that_the_ground_contradicts_is_not_counted_as_confirmed(demo_bag):
    husky = load_robot("husky")
    recording = Recording.open(demo_bag).in_base_frame(husky.base_frame)

    def errors(source):
        found = evaluate_recording(
            recording, Predictor(husky, source, horizon=2.0), image_topics=tuple(recording.images), horizons=(1.0, 2.0),
            stride=0.6, quiet=True,
        )  # fmt: skip
        return {method: rows[2.0][0].mean for method, rows in summary_table(found).items()}

    alone = errors(choose_terrain_source("camera", husky))
    trusted = errors(choose_terrain_source("camera", husky, fallback=True))
    # The encoder's own terrain is judged as without a fallback, and beside it what the node publishes.
    assert trusted.pop("physics, confirmed terrain") == pytest.approx(trusted["physics, flat ground"], rel=0.05)
    assert trusted == pytest.approx(alone)


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


def test_missing_sensor_data_of_a_bag_is_named(executables, tmp_path):
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
    assert "no point clouds to predict from; `--terrain flat`" in done.stderr
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


def test_images_further_from_the_stamp_than_the_limit_are_left_out(tmp_path):
    robot, start = load_robot("husky"), 10**18
    with BagWriter(tmp_path / "recording") as bag:
        for i in range(100):
            at = start + i * 20_000_000
            bag.write(
                "/odom", builders.odometry(at, "odom", "base_link", [0, 0, 0], [0, 0, 0, 1], [0] * 3, [0] * 3), at
            )
            bag.write("/cmd_vel", builders.twist(0.0, 0.0), at)
        bag.write("/points", builders.point_cloud(start, "lidar", np.ones((5, 3))), start)
        image = builders.image(start, "camera_front", np.full((4, 6, 3), 9, np.uint8))
        bag.write("/camera_front/image_raw", image, start)
        calibration = builders.camera_info(
            start, "camera_front", 6, 4, [[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]], [0] * 5
        )
        bag.write("/camera_front/camera_info", calibration, start)
    recording = Recording.open(tmp_path / "recording")
    topics = ("/camera_front/image_raw",)
    near, far = (start + round(share * MAXIMUM_SPREAD * 1e9) for share in (0.9, 1.5))
    both = observe(recording, robot, near, ("lidar", "camera"), topics)
    assert both.cloud is not None and list(both.images) == list(topics)
    neither = observe(recording, robot, far, ("lidar", "camera"), topics)
    assert neither.cloud is None and not neither.images
    # A cloud that is not combined with images may be as old as the only one is.
    assert observe(recording, robot, far, ("lidar",)).cloud is not None


def test_a_camera_that_dies_or_has_no_pose_ends_no_evaluation(tmp_path, capsys):
    cameras = {
        "first": {"times": np.arange(0.0, 6.0, 0.1)}, "second": {}, "third": {"mounted": False},
        "again": {"of": "second", "name": "/second/image_raw/compressed"},
    }  # fmt: skip
    bag = camera_bag(tmp_path / "bag", **cameras)
    arguments = ["--terrain", "camera", "--horizons", "1", "--stride", "2", "--quiet", "--out", str(tmp_path / "out")]
    assert main([str(bag), *arguments]) == 0
    said = capsys.readouterr().err
    assert "/third/image_raw is left out: " in said and "the pose of frame 'third' on the robot is unknown" in said
    assert "/second/image_raw/compressed is left out: of the same camera as /second/image_raw" in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    # Every 2 s of 16 s, less the horizon.
    assert report["windows"] == 8 and any("/third/image_raw is left out" in remark for remark in report["remarks"])


def test_the_former_name_of_the_retention_time_works_and_warns(demo_bag, capsys):
    for option in ("--memory", "--retention-time"):
        with pytest.raises(SystemExit):
            main([str(demo_bag), option, "700"])
        stderr = capsys.readouterr().err
        assert "--retention-time: got 700.0, expected 0 to 600 s" in stderr
        assert ("warning: --memory is deprecated and will be removed; use --retention-time" in stderr) == (
            option == "--memory"
        )


def test_pages_escape_plain_text():
    text = page(
        "a < b", card(definition_list({"<key>": "<b>"}) + folded_list("two & more", ["x > y"]), caption="1 < 2")
    )
    assert "<title>a &lt; b</title>" in text and "<h1>a &lt; b</h1>" in text
    assert "<dt>&lt;key&gt;</dt><dd>&lt;b&gt;</dd>" in text and "<li>x &gt; y</li>" in text and "1 &lt; 2" in text
    assert folded_list("nothing", []) == ""


def test_a_section_of_a_document_is_replaced_between_its_comments(tmp_path):
    document = tmp_path / "page.md"
    document.write_text("before\n<!-- results -->\nold\n<!-- end of results -->\nafter\n")
    write_between(document, "results", "\nnew\n\n")
    assert document.read_text() == "before\n<!-- results -->\nnew\n<!-- end of results -->\nafter\n"
    with pytest.raises(ValueError, match="expected the comments <!-- other -->"):
        write_between(document, "other", "new")
    document.write_text(document.read_text() * 2)
    with pytest.raises(ValueError, match="once each"):
        write_between(document, "results", "new")
