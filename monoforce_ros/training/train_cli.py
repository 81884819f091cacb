"""``train``: trains the terrain encoder on recordings."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import override

import cv2
import torch

from monoforce_ros.bags import BagError, add_read_options
from monoforce_ros.core import OptionParser, without_nan, write_text
from monoforce_ros.encoder import (
    SENSORS,
    SPREAD_FACTORS,
    CheckpointError,
    Encoder,
    EncoderConfig,
    TerrainEncoder,
    WeightsError,
    extended,
    load_encoder,
    new_encoder,
    save_encoder,
)
from monoforce_ros.reporting import progress_bar
from monoforce_ros.robots import RobotFileError, RobotModel, fingerprint, load_robot, shipped_robots, write_robot
from monoforce_ros.synthetic import STYLES
from monoforce_ros.training.adaptation import (
    REPLAY_WORLDS,
    SHARES,
    AdaptationSettings,
    adapt,
    judged_adaptation,
    keep_obstacles,
    shares_targets,
    split_recording,
)
from monoforce_ros.training.depth_training import DepthSettings, DepthTrainer, depth_errors
from monoforce_ros.training.gathered_samples import recorded_bags, recorded_worlds
from monoforce_ros.training.image_features import image_features
from monoforce_ros.training.judgement import BOTH, CAMERAS, SWEEP, calibrated
from monoforce_ros.training.losses import LossWeights
from monoforce_ros.training.recording_samples import RecordingSamples, SamplesError
from monoforce_ros.training.sample_extraction import SampleSettings
from monoforce_ros.training.trainer import (
    BACKBONE_PARTS,
    Process,
    Trainer,
    TrainingSettings,
    describe,
    state_file,
)
from monoforce_ros.training.training_log import TrainingLog
from monoforce_ros.training.training_state import TrainingError
from monoforce_ros.training.vegetation_fit import EFFECT, fit_vegetation
from monoforce_ros.training.world_samples import (
    CHOOSING_WORLD,
    FIRST_WORLD,
    HELD_OUT_WORLD,
    JUDGED_WORLD,
    PLACES,
    REPLAY_WORLD,
    WORLD_STYLES,
)

_JUDGED_IMAGES = 256
"""Images on which the training of depth is judged before and after."""


class _RenamedOption(argparse.Action):
    """The old name of an option: still accepted, with a warning that gives the new one."""

    def __init__(
        self,
        option_strings: Sequence[str],
        dest: str,
        *,
        new: str,
        nargs: int | None = None,
        const: object = None,
        type: Callable[[str], object] | None = None,
    ):
        super().__init__(
            option_strings, dest, nargs, const, default=argparse.SUPPRESS, type=type, help=argparse.SUPPRESS
        )
        self.new = new

    @override
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option: str | None = None,
    ) -> None:
        print(f"{parser.prog}: {option} is now {self.new}; the old name will be removed", file=sys.stderr)
        setattr(namespace, self.dest, self.const if self.nargs == 0 else values)


def build_parser() -> OptionParser:
    """The parser of the command line."""
    parser = OptionParser(
        prog="train",
        description="Train the terrain encoder on recordings of images, odometry, commands and lidar sweeps. The same "
        "command resumes an interrupted training. Use torchrun to train with several processes.",
    )
    parser.add_argument("bags", nargs="*", type=Path, metavar="BAG", help="rosbag2 folders or ROS 1 .bag files")
    parser.add_argument("--out", type=Path, help="folder for the checkpoint, logs and saved state")
    parser.add_argument("--held-out", nargs="+", type=Path, default=[], metavar="BAG", help="recordings to "
                        "validate on (default: every eighth bag)")  # fmt: skip
    parser.add_argument("--worlds", type=int, metavar="N", help="also train on N randomised worlds, with the "
                        f"simulator's surfaces as targets (default: 0; {REPLAY_WORLDS} with --adapt)")  # fmt: skip
    parser.add_argument("--world-seed", type=int, metavar="SEED", help="of the first world (default: "
                        f"{FIRST_WORLD}; {REPLAY_WORLD} with --adapt, which the shipped encoder has not "
                        "seen)")  # fmt: skip
    parser.add_argument("--places", type=int, default=PLACES, metavar="N", help="places in each world (default: "
                        "%(default)s)")  # fmt: skip
    parser.add_argument("--held-out-worlds", type=int, default=12, metavar="N", help="worlds to validate on where no "
                        "recording is held out; with --adapt half of them choose how much of the change is kept, half "
                        "judge it (default: %(default)s)")  # fmt: skip
    parser.add_argument("--world-styles", nargs="+", choices=sorted(STYLES), default=list(WORLD_STYLES),
                        metavar="STYLE", help=f"styles that alternate, of {', '.join(sorted(STYLES))} (default: "
                        f"{' '.join(WORLD_STYLES)})")  # fmt: skip
    parser.add_argument("--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())}")
    parser.add_argument("--samples", type=Path, metavar="DIR", help="folder for the samples extracted from the bags "
                        "(default: OUT/samples)")  # fmt: skip
    parser.add_argument("--samples-only", action="store_true", help="extract the samples and stop")
    parser.add_argument("--sensor", choices=SENSORS, help="input of the encoder: images; a lidar sweep to densify; or "
                        "both, either of which may be absent (default: that of --start-from, or camera)")  # fmt: skip
    parser.add_argument("--images", nargs="+", default=[], metavar="TOPIC", help="image topics (default: all with a "
                        "CameraInfo)")  # fmt: skip
    add_read_options(parser)
    parser.add_argument("--period", type=float, default=SampleSettings.period, metavar="S", help="mean interval "
                        "between samples (default: %(default)s)")  # fmt: skip
    parser.add_argument("--fit-iterations", type=int, default=SampleSettings.iterations, metavar="N", help="gradient "
                        "steps of each terrain fit (paper III-F); 0: the supporting terrain as the wheels traced it "
                        "(default: %(default)s)")  # fmt: skip
    parser.add_argument("--steps", type=int, help=f"(default: {TrainingSettings.steps}; {AdaptationSettings.steps} "
                        "with --adapt)")  # fmt: skip
    parser.add_argument("--batch", type=int, default=TrainingSettings.batch, help="samples per step and process "
                        "(default: %(default)s)")  # fmt: skip
    parser.add_argument("--rate", type=float, help=f"peak learning rate (default: {TrainingSettings.rate:g}; "
                        f"{AdaptationSettings.rate:g} with --adapt)")  # fmt: skip
    parser.add_argument("--losses", nargs="+", default=["geometric", "terrain", "trajectory"],
                        choices=("geometric", "terrain", "trajectory"),
                        help="losses to minimise (default: all; `geometric` alone is LSS)")  # fmt: skip
    parser.add_argument("--no-depth", action="store_true", help="do not train the depth along pixels with the lidar's "
                        "points")  # fmt: skip
    parser.add_argument("--geometric", type=float, default=LossWeights.geometric, metavar="WEIGHT", help="weight of "
                        "the geometric loss (default: %(default)s)")  # fmt: skip
    parser.add_argument("--prominence", type=float, default=LossWeights.prominence, metavar="WEIGHT", help="additional "
                        "relative weight of walls, trunks and edges in the geometric loss (default: "
                        "%(default)s)")  # fmt: skip
    parser.add_argument("--no-vegetation", action="store_true", help="do not fit the drag of vegetation")
    parser.add_argument("--seed", type=int, default=TrainingSettings.seed, help="(default: %(default)s)")
    parser.add_argument("--no-augmentation", action="store_true", help="do not mirror, rotate, crop and recolour "
                        "samples")  # fmt: skip
    parser.add_argument("--size", default="320x240", metavar="WIDTHxHEIGHT", help="size to which images are resized "
                        "(default: %(default)s)")  # fmt: skip
    parser.add_argument("--map-size", type=float, default=EncoderConfig.map_size, metavar="M", help="(default: "
                        "%(default)s)")  # fmt: skip
    parser.add_argument("--resolution", type=float, default=EncoderConfig.resolution, metavar="M", help="size of a "
                        "cell (default: %(default)s)")  # fmt: skip
    parser.add_argument("--relative-bins", type=int, metavar="N", help="bins of depth relative to level ground "
                        "(default: those of --start-from, or none)")  # fmt: skip
    parser.add_argument("--edges", action=argparse.BooleanOptionalAction, help="restore steps that uncertainty blurs "
                        "into slopes, cameras only (default: unless the geometric loss is the only one)")  # fmt: skip
    parser.add_argument("--adapt", action="store_true", help="adapt the shipped encoder (or --start-from) to this "
                        "robot in minutes: the last quarter of each bag is held out to judge it")  # fmt: skip
    parser.add_argument("--start-from", type=Path, metavar="FILE.safetensors", help="checkpoint to fine-tune")
    parser.add_argument("--backbone-weights", choices=("imagenet", "random"), default="imagenet", help="initial "
                        "weights of the backbone (default: %(default)s)")  # fmt: skip
    parser.add_argument("--train-backbone", choices=BACKBONE_PARTS, default="none", help="part of the backbone that is "
                        "trained, too; late: its stages at stride 16; map: nothing of the images, not even what "
                        "follows the backbone (default: %(default)s)")  # fmt: skip
    parser.add_argument("--depth-steps", type=int, default=0, metavar="N", help="first train the depth along pixels "
                        "for N steps, on features that the backbone computes once (default: %(default)s)")  # fmt: skip
    parser.add_argument("--depth-variants", type=int, default=2, metavar="N", help="augmented variants of each image "
                        "for that, 0.24 MB each (default: %(default)s)")  # fmt: skip
    parser.add_argument("--validate-every", type=int, default=TrainingSettings.validate_every, metavar="STEPS",
                        help="(default: %(default)s)")  # fmt: skip
    parser.add_argument("--save-every", type=int, default=TrainingSettings.save_every, metavar="STEPS",
                        help="(default: %(default)s)")  # fmt: skip
    parser.add_argument("--sensor-shares", type=float, nargs=3, default=TrainingSettings.sensor_shares,
                        metavar=("IMAGES", "BOTH", "SWEEP"), help="with --sensor camera_lidar: shares of samples with "
                        "images alone, both and a sweep alone (default: %(default)s)")  # fmt: skip
    parser.add_argument("--all-sensors", action="store_true", help="with --sensor camera_lidar: leave out no sensor, "
                        "camera or ring of any sample. To compare with encoders of one sensor; such an encoder does "
                        "not expect that a sensor fails")  # fmt: skip
    parser.add_argument("--precision", choices=("auto", "float32", "bfloat16"), default="auto", help="(default: "
                        "bfloat16 on CUDA, and on CPUs that multiply it)")  # fmt: skip
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="(default: CUDA if "
                        "available)")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="bags from which samples are extracted, "
                        "and worlds that are drawn, in parallel (default: %(default)s)")  # fmt: skip
    parser.add_argument("--threads", type=int, default=0, help="threads of PyTorch and OpenCV (default: one per core)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--cut", type=Path, dest="samples", action=_RenamedOption, new="--samples")
    parser.add_argument("--cut-only", dest="samples_only", action=_RenamedOption, new="--samples-only", nargs=0,
                        const=True)  # fmt: skip
    parser.add_argument("--standing", type=float, dest="prominence", action=_RenamedOption, new="--prominence")
    parser.add_argument("--no-variation", dest="no_augmentation", action=_RenamedOption, new="--no-augmentation",
                        nargs=0, const=True)  # fmt: skip
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if not options.bags and not options.worlds:
        parser.error("got no bags and no --worlds; expected one of them at least")
    sensor = options.sensor or ("camera_lidar" if options.start_from else "camera")
    if options.adapt or options.no_augmentation or sensor != "camera_lidar":
        parser.refuse_without_effect(
            options, ("sensor_shares", "all_sensors"), "without augmentation of images and sweeps"
        )
    elif options.all_sensors:
        parser.refuse_without_effect(options, ("sensor_shares",), "with --all-sensors")
    if options.adapt:
        if not options.bags:
            parser.error("--adapt: got no bag, expected some of the robot's own")
        known = tuple(name for name in _NOT_FOR_ADAPTING if hasattr(options, name))
        parser.refuse_without_effect(
            options, known, "with --adapt: the encoder that is adapted decides it",
            sys.argv[1:] if arguments is None else arguments,
        )  # fmt: skip
    if options.samples_only and options.samples is None and options.out is None:
        parser.error("--samples-only: expected a folder with --samples, or --out")
    if options.out is None and not options.samples_only:
        parser.error("the following arguments are required: --out")
    process = None
    try:
        process = Process(options.device)
        _train(options, process)
    except (
        BagError, RobotFileError, SamplesError, TrainingError, CheckpointError, WeightsError, ValueError, OSError,
    ) as error:  # fmt: skip
        print(f"train: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"train: interrupted{_what_is_kept(options)}", file=sys.stderr)
        return 130
    finally:
        if process is not None:
            process.close()
    return 0


def _training_bags(options: argparse.Namespace) -> list[Path]:
    """Bags that are not held out, however their paths are written."""
    held_out = {bag.resolve() for bag in options.held_out}
    return [bag for bag in options.bags if bag.resolve() not in held_out]


def _what_is_kept(options: argparse.Namespace) -> str:
    """What the same command does after an interruption."""
    if options.samples_only:
        return "; the same command goes on with the samples that are missing"
    if options.adapt:
        return "; the same command adapts anew, with the samples that are there"
    if not state_file(options.out).is_file():
        return "; nothing was trained yet"
    return f"; the same command resumes from {options.out / 'state'}"


_NOT_FOR_ADAPTING = (
    "held_out", "size", "losses", "relative_bins", "sensor", "no_depth", "places", "no_augmentation", "train_backbone",
    "depth_steps", "depth_variants", "edges", "map_size", "resolution", "samples_only", "validate_every", "save_every",
    "geometric", "prominence", "no_vegetation", "backbone_weights",
)  # fmt: skip


def _train(options: argparse.Namespace, process: Process) -> None:
    if options.adapt:
        _adapt(options)
        return
    # Results of a seed depend on the number of threads.
    if options.threads:
        torch.set_num_threads(options.threads)
        # Fifteen trainings side by side on 16 cores, each with 16 threads of OpenCV, took three times as long.
        cv2.setNumThreads(options.threads)
    start = None if options.start_from is None else load_encoder(options.start_from)
    config, settings = _config(options, start), _settings(options)
    robot = load_robot(options.robot)
    held_out, bags = list(options.held_out), _training_bags(options)
    if not held_out and len(bags) >= 4:
        held_out = bags[7::8] or bags[-1:]
        bags = [bag for bag in bags if bag not in held_out]
    # The first process extracts samples, the others read its files.
    if process.first:
        training, validation = (recorded_bags(part, robot, config, options, title) for part, title in
                                ((bags, "training"), (held_out, "held out")))  # fmt: skip
        training += recorded_worlds(_world_seeds(options), config, options, options.places)
        if options.worlds and not validation:
            validation = recorded_worlds(
                range(HELD_OUT_WORLD, HELD_OUT_WORLD + options.held_out_worlds), config, options
            )
    if options.samples_only:
        return
    if process.count > 1:
        torch.distributed.barrier()
        if not process.first:
            training, validation = (recorded_bags(part, robot, config, options, "") for part in (bags, held_out))
            training += recorded_worlds(_world_seeds(options), config, options, options.places)
    robot = _with_vegetation(robot, training, config, settings, options, process)
    torch.manual_seed(settings.seed)
    encoder = _encoder(options, config, start)
    if options.depth_steps and process.first and not state_file(options.out).is_file():
        _train_depth(encoder, training, options)
    if options.depth_steps and process.count > 1:
        torch.distributed.barrier()
    trainer = Trainer(encoder, robot, training, validation, options.out, settings, process)
    resumed = trainer.resume()
    if process.first:
        print(
            f"{sum(map(len, training))} samples from {len(training)} recordings, {len(validation)} held out, "
            f"{sum(p.numel() for p in encoder.parameters()) / 1e6:.2f} million parameters, on {process.device}"
            + (f"; resuming from step {trainer.step}" if resumed else "")
        )
    with TrainingLog(options.out, settings.steps, trainer, quiet=options.quiet or not process.first) as log:
        trainer.run(log)
    if process.first and validation:
        best = load_encoder(options.out / "encoder.safetensors")
        sensors = BOTH if options.all_sensors else CAMERAS if config.takes_images else SWEEP
        save_encoder(calibrated(best, validation, sensors), options.out / "encoder.safetensors")
    if process.first:
        _write_summary(options.out, trainer, describe(config, settings, training))


def _train_depth(encoder: Encoder, training: Sequence[RecordingSamples], options: argparse.Namespace) -> None:
    """Train the depth along pixels of an encoder, in place; resumes an interrupted training."""
    if not isinstance(encoder, TerrainEncoder):
        raise ValueError("--depth-steps: got an encoder without images, expected --sensor camera or camera_lidar")
    # An encoder that was trained before reads the lifted features; they are to stay what they are.
    settings = DepthSettings(
        steps=options.depth_steps, keep=DepthSettings.keep if options.start_from else 0.0, seed=options.seed
    )
    folder = (options.samples or options.out / "samples") / "features"
    with progress_bar(len(training), label="features", unit="recording", quiet=options.quiet) as bar:

        def computed(done: int) -> None:
            bar.update()

        features = image_features(
            encoder, training, folder, variants=options.depth_variants, seed=options.seed, report=computed
        )
    trainer = DepthTrainer(encoder, features, options.out / "state", settings)
    trainer.resume()
    judged = features.select(torch.linspace(0, len(features) - 1, min(_JUDGED_IMAGES, len(features))).long())
    before = depth_errors(encoder, judged) if trainer.step == 0 else None
    with progress_bar(settings.steps, initial=trainer.step, label="depth", unit="step", quiet=options.quiet) as bar:

        def advance(step: int, losses: dict[str, float]) -> None:
            bar.set_postfix({"loss": f"{losses['depth']:.2f}"})
            bar.update()

        trainer.run(advance)
    after = depth_errors(encoder, judged)
    start = "" if before is None else f"{before.median:.1%} → "
    print(f"depth along pixels: median error {start}{after.median:.1%} on images of the training (level ground "
          f"{after.level:.1%})")  # fmt: skip


def _adapt(options: argparse.Namespace) -> None:
    """Adapt an encoder to the bags' robot, and say what that changed."""
    torch.set_num_threads(options.threads or torch.get_num_threads())
    encoder = load_encoder(options.start_from or "")
    robot = load_robot(options.robot)
    recordings = recorded_bags(options.bags, robot, encoder.config, options, "samples")
    parts = []
    for recording in recordings:
        try:
            parts.append(split_recording(recording))
            if shares_targets(*parts[-1]):
                print(
                    f"{recording.name}: too short for a held-out part of its own; what it says of the result is partly "
                    "of the training: adapt to a recording of 30 s or more", file=sys.stderr,
                )  # fmt: skip
        except SamplesError as error:
            print(f"train: skipped: {error}", file=sys.stderr)
    if not parts:
        raise SamplesError(f"none of {len(recordings)} recordings is long enough to adapt to")
    replay = recorded_worlds(_world_seeds(options, REPLAY_WORLD, REPLAY_WORLDS), encoder.config, options)
    choosing, judging = (
        recorded_worlds(range(first, first + max(options.held_out_worlds // 2, 1)), encoder.config, options)
        for first in (CHOOSING_WORLD, JUDGED_WORLD)
    )
    if options.device == "cuda":
        print("train: --adapt runs on the CPU", file=sys.stderr)
    settings = _adaptation_settings(options)
    with progress_bar(settings.steps, label="adapting", unit="step", quiet=options.quiet) as bar:

        def advance(step: int, losses: dict[str, float]) -> None:
            bar.update()

        adapted = adapt(encoder, robot, [part[0] for part in parts], replay, options.out, settings, advance)
    with progress_bar(len(SHARES), label="obstacles", unit="judgement", quiet=options.quiet) as bar:
        adapted, share = keep_obstacles(encoder, adapted, choosing, bar.update)
    chosen, result = judged_adaptation(encoder, adapted, [part[1] for part in parts], judging, share)
    save_encoder(chosen, options.out / "encoder.safetensors")
    write_text(options.out / "adaptation.json", json.dumps(without_nan(asdict(result)), indent=1) + "\n")
    print(result.summary)
    print(result.advice(options.out / "encoder.safetensors"))


def _with_vegetation(
    robot: RobotModel,
    training: Sequence[RecordingSamples],
    config: EncoderConfig,
    settings: TrainingSettings,
    options: argparse.Namespace,
    process: Process,
) -> RobotModel:
    """The robot with a fitted drag of vegetation; unchanged without trajectory loss or if its file has that effect.

    The result is written to OUT/robot.yaml; an existing file is reused, so that resuming does not change the robot.
    """
    has_drag = any(name == EFFECT for name, _ in robot.effects)
    if has_drag or options.no_vegetation or not settings.weights.trajectory:
        return robot
    file = options.out / "robot.yaml"
    if process.first and not file.is_file():
        found = fit_vegetation(training, robot, config)
        bags = _training_bags(options)
        write_robot(options.robot, file, [found.effect] if found else [], bags, fingerprint(bags), found_by="train")
        if found:
            print(
                f"{file}: vegetation drag {found.coefficient:.3g} N s/m⁴, yield speed {found.yield_speed:.2g} m/s; "
                f"loss on {found.chunks} chunks of motion in vegetation {found.before:.2f} → {found.after:.2f}"
            )
    if process.count > 1:
        torch.distributed.barrier()
    return load_robot(file)


def _encoder(options: argparse.Namespace, config: EncoderConfig, start: Encoder | None) -> Encoder:
    if start is not None:
        found, expected = asdict(start.config), asdict(config)
        free = {"decreases", "edges", *SPREAD_FACTORS, "sweep_channels"}
        if isinstance(start, TerrainEncoder) and not start.config.relative_bins:
            free |= {"relative_bins"}
        names = [n for n in expected if n not in free and expected[n] != found[n]]
        if names:
            differences = "; ".join(f"{name}: got {found[name]}, expected {expected[name]}" for name in names)
            raise CheckpointError(f"{options.start_from}: configuration differs from the options: {differences}")
        return extended(start, config)
    encoder = new_encoder(config)
    if isinstance(encoder, TerrainEncoder) and options.backbone_weights == "imagenet":
        encoder.backbone.load_imagenet()
    return encoder


def _config(options: argparse.Namespace, start: Encoder | None) -> EncoderConfig:
    width, _, height = options.size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ValueError(f"--size: got {options.size!r}, expected two whole numbers as in 320x240")
    given = EncoderConfig() if start is None else start.config
    return EncoderConfig(
        sensor=given.sensor if options.sensor is None else options.sensor,
        image_width=int(width),
        image_height=int(height),
        map_size=options.map_size,
        resolution=options.resolution,
        relative_bins=given.relative_bins if options.relative_bins is None else options.relative_bins,
        decreases=options.losses != ["geometric"],
        edges=options.losses != ["geometric"] if options.edges is None else options.edges,
        # Without held-out recordings nothing calibrates them anew.
        **{name: getattr(given, name) for name in SPREAD_FACTORS},
    )


def _given[Value](value: Value | None, default: Value) -> Value:
    """The value of an option, if it was given: its default depends on others."""
    return default if value is None else value


def _world_seeds(options: argparse.Namespace, first: int = FIRST_WORLD, count: int = 0) -> range:
    """Seeds of the randomised worlds to train on, by default ``count`` from the ``first`` on."""
    start = _given(options.world_seed, first)
    return range(start, start + _given(options.worlds, count))


def _adaptation_settings(options: argparse.Namespace) -> AdaptationSettings:
    return AdaptationSettings(
        steps=_given(options.steps, AdaptationSettings.steps), batch=options.batch,
        rate=_given(options.rate, AdaptationSettings.rate), seed=options.seed, precision=options.precision,
    )  # fmt: skip


def _settings(options: argparse.Namespace) -> TrainingSettings:
    given = LossWeights(geometric=options.geometric)
    weights = {name: getattr(given, name) if name in options.losses else 0.0 for name in
               ("geometric", "terrain", "trajectory")}  # fmt: skip
    return TrainingSettings(
        steps=_given(options.steps, TrainingSettings.steps), batch=options.batch,
        rate=_given(options.rate, TrainingSettings.rate),
        weights=LossWeights(
            **weights, prominence=options.prominence, depth=0.0 if options.no_depth else LossWeights.depth
        ),
        seed=options.seed, augment=not options.no_augmentation, backbone=options.train_backbone,
        sensor_shares=None if options.all_sensors else tuple(options.sensor_shares),
        validate_every=options.validate_every, save_every=options.save_every, precision=options.precision,
    )  # fmt: skip


def _write_summary(out: Path, trainer: Trainer, description: dict) -> None:
    content = json.dumps(without_nan(description | {"history": trainer.described_history}), indent=2, default=str)
    write_text(out / "training.json", content)
    checkpoint = out / "encoder.safetensors"
    line = f"{checkpoint}: {checkpoint.stat().st_size / 1e6:.1f} MB"
    if trainer.history:
        _, best = min(trainer.history, key=lambda entry: entry[1].loss)
        line += (
            f"; median error on held-out recordings {100 * best.geometric:.1f} cm for the visible surface (H_g), "
            f"{100 * best.supporting:.1f} cm for the supporting terrain (H_t)"
        )
    print(line)


if __name__ == "__main__":
    sys.exit(main())
