"""Trainer: encoder, samples and losses → checkpoint, resumable after an interruption."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
import torch.distributed
from torch import Tensor, nn

from monoforce_ros.effects import CATALOGUE
from monoforce_ros.encoder import (
    EncodedMaps,
    Encoder,
    EncoderConfig,
    EncoderInput,
    TerrainEncoder,
    multiplies_bfloat16,
    save_encoder,
)
from monoforce_ros.physics import PhysicsOptions
from monoforce_ros.robots import RobotModel, robot_digest
from monoforce_ros.training.batches import Batches
from monoforce_ros.training.judgement import BOTH, CAMERAS, SWEEP
from monoforce_ros.training.losses import (
    HIGHEST,
    LOWEST,
    LossWeights,
    decrease_loss,
    depth_loss,
    friction_loss,
    geometric_loss,
    measured_decrease_loss,
    prominent_decrease_loss,
    slope_loss,
    spread_loss,
    terrain_loss,
    trajectory_loss,
)
from monoforce_ros.training.recording_samples import RecordingSamples
from monoforce_ros.training.samples import Augmentation, Targets, sample
from monoforce_ros.training.training_state import RENAMED_WEIGHTS, TrainingError, read_state, save_state

BACKBONE_PARTS = ("none", "late", "all", "map")
"""Parts of the backbone that can be trained; ``late``: the stages at stride 16. Norms are trained with ``all`` only.
``map``: nothing before the map is trained, neither the backbone nor what follows it up to the lift."""
_IMAGES_AT_ONCE = 16
"""On a GPU the number of images in a batch is a multiple of this: cuDNN chooses kernels anew for each number."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training."""

    steps: int = 2000
    batch: int = 8
    """Samples per step and process."""
    rate: float = 1.5e-3
    """Peak learning rate; a third of it for the pretrained backbone."""
    warm_up: int = 50
    """Steps of linear warm-up of the learning rate."""
    weights: LossWeights = field(default_factory=LossWeights)
    seed: int = 1
    augment: bool = True
    """Whether to augment samples (mirror, rotate, crop, change colours)."""
    backbone: str = "none"
    """Part of the backbone that is trained, of :data:`BACKBONE_PARTS`: its ImageNet weights hold for photographs."""
    sensor_shares: tuple[float, float, float] | None = (0.55, 0.3, 0.15)
    """For encoders of both: shares of samples with images alone, with both and with a sweep alone, of which cameras,
    rings and the driven ground are left out at random, too. None: every sample has everything."""
    validate_every: int = 250
    save_every: int = 50
    precision: str = "auto"
    """``float32``, ``bfloat16``, or ``auto``: bfloat16 where the processor multiplies it."""

    def __post_init__(self):
        for name, low, high in (
            ("steps", 1, 10_000_000), ("batch", 1, 4096), ("rate", 1e-7, 1.0), ("warm_up", 0, 1_000_000),
            ("validate_every", 1, 10_000_000), ("save_every", 1, 10_000_000), ("seed", 0, 2**31),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"training {name}: got {getattr(self, name)}, expected {low:g} to {high:g}")
        if self.backbone not in BACKBONE_PARTS:
            raise ValueError(f"training backbone: got {self.backbone!r}, expected one of {', '.join(BACKBONE_PARTS)}")
        shares = self.sensor_shares
        if shares is not None and (
            len(shares) != 3 or not all(0.0 <= share < float("inf") for share in shares) or not sum(shares) > 0.0
        ):
            raise ValueError(f"training sensor_shares: got {shares}, expected three numbers from 0 on, not all 0")
        if self.precision not in ("auto", "float32", "bfloat16"):
            raise ValueError(f"training precision: got {self.precision!r}, expected auto, float32 or bfloat16")


_GOLDEN_RATIO = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class Validation:
    """Errors of an encoder on held-out recordings; medians over cells in view."""

    geometric: float
    """|H_g - H_g*| [m]."""
    supporting: float
    """|H_t - H_t*| on contact cells [m]."""
    loss: float
    """Held-out loss, by which the checkpoint is selected (paper IV-A): terrain plus geometric loss."""


class Process:
    """This process and its device, one of several under ``torchrun``."""

    def __init__(self, device: str = "auto"):
        self.count = int(os.environ.get("WORLD_SIZE", "1"))
        self.rank = int(os.environ.get("RANK", "0"))
        cuda = device == "cuda" or (device == "auto" and torch.cuda.is_available())
        if device == "cuda" and not torch.cuda.is_available():
            raise TrainingError("device: got cuda, but PyTorch finds no CUDA GPU; use --device cpu")
        self.device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if cuda else torch.device("cpu")
        if self.count > 1 and not torch.distributed.is_initialized():
            if cuda:
                torch.cuda.set_device(self.device)
            torch.distributed.init_process_group("nccl" if cuda else "gloo")

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files."""
        return self.rank == 0

    def close(self) -> None:
        """Leave the group."""
        if self.count > 1 and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()


class _Losses(nn.Module):
    """Encoder and losses as one module, as DistributedDataParallel requires a single forward pass."""

    def __init__(self, encoder: Encoder, robot: RobotModel, weights: LossWeights):
        super().__init__()
        self.encoder, self.weights = encoder, weights
        self.robot, self.options = robot, PhysicsOptions()

    def forward(self, batch: EncoderInput, targets: Targets) -> dict[str, Tensor]:
        maps = self.encoder(batch)
        # The physics needs more digits than the encoder's convolutions.
        with torch.autocast(batch.ground.device.type, enabled=False):
            return self._losses(maps, batch, targets)

    def _losses(self, maps: EncodedMaps, batch: EncoderInput, targets: Targets) -> dict[str, Tensor]:
        weights, losses = self.weights, {}
        if weights.geometric:
            losses["geometric"] = weights.geometric * geometric_loss(maps, targets, batch.ground, weights.prominence)
        if weights.terrain:
            losses["terrain"] = weights.terrain * terrain_loss(maps, targets, batch.ground, weights.prominence)
            losses["slope"] = weights.slope * slope_loss(maps, targets, self.encoder.config.resolution)
        if weights.trajectory:
            losses["trajectory"] = weights.trajectory * trajectory_loss(
                maps, targets, self.robot, self.encoder.config, self.options
            )
        if self.encoder.config.decreases:
            losses["decrease"] = weights.decrease * decrease_loss(maps)
        if self.encoder.config.decreases and weights.geometric and weights.terrain:
            losses["measured decrease"] = weights.measured_decrease * measured_decrease_loss(maps, targets)
        if self.encoder.config.decreases and weights.geometric:
            losses["prominent decrease"] = weights.prominent_decrease * prominent_decrease_loss(
                maps, targets, batch.ground
            )
        losses["spread"] = weights.spread * spread_loss(maps, targets, batch.ground)
        if isinstance(self.encoder, TerrainEncoder):
            losses["depth"] = weights.depth * depth_loss(maps, targets, self.encoder.depths)
        losses["friction"] = weights.friction * friction_loss(maps, targets, self.encoder.config)
        losses["total"] = torch.stack(list(losses.values())).sum()
        # A zero gradient for heads without a loss: distributed training expects one for each parameter.
        unused = maps.decrease.sum() + maps.stiffness.sum() + maps.damping.sum() + maps.friction.sum()
        losses["total"] = losses["total"] + 0.0 * (unused + maps.geometric_height.sum())
        return losses


class Trainer:
    """Trains an encoder on recordings and saves its state in a folder.

    Args:
        encoder: encoder to train, with initial weights.
        robot: that was driven.
        recordings: training recordings.
        held_out: recordings to validate on.
        out: folder for ``encoder.safetensors``, ``training.json``, ``state/`` and logs.
        settings: settings of the training.
        process: this process and its device.
        loaders: batches prepared at the same time, beside a step: one in a thread, several in processes of their own.
            By default one on the CPU, which the step needs itself, and for a GPU one for each core but one, up to 16.
    """

    def __init__(
        self,
        encoder: Encoder,
        robot: RobotModel,
        recordings: Sequence[RecordingSamples],
        held_out: Sequence[RecordingSamples],
        out: Path,
        settings: TrainingSettings,
        process: Process,
        *,
        loaders: int | None = None,
    ):
        self.out, self.settings, self.process = out, settings, process
        self.loaders = loaders or (1 if process.device.type == "cpu" else max(1, min(16, (os.cpu_count() or 1) - 1)))
        self.encoder = encoder.to(process.device).to(memory_format=torch.channels_last)
        self.held_out = list(held_out)
        self.batches = Batches(
            recordings, encoder.config, size=settings.batch, seed=settings.seed, augment=settings.augment,
            sensor_shares=settings.sensor_shares if encoder.config.sensor == "camera_lidar" else None,
            rank=process.rank, count=process.count, mirror=not settings.weights.trajectory or is_symmetric(robot),
        )  # fmt: skip
        if not self.batches.index:
            raise TrainingError("no samples to train on")
        if isinstance(encoder, TerrainEncoder) and settings.backbone == "map":
            encoder.freeze_images()
        elif isinstance(encoder, TerrainEncoder) and settings.backbone != "all":
            encoder.freeze_backbone(early_only=settings.backbone == "late")
        losses = _Losses(self.encoder, robot, settings.weights)
        self.losses: nn.Module = losses
        if process.count > 1:
            # A batch may be without any image.
            unused = encoder.config.sensor == "camera_lidar"
            self.losses = nn.parallel.DistributedDataParallel(losses, find_unused_parameters=unused)
        backbone = list(encoder.backbone.parameters()) if isinstance(encoder, TerrainEncoder) else []
        pretrained = set(backbone)
        groups = [
            {"params": backbone, "lr": settings.rate / 3},
            {"params": [p for p in self.encoder.parameters() if p not in pretrained], "lr": settings.rate},
        ]
        self.optimiser = torch.optim.AdamW(groups, weight_decay=1e-2)
        self.data = _fingerprint(robot, recordings, held_out)
        """Of the samples and the robot: a training goes on with its own only."""
        self.step = 0
        self.best = float("inf")
        self.history: list[tuple[int, Validation]] = []
        """Step and result of each validation."""

    def run(self, report: Callable[[int, dict[str, float]], None] = lambda step, losses: None) -> None:
        """Train until the last step.

        Raises:
            TrainingError: the loss is not finite for 20 steps in a row.
        """
        settings = self.settings
        not_finite = 0
        self.encoder.train()
        for batch, targets in self.batches.prepared(range(self.step, settings.steps), self.loaders):
            losses = self._descend(batch.to(self.process.device), targets.to(self.process.device))
            self.step += 1
            not_finite = 0 if np.isfinite(losses["total"]) else not_finite + 1
            if not_finite >= 20:
                raise TrainingError(
                    f"the loss was not finite for {not_finite} steps in a row, up to step {self.step}; earlier "
                    "checkpoints are kept; try a smaller --rate"
                )
            report(self.step, losses)
            done = self.step == settings.steps
            if done or self.step % settings.validate_every == 0:
                self._validate()
            if self.process.first and (done or self.step % settings.save_every == 0):
                self.save()

    def _descend(self, batch: EncoderInput, targets: Targets) -> dict[str, float]:
        if self.process.device.type == "cuda":
            batch, targets = _evenly(batch, targets)
        fraction = self.step / max(1, self.settings.steps)
        warm_up = min(1.0, (self.step + 1) / max(1, self.settings.warm_up))
        factor = warm_up * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * fraction)))
        for group, share in zip(self.optimiser.param_groups, (1 / 3, 1.0), strict=True):
            group["lr"] = self.settings.rate * share * factor
        self.optimiser.zero_grad(set_to_none=True)
        with self._cast():
            losses = self.losses(batch, targets)
        total = losses["total"]
        finite = torch.isfinite(total.detach())
        if self.process.count > 1:
            # All processes or none: who waits for the gradients of one that has none waits for ever.
            flag = finite.to(torch.int32)
            torch.distributed.all_reduce(flag, op=torch.distributed.ReduceOp.MIN)
            finite = flag > 0
        if finite:
            total.backward()
            norm = nn.utils.clip_grad_norm_(self.encoder.parameters(), 2.0)
            # A single rollout in which the robot tumbles must not corrupt the weights.
            if torch.isfinite(norm):
                self.optimiser.step()
        names, values = list(losses), torch.stack([value.detach() for value in losses.values()]).tolist()
        return dict(zip(names, values, strict=True))

    def _cast(self) -> torch.autocast:
        kind = self.process.device.type
        fast = kind == "cuda" or multiplies_bfloat16()
        enabled = self.settings.precision == "bfloat16" or (self.settings.precision == "auto" and fast)
        return torch.autocast(kind, dtype=torch.bfloat16, enabled=enabled)

    def _validate(self) -> None:
        """Validate, and save the encoder if it has the lowest held-out loss so far."""
        if not self.process.first:
            return
        if not self.held_out:
            save_encoder(self.encoder, self.out / "encoder.safetensors")
            return
        found = validate(self.encoder, self.held_out, self.process.device, self.settings.sensor_shares)
        self.history.append((self.step, found))
        if found.loss < self.best:
            self.best = found.loss
            save_encoder(self.encoder, self.out / "encoder.safetensors")
        self.encoder.train()

    def save(self) -> None:
        """Save weights, the optimiser's moments and the step, from which :meth:`resume` continues."""
        description = {
            "step": self.step, "best": self.best, "history": self.described_history, "settings": asdict(self.settings),
            "config": asdict(self.encoder.config), "written": time.time(), "data": self.data,
        }  # fmt: skip
        save_state(state_file(self.out), self.encoder, self.optimiser, description)

    @property
    def described_history(self) -> list[dict[str, float]]:
        """:attr:`history` as in JSON files."""
        return [{"step": step, **asdict(found)} for step, found in self.history]

    def resume(self) -> bool:
        """Continue from the saved state in the folder; False if there is none.

        Raises:
            TrainingError: the state is damaged, or its network or settings differ.
        """
        description = read_state(state_file(self.out), self.encoder, self.optimiser, asdict(self.settings), self.data)
        if description is None:
            return False
        self.step, self.best = description["step"], description["best"]
        self.history = [
            (e["step"], Validation(e["geometric"], e["supporting"], e["loss"])) for e in description["history"]
        ]
        return True


_MIDDLE = 0.01
"""How far the centre of mass of a robot may be beside its middle, and it still is its own mirror image [m]."""


def is_symmetric(robot: RobotModel) -> bool:
    """Whether a robot's mirror image moves as the robot does, mirrored."""
    aside = any(
        (name in CATALOGUE and CATALOGUE[name].one_sided)
        or any(key == "y" and float(value) for key, value in values.items())
        for name, values in robot.effects
    )
    return not aside and abs(float(robot.centre_of_mass[1])) < _MIDDLE


def _fingerprint(robot: RobotModel, *parts: Sequence[RecordingSamples]) -> str:
    content = hashlib.sha256(robot_digest(robot).encode())
    for recordings in parts:
        for recording in recordings:
            content.update(recording.name.encode() + np.asarray(recording.stamps).tobytes())
            content.update(np.asarray(recording.odometry_from_base).tobytes())
        content.update(b"|")
    return content.hexdigest()[:16]


def _evenly(batch: EncoderInput, targets: Targets) -> tuple[EncoderInput, Targets]:
    """The same with a number of images of which there are few."""
    count = -(-len(batch.images) // _IMAGES_AT_ONCE) * _IMAGES_AT_ONCE
    added = targets.depth.new_zeros(count - len(batch.images), *targets.depth.shape[1:])
    return batch.with_images(count), replace(targets, depth=torch.cat([targets.depth, added]))


def state_file(out: Path) -> Path:
    """File in a training's folder that an interrupted training continues from."""
    return out / "state" / "state.safetensors"


@torch.no_grad()
def validate(
    encoder: Encoder,
    recordings: Sequence[RecordingSamples],
    device: torch.device,
    sensor_shares: Sequence[float] | None = (1.0, 0.0, 0.0),
) -> Validation:
    """Evaluate an encoder on whole recordings, without augmentation.

    Args:
        encoder: the encoder.
        recordings: recordings that it was not trained on.
        device: its device.
        sensor_shares: shares of samples with images alone, with both and with a sweep alone, for encoders of both;
            None: all samples have both.
    """
    encoder.eval()
    shares = sensor_shares if encoder.config.sensor == "camera_lidar" else None
    geometric, supporting, losses = [], [], []
    for recording in recordings:
        for start in range(0, len(recording), 8):
            indices = range(start, min(start + 8, len(recording)))
            given = [BOTH if shares is None else _sensors(i, shares) for i in indices]
            samples = [
                sample(recording, i, encoder.config, augmentation, chunks=1)
                for i, augmentation in zip(indices, given, strict=True)
            ]
            batch = EncoderInput.stack([s[0] for s in samples]).to(device)
            targets = Targets.stack([s[1] for s in samples]).to(device)
            maps: EncodedMaps = encoder(batch)
            ground = batch.ground[:, None, None]
            measured = (targets.geometric - ground).clamp(LOWEST, HIGHEST) + ground
            predicted = (maps.geometric_height - ground).clamp(LOWEST, HIGHEST) + ground
            geometric.append((predicted - measured).abs()[targets.observed & maps.covered].cpu())
            supporting.append((maps.height - targets.supporting).abs()[targets.contact_mask & maps.covered].cpu())
            losses.append(
                float(terrain_loss(maps, targets, batch.ground) + geometric_loss(maps, targets, batch.ground))
            )

    def median(parts: list[Tensor]) -> float:
        values = torch.cat(parts)
        return float(values.median()) if len(values) else float("nan")

    return Validation(median(geometric), median(supporting), float(np.mean(losses)))


def _sensors(index: int, shares: Sequence[float]) -> Augmentation:
    """Sensors of a sample by its index, the same in each validation; any run of samples has about the given shares."""
    part = (index + 0.5) * _GOLDEN_RATIO % 1.0 * sum(shares)
    return CAMERAS if part < shares[0] else BOTH if part < shares[0] + shares[1] else SWEEP


def describe(config: EncoderConfig, settings: TrainingSettings, recordings: Sequence[RecordingSamples]) -> dict:
    """Content of ``training.json``: configuration, settings and number of samples of each recording."""
    counts = {recording.name: len(recording) for recording in recordings}
    current = asdict(settings)
    # Also under the names of earlier releases.
    current["vary"] = current["augment"]
    current["weights"] |= {old: current["weights"][new] for old, new in RENAMED_WEIGHTS.items()}
    return {
        "config": asdict(config),
        "settings": current,
        "recordings": counts,
        "drives": counts,  # the name in earlier releases
    }
