"""What makes a diagnosis meaningless is found by one check, by `diagnose` and by `evaluate --check` alike."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, SmoothedMotion, builders, smooth
from monoforce_ros.core import CommandTrack, EffortTrack, MotionTrack, WheelTrack
from monoforce_ros.discrepancy import Evidence, cli, diagnose, motion_faults
from monoforce_ros.discrepancy.ground import LEVEL_SLOPE, slopes_of
from monoforce_ros.evaluation.check import check_bag
from monoforce_ros.robots import load_robot

START = 1_700_000_000_000_000_000
STEP = 0.05
SECONDS = 40.0


def commanded(seed=3):
    """Random steps of speed and yaw rate, held for 2 s."""
    random = np.random.default_rng(seed)
    return np.repeat(random.uniform([0.1, -0.8], [0.9, 0.8], (round(SECONDS / 2), 2)), round(2 / STEP), axis=0)


def recorded(*, delay=0.2, noise=0.0, slope=0.0, mounting=0.0):
    """A robot that follows its commands late, on a slope along the odometry frame's x axis."""
    twists = commanded()
    stamps = START + np.rint(np.arange(len(twists)) * STEP * 1e9).astype(np.int64)
    commands = CommandTrack(stamps, twists)
    done = commands.sample(stamps - round(1e9 * delay))
    heading = np.cumsum(done[:, 1]) * STEP
    random = np.random.default_rng(1)
    places = np.cumsum(done[:, :1] * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0) * STEP
    positions = np.c_[places, places[:, 0] * np.tan(slope)] + noise * random.standard_normal((len(twists), 3))
    tilt = Rotation.from_euler("y", -slope)  # uphill along x: nose up
    turns = tilt * Rotation.from_euler("z", heading[:, None]) * Rotation.from_euler("y", mounting)
    zeros = np.zeros((len(twists), 3))
    linear, angular = zeros.copy(), zeros.copy()
    linear[:, 0], angular[:, 2] = done.T
    return MotionTrack(stamps, positions, turns.as_quat(), linear, angular), commands


def constant_heading(motion, commands):
    return replace(motion, quaternions=np.tile([0.0, 0, 0, 1], (len(motion), 1))), commands


def standing(motion, commands):
    still = np.zeros((len(motion), 3))
    return MotionTrack(motion.stamps, still, np.tile([0.0, 0, 0, 1], (len(motion), 1)), still, still), commands


def nothing_commanded(motion, commands):
    return motion, CommandTrack(commands.stamps, 0 * commands.twists)


def apart(motion, commands):
    return motion, CommandTrack(commands.stamps + 300 * 10**9, commands.twists)


def a_little_apart(motion, commands):
    return motion, CommandTrack(commands.stamps + 7 * 10**9, commands.twists)


def unrelated(motion, commands):
    return motion, CommandTrack(commands.stamps, commanded(seed=77))


def sideways(motion, commands):
    turn = Rotation.from_euler("z", np.pi / 2)
    return replace(motion, quaternions=(Rotation.from_quat(motion.quaternions) * turn).as_quat()), commands


def upside_down(motion, commands):
    turn = Rotation.from_euler("x", np.pi)
    return replace(motion, quaternions=(Rotation.from_quat(motion.quaternions) * turn).as_quat()), commands


FAULTS = [
    (constant_heading, "orientation never changes"),
    (standing, "does not move although commands reach"),
    (nothing_commanded, "nothing is commanded"),
    (apart, "do not overlap in time"),
    (a_little_apart, r"-[67]\.\d s later"),
    (unrelated, "does not follow the commands"),
    (sideways, r"drives sideways, (8|9)\d°"),
    (upside_down, "upside down"),
]


def write_bag(path, motion, commands, wheels=None):
    """A bag of poses and commands."""
    messages = []
    for i, stamp in enumerate(motion.stamps):
        parts = (motion.positions[i], motion.quaternions[i], motion.linear_velocities[i], motion.angular_velocities[i])
        messages.append((int(stamp), "/odom", builders.odometry(int(stamp), "odom", "base_link", *parts)))
    for stamp, twist in zip(commands.stamps, commands.twists, strict=True):
        messages.append((int(stamp), "/cmd_vel", builders.twist_stamped(int(stamp), "base_link", *twist)))
    with BagWriter(path) as bag:
        for stamp, topic, message in sorted(messages, key=lambda entry: entry[0]):
            bag.write(topic, message, stamp)
    return path


def test_a_recording_without_faults_has_none():
    for noise in (0.0, 0.02):
        motion, commands = recorded(noise=noise)
        assert motion_faults(smooth(motion), commands) == ()


@pytest.mark.parametrize(("fault", "text"), FAULTS, ids=[fault.__name__ for fault, _ in FAULTS])
def test_a_fault_stops_both_tools(tmp_path, capsys, fault, text):
    motion, commands = fault(*recorded(noise=0.005))
    bag = write_bag(tmp_path / "bag", motion, commands)
    check = check_bag(bag, load_robot("husky"))
    assert not check.usable
    assert cli.main([str(bag), "--out", str(tmp_path / "out"), "--quiet"]) == cli.NOT_IDENTIFIABLE_STATUS
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["verdict"] == "not_identifiable" and report["effects"] == []
    (said,) = report["advice"]
    assert re.search(text, said)
    assert any(finding.text == said for finding in check.findings)
    assert said in capsys.readouterr().out
    assert "cannot be diagnosed" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("seconds", [2.5, 3.6])
def test_a_short_recording_of_a_moving_robot_is_not_said_to_stand(seconds):
    """As a bag that was cut off: windows begin in less than two of its seconds."""
    motion, commands = recorded(noise=0.01)
    kept = motion.stamps < START + 1e9 * (4.0 + seconds)
    kept &= motion.stamps >= START + 4e9
    arrays = {name: value[kept] for name, value in vars(motion).items() if isinstance(value, np.ndarray)}
    short = replace(motion, **arrays)
    assert motion_faults(smooth(short), commands, None) == ()
    (fault,) = motion_faults(smooth(standing(short, commands)[0]), commands, None)
    assert fault.startswith("the robot does not move although commands reach")


def test_wheels_that_turn_while_the_robot_does_not_are_said():
    motion, commands = standing(*recorded())
    speeds = commands.twists[:, :1] + np.outer(commands.twists[:, 1], [-0.3, 0.3])
    (text,) = motion_faults(smooth(motion), commands, WheelTrack(commands.stamps, speeds / 0.165))
    assert "wheels turn" in text and "off the ground" in text
    # The same without motion of the wheels is another fault.
    (text,) = motion_faults(smooth(motion), commands, WheelTrack(commands.stamps, 0 * speeds))
    assert "motors off" in text


def test_motors_that_work_while_the_robot_stands_say_that_it_is_blocked():
    motion, commands = standing(*recorded())
    # Ten seconds of nothing, and then what it was commanded before, which the robot cannot follow.
    pause = np.arange(200) * 50_000_000 + commands.stamps[0]
    later = CommandTrack(
        np.r_[pause, commands.stamps + 10 * 10**9], np.r_[np.zeros((200, 2)), np.maximum(commands.twists, 0.1)]
    )
    stamps = np.arange(pause[0], later.stamps[-1], 50_000_000)
    asked = (np.abs(later.sample(stamps)) > 0.05).any(axis=1)
    noise = np.abs(0.2 * np.random.default_rng(0).standard_normal((len(stamps), 2)))
    working = EffortTrack(stamps, 1.0 + noise + 7.0 * asked[:, None])
    (text,) = motion_faults(smooth(motion), later, None, working)
    assert "its motors work" in text and "blocked" in text and "motors off" not in text
    times = float(text.split("they draw ")[1].split(" times")[0])
    assert times == pytest.approx(8.16 / 1.16, rel=0.05)
    # Motors that are off draw what they draw without commands.
    (text,) = motion_faults(smooth(motion), later, None, EffortTrack(stamps, 1.0 + noise))
    assert "motors off" in text
    (text,) = motion_faults(smooth(motion), later, None, None)
    assert "motors off" in text


def blocked(motion, commands, after=6.0):
    """The robot stands from some time on, with a trembling body, and its wheels turn as commanded."""
    index = np.minimum(np.arange(len(motion)), round(after / STEP))
    tremble = 0.02 * np.random.default_rng(4).standard_normal((len(motion), 3))
    stays = (index == index[-1])[:, None]
    stopped = replace(
        motion,
        positions=motion.positions[index],
        quaternions=motion.quaternions[index],
        linear_velocities=np.where(stays, tremble, motion.linear_velocities),
        angular_velocities=np.where(stays, tremble, motion.angular_velocities),
    )
    speeds = commands.twists[:, :1] + np.outer(commands.twists[:, 1], [-0.3, 0.3])
    return stopped, commands, WheelTrack(commands.stamps, speeds / 0.165)


def test_a_robot_that_is_blocked_after_a_few_metres_has_no_wrong_topic():
    motion, commands, wheels = blocked(*recorded())
    (text,) = motion_faults(smooth(motion), commands, wheels)
    assert text.startswith("the wheels follow the commands") and "blocked" in text and "topic" not in text
    # Without wheel speeds the commands may as well be another robot's, and so they may if the wheels follow others.
    for track in (None, WheelTrack(wheels.stamps, np.roll(wheels.speeds, 333, axis=0))):
        (text,) = motion_faults(smooth(motion), commands, track)
        assert "wrong topic" in text
    found = diagnose(Evidence(smooth(motion), commands, wheels=wheels), load_robot("husky"))
    assert found.verdict == "not_identifiable" and found.advice[0].startswith("the wheels follow the commands")
    assert any("the robot stays where it is" in text for text in found.remarks)
    assert len(found.advice) == 1


def test_a_pulled_robot_is_not_unrelated_to_its_commands():
    motion, commands = recorded()
    # The yaw rate has nothing to do with its command, the speed has.
    heading = np.cumsum(0.6 * np.sin(np.arange(len(motion)) * 0.011)) * STEP
    places = np.cumsum(
        motion.linear_velocities[:, :1] * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0
    ) * STEP  # fmt: skip
    pulled = replace(
        motion,
        positions=np.c_[places, np.zeros(len(places))],
        quaternions=Rotation.from_euler("z", heading[:, None]).as_quat(),
    )
    assert motion_faults(smooth(pulled), commands) == ()


def test_clocks_apart_by_less_than_two_seconds_are_an_effect():
    motion, commands = recorded()
    assert motion_faults(smooth(motion), CommandTrack(commands.stamps + 1_500_000_000, commands.twists)) == ()


def test_commissioning_and_python_callers_stop_too():
    motion, commands = constant_heading(*recorded())
    found = diagnose(Evidence(smooth(motion), commands), load_robot("husky"))
    assert found.verdict == "not_identifiable" and "orientation never changes" in found.advice[0]


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_slopes_show_in_the_poses_but_a_tilted_mount_does_not(noise):
    def slope(**settings):
        return slopes_of(smooth(recorded(noise=noise, **settings)[0]))

    assert slope().total < 0.5 * LEVEL_SLOPE
    assert slope(mounting=np.radians(6.0)).total < LEVEL_SLOPE
    steep = slope(slope=np.radians(8.0))
    assert steep.total == pytest.approx(np.radians(8.0), rel=0.25)
    assert steep.plane == pytest.approx(np.radians(8.0), rel=0.02) and steep.uneven < 0.5 * LEVEL_SLOPE
    motion, _ = recorded(noise=noise)
    waves = 0.3 * np.sin(1.5 * motion.positions[:, 0]) * np.cos(1.2 * motion.positions[:, 1])
    # A gentle tilt of all hills is most of the variance of the heights over a long way, and little of the slope.
    for tilt in (0.0, 0.06):
        heights = waves + tilt * motion.positions[:, 0]
        hills = replace(motion, positions=np.c_[motion.positions[:, :2], heights])
        rough = slopes_of(SmoothedMotion(hills, 0.005, 0.002, (slice(0, len(motion)),)))
        assert rough.uneven > LEVEL_SLOPE
        assert rough.plane == pytest.approx(tilt, abs=0.03)
