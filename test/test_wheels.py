"""Wheels: how drives follow commands, wheels that turn in place, and stretches that nobody commanded."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import Recording, SmoothedMotion
from monoforce_ros.core import CommandTrack, MotionTrack, WheelTrack
from monoforce_ros.discrepancy import commissioning
from monoforce_ros.discrepancy.comparison import compare
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.gap import noisy_motions
from monoforce_ros.discrepancy.healthy_wheels import HealthyWheels, drives_of
from monoforce_ros.discrepancy.left_out_stretches import LeftOut
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.wheel_motion import undriven_stretches, wheels_without_motion
from monoforce_ros.discrepancy.wheel_units import contradictions, in_rad_per_second, wheel_unit
from monoforce_ros.discrepancy.wheels import best_of, changed_drives, compare_with_wheels
from monoforce_ros.effects import CATALOGUE, drive_speeds, effect_values
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import RobotFileError, load_robot, robot_file
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")
ORIGIN = 10**18


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def drawn_commands(seconds, seed, hold=2.0):
    """Random steps of the twist, published at 20 Hz."""
    random = np.random.default_rng(seed)
    count = round(seconds / hold)
    twists = np.repeat(random.uniform([-0.4, -1.8], [1.0, 1.8], (count, 2)), round(hold / 0.05), axis=0)
    return CommandTrack(ORIGIN + np.arange(len(twists)) * 50_000_000, twists)


def wheels_of(commands, robot, effects, *, rate=14.0, noise=0.05, seed=2):
    """Wheel speeds as measured by joint states, with effects between commands and wheels."""
    seconds = (commands.stamps[-1] - commands.stamps[0]) * 1e-9
    stamps = commands.stamps[0] + np.arange(round(seconds / 0.01)) * 10_000_000
    commanded = torch.as_tensor(commands.sample(stamps)[None], dtype=torch.float32)
    # Stamps that share no multiple with those of the commands, as of two computers.
    every = round(100 / rate)
    speeds = drive_speeds(replace(robot, effects=effects), commanded, 0.01)[0, ::every].double().numpy()
    measured = speeds / robot.wheel_radius + noise * np.random.default_rng(seed).standard_normal(speeds.shape)
    return WheelTrack(stamps[::every], measured)


HUSKY_BASE = (
    ("yaw_rate_limit", {"limit": 1.0}),
    ("acceleration_limit", {"limit": 1.9}),
    ("yaw_acceleration_limit", {"limit": 1.9}),
    ("command_delay", {"delay": 0.2}),
)


@pytest.mark.parametrize(
    "effects",
    [
        HUSKY_BASE,
        (("yaw_acceleration_limit", {"limit": 1.2}),),
        (("supply_sag", {"sag": 0.4}),),
        (("drive_loss", {"loss": 0.4}),),
        (("drive_loss", {"loss": -1.0}),),
        (("drive_droop", {"loss": 0.2, "recovery": 1.5}),),
        (("actuator_lag", {"time_constant": 0.2}), ("drive_droop", {"loss": 0.15, "recovery": 1.0})),
        (("command_delay", {"delay": 0.3}), ("actuator_lag", {"time_constant": 0.2})),
    ],
)
def test_effects_of_the_drives_are_recovered_from_wheel_speeds(husky, effects):
    commands = drawn_commands(90.0, 5)
    found = compare_with_wheels(commands, wheels_of(commands, husky, effects), husky)
    assert {name for name, _ in found.effects} == {name for name, _ in effects}
    for (name, values), half_widths in zip(found.effects, found.half_widths, strict=True):
        for key, injected in dict(effects)[name].items():
            # Integral action is shown by what it did before a block, too, of which little is known.
            assert values[key] == pytest.approx(injected, rel=0.12 if key == "recovery" else 0.06, abs=0.015), key
            assert 0.0 < half_widths[key] < 0.1 * max(1.0, injected)


@pytest.mark.parametrize("gain", [0.9, 1.2])
def test_drives_that_multiply_every_command_are_not_called_slow_or_limited(husky, gain):
    commands = drawn_commands(90.0, 5)
    lag = ("actuator_lag", {"time_constant": 0.15})
    found = compare_with_wheels(commands, wheels_of(commands, husky, (("drive_gain", {"gain": gain}), lag)), husky)
    assert [name for name, _ in found.effects] == ["actuator_lag"]
    assert dict(found.effects)["actuator_lag"]["time_constant"] == pytest.approx(0.15, abs=0.02)
    assert found.gain == pytest.approx(gain, abs=0.02) and f"at {found.gain:.2f} times" in found.summary()
    plain = compare_with_wheels(commands, wheels_of(commands, husky, (lag,)), husky)
    assert plain.gain == 1.0 and "times" not in plain.summary()


def test_wheels_show_a_supply_that_drains(husky):
    commands = drawn_commands(90.0, 5)
    wheels = wheels_of(commands, husky, ())
    times = (wheels.stamps - commands.stamps[0]) * 1e-9
    drained = WheelTrack(wheels.stamps, wheels.speeds * (1.0 - 0.3 * times / 60.0)[:, None])
    found = compare_with_wheels(commands, drained, husky)
    assert [name for name, _ in found.effects] == ["supply_drain"]
    assert found.effects[0][1]["drain"] == pytest.approx(0.3, rel=0.05)
    assert "slower by 0.30 of their speed every minute" in found.summary()


@pytest.mark.parametrize("gain", [0.75, 0.95])
def test_wheels_that_become_slow_at_once_show_no_supply_that_drains(husky, gain):
    commands = drawn_commands(90.0, 5)
    wheels = wheels_of(commands, husky, ())
    late = wheels.stamps > commands.stamps[0] + 50 * 10**9
    found = compare_with_wheels(
        commands, WheelTrack(wheels.stamps, wheels.speeds * np.where(late, gain, 1.0)[:, None]), husky
    )
    assert found is None or "supply_drain" not in dict(found.effects)


def test_a_dead_time_is_found_though_it_is_a_small_share_of_the_error():
    """A fast robot with noisy wheel speeds and rare steps: the dead time removes less than 8 % of the squared error."""
    warthog, delays = load_robot("warthog"), []
    for seed in range(6):
        random = np.random.default_rng(seed)
        twists = np.repeat(random.uniform([-1.5, -2.0], [4.0, 2.0], (16, 2)), 300, axis=0)
        commands = CommandTrack(ORIGIN + np.arange(len(twists)) * 50_000_000, twists)
        wheels = wheels_of(commands, warthog, (("command_delay", {"delay": 0.25}),), noise=2.7, seed=seed)
        found = compare_with_wheels(commands, wheels, warthog)
        assert found.error_after**2 > 0.92 * found.error_before**2
        assert {name for name, _ in found.effects} <= {"command_delay"}
        delays += [values["delay"] for _, values in found.effects]
    assert len(delays) >= 4
    assert delays == pytest.approx([0.25] * len(delays), abs=0.04)


def test_noise_alone_shows_no_effect(husky):
    """At an error rate of 5 % for each size of model, and with values that count: hardly ever."""
    named = []
    for seed in range(8):
        commands = drawn_commands(60.0, 20 + seed)
        found = compare_with_wheels(commands, wheels_of(commands, husky, (), noise=0.6, seed=seed), husky)
        named += [name for name, _ in found.effects]
    assert len(named) <= 1, named


def test_a_limit_below_those_of_the_catalogue_stays_within_them(husky):
    """Values of the wheels are initial values of fits, which accept nothing else."""
    commands = drawn_commands(60.0, 12)
    commands = CommandTrack(commands.stamps, commands.twists * [1.0, 0.3])
    half = 0.5 * float((husky.drive_offsets.max() - husky.drive_offsets.min()).abs())
    speed, rate = commands.twists[::2, 0], np.clip(commands.twists[::2, 1], -0.02, 0.02)
    speeds = np.stack([speed - half * rate, speed + half * rate], axis=1) / husky.wheel_radius
    found = compare_with_wheels(commands, WheelTrack(commands.stamps[::2], speeds), husky)
    (limit,) = [values["limit"] for name, values in found.effects if name == "yaw_rate_limit"]
    low = next(p.low for p in CATALOGUE["yaw_rate_limit"].parameters)
    assert low <= limit < 0.1
    hints, _ = changed_drives(found, husky)
    for name, values in hints:
        assert effect_values(name, values)


def test_only_what_the_wheels_contradict_is_ruled_out(husky):
    commands = drawn_commands(60.0, 11)
    clear = compare_with_wheels(commands, wheels_of(commands, husky, (), noise=0.05), husky)
    assert {"actuator_deadband", "command_delay", "actuator_lag", "drive_loss"} <= set(clear.ruled_out)
    # A dead band beside a limit is not part of the wheels' model: they cannot tell that there is none.
    both = (("actuator_deadband", {"width": 0.05}), ("actuator_saturation", {"limit": 0.6}))
    hidden = compare_with_wheels(commands, wheels_of(commands, husky, both, noise=0.3), husky)
    assert "actuator_deadband" not in {name for name, _ in hidden.effects}
    assert "actuator_deadband" not in hidden.ruled_out
    assert "actuator_deadband" not in changed_drives(hidden, husky)[1]
    # Nor in noise that is larger than it.
    noisy = compare_with_wheels(commands, wheels_of(commands, husky, both[:1], noise=4.0), husky)
    assert noisy is None or "actuator_deadband" not in noisy.ruled_out


def test_a_long_recording_keeps_its_evidence_and_says_what_was_used(husky):
    commands = drawn_commands(1200.0, 7)
    wheels = wheels_of(commands, husky, (("command_delay", {"delay": 0.35}),))
    found = compare_with_wheels(commands, wheels, husky)
    assert [name for name, _ in found.effects] == ["command_delay"]
    assert found.effects[0][1]["delay"] == pytest.approx(0.35, abs=0.01)
    assert (found.used_blocks, found.all_blocks) == (60, 300)
    assert "60 of 300 blocks of 4 s, spread over the recording" in found.summary()


def test_the_limits_of_the_robot_file_are_no_effect(husky):
    """Commands beyond them are clamped in prediction: what the wheels do then is expected."""
    commands = drawn_commands(60.0, 9)
    narrow = replace(husky, maximum_yaw_rate=0.8)
    assert compare_with_wheels(commands, wheels_of(commands, narrow, ()), narrow).effects == ()
    found = compare_with_wheels(commands, wheels_of(commands, narrow, ()), husky)
    assert [name for name, _ in found.effects] == ["yaw_rate_limit"]
    assert found.effects[0][1]["limit"] == pytest.approx(0.8, abs=0.02)


def servo_wheels(commands, robot, time_constant, seed, *, late=None):
    """Wheels under servos with a limited torque, which no effect describes exactly; ``late`` from the middle on."""
    stamps = commands.stamps[0] + np.arange(round((commands.stamps[-1] - commands.stamps[0]) * 1e-7)) * 10_000_000
    commanded = torch.as_tensor(commands.sample(stamps)[None], dtype=torch.float32)
    wanted = drive_speeds(replace(robot, effects=()), commanded, 0.01)[0].double().numpy()
    speeds = np.zeros_like(wanted)
    for step in range(1, len(wanted)):
        slow = late if late is not None and step > len(wanted) // 2 else time_constant
        speeds[step] = speeds[step - 1] + 0.01 * np.clip((wanted[step] - speeds[step - 1]) / slow, -2.5, 2.5)
    measured = speeds[::7] / robot.wheel_radius
    return WheelTrack(stamps[::7], measured + 0.02 * np.random.default_rng(seed).standard_normal(measured.shape))


@pytest.fixture(scope="module")
def healthy_wheels(husky):
    commands = drawn_commands(90.0, 5)
    return compare_with_wheels(commands, servo_wheels(commands, husky, 0.2, 5), husky).model


@pytest.mark.parametrize("seed", [7, 11])
def test_wheels_as_when_the_robot_was_commissioned_show_no_change(husky, healthy_wheels, seed):
    commands = drawn_commands(60.0, seed)
    found = compare_with_wheels(commands, servo_wheels(commands, husky, 0.2, seed), husky, healthy_wheels)
    assert found.unchanged and found.effects == healthy_wheels.effects
    assert "as when the robot was commissioned, with a time constant" in found.summary()
    changed, unchanged = changed_drives(found, husky, healthy_wheels)
    assert changed == () and {"actuator_lag", "command_delay", "actuator_deadband", "drive_loss"} <= set(unchanged)
    # What they differ from is what was learned of the wheels, not what the motion made of it for the robot's file.
    alone = compare_with_wheels(commands, servo_wheels(commands, husky, 0.2, seed), husky)
    assert "actuator_lag" in dict(changed_drives(alone, husky)[0])


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_slower_drives_are_a_change_under_hard_and_under_gentle_commands(husky, healthy_wheels, share):
    commands = drawn_commands(60.0, 8)
    commands = CommandTrack(commands.stamps, share * commands.twists)
    found = compare_with_wheels(commands, servo_wheels(commands, husky, 0.35, 8), husky, healthy_wheels)
    assert not found.unchanged
    changed, _ = changed_drives(found, husky, healthy_wheels)
    assert dict(changed)["actuator_lag"]["time_constant"] == pytest.approx(0.35, abs=0.03)


def test_drives_that_become_slow_in_the_middle_are_not_ruled_out(husky, healthy_wheels):
    commands = drawn_commands(60.0, 13)
    found = compare_with_wheels(commands, servo_wheels(commands, husky, 0.2, 8, late=0.6), husky, healthy_wheels)
    assert not found.unchanged
    assert "actuator_lag" not in changed_drives(found, husky, healthy_wheels)[1]


def test_the_wheels_that_fit_all_commissioning_drives_best_are_kept(husky, healthy_wheels):
    recordings = [(commands, servo_wheels(commands, husky, 0.2, 3)) for commands in (drawn_commands(60.0, 3),)]
    other = replace(healthy_wheels, effects=(("actuator_lag", {"time_constant": 0.5}),))
    kept = best_of([other, healthy_wheels], recordings, husky)
    assert kept.effects == healthy_wheels.effects and kept.noise + kept.share > 0.0
    assert best_of([], recordings, husky) is None


def test_healthy_wheels_in_a_robot_file(tmp_path, husky, healthy_wheels):
    robot = replace(husky, effects=(("actuator_lag", {"time_constant": 0.21}), ("friction_scale", {"factor": 0.9})))
    known = replace(healthy_wheels, in_file=drives_of(robot.effects))
    assert known.in_file == (("actuator_lag", {"time_constant": 0.21}),)
    read = HealthyWheels.read(known.entry())
    assert read.effects[0][1]["time_constant"] == pytest.approx(known.effects[0][1]["time_constant"], rel=1e-4)
    assert read.ratio == pytest.approx(known.ratio, rel=1e-4) and read.share == pytest.approx(known.share, rel=1e-3)
    assert read.known_to(robot)
    # A fault that was found since then, and written into the file, is no longer the healthy robot.
    assert not read.known_to(replace(robot, effects=(("actuator_lag", {"time_constant": 0.4}),)))
    assert not read.known_to(replace(robot, effects=(*robot.effects, ("command_delay", {"delay": 0.1}))))
    for wrong in (
        {**known.entry(), "ratio_rad_m": 0.0},
        {**known.entry(), "share": float("nan")},
        {**known.entry(), "effects": {"friction_scale": {"factor": 0.5}}},
        {**known.entry(), "effects": {"actuator_lag": {"delay": 0.5}}},
        {key: value for key, value in known.entry().items() if key != "noise_m2_s2"},
        "none",
    ):
        content = {"samples_s": [2.0], "residual_rms": [[0.1, 0.1, 0.1]], "wheels": wrong}
        text = (husky_text := robot_file("husky").read_text()) + yaml.safe_dump({"commissioning": content})
        assert "commissioning:" not in husky_text
        (tmp_path / "husky.yaml").write_text(text)
        with pytest.raises(RobotFileError, match=r"husky\.yaml: commissioning"):
            NominalModel.read(tmp_path / "husky.yaml", (2.0,))


def driven(robot, commands, effects=(), noise=0.01):
    """Motion of our own physics at 20 Hz under commands, on level ground, with noise on positions."""
    steps = round((commands.stamps[-1] - commands.stamps[0]) * 1e-9 / 0.01)
    stamps = ORIGIN + np.arange(steps) * 10_000_000
    twists = torch.as_tensor(commands.sample(stamps)[None], dtype=torch.float32)
    robot = replace(robot, effects=effects)
    terrain = TerrainMap.flat(Grid.square(2.0, 1.0))
    result = rollout(terrain, robot, drive_speeds(robot, twists, 0.01), State.at_rest(0.13), with_forces=False)
    rotations = Rotation.from_matrix(result.rotation[0, :-1:5].double().numpy())
    positions = result.position[0, :-1:5].double().numpy()
    return MotionTrack(
        stamps[::5],
        positions + noise * np.random.default_rng(0).standard_normal(positions.shape),
        rotations.as_quat(),
        rotations.inv().apply(result.velocity[0, :-1:5].double().numpy()),
        rotations.inv().apply(result.angular_velocity[0, :-1:5].double().numpy()),
    )


def held(motion, low, high):
    """The motion with the robot held where it is from ``low`` to ``high`` [s], as by an obstacle."""
    positions, quaternions = motion.positions.copy(), motion.quaternions.copy()
    inside = slice(int(low * 20), int(high * 20))
    noise = positions[inside] - positions[inside].mean(axis=0)
    still = 0.01 * np.random.default_rng(1).standard_normal(noise.shape)
    positions[int(high * 20) :] -= positions[int(high * 20)] - positions[int(low * 20)]
    positions[inside], quaternions[inside] = positions[int(low * 20)] + still, quaternions[int(low * 20)]
    return replace(motion, positions=positions, quaternions=quaternions)


def test_wheels_that_turn_while_the_robot_stays_are_found_with_their_stretch(husky):
    commands = drawn_commands(60.0, 3)
    wheels, motion = wheels_of(commands, husky, ()), driven(husky, commands)
    assert wheels_without_motion(motion, wheels, commands, husky) is None
    found = wheels_without_motion(held(motion, 20.0, 32.0), wheels, commands, husky)
    assert found.side == "both" and found.share < 0.5
    low, high = ((stamp - ORIGIN) * 1e-9 for stamp in (found.stretches[0][0], found.stretches[-1][1]))
    assert low == pytest.approx(20.0, abs=2.0) and high == pytest.approx(32.0, abs=2.0)
    assert "the wheels turn" in found.summary() and "off the ground, dug in or blocked" in found.summary()
    jacked_up = wheels_without_motion(held(motion, 0.0, 59.5), wheels, commands, husky)
    assert jacked_up.share > 0.9 and "neither ground nor sensors" in jacked_up.summary()
    assert jacked_up.followed == pytest.approx(1.0, abs=0.02)
    # What cannot be compared is no finding.
    assert wheels_without_motion(motion, None, commands, husky) is None
    assert wheels_without_motion(motion, wheels, commands, load_robot("tradr")) is None


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (30.0 / np.pi, "revolutions per minute"),
        (180.0 / np.pi, "degrees per second"),
        # At the radius of a Husky revolutions per second and metres per second are alike.
        (0.5 / np.pi, "revolutions per second or metres per second"),
        (24.0, "of the motors before a gear"),
    ],
)
def test_wheel_speeds_of_another_unit_do_not_make_a_healthy_drive_stand(husky, factor, said):
    commands = drawn_commands(60.0, 3)
    wheels, motion = wheels_of(commands, husky, ()), driven(husky, commands)
    recorded = replace(wheels, speeds=factor * wheels.speeds)
    unit = wheel_unit(motion, recorded, commands, husky)
    taken = replace(recorded, speeds=recorded.speeds / unit.factor)
    assert said in unit.text and f"{factor:.2g}"[:2] in unit.text
    np.testing.assert_allclose(taken.speeds, wheels.speeds, rtol=0.05, atol=0.05)
    assert wheels_without_motion(motion, taken, commands, husky) is None
    assert len(undriven_stretches(commands, taken, motion, husky)) == 0
    # Wheels of any unit that turn while the robot stays are still found.
    stuck = held(motion, 0.0, 59.5)
    if factor > 1.0:
        # Slow wheels of a robot that stays may be slow drives.
        unit = wheel_unit(stuck, recorded, commands, husky)
        turning = replace(recorded, speeds=recorded.speeds / unit.factor)
        assert wheels_without_motion(stuck, turning, commands, husky)


@pytest.mark.parametrize("effects", [(), (("drive_gain", {"gain": 0.25}),), (("drive_loss", {"loss": -1.0}),)])
def test_wheel_speeds_in_rad_per_second_stay_though_drives_are_weak_or_the_robot_stands(husky, effects):
    commands = drawn_commands(60.0, 3)
    wheels, motion = wheels_of(commands, husky, effects), driven(husky, commands, effects)
    assert wheel_unit(motion, wheels, commands, husky).text == ""
    if not effects:
        assert wheel_unit(held(motion, 0.0, 59.5), wheels, commands, husky).text == ""


@pytest.mark.parametrize("limit", [0.0, 0.05, 0.1])
def test_wheels_that_stand_or_hardly_turn_are_in_no_other_unit(husky, limit):
    """Dead encoders, an emergency stop, or drives that reach 0.1 m/s: the robot hardly moves, or does not."""
    commands = drawn_commands(60.0, 3)
    effects = (("actuator_saturation", {"limit": max(limit, 0.05)}),)
    wheels, motion = wheels_of(commands, husky, effects), driven(husky, commands, effects)
    if not limit:
        wheels = replace(wheels, speeds=np.zeros_like(wheels.speeds))
        assert wheel_unit(driven(husky, commands), wheels, commands, husky).text == ""
    assert wheel_unit(motion, wheels, commands, husky).text == ""


def test_drives_of_a_commissioned_robot_whose_wheels_have_a_unit_of_their_own(husky, healthy_wheels):
    """Divided by its own ratio, a recording would show no drive that runs too slow."""
    commands, factor = drawn_commands(60.0, 3), 30.0
    slow = (("drive_gain", {"gain": 0.7}),)
    motion, wheels = driven(husky, commands, slow), wheels_of(commands, husky, slow)
    recorded = replace(wheels, speeds=factor * wheels.speeds)
    unit = wheel_unit(motion, recorded, commands, husky, known=factor)
    assert unit.factor == factor and "as when the robot was commissioned" in unit.text
    # Revolutions per minute, though the drives run 30 % slow.
    recorded = replace(wheels, speeds=30.0 / np.pi * wheels.speeds)
    assert "revolutions per minute" in wheel_unit(motion, recorded, commands, husky).text
    # A driver that publishes rad/s since then.
    assert wheel_unit(motion, wheels, commands, husky, known=factor).text == ""
    # Learned of speeds as they were recorded.
    old = in_rad_per_second(replace(healthy_wheels, ratio=factor / husky.wheel_radius), husky.wheel_radius)
    assert old.unit == pytest.approx(factor) and old.ratio == pytest.approx(1.0 / husky.wheel_radius)
    assert in_rad_per_second(healthy_wheels, husky.wheel_radius) == healthy_wheels
    assert HealthyWheels.read(old.entry()).unit == pytest.approx(factor)


def test_a_wrong_radius_or_track_width_in_the_robot_file_is_said(husky):
    commands = drawn_commands(90.0, 3, hold=3.0)
    # Every other stretch straight ahead.
    commands.twists[(np.arange(len(commands)) // 60) % 2 == 0, 1] = 0.0
    wheels, motion = wheels_of(commands, husky, ()), driven(husky, commands)
    assert contradictions(motion, wheels, commands, husky) == ((), ())
    (doubt,), _ = contradictions(motion, wheels, commands, replace(husky, wheel_radius=1.25 * husky.wheel_radius))
    assert "1.25 times as fast as commanded" in doubt and "a radius of 0.16" in doubt
    # As it was when the robot was commissioned, whose drives were learned with that ratio.
    known = 1.0 / husky.wheel_radius
    wide = replace(husky, wheel_radius=1.25 * husky.wheel_radius)
    assert contradictions(motion, wheels, commands, wide, known)[0] == ()
    narrow = replace(husky, drive_offsets=0.6 * husky.drive_offsets)
    _, (remark,) = contradictions(motion, wheels, commands, narrow)
    assert "differ by 1.67 times" in remark and "the base controller has one of 0.571 m" in remark
    # Drives that are too slow move the robot as slowly, which is an effect and no error of the file.
    slow = (("drive_gain", {"gain": 0.7}),)
    assert contradictions(driven(husky, commands, slow), wheels_of(commands, husky, slow), commands, husky)[0] == ()


@pytest.mark.parametrize("factor", [0.04, 0.1])
def test_a_robot_on_ice_moves(husky, factor):
    commands = drawn_commands(60.0, 4)
    wheels = wheels_of(commands, husky, ())
    motion = driven(husky, commands, (("friction_scale", {"factor": factor}),))
    assert wheels_without_motion(motion, wheels, commands, husky) is None


def test_wheels_of_one_side_that_turn_in_place(husky):
    """The left side stands in a hole: the robot turns about it."""
    count = 600
    stamps = ORIGIN + np.arange(count) * 50_000_000
    yaw = 0.4 * np.sin(0.5 * np.arange(count) * 0.05)
    half = 0.2854
    left = np.array([0.0, half, 0.0])
    rotations = Rotation.from_euler("z", yaw[:, None])
    positions = left - rotations.apply(left) + 0.003 * np.random.default_rng(3).standard_normal((count, 3))
    motion = MotionTrack(stamps, positions, rotations.as_quat(), np.zeros((count, 3)), np.zeros((count, 3)))
    rate = np.gradient(yaw, 0.05)
    wheels = WheelTrack(stamps, np.stack([np.full(count, 3.0), 2 * half * rate / husky.wheel_radius], axis=1))
    commands = CommandTrack(stamps[:1], np.array([[0.25, -0.87]]))
    found = wheels_without_motion(motion, wheels, commands, husky)
    assert found.side == "left" and "the left wheels turn" in found.summary()


def with_joystick(commands, low, high, *, silent):
    """Commands that are zero, or absent, from 3 s before ``low`` to ``high`` [s], and the twist really driven then."""
    times = (commands.stamps - ORIGIN) * 1e-9
    joystick = (times >= low) & (times < high)
    idle = (times >= low - 3.0) & (times < high)
    true = commands.twists.copy()
    true[idle & ~joystick] = 0.0
    recorded = np.where(idle[:, None], 0.0, commands.twists)
    first = np.flatnonzero(idle)[0]
    kept = ~idle | (np.arange(len(idle)) == first) if silent else np.ones(len(idle), bool)
    return CommandTrack(commands.stamps[kept], recorded[kept]), CommandTrack(commands.stamps, true)


@pytest.mark.parametrize("silent", [True, False])
@pytest.mark.parametrize("by_wheels", [True, False])
def test_stretches_driven_by_joystick_are_found(husky, silent, by_wheels):
    recorded, true = with_joystick(drawn_commands(80.0, 6), 30.0, 44.0, silent=silent)
    wheels = wheels_of(true, husky, HUSKY_BASE) if by_wheels else None
    motion = None if by_wheels else driven(husky, true, HUSKY_BASE)
    found = (undriven_stretches(recorded, wheels, motion, husky) - ORIGIN) * 1e-9
    assert len(found) == 1
    assert found[0] == pytest.approx([30.0, 44.5], abs=1.2)
    # Driven by commands alone there are none, even with slow drives.
    wheels = wheels_of(true, husky, HUSKY_BASE) if by_wheels else None
    assert len(undriven_stretches(true, wheels, motion, husky)) == 0


def test_what_somebody_drove_with_a_joystick_is_not_commissioned(husky):
    recorded, true = with_joystick(drawn_commands(80.0, 6), 30.0, 44.0, silent=False)
    motion = driven(husky, true, HUSKY_BASE)
    evidence = Evidence(SmoothedMotion(motion, 0.002, 0.001, (slice(0, len(motion)),)), recorded)
    entry = commissioning._prepare(evidence, husky, np.array([0.5, 1.0, 1.5, 2.0]), 1.0)
    starts = (entry.data.starts - ORIGIN) * 1e-9
    assert not ((starts > 31.0) & (starts < 43.0)).any()
    assert (starts < 29.0).any() and (starts > 46.0).any()


def test_what_somebody_drove_with_a_joystick_is_in_no_error_of_any_horizon(husky):
    recorded, true = with_joystick(drawn_commands(80.0, 6), 30.0, 44.0, silent=False)
    motion = driven(husky, true, HUSKY_BASE)
    smoothed = SmoothedMotion(motion, 0.002, 0.001, (slice(0, len(motion)),))
    evidence = Evidence(smoothed, recorded)
    data = evidence.cut(np.zeros(0, np.int64), np.array([2.0]))
    found = compare(husky, data, evidence, LeftOut.of(evidence, husky), None, noisy_motions(smoothed))
    assert [entry.horizon for entry in found] == [1.0, 2.0, 5.0]
    for entry in found:
        starts = (entry.starts - ORIGIN) * 1e-9
        assert not ((starts + entry.horizon > 31.5) & (starts < 43.0)).any()
        assert (starts < 25.0).any() and (starts > 46.0).any()


def test_a_base_that_keeps_its_last_command_is_driven_by_it(husky):
    commands = drawn_commands(60.0, 8)
    times = (commands.stamps - ORIGIN) * 1e-9
    silent = CommandTrack(*(part[(times < 20.0) | (times > 30.0)] for part in (commands.stamps, commands.twists)))
    wheels = wheels_of(silent, husky, ())
    assert len(undriven_stretches(silent, wheels, None, husky)) == 0


def test_a_joystick_does_not_spoil_what_the_drives_show(husky):
    recorded, true = with_joystick(drawn_commands(90.0, 6), 30.0, 54.0, silent=False)
    found = compare_with_wheels(recorded, wheels_of(true, husky, (("command_delay", {"delay": 0.3}),)), husky)
    assert [name for name, _ in found.effects] == ["command_delay"]
    assert found.effects[0][1]["delay"] == pytest.approx(0.3, abs=0.015)


def test_a_jacked_up_husky_is_told_from_one_on_wet_grass(husky, real_data):
    found = {}
    for name in ("husky_wheels_in_the_air", "husky_wet_grass"):
        folder = real_data / "doughnut" / name
        if not folder.is_dir():
            pytest.skip(f"no recording at {folder}")
        recording = Recording.open(folder)
        without = wheels_without_motion(recording.motion, recording.wheels, recording.commands, husky)
        drives = compare_with_wheels(recording.commands, recording.wheels, husky)
        found[name] = without, dict(drives.effects)
        assert len(undriven_stretches(recording.commands, recording.wheels, recording.motion, husky)) == 0
    lifted, grass = found["husky_wheels_in_the_air"][0], found["husky_wet_grass"][0]
    assert grass is None
    assert lifted.side == "both" and lifted.share > 0.8 and lifted.followed > 0.5
    # The drives are the same on the stand and on grass: limits of the base, no dead band.
    for _, drives in found.values():
        assert "actuator_deadband" not in drives
        assert drives["yaw_rate_limit"]["limit"] == pytest.approx(1.0, abs=0.05)
        assert drives["acceleration_limit"]["limit"] == pytest.approx(1.9, abs=0.25)
        assert drives["yaw_acceleration_limit"]["limit"] == pytest.approx(1.9, abs=0.2)
        # At 7 Hz wheels hardly tell a dead time from a lag; both together are the time that they follow late.
        late = drives.get("command_delay", {"delay": 0.0})["delay"]
        late += drives.get("actuator_lag", {"time_constant": 0.0})["time_constant"]
        assert 0.05 < late < 0.25
