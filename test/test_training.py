"""Training: augmentation preserves the calibration, losses count measured cells only, and the executable trains."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from monoforce_ros.core import CameraModel
from monoforce_ros.encoder import CheckpointError, EncodedMaps, EncoderConfig, load_encoder, new_encoder
from monoforce_ros.encoder.checkpoint import shipped_checkpoint
from monoforce_ros.encoder.lift import feature_rays
from monoforce_ros.physics import PhysicsOptions
from monoforce_ros.robots import load_robot
from monoforce_ros.training import train_cli
from monoforce_ros.training.batches import Batches
from monoforce_ros.training.gathered_samples import recorded_worlds
from monoforce_ros.training.judgement import BOTH, CAMERAS, SWEEP
from monoforce_ros.training.losses import (
    LossWeights,
    depth_loss,
    geometric_loss,
    measured_decrease_loss,
    prominent_decrease_loss,
    ray_depth_loss,
    slope_loss,
    spread_loss,
    terrain_loss,
    trajectory_loss,
)
from monoforce_ros.training.recording_samples import SamplesError, read_samples
from monoforce_ros.training.sample_extraction import SampleSettings, extract_samples
from monoforce_ros.training.samples import MIRROR, Augmentation, Targets, sample
from monoforce_ros.training.train_cli import build_parser
from monoforce_ros.training.trainer import (
    Process,
    Trainer,
    TrainingSettings,
    _evenly,
    _Losses,
    _sensors,
    validate,
)
from monoforce_ros.training.training_state import TrainingError, read_state, save_state

TINY = EncoderConfig(image_width=128, image_height=96, map_size=6.4, resolution=0.2)
OPTIONS = ["--size", "128x96", "--map-size", "6.4", "--resolution", "0.2", "--batch", "4", "--device", "cpu",
           "--threads", "1", "--quiet"]  # fmt: skip


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


@pytest.fixture(scope="module")
def sample_folder(tmp_path_factory, demo_bag, husky):
    """Folder with the samples of the demo recording, shared by all trainings below."""
    folder = tmp_path_factory.mktemp("samples")
    extract_samples(demo_bag, husky, TINY, folder)
    return folder


@pytest.fixture(scope="module")
def recording(sample_folder):
    return read_samples(next(sample_folder.glob("*.safetensors")))


@pytest.mark.parametrize("lens", [[], [-0.22, 0.065, 0, 0, 0]])
@pytest.mark.parametrize(
    "augmentation",
    [
        Augmentation(mirrored=True),
        Augmentation(zoom=1.25, shift=(0.8, -0.6)),
        Augmentation(tilt=0.04, zoom=1.1, shift=(-1.0, 1.0)),
        Augmentation(mirrored=True, tilt=-0.03, zoom=1.2, shift=(0.3, 0.5)),
    ],
)
def test_a_ray_of_an_augmented_image_passes_through_the_point_at_its_pixel(augmentation, lens):
    matrix = np.array([[180.0, 0, 159.5], [0, 185.0, 121.0], [0, 0, 1]])
    camera = CameraModel(320, 240, matrix, np.array(lens))
    x, y = 190.0, 130.0
    image = np.zeros((240, 320, 3), np.uint8)
    cv2.circle(image, (int(x), int(y)), 4, (255, 255, 255), -1)
    augmented = augmentation.image(image)[..., 0].astype(float)
    bright = augmented > 100
    v, u = (np.array(np.nonzero(bright)) * augmented[bright]).sum(1) / augmented[bright].sum()
    # Rays of single pixels of the augmented image: a feature map as fine as the image.
    rays = feature_rays(camera, 240, 320, augmentation.image_from_view())
    np.testing.assert_allclose(rays[round(v), round(u)], camera.rays(np.array([x, y])), atol=0.012)
    # The whole augmented image lies within the original one.
    corners = augmentation.image_from_view() @ np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1.0]]).T
    assert corners.min() > -1e-9 and corners.max() < 1 + 1e-9


def test_an_augmented_image_has_other_colours_and_noise():
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    grey = Augmentation(saturation=0.0).image(image).astype(int)
    assert np.ptp(grey, axis=-1).max() <= 1 and grey.std() > 30
    flat = np.full_like(image, 64)
    assert Augmentation(exposure=0.5).image(flat).mean() == pytest.approx(255 * np.sqrt(64 / 255), abs=1.0)
    noisy = Augmentation(noise=5.0, seed=3)
    assert noisy.image(flat).std() == pytest.approx(5.0, abs=0.3) and noisy.image(flat).mean() == pytest.approx(
        64, abs=1
    )
    np.testing.assert_array_equal(noisy.image(flat), noisy.image(flat))
    assert np.any(replace(noisy, seed=4).image(flat) != noisy.image(flat))


def test_samples_that_were_not_read_from_a_file_are_prepared_without_another_process(recording):
    batches = Batches([recording.subset(range(4))], TINY, size=2, seed=3)
    assert batches.recordings[0].file is None
    found = list(batches.prepared(range(3), loaders=2))
    assert len(found) == 3
    for step, (batch, targets) in enumerate(found):
        expected, wanted = batches[step]
        assert torch.equal(batch.images, expected.images) and torch.equal(targets.supporting, wanted.supporting)
    assert list(batches.prepared(range(0), loaders=1)) == []


def test_images_added_for_a_gpu_do_not_change_the_losses(recording, husky):
    encoder = new_encoder(TINY).eval()
    torch.nn.init.normal_(encoder.heads.weight, std=0.2)
    losses = _Losses(encoder, husky, LossWeights(trajectory=0.0))
    batch, targets = Batches([recording], TINY, size=3, seed=3)[0]
    more = _evenly(batch, targets)
    assert len(batch.images) < len(more[0].images) == len(more[1].depth) == 16
    with torch.no_grad():
        expected, found = losses(batch, targets), losses(*more)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, atol=1e-5, rtol=1e-5)


def test_worlds_drawn_side_by_side_are_those_drawn_one_after_another(tmp_path):
    drawn = {}
    for jobs in (1, 2):
        options = build_parser().parse_args(["--jobs", str(jobs), "--samples", str(tmp_path / str(jobs)), "--quiet"])
        drawn[jobs] = recorded_worlds(range(431_000, 431_002), EncoderConfig(), options, places=2)
    assert len(drawn[1]) == len(drawn[2]) == 2
    for alone, beside in zip(drawn[1], drawn[2], strict=True):
        assert alone.name == beside.name and torch.equal(alone.images, beside.images)


def maps_of(targets: Targets, **changes) -> EncodedMaps:
    """The maps of an encoder without error."""
    shape = targets.geometric
    return EncodedMaps(
        **{
            "geometric_height": targets.supporting.clone(), "decrease": torch.zeros_like(shape),
            "stiffness": torch.full_like(shape, TINY.stiffness), "damping": torch.full_like(shape, TINY.damping),
            "friction": torch.full_like(shape, TINY.friction), "covered": torch.ones_like(shape, dtype=torch.bool),
            "geometric_spread": torch.full_like(shape, 0.1), "decrease_spread": torch.full_like(shape, 0.1),
            "evidence": torch.ones_like(shape), **changes,
        }
    )  # fmt: skip


def test_a_mirrored_and_turned_sample_moves_as_the_original(recording, husky):
    losses = []
    for augmentation in (
        Augmentation(),
        Augmentation(mirrored=True),
        Augmentation(turn=0.3),
        Augmentation(mirrored=True, turn=-0.3),
    ):
        _, targets = sample(recording, 4, TINY, augmentation)
        losses.append(float(trajectory_loss(maps_of(targets), targets, husky, TINY, PhysicsOptions())))
        assert torch.linalg.det(targets.rotations).sub(1).abs().max() < 1e-4
        # The origin of the terrain frame is at the robot.
        assert float(targets.positions[0, 0, :2].norm()) < 0.5
    assert losses[0] < 0.1
    assert losses[1] == pytest.approx(losses[0], rel=0.02)
    # Resampling the rotated map causes small differences; a wrong sign costs many times as much.
    np.testing.assert_allclose(losses, losses[0], rtol=0.6)
    _, targets = sample(recording, 4, TINY, Augmentation(mirrored=True))
    wrong = replace(targets, twists=targets.twists * torch.tensor([1.0, -1.0]))
    assert float(trajectory_loss(maps_of(wrong), wrong, husky, TINY, PhysicsOptions())) > 5 * losses[1]


def test_a_mirrored_sample_mirrors_its_maps(recording):
    (batch, plain), (other, mirrored) = (sample(recording, 3, TINY, Augmentation(mirrored=m)) for m in (False, True))
    both = plain.observed & mirrored.observed.flip(1)
    difference = (plain.geometric - mirrored.geometric.flip(1)).abs()[both]
    assert float(difference.median()) < 1e-4
    assert float((plain.contact_mask ^ mirrored.contact_mask.flip(1)).float().mean()) < 0.02
    np.testing.assert_allclose(other.origins[0], MIRROR @ batch.origins[0].numpy(), atol=1e-5)
    assert float(batch.ground[0]) == pytest.approx(float(other.ground[0]), abs=1e-6)


def test_a_missing_wall_costs_more_with_a_larger_prominence_weight(recording):
    batch, targets = sample(recording, 3, TINY)
    ground = batch.ground[:, None, None].expand_as(targets.geometric)
    wall = torch.zeros_like(targets.observed)
    wall[:, 10, 5:15] = True
    targets = replace(targets, geometric=ground + 0.9 * wall, observed=torch.ones_like(wall))
    level = maps_of(targets, geometric_height=ground.clone())
    plain, more = (float(geometric_loss(level, targets, batch.ground, prominence)) for prominence in (0.0, 8.0))
    cells = wall.float().mean() / (1.0 + 8.0 * wall.float().mean())
    assert more == pytest.approx(9.0 * float(cells) * (0.9 - 0.025), rel=0.05) and more > 6.0 * plain
    with pytest.raises(ValueError, match="loss weight prominence: got -1"):
        LossWeights(prominence=-1.0)


def test_losses_are_means_over_measured_cells(recording):
    batch, targets = sample(recording, 3, TINY)
    off = maps_of(targets, geometric_height=targets.geometric + 0.3)
    whole = geometric_loss(off, targets, batch.ground)
    # A sparse mask does not shrink the loss, and cells without measurement do not count.
    sparse = targets.observed.clone()
    sparse[:, ::3] = False
    assert float(geometric_loss(off, replace(targets, observed=sparse), batch.ground)) == pytest.approx(
        float(whole), rel=0.1
    )
    elsewhere = off.geometric_height + torch.where(targets.observed, 0.0, 5.0)
    assert float(geometric_loss(replace(off, geometric_height=elsewhere), targets, batch.ground)) == float(whole)
    loss = terrain_loss(maps_of(targets, decrease=torch.full_like(targets.supporting, 0.2)), targets, batch.ground)
    assert float(loss) == pytest.approx(0.2 - 0.025, abs=1e-4)
    nothing = replace(targets, contact_mask=torch.zeros_like(targets.contact_mask))
    assert float(terrain_loss(maps_of(targets), nothing, batch.ground)) == 0.0


def test_the_slope_loss_penalises_relative_height_errors(recording):
    _, targets = sample(recording, 3, TINY)
    contact_mask = torch.zeros_like(targets.contact_mask)
    contact_mask[:, 5:20, 5:20] = True
    targets = replace(targets, contact_mask=contact_mask)
    up, right = (
        steps.to(torch.float32) for steps in torch.meshgrid(*map(torch.arange, contact_mask.shape[1:]), indexing="ij")
    )

    def loss_of(error):
        return float(
            slope_loss(maps_of(targets, geometric_height=targets.supporting + error), targets, TINY.resolution)
        )

    # A common height error does not tilt the robot, and neither do errors on cells without contact.
    assert loss_of(0.3 * torch.ones_like(up)) == pytest.approx(0.0, abs=1e-6)
    assert loss_of(torch.where(contact_mask[0], 0.0, 1.0)) == 0.0
    # Planes: 60 cm apart are 3, 0, 2 and 2 rows of 20 cm; rows and columns together 3, 3, 4 and 0.
    grade = 0.1
    expected = grade * (3 + 2 + 2) / 4 - 3 * 0.025 / 4
    assert loss_of(grade * up) == pytest.approx(expected, rel=1e-4)
    assert loss_of(-grade * right) == pytest.approx(expected, rel=1e-4)
    assert loss_of(grade * (up + right)) == pytest.approx(grade * (3 + 3 + 4) / 4 - 3 * 0.025 / 4, rel=1e-4)
    nothing = replace(targets, contact_mask=torch.zeros_like(contact_mask))
    assert (
        float(slope_loss(maps_of(targets, geometric_height=targets.supporting + grade * up), nothing, TINY.resolution))
        == 0.0
    )


def test_prominent_cells_weigh_more(recording):
    batch, targets = sample(recording, 3, TINY)
    measured = targets.geometric.clone()
    rows, columns = measured.shape[1:]
    wall = torch.zeros_like(targets.observed)
    wall[:, rows // 2, columns // 2 - 3 : columns // 2 + 3] = True
    measured = torch.where(wall, batch.ground[:, None, None] + 0.9, batch.ground[:, None, None])
    targets = replace(targets, geometric=measured, observed=torch.ones_like(targets.observed))

    def loss_of(where):
        return float(geometric_loss(maps_of(targets, geometric_height=measured + 0.3 * where), targets, batch.ground))

    level = torch.zeros_like(wall)
    level[:, 2, 2:8] = True
    assert loss_of(wall) == pytest.approx(4 * loss_of(level), rel=1e-3)


def test_the_decrease_is_supervised_where_both_surfaces_are_known(recording):
    _, targets = sample(recording, 3, TINY)
    observed = torch.zeros_like(targets.observed)
    observed[:, :, observed.shape[2] // 2 :] = True
    targets = replace(targets, geometric=targets.supporting + 0.4, observed=observed)
    decrease = torch.full_like(targets.supporting, 0.1).requires_grad_()
    loss = measured_decrease_loss(maps_of(targets, decrease=decrease), targets)
    assert float(loss.detach()) == pytest.approx(0.3 - 0.025, abs=1e-4)
    (gradient,) = torch.autograd.grad(loss, decrease)
    known = targets.contact_mask & observed
    assert bool(known.any()) and bool((gradient[known] < 0).all()) and float(gradient[~known].abs().max()) == 0.0
    # Only cells with both surfaces count; the supporting terrain is never above the visible one.
    higher = replace(targets, geometric=targets.supporting - 0.4)
    assert float(measured_decrease_loss(maps_of(targets, decrease=decrease * 0.0), higher)) == 0.0


def test_the_decrease_of_prominent_cells_without_contact_is_penalised(recording):
    batch, targets = sample(recording, 3, TINY)
    wall, patch, level = (torch.zeros_like(targets.observed) for _ in range(3))
    wall[:, 10, 5:15], patch[:, 20, 5:15], level[:, 2, 2:8] = True, True, True
    targets = replace(
        targets,
        geometric=batch.ground[:, None, None] + 0.9 * (wall | patch),
        observed=torch.ones_like(wall),
        contact_mask=patch,
    )

    def loss_of(where):
        return float(prominent_decrease_loss(maps_of(targets, decrease=0.2 * where), targets, batch.ground))

    # Contact cells and level cells do not count, nor do they dilute the loss on a wall.
    assert loss_of(wall) == pytest.approx(0.2**2, rel=1e-4) and loss_of(patch) == loss_of(level) == 0.0
    nothing = replace(targets, observed=torch.zeros_like(wall))
    assert float(prominent_decrease_loss(maps_of(targets, decrease=0.2 * wall), nothing, batch.ground)) == 0.0


def test_spreads_learn_the_mean_error_and_heights_do_not_learn_from_them(recording):
    batch, targets = sample(recording, 3, TINY)
    heights = (targets.geometric + 0.2).requires_grad_()
    spread = torch.full_like(heights, 0.05).requires_grad_()
    for _ in range(400):
        maps = maps_of(targets, geometric_height=heights, geometric_spread=spread.clamp_min(0.01))
        gradient_of_heights, gradient = torch.autograd.grad(
            spread_loss(maps, targets, batch.ground) + 0.0 * heights.sum(), (heights, spread)
        )
        assert float(gradient_of_heights.abs().max()) == 0.0
        with torch.no_grad():
            spread -= 0.002 * gradient.sign()
    # Heights are clamped like those of trees.
    known = targets.observed & (targets.geometric - batch.ground[:, None, None] < 0.7)
    # The scale of a Laplace distribution that maximises the likelihood is the mean absolute error.
    np.testing.assert_allclose(spread.detach()[known], 0.2, atol=0.005)


def test_the_depth_loss_is_smallest_at_the_measured_depth(recording):
    _, targets = sample(recording, 3, TINY)
    depths = torch.from_numpy(np.geomspace(0.6, 10.0, 48)).float()
    known = targets.depth > 0
    assert float(known.float().mean()) > 0.05, "the lidar sees what the camera sees"
    right = (targets.depth.clamp_min(0.6)[:, None] - depths[:, None, None]).abs().argmin(dim=1)
    losses = []
    for shift in (0, 3):
        probability = torch.full((*right.shape[:1], 48, *right.shape[1:]), 1e-4)
        probability.scatter_(1, (right + shift).clamp(max=47)[:, None], 1.0)
        losses.append(float(depth_loss(maps_of(targets, depth=probability.log()), targets, depths)))
    assert losses[0] < 0.1 * losses[1]
    # Rays of no weight do not count.
    right_one = torch.zeros_like(known)
    right_one[tuple(torch.nonzero(known)[0])] = True
    probability.scatter_(1, right[:, None], torch.where(right_one, 1.0, 1e-4)[:, None])
    weighted = ray_depth_loss(probability.log(), targets.depth, depths, right_one.float())
    assert float(weighted) == pytest.approx(0.0, abs=1e-5)


def test_the_trajectory_loss_reaches_heights_and_material(recording, husky):
    _, targets = sample(recording, 4, TINY)
    heights = (targets.supporting + 0.02).requires_grad_()
    friction = torch.full_like(heights, 0.6).requires_grad_()
    stiffness = torch.full_like(heights, TINY.stiffness).requires_grad_()
    maps = maps_of(targets, geometric_height=heights, friction=friction, stiffness=stiffness)
    loss = trajectory_loss(maps, targets, husky, TINY, PhysicsOptions())
    gradients = torch.autograd.grad(loss, (heights, friction, stiffness))
    assert all(bool(g.isfinite().all()) and float(g.abs().sum()) > 0 for g in gradients)
    # Cells without contact, such as a wall near the path, get no gradient from a predicted collision.
    assert float(gradients[0][~targets.contact_mask].abs().max()) == 0.0


def test_a_sweep_agrees_with_the_map_of_many_sweeps(recording):
    config = replace(TINY, sensor="lidar")
    for augmentation in (Augmentation(), Augmentation(mirrored=True, turn=0.2)):
        batch, targets = sample(recording, 4, config, augmentation)
        low, _, hit = batch.sweep[0, :3]
        both = (hit > 0) & targets.observed[0]
        assert int(both.sum()) > 100
        away = (low + batch.ground[0] - targets.geometric[0])[both]
        assert float(away.abs().median()) < 0.05


def test_samples_are_extracted_once_and_damage_is_reported(tmp_path, demo_bag, husky, sample_folder, recording):
    file = next(sample_folder.glob("*.safetensors"))
    before = file.stat().st_mtime_ns
    assert extract_samples(demo_bag, husky, TINY, sample_folder) == file
    assert file.stat().st_mtime_ns == before and len(read_samples(file)) == len(recording)
    assert len(list(sample_folder.iterdir())) == 1
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(file.read_bytes()[:4000])
    with pytest.raises(SamplesError, match="damaged"):
        read_samples(broken)
    with pytest.raises(ValueError, match="samples period: got 0"):
        SampleSettings(period=0.0)


def test_samples_with_the_old_name_of_the_contact_mask_are_read_with_a_warning(tmp_path, sample_folder, recording):
    old = tmp_path / "old.safetensors"
    file = next(sample_folder.glob("*.safetensors"))
    with safe_open(str(file), framework="pt") as content:
        metadata = content.metadata()
    tensors = {name.replace("contact_mask", "felt"): value for name, value in load_file(str(file)).items()}
    assert any(name.endswith(".felt") for name in tensors)
    save_file(tensors, str(old), metadata=metadata)
    with pytest.warns(FutureWarning, match="'felt' is now 'contact_mask'") as caught:
        samples = read_samples(old)
    assert len(caught) == 1
    for renamed, segment in zip(samples.segments, recording.segments, strict=True):
        np.testing.assert_array_equal(renamed.contact_mask, segment.contact_mask)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["--cut", "folder"], ["--samples", "folder"]),
        (["--cut-only"], ["--samples-only"]),
        (["--standing", "8"], ["--prominence", "8"]),
        (["--no-variation"], ["--no-augmentation"]),
    ],
)
def test_old_names_of_options_are_accepted_with_a_warning(old, new, capsys):
    parser = build_parser()
    assert parser.parse_args(["bag", *old]) == parser.parse_args(["bag", *new]) != parser.parse_args(["bag"])
    warning = f"train: {old[0]} is now {new[0]}; the old name will be removed"
    assert capsys.readouterr().err.splitlines() == [warning]
    assert old[0] + " " not in parser.format_help()


def test_a_state_with_old_names_of_settings_is_resumed(tmp_path, husky, recording):
    def trainer():
        return Trainer(new_encoder(TINY), husky, [recording], [], tmp_path, TrainingSettings(steps=5), Process("cpu"))

    saved = trainer()
    saved.step = 3
    saved.save()
    file = tmp_path / "state" / "state.safetensors"
    with safe_open(str(file), framework="pt") as content:
        description = json.loads(content.metadata()["training"])
    settings = description["settings"]
    settings["vary"] = settings.pop("augment")
    weights = settings["weights"]
    weights["standing"], weights["standing_decrease"] = weights.pop("prominence"), weights.pop("prominent_decrease")
    save_file(load_file(str(file)), str(file), metadata={"training": json.dumps(description)})
    resumed = trainer()
    assert resumed.resume() and resumed.step == 3


def run(executables, *arguments, check=True, **environment):
    done = subprocess.run(
        [str(executables / "train"), *map(str, arguments)],
        capture_output=True, text=True, timeout=300, env={**os.environ, **environment},
    )  # fmt: skip
    assert not check or done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def trained(executables, demo_bag, sample_folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("trained")
    run(executables, demo_bag, "--out", out, "--samples", sample_folder, "--steps", 24, "--save-every", 8, *OPTIONS)
    return out


def test_batches_prepared_in_advance_do_not_change_the_training(recording, husky, tmp_path, one_thread):
    def weights(loaders: int, stop: int | None = None):
        settings = TrainingSettings(steps=6, warm_up=2, save_every=3, weights=LossWeights(trajectory=0.0))
        torch.manual_seed(0)
        folder = tmp_path / f"{loaders} {stop}"
        trainer = Trainer(new_encoder(TINY), husky, [recording], [], folder, settings, Process("cpu"), loaders=loaders)

        def report(step: int, losses: dict[str, float]) -> None:
            if step == stop:
                raise KeyboardInterrupt

        if stop is not None:
            with pytest.raises(KeyboardInterrupt):
                trainer.run(report)
            assert trainer.resume() and trainer.step == 3
        trainer.run()
        return trainer.encoder.state_dict()

    expected = weights(1)
    for found in (weights(2), weights(2, stop=5)):
        assert all(torch.equal(found[name], value) for name, value in expected.items())


def test_validation_sees_the_sensors_in_the_shares_of_the_training():
    found = [_sensors(i, (0.25, 0.4, 0.35)) for i in range(100)]
    assert [found.count(kind) for kind in (CAMERAS, BOTH, SWEEP)] == pytest.approx([25, 40, 35], abs=2)
    assert {_sensors(i, (1.0, 0.0, 0.0)) for i in range(50)} == {CAMERAS}


def test_an_encoder_of_both_is_validated_with_a_sweep_alone(recording):
    encoder = new_encoder(replace(TINY, sensor="camera_lidar"))
    seen = []
    encoder.register_forward_hook(lambda module, inputs, maps: seen.append(inputs[0]))
    validate(encoder, [recording], torch.device("cpu"), (0.0, 0.0, 1.0))
    assert all(len(batch.images) == 0 and float(batch.sweep.abs().max()) > 0.0 for batch in seen)


def test_training_improves_on_the_ground_that_carries_the_robot(recording, husky, tmp_path, one_thread):
    settings = TrainingSettings(steps=30, warm_up=3, rate=3e-3, augment=False, weights=LossWeights(trajectory=0.0))
    torch.manual_seed(0)
    encoder = new_encoder(TINY)
    encoder.backbone.load_imagenet()
    before = validate(encoder, [recording], torch.device("cpu"))
    Trainer(encoder, husky, [recording], [], tmp_path, settings, Process("cpu")).run()
    assert validate(encoder, [recording], torch.device("cpu")).loss < 0.8 * before.loss


@pytest.mark.parametrize(
    ("part", "early", "late"), [("none", False, False), ("late", False, True), ("all", True, True)]
)
def test_the_chosen_part_of_the_backbone_is_trained(recording, husky, tmp_path, one_thread, part, early, late):
    torch.manual_seed(0)
    encoder = new_encoder(TINY)
    before = {name: value.clone() for name, value in encoder.backbone.state_dict().items()}
    settings = TrainingSettings(steps=2, batch=2, backbone=part, weights=LossWeights(trajectory=0.0), warm_up=1)
    Trainer(encoder, husky, [recording], [], tmp_path, settings, Process("cpu")).run()
    after = encoder.backbone.state_dict()
    changed = {name for name, value in after.items() if not torch.equal(value, before[name])}
    assert any(name.startswith("stem") for name in changed) == early
    assert ("blocks.10.project.conv.weight" in changed) == late
    assert any("running_mean" in name for name in changed) == (part == "all")
    with pytest.raises(ValueError, match="training backbone: got 'some', expected one of none, late, all"):
        TrainingSettings(backbone="some")


def test_with_the_map_alone_trained_images_say_what_they_said(recording, husky, tmp_path, one_thread):
    torch.manual_seed(0)
    encoder = new_encoder(TINY)
    before = {name: value.clone() for name, value in encoder.state_dict().items()}
    settings = TrainingSettings(steps=2, batch=2, backbone="map", weights=LossWeights(trajectory=0.0), warm_up=1)
    Trainer(encoder, husky, [recording], [], tmp_path, settings, Process("cpu")).run()
    changed = {
        name.split(".")[0] for name, value in encoder.state_dict().items() if not torch.equal(value, before[name])
    }
    assert changed == {"bird", "heads"}


def test_a_training_writes_a_log_and_a_checkpoint_that_loads(trained):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(trained / "log"))
    events.Reload()
    for name in ("total", "geometric", "terrain"):
        values = [event.value for event in events.Scalars(f"loss/{name}")]
        assert len(values) == 24 and np.isfinite(values).all(), name
    encoder = load_encoder(trained / "encoder.safetensors")
    assert encoder.config == TINY
    described = json.loads((trained / "training.json").read_text())
    assert described["settings"]["steps"] == 24 and list(described["recordings"]) == ["demo"]
    # The name in earlier releases is still written.
    assert described["drives"] == described["recordings"]
    weights = described["settings"]["weights"]
    assert weights["standing"] == weights["prominence"] and described["settings"]["vary"] is not None


@pytest.mark.unhurried
def test_training_resumes_after_a_kill_with_the_same_result(
    executables, demo_bag, sample_folder, trained, tmp_path, start
):
    command = [demo_bag, "--out", tmp_path, "--samples", sample_folder, "--steps", 24, "--save-every", 8, *OPTIONS]
    process = start("train", *command)
    state = tmp_path / "state" / "state.safetensors"
    deadline = time.monotonic() + 120
    while not state.exists() and process.running and time.monotonic() < deadline:
        time.sleep(0.02)
    process.stop(signal.SIGKILL)
    done = run(executables, *command)
    assert "resuming from step" in done.stdout
    once, twice = (load_file(str(folder / "encoder.safetensors")) for folder in (trained, tmp_path))
    for name, value in once.items():
        torch.testing.assert_close(twice[name], value, rtol=1e-4, atol=1e-5)
    # Resuming with other options is an error.
    refused = run(executables, *command, "--rate", "0.1", check=False)
    assert refused.returncode == 1 and "different rate" in refused.stderr and "another --out" in refused.stderr
    state.write_bytes(state.read_bytes()[:1000])
    refused = run(executables, *command, check=False)
    assert refused.returncode == 1 and "damaged" in refused.stderr and "Traceback" not in refused.stderr


def test_two_processes_train_together(executables, demo_bag, sample_folder, tmp_path):
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m",
        "monoforce_ros.training.train_cli", demo_bag, "--out", tmp_path, "--samples", sample_folder, "--steps", "3",
        *OPTIONS,
    ]  # fmt: skip
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert load_encoder(tmp_path / "encoder.safetensors").config == TINY
    assert done.stdout.count("samples from 1 recordings") == 1


def test_unusable_input_is_reported_in_one_line(executables, tmp_path, demo_bag):
    missing = run(executables, tmp_path / "no", "--out", tmp_path / "o", *OPTIONS, check=False)
    assert missing.returncode == 1 and "does not exist" in missing.stderr and "Traceback" not in missing.stderr
    wrong = run(executables, demo_bag, "--out", tmp_path / "o", "--size", "130x96", check=False)
    assert wrong.returncode == 1 and "multiples of 16" in wrong.stderr
    other = tmp_path / "demo"
    shutil.copytree(demo_bag, other)
    unknown = run(executables, other, "--out", tmp_path / "o", "--images", "/no", *OPTIONS, check=False)
    assert unknown.returncode == 1 and "no images with a CameraInfo" in unknown.stderr


@pytest.mark.parametrize("sensor", ["camera", "lidar"])
def test_trainings_with_images_alone_resume_whatever_a_sweep_would_show(tmp_path, sensor):
    config = EncoderConfig(sensor=sensor, map_features=8)
    encoder = new_encoder(config)
    optimiser = torch.optim.SGD(encoder.parameters(), 1e-3)
    file = tmp_path / "state.safetensors"
    saved = {"settings": {}, "step": 3, "config": asdict(config) | {"sweep_channels": 7}}
    save_state(file, encoder, optimiser, saved)
    if sensor == "camera":
        assert read_state(file, encoder, optimiser, {})["step"] == 3
    else:
        with pytest.raises(TrainingError, match="saved with different network configuration"):
            read_state(file, encoder, optimiser, {})


def test_shares_of_sensors_decide_what_a_sample_lacks():
    # One in ninety samples of images alone has none: all cameras are left out.
    random = np.random.default_rng(4)
    swept = [Augmentation.draw(random, (0.0, 0.0, 1.0)) for _ in range(20)]
    assert not any(drawn.shows(camera) for drawn in swept for camera in range(6))
    assert all(drawn.sweep_share > 0.0 for drawn in swept)
    seeing = [Augmentation.draw(random, (2.0, 0.0, 0.0)) for _ in range(20)]
    assert all(any(drawn.shows(camera) for camera in range(6)) for drawn in seeing)
    assert not any(drawn.sweep_share for drawn in seeing)
    with pytest.raises(ValueError, match="sensor_shares: got"):
        TrainingSettings(sensor_shares=(0.0, 0.0, 0.0))


def test_with_all_sensors_no_sample_lacks_any():
    options = build_parser().parse_args(["bag", "--sensor", "camera_lidar", "--all-sensors", "--no-depth"])
    settings = train_cli._settings(options)
    assert settings.sensor_shares is None and settings.weights.depth == 0.0
    random = np.random.default_rng(3)
    for drawn in (Augmentation.draw(random, settings.sensor_shares) for _ in range(50)):
        assert all(drawn.shows(camera) for camera in range(6)) and not drawn.blank
        assert drawn.sweep_share == 1.0 and drawn.traced
    assert train_cli._settings(build_parser().parse_args(["bag"])).weights.depth > 0.0


def test_fine_tuning_takes_the_sensors_and_bins_of_its_start():
    arguments = ["bag", "--start-from", str(shipped_checkpoint())]
    options = build_parser().parse_args(arguments)
    shipped = load_encoder("")
    config = train_cli._config(options, shipped)
    assert (config.sensor, config.relative_bins) == (shipped.config.sensor, shipped.config.relative_bins)
    assert shipped.config.sensor == "camera_lidar" and shipped.config.relative_bins > 0
    start = train_cli._encoder(options, config, shipped).state_dict()
    assert all(torch.equal(start[name], value) for name, value in shipped.state_dict().items())
    assert train_cli._config(build_parser().parse_args(["bag"]), None).sensor == "camera"
    options = build_parser().parse_args([*arguments, "--sensor", "camera"])
    with pytest.raises(CheckpointError, match="sensor: got camera_lidar, expected camera"):
        train_cli._encoder(options, train_cli._config(options, shipped), shipped)
