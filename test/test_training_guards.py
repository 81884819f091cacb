"""What a training must not do in silence: go on with other data, mix what it is judged by, learn what is not so."""

from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_training import maps_of

from monoforce_ros.bags import BagReader, BagWriter, Recording, builders, chosen_cameras, observe, smooth
from monoforce_ros.core import homogeneous, without_nan
from monoforce_ros.encoder import EncoderConfig, load_encoder, new_encoder
from monoforce_ros.encoder.checkpoint import shipped_checkpoint
from monoforce_ros.encoder.view import support_plane
from monoforce_ros.robots import load_robot, robot_digest
from monoforce_ros.training import train_cli
from monoforce_ros.training.adaptation import REPLAY_WORLDS, shares_targets, split_recording
from monoforce_ros.training.batches import Batches
from monoforce_ros.training.losses import LossWeights, geometric_loss
from monoforce_ros.training.recording_samples import SamplesError, read_samples
from monoforce_ros.training.sample_extraction import (
    SampleSettings,
    _fingerprint,
    _segments,
    _trace,
    extract_samples,
)
from monoforce_ros.training.samples import Augmentation, sample
from monoforce_ros.training.train_cli import build_parser, main
from monoforce_ros.training.trainer import Process, Trainer, TrainingSettings, is_symmetric
from monoforce_ros.training.training_state import TrainingError
from monoforce_ros.training.world_samples import FIRST_WORLD, REPLAY_WORLD

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


def test_fine_tuning_learns_nothing_from_the_calibration_of_its_start(recording, husky, tmp_path):
    """A network that is trained under factors on its bands makes up for them: they would be calibrated for nothing."""
    weights = []
    for factor in (1.0, 4.0):
        torch.manual_seed(0)
        encoder = new_encoder(replace(CONFIG, geometric_spread_factor=factor, decrease_spread_factor=factor))
        settings = TrainingSettings(steps=3, warm_up=1, batch=2, rate=5e-3, weights=LossWeights(trajectory=0.0))
        Trainer(encoder, husky, [recording], [], tmp_path / f"{factor:g}", settings, Process("cpu")).run()
        saved = load_encoder(tmp_path / f"{factor:g}" / "encoder.safetensors")
        assert saved.config == encoder.config
        weights.append(saved.heads.weight)
    assert torch.equal(*weights)


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


START, OPTICAL = 10**18, np.array([[0, 0, 1.0, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.4], [0, 0, 0, 1]])
SECONDS = 16


def camera_bag(path, **topics):
    """A drive over level ground with cameras of 48 × 32 px at 5 Hz, each named by its frame; options of each topic:

    name, times, encoding, size, info and mounted (whether its frame is on /tf_static).
    """
    with BagWriter(path) as bag:
        mounted = {frame: OPTICAL for frame, options in topics.items() if options.get("mounted", True)}
        bag.write("/tf_static", builders.static_transforms(START, "base_link", mounted), START)
        for i in range(50 * SECONDS):
            at = START + i * 20_000_000
            place = [0.01 * i, 0.0, 0.0]
            bag.write(
                "/odom", builders.odometry(at, "odom", "base_link", place, [0, 0, 0, 1], [0.5, 0, 0], [0] * 3), at
            )
            bag.write("/cmd_vel", builders.twist_stamped(at, "base_link", 0.5, 0.0), at)
        for frame, options in topics.items():
            name = options.get("name", f"/{frame}/image_raw")
            height, width = options.get("size", (32, 48))
            for time in options.get("times", np.arange(0.0, SECONDS, 0.2)):
                at = START + round(1e9 * time)
                image = builders.image(at, frame, np.full((height, width, 3), 90, np.uint8))
                image.encoding = options.get("encoding", "rgb8")
                if name.endswith("/compressed"):
                    _, data = cv2.imencode(".png", np.zeros((height, width, 3), np.uint8))
                    image = builders.compressed_image(at, frame, "png", data.tobytes())
                bag.write(name, image, at)
                info = builders.camera_info(at, options.get("of", frame), 48, 32, MATRIX, [0.0] * 5)
                bag.write(f"/{options.get('of', frame)}/camera_info", info, at)
    return path


MATRIX = np.array([[40.0, 0, 23.5], [0, 40.0, 15.5], [0, 0, 1]])


def extracted(bag, husky, folder, **settings):
    return read_samples(extract_samples(bag, husky, CONFIG, folder / "samples", settings=SampleSettings(**settings)))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"size": (16, 24)}, "images are 24 × 16 px, but CameraInfo says 48 × 32 px"),
        ({"mounted": False}, "the pose of frame 'second' on the robot is unknown"),
        ({"encoding": "16UC1"}, "image encoding: got '16UC1'"),
        ({"of": "first", "name": "/first/image_raw/compressed"}, "of the same camera as /first/image_raw"),
    ],
)
def test_a_camera_that_cannot_be_used_does_not_cost_the_others_and_is_named(tmp_path, husky, capsys, options, reason):
    bag = camera_bag(tmp_path / "bag", first={}, second=options)
    samples = extracted(bag, husky, tmp_path)
    assert len(samples) > 20 and len(samples.cameras) == 1
    said = capsys.readouterr().err
    assert options.get("name", "/second/image_raw") + " is left out: " in said and reason in said
    if "of" not in options:
        with pytest.raises(SamplesError, match="no usable image: /second/image_raw: "):
            extracted(camera_bag(tmp_path / "alone", second=options), husky, tmp_path)


def test_of_one_camera_the_topic_with_more_images_is_used(tmp_path, husky):
    bag = camera_bag(
        tmp_path / "bag", first={"times": np.arange(0.0, SECONDS, 1.0)},
        second={"of": "first", "name": "/first/image_raw/compressed"},
    )  # fmt: skip
    assert chosen_cameras(Recording.open(bag), husky).topics == ("/first/image_raw/compressed",)


@pytest.mark.parametrize("dead", ["first", "second"])
def test_a_camera_that_dies_does_not_cost_later_samples(tmp_path, husky, capsys, dead):
    # Even of the faster one, whose images the samples are at.
    cameras = {"first": {"times": np.arange(0.0, SECONDS, 0.1)}, "second": {}}
    whole = extracted(camera_bag(tmp_path / "whole", **cameras), husky, tmp_path)
    cameras[dead] = {"times": np.arange(0.0, 9.0, 0.05 if dead == "first" else 0.2)}
    samples = extracted(camera_bag(tmp_path / "bag", **cameras), husky, tmp_path)
    assert abs(len(samples) - len(whole)) <= 1
    has = np.isfinite(samples.odometry_from_cameras).all(axis=(2, 3))
    number = ["first", "second"].index(dead)
    early, late = samples.stamps <= START + 8.8e9, samples.stamps > START + 9.1e9
    assert has[:, 1 - number].all() and has[early].all() and not has[late, number].any() and late.sum() > 5
    said = capsys.readouterr().err
    assert f"/{dead}/image_raw has usable images for {has[:, number].sum()} of {len(samples)} samples" in said
    counts = [len(sample(samples, i, CONFIG)[0].images) for i in (0, len(samples) - 1)]
    assert counts == [2, 1]


def test_a_camera_on_a_pan_tilt_head_is_where_it_was_at_each_image(tmp_path, husky):
    rate = 0.4

    def head(time):
        return homogeneous(Rotation.from_euler("z", rate * time).as_matrix(), np.zeros(3))

    bag = camera_bag(tmp_path / "bag", first={"mounted": False})
    with BagReader(bag) as reader:
        messages = [(m.topic, m.decode(), m.received) for m in reader.messages(reader.topics)]
    with BagWriter(tmp_path / "moving") as written:
        for topic, message, at in messages:
            written.write(topic, message, at)
        written.write("/tf_static", builders.transforms(START, "head", {"first": OPTICAL}), START)
        for time in np.arange(0.0, SECONDS, 0.07):
            at = START + round(1e9 * time)
            written.write("/tf", builders.transforms(at, "base_link", {"head": head(time)}), at)
    samples = extracted(tmp_path / "moving", husky, tmp_path)
    assert len(samples) > 20
    for i in (0, 3, len(samples) - 1):
        mounted = np.linalg.inv(samples.odometry_from_base[i]) @ samples.odometry_from_cameras[i, 0]
        expected = head((samples.stamps[i] - START) * 1e-9) @ OPTICAL
        np.testing.assert_allclose(mounted, expected, atol=1e-3)
    # As for evaluate and diagnose.
    recording = Recording.open(tmp_path / "moving").in_base_frame("base_link")
    seen = observe(recording, husky, START + 4_100_000_000, ("camera",), tuple(recording.images))
    np.testing.assert_allclose(
        next(iter(seen.base_from_cameras.values()))[:3, :3], (head(4.0) @ OPTICAL)[:3, :3], atol=1e-3
    )


def test_a_period_between_those_of_images_holds_on_average(tmp_path, husky, capsys):
    samples = extracted(camera_bag(tmp_path / "bag", first={}), husky, tmp_path, period=0.5)
    assert np.diff(samples.stamps).mean() * 1e-9 == pytest.approx(0.5, abs=0.01)
    assert "instead of" not in capsys.readouterr().err
    extracted(tmp_path / "bag", husky, tmp_path, period=0.05)
    assert "a sample every 0.2 s instead of 0.05 s: images come no more often" in capsys.readouterr().err


def test_a_sweep_encoder_needs_no_images(tmp_path, husky, capsys):
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-6, 6, (4000, 2)), np.full(4000, -0.6)])
    with BagWriter(tmp_path / "bag") as bag:
        mounted = homogeneous(np.eye(3), np.array([0.0, 0.0, 0.47]))
        bag.write("/tf_static", builders.static_transforms(START, "base_link", {"lidar": mounted}), START)
        for i in range(50 * SECONDS):
            at, place = START + i * 20_000_000, [0.01 * i, 0.0, 0.0]
            bag.write(
                "/odom", builders.odometry(at, "odom", "base_link", place, [0, 0, 0, 1], [0.5, 0, 0], [0] * 3), at
            )
            bag.write("/cmd_vel", builders.twist_stamped(at, "base_link", 0.5, 0.0), at)
            if i % 10 == 0:
                bag.write("/points", builders.point_cloud(at, "lidar", ground), at)
    swept = replace(CONFIG, sensor="lidar")
    samples = read_samples(extract_samples(tmp_path / "bag", husky, swept, tmp_path / "samples"))
    assert len(samples) > 20 and samples.images.shape[1] == 0 and len(samples.sweep(5)) > 500
    batch, target = sample(samples, 5, swept)
    assert batch.sweep.abs().sum() > 0 and not len(batch.images) and target.observed.any()
    # An encoder of images cannot use them.
    with pytest.raises(SamplesError, match="no images with a CameraInfo"):
        extract_samples(tmp_path / "bag", husky, CONFIG, tmp_path / "samples")
    out = tmp_path / "out"
    arguments = [str(tmp_path / "bag"), "--sensor", "lidar", "--out", str(out), "--steps", "1", "--batch", "2"]
    assert main([*arguments, "--no-vegetation", "--quiet"]) == 0, capsys.readouterr().err
    assert load_encoder(out / "encoder.safetensors").config.sensor == "lidar"


@pytest.mark.parametrize("given", [True, False])
def test_adapting_keeps_to_options_that_are_the_defaults_of_a_training(given):
    explicit = ["--steps", "2000", "--rate", "1.5e-3", "--worlds", "0", "--world-seed", str(FIRST_WORLD)]
    options = build_parser().parse_args(["bag", "--adapt", "--out", "o", *(explicit if given else [])])
    settings = train_cli._adaptation_settings(options)
    assert (settings.steps, settings.rate) == ((2000, 1.5e-3) if given else (80, 4e-4))
    worlds = train_cli._world_seeds(options, REPLAY_WORLD, REPLAY_WORLDS)
    assert worlds == (range(FIRST_WORLD, FIRST_WORLD) if given else range(REPLAY_WORLD, REPLAY_WORLD + REPLAY_WORLDS))
    trained = train_cli._settings(build_parser().parse_args(["bag"]))
    assert (trained.steps, trained.rate) == (TrainingSettings.steps, TrainingSettings.rate)
    assert train_cli._world_seeds(build_parser().parse_args(["bag"])) == range(FIRST_WORLD, FIRST_WORLD)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["bag", "--adapt", "--out", "o", "--sensor", "camera"], "--sensor"),
        (["bag", "--adapt", "--out", "o", "--held-out", "x"], "--held-out"),
        # Those of a training by default, too: an adaptation has others.
        (["bag", "--adapt", "--out", "o", "--losses", "geometric", "terrain", "trajectory"], "--losses has no effect"),
        (["bag", "--adapt", "--out", "o", "--size=320x240"], "--size has no effect"),
        (["--adapt", "--worlds", "1", "--out", "o"], "--adapt: got no bag"),
    ],
)
def test_options_that_adapting_ignores_are_refused(arguments, text, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert text in capsys.readouterr().err


def test_a_held_out_bag_is_not_trained_on_however_its_path_is_written(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(train_cli, "recorded_bags", lambda bags, *_: asked.append([bag.name for bag in bags]) or [])
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
