"""The source ``lidar``: the encoder on sweeps, interpolation where it cannot or may not be used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from monoforce_ros.bags import Recording, observe
from monoforce_ros.core import MotionState
from monoforce_ros.encoder import CheckpointError, EncoderConfig, load_encoder, new_encoder, save_encoder
from monoforce_ros.evaluation import evaluate_recording
from monoforce_ros.evaluation.tables import PHYSICS
from monoforce_ros.perception import (
    EncoderTerrain,
    LidarTerrain,
    Observation,
    TrustedTerrain,
    choose_terrain_source,
)
from monoforce_ros.prediction import Predictor
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainError

pytestmark = pytest.mark.usefixtures("one_thread")
STILL = MotionState(0, np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


@pytest.fixture(scope="module")
def recording(demo_bag):
    return Recording.open(demo_bag).in_base_frame("base_link")


def errors(recording, source, robot):
    """Median position error after 5 s [m]: of six windows, one that is stuck on a tuft decides the mean."""
    found = evaluate_recording(
        recording, Predictor(robot, source, horizon=5.0), horizons=(5.0,), stride=1.0, quiet=True, minimum_duration=1.0
    )
    return found.summary(PHYSICS)[5.0][0].median


def test_in_tall_grass_paths_are_far_better_than_on_interpolated_heights(recording, husky):
    learned, interpolated = (
        errors(recording, choose_terrain_source(kind, husky), husky) for kind in ("lidar", "lidar_interpolation")
    )
    assert learned < 0.5 * interpolated


def test_the_encoder_s_sweep_is_used_from_the_start_and_images_are_not(recording, husky):
    plain = choose_terrain_source("lidar", husky)
    for kind, share in (("lidar", 1.0), ("lidar_camera", 0.0)):
        trusted = choose_terrain_source(kind, husky, fallback=True)
        assert isinstance(trusted, TrustedTerrain)
        stamp = recording.clouds[0].stamp
        sensors = tuple(kind.split("_"))
        observation = observe(recording, husky, stamp, sensors, tuple(recording.images))
        motion = recording.motion.at(stamp)
        terrain = trusted.terrain(observation, motion)
        assert trusted.report.share == share
        expected = plain.terrain(replace(observation, images={}), motion)
        torch.testing.assert_close(terrain.height, expected.height)
        # What both sensors say is remembered, to be compared with the ground.
        assert (kind == "lidar") == torch.equal(trusted.predicted.height, expected.height)


def test_a_sweep_s_encoder_is_replaced_by_interpolation_where_the_ground_contradicts_it(recording, husky, tmp_path):
    encoder = load_encoder("")
    with torch.no_grad():
        # Vegetation everywhere, at which the robot drives as if it were none.
        encoder.heads.bias[1] += 0.6
    file = tmp_path / "deep.safetensors"
    save_encoder(encoder, file)
    trusted = choose_terrain_source("lidar", husky, checkpoint=file, fallback=True)
    plain = choose_terrain_source("lidar_interpolation", husky, grid=trusted.grid)
    shares = []
    for frame in recording.clouds[::5]:
        observation, motion = observe(recording, husky, frame.stamp, ("lidar",)), recording.motion.at(frame.stamp)
        terrain, interpolated = (source.terrain(observation, motion) for source in (trusted, plain))
        shares.append(trusted.report.share)
        if not shares[-1]:
            torch.testing.assert_close(terrain.height, interpolated.height)
    assert shares[-1] < 0.3


def test_other_grids_and_encoders_without_sweeps_are_interpolated(tmp_path, husky):
    wide = choose_terrain_source("lidar", husky, grid=Grid.square(20.0, 0.2))
    assert isinstance(wide, LidarTerrain) and wide.grid == Grid.square(20.0, 0.2)
    file = tmp_path / "images.safetensors"
    save_encoder(new_encoder(EncoderConfig(map_features=8)), file)
    assert isinstance(choose_terrain_source("lidar", husky, checkpoint=file), LidarTerrain)
    assert isinstance(choose_terrain_source("lidar", husky, grid=Grid.square()), EncoderTerrain)


def test_without_the_shipped_encoder_sweeps_are_interpolated_and_the_node_says_so(tmp_path, husky, monkeypatch):
    missing = tmp_path / "terrain_encoder.safetensors"
    monkeypatch.setattr("monoforce_ros.encoder.checkpoint.shipped_checkpoint", lambda: missing)
    said = []
    source = choose_terrain_source("lidar", husky, fallback=True, grid=Grid.square(10.0, 0.2), warn=said.append)
    assert isinstance(source, LidarTerrain) and source.grid == Grid.square(10.0, 0.2)
    assert len(said) == 1 and f"{missing} does not exist" in said[0] and "interpolates the point cloud" in said[0]
    missing.write_bytes(b"version https://git-lfs.github.com/spec/v1")
    missing.with_suffix(".json").write_text('{"format": 2}')
    assert isinstance(choose_terrain_source("lidar", husky, warn=said.append), LidarTerrain)
    assert "damaged" in said[1]
    # A file that the user names has to be there, and images say nothing without an encoder.
    for kind, checkpoint in (("lidar", missing), ("lidar", tmp_path / "own.safetensors"), ("lidar_camera", "")):
        with pytest.raises(CheckpointError):
            choose_terrain_source(kind, husky, checkpoint=checkpoint, warn=said.append)


def test_material_is_the_given_one(husky):
    material = TerrainDefaults(stiffness=1e6, damping=3e4, friction=0.55)
    random = np.random.default_rng(0)
    cloud = np.c_[random.uniform(-6.0, 6.0, (8000, 2)), np.full(8000, -0.13)].astype(np.float32)
    terrain = choose_terrain_source("lidar", husky, material=material).terrain(Observation(0, cloud), STILL)
    for name in ("stiffness", "damping", "friction"):
        assert (getattr(terrain, name) == getattr(material, name)).all()
    # Level ground is level ground.
    near = np.hypot(*np.meshgrid(terrain.grid.x, terrain.grid.y)) < 4.0
    assert float(terrain.height[torch.from_numpy(near)].std()) < 0.03


def test_both_sensors_make_one_map_and_either_may_be_missing(recording, husky):
    source = choose_terrain_source("lidar_camera", husky)
    assert isinstance(source, EncoderTerrain) and set(source.sensors) == {"lidar", "camera"}
    stamp = recording.clouds[len(recording.clouds) // 2].stamp
    observation = observe(recording, husky, stamp, ("lidar", "camera"), tuple(recording.images))
    motion = recording.motion.at(stamp)
    assert observation.images and observation.cloud is not None
    both = source.terrain(observation, motion)
    without_images = source.terrain(replace(observation, images={}), motion)
    without_cloud = source.terrain(replace(observation, cloud=None), motion)
    swept = choose_terrain_source("lidar", husky).terrain(observation, motion)
    assert float((both.height - without_images.height).abs().max()) > 0.01
    assert float((both.height - without_cloud.height).abs().max()) > 0.05
    # The trace that each source remembers differs by the maps made before: none here.
    torch.testing.assert_close(without_images.geometric_height, swept.geometric_height, rtol=0.0, atol=0.02)
    with pytest.raises(ValueError, match="a point cloud or an image"):
        source.terrain(replace(observation, images={}, cloud=None), motion)


def test_a_covered_lidar_is_an_error_alone_and_none_beside_cameras(recording, husky):
    stamp = recording.clouds[0].stamp
    observation = observe(recording, husky, stamp, ("lidar", "camera"), tuple(recording.images))
    motion = recording.motion.at(stamp)
    covered = replace(observation, cloud=np.zeros((5, 3), np.float32) + np.array([1.0, 0.0, 0.0], np.float32))
    for fallback in (False, True):
        with pytest.raises(TerrainError, match="5 returns hit 1 cells"):
            choose_terrain_source("lidar", husky, fallback=fallback).terrain(covered, motion)
    # Nor do points that lie far from the ground say anything of it: the lidar's pose is wrong.
    above = replace(observation, cloud=observation.cloud + np.array([0.0, 0.0, 9.0], np.float32))
    with pytest.raises(TerrainError, match="hit 0 cells"):
        choose_terrain_source("lidar", husky).terrain(above, motion)
    found = choose_terrain_source("lidar_camera", husky, fallback=True).terrain(covered, motion)
    level = choose_terrain_source("flat", husky).terrain(covered, motion)
    torch.testing.assert_close(found.height, level.height)
    # Five points do not spoil what the cameras show.
    seen, without = (
        choose_terrain_source("lidar_camera", husky).terrain(data, motion)
        for data in (covered, replace(observation, cloud=None))
    )
    torch.testing.assert_close(seen.height, without.height)
    assert float(seen.height.std()) > 0.01


def test_with_both_sensors_rigid_ground_has_the_given_material(recording, husky):
    stamp = recording.clouds[len(recording.clouds) // 2].stamp
    observation = observe(recording, husky, stamp, ("lidar", "camera"), tuple(recording.images))
    material = TerrainDefaults(stiffness=1e6, damping=3e4, friction=0.55)
    found = choose_terrain_source("lidar_camera", husky, material=material).terrain(
        observation, recording.motion.at(stamp)
    )
    depth = found.geometric_height - found.height
    assert (found.friction[depth < 0.02] == 0.55).all() and int((depth < 0.02).sum()) > 1000
    # Of what is soft the encoder tells how far it differs from the ground that it was made for.
    usual = replace(material, friction=0.8)
    plain = choose_terrain_source("lidar_camera", husky, material=usual).terrain(
        observation, recording.motion.at(stamp)
    )
    torch.testing.assert_close(found.friction, plain.friction * (0.55 / 0.8))
    assert (found.friction[depth > 0.06] != 0.55).any()


def test_from_images_ground_has_the_given_friction(recording, husky):
    stamp = recording.clouds[len(recording.clouds) // 2].stamp
    observation = observe(recording, husky, stamp, ("camera",), tuple(recording.images))
    material = TerrainDefaults(friction=0.5)
    for fallback in (False, True):
        source = choose_terrain_source("camera", husky, material=material, fallback=fallback)
        found = source.terrain(observation, recording.motion.at(stamp))
        found = source.predicted if fallback else found
        depth = found.geometric_height - found.height
        assert (found.friction[depth < 0.02] == 0.5).all() and int((depth < 0.02).sum()) > 1000
        assert float(found.friction.max()) < 0.6
