"""Adaptation: own samples and randomised worlds together, judged on what neither training saw."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from monoforce_ros.bags import BagReader, BagWriter
from monoforce_ros.encoder import EncoderConfig, EncoderInput, load_encoder, new_encoder, save_encoder
from monoforce_ros.encoder.sweep import HIT
from monoforce_ros.robots import load_robot
from monoforce_ros.training.adaptation import (
    AdaptationSettings,
    adapt,
    balanced,
    calibration_and_judging,
    compare,
    got_worse,
    judged_adaptation,
    keep_obstacles,
    split_recording,
)
from monoforce_ros.training.judgement import (
    BOTH,
    CAMERAS,
    SWEEP,
    band_ratios,
    calibrated,
    judge,
    judged_maps,
    scene_factor,
    widened,
)
from monoforce_ros.training.recording_samples import SamplesError, read_samples
from monoforce_ros.training.sample_extraction import extract_samples
from monoforce_ros.training.samples import sample
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


def lifted(encoder, by):
    """A copy whose heights are all higher [m]."""
    result = copy.deepcopy(encoder)
    with torch.no_grad():
        result.heads.bias[0] += by
    return result


def test_weights_that_are_worse_beyond_chance_are_not_kept(encoder, recording):
    _, held_out = split_recording(recording)
    # The untrained encoder says the ground that carries the robot.
    wrong, right = lifted(encoder, 0.6), encoder
    assert got_worse(right, wrong, [held_out]) == ("surface", "support")
    assert got_worse(wrong, right, [held_out]) == got_worse(right, right, [held_out]) == ()
    assert got_worse(right, lifted(right, 0.3), [held_out.subset([0])]) == ("surface", "support")

    chosen, result = judged_adaptation(right, wrong, [held_out], [], 0.75)
    assert result.share == 0.0 and result.worse == ("surface", "support")
    assert result.after.median == result.before.median and result.after.support == result.before.support
    assert all(torch.equal(value, chosen.state_dict()[name]) for name, value in right.state_dict().items())
    assert "kept nothing of the change: on the held-out part the visible surface and" in result.summary

    chosen, result = judged_adaptation(wrong, right, [held_out], [], 0.75)
    assert result.share == 0.75 and not result.worse and "kept 75% of the change" in result.summary
    assert torch.equal(chosen.heads.bias, right.heads.bias)


def test_an_encoder_that_is_worse_than_level_ground_is_not_recommended(encoder, recording, tmp_path):
    _, held_out = split_recording(recording)
    _, result = judged_adaptation(lifted(encoder, 0.9), lifted(encoder, 0.6), [held_out], [])
    assert result.share == 1.0 and result.worse_than_level
    assert "the ground under the wheels is still worse than level ground" in result.summary
    assert "do not rely on" in result.advice(tmp_path) and "use it with" not in result.advice(tmp_path)
    good = replace(result, after=replace(result.after, median=0.01, support=0.01))
    assert not good.worse_than_level and "use it with" in good.advice(tmp_path)


def test_bands_are_widened_on_one_half_of_the_held_out_part_and_judged_on_the_other(encoder, recording):
    _, held_out = split_recording(recording)
    first, second = calibration_and_judging([held_out])
    assert first[0].stamps[-1] < second[0].stamps[0] and len(first[0]) + len(second[0]) == len(held_out)
    assert [len(part) for part in calibration_and_judging([held_out.subset([0])])] == [0, 1]
    wrong = lifted(encoder, 0.9)
    assert judge(wrong, second).inside < 0.7
    chosen, result = judged_adaptation(wrong, wrong, [held_out], [])
    assert judge(chosen, first).inside == pytest.approx(0.9, abs=0.005)
    assert result.before.inside == judge(wrong, second).inside < result.after.inside
    assert f"hold {result.before.inside:.0%} → {result.after.inside:.0%}" in result.summary
    # Never narrower, and a sweep's own bands stay.
    sure = copy.deepcopy(encoder)
    sure.config = replace(sure.config, geometric_spread_factor=50.0, decrease_spread_factor=50.0)
    assert widened(sure, first).config == sure.config
    for name in ("geometric_spread_factor", "decrease_spread_factor"):
        assert getattr(chosen.config, name) == getattr(encoder.config, name)


def test_bands_of_images_alone_are_wider_than_those_of_a_sweep(recording):
    torch.manual_seed(3)
    encoder = new_encoder(CONFIG).eval()
    wider = copy.deepcopy(encoder)
    wider.config = replace(CONFIG, image_spread_factor=1.5, image_decrease_spread_factor=1.2)
    alone, both, swept = (sample(recording, 0, CONFIG, sensors, chunks=1)[0] for sensors in (CAMERAS, BOTH, SWEEP))
    with torch.no_grad():
        one, other = (entry(EncoderInput.stack([alone, both, swept])) for entry in (encoder, wider))
    torch.testing.assert_close(other.geometric_spread[0], 1.5 * one.geometric_spread[0])
    ratio = other.geometric_spread / one.geometric_spread
    hit = torch.stack([entry.sweep[0, HIT] > 0 for entry in (alone, both, swept)])
    torch.testing.assert_close(ratio[hit], torch.ones_like(ratio[hit]))
    ratio = other.decrease_spread / one.decrease_spread
    torch.testing.assert_close(ratio[0], torch.full_like(ratio[0], 1.2))
    torch.testing.assert_close(ratio[hit], torch.ones_like(ratio[hit]))
    # A sweep of the left side alone says nothing of the right one.
    half = both.sweep.clone()
    y = torch.as_tensor(CONFIG.grid.y)
    half[:, :, y < 0.0] = 0.0
    with torch.no_grad():
        one, other = (entry(replace(both, sweep=half)) for entry in (encoder, wider))
    ratio = (other.geometric_spread / one.geometric_spread)[0]
    right, left = ratio[y < -1.1], ratio[half[0, HIT] > 0]
    torch.testing.assert_close(right, torch.full_like(right, 1.5))
    torch.testing.assert_close(left, torch.ones_like(left))
    between = ratio[(y < -0.5) & (y > -0.9)]
    assert bool((between > 1.0).all()) and bool((between <= 1.5).all()) and float(between.min()) < 1.4


def test_bands_hold_what_they_say_in_nine_of_ten_scenes(encoder, recording):
    assert scene_factor([1.0] * 8) is None and scene_factor([0.5] * 9) == 1.0
    assert scene_factor([1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8]) == 1.8
    assert scene_factor(np.linspace(1.0, 2.0, 19).tolist()) == pytest.approx(1.0 + 17 / 18)
    random = np.random.default_rng(0)
    further = [random.lognormal(0.5, 0.3) <= scene_factor(random.lognormal(0.5, 0.3, 24)) for _ in range(2000)]
    assert np.mean(further) == pytest.approx(23 / 25, abs=0.02)
    # Nine parts of a recording stand for scenes.
    scenes = [recording.subset(part.tolist()) for part in np.array_split(np.arange(len(recording)), 9)]
    found = calibrated(encoder, scenes).config
    needed = [np.quantile(band_ratios(encoder, [scene]).geometric, 0.9) for scene in scenes]
    assert found.geometric_spread_factor * found.image_spread_factor == pytest.approx(max(needed), rel=1e-4)
    assert found.image_spread_factor > 1.0 and calibrated(encoder, scenes[:8]).config.image_spread_factor == 1.0
    assert calibrated(encoder, scenes, SWEEP).config.image_spread_factor == 1.0


def test_an_adaptation_leaves_the_factors_on_the_bands_as_they_are(recording, tmp_path, one_thread):
    """A network that is trained under them makes up for them: bands would be as narrow as before the calibration."""
    weights = []
    for factor in (1.0, 4.0):
        torch.manual_seed(0)
        start = new_encoder(replace(CONFIG, image_spread_factor=factor, geometric_spread_factor=factor))
        settings = AdaptationSettings(steps=3, rate=5e-3)
        adapted = adapt(start, load_robot("husky"), [recording], [], tmp_path / f"{factor:g}", settings)
        assert adapted.config == start.config
        weights.append(adapted.heads.weight)
    assert torch.equal(*weights)


def test_wheels_alone_teach_an_encoder_of_a_robot_without_a_lidar(demo_bag, tmp_path, one_thread):
    bag = tmp_path / "wheels"
    with BagReader(demo_bag) as reader, BagWriter(bag) as writer:
        for message in reader.messages():
            if "PointCloud2" not in message.message_type:
                writer.write_serialized(message.topic, message.message_type, message.cdr(), message.received)
    robot = load_robot("husky")
    recording = read_samples(extract_samples(bag, robot, CONFIG, tmp_path))
    assert not recording.segments[0].observed.any() and recording.segments[0].contact_mask.any()
    training, held_out = split_recording(recording)
    torch.manual_seed(0)
    start = lifted(new_encoder(CONFIG), 0.2)
    adapted = adapt(start, robot, [training], [], tmp_path / "out", AdaptationSettings(steps=15, rate=5e-3))
    _, result = judged_adaptation(start, adapted, [held_out], [])
    assert result.before.cells == 0 and np.isnan(result.after.median) and not result.worse
    assert result.before.support > 0.1 and result.after.support < 0.8 * result.before.support
    assert "visible surface" not in result.summary and "error of the ground under the wheels" in result.summary
    # What the wheels traced calibrates the bands, too.
    sure = lifted(start, 0.7)
    wider = widened(sure, [held_out]).config
    assert wider.image_spread_factor > 1.0 and wider.image_decrease_spread_factor > 1.0
    # Those of a sweep, of which nothing was judged, stay.
    assert wider.geometric_spread_factor == wider.decrease_spread_factor == 1.0


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
    assert set(written) == {"before", "after", "worlds_before", "worlds_after", "share", "worse"}
    assert "level ground" in done.stdout and "% bands hold" in done.stdout
    assert load_encoder(tmp_path / "out" / "encoder.safetensors").config.map_size == CONFIG.map_size
