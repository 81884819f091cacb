"""The predictor with a lidar and a camera at once, in a process of its own; either may fall silent."""

import numpy as np
import pytest
import torch

from monoforce_ros.bags import builders
from monoforce_ros.encoder import EncoderConfig, TerrainEncoder, save_encoder

ERROR = 2
IMAGE, INFO = "/front/image_raw", "/front/camera_info"
MATRIX = np.array([[100.0, 0, 80], [0, 100.0, 60], [0, 0, 1]])
DECREASE = 0.3


@pytest.fixture(scope="module")
def predictor(start, peer, tmp_path_factory):
    torch.manual_seed(0)
    config = EncoderConfig(image_width=160, image_height=112, map_features=16, map_size=12.8, resolution=0.2)
    encoder = TerrainEncoder(config)
    # This encoder predicts visible surfaces 0.3 m above the supporting ground at the height of the wheels.
    torch.nn.init.zeros_(encoder.heads.weight)
    encoder.heads.bias.data = torch.tensor([DECREASE, DECREASE, 0.0, 0.0, 0.0, 0.0, 0.0])
    path = tmp_path_factory.mktemp("checkpoint") / "encoder.safetensors"
    save_encoder(encoder, path)
    process = start(
        "predictor", "--ros-args", "-p", "terrain_source:=lidar_camera", "-p", f"checkpoint:={path}",
        "-p", f"image_topics:=[{IMAGE}]", "-p", "data_timeout:=1.0", "-p", "horizon:=2.0",
        # What the encoder says counts at once.
        "-p", "camera_fallback:=false",
    )  # fmt: skip
    process.wait_for("predicting 2 s ahead for husky with terrain from lidar_camera")
    return process


def cloud(stamp):
    """Level ground with stems of grass 0.2 m high ahead of the robot, and a wall beside it."""
    random = np.random.default_rng(0)
    radius, angle = random.uniform(0.8, 8.0, 9000), random.uniform(-np.pi, np.pi, 9000)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(9000, -0.1323 - 0.65)], axis=1)
    points[(points[:, 0] > 1.0) & (np.abs(points[:, 1]) < 2.0), 2] += 0.2
    wall = np.stack([np.linspace(-2, 2, 400), np.full(400, 3.0), random.uniform(-0.78, 0.8, 400)], axis=1)
    return builders.point_cloud(stamp, "lidar", np.concatenate([points, wall]).astype(np.float32))


def drive(peer, seconds, *, lidar=True, camera=True):
    """Feed odometry and commands, clouds and images at 5 Hz, the image 20 ms before the cloud."""

    def both(stamp):
        if camera:
            peer.publish(INFO, builders.camera_info(stamp, "camera_front", 160, 120, MATRIX, [0.0] * 5))
            peer.publish(
                IMAGE, builders.image(stamp - 20_000_000, "camera_front", np.full((120, 160, 3), 90, np.uint8))
            )
        return cloud(stamp) if lidar else None

    peer.drive(seconds, cloud=both)


def heights(peer):
    """Heights in the last map: 2 m ahead, and at the wall next to the robot."""
    found = peer.received["/predicted/terrain"][-1]
    values = np.frombuffer(bytes(found.data), "<f4").reshape(-1, found.point_step // 4)
    place = values[:, :2] - np.array([1.0, 2.0])
    ahead = (np.abs(place[:, 0] - 2.0) < 0.5) & (np.abs(place[:, 1]) < 0.5)
    wall = (np.abs(place[:, 0]) < 1.0) & (np.abs(place[:, 1] - 3.0) < 0.11)
    return float(np.median(values[ahead, 2])) - 0.3, float(values[wall, 2].max()) - 0.3


def predicted(peer, **how):
    peer.begin()
    for _ in range(8):
        drive(peer, 0.8, **how)
        if len(peer.received["/predicted/terrain"]) >= 2:
            return
    pytest.fail("no prediction")


def silent(peer, part):
    said = lambda: peer.status(part) or (0, "")  # noqa: E731
    assert peer.until(lambda: said()[0] == ERROR and "no messages for" in said()[1], 3.0), said()


def test_grass_measured_by_the_lidar_is_lowered_and_a_wall_is_kept(peer, predictor):
    predicted(peer)
    grass, wall = heights(peer)
    assert grass == pytest.approx(-0.1323, abs=0.04)
    assert wall > 0.5


def test_without_the_camera_lidar_heights_are_used(peer, predictor):
    predicted(peer)
    drive(peer, 2.0, camera=False)
    predicted(peer, camera=False)
    grass, wall = heights(peer)
    assert grass == pytest.approx(0.2 - 0.1323, abs=0.04) and wall > 0.5
    silent(peer, f"camera {IMAGE}")
    assert predictor.running and "Traceback" not in predictor.output


def test_without_the_lidar_the_encoder_is_used_alone(peer, predictor):
    predicted(peer)
    drive(peer, 2.0, lidar=False)
    predicted(peer, lidar=False)
    grass, wall = heights(peer)
    assert grass == pytest.approx(-0.1323, abs=0.04) and wall < 0.2
    silent(peer, "lidar")
    predicted(peer)
    assert heights(peer)[1] > 0.5
