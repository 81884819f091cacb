"""Terrain from data: accumulated sweeps, map files, and terrain fitted to recorded motion."""

import dataclasses
import json
import subprocess

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import Recording, smooth
from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic.labels import GroundClass, labels_file
from monoforce_ros.synthetic.odometry import OdometrySettings
from monoforce_ros.synthetic.recording import RecordingSettings, record
from monoforce_ros.terrain import (
    Grid,
    TerrainDefaults,
    TerrainFileError,
    TerrainMap,
    accumulate,
    load_terrain,
    save_terrain,
)
from monoforce_ros.terrain.accumulation import count_neighbours
from monoforce_ros.training import FitSettings, fit_terrain
from monoforce_ros.training.fit_cli import FitFigures, existing_figures
from monoforce_ros.training.terrain_fit import trajectory_frame, trajectory_grid
from monoforce_ros.training.visible import visible_terrain

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """22 s over hills, stones and through grass, with a lidar and the noise of a localisation."""
    out = tmp_path_factory.mktemp("world") / "drive"
    odometry = OdometrySettings(rate=20.0, position_noise=0.01, rotation_noise=np.radians(0.5))
    record(out, RecordingSettings(duration=22.0, seed=7, camera=None, odometry=odometry, labels=True))
    return out


def truth(labels, grid, pose):
    """True support heights and classes on a map's cells."""
    x, y = np.meshgrid(grid.x, grid.y)
    places = np.stack([x, y, 0 * x], axis=-1) @ pose[:3, :3].T + pose[:3, 3]
    column, row = np.moveaxis(np.rint((places[..., :2] - labels["origin"]) / labels["resolution"]).astype(int), -1, 0)
    return labels["support_height"][row, column] - pose[2, 3], labels["ground_class"][row, column]


def test_the_supporting_terrain_in_grass_is_recovered_where_the_lidar_measures_the_tips(world, husky):
    recording, labels = Recording.open(world), np.load(labels_file(world))
    motion = smooth(recording.motion).motion
    hard, grass, visible_in_grass = [], [], []
    for index in range(2):
        start = int(recording.motion.stamps[0]) + index * 10**10
        pose, grid = trajectory_frame(motion, start), trajectory_grid(motion, start, 10.0, FitSettings())
        visible = visible_terrain(recording, motion, husky, grid, pose, start=start - 2 * 10**9, stop=start + 10**10)
        fit = fit_terrain(motion, recording.commands, husky, start=start, visible=visible)
        support, classes = truth(labels, grid, pose)
        away = np.abs(fit.terrain.height.numpy() - support)
        ordinary = (classes == GroundClass.GROUND) | (classes == GroundClass.RAMP)
        hard.append(away[fit.contact_mask & ordinary])
        grass.append(away[fit.contact_mask & (classes == GroundClass.GRASS)])
        off = np.abs(visible.geometric_height.numpy() - support)
        visible_in_grass.append(off[fit.contact_mask & (classes == GroundClass.GRASS)])
        assert fit.losses[-1] < 0.5 * fit.losses[0]
        assert np.median(fit.after) < 0.6 * np.median(fit.before)
    hard, grass, visible_in_grass = (np.concatenate(parts) for parts in (hard, grass, visible_in_grass))
    assert len(hard) > 300
    assert len(grass) > 60
    assert np.median(hard) <= 0.02
    assert np.median(grass) <= 0.04
    assert np.median(visible_in_grass) > 0.15


def recorded(robot, terrain, twist, seconds, height):
    """Motion simulated by the rollout, as a recorded track with commands."""
    steps = round(seconds / 0.01)
    twists = torch.tensor(twist, dtype=torch.float32).expand(1, steps, 2)
    still = rollout(terrain, robot, torch.zeros(1, 150, 2), State.at_rest(height), with_forces=False)
    state = State(*(getattr(still, n)[:, -1] for n in ("position", "rotation", "velocity", "angular_velocity")))
    result = rollout(terrain, robot, robot.drive_speeds(twists), state, with_forces=False)
    rotations = result.rotation[0].double().numpy()[::2]
    turned = Rotation.from_matrix(rotations)
    stamps = (10**9 + np.arange(len(rotations)) * 20_000_000).astype(np.int64)
    motion = MotionTrack(
        stamps=stamps,
        positions=result.position[0].double().numpy()[::2],
        quaternions=turned.as_quat(),
        linear_velocities=turned.inv().apply(result.velocity[0].double().numpy()[::2]),
        angular_velocities=turned.inv().apply(result.angular_velocity[0].double().numpy()[::2]),
    )
    return motion, CommandTrack(stamps[:1] - 1, np.array([twist], float))


def test_the_descent_corrects_a_wrong_initial_terrain(husky):
    grid = Grid.square(12.8, 0.1)
    x, _ = np.meshgrid(grid.x, grid.y)
    height = torch.from_numpy((0.05 * np.sin(1.4 * x)).astype(np.float32))
    motion, commands = recorded(husky, TerrainMap.from_height(height, grid), (0.6, 0.0), 6.0, 0.14)
    wrong = TerrainMap.from_height(height + 0.12, trajectory_like(grid, motion, height))
    fit = fit_terrain(motion, commands, husky, start=int(motion.stamps[0]), length=5.5, visible=wrong)
    expected = height.numpy() - motion.positions[0, 2]
    assert np.median(np.abs(fit.terrain.height.numpy() - expected)[fit.contact_mask]) < 0.008
    assert np.median(fit.after) < 0.004 < 0.05 < np.median(fit.before)


def trajectory_like(grid, motion, height):
    """The grid in the trajectory's frame, which is only shifted here."""
    x, y = motion.positions[0, :2]
    return dataclasses.replace(grid, origin=(grid.origin[0] - x, grid.origin[1] - y))


def test_friction_is_fitted_where_the_robot_slips(husky):
    grid = Grid.square(12.8, 0.1)
    slope = torch.from_numpy((np.tile(grid.x, (grid.rows, 1)) * 0.25).astype(np.float32))
    slippery = dataclasses.replace(TerrainMap.from_height(slope, grid), friction=torch.full_like(slope, 0.28))
    motion, commands = recorded(husky, slippery, (0.5, 0.3), 5.0, 0.2)
    start = int(motion.stamps[0])
    plain, fitted = (
        fit_terrain(motion, commands, husky, start=start, length=4.5, settings=FitSettings(friction=friction))
        for friction in (False, True)
    )
    assert float(plain.terrain.friction.min()) == pytest.approx(0.8)
    friction = fitted.terrain.friction.numpy()[fitted.contact_mask]
    assert np.median(friction) == pytest.approx(0.28, abs=0.1)
    assert fitted.losses.min() < plain.losses.min()
    # What tracing cannot tell alone: heights stay as the wheels traced them.
    given = FitSettings(heights=False, friction=True)
    traced = fit_terrain(motion, commands, husky, start=start, length=4.5, settings=FitSettings(iterations=0))
    material = fit_terrain(motion, commands, husky, start=start, length=4.5, settings=given)
    assert torch.equal(material.terrain.height, traced.terrain.height)
    assert np.median(material.terrain.friction.numpy()[material.contact_mask]) == pytest.approx(0.28, abs=0.1)
    assert material.losses[-1] < material.losses[0] and not len(traced.losses)


def test_stiffness_is_fitted_where_the_robot_sways(husky):
    grid = Grid.square(12.8, 0.1)
    rough = torch.from_numpy((0.05 * np.sin(3.0 * np.tile(grid.x, (grid.rows, 1)))).astype(np.float32))
    soft = TerrainMap.from_height(rough, grid, material=TerrainDefaults(stiffness=2e5))
    motion, commands = recorded(husky, soft, (0.8, 0.1), 5.0, 0.1)
    given = FitSettings(heights=False, stiffness=True)
    fit = fit_terrain(motion, commands, husky, start=int(motion.stamps[0]), length=4.5, settings=given)
    initial = TerrainDefaults().stiffness
    assert np.median(fit.terrain.stiffness.numpy()[fit.contact_mask]) < 0.6 * initial
    assert fit.losses[-1] < fit.losses[0]


def test_sweeps_are_accumulated_at_their_poses_without_dust():
    random = np.random.default_rng(1)
    ground = np.column_stack([random.uniform(-4, 4, (6000, 2)), np.zeros(6000)])
    sweeps = []
    for x in (0.0, 1.0, 2.0):
        pose = np.eye(4)
        pose[:3, 3] = [x, 0.0, 0.5]
        dust = np.array([[1.0 + x, 2.0, 1.5]])
        sweeps.append((np.concatenate([ground - pose[:3, 3], dust, [[np.nan] * 3], [[50.0, 0.0, 0.0]]]), pose))
    cloud = accumulate(sweeps)
    assert np.abs(cloud[:, 2]).max() < 1e-9
    assert len(cloud) > 17_000
    assert accumulate([]).shape == (0, 3)


def test_neighbours_are_counted_across_voxels():
    points = np.array([[0.01, 0, 0], [0.09, 0, 0], [0.11, 0, 0], [0.35, 0, 0], [5.0, 5.0, 5.0]])
    assert count_neighbours(points, 0.1).tolist() == [3, 3, 3, 1, 1]


def test_maps_survive_a_file(tmp_path):
    grid = Grid(5, 9, 0.2, (-0.3, 0.7))
    terrain = dataclasses.replace(
        TerrainMap.flat(grid, height=0.3), friction=torch.rand(5, 9), observed=torch.rand(5, 9) > 0.5
    )
    pose = np.eye(4)
    pose[:3, 3] = [1.0, 2.0, 3.0]
    save_terrain(tmp_path / "map.npz", terrain, pose)
    read, where = load_terrain(tmp_path / "map.npz")
    assert read.grid == grid
    for name in ("height", "geometric_height", "stiffness", "damping", "friction", "observed"):
        torch.testing.assert_close(getattr(read, name), getattr(terrain, name))
    np.testing.assert_array_equal(where, pose)
    assert [path.name for path in tmp_path.iterdir()] == ["map.npz"]


@given(st.binary(max_size=300))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_arbitrary_bytes_are_refused_as_a_map(tmp_path, data):
    (tmp_path / "map.npz").write_bytes(data)
    with pytest.raises(TerrainFileError, match=r"map\.npz"):
        load_terrain(tmp_path / "map.npz")


def test_maps_with_pickles_or_without_channels_are_refused(tmp_path):
    np.savez(tmp_path / "bad.npz", height=np.array([{"a": 1}], dtype=object))
    with pytest.raises(TerrainFileError, match="got no"):
        load_terrain(tmp_path / "bad.npz")
    with pytest.raises(TerrainFileError, match="missing.npz"):
        load_terrain(tmp_path / "missing.npz")


def test_the_executable_fits_draws_and_resumes(world, tmp_path, executables, ros_environment):
    command = [executables / "fit_terrain", world, "--out", tmp_path / "maps", "--iterations", "15", "--quiet"]

    def run():
        done = subprocess.run(command, env=ros_environment, capture_output=True, text=True, timeout=180, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "2 trajectories" in run()
    names = sorted(path.name for path in (tmp_path / "maps").iterdir())
    assert names == ["drive_000.npz", "drive_000.png", "drive_001.npz", "drive_001.png", "fit_terrain.json"]
    rows = json.loads((tmp_path / "maps" / "fit_terrain.json").read_text())["trajectories"]
    assert all(row["height_error_m"] < row["height_error_seen_m"] for row in rows)
    terrain, _ = load_terrain(tmp_path / "maps" / "drive_000.npz")
    assert terrain.observed.any()
    with np.load(tmp_path / "maps" / "drive_000.npz") as content:
        mask = content["contact_mask"]
    # felt_cells is the name of contact_cells in earlier releases.
    assert rows[0]["contact_cells"] == rows[0]["felt_cells"] == mask.sum() > 0
    before = (tmp_path / "maps" / "drive_000.npz").stat().st_mtime_ns
    (tmp_path / "maps" / "drive_001.npz").unlink()
    run()
    assert (tmp_path / "maps" / "drive_000.npz").stat().st_mtime_ns == before
    assert (tmp_path / "maps" / "drive_001.npz").is_file()


def test_figures_with_the_old_name_of_the_contact_mask_are_read_with_a_warning(tmp_path):
    figures = FitFigures(0.2, 0.01, 3.0, 1.0, 25)
    old = dataclasses.asdict(figures)
    old["felt_cells"] = old.pop("contact_cells")
    np.savez(tmp_path / "map.npz", fingerprint=np.array("abc"), figures=np.array(json.dumps(old)))
    with pytest.warns(FutureWarning, match="'felt' is now 'contact_mask'"):
        assert existing_figures(tmp_path / "map.npz", "abc") == figures
    assert existing_figures(tmp_path / "map.npz", "other") is None


def test_an_unusable_bag_is_reported(tmp_path, executables, ros_environment, real_data):
    bag = next((real_data / "husky_outdoor").glob("*.bag"))
    done = subprocess.run(
        [executables / "fit_terrain", bag, "--out", tmp_path / "maps"],
        env=ros_environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "no commands" in done.stderr
