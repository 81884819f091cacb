"""Depth along pixels: bins relative to level ground, and their training on cached features of the backbone."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from monoforce_ros.encoder import CheckpointError, EncoderConfig, TerrainEncoder, load_encoder, save_encoder
from monoforce_ros.training import train_cli
from monoforce_ros.training.depth_training import DepthSettings, DepthTrainer, depth_errors
from monoforce_ros.training.image_features import image_features
from monoforce_ros.training.recording_samples import SamplesError, read_samples
from monoforce_ros.training.samples import sample
from monoforce_ros.training.training_state import TrainingError
from monoforce_ros.training.world_samples import world_samples

CONFIG = EncoderConfig(
    sensor="camera_lidar", image_width=128, image_height=96, map_size=6.4, resolution=0.2, edges=False, relative_bins=40
)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Samples of a few places of one randomised world."""
    return read_samples(world_samples(431_001, CONFIG, tmp_path_factory.mktemp("worlds"), places=4))


def encoder_of(config: EncoderConfig = CONFIG, seed: int = 3) -> TerrainEncoder:
    torch.manual_seed(seed)
    encoder = TerrainEncoder(config)
    encoder.backbone.load_imagenet()
    return encoder.eval()


def inputs(count: int, height: float, config: EncoderConfig = CONFIG):
    """Features, rays and origins of cameras that look ahead and down, at a height above the ground [m]."""
    rows, columns = config.feature_rows, config.feature_columns
    rays = torch.ones(count, rows, columns, 3)
    rays[..., 1] = torch.linspace(0.8, -0.8, columns)
    rays[..., 2] = torch.linspace(0.3, -1.2, rows)[:, None]
    features = torch.rand(count, 40, rows, columns), torch.rand(count, 112, rows // 2, columns // 2)
    return *features, rays, torch.tensor([[0.0, 0.0, height]]).repeat(count, 1)


def test_bins_of_relative_depth_change_nothing_before_they_are_trained():
    plain = encoder_of(replace(CONFIG, relative_bins=0))
    with_bins = encoder_of()
    with_bins.load_state_dict(with_bins.state_dict() | plain.state_dict())
    batch = inputs(2, 0.6)
    for found, expected in zip(with_bins.lifted(*batch), plain.lifted(*batch), strict=True):
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("height", [0.35, 0.6, 1.4])
def test_one_answer_relative_to_level_ground_holds_at_every_height_and_row(height):
    encoder = encoder_of()
    with torch.no_grad():
        for part in (encoder.lift, encoder.relative):
            part.weight.zero_()
            part.bias.zero_()
        encoder.level_weight.zero_()
        # Four bins nearer than level ground, everywhere.
        level_bin = 0.75 * (CONFIG.relative_bins - 1)
        encoder.relative.bias.copy_(-((torch.arange(CONFIG.relative_bins) - (level_bin - 4.0)) ** 2))
    _, _, rays, origins = batch = inputs(1, height)
    probability, _ = encoder.lifted(*batch)
    mean = (probability.exp() * encoder.depths.log()[:, None, None]).sum(1)
    level = -origins[0, 2] / rays[..., 2]
    step = float(encoder.depths[1].log() - encoder.depths[0].log())
    known = (rays[..., 2] < 0) & (level > 1.2) & (level < 8.0)
    assert int(known.sum()) > 20
    np.testing.assert_allclose((mean - level.log())[known].detach(), -4.0 * step, atol=0.1 * step)


def test_relative_logits_are_interpolated(one_thread):
    encoder = encoder_of()
    random = torch.Generator().manual_seed(5)
    relative = torch.randn(1, CONFIG.relative_bins, 3, 2, generator=random)
    level = torch.rand(1, 3, 2, generator=random) * 2.0
    found = encoder._from_level_ground(relative, level)[0]
    step = float(encoder.depths[1].log() - encoder.depths[0].log())
    for row, column in np.ndindex(3, 2):
        offsets = (encoder.depths.log().numpy() - float(level[0, row, column])) / step
        known = np.arange(CONFIG.relative_bins) - 0.75 * (CONFIG.relative_bins - 1)
        expected = np.interp(offsets, known, relative[0, :, row, column].numpy())
        np.testing.assert_allclose(found[:, row, column], expected, atol=1e-3)


def test_depth_of_a_world_is_learned_on_cached_features(world, tmp_path, one_thread):
    encoder = encoder_of()
    features = image_features(encoder, [world], tmp_path, variants=0)
    before = depth_errors(encoder, features)
    untouched = {name: value.clone() for name, value in encoder.state_dict().items()
                 if name.startswith(("backbone.", "bird.", "heads."))}  # fmt: skip
    settings = DepthSettings(steps=80, batch=4, warm_up=5, keep=0, part="all")
    trainer = DepthTrainer(encoder, features, tmp_path, settings)
    trainer.run()
    after = depth_errors(encoder, features)
    assert after.rays == before.rays > 300
    assert after.median < 0.5 * min(before.median, before.level)
    assert after.prominent < 0.4 * before.prominent_level
    assert all(torch.equal(value, encoder.state_dict()[name]) for name, value in untouched.items())


def test_the_last_layer_alone_learns_depth_and_leaves_the_rest(world, tmp_path, one_thread):
    encoder = encoder_of()
    features = image_features(encoder, [world], tmp_path, variants=0)
    before = depth_errors(encoder, features)
    weights = {name: value.clone() for name, value in encoder.state_dict().items()}
    DepthTrainer(encoder, features, tmp_path, DepthSettings(steps=40, batch=4, warm_up=5, keep=0)).run()
    changed = {
        name.split(".")[0] for name, value in encoder.state_dict().items() if not torch.equal(value, weights[name])
    }
    assert changed == {"lift", "relative", "level_weight"}
    assert depth_errors(encoder, features).median < 0.8 * before.median
    with pytest.raises(ValueError, match="depth training part: got 'neck', expected one of lift, all"):
        DepthSettings(part="neck")


def test_lifted_features_are_kept_where_a_map_is_read_from_them(world, tmp_path, one_thread):
    changes = []
    for keep in (0.0, 10.0):
        encoder = encoder_of()
        features = image_features(encoder, [world], tmp_path, variants=0)
        settings = DepthSettings(steps=30, batch=4, warm_up=5, keep=keep, part="all")
        DepthTrainer(encoder, features, tmp_path / str(keep), settings).run()
        part = features.select(torch.arange(len(features)))
        _, lifted = encoder.lifted(part.fine, part.coarse, part.rays, part.origins)
        changes.append(float((lifted - part.lifted).square().mean().detach()))
    assert changes[1] < 0.3 * changes[0]


def test_features_are_those_of_the_encoder_and_computed_once(world, tmp_path):
    encoder = encoder_of()
    features = image_features(encoder, [world], tmp_path, variants=0)
    (file,) = tmp_path.glob("features-*.safetensors")
    written = file.stat().st_mtime_ns
    again = image_features(encoder, [world], tmp_path, variants=0)
    assert file.stat().st_mtime_ns == written and torch.equal(again.fine, features.fine)
    batch, targets = sample(world, 0, CONFIG)
    count = len(batch.images)
    with torch.no_grad():
        fine, coarse = encoder.image_features(batch.images)
    torch.testing.assert_close(features.fine[:count].float(), fine, rtol=0.01, atol=0.02)
    torch.testing.assert_close(features.coarse[:count].float(), coarse, rtol=0.01, atol=0.02)
    assert torch.equal(features.depth[:count], torch.where(batch.seen, targets.depth, 0.0))
    # Augmented variants, and another encoder's, are other files.
    varied = image_features(encoder, [world], tmp_path, variants=2)
    assert len(varied) == 2 * len(features) and not torch.equal(varied.fine[: len(features)], features.fine)
    image_features(encoder_of(seed=4), [world], tmp_path, variants=0)
    assert len(list(tmp_path.glob("features-*.safetensors"))) == 4
    file.write_bytes(file.read_bytes()[:2000])
    with pytest.raises(SamplesError, match="damaged .* delete it to recreate it"):
        image_features(encoder, [world], tmp_path, variants=0)


def test_features_of_another_sweep_or_ground_are_computed_anew(world, tmp_path):
    """Depths are those that the sweep measured, and rays begin above the ground under the wheels."""
    encoder = encoder_of()
    before = image_features(encoder, [world], tmp_path, variants=0)
    other = replace(world, sweeps=world.sweeps[::4].copy(), sweep_ends=world.sweep_ends // 4)
    features = image_features(encoder, [other], tmp_path, variants=0)
    batch, targets = sample(other, 0, CONFIG)
    expected = torch.where(batch.seen, targets.depth, 0.0)
    assert torch.equal(features.depth[: len(expected)], expected)
    assert not torch.equal(before.depth[: len(expected)], expected)
    lower = image_features(encoder, [replace(world, support=world.support - [0.0, 0.0, 0.3])], tmp_path, variants=0)
    torch.testing.assert_close(lower.origins[:, 2], before.origins[:, 2] + 0.3, rtol=0.0, atol=1e-4)


def test_an_interrupted_training_continues_as_if_it_had_not_been(world, tmp_path, one_thread):
    settings = DepthSettings(steps=6, batch=4, warm_up=2, save_every=3)

    class InterruptedTrainingError(Exception):
        pass

    def interrupt(step, losses):
        if step == 4:
            raise InterruptedTrainingError

    def trainer(folder, encoder):
        return DepthTrainer(encoder, image_features(encoder_of(), [world], tmp_path), folder, settings)

    whole = encoder_of()
    trainer(tmp_path / "whole", whole).run()
    with pytest.raises(InterruptedTrainingError):
        trainer(tmp_path / "parts", encoder_of()).run(interrupt)
    resumed = encoder_of()
    second = trainer(tmp_path / "parts", resumed)
    assert second.resume() and second.step == 3
    second.run()
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], value, msg=name)


def test_a_state_of_another_layout_or_other_settings_is_refused(world, tmp_path):
    encoder = encoder_of()
    features = image_features(encoder, [world], tmp_path, variants=0)
    DepthTrainer(encoder, features, tmp_path, DepthSettings(steps=5)).save()
    with pytest.raises(TrainingError, match="saved with different rate; use the same options, or another --out"):
        DepthTrainer(encoder, features, tmp_path, DepthSettings(steps=5, rate=2e-3)).resume()
    other = encoder_of(replace(CONFIG, relative_bins=0))
    with pytest.raises(TrainingError, match="saved with different network configuration"):
        DepthTrainer(other, features, tmp_path, DepthSettings(steps=5)).resume()


def test_a_checkpoint_without_bins_of_relative_depth_is_still_read(tmp_path):
    file = tmp_path / "encoder.safetensors"
    save_encoder(encoder_of(replace(CONFIG, relative_bins=0)), file)
    description = json.loads(file.with_suffix(".json").read_text())
    del description["relative_bins"]
    file.with_suffix(".json").write_text(json.dumps(description))
    assert load_encoder(file).config.relative_bins == 0
    # A configuration that promises them is refused.
    file.with_suffix(".json").write_text(json.dumps(description | {"relative_bins": 40}))
    with pytest.raises(CheckpointError, match="the weights do not match the network"):
        load_encoder(file)


def test_the_executable_trains_depth_first_and_resumes(demo_bag, tmp_path, capsys):
    start = tmp_path / "start.safetensors"
    save_encoder(encoder_of(replace(CONFIG, relative_bins=0, sensor="camera")), start)
    options = [
        demo_bag, "--out", tmp_path, "--start-from", start, "--depth-steps", 3, "--depth-variants", 1, "--steps", 1,
        "--batch", 2, "--size", "128x96", "--map-size", "6.4", "--resolution", "0.2", "--losses", "geometric",
        "terrain", "--no-vegetation", "--device", "cpu", "--precision", "float32", "--threads", 1, "--quiet",
        "--relative-bins", 40,
    ]  # fmt: skip
    assert train_cli.main([str(option) for option in options]) == 0
    assert "depth along pixels: median error" in capsys.readouterr().out
    assert (tmp_path / "state" / "depth.safetensors").is_file()
    found = load_encoder(tmp_path / "encoder.safetensors")
    assert found.config.relative_bins == CONFIG.relative_bins
    assert float(found.relative.weight.detach().abs().max()) > 0.0
    assert train_cli.main([str(option) for option in options]) == 0
    assert "resuming from step 1" in capsys.readouterr().out
    assert train_cli.main([str(option) for option in (*options, "--sensor", "lidar")]) == 1
