"""`diagnose`: injected faults are named, estimated, added to the robot's file, and improve predictions."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from conftest import hears_interrupts
from recorded_rollout import recorded
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import ReadOptions, Recording, SmoothedMotion, smooth
from monoforce_ros.core import AngularVelocityTrack, CommandTrack, MotionTrack, WheelTrack
from monoforce_ros.discrepancy import (
    Diagnosis,
    DiagnosisSettings,
    EffectEstimate,
    Evidence,
    ParameterEstimate,
    Verdict,
    bag_diagnosis,
    cli,
    commission,
    diagnose,
    diagnose_bag,
)
from monoforce_ros.discrepancy import conclusion as conclusion_module
from monoforce_ros.discrepancy.clocks import compare_with_gyro
from monoforce_ros.discrepancy.comparison import GapRow, compare, gets_worse
from monoforce_ros.discrepancy.evidence import EvidenceWindows, subsampled, window_starts
from monoforce_ros.discrepancy.fit import first_values, fit_effects
from monoforce_ros.discrepancy.gap import noise_floor, noisy_motions, relative_motion
from monoforce_ros.discrepancy.hypothesis import Predictions, correct_measurements
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.report import effect_entry, report_content
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.terrain_evidence import supporting_terrain, terrain_uncertainty, traced_terrain
from monoforce_ros.discrepancy.wheels import compare_with_wheels
from monoforce_ros.effects.catalogue import CATALOGUE, drive_speeds, recorded_commands, recorded_motion
from monoforce_ros.evaluation.recording_evaluation import PHYSICS, evaluate_recording
from monoforce_ros.perception import FlatTerrain
from monoforce_ros.physics import State, rollout
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import RobotFileError, load_robot, robot_file
from monoforce_ros.robots.robot_copy import write_robot
from monoforce_ros.synthetic.hidden import parse_hidden
from monoforce_ros.synthetic.odometry import OdometrySettings
from monoforce_ros.synthetic.recording import RecordingSettings, record
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def simulated_recording(husky, effects, seconds=24.0):
    """A recording of our own physics with injected effects."""
    random = np.random.default_rng(4)
    robot = replace(husky, effects=effects)
    steps = round(seconds / 0.01)
    commanded = np.repeat(random.uniform([-0.2, -0.9], [0.9, 0.9], (round(seconds / 1.5), 2)), 150, axis=0)[:steps]
    speeds = drive_speeds(robot, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    terrain = TerrainMap.flat(Grid.square(2.0, 1.0))
    result = rollout(terrain, robot, speeds, State.at_rest(0.13), with_forces=False)
    motion = recorded(result, 10**9)
    commands = CommandTrack(10**9 + np.arange(steps) * 10_000_000, commanded)
    return recorded_motion(motion, robot), recorded_commands(commands, robot)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("command_delay", {"delay": 0.23}),
        ("drive_gain", {"gain": 0.87}),
        ("drive_asymmetry", {"difference": -0.12}),
        ("turning_scrub", {"track_width_factor": 1.3}),
        ("sensor_lever_arm", {"x": 0.35, "y": -0.1}),
        ("pose_clock_offset", {"offset": 0.17}),
        ("command_clock_offset", {"offset": 0.21}),
    ],
)
def test_injected_parameters_are_recovered_by_the_fit(husky, name, parameters):
    motion, commands = simulated_recording(husky, ((name, parameters),))
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    predictions = Predictions(husky, EvidenceWindows(motion, commands, starts, 2.0, SAMPLES))
    scale = np.tile([0.01, 0.01, 0.005], (4, 1))
    before = np.abs(predictions.residuals([()])[0]).mean()
    fit = fit_effects(predictions, first_values(CATALOGUE[name], husky), scale)
    for key, value in parameters.items():
        assert dict(fit.effects)[name][key] == pytest.approx(value, rel=0.05, abs=0.012)
    after = np.abs(predictions.residuals([fit.effects])[0]).mean()
    assert after < 0.2 * before
    # Finite differences show every parameter, so that it gets an interval.
    assert (np.diag(fit.covariance) > 0).all()


def test_effects_are_ranked_by_leave_one_out_loss(husky):
    injected = (("drive_asymmetry", {"difference": 0.01}), ("drive_gain", {"gain": 0.8}))
    motion, commands = simulated_recording(husky, injected)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    search = Search(
        husky, EvidenceWindows(motion, commands, starts, 2.0, SAMPLES), np.tile([0.01, 0.01, 0.005], (4, 1))
    )
    fit = search.refit(injected)
    assert search.ranked(fit) == [1, 0]
    alone = replace(fit, effects=fit.effects[:1])
    assert search.ranked(alone) == [0]


def test_batched_hypotheses_equal_single_calls(husky):
    motion, commands = simulated_recording(husky, ())
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 2.0)
    predictions = Predictions(husky, EvidenceWindows(motion, commands, starts, 2.0, SAMPLES))
    tried = [
        (),
        *(((("drive_gain", {"gain": gain}),)) for gain in (0.8, 1.1)),
        (("pose_clock_offset", {"offset": 0.1}),),
    ]
    together = predictions.residuals(tried)
    for effects, expected in zip(tried, together, strict=True):
        np.testing.assert_allclose(predictions.residuals([effects])[0], expected, atol=1e-5)
    # Nothing is injected, so the residuals are small.
    assert np.abs(together[0]).max() < 0.02


def test_measurement_effects_are_corrected(husky):
    effects = (("sensor_yaw_offset", {"angle": 0.2}), ("pose_clock_offset", {"offset": 0.3}))
    clean, commands = simulated_recording(husky, (), seconds=6.0)
    recorded = recorded_motion(clean, replace(husky, effects=effects))
    back, _ = correct_measurements(recorded, commands, effects)
    np.testing.assert_allclose(back.stamps, clean.stamps, rtol=0, atol=100)
    np.testing.assert_allclose(back.positions, clean.positions)
    turned = Rotation.from_quat(back.quaternions).inv() * Rotation.from_quat(clean.quaternions)
    assert turned.magnitude().max() < 1e-7


def with_noise(motion: MotionTrack, seed: int) -> MotionTrack:
    """Poses with noise of 1 cm and 0.5°."""
    random = np.random.default_rng(seed)
    noise = Rotation.from_rotvec(np.radians(0.5) * random.standard_normal((len(motion), 3)))
    return replace(
        motion,
        positions=motion.positions + 0.01 * random.standard_normal(motion.positions.shape),
        quaternions=(Rotation.from_quat(motion.quaternions) * noise).as_quat(),
    )


def test_the_noise_floor_is_the_error_of_a_perfect_model(husky):
    motion, commands = simulated_recording(husky, (), seconds=40.0)
    smoothed = smooth(with_noise(motion, 1))
    starts = window_starts(motion, smoothed.stretches, 2.0, 0.5)
    data = EvidenceWindows(smoothed.motion, commands, starts, 2.0, SAMPLES)
    floor = noise_floor(smoothed.motion, noisy_motions(smoothed), data)
    rms = np.sqrt((Predictions(husky, data).residuals([()])[0] ** 2).mean(axis=0))
    assert (floor[-1] < 1.5 * rms[-1]).all()
    assert (rms[-1] < 2.5 * floor[-1]).all()


def test_the_noise_floor_is_the_error_that_smoothing_leaves(husky):
    """Of known motion with noise. As much smoothing as another rule asks for misses it, here and on other motion."""
    motion, commands = simulated_recording(husky, (), seconds=60.0)
    ratios = []
    for seed in range(4):
        smoothed = smooth(with_noise(motion, seed))
        starts = window_starts(motion, smoothed.stretches, 2.0, 0.5)
        data = EvidenceWindows(smoothed.motion, commands, starts, 2.0, SAMPLES)
        error = relative_motion(smoothed.motion, data) - relative_motion(motion, replace(data, motion=motion))
        floor = noise_floor(smoothed.motion, noisy_motions(smoothed), data)
        ratios.append(floor / np.quantile(np.abs(error), 0.683, axis=0))
    assert np.exp(np.log(ratios).mean(axis=(0, 1))) == pytest.approx(1.0, abs=0.15)


def test_motion_that_is_smoothed_like_another_keeps_its_stretches(husky):
    motion, _ = simulated_recording(husky, (), seconds=6.0)
    smoothed = smooth(motion)
    again = smooth(motion, like=smoothed)
    np.testing.assert_array_equal(again.motion.positions, smoothed.motion.positions)
    np.testing.assert_array_equal(again.weights, smoothed.weights)
    far = replace(motion, positions=motion.positions + 3.0 * (np.arange(len(motion)) % 2)[:, None])
    assert len(smooth(far).stretches) > 1
    assert smooth(far, like=smoothed).stretches == smoothed.stretches
    with pytest.raises(ValueError, match="stamps"):
        smooth(replace(motion, stamps=motion.stamps + 1), like=smoothed)


@pytest.mark.parametrize("still", [True, False])
def test_insufficient_recordings_are_not_identifiable(husky, still):
    times = np.arange(0.0, 40.0, 0.05)
    stamps = (10**9 + np.rint(times * 1e9)).astype(np.int64)
    positions = np.zeros((len(times), 3))
    positions[:, 0] = 0.0 if still else 0.5 * times
    zeros = np.zeros_like(positions)
    motion = MotionTrack(stamps, positions, Rotation.identity(len(times)).as_quat(), zeros, zeros)
    commands = CommandTrack(stamps, np.tile([0.0 if still else 0.5, 0.0], (len(times), 1)))
    diagnosis = diagnose(Evidence(smooth(motion), commands), husky)
    assert diagnosis.verdict == "not_identifiable"
    assert diagnosis.effects == ()
    assert "drive" in diagnosis.advice[0] or "step the speed" in diagnosis.advice[0]


@pytest.fixture(scope="module")
def late_robot(tmp_path_factory):
    """A MuJoCo recording with a command delay of 0.3 s and the pose noise of SLAM."""
    out = tmp_path_factory.mktemp("hidden") / "drive"
    flat = TerrainSettings(flat=True)
    hidden = (parse_hidden("command_delay:0.3"),)
    settings = RecordingSettings(
        duration=45.0, seed=3, terrain=flat, camera=None, lidar=None, commands="steps",
        odometry=OdometrySettings.slam(), hidden=hidden,
    )  # fmt: skip
    record(out, settings)
    return out


@pytest.fixture(scope="module")
def late_again(tmp_path_factory):
    """The same robot on another recording: other commands and other noise."""
    out = tmp_path_factory.mktemp("hidden") / "again"
    settings = RecordingSettings(
        duration=30.0, seed=4, terrain=TerrainSettings(flat=True), camera=None, lidar=None, commands="steps",
        odometry=OdometrySettings.slam(), hidden=(parse_hidden("command_delay:0.3"),),
    )  # fmt: skip
    record(out, settings)
    return out


def test_an_injected_delay_is_named_added_and_closes_the_gap(
    late_robot, late_again, tmp_path, executables, ros_environment
):
    out = tmp_path / "report"
    done = subprocess.run(
        [executables / "diagnose", late_robot, "--out", out, "--effects", "1", "--quiet", "--held-out", late_again],
        env=ros_environment, capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "effect_found"
    effect, *others = report["effects"]
    # The robot was never commissioned: what its file misses may stay beside the delay, in a part of the recording.
    assert all(2 * other["found_again"][0] < other["found_again"][1] for other in others)
    # Commands and poses cannot distinguish a late base from a late pose clock; the gyro in the bag does.
    assert effect["name"] == "command_delay"
    assert "pose_clock_offset" not in effect["indistinguishable"]
    # The former name of the key, for one release.
    assert effect["rivals"] == effect["indistinguishable"]
    (value,) = effect["parameters"].values()
    assert value["value"] == pytest.approx(0.3, abs=0.05)
    gap = report["gap"]["position_2s"]
    assert gap["after"] < 0.5 * gap["before"]
    assert gap["low"] > 0
    assert gap["closed"] > 0.5
    held_out = report["held_out"]["again"]["position_2s"]
    assert held_out["after"] < 0.5 * held_out["before"]
    page = (out / "report.html").read_text()
    assert page.count("<img") >= 6 and "On held-out recordings" in page
    assert ("selected on these same blocks" in page) == (effect["found_again"] is None)
    assert "Effects missing in the model" in page and "data:image/png;base64" in page and "src='http" not in page
    # The written robot file loads and predicts the same recording better.
    found = load_robot(report["robot_file"])
    assert dict(found.effects)[effect["name"]]
    recording = Recording.open(late_robot)
    errors = []
    for robot in (load_robot("husky"), found):
        predictor = Predictor(robot, FlatTerrain(robot, Grid.square(), TerrainDefaults()), horizon=2.0)
        evaluation = evaluate_recording(recording, predictor, horizons=(1.0, 2.0), stride=1.0, quiet=True)
        errors.append(evaluation.summary(PHYSICS)[2.0][0].median)
    assert errors[1] < 0.5 * errors[0]


def test_without_a_discrepancy_nothing_is_added(husky):
    motion, commands = simulated_recording(husky, (), seconds=30.0)
    smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
    diagnosis = diagnose(Evidence(smoothed, commands), husky, settings=DiagnosisSettings(max_effects=1))
    assert diagnosis.verdict == "no_discrepancy"
    assert diagnosis.effects == () and diagnosis.fitted == ()


@pytest.mark.parametrize(
    ("injected", "verdict", "reason"),
    [
        (("drive_gain", {"gain": 0.8}), Verdict.NO_IMPROVEMENT, "do not decrease beyond chance"),
        (("learned_term", {"torque_z:vx|vx|": 400.0}), Verdict.UNKNOWN_EFFECT, "the formula is not added"),
    ],
)
def test_what_does_not_improve_held_out_windows_is_not_added(husky, monkeypatch, injected, verdict, reason):
    def useless(*arguments, **named):
        compared = compare(*arguments, **named)
        return [c if c.after is None else replace(c, after=1.1 * c.before) for c in compared]

    monkeypatch.setattr(conclusion_module, "compare", useless)
    motion, commands = simulated_recording(husky, (injected,), seconds=40.0)
    smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
    diagnosis = diagnose(Evidence(smoothed, commands), husky, settings=DiagnosisSettings(max_effects=1))
    assert diagnosis.verdict == verdict
    assert reason in diagnosis.remarks[-1]
    # Effects go into the robot's file, and are what a report calls "after".
    assert diagnosis.effects == () and diagnosis.fitted == ()
    report = report_content(diagnosis, {}, None)
    assert report["gap"] and all(row["after"] is None and "closed" not in row for row in report["gap"].values())
    assert all(row["position_after"] is None and row["heading_after"] is None for row in report["regimes"])
    assert all(path.after is None for path in diagnosis.details.paths)
    assert all(comparison.after is None for comparison in diagnosis.details.compared)
    assert any("drive_gain" in row.values() for row in report["candidates"])


@pytest.mark.parametrize(("as_healthy", "verdict"), [(True, "no_discrepancy"), (False, "no_improvement")])
def test_an_effect_that_predicts_nothing_is_no_discrepancy_where_errors_are_a_healthy_robots(
    husky, monkeypatch, as_healthy, verdict
):
    def useless(*arguments, **named):
        compared = compare(*arguments, **named)
        return [c if c.after is None else replace(c, after=1.1 * c.before) for c in compared]

    monkeypatch.setattr(conclusion_module, "compare", useless)
    motion, commands = simulated_recording(husky, (("drive_gain", {"gain": 0.97}),), seconds=40.0)
    evidence = Evidence(SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)), commands)
    settings = DiagnosisSettings(max_effects=1)
    residual = np.array([[0.001, 0.001, 0.001]]) * np.arange(1, 5)[:, None]
    varying = dict.fromkeys(CATALOGUE, 0.01)
    before = diagnose(evidence, husky, settings=settings, nominal=NominalModel(residual, varying, segments=5, loss=0.5))
    # By its size the error is either what this robot always has, or a tenth of it is.
    loss = before.losses.before * (1.0 if as_healthy else 0.1)
    healthy = NominalModel(residual, varying, segments=5, loss=loss, loss_spread=0.2)
    diagnosis = diagnose(evidence, husky, settings=settings, nominal=healthy)
    assert diagnosis.verdict == verdict, diagnosis.remarks
    said = (
        "on held-out windows they do not decrease with drive_gain" if as_healthy else "held-out windows do not decrease"
    )
    assert any(f"{said} beyond chance" in remark for remark in diagnosis.remarks), diagnosis.remarks
    assert diagnosis.effects == () and diagnosis.fitted == ()


@pytest.mark.parametrize(("factor", "said"), [(1.1, "increase"), (1.0, "do not decrease")])
def test_what_does_not_help_in_windows_that_no_search_saw_is_not_added(husky, monkeypatch, factor, said):
    compared = []

    def worse_when_repeated(*arguments, **named):
        found = compare(*arguments, **named)
        compared.append(found)
        return found if len(compared) == 1 else [replace(c, after=factor * c.before) for c in found]

    monkeypatch.setattr(conclusion_module, "compare", worse_when_repeated)
    motion, commands = simulated_recording(husky, (("drive_gain", {"gain": 0.8}),), seconds=40.0)
    smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
    diagnosis = diagnose(Evidence(smoothed, commands), husky, settings=DiagnosisSettings(max_effects=1))
    assert len(compared) == 2
    assert diagnosis.verdict == Verdict.NO_IMPROVEMENT and f"{said} beyond chance" in diagnosis.remarks[-1]
    assert diagnosis.effects == () and all(row.after is None for row in diagnosis.gap.values())


def test_a_diagnosis_gets_worse_where_an_error_grows_and_none_shrinks():
    def row(low: float, high: float, horizon: float = 2.0) -> GapRow:
        return GapRow(horizon, 0.5, 0.5, low, high, "m", 0.1)

    grown, shrunk, open_ = row(-0.2, -0.1), row(0.1, 0.2), row(-0.1, 0.1)
    assert gets_worse({"position_2s": grown, "heading_2s": open_, "position_1s": row(0.1, 0.2, 1.0)})
    assert not gets_worse({"position_2s": grown, "heading_2s": shrunk})
    assert not gets_worse({"position_2s": open_, "heading_2s": open_, "position_5s": row(-0.2, -0.1, 5.0)})
    assert gets_worse({"position_1s": row(-0.2, -0.1, 1.0)}) and not gets_worse({})


def test_a_verdict_without_effects_cannot_hold_any():
    row = GapRow(2.0, before=0.5, after=0.4, gain_low=-0.1, gain_high=0.2, unit="m", noise=0.1)
    effect = EffectEstimate("drive_gain", {"gain": ParameterEstimate(0.8, 0.7, 0.9, "-")})
    for held in ({"gap": {"position_2s": row}}, {"effects": (effect,)}, {"held_out": {"b": {"position_2s": row}}}):
        Diagnosis(Verdict.EFFECT_FOUND, **held)
        with pytest.raises(ValueError, match="adds no effects"):
            Diagnosis(Verdict.NO_IMPROVEMENT, **held)


def test_the_diagnosed_recording_is_not_held_out(late_again, tmp_path, capsys):
    copied = shutil.copytree(late_again, tmp_path / "copy")
    for held_out in (late_again, copied):
        status = cli.main([str(late_again), "--held-out", str(held_out), "--out", str(tmp_path / "out"), "--quiet"])
        assert status == 1
        assert "--held-out got the diagnosed recording" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_nominal_file_is_not_overwritten_and_a_stale_one_does_not_stay(late_robot, tmp_path, monkeypatch):
    nominal = tmp_path / "husky.yaml"
    nominal.write_text(robot_file("husky").read_text())
    with pytest.raises(ValueError, match="the folder of the nominal robot file husky.yaml, expected another --out"):
        diagnose_bag(late_robot, str(nominal), tmp_path)
    with pytest.raises(ValueError, match="--held-out got a path that does not exist"):
        diagnose_bag(late_robot, "husky", tmp_path / "out", held_out=[tmp_path / "nowhere"])
    # What commissioning learned must not be lost either, nor the work of a diagnosis that cannot be written.
    commissioned = tmp_path / "commissioned" / "husky.yaml"
    commissioned.parent.mkdir()
    monkeypatch.setattr(
        NominalModel, "read", classmethod(lambda cls, robot, samples: True if robot == str(commissioned) else None)
    )
    commissioned.write_text(nominal.read_text())
    with pytest.raises(ValueError, match="the folder of the commissioned file husky.yaml, expected another --out"):
        diagnose_bag(late_robot, "husky", commissioned.parent)
    # What an earlier diagnosis wrote, with the commissioning of its nominal file, may be replaced by the same again.
    (commissioned.parent / "report.json").write_text(json.dumps({"robot_file": str(commissioned)}))
    with pytest.raises(ValueError, match="--held-out got a path that does not exist"):
        diagnose_bag(late_robot, "husky", commissioned.parent, held_out=[tmp_path / "nowhere"])
    os.utime(commissioned, ns=(1 << 62, 1 << 62))
    with pytest.raises(ValueError, match="the folder of the commissioned file husky.yaml"):
        diagnose_bag(late_robot, "husky", commissioned.parent)
    os.utime(commissioned, ns=(0, 0))
    (commissioned.parent / "report.json").write_text("[]")
    with pytest.raises(ValueError, match="the folder of the commissioned file husky.yaml"):
        diagnose_bag(late_robot, "husky", commissioned.parent)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="--out cannot be made a folder"):
        diagnose_bag(late_robot, "husky", tmp_path / "file")
    # A report without an effect must not stand beside a robot file of an earlier one.
    stale = tmp_path / "out" / "husky.yaml"
    stale.parent.mkdir()
    stale.write_text(nominal.read_text())
    monkeypatch.setattr(bag_diagnosis, "diagnose", lambda *_, **__: Diagnosis(Verdict.NO_DISCREPANCY))
    assert diagnose_bag(late_robot, "husky", stale.parent).robot_file is None
    assert not stale.exists() and (stale.parent / "husky.earlier.yaml").exists() and nominal.exists()


def test_held_out_recordings_with_the_same_name_stay_apart(late_robot, late_again, tmp_path, monkeypatch):
    monkeypatch.setattr(bag_diagnosis, "diagnose", lambda *_, **__: Diagnosis(Verdict.NO_DISCREPANCY))
    first, second = (tmp_path / part / "recording" for part in ("monday", "tuesday"))
    shutil.copytree(late_again, first)
    shutil.copytree(late_again, second)
    found = diagnose_bag(late_robot, "husky", tmp_path / "out", held_out=[first, second, first, late_again])
    tables = json.loads(found.report.read_text())["held_out"]
    assert list(tables) == ["monday/recording", "tuesday/recording", "again"]
    assert all(table["position_2s"]["after"] is None for table in tables.values())


def test_a_held_out_recording_that_cannot_be_compared_is_refused_before_the_work(late_robot, tmp_path, monkeypatch):
    def unexpected(*_, **__):
        raise AssertionError("diagnosed although the held-out recording is of no use")

    monkeypatch.setattr(bag_diagnosis, "diagnose", unexpected)
    short, damaged = tmp_path / "short", tmp_path / "damaged"
    flat = TerrainSettings(flat=True)
    record(short, RecordingSettings(duration=4.0, seed=3, terrain=flat, camera=None, lidar=None))
    shutil.copytree(short, damaged)
    (damaged / "metadata.yaml").write_text("nothing: here")
    for held_out in (short, damaged):
        with pytest.raises(ValueError, match=f"{held_out}: --held-out got a recording that cannot be compared: "):
            diagnose_bag(late_robot, "husky", tmp_path / "out", held_out=[held_out])


def test_a_comparison_that_fails_late_loses_no_diagnosis(late_robot, late_again, tmp_path, monkeypatch):
    monkeypatch.setattr(bag_diagnosis, "diagnose", lambda *_, **__: Diagnosis(Verdict.NO_DISCREPANCY))

    def failing(self, effects):
        raise MemoryError("no room")

    monkeypatch.setattr(bag_diagnosis.HeldOutBag, "table", failing)
    found = diagnose_bag(late_robot, "husky", tmp_path / "out", held_out=[late_again])
    assert json.loads(found.report.read_text())["held_out"] == {}
    remark = "the held-out recording again could not be compared: no room"
    assert remark in found.diagnosis.remarks and found.doubts == ()


def test_a_driver_that_publishes_rpm_is_said_and_its_wheels_are_used(late_again, tmp_path, monkeypatch):
    class Published(ReadOptions):
        def open(self, path, robot=None):
            recording = super().open(path, robot)
            wheels = replace(recording.wheels, speeds=30.0 / np.pi * recording.wheels.speeds)
            return replace(recording, wheels=wheels)

    seen = []

    def diagnosed(evidence, *_, **__):
        seen.append(evidence.wheels)
        return Diagnosis(Verdict.NO_DISCREPANCY)

    monkeypatch.setattr(bag_diagnosis, "diagnose", diagnosed)
    found = diagnose_bag(late_again, "husky", tmp_path / "out", reading=Published())
    np.testing.assert_allclose(seen[0].speeds, Recording.open(late_again).wheels.speeds)
    assert any("they are taken for revolutions per minute" in text for text in found.complaints)
    assert "revolutions per minute" in json.loads(found.report.read_text())["inputs"]["problems of the bag"]


def test_folders_of_reports_never_coincide():
    bags = [Path(text) for text in ("a/short", "b/short.bag", "c/00_short", "d/other")]
    folders = cli.report_folders(bags)
    assert len(set(folders)) == len(bags) and folders[2:] == ["00_short", "other"]
    assert cli.report_folders([Path("a/short"), Path("b/short")]) == ["00_short", "01_short"]


@pytest.mark.parametrize("count", [1, 2])
def test_ctrl_c_ends_it_in_one_line_without_half_a_report(late_robot, late_again, tmp_path, ros_environment, count):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "monoforce_ros.discrepancy.cli", *(late_robot, late_again)[:count]]
    running = subprocess.Popen(
        [*command, "--out", out, "--quiet"], env=ros_environment, text=True, start_new_session=True,
        preexec_fn=hears_interrupts, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=Path(__file__).parents[1],
    )  # fmt: skip
    # Once folders exist the work has begun, of several bags in processes of their own.
    folder = out if count == 1 else out / late_robot.name
    for _ in range(600):
        if folder.exists():
            break
        time.sleep(0.1)
    time.sleep(2.0)
    os.killpg(running.pid, signal.SIGINT)
    _, said = running.communicate(timeout=20)
    assert running.returncode == 130
    assert said.splitlines() == ["diagnose: interrupted; reports that are listed above are complete"]
    assert [path for path in out.rglob("*") if path.is_file()] == []


def benchmark_row(injected, estimated, loss=9.0, **more):
    """A row of ``benchmarks/hidden_effects.py`` with one effect that was named as it is."""
    (name, truth), (named, values) = injected, estimated
    gap = {"horizon_s": 2.0, "before": 0.2, "after": 0.05, "noise": 0.01, "closed": 0.8}
    row = {
        "kind": "single", "verdict": "effect_found", "truth": [{"name": name, "parameters": truth}], "seconds": 9.0,
        "effects": [{"name": named, "parameters": {key: {"value": value} for key, value in values.items()}}],
        "numbers": {"loss_before": loss}, "gap": {"position_2s": gap}, "ground": "flat", "noise": "usual", "case": name,
    }  # fmt: skip
    return row | more


def test_figures_of_the_benchmark_say_what_they_are_conditional_on(tmp_path):
    import hidden_effects

    friction = benchmark_row(("friction_scale", {"factor": 0.25}), ("friction_scale", {"factor": 0.35}))
    delay = benchmark_row(("command_delay", {"delay": 0.4}), ("command_delay", {"delay": 0.42}))
    missed = benchmark_row(("drive_gain", {"gain": 0.8}), ("viscous_drag", {"coefficient": 99.0}))
    weak = benchmark_row(("drive_gain", {"gain": 0.99}), ("drive_gain", {"gain": 0.5}), loss=1.0)
    failed = missed | {"verdict": "not_identifiable", "effects": [], "numbers": {}, "gap": {}}
    found = hidden_effects.scores([friction, delay, missed, weak, failed])
    # An effect without a diagnosis is missed, and friction is part of the error.
    assert found["singles_named_first"] == {"share": 0.5, "count": 2, "of": 4}
    assert found["not_diagnosed"]["count"] == 1
    assert found["parameter_error"] == {"median": pytest.approx(0.225), "count": 2, "of": 4}
    text = hidden_effects.section([friction, delay, missed, weak, failed], found, None, tmp_path)
    assert "the 2 strong single effects that were correctly named first" in text
    assert "1 weak ones are not counted" in text
    # Rows of reports from before, and where no effect was added.
    nothing = {"before": 0.3, "after": None, "noise": 0.01}
    row = {"verdict": "no_improvement", "effects": [], "gap": {"position_2s": nothing}, "baselines": {}}
    row["baselines"] = dict.fromkeys(("refit", "network", "sindy"), 0.2)
    assert hidden_effects._baseline_scores([row])["diagnose"] == {"error": 0.3, "closed": 0.0}
    old = benchmark_row(("viscous_drag", {}), ("quadratic_drag", {}))
    old["effects"][0]["rivals"] = ["viscous_drag"]
    assert hidden_effects.named_as_other_drag(old)


def test_a_commissioned_model_predicts_the_healthy_robot(husky, tmp_path):
    injected = (
        ("friction_scale", {"factor": 0.7}),
        ("turning_scrub", {"track_width_factor": 1.2}),
        ("actuator_lag", {"time_constant": 0.15}),
    )
    motion, commands = simulated_recording(husky, injected)
    smoothed = SmoothedMotion(motion, 0.002, 0.001, (slice(0, len(motion)),))
    effects, learned = commission([Evidence(smoothed, commands)], husky)
    found = {effect.name: effect.parameters for effect in effects}
    assert found["turning_scrub"]["track_width_factor"].value == pytest.approx(1.2, rel=0.05)
    assert found["actuator_lag"]["time_constant"].value == pytest.approx(0.15, abs=0.03)
    samples = (0.5, 1.0, 1.5, 2.0)
    assert learned.residual.shape == (4, 3) and learned.segments >= 3
    assert {"drive_gain", "friction_scale", "learned_term torque_z:1"} <= set(learned.variation)
    entries = [effect_entry(effect) for effect in effects]
    file = write_robot("husky", tmp_path / "husky.yaml", entries, [tmp_path], "0", learned.entry(samples))
    read = NominalModel.read(file, samples)
    np.testing.assert_allclose(read.residual, learned.residual, rtol=1e-3)
    assert read.variation == pytest.approx(dict(learned.variation), rel=1e-3)
    assert (read.segments, read.loss) == (learned.segments, pytest.approx(learned.loss, rel=1e-3))
    assert NominalModel.read("husky", samples) is None
    nominal = load_robot(file)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    before, after = (
        np.abs(Predictions(robot, EvidenceWindows(motion, commands, starts, 2.0, SAMPLES)).residuals([()])[0]).mean()
        for robot in (husky, nominal)
    )
    assert after < 0.2 * before
    with pytest.raises(RobotFileError, match="commission the robot again"):
        NominalModel.read(file, (1.0, 2.0))
    broken = yaml.safe_load(file.read_text())
    broken["commissioning"]["variation"]["drive_gain"] = float("nan")
    file.write_text(yaml.safe_dump(broken))
    with pytest.raises(RobotFileError, match="finite numbers of 0 or more"):
        NominalModel.read(file, samples)


def test_a_gyro_distinguishes_a_late_pose_clock_from_a_late_robot(husky):
    def gyro_of(motion, bias=0.0, sign=1.0, axis=2):
        rates = np.zeros((len(motion), 3))
        rates[:, axis] = sign * motion.angular_velocities[:, 2] + bias
        return AngularVelocityTrack(motion.stamps, rates)

    clean, commands = simulated_recording(husky, (), seconds=40.0)
    late = replace(clean, stamps=clean.stamps + 230_000_000)
    smoothed = SmoothedMotion(late, 0.003, 0.002, (slice(0, len(late)),))
    found = compare_with_gyro(smoothed, gyro_of(clean))
    assert found.poses_late and found.offset == pytest.approx(0.23, abs=0.01)
    assert not found.biased()
    # The mounting of the IMU is estimated too.
    tilted = compare_with_gyro(smoothed, gyro_of(clean, sign=-1.0, axis=1))
    assert (tilted.axis, tilted.sign) == (1, -1) and tilted.offset == pytest.approx(0.23, abs=0.01)
    in_time = SmoothedMotion(clean, 0.003, 0.002, (slice(0, len(clean)),))
    biased = compare_with_gyro(in_time, gyro_of(clean, bias=0.04))
    assert not biased.poses_late
    assert biased.biased() and biased.bias == pytest.approx(0.04, abs=0.005)
    assert compare_with_gyro(in_time, None) is None
    noise = np.random.default_rng(0).standard_normal((len(clean), 3))
    assert compare_with_gyro(in_time, AngularVelocityTrack(clean.stamps, noise)) is None
    evidence = Evidence(smoothed, commands, gyro=gyro_of(clean))
    diagnosis = diagnose(evidence, husky, settings=DiagnosisSettings(max_effects=1))
    assert diagnosis.verdict == "effect_found"
    assert [effect.name for effect in diagnosis.effects] == ["pose_clock_offset"]


def wheels_of(commands, husky, effects, seconds=60.0):
    """Wheel speeds as measured by joint states, with effects between commands and wheels."""
    steps = round(seconds / 0.01)
    stamps = commands.stamps[0] + np.arange(steps) * 10_000_000
    commanded = torch.as_tensor(commands.sample(stamps)[None], dtype=torch.float32)
    # Stamps that share no multiple with those of the commands, as of two computers.
    speeds = drive_speeds(replace(husky, effects=effects), commanded, 0.01)[0, ::7].double().numpy()
    noise = np.random.default_rng(2).standard_normal(speeds.shape)
    return WheelTrack(stamps[::7], speeds / husky.wheel_radius + 0.05 * noise)


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (("command_delay", {"delay": 0.35}),),
        (("actuator_deadband", {"width": 0.1}),),
        (("command_delay", {"delay": 0.3}), ("actuator_saturation", {"limit": 0.6}),
         ("actuator_lag", {"time_constant": 0.25})),
    ],
)  # fmt: skip
def test_wheel_speeds_identify_effects_of_the_drives(husky, effects):
    random = np.random.default_rng(3)
    twists = np.repeat(random.uniform([-0.3, -1.0], [1.0, 1.0], (30, 2)), 40, axis=0)
    commands = CommandTrack(10**9 + np.arange(len(twists)) * 50_000_000, twists)
    found = compare_with_wheels(commands, wheels_of(commands, husky, effects), husky)
    assert [name for name, _ in found.effects] == [name for name, _ in effects]
    for (_, values), (_, injected) in zip(found.effects, effects, strict=True):
        for key, value in injected.items():
            assert values[key] == pytest.approx(value, rel=0.08, abs=0.02)
    assert ("late" in found.summary()) == any(name == "command_delay" for name, _ in effects)
    assert compare_with_wheels(commands, None, husky) is None
    unrelated = WheelTrack(commands.stamps, random.standard_normal((len(twists), 2)))
    assert compare_with_wheels(commands, unrelated, husky) is None


def test_long_recordings_are_subsampled_over_their_length():
    starts = np.arange(0, 3600, dtype=np.int64) * 10**9
    kept = subsampled(starts, 8.0, 120)
    assert 60 <= len(kept) <= 130
    assert kept[0] == starts[0] and kept[-1] > starts[-1] - 600 * 10**9
    # Whole pairs of blocks, so that each fold keeps its share.
    assert set(np.unique((kept // (8 * 10**9)) % 2)) == {0, 1}
    assert len(subsampled(starts[:100], 8.0, 120)) == 100


def test_the_uncertainty_of_terrain_is_zero_on_level_ground_and_grows_with_map_noise(husky):
    motion, commands = simulated_recording(husky, (), seconds=12.0)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    level = EvidenceWindows(motion, commands, starts, 2.0, SAMPLES)
    assert (terrain_uncertainty(husky, level, None) == 0).all()
    grid = Grid.square(24.0, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    hills = 0.06 * np.sin(1.5 * x) * np.cos(1.2 * y)
    # The noise is at the left only: windows there are less certain than the others.
    noise = np.where(x < motion.positions[:, 0].mean(), 0.03 * np.sin(5 * x), 0.0)
    maps = [
        TerrainMap.from_height(torch.as_tensor(height, dtype=torch.float32), grid)
        for height in (hills, hills + noise, hills - noise)
    ]
    on_map = replace(level, terrain=maps[0], odometry_from_terrain=np.eye(4))
    shape = terrain_uncertainty(husky, on_map, None)
    noisy = terrain_uncertainty(husky, on_map, (maps[1], maps[2]))
    assert shape.shape == (len(starts), 4, 3)
    assert (shape[:, -1].mean(axis=0) > 0).all() and (noisy[:, -1].mean(axis=0) > shape[:, -1].mean(axis=0)).all()


def test_the_ground_under_grass_is_traced_where_the_robot_drove(husky):
    motion, _ = simulated_recording(husky, (), seconds=12.0)
    grid = Grid.square(24.0, 0.1)
    grass = TerrainMap.from_height(torch.full((grid.rows, grid.columns), 0.3), grid)
    found = supporting_terrain(grass, motion, husky)
    rows, columns, _ = grid.cells(motion.positions[:, :2])
    under = found.height.numpy()[rows, columns]
    assert np.abs(under).max() < 0.03
    assert (found.geometric_height == 0.3).all()
    # Far from the path the visible surface stays.
    far = np.hypot(*(np.stack(np.meshgrid(grid.x, grid.y))[..., None] - motion.positions[:, :2].T[:, None, None])).min(
        axis=-1
    )
    assert (found.height.numpy()[far > 3.0] == np.float32(0.3)).all()


def test_ground_without_a_map_is_traced_along_the_poses(husky):
    grid = Grid.square(24.0, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    hills = torch.as_tensor(0.15 * np.sin(0.8 * x) * np.cos(0.6 * y), dtype=torch.float32)
    truth = TerrainMap.from_height(hills, grid)
    speeds = torch.tensor([[[0.8, 1.0]]]).repeat(1, 800, 1)
    start = State.at_rest(0.25)
    result = rollout(truth, husky, speeds, start, with_forces=False)
    stamps = np.arange(800) * 10_000_000
    rotations = Rotation.from_matrix(result.rotation[0].double().numpy())
    zeros = np.zeros((800, 3))
    motion = MotionTrack(stamps, result.position[0].double().numpy(), rotations.as_quat(), zeros, zeros)
    traced = traced_terrain(motion, husky, grid)
    rows, columns, _ = grid.cells(motion.positions[200:, :2])
    error = (traced.height - hills).numpy()[rows, columns]
    assert np.abs(error).max() < 0.06 < np.ptp(hills.numpy()[rows, columns])


@pytest.fixture(scope="module")
def pulled_robot(tmp_path_factory):
    """A MuJoCo recording with a yaw torque that grows with the square of the speed."""
    out = tmp_path_factory.mktemp("hidden") / "drive"
    settings = RecordingSettings(
        duration=45.0, seed=5, terrain=TerrainSettings(flat=True), camera=None, lidar=None, commands="steps",
        odometry=OdometrySettings.slam(), hidden=(parse_hidden("speed_pull:400"),),
    )  # fmt: skip
    record(out, settings)
    return out


def test_an_out_of_catalogue_effect_is_reported_as_unknown(pulled_robot, late_robot, tmp_path, executables,
                                                            ros_environment):  # fmt: skip
    out = tmp_path / "reports"
    # Two bags in parallel, and a third that does not exist: it does not stop the others.
    done = subprocess.run(
        [executables / "diagnose", pulled_robot, late_robot, tmp_path / "none", "--out", out, "--effects", "1",
         "--quiet"],
        env=ros_environment, capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    assert done.returncode == 1 and "1 of 3 bags failed" in done.stderr
    report = json.loads((out / "00_drive" / "report.json").read_text())
    assert report["verdict"] == "unknown_effect", done.stdout
    (effect,) = report["effects"]
    assert effect["name"] == "learned_term"
    # A torque to the left that grows with speed; 45 s do not determine its power reliably.
    assert any(key.startswith("torque_z:") and entry["value"] > 50.0 for key, entry in effect["parameters"].items())
    assert report["gap"]["heading_2s"]["after"] < 0.5 * report["gap"]["heading_2s"]["before"]
    assert json.loads((out / "01_drive" / "report.json").read_text())["verdict"] == "effect_found"


@pytest.mark.unhurried
def test_the_node_predicts_better_with_the_written_file(tmp_path, start, peer):
    """A robot with small wheels is diagnosed; a running node predicts better with the written file than without."""
    bag = tmp_path / "drive"
    settings = RecordingSettings(
        duration=40.0, seed=8, terrain=TerrainSettings(flat=True), camera=None, lidar=None, commands="steps",
        odometry=OdometrySettings.slam(), hidden=(parse_hidden("drive_gain:0.7"),),
    )  # fmt: skip
    record(bag, settings)
    found = diagnose_bag(bag, "husky", tmp_path / "report", settings=DiagnosisSettings(max_effects=1))
    assert [effect.name for effect in found.diagnosis.effects] == ["drive_gain"]
    recording = Recording.open(bag)
    runs = []
    for robot in ("husky", found.robot_file):
        peer.clear()
        node = start("predictor", "--ros-args", "-p", f"robot:={robot}", "-p", "terrain_source:=flat")
        node.wait_for("predicting 5 s ahead for husky")
        player = start("bag_player", bag, "--duration", "12")
        assert peer.until(lambda player=player: not player.running, 90.0)
        # On a busy machine the last paths arrive after the player has ended; they must not count as the next run's.
        peer.settle(1.0)
        node.stop()
        errors = {}
        for path in peer.received["/predicted/path"]:
            stamp = path.header.stamp.sec * 10**9 + path.header.stamp.nanosec
            # Where the robot was one second later; the path has a pose every tenth of a second.
            there = recording.motion.at(stamp + 10**9).position
            pose = path.poses[10].pose.position
            errors[stamp] = np.hypot(pose.x - there[0], pose.y - there[1])
        runs.append(errors)
    # A busy machine leaves predictions out, other ones in each run: predictions from the same instant are compared.
    stamps = sorted(set(runs[0]) & set(runs[1]))
    assert len(stamps) > 10, node.output[-2000:]
    before, after = (np.median([errors[stamp] for stamp in stamps]) for errors in runs)
    assert after < 0.75 * before, (before, after)


def test_errors_are_one_line(tmp_path, executables, ros_environment):
    done = subprocess.run(
        [executables / "diagnose", tmp_path / "none", "--out", tmp_path / "out"],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].startswith("diagnose: ")
