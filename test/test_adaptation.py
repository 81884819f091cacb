"""Adaptation: own samples and randomised worlds together, judged on what neither training saw."""

import copy
import json

import numpy as np
import pytest
import torch

from monoforce_ros.encoder import EncoderConfig, load_encoder, new_encoder, save_encoder
from monoforce_ros.robots import load_robot
from monoforce_ros.training.adaptation import (
    AdaptationSettings,
    adapt,
    balanced,
    compare,
    keep_obstacles,
    split_recording,
)
from monoforce_ros.training.judgement import CAMERAS, SWEEP, calibrated, judge, judged_maps
from monoforce_ros.training.recording_samples import SamplesError, read_samples
from monoforce_ros.training.sample_extraction import extract_samples
from monoforce_ros.training.world_samples import world_samples

CONFIG = EncoderConfig(
    sensor="camera_lidar", image_width=128, image_height=96, map_size=6.4, resolution=0.2, edges=False
)


@pytest.fixture(scope="module")
def recording(demo_bag, tmp_path_factory):
    folder = tmp_path_factory.mktemp("samples")
    return read_samples(extract_samples(demo_bag, load_robot("husky"), CONFIG, folder))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("worlds")
    file = world_samples(431_000, CONFIG, folder, places=3)
    assert world_samples(431_000, CONFIG, folder, places=3) == file, "kept"
    return read_samples(file)


@pytest.fixture(scope="module")
def encoder():
    torch.manual_seed(3)
    return new_encoder(CONFIG).eval()


def test_a_recording_is_split_in_time(recording):
    training, held_out = split_recording(recording)
    assert training.stamps[-1] < held_out.stamps[0] - 2.9e9
    assert len(held_out) == pytest.approx(0.25 * len(recording), abs=2)
    for part, i in ((training, len(training) - 1), (held_out, 0)):
        whole = int(np.flatnonzero(recording.stamps == part.stamps[i])[0])
        np.testing.assert_array_equal(part.sweep(i), recording.sweep(whole))
        np.testing.assert_array_equal(part.trace(i), recording.trace(whole))
        assert torch.equal(part.images[i], recording.images[whole])
    with pytest.raises(SamplesError, match="got 2 samples over .* expected at least 5 s"):
        split_recording(recording.subset([0, 1]))


def test_a_world_has_samples_whose_sweeps_agree_with_its_surfaces(world, encoder):
    assert len(world) == 3 and len(world.chunks.stamps) == 0
    for entry in judged_maps(encoder, [world], SWEEP):
        low, _, hit = entry.batch.sweep[:, :3].unbind(1)
        low = (low + entry.batch.ground[:, None, None])[hit > 0]
        visible, supporting = entry.targets.geometric[hit > 0], entry.targets.supporting[hit > 0]
        # Rays pass between leaves, down to the ground that carries them; the labels have no crowns of trees.
        between = (low > supporting - 0.1) & (low < visible + 0.1)
        assert float(between.float().mean()) > 0.9
        bare = visible - supporting < 0.05
        assert float((low - visible)[bare].abs().median()) < 0.03 and int(bare.sum()) > 100
        # The robot stands on its ground.
        under = entry.targets.supporting[:, 15:17, 15:17].mean(dim=(1, 2)) - entry.batch.ground
        assert float(under.abs().max()) < 0.15


def test_an_untrained_encoder_is_as_good_as_the_ground_that_carries_the_robot(world, recording, encoder):
    found = judge(encoder, [world, recording], CAMERAS)
    assert found.median == pytest.approx(found.level, rel=0.25) and found.cells > 1000
    # And as what a sweep measured.
    found = judge(encoder, [world, recording], SWEEP)
    assert found.median < 0.3 * found.level and found.cells > 1000


def test_bands_are_calibrated_on_held_out_samples(world, recording, encoder):
    before = judge(encoder, [recording])
    better = calibrated(encoder, [recording])
    after = judge(better, [recording])
    assert abs(before.inside - 0.9) > 0.01 and after.inside == pytest.approx(0.9, abs=0.005)
    assert calibrated(better, [recording]).config.geometric_spread_factor == pytest.approx(
        better.config.geometric_spread_factor, rel=1e-3
    )


def test_both_kinds_of_samples_count_alike(recording, world):
    joined = balanced([recording], [world])
    own = sum(len(entry) for entry in joined if entry is recording)
    assert own == pytest.approx(sum(map(len, joined)) / 2, rel=0.2)
    assert balanced([recording], []) == [recording]


def test_adaptation_mends_an_encoder_of_another_robot(recording, world, tmp_path, one_thread):
    training, held_out = split_recording(recording)
    torch.manual_seed(0)
    start = new_encoder(CONFIG)
    start.backbone.load_imagenet()
    # As the cameras of another robot did: everything looks 20 cm too high.
    with torch.no_grad():
        start.heads.bias[0] = 0.2
    biased = start.heads.weight.clone()
    steps = []
    settings = AdaptationSettings(steps=30, rate=5e-3)
    adapted = adapt(
        start, load_robot("husky"), [training], [world], tmp_path, settings, lambda step, losses: steps.append(step)
    )
    assert steps == list(range(1, 31))
    result = compare(start, adapted, [held_out], [world])
    assert result.before.median > 0.15 and result.after.median < 0.8 * result.before.median
    assert result.after.support < 0.8 * result.before.support
    assert result.worlds_after is not None and "randomised worlds: obstacles seen" in result.summary
    assert torch.equal(start.heads.weight, biased), "the encoder that was adapted is untouched"


@pytest.mark.parametrize(("height", "share"), [(0.4, 1.0), (-0.1, 0.5), (-2.0, 0.0)])
def test_no_more_of_a_change_is_kept_than_lets_obstacles_be_detected(encoder, world, height, share):
    def raised(by):
        result = copy.deepcopy(encoder)
        with torch.no_grad():
            result.heads.bias[0] += by
        return result

    # An encoder that takes everything for an obstacle, cells over 15 cm, and a copy that does not any more.
    before, adapted = raised(0.5), raised(height)
    assert judge(before, [world]).obstacles > 0.95
    found, kept = keep_obstacles(before, adapted, [world])
    assert kept == share and judge(found, [world]).obstacles > 0.93
    assert (found.heads.bias[0] - encoder.heads.bias[0]).item() == pytest.approx(0.5 + share * (height - 0.5), abs=1e-6)


@pytest.mark.unhurried
def test_the_executable_adapts_to_a_bag(executables, demo_bag, tmp_path):
    from test_training import run

    torch.manual_seed(1)
    save_encoder(new_encoder(CONFIG), tmp_path / "start.safetensors")
    done = run(
        executables, demo_bag, "--adapt", "--start-from", tmp_path / "start.safetensors", "--out", tmp_path / "out",
        "--steps", 2, "--worlds", 1, "--held-out-worlds", 2, "--threads", 1, "--quiet",
    )  # fmt: skip
    assert "held-out part: error of the visible surface" in done.stdout
    assert "randomised worlds: obstacles seen" in done.stdout and "checkpoint:=" in done.stdout
    written = json.loads((tmp_path / "out" / "adaptation.json").read_text())
    assert set(written) == {"before", "after", "worlds_before", "worlds_after", "share"}
    assert load_encoder(tmp_path / "out" / "encoder.safetensors").config.map_size == CONFIG.map_size
