"""The live gap: injected model errors are measured with their size and regime, and noise is recognised as noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CommandTrack, MotionState, MotionTrack
from monoforce_ros.perception import FlatTerrain, Observation
from monoforce_ros.prediction import HORIZONS, LiveGap, Predictor
from monoforce_ros.prediction.monitor import odometry_noise
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults

START = 1_000_000_000_000


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def predictor_of(robot) -> Predictor:
    return Predictor(robot, FlatTerrain(robot, Grid.square(), TerrainDefaults()))


def drive(
    robot, twists: np.ndarray, noise: float = 0.0, heading_noise: float = 0.0
) -> tuple[MotionTrack, CommandTrack]:
    """Motion of a robot that behaves exactly as its model, on level ground, at 50 Hz."""
    predictor = Predictor(
        robot, FlatTerrain(robot, Grid.square(200.0, 1.0), TerrainDefaults()), horizon=len(twists) / 100
    )

    still = MotionState(START, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    commanded = np.concatenate([np.zeros((predictor.history, 2)), twists])
    terrain = predictor.source.terrain(Observation(START), still)
    rolled = predictor.roll_out(terrain, [still], commanded[None])
    every = slice(None, None, 2)
    rotations = rolled.rotation[0, every].double()
    random = np.random.default_rng(0)
    count = len(rotations)
    shaken = Rotation.from_euler("z", random.normal(0, heading_noise, (count, 1)))
    turned = Rotation.from_matrix(rotations.numpy()) * shaken

    def body(values: torch.Tensor) -> np.ndarray:
        return torch.einsum("tji,tj->ti", rotations, values[0, every].double()).numpy()

    stamps = START + np.arange(count) * 20_000_000
    motion = MotionTrack(
        stamps=stamps,
        positions=rolled.position[0, every].double().numpy() + random.normal(0, noise, (count, 3)) * [1, 1, 0],
        quaternions=turned.as_quat(),
        linear_velocities=body(rolled.velocity),
        angular_velocities=body(rolled.angular_velocity),
        frame_id="odom",
        child_frame_id="base_link",
    )
    return motion, CommandTrack(START + np.arange(len(twists)) * 10_000_000, twists)


def watched(robot, motion: MotionTrack, commands: CommandTrack, timeout: float = np.inf) -> LiveGap:
    """The gap after a recording with two predictions a second."""
    predictor = predictor_of(robot)
    gap = LiveGap(predictor, timeout)
    for stamp in range(START + 2_000_000_000, int(motion.stamps[-1]), 500_000_000):
        state = motion.at(stamp)
        # As the node does: the current command is held, whatever follows.
        held = commands.sample(np.minimum(predictor.command_stamps(stamp), stamp), timeout=timeout)
        gap.remember(predictor.predict(Observation(stamp), state, held))
        now = motion.stamps <= stamp
        known = replace(
            motion,
            **{
                name: getattr(motion, name)[now]
                for name in ("stamps", "positions", "quaternions", "linear_velocities", "angular_velocities")
            },
        )
        gap.compare(known, commands)
    return gap


def weaving(seconds: float) -> np.ndarray:
    """Straight for 6 s, turning for 6 s, and so on."""
    steps = np.arange(round(100 * seconds))
    turning = (steps // 600) % 2 == 1
    return np.column_stack([np.full(len(steps), 0.6), np.where(turning, 0.7, 0.0)])


def test_an_exact_model_has_no_gap_although_commands_change(husky):
    motion, commands = drive(husky, weaving(40.0))
    found = watched(husky, motion, commands).summary()
    assert found.count >= 30
    assert found.position[1] < 0.02 and found.position[2] < 0.05 and found.heading[2] < 0.03
    assert not found.excessive and found.floor[1] < 0.01


def test_the_gap_of_a_weak_drive_has_the_expected_size(husky):
    weak = replace(husky, effects=(("drive_gain", {"gain": 0.7}),))
    motion, commands = drive(weak, np.column_stack([np.full(3000, 0.8), np.zeros(3000)]))
    found = watched(husky, motion, commands).summary()
    # The speed is three tenths of 0.8 m/s too low.
    for i, horizon in enumerate(HORIZONS):
        assert found.position[i] == pytest.approx(0.3 * 0.8 * horizon, rel=0.1)
    assert found.excessive
    repaired = watched(weak, motion, commands).summary()
    assert repaired.position[2] < 0.05 * found.position[2] and not repaired.excessive


def test_the_regime_with_the_error_is_named(husky):
    scrubbing = replace(husky, effects=(("turning_scrub", {"track_width_factor": 1.8}),))
    motion, commands = drive(scrubbing, weaving(60.0))
    found = watched(husky, motion, commands).summary()
    assert found.worst == "turning"
    assert watched(scrubbing, motion, commands).summary().worst == ""


def test_noise_is_recognised_as_noise(husky):
    motion, commands = drive(husky, weaving(40.0), noise=0.03, heading_noise=0.02)
    spread, turn = odometry_noise(motion)
    assert spread == pytest.approx(0.03, rel=0.15) and turn == pytest.approx(0.02, rel=0.15)
    found = watched(husky, motion, commands).summary()
    assert 0.5 < found.position[1] / found.floor[1] < 2.0
    assert not found.excessive


def test_a_base_that_stops_without_new_commands_has_no_gap(husky):
    twists = np.where(np.arange(1500)[:, None] < 350, [1.0, 0.0], [0.0, 0.0])
    motion, commands = drive(husky, twists)
    # The planner fell silent after 3 s, and the base stopped half a second later.
    silent = CommandTrack(commands.stamps[:300], commands.twists[:300])
    found = watched(husky, motion, silent, timeout=0.5).summary()
    assert found.count > 10 and found.position[1] < 0.05 and not found.excessive
    assert watched(husky, motion, silent).summary().position[1] > 0.5


def test_nothing_is_compared_before_the_horizon_has_passed_or_after_a_time_jump(husky):
    motion, commands = drive(husky, weaving(8.0))
    predictor = predictor_of(husky)
    gap = LiveGap(predictor)
    stamp = START + 4_000_000_000
    gap.remember(
        predictor.predict(Observation(stamp), motion.at(stamp), commands.sample(predictor.command_stamps(stamp)))
    )
    assert gap.compare(motion, commands) is None and gap.summary().count == 0
    assert np.isnan(gap.summary().position).all() and not gap.summary().excessive
    gap.clear()
    later = replace(motion, stamps=motion.stamps + 10**10)
    assert gap.compare(later, commands) is None


def test_a_prediction_from_before_a_jump_of_the_odometry_is_not_compared(husky):
    motion, commands = drive(husky, np.tile([0.5, 0.0], (900, 1)))
    later = motion.stamps > START + 3 * 10**9
    moved = replace(motion, positions=motion.positions + np.where(later, 100.0, 0.0)[:, None])
    # Another estimator: only its own poses are kept.
    switched = replace(moved, **{name: getattr(moved, name)[later] for name in (
        "stamps", "positions", "quaternions", "linear_velocities", "angular_velocities")})  # fmt: skip
    for track in (moved, switched):
        gap = LiveGap(predictor_of(husky))
        start = motion.at(START + 10**9)
        gap.remember(gap.predictor.predict(Observation(start.stamp), start, np.tile([0.5, 0.0], (900, 1))[: len(
            gap.predictor.command_stamps(start.stamp))]))  # fmt: skip
        assert gap.compare(track, commands) is None and not gap.summary().count
    whole = LiveGap(predictor_of(husky))
    whole.remember(whole.predictor.predict(Observation(start.stamp), start, np.tile([0.5, 0.0], (900, 1))[: len(
        whole.predictor.command_stamps(start.stamp))]))  # fmt: skip
    assert whole.compare(motion, commands) is not None
