"""The benchmarks run, and the outside check against MuJoCo holds; durations decide nothing here."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT


@pytest.fixture(scope="module")
def check():
    import mujoco_check

    return mujoco_check


@pytest.fixture(scope="module")
def husky(check):
    return check.fitted_robot(1)


@pytest.mark.parametrize(
    ("roughness", "commands"), [(0.0, "straight, fast"), (0.4, "arc to the right"), (0.4, "wide arc")]
)
def test_the_rollout_follows_an_independent_engine(check, husky, roughness, commands):
    row = check.compare(husky, roughness, 2, check.COMMANDS[commands])
    assert row["distance_m"] > 2.0
    assert row["position_error_m"] < 0.25
    assert row["rotation_error_deg"] < 8.0


def test_the_rollout_benchmark_writes_its_figures(tmp_path):
    out = tmp_path / "rollout.json"
    done = subprocess.run(
        [sys.executable, "benchmarks/rollout.py", "--quick", "--backends", "warp", "--json", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    content = json.loads(out.read_text())
    assert {row["backend"] for row in content["rows"]} == {"warp"}
    assert content["kept_for_backward_b64_bytes"] > 0
    assert len(content["effects"]) == 2


def test_the_benchmark_of_joints_writes_its_ratios(tmp_path):
    out = tmp_path / "joints.json"
    done = subprocess.run(
        [sys.executable, "benchmarks/joints.py", "--quick", "--json", str(out)],
        cwd=ROOT, capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == 20 and all(row["ratio"] == row["moving_s"] / row["still_s"] for row in rows)


def test_the_encoder_benchmark_writes_its_figures(tmp_path):
    out = tmp_path / "encoder.json"
    done = subprocess.run(
        [sys.executable, "benchmarks/encoder.py", "--quick", "--threads", "1", "--json", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    figures = json.loads(out.read_text())
    cases = ("lidar sweep, 5,000 returns", "lidar sweep, 35,000 returns", "1 camera(s)", "4 camera(s)")
    assert set(figures["shipped"]) == set(cases)
    assert all(figures["shipped"][case][time] > 0.0 for case in cases for time in ("clock_ms", "processor_ms"))
    for count in (1, 4):
        row = figures[f"{count} cameras"]
        assert row["fused_ms"] > 0 and row["ratio"] > 0 and all(v > 0 for v in row["stages_ms"].values())


def test_a_minute_of_a_bag_in_a_loop_leaves_memory_and_threads_as_they_were(tmp_path):
    """Half an hour of it is a benchmark."""
    out = tmp_path / "node.json"
    done = subprocess.run(
        [sys.executable, "benchmarks/node.py", "--endurance", "1", "--json", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())["endurance"]
    samples = found["samples"]
    assert found["exit_status"] == [0, 0]
    assert all(sample["paths"] > 0 for sample in samples)
    assert samples[-1]["threads"] <= samples[0]["threads"]
    assert samples[-1]["memory_mb"] < 1.08 * samples[0]["memory_mb"]


@pytest.mark.robot
def test_latency_is_measured_between_processes(tmp_path):
    out = tmp_path / "node.json"
    done = subprocess.run(
        [sys.executable, "benchmarks/node.py", "--only", "lidar", "--seconds", "3", "--json", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(out.read_text())["rows"]
    assert row["paths"] >= 5 and 0 < row["p50_ms"] <= row["p95_ms"] <= row["p99_ms"] and row["exit_status"] == 0


def test_the_tables_of_real_drives_keep_what_was_not_run_and_say_what_is_known():
    import warthog_reports

    steps = {
        "windows": 30, "before": 2.0, "after": None, "kinematic": 0.9, "ahead": None, "reckoned": 0.5,
    }  # fmt: skip
    gap = {"position_2s": {"before": 1.0, "after": 0.5, "noise": 0.1, "low": 0.4, "high": 0.6}}
    lag = {"name": "actuator_lag", "parameters": {"time_constant": {"value": 0.31, "unit": "s"}}}
    row = {
        "ground": "asphalt", "known": "lag 0.3 s", "verdict": "effect_found", "effects": [lag], "known_parts": [],
        "gap": gap, "steps": steps, "held_out": {"other": gap}, "seconds": 60.0, "code": "abc",
        "headline": {"sentence": "Found.", "findings": []},
    }  # fmt: skip
    other = {
        "ground": "Husky, wheels in the air", "effects": [], "verdict": "not_identifiable", "gap": {}, "steps": None,
        "held_out": {}, "headline": {"sentence": "Not diagnosed.", "findings": ["the wheels turn (at 3 rad/s)"]},
    }  # fmt: skip
    before = warthog_reports.section([row | other])
    text = warthog_reports.section([row], before)
    assert (
        text.count("\n| Husky, wheels in the air | lag 0.3 s | `not_identifiable`. Not diagnosed. | the wheels turn |")
        == 1
    )
    whole = next(line for line in text.splitlines() if line.startswith("| asphalt | lag"))
    assert "`actuator_lag` 0.31 s | 1.00 → 0.50 | – | – | 60 s | abc |" in whole
    assert "\n| asphalt | 30 | 2.00 m | – | 0.90 m | – | 0.50 m |" in text
    assert "- Effects found on asphalt, on the held-out recording `other`" in text
    # Nothing run, nothing changed.
    assert warthog_reports.section([], text) == text
    files = [drive.file for drive in warthog_reports.DRIVES]
    assert len(set(files)) == len(files)


def test_every_real_drive_is_there_where_the_data_are():
    import warthog_reports

    data = Path(os.environ.get("MONOFORCE_REAL_DATA", ROOT.parent / "shared" / "data"))
    if not (data / "drive").exists():
        pytest.skip(f"no real drives in {data}")
    for drive in warthog_reports.DRIVES:
        for name in (drive.file, *drive.held_out):
            assert (data / name).exists(), name
    bags = {folder.name for folder in (data / "doughnut").iterdir() if folder.is_dir()}
    assert bags <= {Path(drive.file).name for drive in warthog_reports.DRIVES}


def test_a_repeated_drive_goes_on_where_it_ended(tmp_path, demo_bag):
    import long_recording
    import numpy as np

    from monoforce_ros.bags import Recording

    once = Recording.open(demo_bag)
    length = float(once.motion.stamps[-1] - once.motion.stamps[0]) * 1e-9
    long_recording.repeat(demo_bag, 2.5 * length, tmp_path / "long")
    found = Recording.open(tmp_path / "long")
    assert (found.motion.stamps[-1] - found.motion.stamps[0]) * 1e-9 == pytest.approx(2.5 * length, abs=0.2)
    assert len(found.commands) > 2.2 * len(once.commands)
    count = len(once.motion)
    moved = np.linalg.norm(np.diff(found.motion.positions, axis=0), axis=1)
    # The second drive begins where the first one ended, and moves as it did.
    assert moved[count - 1] < 1e-6 and np.diff(found.motion.stamps)[count - 1] == long_recording.PAUSE
    np.testing.assert_allclose(moved[count : 2 * count - 1], moved[: count - 1], atol=1e-6)
