"""Repetition: what is found without a part of a recording predicts that part, and nothing of the part enters it."""

from dataclasses import replace

import numpy as np
import pytest
from test_diagnose import simulated_recording

from monoforce_ros.bags import JointRecord, SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, JointTrack, WheelTrack
from monoforce_ros.discrepancy import DiagnosisSettings, Evidence
from monoforce_ros.discrepancy.comparison import HeldOut
from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.discrepancy.evidence import window_starts
from monoforce_ros.discrepancy.explanation import Windows, explain
from monoforce_ros.discrepancy.jackknife import jackknife_error, widened
from monoforce_ros.discrepancy.repetition import LENGTH, Repeated, Repetition, repeat, without_part
from monoforce_ros.discrepancy.sensor_findings import SensorFindings
from monoforce_ros.discrepancy.verdict import Verdict
from monoforce_ros.robots import load_robot

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
SETTINGS = DiagnosisSettings(max_effects=1)


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def windows_of(motion, commands, horizon=2.0):
    starts = window_starts(motion, [slice(0, len(motion))], horizon, 1.0)
    smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
    evidence = Evidence(smoothed, commands)
    # Every other second is enough, and takes half of the time.
    starts = starts[::2]
    return evidence, Windows(evidence.cut(starts, SAMPLES), np.full((len(starts), 4, 3), 0.005))


def test_parts_take_turns_and_windows_end_within_theirs():
    held_out = HeldOut(((), (), ()), 10**9, 16.0)
    stamps = 10**9 + np.array([0, 15, 16, 33, 47, 48]) * 10**9
    assert held_out.part_of(stamps).tolist() == [0, 0, 1, 2, 2, 0]
    starts = 10**9 + np.arange(0, 32) * 10**9
    kept = (held_out.judged(starts, 5.0) - 10**9) // 10**9
    assert kept.tolist() == [*range(12), *range(16, 28)]
    assert len(HeldOut.everywhere(()).judged(starts, 5.0)) == len(starts)


def test_a_delay_is_found_again_without_each_part_and_a_part_that_lies_changes_only_its_own_prediction(husky):
    motion, commands = simulated_recording(husky, (("command_delay", {"delay": 0.3}),), seconds=60.0)
    evidence, windows = windows_of(motion, commands)
    whole = repeat(evidence, husky, windows, None, SETTINGS)
    assert whole is not None and len(whole.repeated) == 3
    for repeated in whole.repeated:
        assert repeated is not None
        (effect,) = repeated.effects
        assert effect[0] in ("command_delay", "pose_clock_offset", "command_clock_offset")
    # In the first part the commands are nonsense: what is found without that part must not change at all.
    first = int(windows.data.starts[0])
    lie = HeldOut(((),) * 3, first, LENGTH).part_of(commands.stamps) == 0
    lie &= (commands.stamps - first) % round(LENGTH * 1e9) < 12 * 10**9
    lie &= (commands.stamps - first) % round(LENGTH * 1e9) > 4 * 10**9
    twists = commands.twists.copy()
    twists[lie] *= -1.0
    evidence, windows = windows_of(motion, replace(commands, twists=twists))
    lying = repeat(evidence, husky, windows, None, SETTINGS)
    assert lying is not None and lie.any()
    assert lying.repeated[0] == whole.repeated[0]
    assert lying.repeated[1] != whole.repeated[1]


def test_sensors_are_taken_without_the_part(husky):
    """Wheels that turn by other rules in one part must not tell anything where that part is left out."""
    motion, commands = simulated_recording(husky, (), seconds=60.0)

    def wheels(delay):
        twists = commands.sample(motion.stamps - round(delay * 1e9))
        sides = [twists[:, 0] + side * 0.3 * twists[:, 1] for side in (-1, 1)]
        return np.stack(sides, axis=1) / husky.wheel_radius

    evidence, windows = windows_of(motion, commands)
    places = HeldOut(((),) * 3, int(windows.data.starts[0]), LENGTH)
    measured = []
    for delay in (0.3, 0.8):
        changed = np.where((places.part_of(motion.stamps) == 2)[:, None], wheels(delay), wheels(0.3))
        recorded = replace(evidence, wheels=WheelTrack(motion.stamps, changed))
        parts = [
            SensorFindings.of(without_part(recorded, places, part), husky, commissioned=False) for part in range(3)
        ]
        measured.append([findings.known for findings in parts])
    assert measured[0][2] == measured[1][2] != ()
    assert all(measured[0][part] != measured[1][part] for part in (0, 1))


def test_joints_and_gyro_are_taken_without_the_part():
    """A flipper that turns the other way and a biased gyro in one part only: without it nobody knows."""
    marv = load_robot("marv")
    motion, commands = simulated_recording(marv, (), seconds=60.0)
    evidence, windows = windows_of(motion, commands)
    places = HeldOut(((),) * 3, int(windows.data.starts[0]), LENGTH)
    stamps = motion.stamps
    held = places.part_of(stamps) == 2
    names = tuple(joint.name for joint in marv.joints)
    wanted = np.tile(0.8 * np.sin(0.5e-9 * (stamps - stamps[0]))[:, None], (1, len(names)))
    rates = np.zeros((len(stamps), 3))
    rates[:, 2] = motion.angular_velocities[:, 2]
    measured = []
    for share, bias in ((0.0, 0.0), (2.0, 0.3)):
        angles = wanted.copy()
        angles[held, -1] *= 1.0 - share
        joints = JointRecord(JointTrack(stamps, names, angles), JointTrack(stamps, names, wanted), 4)
        gyro = AngularVelocityTrack(stamps, rates + bias * held[:, None])
        recorded = replace(evidence, joints=joints, gyro=gyro)
        measured.append(
            [SensorFindings.of(without_part(recorded, places, part), marv, commissioned=False) for part in range(3)]
        )
    healthy, lying = measured
    assert healthy[2].gyro is not None and lying[2].gyro == healthy[2].gyro
    assert lying[0].gyro != healthy[0].gyro
    assert lying[2].flippers is None and all(lying[part].flippers is not None for part in (0, 1))


def test_too_short_a_recording_is_not_repeated(husky):
    motion, commands = simulated_recording(husky, (), seconds=20.0)
    evidence, windows = windows_of(motion, commands)
    assert repeat(evidence, husky, windows, None, SETTINGS) is None


def test_an_effect_that_others_replace_half_of_the_time_belongs_to_a_class_with_them():
    repeated = (Repeated(named=("drive_gain",)), Repeated(named=("drive_gain",)), Repeated(named=("payload",)), None)
    (judged,) = Repetition(0, repeated).judged([EffectEstimate("drive_gain", {})])
    assert judged.found_again == (2, 3) and judged.indistinguishable == ()
    repeated = (Repeated(named=("drive_gain",)), Repeated(named=("payload",)), None, None)
    (judged,) = Repetition(0, repeated).judged([EffectEstimate("drive_gain", {})])
    assert judged.found_again == (1, 2) and judged.indistinguishable == ("payload",)
    assert judged.named_otherwise == ()


def test_a_name_that_changes_with_each_part_is_one_class_with_all_that_takes_its_place():
    def judged(*named):
        repeated = tuple(Repeated(named=names) for names in named)
        return Repetition(0, repeated).judged([EffectEstimate("drive_gain", {})])[0]

    changes = judged(("payload",), ("turning_scrub",), ("drive_gain",))
    assert changes.found_again == (1, 3) and changes.indistinguishable == ()
    assert changes.named_otherwise == ("payload", "turning_scrub")
    assert judged(("payload",), ("turning_scrub",), ("viscous_drag",)).named_otherwise[-1] == "viscous_drag"
    # Found again in most of them it keeps its name; where others find nothing, there is none in its place.
    assert judged(("payload",), ("drive_gain",), ("drive_gain",)).named_otherwise == ()
    assert judged((), (), ("drive_gain",)).named_otherwise == ()
    # One that takes its place in half of them means the same.
    most = judged(("payload",), ("payload",), ("turning_scrub",))
    assert most.indistinguishable == ("payload",) and most.named_otherwise == ("turning_scrub",)


def test_an_effect_beside_another_that_is_found_again_in_fewer_than_half_of_the_repetitions_is_not_added(
    husky, monkeypatch
):
    motion, commands = simulated_recording(husky, (("command_delay", {"delay": 0.3}),), seconds=40.0)
    evidence, windows = windows_of(motion, commands)
    found = explain(evidence, husky, windows, None, SETTINGS)
    assert found.decision.verdict == Verdict.EFFECT_FOUND
    (name,) = found.decision.trial.names
    both = found.search.judge((*found.decision.trial.effects, ("payload", {"mass": 3.0, "x": 0.1, "y": 0.0})))
    decision = replace(found.decision, trial=both)

    def names(*repeated):
        confirmed = Repetition(0, repeated).confirmed(found, decision, SETTINGS.thresholds)
        return confirmed.trial.names, " ".join(confirmed.remarks)

    # A single one that no repetition finds hangs on one part; one of two suffices, and so does another in its place.
    def alone(*repeated):
        return Repetition(0, repeated).confirmed(found, found.decision, SETTINGS.thresholds)

    nothing, other = Repeated(), Repeated(named=("payload",))
    lost = alone(nothing, other, nothing)
    assert lost.verdict == Verdict.UNKNOWN_EFFECT and lost.trial is None and lost.parts.names == (name,)
    assert f"{name} found again in none of the searches" in lost.remarks[-1] and "payload" in lost.remarks[-1]
    assert alone(nothing, Repeated(named=(name,)), nothing).trial.names == (name,)
    assert alone(other, other, nothing).trial.names == (name,)
    with monkeypatch.context() as healthy:
        healthy.setattr(found.search, "size_p", lambda trial: 0.5)
        assert alone(nothing, nothing, nothing).verdict == Verdict.NO_DISCREPANCY

    delay, payload = Repeated(named=(name,)), Repeated(named=(name, "payload"))
    assert names(delay, payload, None)[0] == (name, "payload")
    for repeated in ((delay, delay, None), (delay, delay, payload)):
        kept, remarks = names(*repeated)
        assert kept == (name,) and "not added: payload found again in fewer than half of the searches" in remarks
    # One that takes its place each time is the same finding under another name.
    instead = Repeated(named=(name, "constant_force"))
    assert names(instead, instead, payload)[0] == (name, "payload")
    # Where each repetition finds something else, the recording does not say what is wrong.
    others = (Repeated(named=("drive_gain",)), Repeated(named=("drive_loss",)), Repeated(named=("turning_scrub",)))
    nothing = Repetition(0, others).confirmed(found, decision, SETTINGS.thresholds)
    assert nothing.verdict == Verdict.UNKNOWN_EFFECT and nothing.trial is None and nothing.parts is both
    assert "these name drive_gain or drive_loss or turning_scrub" in nothing.remarks[-1]
    # One without which the others are no measurements belongs to them.
    monkeypatch.setattr(found.search, "credible", lambda trial: len(trial.names) > 1)
    assert names(delay, delay, payload)[0] == (name, "payload")


def test_an_effect_without_which_held_out_windows_are_predicted_worse_is_kept_however_rarely_it_is_found_again(husky):
    """Two thirds of a recording miss what the whole of it shows."""
    hidden = (("command_delay", {"delay": 0.3}), ("drive_gain", {"gain": 0.8}))
    motion, commands = simulated_recording(husky, hidden, seconds=40.0)
    evidence, windows = windows_of(motion, commands)
    found = explain(evidence, husky, windows, None, DiagnosisSettings(max_effects=2))
    assert found.decision.verdict == Verdict.EFFECT_FOUND
    delay, gain = found.decision.trial.names
    once = Repetition(0, (Repeated(named=(delay,)), Repeated(named=(delay, gain)), Repeated(named=(delay,))))
    assert once.confirmed(found, found.decision, SETTINGS.thresholds).trial.names == (delay, gain)


def test_the_jackknife_knows_the_standard_error_of_a_mean():
    random = np.random.default_rng(5)
    groups = random.normal(3.0, 2.0, (4, 500, 5))
    errors = []
    for draw in groups.transpose(1, 0, 2):
        without = [np.delete(draw, part, axis=0).mean() for part in range(4)]
        errors.append(jackknife_error(without, 4))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(2.0 / np.sqrt(20.0), rel=0.05)
    assert jackknife_error([1.0], 4) == 0.0


def test_intervals_are_as_wide_as_searches_without_parts_ask_for():
    """Twenty values of a delay scatter by 0.03 s from part to part, where the fit of the whole says 0.001 s."""
    random = np.random.default_rng(6)
    held, before = 0, 0
    for _ in range(400):
        parts = 0.2 + 0.03 * random.standard_normal(4)
        narrow = ParameterEstimate(parts.mean(), parts.mean() - 0.002, parts.mean() + 0.002, "s")
        again = [{"delay": np.delete(parts, part).mean()} for part in range(4)]
        wide = widened(EffectEstimate("command_delay", {"delay": narrow}), again, 4).parameters["delay"]
        assert wide.low <= narrow.low and wide.high >= narrow.high
        before += narrow.holds(0.2)
        held += wide.holds(0.2)
    # Of four values a normal interval holds the mean in 86 % (Student's t with three degrees of freedom).
    assert before < 0.2 * 400 and held > 0.8 * 400


def test_a_widened_interval_keeps_to_bounds_and_to_its_side_of_neutral():
    force = ParameterEstimate(80.0, 60.0, 100.0, "N")
    estimate = EffectEstimate("constant_force", {"x": force, "y": ParameterEstimate(3.0, -5.0, 11.0, "N")})
    wide = widened(estimate, [{"x": 20.0, "y": 40.0}, {"x": 150.0, "y": -40.0}, {"x": 70.0, "y": 0.0}], 3).parameters
    assert 0.0 < wide["x"].low < 60.0 and wide["x"].high > 150.0
    assert wide["y"].low < -40.0 and wide["y"].high > 40.0
    limit = EffectEstimate("drive_loss", {"loss": ParameterEstimate(0.9, 0.85, 0.95, "-")})
    assert widened(limit, [{"loss": 0.5}, {"loss": 1.0}, {"loss": 0.9}], 3).parameters["loss"].high == 1.0
    alone = widened(limit, [{"loss": 0.5}], 3)
    assert alone.parameters == limit.parameters


def test_terms_of_a_formula_whose_interval_holds_zero_are_left_out(husky, monkeypatch):
    """A torque turns the robot; a drag that the fit adds to it says nothing."""
    hidden = (("learned_term", {"torque_z:1": 60.0}),)
    motion, commands = simulated_recording(husky, hidden, seconds=60.0)
    evidence, windows = windows_of(motion, commands)
    search = explain(evidence, husky, windows, None, SETTINGS, repeated=True).search
    both = (*search.known, ("learned_term", {"torque_z:1": 50.0, "force_x:vx|vx|": 5.0}))
    monkeypatch.setattr("monoforce_ros.discrepancy.selection.learned_terms", lambda *_: [both])
    before = search.estimates(search.refit(both))[-1].parameters
    assert before["force_x:vx|vx|"].holds(0.0) and not before["torque_z:1"].holds(0.0)
    assert dict(search.learn().effects)["learned_term"].keys() == {"torque_z:1"}
