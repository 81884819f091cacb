"""The ground of a recording from the terrain encoder: maps along the drive become one, weighted by their spread."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import ROOT

from monoforce_ros.bags import BagError, Recording, smooth
from monoforce_ros.core import MotionState
from monoforce_ros.discrepancy.bag_diagnosis import read_with_ground
from monoforce_ros.discrepancy.cli import main
from monoforce_ros.discrepancy.encoder_ground import EncoderGround, _Mosaic, encoder_maps
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_source_with_cameras_is_named_with_or_without_weights():
    assert EncoderGround.named("camera") == EncoderGround("camera")
    assert EncoderGround.named("lidar_camera:a/b.safetensors") == EncoderGround("lidar_camera", "a/b.safetensors")
    for other in ("flat", "lidar", "traced", "auto", "map.npz", "cameras"):
        assert EncoderGround.named(other) is None


def seen_from(x: float, y: float, heading: float, z: float = 0.0) -> MotionState:
    rotation = np.array(
        [[np.cos(heading), -np.sin(heading), 0.0], [np.sin(heading), np.cos(heading), 0.0], [0.0, 0.0, 1.0]]
    )
    return MotionState(0, np.array([x, y, z]), rotation, np.zeros(3), np.zeros(3))


def ground_at(x, y):
    return 0.3 * x - 0.2 * y + 0.1


def view_of_ground(motion: MotionState, error: float = 0.0, spread: float = 0.05, *, half: bool = False) -> TerrainMap:
    """What is seen of the ground from a pose; ``half`` sees nothing behind the robot."""
    grid = Grid.square(6.4)
    x, y = np.meshgrid(grid.x, grid.y)
    pose = motion.odometry_from_terrain
    world = np.stack([x, y], axis=-1) @ pose[:2, :2].T + pose[:2, 3]
    height = torch.from_numpy((ground_at(world[..., 0], world[..., 1]) - pose[2, 3] + error).astype(np.float32))
    observed = torch.from_numpy(x > 0) if half else None
    terrain = TerrainMap.from_height(height, grid, geometric_height=height + 0.2, observed=observed)
    return replace(terrain, geometric_spread=torch.full_like(height, spread), decrease_spread=torch.zeros_like(height))


def test_maps_from_any_pose_show_the_same_ground():
    grid = Grid(101, 141, 0.1, (-4.0, -5.0))
    mosaic = _Mosaic(grid)
    poses = [seen_from(0.0, 0.0, 0.0), seen_from(1.33, 0.71, 2.1, z=0.4), seen_from(4.0, -1.0, -0.7, z=-0.2)]
    for motion in poses:
        mosaic.add(view_of_ground(motion), motion)
    terrain = mosaic.terrain()
    x, y = np.meshgrid(grid.x, grid.y)
    known = terrain.observed.numpy()
    near = np.min([np.hypot(x - p.position[0], y - p.position[1]) for p in poses], axis=0) < 3.0
    assert known[near].all() and not known.all()
    np.testing.assert_allclose(terrain.height.numpy()[known], ground_at(x, y)[known], atol=2e-3)
    np.testing.assert_allclose((terrain.geometric_height - terrain.height).numpy(), 0.2, atol=1e-4)
    # Beyond them stands the nearest height, and the cell says that nobody saw it.
    assert np.isfinite(terrain.height.numpy()).all()


def test_a_map_counts_by_its_spread_and_only_where_it_was_observed():
    grid, motion = Grid.square(6.0), seen_from(0.0, 0.0, 0.0)
    mosaic = _Mosaic(grid)
    mosaic.add(view_of_ground(motion, spread=0.02), motion)
    mosaic.add(view_of_ground(motion, error=1.0, spread=0.5, half=True), motion)
    x, y = np.meshgrid(grid.x, grid.y)
    apart = mosaic.terrain().height.numpy() - ground_at(x, y)
    np.testing.assert_allclose(apart[x < -0.1], 0.0, atol=2e-3)
    # Variances of 0.02² + 0.02² and 0.5² + 0.02² m²: weights of 1250 and 4.
    np.testing.assert_allclose(apart[x > 0.1], (1 / 0.2504) / (1 / 0.0008 + 1 / 0.2504), atol=2e-3)


@pytest.mark.parametrize("kind", ["camera", "lidar_camera"])
def test_a_recording_s_ground_comes_from_its_images(demo_bag, kind):
    husky = load_robot("husky")
    evidence, _, ground = read_with_ground(demo_bag, husky, kind)
    assert ground.source == kind and "predictions along the drive" in ground.description
    count = int(ground.description.split(": ")[-1].split()[0])
    length = np.linalg.norm(np.diff(evidence.smoothed.motion.positions, axis=0), axis=1).sum()
    assert 5 < count <= length / 0.2 + 10
    assert evidence.terrain.observed.any() and evidence.split_maps is not None
    # Under the robot stands the ground that carried it, whichever way it was seen before.
    by_lidar = read_with_ground(demo_bag, husky, "lidar")[0].terrain
    rows, columns, inside = by_lidar.grid.cells(evidence.smoothed.motion.positions[:, :2])
    assert inside.all() and by_lidar.grid == evidence.terrain.grid
    apart = (evidence.terrain.height - by_lidar.height).numpy()[rows, columns]
    assert np.median(np.abs(apart)) < 0.03


def test_a_recording_without_images_says_what_to_use_instead(demo_bag, tmp_path, capsys):
    husky = load_robot("husky")
    recording = Recording.open(demo_bag).in_base_frame("base_link")
    blind = replace(recording, images={})
    motion = smooth(recording.motion).motion
    with pytest.raises(BagError, match="no images, which --terrain camera needs; use lidar, traced"):
        encoder_maps(blind, motion, husky, Grid.square(8.0), EncoderGround("camera"))
    missing = ROOT / "no_such_weights.safetensors"
    assert main([str(demo_bag), "--terrain", f"camera:{missing}", "--out", str(tmp_path), "--quiet"]) == 1
    assert str(missing) in capsys.readouterr().err
