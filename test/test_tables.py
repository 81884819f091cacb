"""Tables of terrain sources: means, ratios and their intervals, and the installed executable on a bag."""

import json
import subprocess

import numpy as np
import pytest
import torch

from monoforce_ros.bags import Recording
from monoforce_ros.encoder import EncoderConfig, load_encoder, new_encoder, save_encoder
from monoforce_ros.evaluation.metrics import Poses
from monoforce_ros.evaluation.recording_evaluation import PHYSICS, RecordingEvaluation, evaluate_recording, predict_at
from monoforce_ros.evaluation.tables import FLAT, LIDAR, _sequence, evaluate_sequence, mean_over, ratio_over
from monoforce_ros.perception import EncoderTerrain
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot


def straight(away: float, speed: float = 2.0, windows: int = 2) -> RecordingEvaluation:
    """Windows of 5 s straight ahead, predicted ``away`` metres to the side."""
    times = np.arange(51) * 0.1
    measured = np.zeros((windows, 51, 3))
    measured[..., 0] = speed * times
    level = np.broadcast_to(np.eye(3), (windows, 51, 3, 3)).copy()
    predicted = measured + np.array([0.0, away, 0.0])
    return RecordingEvaluation(
        times=times,
        stamps=np.arange(windows),
        measured=Poses(measured, level),
        predicted={PHYSICS: Poses(predicted, level)},
        inside=np.ones((windows, 51), bool),
        horizons=(5.0,),
    )


def test_errors_count_as_long_as_the_measured_robot_is_on_the_map():
    # At 2 m/s the map's edge, 6.4 m away, is reached after 3.2 s; what comes after does not count.
    evaluation = straight(0.3)
    evaluation.predicted[PHYSICS].positions[:, 33:, 1] += 100.0
    errors = _sequence("drive", evaluation, PHYSICS, np.array([True, True]))
    assert errors.position == pytest.approx(0.3) and errors.rotation == pytest.approx(0.0) and errors.windows == 2
    # The start is the same for all and does not enter the mean; neither does a window that is not selected.
    evaluation.predicted[PHYSICS].positions[1] += 50.0
    assert _sequence("drive", evaluation, PHYSICS, np.array([True, False])).position == pytest.approx(0.3)
    # A robot that leaves the map at once provides no poses to compare.
    assert np.isnan(_sequence("drive", straight(0.3, speed=40.0), PHYSICS, np.array([True, True])).position)


def test_means_and_ratios_are_over_recordings():
    mean = mean_over([1.0, 2.0, 3.0, float("nan")])
    assert mean.value == 2.0 and 1.0 <= mean.low < 2.0 < mean.high <= 3.0
    # Recordings differ more than systems do: with paired resampling, the ratio is nevertheless certain.
    ratio = ratio_over([0.5, 5.0, 50.0], [1.0, 10.0, 100.0])
    assert ratio.value == ratio.low == ratio.high == 0.5
    assert np.isnan(mean_over([]).value) and np.isnan(ratio_over([], []).value)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    torch.manual_seed(0)
    for sensor in ("camera", "lidar"):
        config = EncoderConfig(sensor=sensor, image_width=128, image_height=96, resolution=0.2)
        encoder = new_encoder(config)
        # Untrained heads predict level ground.
        with torch.no_grad():
            encoder.heads.weight.normal_(0.0, 0.02)
        save_encoder(encoder, folder / f"{sensor}.safetensors")
    return folder


def test_the_map_of_one_window_does_not_depend_on_the_windows_before(demo_bag):
    robot = load_robot("husky")
    recording = Recording.open(demo_bag, robot=robot).in_base_frame(robot.base_frame)
    source = EncoderTerrain(load_encoder(""), robot)
    maps = {}

    class Remembering:
        sensors, grid = source.sensors, source.grid

        def terrain(self, observation, motion):
            maps[observation.stamp] = source.terrain(observation, motion)
            return maps[observation.stamp]

    predictor = Predictor(robot, Remembering(), horizon=2.0)
    topics = tuple(recording.images)
    found = evaluate_recording(recording, predictor, image_topics=topics, horizons=(2.0,), stride=2.0, quiet=True)
    last = int(found.stamps[-1])
    # A source that saw none of them knows the ground driven over, too.
    fresh = Predictor(robot, EncoderTerrain(load_encoder(""), robot), horizon=2.0)
    alone = predict_at(recording, fresh, last, topics)
    assert len(maps) >= 3 and torch.allclose(alone.terrain.height, maps[last].height, atol=1e-5)
    assert np.allclose(alone.positions()[:: round(0.1 / fresh.options.time_step)],
                       found.predicted[PHYSICS].positions[-1], atol=1e-4)  # fmt: skip


def test_the_executable_writes_json_markdown_and_html(executables, demo_bag, checkpoints, tmp_path):
    docs = tmp_path / "page.md"
    docs.write_text("before\n<!-- tables -->\nold\n<!-- end of tables -->\nafter\n")
    done = subprocess.run(
        [
            executables / "evaluate", "--tables", "--grass", demo_bag, "--lss", checkpoints / "camera.safetensors",
            "--lidar-network", checkpoints / "lidar.safetensors", "--out", tmp_path / "out", "--docs", docs,
            "--jobs", "1", "--quiet",
        ],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "out" / "tables.json").read_text())["grass"]
    assert found["recordings"] == found["drives"] == 1 and found["windows"] >= 5
    assert set(found["systems"]) == {"lidar", "lss", "lidar_network", "flat", "constant"}
    # The same numbers as computed directly, and all different.
    direct = evaluate_sequence(demo_bag, load_robot("husky"), [LIDAR, FLAT])
    near, far = (direct["flat"].by_distance[name] for name in ("0 to 1 m", "2.5 to 6.4 m"))
    assert near < far and direct["flat"].worst_position > direct["flat"].position and direct["flat"].worst
    for key in ("lidar", "flat"):
        value = found["systems"][key]["position"]["value"]
        assert value == pytest.approx(direct[key].position, rel=0.05)
    values = [entry["position"]["value"] for entry in found["systems"].values()]
    assert len({round(v, 9) for v in values}) == 5 and all(np.isfinite(values))
    page = (tmp_path / "out" / "tables.html").read_text()
    assert "data:image/png;base64" in page and "LSS [9]" in page and "http" not in page.split("</style>")[1]
    text = docs.read_text()
    assert text.startswith("before\n<!-- tables -->") and "old" not in text and text.endswith("tables -->\nafter\n")
    assert "| images | images → H_g, LSS [9] |" in text


def test_errors_are_reported_in_one_line(executables, demo_bag, tmp_path):
    def run(*arguments):
        return subprocess.run(
            [executables / "evaluate", "--tables", *arguments, "--out", tmp_path],
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip

    missing = run("--rigid", tmp_path / "no")
    assert missing.returncode == 1 and "does not exist" in missing.stderr and "Traceback" not in missing.stderr
    assert run().returncode == 2
    wrong = run("--rigid", demo_bag, "--lss", tmp_path / "no.safetensors")
    assert wrong.returncode == 1 and "no.safetensors does not exist" in wrong.stderr


@pytest.mark.parametrize("spreads", [(0.0, 0.0), (0.1, 0.1), (0.2, 0.2), (0.2, 0.0)])
def test_intervals_of_ratios_hold_the_truth_with_three_training_seeds(spreads):
    """Worlds and training seeds differ by random factors; 95 % of intervals are to hold the ratio of 0.8."""
    random = np.random.default_rng(5)
    held = []
    for _ in range(200):
        worlds = random.lognormal(0.0, 0.6, (40, 1))
        first, second = (
            ratio * worlds * random.lognormal(0.0, 0.15, (40, 3)) * random.lognormal(0.0, spread, (1, 3))
            for ratio, spread in zip((0.8, 1.0), spreads, strict=True)
        )
        found = ratio_over(first, second)
        held.append(found.low <= 0.8 <= found.high)
    # Of 200 intervals at 95 %, fewer than 183 hold the truth by chance in 1 of 50 cases.
    assert np.mean(held) >= 0.915


def test_a_ratio_does_not_depend_on_the_order_of_training_seeds():
    values = np.array([[1.0, 2.0, 3.0]] * 8) * np.linspace(1, 2, 8)[:, None]
    found, permuted = ratio_over(values, values), ratio_over(values, values[:, [2, 0, 1]])
    assert found == permuted and found.low < 0.6 and found.high > 1.6
