"""``train``: train the terrain encoder on recorded drives."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from monoforce_ros.bags import BagError
from monoforce_ros.core import write_text
from monoforce_ros.encoder import CheckpointError, Encoder, EncoderConfig, WeightsError, load_encoder, new_encoder
from monoforce_ros.robots import RobotFileError, RobotModel, fingerprint, load_robot, shipped_robots, write_robot
from monoforce_ros.training.losses import LossWeights
from monoforce_ros.training.recording_samples import (
    RecordingSamples,
    SamplesError,
    SampleSettings,
    cut_recording,
    read_samples,
)
from monoforce_ros.training.trainer import Process, Trainer, TrainingError, TrainingSettings, describe
from monoforce_ros.training.vegetation_fit import EFFECT, fit_vegetation


def build_parser() -> argparse.ArgumentParser:
    """The command line's options."""
    parser = argparse.ArgumentParser(
        prog="train",
        description="Train the terrain encoder on what a robot recorded: images, odometry, commands and lidar. Run "
        "again with the same options, it goes on where it was interrupted. Under torchrun several processes share "
        "the work.",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 folders or ROS 1 .bag files")
    parser.add_argument("--out", type=Path, help="folder for checkpoint, logs and state")
    parser.add_argument("--held-out", nargs="+", type=Path, default=[], metavar="BAG", help="whole drives to validate "
                        "on (every eighth bag)")  # fmt: skip
    parser.add_argument("--robot", default="husky", help=f"robot file or one of {', '.join(shipped_robots())}")
    parser.add_argument("--cut", type=Path, metavar="DIR", help="folder for the drives cut into samples (OUT/samples)")
    parser.add_argument("--cut-only", action="store_true", help="cut the drives into samples and stop")
    parser.add_argument("--sensor", choices=("camera", "lidar"), default="camera", help="what the encoder sees: "
                        "images, or a sweep that it completes (%(default)s)")  # fmt: skip
    parser.add_argument("--images", nargs="+", default=[], metavar="TOPIC", help="cameras (all that are calibrated)")
    parser.add_argument("--period", type=float, default=SampleSettings.period, metavar="S", help="between samples "
                        "(%(default)s)")  # fmt: skip
    parser.add_argument("--steps", type=int, default=TrainingSettings.steps, help="(%(default)s)")
    parser.add_argument("--batch", type=int, default=TrainingSettings.batch, help="samples a step and process "
                        "(%(default)s)")  # fmt: skip
    parser.add_argument("--rate", type=float, default=TrainingSettings.rate, help="learning rate (%(default)s)")
    parser.add_argument("--losses", nargs="+", default=["geometric", "terrain", "trajectory"],
                        choices=("geometric", "terrain", "trajectory"),
                        help="(all; `geometric` alone is LSS)")  # fmt: skip
    parser.add_argument("--geometric", type=float, default=LossWeights.geometric, metavar="WEIGHT", help="of the "
                        "geometric loss among the others (%(default)s)")  # fmt: skip
    parser.add_argument("--standing", type=float, default=LossWeights.standing, metavar="WEIGHT", help="by how much "
                        "more walls, trunks and edges count in the geometric loss (%(default)s)")  # fmt: skip
    parser.add_argument("--no-vegetation", action="store_true", help="do not fit how hard vegetation holds the robot")
    parser.add_argument("--seed", type=int, default=TrainingSettings.seed, help="(%(default)s)")
    parser.add_argument("--no-variation", action="store_true", help="do not mirror, turn, cut and recolour samples")
    parser.add_argument("--size", default="320x240", metavar="WIDTHxHEIGHT", help="of images in the network "
                        "(%(default)s)")  # fmt: skip
    parser.add_argument("--map-size", type=float, default=EncoderConfig.map_size, metavar="M", help="(%(default)s)")
    parser.add_argument("--resolution", type=float, default=EncoderConfig.resolution, metavar="M", help="of a cell "
                        "(%(default)s)")  # fmt: skip
    parser.add_argument("--edges", action=argparse.BooleanOptionalAction, help="steps in place of slopes that "
                        "uncertainty makes of them (with the terrain loss, from cameras)")  # fmt: skip
    parser.add_argument("--start-from", type=Path, metavar="FILE.safetensors", help="an encoder to go on from")
    parser.add_argument("--backbone-weights", choices=("imagenet", "random"), default="imagenet", help="(%(default)s)")
    parser.add_argument("--validate-every", type=int, default=TrainingSettings.validate_every, metavar="STEPS")
    parser.add_argument("--save-every", type=int, default=TrainingSettings.save_every, metavar="STEPS")
    parser.add_argument("--precision", choices=("auto", "float32", "bfloat16"), default="auto")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="drives cut at a time (%(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="of PyTorch (as many as cores)")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    if options.cut_only and options.cut is None:
        parser.error("--cut-only: expected the folder for the samples with --cut")
    if options.out is None and not options.cut_only:
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
        print(f"train: interrupted; the same command goes on from {options.out / 'state'}", file=sys.stderr)
        return 130
    finally:
        if process is not None:
            process.close()
    return 0


def _train(options: argparse.Namespace, process: Process) -> None:
    # The same width on every computer, so that a seed means the same.
    if options.threads:
        torch.set_num_threads(options.threads)
    config, settings = _config(options), _settings(options)
    robot = load_robot(options.robot)
    held_out = list(options.held_out)
    bags = [bag for bag in options.bags if bag not in held_out]
    if not held_out and len(bags) >= 4:
        held_out = bags[7::8] or bags[-1:]
        bags = [bag for bag in bags if bag not in held_out]
    # One process cuts, the others read what it has written.
    if process.first:
        training, validation = (_cut(part, robot, config, options, what) for part, what in
                                ((bags, "training"), (held_out, "held out")))  # fmt: skip
    if options.cut_only:
        return
    if process.count > 1:
        torch.distributed.barrier()
        if not process.first:
            training, validation = (_cut(part, robot, config, options, "") for part in (bags, held_out))
    robot = _with_vegetation(robot, training, config, settings, options, process)
    torch.manual_seed(settings.seed)
    encoder = _encoder(options, config)
    trainer = Trainer(encoder, robot, training, validation, options.out, settings, process)
    resumed = trainer.resume()
    if process.first:
        print(
            f"{sum(map(len, training))} samples of {len(training)} drives, {len(validation)} drives held out, "
            f"{sum(p.numel() for p in encoder.parameters()) / 1e6:.2f} million weights, on {process.device}"
            + (f"; going on from step {trainer.step}" if resumed else "")
        )
    with _Log(options.out, settings.steps, trainer, quiet=options.quiet or not process.first) as log:
        trainer.run(log)
    if process.first:
        _conclude(options.out, trainer, describe(config, settings, training))


def _with_vegetation(
    robot: RobotModel,
    training: Sequence[RecordingSamples],
    config: EncoderConfig,
    settings: TrainingSettings,
    options: argparse.Namespace,
    process: Process,
) -> RobotModel:
    """The robot with the drag of vegetation in it, where the motion is a target and its file does not say already.

    OUT/robot.yaml is that robot's file; once there it is kept, so that an interrupted training goes on with it.
    """
    known = any(name == EFFECT for name, _ in robot.effects)
    if known or options.no_vegetation or not settings.weights.trajectory:
        return robot
    file = options.out / "robot.yaml"
    if process.first and not file.is_file():
        found = fit_vegetation(training, robot, config)
        bags = [bag for bag in options.bags if bag not in options.held_out]
        write_robot(options.robot, file, [found.effect] if found else [], bags, fingerprint(bags), found_by="train")
        if found:
            print(
                f"{file}: vegetation holds the robot: {found.coefficient:.3g} N s/m⁴, as much by bending as at "
                f"{found.yield_speed:.2g} m/s; loss of {found.pieces} pieces of motion through it {found.before:.2f} → "
                f"{found.after:.2f}"
            )
    if process.count > 1:
        torch.distributed.barrier()
    return load_robot(file)


def _encoder(options: argparse.Namespace, config: EncoderConfig) -> Encoder:
    if options.start_from is not None:
        encoder = load_encoder(options.start_from)
        before, now = asdict(encoder.config), asdict(config)
        wrong = [name for name in now if name not in ("decreases", "edges") and now[name] != before[name]]
        if wrong:
            raise CheckpointError(
                f"{options.start_from}: its {', '.join(wrong)} {'differ' if len(wrong) > 1 else 'differs'} from what "
                f"the options ask for: {[before[name] for name in wrong]}, not {[now[name] for name in wrong]}"
            )
        fresh = new_encoder(config)
        fresh.load_state_dict(encoder.state_dict())
        return fresh
    encoder = new_encoder(config)
    if config.sensor == "camera" and options.backbone_weights == "imagenet":
        encoder.backbone.load_imagenet()
    return encoder


def _config(options: argparse.Namespace) -> EncoderConfig:
    width, _, height = options.size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ValueError(f"--size: got {options.size!r}, expected two whole numbers as in 320x240")
    return EncoderConfig(
        sensor=options.sensor,
        image_width=int(width),
        image_height=int(height),
        map_size=options.map_size,
        resolution=options.resolution,
        decreases=options.losses != ["geometric"],
        edges=options.losses != ["geometric"] if options.edges is None else options.edges,
    )


def _settings(options: argparse.Namespace) -> TrainingSettings:
    given = LossWeights(geometric=options.geometric)
    chosen = {name: getattr(given, name) if name in options.losses else 0.0 for name in
              ("geometric", "terrain", "trajectory")}  # fmt: skip
    return TrainingSettings(
        steps=options.steps, batch=options.batch, rate=options.rate,
        weights=LossWeights(**chosen, standing=options.standing), seed=options.seed, vary=not options.no_variation,
        validate_every=options.validate_every, save_every=options.save_every, precision=options.precision,
    )  # fmt: skip


def _cut(
    bags: Sequence[Path], robot, config: EncoderConfig, options: argparse.Namespace, what: str
) -> list[RecordingSamples]:
    drives = []
    settings = SampleSettings(period=options.period)
    folder = options.cut or options.out / "samples"
    bar = tqdm(bags, desc=what, unit="bag", disable=True if options.quiet or not what or not bags else None)
    with ProcessPoolExecutor(
        max(1, min(options.jobs, len(bags))), mp_context=multiprocessing.get_context("spawn"), initializer=_alone
    ) as pool:
        tasks = [(bag, robot, config, folder, settings, tuple(options.images)) for bag in bags]
        # A single bag is cut here: another process would take longer to start.
        cut = pool.map(_cut_one, tasks) if len(bags) > 1 and options.jobs > 1 else map(_cut_one, tasks)
        for bag, (drive, complaint) in zip(bar, cut, strict=False):
            if drive is not None:
                drives.append(read_samples(drive))
            else:
                # One drive that teaches nothing must not cost a night; none at all is an error.
                print(f"train: {bag} left out: {complaint}", file=sys.stderr)
    if bags and not drives:
        raise SamplesError(f"none of {len(bags)} bags can be trained on")
    return drives


def _alone() -> None:
    """Several processes at work have one thread each."""
    torch.set_num_threads(1)


def _cut_one(task: tuple) -> tuple[Path | None, str]:
    """File of a bag's samples, or why there is none."""
    bag, robot, config, folder, settings, topics = task
    try:
        return cut_recording(bag, robot, config, folder, settings=settings, image_topics=topics), ""
    except SamplesError as error:
        return None, str(error)


class _Log:
    """Progress bar and TensorBoard's log."""

    def __init__(self, out: Path, steps: int, trainer: Trainer, *, quiet: bool):
        from torch.utils.tensorboard import SummaryWriter

        self.trainer, self.validated = trainer, len(trainer.history)
        self.writer = SummaryWriter(str(out / "log"), purge_step=trainer.step) if trainer.process.first else None
        self.bar = tqdm(total=steps, initial=trainer.step, desc="training", unit="step",
                        disable=True if quiet else None)  # fmt: skip
        # Without a terminal a bar shows nothing: a night's log gets twenty lines instead.
        self.steps, self.lines = steps, 0 if quiet or sys.stderr.isatty() else max(1, steps // 20)
        self.smooth: float | None = None

    def __enter__(self) -> _Log:
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.close()
        if self.writer is not None:
            self.writer.close()

    def __call__(self, step: int, losses: dict[str, float]) -> None:
        total = losses["total"]
        if np.isfinite(total):
            self.smooth = total if self.smooth is None else 0.95 * self.smooth + 0.05 * total
        history = self.trainer.history
        shown = {} if self.smooth is None else {"loss": f"{self.smooth:.3f}"}
        if history:
            shown["held out"] = f"{100 * history[-1]['geometric']:.1f}, {100 * history[-1]['supporting']:.1f} cm"
        self.bar.set_postfix(shown)
        self.bar.update()
        if self.lines and (step % self.lines == 0 or step == self.steps):
            said = ", ".join(f"{name} {value}" for name, value in shown.items())
            print(f"step {step} of {self.steps}: {said}", flush=True)
        if self.writer is None:
            return
        for name, value in losses.items():
            self.writer.add_scalar(f"loss/{name}", value, step)
        for entry in history[self.validated :]:
            for name in ("geometric", "supporting", "loss"):
                self.writer.add_scalar(f"held out/{name}", entry[name], entry["step"])
        self.validated = len(history)


def _conclude(out: Path, trainer: Trainer, description: dict) -> None:
    content = json.dumps(description | {"history": trainer.history}, indent=2, default=str)
    write_text(out / "training.json", content)
    checkpoint = out / "encoder.safetensors"
    line = f"{checkpoint}: {checkpoint.stat().st_size / 1e6:.1f} MB"
    if trainer.history:
        best = min(trainer.history, key=lambda entry: entry["loss"])
        line += (
            f"; on drives held out, median error {100 * best['geometric']:.1f} cm of what is seen, "
            f"{100 * best['supporting']:.1f} cm of what carries"
        )
    print(line)


if __name__ == "__main__":
    sys.exit(main())
