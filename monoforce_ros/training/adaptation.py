"""Adaptation: fine-tune a trained encoder to a robot's own cameras and ground in a few minutes."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from monoforce_ros.encoder import Encoder
from monoforce_ros.robots import RobotModel
from monoforce_ros.training.judgement import CAMERAS, SWEEP, Judgement, judge
from monoforce_ros.training.losses import LossWeights
from monoforce_ros.training.recording_samples import RecordingSamples, SamplesError
from monoforce_ros.training.sample_extraction import TARGET_REACH
from monoforce_ros.training.samples import Augmentation
from monoforce_ros.training.trainer import Process, Trainer, TrainingSettings

HELD_OUT_SHARE = 0.25
"""Share of a recording, its end, that adaptation does not see."""
GAP = 3.0
"""Time between the training part and the held-out part of a recording, so that their images differ [s]."""
REPLAY_WORLDS = 8
"""Randomised worlds that are trained on alongside, so that walls and grass are not forgotten."""
SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Shares of the change of the weights that :func:`keep_obstacles` tries."""
LOST_OBSTACLES = 0.02
"""How far the share of detected obstacles may fall: a requirement, not a measurement."""


@dataclass(frozen=True)
class AdaptationSettings:
    """Settings of an adaptation."""

    steps: int = 80
    batch: int = 8
    rate: float = 4e-4
    """Peak learning rate, a quarter of that of a training from scratch."""
    seed: int = 1
    precision: str = "auto"


@dataclass(frozen=True)
class Adaptation:
    """What an adaptation changed: errors before and after."""

    before: Judgement
    after: Judgement
    """On the held-out part of the recordings."""
    worlds_before: Judgement | None
    worlds_after: Judgement | None
    """On randomised worlds that neither training saw; None without them."""
    share: float = 1.0
    """Share of the change of the weights that was kept; see :func:`keep_obstacles`."""

    @property
    def summary(self) -> str:
        """The result in words."""
        lines = [
            f"kept {self.share:.0%} of the change, so that obstacles in randomised worlds stay detected",
        ]
        if np.isfinite(self.before.median):
            lines.append(
                f"held-out part: error of the visible surface {_cm(self.before.median)} → {_cm(self.after.median)} "
                f"(level ground {_cm(self.before.level)})"
            )
        if np.isfinite(self.before.support):
            lines.append(
                f"held-out part: error of the ground under the wheels {_cm(self.before.support)} → "
                f"{_cm(self.after.support)} (level ground {_cm(self.before.support_level)})"
            )
        if self.worlds_before is not None and self.worlds_after is not None:
            lines.append(
                f"randomised worlds: obstacles seen {self.worlds_before.obstacles:.0%} → "
                f"{self.worlds_after.obstacles:.0%}, clear ground {self.worlds_before.clear:.0%} → "
                f"{self.worlds_after.clear:.0%}"
            )
        return "\n".join(lines)


def split_recording(recording: RecordingSamples) -> tuple[RecordingSamples, RecordingSamples]:
    """Training part and held-out end of a recording.

    Raises:
        SamplesError: the recording is too short for both.
    """
    first, last = int(recording.stamps[0]), int(recording.stamps[-1])
    border = last - HELD_OUT_SHARE * (last - first)
    early = recording.stamps <= border - GAP * 1e9
    apart = early & (_measured_until(recording) <= border)
    # Of a recording of a few targets none would be left.
    training = np.flatnonzero(apart if apart.any() else early)
    held_out = np.flatnonzero(recording.stamps > border)
    if not len(training) or not len(held_out):
        raise SamplesError(
            f"{recording.name}: got {len(recording)} samples over {(last - first) * 1e-9:.0f} s, expected at least "
            f"{GAP / (1 - HELD_OUT_SHARE) + 1:.0f} s: a quarter is held out to judge the result"
        )
    return recording.subset(training.tolist()), recording.subset(held_out.tolist())


def shares_targets(training: RecordingSamples, held_out: RecordingSamples) -> bool:
    """Whether targets of the training part were partly measured in the held-out part, as of recordings below 30 s."""
    return bool((_measured_until(training) > held_out.stamps[0]).any())


def _measured_until(recording: RecordingSamples) -> np.ndarray:
    """Up to when each sample's target may have been measured ``[n]`` [ns]: by later sweeps, and by the wheels."""
    firsts = {segment: int(recording.stamps[recording.segment_of == segment].min())
              for segment in set(recording.segment_of.tolist())}  # fmt: skip
    return np.array([firsts[segment] + round(TARGET_REACH * 1e9) for segment in recording.segment_of.tolist()])


def adapt(
    encoder: Encoder,
    robot: RobotModel,
    own: Sequence[RecordingSamples],
    replay: Sequence[RecordingSamples],
    out: Path,
    settings: AdaptationSettings = AdaptationSettings(),
    report: Callable[[int, dict[str, float]], None] = lambda step, losses: None,
) -> Encoder:
    """A copy of an encoder, fine-tuned on a robot's own samples; the backbone stays.

    Half of the samples of each step are the robot's own, half come from ``replay``.

    Args:
        encoder: encoder to start from.
        robot: that was driven.
        own: samples of the robot.
        replay: samples of randomised worlds.
        out: folder for the training's state.
        settings: settings of the adaptation.
        report: called with the step and its losses.
    """
    adapted = copy.deepcopy(encoder)
    training = TrainingSettings(
        steps=settings.steps, batch=settings.batch, rate=settings.rate, warm_up=max(1, settings.steps // 10),
        weights=LossWeights(trajectory=0.0), seed=settings.seed, validate_every=settings.steps,
        save_every=settings.steps, precision=settings.precision,
    )  # fmt: skip
    trainer = Trainer(adapted, robot, balanced(own, replay), [], out, training, Process("cpu"))
    trainer.run(report)
    return adapted.eval()


def blend(before: Encoder, after: Encoder, share: float) -> Encoder:
    """An encoder whose weights lie between those of two of one configuration: 0 gives ``before``, 1 ``after``."""
    start, end = before.state_dict(), after.state_dict()
    result = copy.deepcopy(after)
    result.load_state_dict({
        name: value + share * (end[name] - value) if value.is_floating_point() else end[name]
        for name, value in start.items()
    })  # fmt: skip
    return result.eval()


def keep_obstacles(
    before: Encoder, adapted: Encoder, worlds: Sequence[RecordingSamples], report: Callable[[], object] = lambda: None
) -> tuple[Encoder, float]:
    """The encoder nearest to the adapted one that still detects the obstacles of other worlds, and its share.

    Weights between those of a network and of its fine-tuned copy keep most of what either can do (Wortsman et al.,
    Robust fine-tuning of zero-shot models, CVPR 2022). The largest of :data:`SHARES` is taken with which the share of
    obstacle cells that are detected falls by no more than :data:`LOST_OBSTACLES`.

    Args:
        before: encoder before the adaptation.
        adapted: its fine-tuned copy.
        worlds: randomised worlds of neither training, other ones than the result is judged on.
        report: called after each judgement.
    """
    sensors = _sensors(before)
    wanted = judge(before, worlds, sensors).obstacles - LOST_OBSTACLES
    report()
    for share in SHARES:
        found = blend(before, adapted, share)
        if share == 0.0:
            break
        obstacles = judge(found, worlds, sensors).obstacles
        report()
        if not obstacles < wanted:
            break
    return found, share


def balanced(own: Sequence[RecordingSamples], replay: Sequence[RecordingSamples]) -> list[RecordingSamples]:
    """Both, each repeated so that they have about as many samples."""
    counts = [sum(map(len, part)) for part in (own, replay)]
    if not all(counts):
        return [*own, *replay]
    repeats = [max(1, round(max(counts) / count)) for count in counts]
    return [*list(own) * repeats[0], *list(replay) * repeats[1]]


def compare(
    before: Encoder,
    after: Encoder,
    held_out: Sequence[RecordingSamples],
    worlds: Sequence[RecordingSamples],
    share: float = 1.0,
) -> Adaptation:
    """Errors before and after on samples that neither training saw."""
    sensors = _sensors(before)
    judged = [judge(encoder, held_out, sensors) for encoder in (before, after)]
    others = [judge(encoder, worlds, sensors) if worlds else None for encoder in (before, after)]
    return Adaptation(judged[0], judged[1], others[0], others[1], share)


def _sensors(encoder: Encoder) -> Augmentation:
    return CAMERAS if encoder.config.takes_images else SWEEP


def _cm(metres: float) -> str:
    return f"{100 * metres:.1f} cm"
