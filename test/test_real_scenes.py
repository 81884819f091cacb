"""Real images, calibrations, clouds and poses, played into the installed predictor."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import ROOT

from monoforce_ros.bags import BagReader, Recording
from monoforce_ros.core import MotionTrack, transform_points
from monoforce_ros.datasets import DatasetError, RoughScene, robot_file_for, scene_to_bag
from monoforce_ros.encoder import EncoderConfig, new_encoder, save_encoder
from monoforce_ros.messages import stamp_of
from monoforce_ros.nodes.inputs import ODOMETRY_LAG
from monoforce_ros.robots import load_robot

SCENES = {"husky_robingas": ("husky", 4), "tradr_robingas": ("tradr", 6)}
OUTPUTS = ("height_map", "terrain", "path", "contact_forces")


@pytest.fixture(scope="module", params=sorted(SCENES))
def played(request, real_data, start, tmp_path_factory):
    """Play a scene as a bag into the predictor; returns the recording, the robot and the outputs."""
    folder = tmp_path_factory.mktemp(request.param)
    robot, cameras = SCENES[request.param]
    scene = RoughScene.open(real_data / "rough" / request.param)
    # Raw images in one scene, compressed ones in the other: both must work.
    remarks = scene_to_bag(scene, folder / "scene", seconds=3.0, compressed=request.param != "husky_robingas")
    assert "are not the robot's" in remarks[0]
    robot_yaml = robot_file_for(scene, robot, folder / "robot.yaml")
    topics = [f"/predicted/{name}" for name in OUTPUTS]
    predictor = start("predictor", "--ros-args", "-p", f"robot:={robot_yaml}")
    recorder = start("bag_recorder", folder / "out", "--topics", *topics)
    predictor.wait_for("predicting")
    recorder.wait_for("recording /predicted/contact_forces")
    player = start("bag_player", folder / "scene", "--quiet", "--wait", "10")
    assert player.wait() == 0, player.output
    recorder.wait_for("recording")
    assert recorder.stop() == 0 and predictor.stop() == 0
    assert "nothing published" not in predictor.output
    recording = Recording.open(folder / "scene")
    assert len(recording.images) == len(recording.cameras) == cameras
    outputs = {}
    with BagReader(folder / "out") as bag:
        for message in bag.messages():
            outputs.setdefault(message.topic.rsplit("/", 1)[-1], []).append(message.decode())
    return recording, load_robot(robot_yaml), outputs


def test_every_output_arrives_with_the_stamp_and_frame_of_the_input(played):
    recording, _, outputs = played
    assert set(outputs) == set(OUTPUTS)
    for messages in outputs.values():
        header = messages[0].markers[0].header if hasattr(messages[0], "markers") else messages[0].header
        assert header.frame_id == recording.motion.frame_id == "map"
        assert stamp_of(messages[0].markers[0] if hasattr(messages[0], "markers") else messages[0]) == (
            recording.clouds[0].stamp
        )


def test_the_height_map_agrees_with_the_cloud_it_was_made_of(played, record_property):
    recording, robot, outputs = played
    frame = recording.clouds[0]
    points, sensor = recording.cloud(frame)
    base = transform_points(robot.sensors[sensor].double().numpy(), points)
    motion = recording.motion.at(frame.stamp)
    world = transform_points(motion.odometry_from_base, base)
    terrain = outputs["terrain"][0]
    names = [entry.name for entry in terrain.fields]
    cells = np.frombuffer(bytes(terrain.data), "<f4").reshape(-1, len(names)).astype(float)
    observed = cells[cells[:, names.index("observed")] > 0.5]
    assert len(observed) > 3000
    # Compare in the axes of the map, where cells are squares.
    to_terrain = np.linalg.inv(motion.odometry_from_terrain)
    cell_xy = np.rint(transform_points(to_terrain, observed[:, :3])[:, :2] / 0.1 - 0.5).astype(int)
    local = transform_points(to_terrain, world)
    height = dict(zip(map(tuple, cell_xy), observed[:, 2], strict=True))
    keys = map(tuple, np.rint(local[:, :2] / 0.1 - 0.5).astype(int))
    low, high = (bound.numpy() - [0.1, 0.1, 0] for bound in robot.bounds)
    body = ((base[:, :2] > low[:2]) & (base[:, :2] < high[:2] + 0.2)).all(axis=1)
    errors = [
        abs(height[key] - z)
        for key, z, on_robot in zip(keys, world[:, 2], body, strict=True)
        if not on_robot and key in height
    ]
    median = float(np.median(errors))
    record_property("median height error [m]", median)
    print(f"{recording.path.parent.name}: median |map - cloud| {100 * median:.1f} cm over {len(errors)} returns")
    assert len(errors) > 10_000
    assert median <= 0.05


def until(track: MotionTrack, count: int) -> MotionTrack:
    """The first ``count`` measurements of a track."""
    names = ("stamps", "positions", "quaternions", "linear_velocities", "angular_velocities")
    return replace(track, **{name: getattr(track, name)[:count] for name in names})


def test_the_path_starts_at_the_robot_and_keeps_to_the_ground(played):
    recording, robot, outputs = played
    stamp, track = recording.clouds[0].stamp, recording.motion
    motion = track.at(stamp)
    path = outputs["path"][0]
    poses = np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in path.poses])
    # If the cloud overtook its odometry, the motion is extrapolated from odometry at most 30 ms older.
    earlier = [i for i, s in enumerate(track.stamps) if stamp - ODOMETRY_LAG <= s < stamp]
    starts = [motion, *(until(track, i + 1).at(stamp) for i in earlier)]
    away = [np.abs(poses[0] - start.position).max() for start in starts]
    assert min(away) < 1e-6, away
    terrain = outputs["terrain"][0]
    names = [entry.name for entry in terrain.fields]
    cells = np.frombuffer(bytes(terrain.data), "<f4").reshape(-1, len(names)).astype(float)
    for pose in poses:
        near = np.hypot(*(cells[:, :2] - pose[:2]).T) < 0.3
        clearance = pose[2] - cells[near, 2].mean()
        assert -0.1 < clearance - robot.ground_clearance < 0.2
    # 0.5 m/s were commanded for the 5 s of the horizon.
    assert 1.0 < np.linalg.norm(poses[-1] - poses[0]) < 2.6


def test_a_cloud_without_a_pose_of_its_time_is_rejected(real_data):
    scene = RoughScene.open(real_data / "rough" / "husky_robingas")
    with pytest.raises(DatasetError, match="nearest pose is 7.00 s away"):
        scene.pose(int(scene.cloud_stamps[0]))
    oru = RoughScene.open(real_data / "rough" / "husky_oru")
    with pytest.raises(DatasetError, match="nearest pose is"):
        oru.pose(int(oru.cloud_stamps[0]))


def test_rounded_rotations_and_numbers_in_quotes_are_read(real_data):
    for name in ("tradr_robingas", "tradr_rough", "husky_oru"):
        scene = RoughScene.open(real_data / "rough" / name)
        for matrices in (scene.map_from_base[:, :3, :3], *[m[None, :3, :3] for m in scene.base_from_sensors.values()]):
            identity = matrices @ np.swapaxes(matrices, 1, 2)
            np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-9)
        assert (np.diff(scene.pose_stamps) > 0).all()


def test_rational_distortion_is_kept(real_data):
    scene = RoughScene.open(real_data / "rough" / "tradr_robingas")
    camera = scene.cameras["camera_front"]
    assert camera.distortion.size == 8
    ray = camera.rays(np.array([0.0, 0.0]))
    pixels, inside = camera.project(ray[None])
    assert inside[0] and np.abs(pixels[0]).max() < 0.1


@pytest.mark.unhurried
def test_the_benchmark_adapts_on_all_scenes_but_one(real_data, tmp_path):
    small = EncoderConfig(
        sensor="camera_lidar", image_width=64, image_height=48, map_size=6.4, resolution=0.2, depth_bins=12,
        map_features=8, edges=False,
    )  # fmt: skip
    torch.manual_seed(0)
    save_encoder(new_encoder(small), tmp_path / "start.safetensors")
    done = subprocess.run(
        [
            sys.executable, "benchmarks/real_scenes.py", real_data / "rough",
            "--encoder", tmp_path / "start.safetensors",
            "--adapt", "1", "--steps", "2", "--choosing", "1", "--samples", tmp_path / "samples", "--threads", "1",
            "--json", tmp_path / "found.json",
        ],
        cwd=ROOT, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "found.json").read_text())
    scenes = {row["scene"] for row in found}
    assert len(scenes) == 3 and len(found) == 6
    for scene in scenes:
        before, after = (row for row in found if row["scene"] == scene)
        assert (before["encoder"], after["encoder"]) == ("as shipped", "adapted on the others")
        # Level ground does not depend on the encoder, nor do the cells that are judged on its weights.
        assert before["level"] == after["level"] and before["cells"] == after["cells"] > 100
        assert f"{scene}: kept " in done.stdout
