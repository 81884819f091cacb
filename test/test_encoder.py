"""The terrain encoder: geometry of the lift, checkpoints, and what it refuses."""

import json

import numpy as np
import pytest
import torch

from monoforce_ros.camera import CameraModel
from monoforce_ros.encoder import CameraView, CheckpointError, EncoderConfig, TerrainEncoder, load_encoder, save_encoder
from monoforce_ros.encoder.lift import depth_values, frustum_points, map_cells, splat
from monoforce_ros.motion import homogeneous, transform_points

SMALL = EncoderConfig(image_width=128, image_height=96, map_size=6.4, resolution=0.2, depth_bins=12, map_features=8)
FORWARD = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # optical axes of a camera that looks along x


def view(image=None, *, rotation=FORWARD, lens=(), size=(128, 96)) -> CameraView:
    width, height = size
    matrix = np.array([[0.6 * width, 0, width / 2 - 0.5], [0, 0.6 * width, height / 2 - 0.5], [0, 0, 1]])
    camera = CameraModel(width, height, matrix, np.array(lens))
    image = np.zeros((height, width, 3), np.uint8) if image is None else image
    return CameraView(image, camera, homogeneous(rotation, np.array([0.2, 0.0, 0.5])))


@pytest.mark.parametrize(
    ("rotation", "lens", "size"),
    [
        (FORWARD, [], (128, 96)),
        (FORWARD, [-0.22, 0.065, 0, 0, 0], (320, 240)),
        (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), [], (96, 128)),  # to the left, portrait
        (FORWARD, [0.22, -0.02, 0, 0, 0.0015, 0.49, -0.026, 0.0019], (1232, 1616)),
    ],
)
def test_a_feature_at_a_depth_lands_in_the_cell_of_its_point(rotation, lens, size):
    seen = view(rotation=rotation, lens=lens, size=size)
    depths = depth_values(SMALL)
    points = frustum_points(seen.camera, 6, 8, depths)
    for row, column, index in [(0, 0, 3), (3, 4, 5), (5, 7, 2)]:
        # The point that projects onto the middle of the feature's patch of pixels, at its depth.
        pixel = np.array([(column + 0.5) / 8 * size[0] - 0.5, (row + 0.5) / 6 * size[1] - 0.5])
        projected, _ = seen.camera.project(points[index, row, column][None])
        np.testing.assert_allclose(projected[0], pixel, atol=0.2)
        assert points[index, row, column, 2] == pytest.approx(depths[index])
        place = transform_points(seen.terrain_from_camera, points[index, row, column])
        cell = int(map_cells(place, SMALL))
        grid = SMALL.grid
        if cell >= 0:
            assert abs(grid.x[cell % grid.columns] - place[0]) <= grid.resolution / 2 + 1e-9
            assert abs(grid.y[cell // grid.columns] - place[1]) <= grid.resolution / 2 + 1e-9


def test_splat_sums_what_falls_into_a_cell_and_drops_the_rest():
    depth = torch.tensor([[[[0.25]], [[0.75]]]])
    features = torch.tensor([[[[2.0]], [[4.0]]]])
    cells = torch.tensor([[[[3]], [[-1]]]])
    summed = splat(depth, features, cells, 5)
    assert summed[0, :, 3].tolist() == [0.5, 1.0, 0.25]
    assert float(summed.abs().sum()) == pytest.approx(1.75)
    both = splat(depth, features, torch.tensor([[[[3]], [[3]]]]), 5)
    assert both[0, :, 3].tolist() == [2.0, 4.0, 1.0]


def test_heads_keep_their_signs_and_any_number_of_cameras_goes():
    torch.manual_seed(0)
    encoder = TerrainEncoder(SMALL).eval()
    images = np.random.default_rng(0).integers(0, 255, (2, 96, 128, 3), np.uint8)
    for count in (1, 2):
        terrain = encoder.terrain([view(image) for image in images[:count]])
        assert bool((terrain.height <= terrain.geometric_height).all())
        assert float(terrain.stiffness.min()) > 0 and float(terrain.friction.min()) > 0
        assert terrain.grid == SMALL.grid
        # Behind the camera nothing was seen.
        assert not bool(terrain.observed[:, terrain.grid.x < 0.0].any())


def test_an_image_that_is_not_the_calibrated_size_is_named():
    with pytest.raises(ValueError, match="got 64 × 48 px, but its CameraInfo says 128 × 96 px"):
        view(np.zeros((48, 64, 3), np.uint8))


def test_a_checkpoint_comes_back_as_it_was(tmp_path):
    torch.manual_seed(1)
    encoder = TerrainEncoder(SMALL).eval()
    save_encoder(encoder, tmp_path / "a" / "encoder.safetensors")
    loaded = load_encoder(tmp_path / "a" / "encoder.safetensors")
    assert loaded.config == SMALL
    assert torch.equal(loaded.terrain([view()]).height, encoder.terrain([view()]).height)
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["encoder.json", "encoder.safetensors"]


def test_unusable_checkpoints_are_named_and_never_replaced_by_random_weights(tmp_path):
    path = tmp_path / "encoder.safetensors"
    with pytest.raises(CheckpointError, match="no encoder checkpoint was given"):
        load_encoder("")
    with pytest.raises(CheckpointError, match="does not exist: a checkpoint is"):
        load_encoder(path)
    save_encoder(TerrainEncoder(SMALL), path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="damaged"):
        load_encoder(path)
    path.write_bytes(whole)
    config = json.loads(path.with_suffix(".json").read_text())
    for change, message in (
        ({"map_features": 16}, "not the weights of the network"),
        ({"backbone": "resnet"}, "got 'resnet'"),
        ({"colour": "red"}, "not the configuration"),
        ({"depth_bins": 1e9}, "depth_bins"),
    ):
        path.with_suffix(".json").write_text(json.dumps(config | change))
        with pytest.raises(CheckpointError, match=message):
            load_encoder(path)
    path.with_suffix(".json").write_text("{")
    with pytest.raises(CheckpointError, match="not the configuration"):
        load_encoder(path)
    broken = TerrainEncoder(SMALL)
    torch.nn.init.constant_(broken.heads.bias, float("nan"))
    save_encoder(broken, path)
    with pytest.raises(CheckpointError, match="not finite"):
        load_encoder(path)
