"""What a training must not do in silence: go on with other data, mix what it is judged by, learn what is not so."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from test_training import maps_of

from monoforce_ros.bags import Recording, smooth
from monoforce_ros.core import without_nan
from monoforce_ros.encoder import EncoderConfig, load_encoder, new_encoder
from monoforce_ros.encoder.checkpoint import shipped_checkpoint
from monoforce_ros.encoder.view import support_plane
from monoforce_ros.robots import load_robot, robot_digest
from monoforce_ros.training import train_cli
from monoforce_ros.training.adaptation import shares_targets, split_recording
from monoforce_ros.training.batches import Batches
from monoforce_ros.training.losses import LossWeights, geometric_loss
from monoforce_ros.training.recording_samples import SamplesError, read_samples
from monoforce_ros.training.sample_extraction import (
    SampleSettings,
    _fingerprint,
    _segments,
    _trace,
    _usable_topics,
    extract_samples,
)
from monoforce_ros.training.samples import Augmentation, sample
from monoforce_ros.training.train_cli import build_parser, main
from monoforce_ros.training.trainer import Process, Trainer, TrainingSettings, is_symmetric
from monoforce_ros.training.training_state import TrainingError

CONFIG = EncoderConfig(image_width=64, image_height=64, depth_bins=8, map_features=8, image_features=8)


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


@pytest.fixture(scope="module")
def recording(demo_bag, tmp_path_factory, husky):
    folder = tmp_path_factory.mktemp("samples")
    return read_samples(extract_samples(demo_bag, husky, CONFIG, folder, settings=SampleSettings(iterations=10)))


def test_a_training_goes_on_with_its_own_samples_and_robot_only(recording, husky, tmp_path):
    settings = TrainingSettings(steps=2, warm_up=1, batch=2, weights=LossWeights(trajectory=0.0))

    def trainer(robot=husky, recordings=(recording,), held_out=()):
        torch.manual_seed(0)
        return Trainer(new_encoder(CONFIG), robot, recordings, held_out, tmp_path, settings, Process("cpu"))

    trainer().save()
    assert trainer().resume()
    shorter = recording.subset([0, 1, 2])
    heavier = replace(husky, mass=husky.mass + 1.0)
    for other in (trainer(recordings=[shorter]), trainer(heavier), trainer(held_out=[shorter])):
        with pytest.raises(TrainingError, match="saved with different samples or robot; .* another --out"):
            other.resume()


@pytest.mark.parametrize("field", ["sensors", "base_frame", "point_tangents", "friction_lateral", "effects"])
def test_samples_are_extracted_anew_for_a_robot_that_differs_in_anything(husky, demo_bag, field):
    value = getattr(husky, field)
    changed = {
        "sensors": lambda: {name: pose + 0.5 for name, pose in value.items()},
        "base_frame": lambda: "base_footprint",
        "point_tangents": lambda: -value,
        "friction_lateral": lambda: value * 0.9,
        "effects": lambda: (("drive_gain", {"gain": 0.9}),),
    }[field]()
    other = replace(husky, **{field: changed})
    assert robot_digest(other) != robot_digest(husky) == robot_digest(load_robot("husky"))
    prints = {_fingerprint(demo_bag, robot, CONFIG, SampleSettings(), ()) for robot in (husky, other)}
    prints.add(_fingerprint(demo_bag, husky, replace(CONFIG, stiffness=1e5), SampleSettings(), ()))
    assert len(prints) == 3


def test_fine_tuning_without_held_out_recordings_keeps_the_calibration_of_its_start():
    start = load_encoder(shipped_checkpoint())
    assert start.config.geometric_spread_factor != 1.0 != start.config.decrease_spread_factor
    options = build_parser().parse_args(["bag", "--start-from", str(shipped_checkpoint())])
    config = train_cli._config(options, start)
    assert config.geometric_spread_factor == start.config.geometric_spread_factor
    assert config.decrease_spread_factor == start.config.decrease_spread_factor


@pytest.mark.parametrize("slope", [0.2, 0.36])
def test_the_geometric_loss_of_a_true_hillside_is_none(recording, slope):
    batch, targets = sample(recording, 3, CONFIG)
    x = torch.as_tensor(CONFIG.grid.x, dtype=torch.float32)
    hill = (batch.ground[:, None, None] + slope * x).expand_as(targets.geometric).clone()
    targets = replace(targets, geometric=hill, observed=torch.ones_like(targets.observed))
    predicted = hill.clone().requires_grad_()
    loss = geometric_loss(maps_of(targets, geometric_height=predicted), targets, batch.ground)
    loss.backward()
    assert float(loss) == 0.0 and not predicted.grad.any()
    # A hill that is missing costs what it did.
    level = maps_of(targets, geometric_height=0.0 * hill + batch.ground[:, None, None])
    assert float(geometric_loss(level, targets, batch.ground)) > 0.1


def test_scenes_are_not_mirrored_for_a_robot_that_is_not_its_own_mirror_image(recording, husky):
    aside = replace(husky, centre_of_mass=husky.centre_of_mass + torch.tensor([0.0, 0.05, 0.0]))
    pulls = replace(husky, effects=(("drive_asymmetry", {"difference": 0.1}),))
    heavier = replace(husky, effects=(("payload", {"mass": 5.0, "x": 0.1, "y": 0.0, "z": 0.1}),))
    assert [is_symmetric(robot) for robot in (husky, heavier, aside, pulls)] == [True, True, False, False]
    drawn = []

    def watched(recording, index, config, augmentation=Augmentation()):
        drawn.append(augmentation.mirrored)
        return sample(recording, index, config, augmentation)

    for mirror in (True, False):
        batches = Batches([recording], CONFIG, size=8, seed=1, mirror=mirror)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("monoforce_ros.training.batches.sample", watched)
            batches[0]
        assert any(drawn) == mirror
        drawn.clear()


def test_every_sample_is_used_as_often_as_the_others(recording):
    part = recording.subset(list(range(10)))
    batches = Batches([part], CONFIG, size=8, seed=1, augment=False)
    used = np.zeros(10, int)

    def counted(recording, index, config, augmentation):
        used[index] += 1
        return sample(recording, index, config, augmentation)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("monoforce_ros.training.batches.sample", counted)
        for step in range(10):
            batches[step]
    assert (used == 8).all()


def test_the_held_out_end_of_a_recording_has_targets_of_its_own(recording):
    # A recording of two minutes: the samples of each half segment of five seconds.
    count = 120
    long = replace(
        recording.subset([i % len(recording) for i in range(count)]),
        stamps=recording.stamps[0] + np.arange(count) * 10**9,
        segment_of=np.arange(count) // 5,
    )
    training, held_out = split_recording(long)
    assert not shares_targets(training, held_out)
    last = training.stamps[training.segment_of == training.segment_of.max()].min()
    assert last + 12 * 10**9 <= held_out.stamps[0]
    assert shares_targets(*split_recording(recording)), "the demo is too short"


@pytest.mark.parametrize(
    ("name", "value"),
    [("depth_bins", 48.0), ("map_features", 24.0), ("image_width", 320.0), ("friction", "x"), ("friction", -1.0),
     ("stiffness", None), ("lowest", float("nan")), ("highest", "a")],
)  # fmt: skip
def test_configurations_of_damaged_checkpoints_are_refused(name, value):
    with pytest.raises(ValueError, match=f"encoder {name}: got"):
        EncoderConfig(**{**asdict(EncoderConfig()), name: value})


def test_topics_that_cost_samples_are_left_out(capsys):
    class Bag:
        path = "bag"

        def __init__(self, **images):
            self.images = {f"/{name}": [FrameAt(round(t * 1e9)) for t in times] for name, times in images.items()}

        def image(self, frame):
            if frame.stamp == 7 * 10**9:
                raise ValueError("16UC1 is no colour image")
            return np.zeros((4, 4, 3), np.uint8)

    class FrameAt:
        def __init__(self, stamp):
            self.stamp = stamp

    times = np.arange(0.0, 12.0, 0.2)
    bag = Bag(front=times, rear=times + 0.03, dead=times[:12], depth=[7.0, 7.2])
    assert _usable_topics(bag, tuple(bag.images)) == ("/front", "/rear")
    said = capsys.readouterr().err
    assert "/dead is left out: images at 20%" in said and "/depth is left out: 16UC1" in said
    with pytest.raises(SamplesError, match="no usable image: /depth"):
        _usable_topics(Bag(depth=[7.0]), ("/depth",))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["bag", "--adapt", "--out", "o", "--sensor", "camera"], "--sensor"),
        (["bag", "--adapt", "--out", "o", "--held-out", "x"], "--held-out"),
        (["--adapt", "--worlds", "1", "--out", "o"], "--adapt: got no bag"),
    ],
)
def test_options_that_adapting_ignores_are_refused(arguments, text, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert text in capsys.readouterr().err


def test_a_held_out_bag_is_not_trained_on_however_its_path_is_written(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(train_cli, "_samples", lambda bags, *_: asked.append([bag.name for bag in bags]) or [])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bags").mkdir()
    options = build_parser().parse_args(
        ["bags/a", "bags/b", "--held-out", str(tmp_path / "bags" / "a"), "--out", "o", "--samples-only"]
    )
    train_cli._train(options, Process("cpu"))
    assert asked == [["b"], ["a"]]


def test_nothing_of_a_sample_is_from_beyond_a_jump_of_the_localisation(demo_bag, husky, tmp_path):
    recording = Recording.open(demo_bag).in_base_frame("base_link")
    motion = recording.motion
    middle = int(0.5 * (int(motion.stamps[0]) + int(motion.stamps[-1])))
    later = motion.stamps > middle
    jumped = replace(motion, positions=motion.positions + np.where(later, 1.0, 0.0)[:, None] * [2.0, 0.0, 2.0])
    stretches = smooth(jumped).stretches
    assert len(stretches) == 2
    spans = [(int(jumped.stamps[part][0]), int(jumped.stamps[part][-1])) for part in stretches]
    settings = SampleSettings(iterations=5)
    segments = _segments(replace(recording, motion=jumped), jumped, recording.commands, husky, settings, spans)
    # Those of the first half say nothing of the second one, where everything is 2 m higher.
    assert {end for _, end, _ in segments} == {end for _, end in spans}
    for start, end, segment in segments:
        heights = segment.geometric[segment.observed]
        assert start < end and np.ptp(np.quantile(heights, (0.05, 0.95))) < 1.5
    stamp = int(jumped.stamps[later][20])
    torn, whole = _trace(jumped, husky, stamp), _trace(jumped, husky, stamp, spans[1][0])
    assert np.ptp(torn[:, 2]) > 1.5 > 1.0 > np.ptp(whole[:, 2])


def test_json_has_no_nan():
    content = {"a": float("nan"), "b": [1.0, float("inf"), {"c": 2}], "d": "text"}
    assert without_nan(content) == {"a": None, "b": [1.0, None, {"c": 2}], "d": "text"}


def test_a_sample_of_a_sweep_alone_shows_no_camera_of_many():
    random = np.random.default_rng(2)
    drawn = [Augmentation.draw(random, (0.0, 0.0, 1.0)) for _ in range(20)]
    assert not any(augmentation.shows(camera) for augmentation in drawn for camera in range(9))
    assert Augmentation().shows(8)


@pytest.mark.parametrize(("half_length", "off"), [(0.3, 0.01), (1.4, 0.01)])
def test_the_plane_under_the_wheels_reaches_those_of_a_long_robot(half_length, off):
    slope = np.tan(np.radians(20.0))
    support = np.array([[x, y, slope * x] for x in (-half_length, half_length) for y in (-0.5, 0.5)])
    ground, plane, near = support_plane(support, CONFIG.grid)
    rows, columns, _ = CONFIG.grid.cells(support[:, :2])
    heights = ground + (plane * near)[rows, columns]
    cell = 0.5 * CONFIG.resolution * slope
    assert np.abs(heights - support[:, 2]).max() < off + cell
