"""The kinematic baseline recovers the parameters of a kinematic robot, and is tested on blocks it was not fitted to."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import AngularVelocityTrack, CommandTrack, MotionTrack, WheelTrack
from monoforce_ros.discrepancy import Evidence
from monoforce_ros.discrepancy.comparison import HeldOut
from monoforce_ros.discrepancy.dead_reckoning import MeasuredDrive, dead_reckoning_errors
from monoforce_ros.discrepancy.kinematic_baseline import (
    KinematicModel,
    compare_on_steps,
    fit_kinematics,
    position_errors,
    step_starts,
)
from monoforce_ros.discrepancy.step_errors import compare_after_steps
from monoforce_ros.robots import load_robot

TRUTH = KinematicModel(0.9, 0.6, 0.35, 0.3, 0.7, 5.0)


def recording(seconds=120.0, held=4.0):
    """A robot that is exactly kinematic, driven by steps of the command."""
    step = 0.05
    random = np.random.default_rng(5)
    twists = np.repeat(random.uniform([0.1, -0.9], [1.0, 0.9], (round(seconds / held), 2)), round(held / step), axis=0)
    stamps = 10**9 + np.arange(len(twists)) * round(step * 1e9)
    start = np.zeros((1, 2))
    # A fine time step, so that the truth does not depend on it.
    fine = 10
    path = TRUTH.drive(np.repeat(twists, fine, axis=0)[None], start, 0, step / fine)[0][fine - 1 :: fine]
    times = stamps + round(step * 1e9)
    velocities = np.gradient(path, step, axis=0)
    speed = np.hypot(velocities[:, 0], velocities[:, 1])
    zeros = np.zeros(len(path))
    motion = MotionTrack(
        times,
        np.c_[path[:, :2], zeros],
        Rotation.from_euler("z", path[:, 2:]).as_quat(),
        np.c_[speed, zeros, zeros],
        np.c_[zeros, zeros, velocities[:, 2]],
    )
    return motion, CommandTrack(stamps, twists)


def possible(motion):
    return np.arange(motion.stamps[0] + 3 * 10**9, motion.stamps[-1] - 3 * 10**9, 50_000_000)


def test_windows_begin_with_steps_of_the_command():
    motion, commands = recording()
    starts = step_starts(commands, possible(motion))
    steps = commands.stamps[1:][(np.diff(commands.twists, axis=0) != 0).any(axis=1)]
    assert 20 <= len(starts) <= len(steps)
    late = [(start - steps[steps <= start].max()) * 1e-9 for start in starts]
    assert max(late) <= 0.25
    constant = CommandTrack(commands.stamps, np.tile([0.5, 0.1], (len(commands), 1)))
    assert len(step_starts(constant, possible(motion))) == 0


def test_the_parameters_of_a_kinematic_robot_are_recovered():
    motion, commands = recording()
    found = fit_kinematics(motion, commands, step_starts(commands, possible(motion)))
    for name, tolerance in (("speed_gain", 0.03), ("yaw_gain", 0.03), ("delay", 0.05), ("lag", 0.06),
                            ("largest_speed", 0.03)):  # fmt: skip
        assert getattr(found, name) == pytest.approx(getattr(TRUTH, name), abs=tolerance), name
    with pytest.raises(ValueError, match="got no windows"):
        fit_kinematics(motion, commands, np.zeros(0, np.int64))


def test_neither_half_is_fitted_to_itself():
    motion, commands = recording()
    starts = step_starts(commands, possible(motion))
    folds = ((starts - starts[0]) // (8 * 10**9)) % 2

    def errors(at, halves):
        return np.full(len(at), 0.5), np.full(len(at), 0.1)

    found = compare_on_steps(motion, commands, starts, folds, errors)
    assert found.windows == len(starts)
    assert (found.before, found.after) == (0.5, 0.1)
    assert found.kinematic < 0.1 * found.ideal
    # Commands of one half that mean nothing spoil the errors of the other half only.
    wrong = CommandTrack(commands.stamps, commands.twists.copy())
    mask = ((wrong.stamps - starts[0]) // (8 * 10**9)) % 2 == 0
    wrong.twists[mask] *= -1
    model = fit_kinematics(motion, wrong, starts[folds == 0])
    assert np.median(position_errors(model, motion, commands, starts[folds == 1])) > 5 * found.kinematic
    assert compare_on_steps(motion, commands, starts[:4], folds[:4], errors) is None


@pytest.mark.usefixtures("one_thread")
def test_effects_and_kinematic_fit_are_compared_on_the_same_windows():
    motion, commands = recording(seconds=60.0)
    evidence = Evidence(SmoothedMotion(motion, 0.001, 0.001, (slice(0, len(motion)),)), commands)
    robot = load_robot("husky")
    # The values are those of another robot: they are fitted to the half that is not tested.
    effects = (("command_delay", {"delay": 0.1}), ("turning_scrub", {"track_width_factor": 1.0}))
    found = compare_after_steps(evidence, robot, effects)
    assert found.windows >= 10 and len(found.models) == 2
    assert found.after < 0.8 * found.before
    assert found.kinematic < 0.2 * found.before
    assert compare_after_steps(evidence, robot, ()).after is None
    still = CommandTrack(commands.stamps, np.tile([0.5, 0.1], (len(commands), 1)))
    assert compare_after_steps(Evidence(evidence.smoothed, still), robot, ()) is None


@pytest.mark.usefixtures("one_thread")
def test_each_part_is_predicted_with_what_was_found_without_it():
    """A search without the second part that found nothing leaves it to the nominal model, whatever the whole shows."""
    motion, commands = recording(seconds=96.0)
    evidence = Evidence(SmoothedMotion(motion, 0.001, 0.001, (slice(0, len(motion)),)), commands)
    robot = load_robot("husky")
    effects = (("command_delay", {"delay": 0.3}), ("turning_scrub", {"track_width_factor": 1.3}))
    first = int(motion.stamps[0]) + 3 * 10**9
    without = [compare_after_steps(evidence, robot, effects, HeldOut(found, first, 16.0)) for found in
               ((effects, effects, effects), (effects, (), effects), ((), (), ()))]  # fmt: skip
    assert all(found.selected_apart and len(found.models) == 3 for found in without)
    assert without[0].windows == without[1].windows <= compare_after_steps(evidence, robot, effects).windows
    assert without[0].after < without[1].after < without[1].before == without[0].before
    assert without[2].after == without[2].before
    assert not compare_after_steps(evidence, robot, effects).selected_apart


def measured_drive(motion, *, late, gyro):
    """Wheels that turn 1.2 times as fast against each other as the robot does, in poses that are late."""
    robot = load_robot("husky")
    half = 0.5 * float(robot.drive_offsets.max() - robot.drive_offsets.min())
    speed, turning = motion.linear_velocities[:, 0], motion.angular_velocities[:, 2]
    stamps = motion.stamps - round(late * 1e9)
    wheels = np.stack([speed - 1.2 * half * turning, speed + 1.2 * half * turning], axis=1) / robot.wheel_radius
    rates = AngularVelocityTrack(stamps, np.c_[turning, 0 * turning, -turning]) if gyro else None
    return robot, WheelTrack(stamps, wheels), rates


@pytest.mark.parametrize("gyro", [True, False])
def test_dead_reckoning_fits_gains_and_the_delay_of_the_poses(gyro):
    motion, commands = recording()
    robot, wheels, rates = measured_drive(motion, late=0.35, gyro=gyro)
    smoothed = SmoothedMotion(motion, 0.001, 0.001, (slice(0, len(motion)),))
    evidence = Evidence(smoothed, commands, gyro=rates, wheels=wheels)
    starts = step_starts(commands, possible(motion))
    folds = ((starts - starts[0]) // (8 * 10**9)) % 2
    errors = dead_reckoning_errors(evidence, robot, starts, np.array([0.5, 1.0, 1.5, 2.0]), folds)
    assert np.median(errors) < 0.02
    # Without the delay they would be decimetres.
    drive = MeasuredDrive.of(evidence, robot)
    punctual = drive.reckoned(starts, np.array([2.0]), np.array([1.0, 1.0 if gyro else 1 / 1.2, 0.0]))
    late = drive.reckoned(starts, np.array([2.0]), np.array([1.0, 1.0 if gyro else 1 / 1.2, 0.35]))
    assert np.median(np.hypot(*(punctual - late)[:, 0, :2].T)) > 0.1


def test_dead_reckoning_needs_wheel_speeds_without_gaps():
    motion, commands = recording()
    robot, wheels, _ = measured_drive(motion, late=0.0, gyro=False)
    smoothed = SmoothedMotion(motion, 0.001, 0.001, (slice(0, len(motion)),))
    starts = step_starts(commands, possible(motion))
    folds = ((starts - starts[0]) // (8 * 10**9)) % 2
    samples = np.array([1.0, 2.0])
    assert dead_reckoning_errors(Evidence(smoothed, commands), robot, starts, samples, folds) is None
    kept = np.abs(wheels.stamps - starts[len(starts) // 2] - 10**9) > 10**9
    broken = WheelTrack(wheels.stamps[kept], wheels.speeds[kept])
    assert dead_reckoning_errors(Evidence(smoothed, commands, wheels=broken), robot, starts, samples, folds) is None


def test_how_far_the_effects_are_ahead_has_an_interval():
    motion, commands = recording()
    starts = step_starts(commands, possible(motion))
    folds = ((starts - starts[0]) // (8 * 10**9)) % 2
    random = np.random.default_rng(3)

    def compared(size):
        def errors(at, _):
            return np.full(len(at), 1.0), size * random.uniform(0.5, 1.5, len(at))

        return compare_on_steps(motion, commands, starts, folds, errors)

    # A kinematic robot: no effects of a rollout are ahead of the kinematic fit.
    behind = compared(0.5)
    assert behind.ahead[0] < behind.ahead[1] < 0.0
    same = compared(behind.kinematic)
    assert same.ahead[0] < 0.0 < same.ahead[1]
