"""Recordings whose odometry describes another frame than the one that lengths in the robot file refer to."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest

from monoforce_ros.bags import BagError, BagWriter, ReadOptions, Recording, builders
from monoforce_ros.core import pose_matrix
from monoforce_ros.discrepancy import read_evidence
from monoforce_ros.evaluation import evaluate_recording
from monoforce_ros.perception import FlatTerrain
from monoforce_ros.physics import PhysicsOptions
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults

START = 1_700_000_000_000_000_000
FOOTPRINT = pose_matrix([0.1, 0.0, -0.1323, 0.0, 0.0, 0.2])
"""Pose of the odometry's child frame in base_link."""


@pytest.fixture(scope="module")
def recording(demo_bag) -> Recording:
    return Recording.open(demo_bag)


@pytest.fixture(scope="module")
def displaced(recording) -> Recording:
    """The same drive, as odometry of base_footprint tells it, with its place on the robot in the transforms."""
    motion = recording.motion.of_base(np.linalg.inv(FOOTPRINT), "base_footprint")
    transforms = recording.static_transforms | {("base_link", "base_footprint"): FOOTPRINT}
    return replace(recording, motion=motion, static_transforms=transforms)


def test_the_offset_restores_the_base_s_motion(recording, displaced):
    found = displaced.in_base_frame("base_link").motion
    np.testing.assert_allclose(found.positions, recording.motion.positions, atol=1e-9)
    np.testing.assert_allclose(found.linear_velocities, recording.motion.linear_velocities, atol=1e-9)
    assert found.child_frame_id == "base_link"
    given = replace(displaced, static_transforms={}).in_base_frame("base_link", FOOTPRINT)
    np.testing.assert_allclose(given.motion.positions, recording.motion.positions, atol=1e-9)


def test_an_unknown_offset_is_refused_with_both_frames_and_the_missing_path(displaced):
    lost = replace(displaced, static_transforms={})
    with pytest.raises(BagError, match="frame 'base_footprint'.*refer to 'base_link'.*no transform has 'base_link' or"):
        lost.in_base_frame("base_link")


def test_data_in_the_odometry_frame_need_the_driver_s_own_topic(recording):
    with pytest.raises(BagError, match="odometry frame .odom. do not say where their sensor is.*record the driver"):
        recording.sensor_pose("odom", "base_link", {}, 0)


@pytest.mark.usefixtures("one_thread")
def test_errors_do_not_depend_on_the_frame_of_the_odometry(recording, displaced):
    robot = load_robot("husky")
    grid = Grid.square(12.8, 0.1)
    predictor = Predictor(
        robot, FlatTerrain(robot, grid, TerrainDefaults()), horizon=1.0, options=PhysicsOptions(time_step=0.01)
    )

    def error(of: Recording) -> float:
        found = evaluate_recording(of, predictor, horizons=(1.0,), stride=1.0, quiet=True)
        return float(np.nanmedian(found.errors("physics")[0][:, -1]))

    right = error(recording)
    assert error(displaced.in_base_frame("base_link")) == pytest.approx(right, abs=1e-4)
    # Without the offset the prediction starts beside the robot, and turned.
    assert error(displaced) > right + 0.02


def write(path, child: str, offset: str):
    """Odometry of ``child`` and base_link in it on /tf: ``fixed``, ``moving``, or ``absent``."""
    with BagWriter(path) as bag:
        for i in range(100):
            at = START + i * 50_000_000
            odometry = builders.odometry(at, "odom", child, [0.02 * i, 0, 0], [0, 0, 0, 1], [0.4, 0, 0], [0] * 3)
            bag.write("/odom", odometry, at)
            height = 0.1 + (0.002 * i if offset == "moving" else 0.0)
            if offset != "absent":
                pose = pose_matrix([0, 0, height, 0, 0, 0])
                bag.write("/tf", builders.transforms(at, child, {"base_link": pose}), at)
            bag.write("/tf", builders.transforms(at, "odom", {child: pose_matrix([0.02 * i, 0, 0, 0, 0, 0])}), at)
            bag.write("/cmd_vel", builders.twist(0.4, 0.0), at)
    return path


def test_transforms_on_tf_are_applied_whether_they_hold_still_or_move(tmp_path):
    fixed = Recording.open(write(tmp_path / "fixed", "base_footprint", "fixed"))
    assert fixed.in_base_frame("base_link").motion.positions[0, 2] == pytest.approx(0.1)
    # A stabilised footprint moves in the body: as online, each pose is completed by the newest transform.
    moving = Recording.open(write(tmp_path / "moving", "base_footprint", "moving"))
    heights = moving.in_base_frame("base_link").motion.positions[:, 2]
    np.testing.assert_allclose(heights[10:], 0.1 + 0.002 * np.arange(10, 100), atol=0.0021)
    # Through a frame that is fixed on the body.
    mast = replace(moving, static_transforms={("base_link", "mast"): pose_matrix([0, 0, 1.0, 0, 0, 0])})
    np.testing.assert_allclose(mast.in_base_frame("mast").motion.positions[:, 2], heights + 1.0, atol=1e-9)
    absent = Recording.open(write(tmp_path / "absent", "base_footprint", "absent"))
    with pytest.raises(BagError, match="offset between them is unknown"):
        absent.in_base_frame("base_link")


def test_evaluate_takes_the_offset_from_its_options(tmp_path, executables, ros_environment):
    bag = write(tmp_path / "absent", "base_footprint", "absent")
    command = [executables / "evaluate", "--check", bag]

    def run(*options: str):
        return subprocess.run(
            [*command, *options], env=ros_environment, capture_output=True, text=True, timeout=120, check=False
        )

    refused = run()
    assert refused.returncode == 1 and "the offset between them is unknown" in refused.stdout
    given = run("--odometry-child-pose", "0", "0", "-0.1", "0", "0", "0")
    assert given.returncode == 0 and "base_link is at (0.000, 0.000, 0.100) m" in given.stdout
    named = run("--base-frame", "base_footprint")
    assert named.returncode == 0 and "odom → base_footprint" in named.stdout


def test_a_diagnosis_needs_the_offset_as_an_evaluation_does(tmp_path):
    bag, robot = write(tmp_path / "absent", "base_footprint", "absent"), load_robot("husky")
    with pytest.raises(BagError, match=r"frame 'base_footprint'.*refer to 'base_link'.*--odometry-child-pose"):
        read_evidence(bag, robot, "flat")
    reading = ReadOptions(odometry_child_pose=(0.0, 0.0, -0.1, 0.0, 0.0, 0.0))
    evidence, recording = read_evidence(bag, robot, "flat", reading)
    assert recording.motion.child_frame_id == "base_link" and recording.odometry_child_frame == "base_footprint"
    assert evidence.smoothed.motion.positions[0, 2] == pytest.approx(0.1, abs=1e-3)
    # Another name of the same frame.
    evidence, recording = read_evidence(bag, robot, "flat", ReadOptions(base_frame="base_footprint"))
    assert evidence.smoothed.motion.positions[0, 2] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("tool", ["diagnose", "diagnose --commission", "fit_terrain", "train"])
def test_every_tool_asks_for_the_offset_and_has_the_option_that_it_names(tool, tmp_path, executables, ros_environment):
    bag = write(tmp_path / "absent", "base_footprint", "absent")
    name, *options = tool.split()
    command = [executables / name, *options, bag, "--out", tmp_path / "out"]

    def run(*more: str) -> str:
        return subprocess.run(
            [*command, *more], env=ros_environment, capture_output=True, text=True, timeout=300, check=False
        ).stderr

    refused = run()
    assert "'base_footprint'" in refused and "'base_link'" in refused and "--odometry-child-pose X Y Z" in refused
    given = run("--odometry-child-pose", "0", "0", "-0.1", "0", "0", "0")
    assert "offset" not in given and "usage" not in given
