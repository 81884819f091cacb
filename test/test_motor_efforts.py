"""Currents of the drives beside those of the healthy robot: said where they differ beyond chance, and never else."""

from dataclasses import fields, replace

import numpy as np
import pytest
from test_diagnose import simulated_recording
from test_headline import diagnosed

from monoforce_ros.bags import BagWriter, Recording, SmoothedMotion, builders
from monoforce_ros.core import CommandTrack, EffortTrack, WheelTrack
from monoforce_ros.datasets.drive import DriveRecording, DriveRun, drive_to_bag
from monoforce_ros.discrepancy import DiagnosisSettings, Evidence, diagnose
from monoforce_ros.discrepancy.headline import headline
from monoforce_ros.discrepancy.left_out_stretches import LeftOut
from monoforce_ros.discrepancy.motor_efforts import NOTHING, HealthyEfforts, changed_efforts
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.wheel_motion import half_track, side_speeds
from monoforce_ros.robots import load_robot, write_robot

HUSKY = load_robot("husky")


def drive(seed, factors=(1.0, 1.0), spread=0.1, seconds=120.0):
    """Speeds and turns at random, held for 3 s, with currents that vary from one 16 s to the next by ``spread``."""
    random = np.random.default_rng(seed)
    stamps = 10**9 + np.arange(round(seconds * 10)) * 100_000_000
    twists = np.repeat(random.uniform([-1.0, -0.8], [1.0, 0.8], (len(stamps) // 30 + 1, 2)), 30, axis=0)[: len(stamps)]
    commands = CommandTrack(stamps, twists)
    apart = half_track(HUSKY) * np.abs(twists[:, 1:2])
    currents = 2.0 + 3.0 * np.abs(side_speeds(HUSKY, twists)) + 8.0 * apart
    varies = np.exp(spread * random.standard_normal((len(stamps) // 160 + 1, 1)))
    currents = currents * np.repeat(varies, 160, axis=0)[: len(stamps)] * np.array(factors)
    return commands, EffortTrack(stamps, np.abs(currents + 0.3 * random.standard_normal(currents.shape)))


def learned(*drives, left_out=NOTHING):
    return HealthyEfforts.learned([(*entry, left_out) for entry in drives], HUSKY)


def said(drive_, healthy, wheels=None):
    return changed_efforts(*drive_, wheels, HUSKY, healthy)


def test_what_was_driven_with_a_joystick_counts_neither_as_healthy_nor_as_changed():
    """Commands fall silent at some speed, and a joystick drives slowly back."""
    motion, commands = simulated_recording(HUSKY, (), seconds=120.0)
    stamps = commands.stamps[::10]
    twists = commands.sample(stamps)
    currents = 2.0 + 3.0 * np.abs(side_speeds(HUSKY, twists)) + 8.0 * half_track(HUSKY) * np.abs(twists[:, 1:2])
    middle = len(stamps) // 6
    first = commands.stamps <= stamps[middle]
    silent = CommandTrack(commands.stamps[first], commands.twists[first])
    by_commands = (np.arange(len(stamps)) < middle)[:, None]
    wheels = WheelTrack(stamps, np.where(by_commands, side_speeds(HUSKY, twists), -0.3) / HUSKY.wheel_radius)
    evidence = Evidence(
        SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)),
        silent,
        wheels=wheels,
        efforts=EffortTrack(stamps, np.where(by_commands, currents, 0.5)),
    )
    stretches = LeftOut.of(evidence, HUSKY).stretches
    assert (np.diff(stretches, axis=1).sum() > 15e9) and stretches[0, 0] > stamps[middle]
    healthy = learned(drive(1), drive(2))
    assert changed_efforts(silent, evidence.efforts, wheels, HUSKY, healthy)
    nominal = NominalModel(np.tile([0.01, 0.01, 0.005], (4, 1)), efforts=healthy)
    found = diagnose(evidence, HUSKY, nominal=nominal, settings=DiagnosisSettings(sensors_only=True))
    assert not any("motors draw" in text for text in (*found.observed, *found.remarks))
    assert any("without commands (a joystick?)" in text for text in found.remarks)
    assert learned((silent, evidence.efforts), left_out=stretches) is None


def test_motors_that_draw_more_are_told_with_an_interval_and_the_other_side_is_not():
    healthy = learned(drive(1), drive(2))
    (text,) = said(drive(3, factors=(2.4, 1.0)), healthy)
    assert text.startswith("the left motors draw 2.")
    low, high = (float(number) for number in text.split("(")[1].split(")")[0].split(" to "))
    assert low < 2.4 < high and low > 1.5
    assert "brake" in text


def test_wheels_in_the_air_and_motors_that_are_off_are_told_apart_by_whether_the_wheels_turn():
    healthy = learned(drive(1), drive(2))
    idle = drive(3, factors=(0.2, 0.2))
    turning = WheelTrack(idle[0].stamps, side_speeds(HUSKY, idle[0].twists) / HUSKY.wheel_radius)
    texts = said(idle, healthy, turning)
    assert len(texts) == 2 and all(
        "while the wheels turn, hardly any: are the wheels off the ground" in t for t in texts
    )
    standing = WheelTrack(idle[0].stamps, 0.0 * turning.speeds)
    assert all("switched off" in text for text in said(idle, healthy, standing))
    assert all("blocked wheel" in text for text in said(drive(3, factors=(3.0, 3.0)), healthy, standing))


def test_healthy_drives_are_named_about_as_often_as_stated():
    """Drives of one robot differ by 0.7 of what its segments do, as ``drive_share`` says."""
    named, count = 0, 300
    for seed in range(count):
        random = np.random.default_rng(10_000 + seed)
        healthy = learned(drive(3 * seed))
        factor = np.exp(0.1 * np.sqrt(0.5) * random.standard_normal())
        named += bool(said(drive(3 * seed + 1, factors=(factor, factor)), healthy))
    # Both sides share the variation here, so that they alarm together: at least half of the stated 2.5 %.
    assert 0.003 < named / count < 0.05


def test_what_commissioning_learned_is_kept_in_the_robot_file(tmp_path):
    healthy = learned(drive(1), drive(2))
    samples = (0.5, 1.0, 1.5, 2.0)
    nominal = NominalModel(np.full((4, 3), 0.01), efforts=healthy)
    file = write_robot("husky", tmp_path / "husky.yaml", [], [], "0", nominal.entry(samples))
    read = NominalModel.read(file, samples).efforts
    np.testing.assert_allclose(read.coefficients, healthy.coefficients, rtol=1e-3)
    np.testing.assert_allclose(read.spread, healthy.spread, rtol=1e-2)
    assert read.segments == healthy.segments
    with pytest.raises(ValueError, match="0 or more"):
        HealthyEfforts.read(healthy.entry() | {"spread": {"left": float("nan"), "right": 0.1}})


def test_too_little_says_nothing():
    healthy = learned(drive(1))
    assert learned(drive(1, seconds=20.0)) is None
    commands, efforts = drive(1)
    assert learned((commands, efforts), (commands, None)) is None
    assert learned((commands, EffortTrack(efforts.stamps, 0.0 * efforts.efforts))) is None
    assert said(drive(2, factors=(9.0, 9.0), seconds=20.0), healthy) == ()
    assert changed_efforts(commands, None, None, HUSKY, healthy) == ()
    assert changed_efforts(commands, efforts, None, HUSKY, None) == ()
    still = CommandTrack(commands.stamps, 0.0 * commands.twists)
    assert changed_efforts(still, efforts, None, HUSKY, healthy) == ()


def test_an_observation_stands_in_the_diagnosis_and_names_no_effect():
    healthy = learned(drive(1), drive(2))
    motion, commands = simulated_recording(HUSKY, (), seconds=60.0)
    stamps = commands.stamps[::10]
    twists = commands.sample(stamps)
    currents = 2.0 + 3.0 * np.abs(side_speeds(HUSKY, twists)) + 8.0 * half_track(HUSKY) * np.abs(twists[:, 1:2])
    evidence = Evidence(
        SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),)),
        commands,
        efforts=EffortTrack(stamps, currents * np.array([1.0, 3.0])),
    )
    nominal = NominalModel(np.tile([0.01, 0.01, 0.005], (4, 1)), efforts=healthy)
    found = diagnose(evidence, HUSKY, nominal=nominal, settings=DiagnosisSettings(sensors_only=True))
    assert found.verdict == "no_discrepancy" and found.effects == ()
    (text,) = found.observed
    assert text.startswith("the right motors draw 3 times") and text in found.remarks
    assert text in headline(found).findings and "Nothing is wrong" not in headline(found).sentence
    assert text in headline(diagnosed((0.5, 0.06), (8.0, 1.0), observed=(text,))).findings


def test_efforts_are_read_from_joint_states_by_side_and_without_signs(tmp_path):
    names = ["front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel", "arm"]

    def recorded(name, efforts):
        with BagWriter(tmp_path / name) as bag:
            for k in range(40):
                at = 10**18 + k * 50_000_000
                pose = [np.array([0.02 * k, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3)]
                bag.write("/odom", builders.odometry(at, "odom", "base_link", *pose), at)
                bag.write("/joint_states", builders.joint_state(at, names, [0.0] * 5, [1.0] * 5, efforts), at)
        return Recording.open(tmp_path / name).efforts

    track = recorded("efforts", [-1.0, -3.0, 5.0, 6.0, 99.0])
    assert len(track) == 40
    np.testing.assert_allclose(track.efforts, np.tile([2.0, 5.5], (40, 1)))
    # Drivers without a measurement leave them out, or publish zeros or no numbers.
    for name, efforts in (("none", []), ("zeros", [0.0] * 5), ("nan", [np.nan] * 5)):
        assert recorded(name, efforts) is None


def test_currents_of_a_drive_log_reach_the_joint_states(real_data, tmp_path):
    log = real_data / "drive" / "warthog_wheels_grass_continuous_20hz.csv.gz"
    recording = DriveRecording.open(log)
    (run,) = recording.runs
    assert np.abs(run.currents).max(axis=0) == pytest.approx([11.1875, 50.25])
    # Ten seconds about the strongest current are enough.
    middle = int(np.abs(run.currents[:, 1]).argmax())
    part = slice(middle - 100, middle + 100)
    short = DriveRun(*(getattr(run, entry.name)[part] for entry in fields(run)))
    drive_to_bag(replace(recording, runs=(short,)), tmp_path / "grass")
    efforts = Recording.open(tmp_path / "grass").efforts
    np.testing.assert_allclose(efforts.efforts, np.abs(short.currents))
