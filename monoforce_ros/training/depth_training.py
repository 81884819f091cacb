"""DepthTrainer: trains the depth along pixels on cached features of the frozen backbone.

The backbone, the splat and the bird's-eye-view network cost most of a training step, and depth needs none of them: its
loss compares bins along rays with measured depths. On features that are computed once, a step costs a fraction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from monoforce_ros.encoder import TerrainEncoder
from monoforce_ros.training.image_features import ImageFeatures
from monoforce_ros.training.losses import ray_depth_loss
from monoforce_ros.training.training_state import TrainingError, read_state, save_state

PARTS = ("lift", "all")
"""The last layer alone, which a few dozen worlds do not overfit; or all that follows the backbone."""
_PROMINENT = float(np.log(1.3))
"""Logarithmic distance of a measured depth from that of level ground from which a feature shows something that stands
out, or a hill."""
_STATE = "depth.safetensors"


@dataclass(frozen=True)
class DepthSettings:
    """Settings of a training of depth."""

    steps: int = 2000
    batch: int = 24
    """Images per step."""
    rate: float = 3e-3
    """Peak learning rate."""
    warm_up: int = 50
    """Steps of linear warm-up of the learning rate."""
    part: str = "lift"
    """Trained part of what follows the backbone, of :data:`PARTS`; norms follow the batches with ``all`` only."""
    prominence: float = 1.0
    """Additional relative weight of rays that show something that stands out of level ground, or a hill."""
    keep: float = 1.0
    """Weight of the lifted features' mean squared change, in units of their variance: the bird's-eye-view network has
    learned to read them. 0 for a network that has not."""
    save_every: int = 100
    seed: int = 1

    def __post_init__(self):
        for name, low, high in (
            ("steps", 1, 10_000_000), ("batch", 2, 4096), ("rate", 1e-7, 1.0), ("warm_up", 0, 1_000_000),
            ("prominence", 0.0, 1e6), ("keep", 0.0, 1e6), ("save_every", 1, 10_000_000), ("seed", 0, 2**31),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"depth training {name}: got {getattr(self, name)}, expected {low:g} to {high:g}")
        if self.part not in PARTS:
            raise ValueError(f"depth training part: got {self.part!r}, expected one of {', '.join(PARTS)}")


@dataclass(frozen=True)
class DepthErrors:
    """Relative errors of depth along rays that the lidar measured; medians."""

    rays: int
    level: float
    """Of level ground, at the largest depth where a ray does not meet it."""
    median: float
    prominent: float
    """Of rays whose depth differs from that of level ground by 30 % or more: walls, trunks and hills."""
    prominent_level: float


class DepthTrainer:
    """Trains what follows the backbone in an image: context, neck and lift.

    Args:
        encoder: encoder to train, changed in place.
        features: features that its backbone computed.
        out: folder for the state, from which :meth:`resume` continues.
        settings: settings of the training.
    """

    def __init__(self, encoder: TerrainEncoder, features: ImageFeatures, out: Path, settings: DepthSettings):
        if len(features) < 2:
            raise TrainingError(f"depth training: got {len(features)} images, expected at least 2")
        self.encoder, self.features, self.out, self.settings = encoder, features, out, settings
        last = [encoder.lift, *([encoder.relative] if encoder.config.relative_bins else [])]
        self.trained = nn.ModuleList(last if settings.part == "lift" else [encoder.context, encoder.neck, *last])
        self.parameters = [*self.trained.parameters(), encoder.level_weight]
        self.optimiser = torch.optim.AdamW(self.parameters, lr=settings.rate, weight_decay=1e-2)
        self.step = 0
        kept = features.lifted.float()
        self._scale = kept.var().clamp_min(1e-6)

    def run(self, report: Callable[[int, dict[str, float]], None] = lambda step, losses: None) -> None:
        """Train until the last step, and save the state there and on the way."""
        settings = self.settings
        self.encoder.eval()
        # Only the norms of what is trained follow the batches.
        self.trained.train()
        needed = {name: parameter.requires_grad for name, parameter in self.encoder.named_parameters()}
        self.encoder.requires_grad_(False)
        for parameter in self.parameters:
            parameter.requires_grad_(True)
        while self.step < settings.steps:
            losses = self._descend(self.features.select(self._chosen()))
            self.step += 1
            if not np.isfinite(losses["depth"]):
                raise TrainingError(f"the depth loss was not finite in step {self.step}; try a smaller rate")
            report(self.step, losses)
            if self.step % settings.save_every == 0 or self.step == settings.steps:
                self.save()
        for name, parameter in self.encoder.named_parameters():
            parameter.requires_grad_(needed[name])
        self.encoder.eval()

    def _chosen(self) -> Tensor:
        """Images of the present step, determined by seed and step alone; each epoch uses every image once."""
        settings, count = self.settings, len(self.features)
        size = min(settings.batch, count)
        epoch, place = divmod(self.step, count // size)
        order = np.random.default_rng([settings.seed, epoch]).permutation(count)
        return torch.from_numpy(order[place * size : (place + 1) * size])

    def _descend(self, batch: ImageFeatures) -> dict[str, float]:
        settings = self.settings
        warm_up = min(1.0, (self.step + 1) / max(1, settings.warm_up))
        fraction = self.step / settings.steps
        for group in self.optimiser.param_groups:
            group["lr"] = settings.rate * warm_up * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * fraction)))
        self.optimiser.zero_grad(set_to_none=True)
        probability, lifted = self.encoder.lifted(batch.fine, batch.coarse, batch.rays, batch.origins)
        prominent = (
            _level_logarithm(batch, self.encoder.depths) - batch.depth.clamp_min(1e-3).log()
        ).abs() > _PROMINENT
        weight = 1.0 + settings.prominence * prominent
        depth = ray_depth_loss(probability, batch.depth, self.encoder.depths, weight)
        kept = (lifted - batch.lifted).square().mean() / self._scale
        (depth + settings.keep * kept).backward()
        nn.utils.clip_grad_norm_(self.parameters, 2.0)
        self.optimiser.step()
        return {"depth": float(depth.detach()), "features": float(kept.detach())}

    def save(self) -> None:
        """Save weights, the optimiser's moments and the step."""
        description = {"step": self.step, "settings": asdict(self.settings), "config": asdict(self.encoder.config)}
        save_state(self.out / _STATE, self.encoder, self.optimiser, description)

    def resume(self) -> bool:
        """Continue from the saved state in the folder; False if there is none.

        Raises:
            TrainingError: the state is damaged, or its network or settings differ.
        """
        found = read_state(self.out / _STATE, self.encoder, self.optimiser, asdict(self.settings))
        if found is not None:
            self.step = int(found["step"])
        return found is not None


@torch.no_grad()
def depth_errors(encoder: TerrainEncoder, features: ImageFeatures, *, size: int = 32) -> DepthErrors:
    """Errors of the median of the depth distribution along each measured ray.

    Args:
        encoder: the encoder; put into evaluation mode.
        features: features of its backbone.
        size: images in a batch.
    """
    encoder.eval()
    depths = encoder.depths
    step = float((depths[1] / depths[0]).log())
    predicted, measured, level = [], [], []
    for start in range(0, len(features), size):
        part = features.select(torch.arange(start, min(start + size, len(features))))
        probability, _ = encoder.lifted(part.fine, part.coarse, part.rays, part.origins)
        known = (part.depth >= depths[0]) & (part.depth <= depths[-1])
        level.append(_level_logarithm(part, depths)[known])
        predicted.append(_median_logarithm(probability, float(depths[0].log()), step)[known])
        measured.append(part.depth[known].log())
    found, truth, flat = torch.cat(predicted), torch.cat(measured), torch.cat(level)
    prominent = (flat - truth).abs() > _PROMINENT

    def median(values: Tensor) -> float:
        return float(np.median(np.expm1(values.abs().numpy()))) if len(values) else float("nan")

    return DepthErrors(
        rays=len(truth),
        level=median(flat - truth),
        median=median(found - truth),
        prominent=median((found - truth)[prominent]),
        prominent_level=median((flat - truth)[prominent]),
    )


def _level_logarithm(features: ImageFeatures, depths: Tensor) -> Tensor:
    """Logarithm of the depth of level ground ``[N, rows, columns]``, within the bins."""
    down = features.rays[..., 2]
    meets = torch.where(down < -1e-3, -features.origins[:, 2, None, None] / down.clamp_max(-1e-3), float("inf"))
    return meets.clamp(float(depths[0]), float(depths[-1])).log()


def _median_logarithm(probability: Tensor, first: float, step: float) -> Tensor:
    """Logarithm of the median depth ``[N, rows, columns]``, interpolated within its bin."""
    summed = probability.exp().cumsum(dim=1)
    index = (summed < 0.5).sum(dim=1, keepdim=True).clamp(max=summed.shape[1] - 1)
    inside = probability.exp().gather(1, index)
    below = summed.gather(1, index) - inside
    place = index + ((0.5 - below) / inside.clamp_min(1e-9)).clamp(0.0, 1.0) - 0.5
    return (first + step * place)[:, 0]
