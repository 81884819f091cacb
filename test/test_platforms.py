"""The independent benchmark of diagnose: drawn platforms, injected effects, recordings and scores."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import null_rates
import numpy as np
import pytest
import run as platforms_run
import uncovered_changes
import yaml
from benchmark_case import SETS, Case, all_cases
from benchmark_score import closed_share, covered, found_all, healthy_errors, scores, true_value
from case_recording import CaseFiles, displacement, hidden_job, record_platform, record_together
from command_faults import DeadBand, Delay, DriveFactors, Lag, TwistLimits
from diagnosis_run import Judged, commission_platform, commissioned_file, diagnose_case
from drawn_platform import draw_platform, write_robot_file
from drive_commands import FollowingDriver, LeadingDriver, ManoeuvreDriver, ReplayedCommands
from drive_session import DriveJob
from force_faults import BodyForce, Drag, RollingResistance
from ground_shape import Ground, draw_hills, write_map
from hidden_effect import KINDS, OUTSIDE, SINGLES, HiddenEffect, draw_effect
from injection import TICK, BaseState, Injection, Measurement
from method_table import METHODS, ablation_table, baseline_table
from mujoco_engine import simulate
from reporting_ledger import LEDGER, add_to_ledger, read_ledger, reported_before
from scipy.spatial.transform import Rotation
from sensor_recording import measured_poses
from true_effects import measured, summary

from monoforce_ros.bags import Recording
from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.discrepancy.evidence import EvidenceWindows
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import TerrainDefaults, load_terrain

ROOT = Path(__file__).resolve().parent.parent


def straight(platform, *injections, seconds=4.0, speed=0.5, rate=0.0, ground=Ground()):
    commands = np.tile([speed * platform.maximum_speed, rate * platform.maximum_yaw_rate], (round(seconds * 20) + 1, 1))
    return simulate(DriveJob(platform, ground, ReplayedCommands(commands), tuple(injections), seconds))


def test_platforms_are_drawn_within_their_ranges_and_their_files_load(tmp_path):
    for seed in range(40):
        platform = draw_platform(seed)
        assert 20 <= platform.mass <= 600
        assert 0.3 <= platform.friction <= 1.0
        assert 5 <= platform.poses.rate <= 50
        model = load_robot(write_robot_file(platform, tmp_path / "platform.yaml"))
        assert float(model.mass) == pytest.approx(platform.mass, rel=0.031)
        assert float(model.drive_offsets.max()) * 2 == pytest.approx(platform.track, rel=0.031)
        assert model.wheel_radius == pytest.approx(platform.radius, rel=0.031)
        wheels = platform.wheel_centres
        assert np.diff(np.sort(wheels[: platform.axles, 0])).min() > 2 * platform.radius


def test_sets_have_different_platforms_and_the_counts_that_the_benchmark_promises():
    seeds = {name: {case.platform_seed for case in all_cases(name)} for name in SETS}
    assert not seeds["choosing"] & seeds["reporting"]
    cases = all_cases("reporting")
    counts = {kind: sum(case.kind == kind for case in cases) for kind in ("empty", "single", "pair", "outside")}
    assert counts["empty"] >= 200
    assert counts["single"] >= 200
    assert counts["pair"] >= 60
    assert counts["outside"] >= 60
    assert len({effect for case in cases if case.kind == "outside" for effect in case.effects}) >= 8
    for engine in ("mujoco", "newton"):
        assert {e for case in cases if (case.kind, case.engine) == ("single", engine) for e in case.effects} == set(
            SINGLES
        )
    assert len({case.name for case in cases}) == len(cases)
    worlds = [case for case in cases if case.engine == "worlds"]
    assert {case.ground for case in worlds} == {"mixed", "rigid", "grass", "yard", "bare"}
    assert all(case.kind == "empty" for case in worlds)


def test_a_healthy_platform_drives_as_commanded():
    platform = draw_platform(1)
    trace = straight(platform)
    assert trace.mishap is None
    expected = 0.5 * platform.maximum_speed * platform.radius / platform.controller_radius
    assert trace.velocities[-1, 0] == pytest.approx(expected, rel=0.05)
    assert abs(trace.positions[0, 2] - trace.positions[-1, 2]) < 0.01
    turning = straight(platform, speed=0.0, rate=0.8)
    assert 0.1 < turning.rates[-1, 2] / (0.8 * platform.maximum_yaw_rate) < 1.1


def test_faults_act_in_the_engine():
    platform = draw_platform(1)
    healthy = straight(platform).positions[-1, 0]
    assert straight(platform, DriveFactors(left=0.5, right=0.5)).positions[-1, 0] < 0.6 * healthy
    assert straight(platform, Delay(delay=1.0)).positions[-1, 0] < healthy - 0.35 * platform.maximum_speed
    assert straight(platform, Drag(coulomb=2.0 * platform.friction * platform.mass * 9.81)).positions[-1, 0] < 0.2
    weight = platform.mass * 9.81
    # Below the limit of friction a robot creeps, above it slides.
    creeping, sliding = (straight(platform, BodyForce(y=share * platform.friction * weight)) for share in (0.9, 1.2))
    assert 0.01 < creeping.positions[-1, 1] < 0.2
    assert sliding.positions[-1, 1] > 1.0
    unbalanced = straight(platform, DriveFactors(left=0.7, right=1.0))
    assert unbalanced.rates[-1, 2] > 0.02


def test_an_effect_with_an_onset_changes_nothing_before_it():
    platform = draw_platform(1)
    late = DriveFactors(onset=2.0, left=0.3, right=0.3)
    trace, healthy = straight(platform, late), straight(platform)
    first = round(2.0 / TICK)
    np.testing.assert_array_equal(trace.positions[:first], healthy.positions[:first])
    assert trace.positions[-1, 0] < healthy.positions[-1, 0] - 0.1


def test_command_faults_follow_their_formulas():
    limits = TwistLimits(yaw_rate=0.5, acceleration=1.0, yaw_acceleration=2.0)
    twists = np.array([limits.twist(0.0, np.array([1.0, 1.0])) for _ in range(50)])
    np.testing.assert_allclose(twists[-1], [0.5, 0.5])
    np.testing.assert_allclose(twists[9], [0.1, 0.2])
    np.testing.assert_allclose(DeadBand(width=0.1).drives(0.0, np.array([0.05, -0.3])), [0.0, -0.2])
    lag = Lag(time_constant=0.2)
    lag.drives(0.0, np.zeros(2))
    for _ in range(20):
        speeds = lag.drives(0.0, np.ones(2))
    np.testing.assert_allclose(speeds, 1 - np.exp(-1.0))


def test_rolling_resistance_brakes_wheels_and_so_turns_on_the_spot_too():
    wheels = np.array([[0.3, 0.25, -0.1], [0.3, -0.25, -0.1], [-0.3, 0.25, -0.1], [-0.3, -0.25, -0.1]])
    resistance = RollingResistance(force=10.0, wheels=wheels, centre=np.array([0.0, 0.0, 0.1]))

    def at(speed, rate):
        return resistance.wrench(
            1.0, BaseState(np.zeros(3), np.eye(3), np.array([speed, 0.0, 0.0]), np.array([0.0, 0.0, rate]), np.ones(4))
        )

    force, torque = at(0.5, 0.0)
    np.testing.assert_allclose(force, [-40.0, 0.0, 0.0], atol=1e-9)
    # It acts at the ground, 0.2 m below the centre of mass: the nose goes down.
    np.testing.assert_allclose(torque, [0.0, 8.0, 0.0], atol=1e-9)
    force, torque = at(0.0, 1.0)
    np.testing.assert_allclose(force, 0.0, atol=1e-9)
    np.testing.assert_allclose(torque, [0.0, 0.0, -10.0], atol=1e-9)
    # In a wide curve all wheels roll forward, and nothing resists the turn.
    np.testing.assert_allclose(at(0.5, 0.4)[1][2], 0.0, atol=1e-9)


def test_every_kind_can_be_injected_and_none_uses_the_packages_effects():
    random, platform = np.random.default_rng(0), draw_platform(3)
    state = BaseState(np.zeros(3), np.eye(3), np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.0, 0.3]), np.ones(4))
    for name in KINDS:
        injection = draw_effect(name, random, platform).injection(platform)
        assert np.isfinite(injection.twist(1.0, np.array([0.5, 0.2]))).all()
        assert np.isfinite(injection.drives(1.0, np.array([0.5, 0.2]))).all()
        assert np.isfinite(np.concatenate(injection.wrench(1.0, state))).all()
        healthy = Injection()
        acts = (
            injection.build != healthy.build
            or injection.measurement != healthy.measurement
            or type(injection) is not Injection
        )
        assert acts, name
    assert not set(OUTSIDE) & set(SINGLES)


def test_displacement_is_zero_without_an_effect_and_sees_late_stamps():
    platform = draw_platform(1)
    case = Case("choosing", 1, 3, "mujoco", "level", "single", ("pose_clock_offset",))
    job = dataclasses.replace(hidden_job(platform, case, ()), duration=20.0)
    trace = simulate(job)
    assert displacement(job, trace, job, trace) == 0.0
    late = HiddenEffect("pose_clock_offset", {"offset": 0.5}).injection(platform)
    shifted = dataclasses.replace(job, injections=(late,))
    assert displacement(shifted, trace, job, trace) > 0.05


def test_hidden_sensor_errors_change_poses_by_their_definition():
    rotations = np.tile(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), (2, 1, 1))
    shown, turned = measured_poses(np.zeros((2, 3)), rotations, Measurement(lever_arm=(1.0, 0.0), sensor_yaw=0.1))
    np.testing.assert_allclose(shown[0], [0.0, 1.0, 0.0], atol=1e-12)
    assert turned[0].as_euler("zyx")[0] == pytest.approx(np.pi / 2 + 0.1)


def test_a_platform_is_recorded_as_a_user_would(tmp_path):
    seed = next(s for s in range(1000, 1100) if (p := draw_platform(s)).wheels and p.gyro)
    case = Case("choosing", seed, 3, "mujoco", "hills", "single", ("drive_gain",))
    record_platform([case], tmp_path)
    files = CaseFiles.of(case, tmp_path)
    truth = json.loads(files.truth.read_text())
    assert truth["usable"]
    assert truth["displacement_m"][0] >= 0.1
    recording = Recording.open(files.bag)
    assert recording.wheels is not None
    assert recording.angular_velocity is not None
    assert (recording.motion.stamps[-1] - recording.motion.stamps[0]) * 1e-9 == pytest.approx(60.0, abs=0.5)
    ground, _ = load_terrain(files.terrain(files.bag))
    assert ground.height.shape[0] == 441
    assert files.check.exists()
    assert Recording.open(files.commissioning).motion.stamps[-1] > recording.motion.stamps[-1]


def test_the_map_lies_under_the_wheels(tmp_path):
    platform = draw_platform(1)
    ground = draw_hills(5, platform.friction)
    driver = ManoeuvreDriver(platform.maximum_speed, platform.maximum_yaw_rate, 1)
    trace = simulate(DriveJob(platform, ground, driver, (), 10.0))
    terrain, _ = load_terrain(write_map(ground, trace.positions[0], 1, tmp_path / "map.npz"))
    path = trace.positions[::100] - trace.positions[0]
    columns = np.rint((path[:, 0] - terrain.grid.origin[0]) / 0.1).astype(int)
    rows = np.rint((path[:, 1] - terrain.grid.origin[1]) / 0.1).astype(int)
    clearance = path[:, 2] - terrain.height.numpy()[rows, columns]
    assert np.median(clearance) == pytest.approx(platform.radius - platform.axle_height, abs=0.05)


def report_row(kind, hidden, effects, verdict="effect_found", **more):
    return {
        "case": "x", "kind": kind, "engine": "mujoco", "hidden": hidden, "effects": effects, "verdict": verdict,
        "gap": {}, "held_out": {}, "seconds": 10.0, "cpu_seconds": 9.0, **more,
    }  # fmt: skip


def hidden_entry(name, **values):
    names, estimated = KINDS[name].names, KINDS[name].estimated
    return {"name": name, "values": values, "onset_s": 0.0, "names": names, "estimated": estimated}


def found_entry(name, indistinguishable=(), **values):
    parameters = {key: {"value": v, "low": v - 0.1, "high": v + 0.1} for key, v in values.items()}
    return {"name": name, "parameters": parameters, "indistinguishable": list(indistinguishable)}


def test_what_is_injected_adds_to_what_the_healthy_robot_has():
    healthy = {"drive_gain": {"gain": 1.05}, "command_delay": {"delay": 0.08}, "actuator_saturation": {"limit": 0.9}}
    for name, key, injected, truth in (
        ("drive_gain", "gain", 0.8, 0.84),
        ("command_delay", "delay", 0.2, 0.28),
        ("actuator_saturation", "limit", 0.5, 0.5),
        ("actuator_saturation", "limit", 1.2, 0.9),
        ("sensor_yaw_offset", "angle", 0.3, 0.3),
    ):
        assert true_value({"healthy": healthy}, name, key, injected) == pytest.approx(truth)
    entry = {"name": "command_delay", "parameters": {"delay": {"value": 0.27, "low": 0.25, "high": 0.3}}}
    late = report_row("single", [hidden_entry("command_delay", delay=0.2)], [entry], healthy=healthy)
    assert covered(late) == [True]


def test_the_commissioned_file_is_found_whatever_the_robot_is_called(tmp_path):
    assert commissioned_file(tmp_path) is None
    (tmp_path / "seconds.txt").write_text("3.0\n")
    (tmp_path / "husky.yaml").write_text("name: husky\n")
    assert commissioned_file(tmp_path) == tmp_path / "husky.yaml"


def test_scores_count_names_classes_pairs_extras_and_intervals():
    gain = hidden_entry("drive_gain", gain=0.8)
    right = report_row("single", [gain], [found_entry("drive_gain", gain=0.85)])
    wrong = report_row("single", [gain], [found_entry("payload", mass=3.0)])
    in_class = report_row("single", [gain], [found_entry("payload", ("drive_gain",)), found_entry("actuator_lag")])
    silent = report_row("single", [gain], [], "no_discrepancy")
    pair = [gain, hidden_entry("actuator_lag", time_constant=0.3)]
    both = report_row("pair", pair, [found_entry("actuator_lag"), found_entry("drive_gain", gain=1.2)])
    half = report_row("pair", pair, [found_entry("drive_gain", gain=0.8)])
    healthy = report_row("empty", [], [], "no_discrepancy")
    alarm = report_row("empty", [], [], "unknown_effect")
    outside = [report_row("outside", [hidden_entry("tether")], [found_entry("drive_gain")])]
    outside.append(report_row("outside", [hidden_entry("tether")], [found_entry("drive_gain")], "unknown_effect"))
    assert [found_all(row) for row in (right, wrong, in_class, silent, both, half)] == [
        True, False, True, False, True, False,
    ]  # fmt: skip
    assert covered(right) == [True]
    assert covered(both) == [False]
    found = scores([right, wrong, in_class, silent, both, half, healthy, alarm, *outside])
    assert found["singles_named"]["share"] == 0.5
    assert found["singles_named_exactly"]["count"] == 1
    assert found["pairs_named"]["share"] == 0.5
    assert found["false_alarms"]["share"] == 0.5
    assert found["empty_named"]["share"] == 0.0
    assert found["outside_named"]["share"] == 0.5
    assert found["outside_unknown"]["share"] == 0.5
    assert found["extra_effects"]["count"] == 1
    assert found["extra_effects"]["of"] == 3
    low, high = found["singles_named"]["low"], found["singles_named"]["high"]
    assert low < 0.07
    assert high > 0.93


def test_the_gap_counts_drives_on_which_nothing_was_added():
    entry = {"horizon_s": 2.0, "before": 0.5, "after": 0.14, "noise": 0.1, "unit": "m"}
    assert closed_share({"position_2s": entry}) == pytest.approx(0.9)
    assert closed_share({"position_2s": entry | {"after": None}}) == 0.0
    assert closed_share({"position_2s": entry | {"before": 0.105}}) is None
    # What the healthy robot errs by, too, is nothing that an effect could close.
    assert closed_share({"position_2s": entry}, {"position_2s": 0.12}) == pytest.approx(0.36 / 0.38)
    assert closed_share({"position_2s": entry}, {"position_2s": 0.01}) == pytest.approx(0.9)
    assert closed_share({"position_2s": entry}, {"position_2s": 0.47}) is None
    assert closed_share({"position_2s": entry}, {}) is None
    empty = [
        {"case": f"newton-hills-7-0{n}-empty", "kind": "empty", "gap": {"position_2s": entry | {"before": b}}}
        for n, b in ((1, 0.1), (2, 0.2))
    ]
    assert healthy_errors([*empty, empty[0] | {"kind": "single"}]) == {
        "newton-hills-7": {"position_2s": pytest.approx(0.15)}
    }


def test_newton_drives_side_by_side_on_level_ground_and_hills():
    newton_engine = pytest.importorskip("newton_engine", reason="newton is in benchmarks/engines.txt")
    platform = draw_platform(1)
    hills = draw_hills(5, platform.friction)
    commands = np.tile([0.5 * platform.maximum_speed, 0.0], (40, 1))
    leader = LeadingDriver(ReplayedCommands(commands))
    slow = DriveFactors(left=0.5, right=0.5)
    jobs = [
        DriveJob(platform, Ground(), leader, (), 2.0),
        DriveJob(platform, Ground(), FollowingDriver(leader), (slow,), 1.5),
        DriveJob(platform, hills, ReplayedCommands(commands), (), 2.0),
    ]
    level, slowed, hilly = newton_engine.simulate_together(jobs)
    expected = 0.5 * platform.maximum_speed * platform.radius / platform.controller_radius
    assert level.velocities[-1, 0] == pytest.approx(expected, rel=0.05)
    assert len(slowed.positions) == 151
    np.testing.assert_array_equal(slowed.commands, level.commands[: len(slowed.commands)])
    assert slowed.positions[-1, 0] < 0.6 * level.positions[150, 0]
    clearance = platform.radius - platform.axle_height
    assert level.positions[-1, 2] == pytest.approx(clearance, abs=0.02)
    under = hills.height(hilly.positions[:, :2])
    assert np.ptp(under) > 0.02
    assert np.median(hilly.positions[:, 2] - under) == pytest.approx(clearance, abs=0.04)


def test_newton_valleys_are_not_filled_where_another_robot_drives_on_level_ground():
    newton_engine = pytest.importorskip("newton_engine", reason="newton is in benchmarks/engines.txt")
    platform = draw_platform(1)
    valley = draw_hills(27, platform.friction)
    commands = np.tile([platform.maximum_speed, 0.0], (60, 1))
    jobs = [DriveJob(platform, ground, ReplayedCommands(commands), (), 3.0) for ground in (Ground(), valley)]
    _, hilly = newton_engine.simulate_together(jobs)
    under = valley.height(hilly.positions[:, :2])
    assert under.min() < -0.1
    low = under < -0.1
    clearance = platform.radius - platform.axle_height
    assert np.median((hilly.positions[:, 2] - under)[low]) == pytest.approx(clearance, abs=0.05)


def test_cases_recorded_together_have_files_only_where_the_effect_matters(tmp_path):
    def simulate_in_turn(jobs):
        return [simulate(job) for job in jobs]

    seed = 1000
    matters = Case("choosing", seed, 1, "mujoco", "level", "single", ("sensor_yaw_offset",))
    empty = Case("choosing", seed, 2, "mujoco", "level", "empty")
    record_together([[matters, empty]], tmp_path, simulate_in_turn)
    for case in (matters, empty):
        files = CaseFiles.of(case, tmp_path)
        truth = json.loads(files.truth.read_text())
        assert truth["usable"]
        assert files.bag.exists()
        assert files.check.exists() == (case.kind == "single")
    assert CaseFiles.of(empty, tmp_path).commissioning.exists()
    record_together([[matters, empty]], tmp_path, lambda jobs: pytest.fail("everything is recorded"))


def test_a_platform_that_tips_over_is_commissioned_on_another_drive(tmp_path):
    empty = Case("choosing", 1000, 2, "mujoco", "level", "empty")
    driven = []

    def simulate_in_turn(jobs):
        traces = [simulate(dataclasses.replace(job, duration=3.0)) for job in jobs]
        healthy = [number for number, job in enumerate(jobs) if job.duration > 60.0]
        for number in healthy:
            driven.append(jobs[number].duration)
            if len(driven) < 3:
                traces[number] = dataclasses.replace(traces[number], mishap="tipped over")
        return traces

    record_together([[empty]], tmp_path, simulate_in_turn)
    assert CaseFiles.of(empty, tmp_path).commissioning.exists()
    assert len(set(driven)) == len(driven) == 3, "each attempt has commands of its own"


def test_motors_of_a_largest_torque_are_no_slippery_ground_in_the_other_engine(tmp_path):
    """Stiff servos with heavy rotors reach their torque at every step: half the friction stood in for their ramps."""
    case = next(case for case in all_cases("choosing") if case.platform_name == "mujoco-level-1000")
    record_platform([case], tmp_path)
    commission_platform(case, tmp_path, Judged(ROOT, tmp_path / "results" / "label", "", 300.0))
    file = tmp_path / "results" / "label" / "nominal" / case.platform_name / "platform.yaml"
    found = {effect["name"]: effect["parameters"] for effect in yaml.safe_load(file.read_text())["effects"]}
    friction = found["friction_scale"]["factor"]["value"] * TerrainDefaults().friction
    assert friction == pytest.approx(draw_platform(1000).friction, rel=0.25)
    assert "drive_torque_limit" in found and "acceleration_limit" not in found


def test_the_true_effect_explains_most_of_what_it_does_in_the_other_engine(tmp_path):
    (case,) = (case for case in all_cases("choosing") if case.name == "mujoco-level-1008-03-single-drive_loss")
    record_platform([case], tmp_path)
    commission_platform(case, tmp_path, Judged(ROOT, tmp_path / "results" / "label", "", 300.0))
    nominal = tmp_path / "results" / "label" / "nominal" / case.platform_name / "platform.yaml"
    row = measured(case, CaseFiles.of(case, tmp_path), nominal)
    assert row["fitted"] == ["drive_loss"] and row["visible"]
    assert row["explained"] > 0.7 and row["error"] < 0.5
    assert json.loads(json.dumps(row)) == row
    assert summary("single", [row]).startswith("single: 1 of 1 drives visible; share explained: 10 % quantile")
    # The slower healthy drives may respond to harder commands, the less of an error is left.
    row = uncovered_changes.measured(case, CaseFiles.of(case, tmp_path), nominal, (0.0, 0.06, 1.0))
    ratios = row["loss_ratios"]
    assert ratios[0] >= ratios[1] >= ratios[2] > 0.0 and (row["harder"] <= 0.0 or ratios[2] < ratios[0])
    # The more healthy drives vary, the less significant is the same drive.
    shares, spreads = (0.0, 1.0, 1e5), (0.1, 50.0)
    row = null_rates.measured(case, CaseFiles.of(case, tmp_path), nominal, shares, spreads)
    (_, alone), (name, usual), (_, hopeless) = row["smallest"]
    assert name == "drive_loss" and alone <= usual <= 0.025 < hopeless
    text = null_rates.summary("single", [row], shares, spreads)
    assert "of 1 drives with an effect below 0.025: 1 at 0, 1 at 1, 0 at 100000" in text
    # So with their losses: the drive is too large beside those that hardly differ.
    assert "too large at 0.0125: 1 at 0.1, 0 at 50" in text


def test_platforms_are_reported_by_one_code_only(tmp_path):
    ledger = tmp_path / "reported.json"
    first, other = (
        [Case("reporting", seed, 1, engine, "level", "empty") for seed, engine in zip(seeds, engines, strict=True)]
        for seeds, engines in (
            ((700, 701, 702, 708), ("mujoco", "newton", "mujoco", "mujoco")), ((704, 702), ("mujoco", "mujoco")),
        )
    )  # fmt: skip
    assert reported_before(first, "a", ledger) == []
    add_to_ledger(first, "a", "2026-01-02", ledger)
    assert [(entry.engine, entry.first, entry.last) for entry in read_ledger(ledger)] == [
        ("mujoco", 700, 702), ("mujoco", 708, 708), ("newton", 701, 701),
    ]  # fmt: skip
    # An interrupted or repeated run of the same code goes on; another code's would not be independent.
    assert reported_before(first, "a", ledger) == []
    assert [entry.first for entry in reported_before(other, "b", ledger)] == [700]
    assert reported_before(other[:1], "b", ledger) == []
    add_to_ledger(first, "a", "2026-01-03", ledger)
    assert {entry.date for entry in read_ledger(ledger)} == {"2026-01-02"}
    # Platform by platform, as they are shown.
    for case in first[::-1]:
        add_to_ledger([case], "c", "2026-01-04", ledger)
    assert [(e.engine, e.first, e.last) for e in read_ledger(ledger) if e.code == "c"] == [
        ("newton", 701, 701), ("mujoco", 700, 702), ("mujoco", 708, 708),
    ]  # fmt: skip
    assert [entry.code for entry in read_ledger(ledger)] == ["a"] * 3 + ["c"] * 3


def test_the_next_set_for_reporting_is_not_in_the_ledger():
    assert read_ledger(LEDGER)
    assert reported_before(all_cases("reporting"), "", LEDGER) == []
    assert reported_before(all_cases("choosing"), "", LEDGER) == []


def test_a_second_report_of_a_platform_is_refused_and_one_that_is_asked_for_is_marked(tmp_path, monkeypatch, capsys):
    (case, *_) = all_cases("reporting")
    arguments = ["--work", str(tmp_path), "--set", "reporting", "--cases", case.name, "--label", "code", "--jobs", "1"]
    arguments += ["--ledger", str(tmp_path / "reported.json"), "--json", str(tmp_path / "rows.json")]
    row = report_row("empty", [], [], "no_discrepancy") | {"case": case.name, "sensors": {}}

    def run(*more):
        monkeypatch.setattr("sys.argv", ["run.py", *arguments, *more])
        return platforms_run.main()

    # Recorded and diagnosed in an earlier call, without wheel speeds, too; there is no IMU.
    files = CaseFiles.of(case, tmp_path)
    result, ablated = (
        tmp_path / "results" / folder / "cases" / f"{case.name}.json" for folder in ("code", "code-wheels")
    )
    alarm, sensors = row | {"verdict": "unknown_effect"}, {"wheels": True, "gyro": False}
    truth = row | {"usable": True, "ground": case.ground, "displacement_m": [], "sensors": sensors}
    for file, content in ((files.truth, truth), (result, row), (ablated, alarm)):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(content))
    assert run("--ablations") == 0
    content = json.loads((tmp_path / "rows.json").read_text())
    assert content["rows"] == [row] and content["without"] == {"wheels": [alarm], "imu": []}
    assert content["seconds"].keys() == {"recording", "diagnoses", "ablations"}
    assert "| with wheels | without wheels | with imu | without imu |" in capsys.readouterr().out
    assert [entry.code for entry in read_ledger(tmp_path / "reported.json")] == ["code"]
    assert run() == 0
    capsys.readouterr()
    arguments[arguments.index("code")] = "changed"
    assert run() == 1
    said = capsys.readouterr().err
    assert f"{case.engine} {case.platform_seed} to {case.platform_seed}" in said and "--again" in said
    assert len(read_ledger(tmp_path / "reported.json")) == 1
    # There is no bag to diagnose again; the row says so, and that it is not independent.
    assert run("--again") == 0
    (again,) = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert again["verdict"] == "error" and again["independent"] is False
    assert "Not independent" in capsys.readouterr().out
    assert [entry.code for entry in read_ledger(tmp_path / "reported.json")] == ["code", "changed"]
    # An interruption after the first row was shown, or while what was seen is diagnosed again.
    arguments[arguments.index("changed")] = "interrupted"
    arguments[arguments.index("--ledger") + 1] = str(tmp_path / "other.json")

    def interrupt(shown):
        raise KeyboardInterrupt

    for stage, stop in (("row_line", interrupt), ("forget", lambda case, judged: interrupt(case))):
        monkeypatch.setattr(platforms_run, stage, stop)
        with pytest.raises(KeyboardInterrupt):
            run(*(["--again"] if stage == "forget" else []))
        assert [entry.code for entry in read_ledger(tmp_path / "other.json")] == ["interrupted"]
        (tmp_path / "other.json").unlink()


def test_a_platform_without_a_sensor_has_no_row_without_it(tmp_path):
    case = Case("choosing", 1000, 2, "mujoco", "level", "empty")
    files = CaseFiles.of(case, tmp_path)
    files.truth.parent.mkdir(parents=True)
    files.truth.write_text(json.dumps({"usable": True, "sensors": {"wheels": False, "gyro": True}}))
    judged = Judged(ROOT, tmp_path / "results", "wheels", 10.0)
    assert diagnose_case(case, tmp_path, judged) is None
    commission_platform(case, tmp_path, judged)
    assert not (tmp_path / "results").exists()


def compared_row(kind, case, after, **errors):
    gap = {"position_2s": {"before": 0.5, "after": after, "noise": 0.1}}
    seconds = dict.fromkeys(errors, 4.0)
    baselines = errors | {"seconds": seconds}
    hidden = [hidden_entry("drive_gain", gain=0.8)] * (2 if kind == "pair" else 1)
    return report_row(kind, hidden, [found_entry("drive_gain")]) | {"case": case, "gap": gap, "baselines": baselines}


def test_the_table_of_methods_has_singles_pairs_and_their_time():
    errors = dict.fromkeys(METHODS, 0.3)
    rows = [compared_row("single", "a", 0.2, **errors), compared_row("pair", "b", None, **(errors | {"sindy": 0.9}))]
    lines = baseline_table(rows).splitlines()
    assert "1 single effects" in lines[0] and "1 pairs" in lines[0]
    cells = {line.split(" | ")[0][2:]: line.strip("| ").split(" | ")[1:] for line in lines[2:]}
    assert cells["nominal model"] == ["0.500", "0 %", "0.500", "0 %", "–"]
    assert cells["diagnose"] == ["0.200", "75 %", "0.500", "0 %", "9 s"]
    assert cells[METHODS["mujoco_sysid"]] == ["0.300", "50 %", "0.300", "50 %", "4 s"]
    assert cells[METHODS["sindy"]] == ["0.300", "50 %", "0.900", "-100 %", "4 s"]
    # Rows of earlier runs lack a method: they are compared in none.
    assert baseline_table([rows[0] | {"baselines": {"refit": 0.3}}]) == "No baselines."


def test_an_ablation_is_compared_with_the_same_drives():
    single = [hidden_entry("drive_gain", gain=0.8)]
    right = report_row("single", single, [found_entry("drive_gain")]) | {"case": "a"}
    lines = ablation_table(
        [right, right | {"case": "b"}], {"wheels": [right | {"effects": [found_entry("payload")]}]}
    ).splitlines()
    assert lines[0] == "| score | with wheels | without wheels |"
    named = next(line for line in lines if line.startswith("| single effects named"))
    assert "100 % [3, 100] (1/1) | 0 % [0, 98] (0/1)" in named


def windows_of(trace, seconds):
    """Windows of 2 s of a simulated drive with exact poses and the commands of its driver."""
    stamps = np.arange(len(trace.positions)) * round(TICK * 1e9) + 1_000_000_000
    motion = MotionTrack(
        stamps, trace.positions, Rotation.from_matrix(trace.rotations).as_quat(), trace.velocities, trace.rates
    )
    commanded = stamps[0] + np.arange(len(trace.commands)) * 50_000_000
    starts = stamps[0] + (np.arange(1.0, seconds - 2.5, 1.0) * 1e9).astype(np.int64)
    samples = np.array([0.5, 1.0, 1.5, 2.0])
    return EvidenceWindows(motion, CommandTrack(commanded, trace.commands), starts, 2.0, samples)


def test_mujocos_system_identification_finds_slow_drives(tmp_path):
    for module in ("mujoco.sysid", "colorama", "tabulate", "plotly"):
        pytest.importorskip(module, reason="mujoco[sysid] is in benchmarks/requirements.txt")
    import mujoco_sysid
    from mujoco_robot import FREE, Nominal

    platform = draw_platform(1)
    driver = ManoeuvreDriver(platform.maximum_speed, platform.maximum_yaw_rate, 2)
    trace = simulate(DriveJob(platform, Ground(), driver, (DriveFactors(left=0.6, right=0.6),), 14.0))
    robot = load_robot(write_robot_file(platform, tmp_path / "platform.yaml"))
    data, scale = windows_of(trace, 14.0), np.full((4, 3), 0.02)
    nominal = Nominal.of(robot)
    np.testing.assert_allclose(
        nominal.wheels[:, 0], np.tile(np.sort(nominal.wheels[: platform.axles, 0])[::-1], 2), atol=1e-3
    )
    np.testing.assert_allclose(np.abs(nominal.wheels - platform.wheel_centres).max(), 0.0, atol=0.05)
    start = {name: entry.start for name, entry in FREE.items()}

    def error(values):
        residuals = mujoco_sysid.WindowRollouts(nominal, data, scale).residuals([values])[0, :, -1]
        return np.median(np.hypot(residuals[:, 0], residuals[:, 1]))

    found = mujoco_sysid.identify(robot, data, scale, 10.0)
    assert found.steps >= 2
    assert error(start) > 0.1
    assert error(found.values) < 0.4 * error(start)
