"""Onset: an effect that begins in the middle of a recording is dated; one that always acts is not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_rollout import recorded
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack, WheelTrack
from monoforce_ros.discrepancy.evidence import Evidence, EvidenceWindows, window_starts
from monoforce_ros.discrepancy.explanation import DiagnosisSettings, Explanation, Windows, explain
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.onset import Onset, find_onset
from monoforce_ros.discrepancy.selection import Search
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.discrepancy.wheels import WheelFinding, changed_drives, compare_with_wheels
from monoforce_ros.effects import drive_speeds, identifiable_effects
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
SECONDS, ONSET = 72.0, 40.0


def _recording(
    begins: float, gain: float = 0.75, drain: float = 0.0, turns: tuple[float, float] = (-0.8, 0.8)
) -> EvidenceWindows:
    """Drives that reach a share of the commanded speed from a time on, and lose ``drain`` of it every minute.

    Yaw rates are drawn between ``turns`` [rad/s].
    """
    husky = load_robot("husky")
    random = np.random.default_rng(2)
    steps = round(SECONDS / 0.01)
    commanded = np.repeat(random.uniform([0.1, turns[0]], [0.9, turns[1]], (round(SECONDS / 1.5), 2)), 150, axis=0)[
        :steps
    ]
    speeds = drive_speeds(husky, torch.as_tensor(commanded[None], dtype=torch.float32), 0.01)
    speeds = speeds * (1.0 - drain * torch.arange(steps)[None, :, None] * 0.01 / 60.0)
    acting = torch.arange(steps)[None, :, None] * 0.01 >= begins
    level = TerrainMap.flat(Grid.square(2.0, 1.0))
    result = rollout(level, husky, torch.where(acting, gain * speeds, speeds), State.at_rest(0.13), with_forces=False)
    motion = recorded(result)
    commands = CommandTrack(np.arange(steps, dtype=np.int64) * 10_000_000, commanded)
    starts = window_starts(motion, [slice(0, len(motion))], 2.0, 1.0)
    return EvidenceWindows(motion, commands, starts, 2.0, SAMPLES)


@pytest.mark.parametrize("begins", [ONSET, 19.0, 0.0])
def test_an_effect_that_begins_is_dated(begins):
    data = _recording(begins)
    # Of a recording whose first seconds are left out, such as a drive by joystick, times count from its own start.
    data = replace(data, starts=data.starts[3:])
    search = Search(load_robot("husky"), data, np.tile([0.01, 0.01, 0.005], (4, 1)))
    trial = search.judge((("drive_gain", {"gain": 0.8}),))
    onset = find_onset(search, trial)
    if begins:
        assert onset is not None
        # A window, and a quarter of a block between the onsets that are tried.
        assert (onset.stamp - data.motion.stamps[0]) * 1e-9 == pytest.approx(begins, abs=3.0)
        assert onset.since_start == pytest.approx((onset.stamp - data.motion.stamps[0]) * 1e-9)
    else:
        assert onset is None


def test_what_a_sensor_measured_acts_before_an_onset_too():
    data, late = _recording(ONSET), 300_000_000
    data = replace(data, motion=replace(data.motion, stamps=data.motion.stamps + late), starts=data.starts[2:-2])
    known = (("pose_clock_offset", {"offset": 0.3}),)
    search = Search(load_robot("husky"), data, np.tile([0.01, 0.01, 0.005], (4, 1)), known=known)
    onset = find_onset(search, search.judge((*known, ("drive_gain", {"gain": 0.8}))))
    assert onset is not None
    assert (onset.stamp - data.motion.stamps[0]) * 1e-9 == pytest.approx(ONSET, abs=3.5)


def _explained(data: EvidenceWindows) -> Explanation:
    """Of a commissioned robot whose healthy residuals are some centimetres."""
    residual = np.tile([0.01, 0.012, 0.007], (4, 1))
    names = [effect.name for effect in identifiable_effects(load_robot("husky"))]
    healthy = NominalModel(residual, dict.fromkeys(names, 0.25), segments=5, loss=0.3, loss_spread=0.2)
    evidence = Evidence(SmoothedMotion(data.motion, 0.0, 0.0, (slice(0, len(data.motion)),)), data.commands)
    windows = Windows(data, np.zeros((len(data.starts), 4, 3)))
    return explain(evidence, load_robot("husky"), windows, healthy, DiagnosisSettings(max_effects=1))


@pytest.mark.parametrize("drain", [0.15])
def test_a_supply_that_drains_is_named(drain):
    found = _explained(_recording(0.0, 1.0, drain))
    assert found.decision.verdict == Verdict.EFFECT_FOUND and found.part is None
    ((name, values),) = found.decision.trial.effects
    assert name == "supply_drain" and values["drain"] == pytest.approx(drain, rel=0.15)


@pytest.mark.parametrize("gain", [0.9])
def test_drives_that_become_slow_at_once_have_no_supply_that_drains(gain):
    found = _explained(_recording(ONSET, gain))
    assert isinstance(found.part, Onset) and found.part.since_start == pytest.approx(ONSET, abs=5.0)
    assert [name for name, _ in found.decision.trial.effects] == ["drive_gain"]


@pytest.mark.parametrize("gain", [0.89, 1.0])
def test_a_weak_effect_that_begins_late_is_significant_from_its_onset_on(gain):
    data = _recording(ONSET, gain)
    residual = np.tile([0.03, 0.03, 0.015], (4, 1))
    names = ("drive_gain", "actuator_lag", "friction_scale", "turning_scrub", "command_delay")
    healthy = NominalModel(residual, dict.fromkeys(names, 0.25), segments=5, loss=0.5, loss_spread=0.2)
    search = Search(load_robot("husky"), data, residual, nominal=healthy)
    outcome = search.run(2, exchange=False)
    whole_rate, rate = search.thresholds.whole_rate, search.thresholds.part_rate
    assert not outcome.best.effects and outcome.fit.passed(search.thresholds)
    whole = min(entry.test.adjusted for entry in search.screening.candidates((), 0, "").screened)
    assert whole > whole_rate
    assert search.part_p() <= rate if gain < 1.0 else search.part_p() > rate


def _compass(data: EvidenceWindows, deviations: np.ndarray) -> EvidenceWindows:
    """The same drive by a localisation whose heading deviates, ``[N]`` [rad]."""
    turns = Rotation.from_rotvec(deviations[:, None] * [0.0, 0.0, 1.0])
    motion = data.motion
    turned = replace(
        motion,
        quaternions=(turns * Rotation.from_quat(motion.quaternions)).as_quat(),
        linear_velocities=turns.inv().apply(motion.linear_velocities),
    )
    return replace(data, motion=turned)


def test_a_compass_near_iron_deviates_with_the_heading_and_a_sensor_that_was_turned_from_then_on():
    data, husky = _recording(SECONDS), load_robot("husky")
    late = np.arange(len(data.motion)) * SECONDS / len(data.motion) >= ONSET
    headings = Rotation.from_quat(data.motion.quaternions).as_euler("zyx")[:, 0]
    starts = np.searchsorted(data.motion.stamps, data.starts)
    offset = (("sensor_yaw_offset", {"angle": 0.1}),)
    for deviations, acting, follows in (
        (0.2 * np.sin(headings), np.sin(headings[starts]) > 0.3, True),
        (0.2 * late, late[starts], False),
    ):
        recording = _compass(data, deviations)
        scale = np.tile([0.01, 0.01, 0.005], (4, 1))
        assert Search(husky, recording, scale).follows_heading(offset, acting) == follows


@pytest.mark.parametrize("gain", [0.75, 0.9])
def test_a_change_at_a_time_stays_one_where_the_heading_goes_with_time(gain):
    """The robot turns by half a circle in all: of the onset and its heading neither adds much to the other."""
    data = _recording(ONSET, gain, turns=(-0.06, 0.15))
    residual = np.tile([0.03, 0.03, 0.015], (4, 1))
    healthy = NominalModel(residual, {"drive_gain": 0.25}, segments=5, loss=0.5, loss_spread=0.2)
    search = Search(load_robot("husky"), data, residual, nominal=healthy)
    acting = data.starts >= data.starts[0] + ONSET * 1e9
    assert not search.follows_heading((("drive_gain", {"gain": 0.5 + 0.5 * gain}),), acting)


def test_wheels_that_confirm_the_file_show_no_change():
    husky = replace(load_robot("husky"), effects=(("command_delay", {"delay": 0.2}),))

    def finding(delay):
        return WheelFinding(
            (("command_delay", {"delay": delay}),), ({"delay": 0.03},), 0.2, 0.1, 6.0, ruled_out=("actuator_deadband",)
        )

    changed, unchanged = changed_drives(finding(0.22), husky)
    # The wheels say nothing of a lag, neither for nor against it.
    assert changed == () and set(unchanged) == {"command_delay", "actuator_deadband"}
    changed, unchanged = changed_drives(finding(0.35), husky)
    assert dict(changed) == {"command_delay": {"delay": 0.35}} and "command_delay" not in unchanged


def test_wheels_that_show_no_delay_contradict_a_file_that_has_one():
    husky = replace(load_robot("husky"), effects=(("command_delay", {"delay": 0.3}),))
    random = np.random.default_rng(1)
    twists = np.repeat(random.uniform([-0.5, -0.8], [0.9, 0.8], (40, 2)), 150, axis=0)
    stamps = np.arange(len(twists), dtype=np.int64) * 10_000_000
    half = 0.5 * float((husky.drive_offsets.max() - husky.drive_offsets.min()).abs())
    speeds = np.stack([twists[:, 0] - half * twists[:, 1], twists[:, 0] + half * twists[:, 1]], axis=1) / 0.165
    wheels = WheelTrack(stamps[::5], (speeds + 0.02 * random.standard_normal(speeds.shape))[::5])
    found = compare_with_wheels(CommandTrack(stamps, twists), wheels, husky)
    assert found is not None
    changed, _ = changed_drives(found, husky)
    assert dict(changed)["command_delay"]["delay"] == pytest.approx(0.0, abs=0.05)
