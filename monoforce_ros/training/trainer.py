"""Trainer: encoder, samples and losses → checkpoint, in steps that a kill does not lose."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
import torch.distributed
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from monoforce_ros.core import atomic_path
from monoforce_ros.encoder import EncodedMaps, Encoder, EncoderConfig, EncoderInput, TerrainEncoder, save_encoder
from monoforce_ros.physics import PhysicsOptions
from monoforce_ros.robots import RobotModel
from monoforce_ros.training.losses import (
    HIGHEST,
    LOWEST,
    LossWeights,
    decrease_loss,
    geometric_loss,
    measured_decrease_loss,
    slope_loss,
    standing_decrease_loss,
    terrain_loss,
    trajectory_loss,
)
from monoforce_ros.training.recording_samples import RecordingSamples
from monoforce_ros.training.samples import Targets, Variation, sample


@dataclass(frozen=True)
class TrainingSettings:
    """How an encoder is trained."""

    steps: int = 2000
    batch: int = 8
    """Samples a step and process."""
    rate: float = 1.5e-3
    """Largest learning rate; the pretrained backbone's is a third of it."""
    warm_up: int = 50
    """Steps in which the rate rises."""
    weights: LossWeights = field(default_factory=LossWeights)
    seed: int = 1
    vary: bool = True
    """Vary samples (mirror, turn, cut, recolour)."""
    validate_every: int = 250
    save_every: int = 50
    precision: str = "auto"
    """``auto`` (half precision on CUDA), ``float32`` or ``bfloat16``."""

    def __post_init__(self):
        for name, low, high in (
            ("steps", 1, 10_000_000), ("batch", 1, 4096), ("rate", 1e-7, 1.0), ("warm_up", 0, 1_000_000),
            ("validate_every", 1, 10_000_000), ("save_every", 1, 10_000_000), ("seed", 0, 2**31),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"training {name}: got {getattr(self, name)}, expected {low:g} to {high:g}")
        if self.precision not in ("auto", "float32", "bfloat16"):
            raise ValueError(f"training precision: got {self.precision!r}, expected auto, float32 or bfloat16")


class TrainingError(RuntimeError):
    """Training that cannot go on; the message says why."""


@dataclass(frozen=True)
class Validation:
    """How far an encoder is off on drives that it did not see; medians over cells that cameras look at."""

    geometric: float
    """|H_g - H_g*| [m]."""
    supporting: float
    """|H_t - H_t*| where the robot drove [m]."""
    loss: float
    """The criterion of the paper (IV-A): terrain and geometric loss."""


class Process:
    """This process among those that train together under ``torchrun``; alone without it."""

    def __init__(self, device: str = "auto"):
        self.count = int(os.environ.get("WORLD_SIZE", "1"))
        self.rank = int(os.environ.get("RANK", "0"))
        cuda = device == "cuda" or (device == "auto" and torch.cuda.is_available())
        if device == "cuda" and not torch.cuda.is_available():
            raise TrainingError("device: got cuda, but PyTorch sees no CUDA GPU; use --device cpu")
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
    """Encoder and losses as one module, so that a distributed wrapper sees one forward pass."""

    def __init__(self, encoder: Encoder, robot: RobotModel, weights: LossWeights):
        super().__init__()
        self.encoder, self.weights = encoder, weights
        self.robot, self.options = robot, PhysicsOptions()

    def forward(self, batch: EncoderInput, targets: Targets) -> dict[str, Tensor]:
        maps = self.encoder(batch)
        weights, losses = self.weights, {}
        if weights.geometric:
            losses["geometric"] = weights.geometric * geometric_loss(maps, targets, batch.ground, weights.standing)
        if weights.terrain:
            losses["terrain"] = weights.terrain * terrain_loss(maps, targets)
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
            losses["standing decrease"] = weights.standing_decrease * standing_decrease_loss(
                maps, targets, batch.ground
            )
        losses["total"] = torch.stack(list(losses.values())).sum()
        # Heads without a loss get a gradient of zero: processes that train together expect one for each weight.
        unused = maps.decrease.sum() + maps.stiffness.sum() + maps.damping.sum() + maps.friction.sum()
        losses["total"] = losses["total"] + 0.0 * (unused + maps.geometric_height.sum())
        return losses


class Trainer:
    """Trains an encoder on drives and keeps its state in a folder.

    Args:
        encoder: to train, its backbone with the weights that it starts from.
        robot: that drove.
        drives: to train on.
        held_out: whole drives to validate on.
        out: folder of ``encoder.safetensors``, ``training.json``, ``state/`` and logs.
        settings: of the training.
        process: this one, among others.
    """

    def __init__(
        self,
        encoder: Encoder,
        robot: RobotModel,
        drives: Sequence[RecordingSamples],
        held_out: Sequence[RecordingSamples],
        out: Path,
        settings: TrainingSettings,
        process: Process,
    ):
        self.out, self.settings, self.process = out, settings, process
        self.encoder = encoder.to(process.device, memory_format=torch.channels_last)
        self.drives, self.held_out = list(drives), list(held_out)
        self.index = [(d, i) for d, drive in enumerate(self.drives) for i in range(len(drive))]
        if not self.index:
            raise TrainingError("no samples to train on")
        losses = _Losses(self.encoder, robot, settings.weights)
        self.losses = nn.parallel.DistributedDataParallel(losses) if process.count > 1 else losses
        backbone = list(self.encoder.backbone.parameters()) if isinstance(encoder, TerrainEncoder) else []
        pretrained = set(backbone)
        groups = [
            {"params": backbone, "lr": settings.rate / 3},
            {"params": [p for p in self.encoder.parameters() if p not in pretrained], "lr": settings.rate},
        ]
        self.optimiser = torch.optim.AdamW(groups, weight_decay=1e-2)
        self.step = 0
        self.best = float("inf")
        self.history: list[dict] = []

    def run(self, report: Callable[[int, dict[str, float]], None] = lambda step, losses: None) -> None:
        """Train to the last step.

        Raises:
            TrainingError: the loss is not finite for many steps in a row.
        """
        settings = self.settings
        lost = 0
        self.encoder.train()
        with ThreadPoolExecutor(1) as pool:
            prepared = pool.submit(self._batch, self.step)
            while self.step < settings.steps:
                batch, targets = prepared.result()
                if self.step + 1 < settings.steps:
                    prepared = pool.submit(self._batch, self.step + 1)
                losses = self._descend(batch.to(self.process.device), targets.to(self.process.device))
                self.step += 1
                lost = 0 if np.isfinite(losses["total"]) else lost + 1
                if lost >= 20:
                    raise TrainingError(
                        f"the loss was not finite in {lost} steps in a row, up to step {self.step}; what was saved "
                        "before is kept; try a smaller --rate"
                    )
                report(self.step, losses)
                done = self.step == settings.steps
                if done or self.step % settings.validate_every == 0:
                    self._validated()
                if self.process.first and (done or self.step % settings.save_every == 0):
                    self.save()

    def _descend(self, batch: EncoderInput, targets: Targets) -> dict[str, float]:
        fraction = self.step / max(1, self.settings.steps)
        rise = min(1.0, (self.step + 1) / max(1, self.settings.warm_up))
        factor = rise * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * fraction)))
        for group, share in zip(self.optimiser.param_groups, (1 / 3, 1.0), strict=True):
            group["lr"] = self.settings.rate * share * factor
        self.optimiser.zero_grad(set_to_none=True)
        with self._cast():
            losses = self.losses(batch, targets)
        total = losses["total"]
        if torch.isfinite(total.detach()):
            total.backward()
            norm = nn.utils.clip_grad_norm_(self.encoder.parameters(), 2.0)
            # One sample that sends a robot tumbling must not spoil the weights.
            if torch.isfinite(norm):
                self.optimiser.step()
        return {name: float(value.detach()) for name, value in losses.items()}

    def _cast(self) -> torch.autocast:
        kind = self.process.device.type
        on = self.settings.precision == "bfloat16" or (self.settings.precision == "auto" and kind == "cuda")
        return torch.autocast(kind, dtype=torch.bfloat16, enabled=on)

    def _batch(self, step: int) -> tuple[EncoderInput, Targets]:
        """Samples of a step, the same for the same seed however often training was interrupted."""
        settings, process = self.settings, self.process
        each = settings.batch * process.count
        random = np.random.default_rng([settings.seed, step])
        # Every sample once in each round through the drives.
        rounds, first = divmod(step * each, len(self.index))
        order = np.random.default_rng([settings.seed, 7, rounds]).permutation(len(self.index))
        first += process.rank * settings.batch
        chosen = np.take(order, range(first, first + settings.batch), mode="wrap")
        variations = [Variation.draw(random) if settings.vary else Variation() for _ in range(each)]
        mine = variations[process.rank * settings.batch :]
        samples = [
            sample(self.drives[self.index[i][0]], self.index[i][1], self.encoder.config, variation)
            for i, variation in zip(chosen, mine, strict=False)
        ]
        return EncoderInput.stack([s[0] for s in samples]), Targets.stack([s[1] for s in samples])

    def _validated(self) -> None:
        """Validate; keep the encoder where it is the best so far."""
        if not self.process.first:
            return
        if not self.held_out:
            save_encoder(self.encoder, self.out / "encoder.safetensors")
            return
        found = validate(self.encoder, self.held_out, self.process.device)
        self.history.append({"step": self.step, **asdict(found)})
        if found.loss < self.best:
            self.best = found.loss
            save_encoder(self.encoder, self.out / "encoder.safetensors")
        self.encoder.train()

    def save(self) -> None:
        """Keep weights, the optimiser's moments and the step, so that training goes on from here."""
        folder = self.out / "state"
        tensors = {f"encoder.{name}": value for name, value in self.encoder.state_dict().items()}
        names = {parameter: name for name, parameter in self.encoder.named_parameters()}
        for parameter, moments in self.optimiser.state.items():
            for key, value in moments.items():
                tensors[f"optimiser.{names[parameter]}.{key}"] = torch.as_tensor(value)
        description = {
            "step": self.step, "best": self.best, "history": self.history, "settings": asdict(self.settings),
            "config": asdict(self.encoder.config), "written": time.time(),
        }  # fmt: skip
        with atomic_path(folder / "state.safetensors") as unfinished:
            save_file(
                {name: value.detach().cpu().contiguous() for name, value in tensors.items()}, str(unfinished),
                metadata={"training": json.dumps(description)},
            )  # fmt: skip

    def resume(self) -> bool:
        """Go on from the folder's state; False where there is none.

        Raises:
            TrainingError: the state is damaged or of another network or other settings.
        """
        file = self.out / "state" / "state.safetensors"
        if not file.is_file():
            return False
        from safetensors import safe_open

        try:
            with safe_open(str(file), framework="pt") as content:
                description = json.loads((content.metadata() or {})["training"])
            tensors = load_file(str(file))
        except (SafetensorError, KeyError, ValueError, OSError) as error:
            raise TrainingError(f"{file}: damaged ({error}); delete {file.parent} to start anew") from error
        wanted = json.loads(json.dumps(asdict(self.settings)))
        different = [name for name, value in wanted.items() if description["settings"].get(name) != value]
        if description["config"] != asdict(self.encoder.config):
            different.append("the network's configuration")
        if different:
            raise TrainingError(
                f"{file}: was trained with other {', '.join(different)}; give the same options, or another --out"
            )
        self.encoder.load_state_dict(
            {name.removeprefix("encoder."): v for name, v in tensors.items() if name.startswith("encoder.")}
        )
        for name, parameter in self.encoder.named_parameters():
            prefix = f"optimiser.{name}."
            moments = {key.removeprefix(prefix): v for key, v in tensors.items() if key.startswith(prefix)}
            if moments:
                self.optimiser.state[parameter] = {
                    key: v if key == "step" else v.to(self.process.device) for key, v in moments.items()
                }
        self.step, self.best, self.history = description["step"], description["best"], description["history"]
        return True


@torch.no_grad()
def validate(encoder: Encoder, drives: Sequence[RecordingSamples], device: torch.device) -> Validation:
    """Measure an encoder on whole drives, without variations."""
    encoder.eval()
    geometric, supporting, losses = [], [], []
    for drive in drives:
        for start in range(0, len(drive), 8):
            samples = [sample(drive, i, encoder.config, chunks=1) for i in range(start, min(start + 8, len(drive)))]
            batch = EncoderInput.stack([s[0] for s in samples]).to(device)
            targets = Targets.stack([s[1] for s in samples]).to(device)
            maps: EncodedMaps = encoder(batch)
            ground = batch.ground[:, None, None]
            seen = (targets.geometric - ground).clamp(LOWEST, HIGHEST) + ground
            geometric.append((maps.geometric_height - seen).abs()[targets.observed & maps.covered].cpu())
            supporting.append((maps.height - targets.supporting).abs()[targets.felt & maps.covered].cpu())
            losses.append(float(terrain_loss(maps, targets) + geometric_loss(maps, targets, batch.ground)))

    def median(parts: list[Tensor]) -> float:
        values = torch.cat(parts)
        return float(values.median()) if len(values) else float("nan")

    return Validation(median(geometric), median(supporting), float(np.mean(losses)))


def describe(config: EncoderConfig, settings: TrainingSettings, drives: Sequence[RecordingSamples]) -> dict:
    """What stands beside a checkpoint: how it came to be."""
    return {
        "config": asdict(config),
        "settings": asdict(settings),
        "drives": {drive.name: len(drive) for drive in drives},
    }
