"""The predictor with cameras as its terrain source, in a process of its own.

The encoder has constant outputs: this tests how the node handles images, not the quality of the terrain.
"""

import time

import cv2
import numpy as np
import pytest
import torch

from monoforce_ros.bags import builders
from monoforce_ros.encoder import EncoderConfig, TerrainEncoder, save_encoder

OK, ERROR = 0, 2
IMAGE, INFO = "/front/image_raw", "/front/camera_info"
PART = f"camera {IMAGE}"
WIDTH, HEIGHT = 160, 120
MATRIX = np.array([[100.0, 0, 80], [0, 100.0, 60], [0, 0, 1]])


def cells(peer):
    """Channels of the last terrain cloud, a row for each cell; their number depends on what the map tells."""
    cloud = peer.received["/predicted/terrain"][-1]
    return np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, cloud.point_step // 4)


@pytest.fixture(scope="module")
def predictor(start, peer, tmp_path_factory):
    torch.manual_seed(0)
    config = EncoderConfig(image_width=160, image_height=112, map_features=16, map_size=12.8, resolution=0.2)
    encoder = TerrainEncoder(config)
    # Level ground under the wheels, so that the rollout has something to drive on.
    torch.nn.init.zeros_(encoder.heads.weight)
    torch.nn.init.zeros_(encoder.heads.bias)
    path = tmp_path_factory.mktemp("checkpoint") / "encoder.safetensors"
    save_encoder(encoder, path)
    process = start(
        "predictor", "--ros-args", "-p", "terrain_source:=camera", "-p", f"checkpoint:={path}",
        "-p", f"image_topics:=[{IMAGE}]", "-p", "data_timeout:=1.0", "-p", "horizon:=2.0",
    )  # fmt: skip
    process.wait_for("predicting 2 s ahead for husky with terrain from camera")
    return process


def picture(stamp, encoding="rgb8", size=(HEIGHT, WIDTH)):
    return builders.image(stamp, "camera_front", np.full((*size, 3), 90, np.uint8), encoding)


def information(stamp, width=WIDTH, height=HEIGHT, matrix=MATRIX):
    return builders.camera_info(stamp, "camera_front", width, height, matrix, [-0.1, 0.01, 0, 0, 0])


def look(peer, seconds, *, image=picture, info=information):
    """Feed odometry, commands, and images at 5 Hz with their CameraInfo."""

    def instead_of_cloud(stamp):
        if info and (message := info(stamp)) is not None:
            peer.publish(INFO, message)
        if (message := image(stamp)) is not None:
            peer.publish(IMAGE, message)

    peer.drive(seconds, cloud=instead_of_cloud)


def healthy(peer, predictor):
    peer.begin()
    for _ in range(8):
        look(peer, 0.8)
        if peer.received["/predicted/path"] and peer.until(lambda: peer.status("prediction") == (OK, "predicting"), 1):
            return
    pytest.fail(f"no prediction from good images: {peer.status('prediction')}\n{predictor.output[-3000:]}")


def refused(peer, predictor, text, **bad):
    # Counted before the pause: a camera's silence may be noticed in it already.
    said_before = sum(text in line for line in predictor.output.splitlines())
    peer.settle()
    peer.begin()
    bad_from = peer.now

    def reported() -> bool:
        return peer.status(PART) is not None and text in peer.status(PART)[1]

    # Right after the start, discovery on a busy machine may take longer than one look.
    for _ in range(6):
        look(peer, 1.4, **bad)
        if peer.until(reported, 0.5):
            break
    assert peer.until(reported, 5.0), predictor.output
    assert peer.status(PART)[0] == ERROR
    assert [s for s in peer.stamps("/predicted/path") if s >= bad_from] == []
    assert sum(text in line for line in predictor.output.splitlines()) - said_before == 1
    assert predictor.running and "Traceback" not in predictor.output


def test_without_camera_info_nothing_is_predicted_and_its_topic_is_named(peer, predictor):
    refused(peer, predictor, f"no usable CameraInfo on {INFO}", info=None)
    healthy(peer, predictor)


def test_images_become_terrain_with_their_stamp(peer, predictor):
    first = peer.now
    healthy(peer, predictor)
    assert set(peer.stamps("/predicted/terrain")) <= set(range(first, peer.now, 20_000_000))
    values = cells(peer)
    assert len(values) == 64 * 64 and np.isfinite(values).all()
    assert 0.05 < values[:, 7].mean() < 0.6


def test_images_of_an_unknown_encoding(peer, predictor):
    refused(peer, predictor, "image encoding: got '32FC3'", image=lambda stamp: picture(stamp, "32FC3"))
    healthy(peer, predictor)


def test_images_of_another_size_than_calibrated(peer, predictor):
    refused(
        peer, predictor, "images are 80 × 60 px, but CameraInfo says", image=lambda stamp: picture(stamp, size=(60, 80))
    )
    healthy(peer, predictor)


def test_a_camera_that_is_not_calibrated(peer, predictor):
    refused(
        peer, predictor, "the camera is not calibrated", info=lambda stamp: information(stamp, matrix=np.zeros((3, 3)))
    )
    healthy(peer, predictor)


def test_images_without_a_pixel(peer, predictor):
    def empty(stamp):
        message = picture(stamp)
        message.height = message.width = message.step = 0
        message.data = np.zeros(0, np.uint8)
        return message

    refused(peer, predictor, "image size: got 0", image=empty)
    healthy(peer, predictor)


def test_a_changed_calibration_is_used_from_then_on(peer, predictor):
    healthy(peer, predictor)
    before = cells(peer)
    narrow = MATRIX * np.array([[3, 1, 1], [1, 3, 1], [1, 1, 1]])
    peer.begin()
    look(peer, 2.0, info=lambda stamp: information(stamp, matrix=narrow))
    assert peer.until(lambda: len(peer.received["/predicted/terrain"]) > 3)
    after = cells(peer)
    # A longer lens sees less.
    assert after[:, 7].sum() < 0.6 * before[:, 7].sum()
    healthy(peer, predictor)


def test_a_camera_that_dies_and_comes_back(peer, predictor):
    refused(peer, predictor, f"{IMAGE}: 1 publisher, no messages", image=lambda stamp: None)
    healthy(peer, predictor)


def test_the_former_name_of_the_retention_time_still_works_with_a_warning(start):
    process = start(
        "predictor", "--ros-args", "-p", "terrain_source:=camera", "-p", "camera_memory:=10.0", "-r", "__node:=former"
    )
    process.wait_for("terrain from camera")
    assert process.output.count("parameter 'camera_memory' is deprecated: use 'camera_retention_time'") == 1
    assert process.stop() == 0


@pytest.mark.parametrize(
    ("topic", "info"),
    [
        ("/front/image_raw/compressed", INFO),
        ("/sensors/camera_0/color/compressed", "/sensors/camera_0/color/camera_info"),
    ],
)
def test_compressed_images_and_their_calibration_are_found(start, peer, predictor, topic, info):
    # Another node of the same kind with the compressed topic; the first goes on undisturbed.
    checkpoint = next(word for word in predictor._process.args if "checkpoint" in word).split(":=")[1]
    other = start(
        "predictor", "--ros-args", "-r", "__ns:=/second",
        "-p", "odometry_topic:=/odom", "-p", "command_topic:=/cmd_vel",
        "-p", "terrain_source:=camera", "-p", f"checkpoint:={checkpoint}", "-p", f"image_topics:=[{topic}]",
    )  # fmt: skip
    other.wait_for("terrain from camera")
    data = cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), 90, np.uint8))[1].tobytes()
    found = []
    from nav_msgs.msg import Path

    peer.node.create_subscription(Path, "/second/predicted/path", found.append, 10)
    deadline = time.monotonic() + 20
    while not found and time.monotonic() < deadline:
        for _ in range(4):
            peer.publish(topic, builders.compressed_image(peer.now, "camera_front", "jpeg", data))
            peer.publish(info, information(peer.now))
            peer.drive(0.2, cloud=lambda stamp: None)
    assert found, other.output
    assert other.stop() == 0
