"""Adaptation: fine-tune a trained encoder to a robot's own cameras and ground in a few minutes."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from monoforce_ros.encoder import Encoder
from monoforce_ros.robots import RobotModel
from monoforce_ros.training.judgement import CAMERAS, SWEEP, Judgement, judge, sample_errors, widened
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
BLOCK = 2.0
"""Length of the blocks of a held-out part whose mean errors are compared [s]: neighbouring samples see one ground."""
_MATTERS = 0.005
"""Increase of an error from which it counts as worse [m]: half of what the predictor's trust tolerates."""
_LEVEL = 0.05
"""Error rate at which an adaptation that made nothing worse is taken back."""
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
    """Share of the change of the weights that was kept; see :func:`keep_obstacles` and :func:`got_worse`."""
    worse: tuple[str, ...] = ()
    """What the adaptation made worse beyond chance, so that none of it was kept: ``surface``, ``support``."""

    @property
    def worse_than_level(self) -> bool:
        """Whether level ground at the height of the wheels is still the better guess."""
        after = self.after
        return after.median > after.level or after.support > after.support_level

    @property
    def summary(self) -> str:
        """The result in words."""
        if self.worse:
            names = " and ".join(_NAMES[name] for name in self.worse)
            lines = [
                f"kept nothing of the change: on the held-out part {names} became worse beyond chance; the weights are "
                "those from before"
            ]
        elif self.share == 0.0:
            lines = ["kept nothing of the change: with any part of it obstacles in randomised worlds were missed"]
        else:
            lines = [f"kept {self.share:.0%} of the change, so that obstacles in randomised worlds stay detected"]
        for name, before, after, level, inside in (
            ("surface", self.before.median, self.after.median, self.after.level,
             (self.before.inside, self.after.inside)),
            ("support", self.before.support, self.after.support, self.after.support_level,
             (self.before.support_inside, self.after.support_inside)),
        ):  # fmt: skip
            if not np.isfinite(before):
                continue
            lines.append(
                f"held-out part: error of {_NAMES[name]} {_cm(before)} → {_cm(after)} (level ground {_cm(level)}); its "
                f"90 % bands hold {inside[0]:.0%} → {inside[1]:.0%}"
            )
            if after > level:
                lines.append(f"held-out part: {_NAMES[name]} is still worse than level ground")
        if self.worlds_before is not None and self.worlds_after is not None:
            lines.append(
                f"randomised worlds: obstacles seen {self.worlds_before.obstacles:.0%} → "
                f"{self.worlds_after.obstacles:.0%}, clear ground {self.worlds_before.clear:.0%} → "
                f"{self.worlds_after.clear:.0%}"
            )
        return "\n".join(lines)

    def advice(self, checkpoint: Path) -> str:
        """What to do with the result."""
        if self.worse_than_level:
            return (
                f"do not rely on {checkpoint} yet: with a lidar use terrain_source:=lidar, otherwise leave "
                "camera_fallback on; check the cameras' poses and calibrations (evaluate --check), and adapt to one to "
                "three minutes of driving over uneven ground"
            )
        if self.share == 0.0:
            return f"{checkpoint} has the weights from before; its bands are as wide as this robot's errors ask for"
        return f"use it with checkpoint:={checkpoint}"


_NAMES = {"surface": "the visible surface", "support": "the ground under the wheels"}


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


def got_worse(before: Encoder, after: Encoder, held_out: Sequence[RecordingSamples]) -> tuple[str, ...]:
    """What became worse beyond chance on samples that the adaptation did not see: ``surface``, ``support``.

    Differences of the errors are averaged over blocks of :data:`BLOCK`, and their mean is compared with its standard
    error (Student's t, one-sided, 5 %). A single block has none. An increase of less than 5 mm is none.
    """
    sensors = _sensors(before)
    found: dict[str, list[float]] = {"surface": [], "support": []}
    for recording in held_out:
        errors = [sample_errors(encoder, recording, sensors) for encoder in (before, after)]
        blocks = ((recording.stamps - recording.stamps[0]) / (BLOCK * 1e9)).astype(int)
        for name, values in found.items():
            change = errors[1][name] - errors[0][name]
            parts = [change[(blocks == block) & np.isfinite(change)] for block in np.unique(blocks)]
            values += [float(part.mean()) for part in parts if len(part)]
    return tuple(name for name, values in found.items() if values and _above_zero(np.array(values)))


def _above_zero(values: np.ndarray) -> bool:
    mean = float(values.mean())
    if len(values) < 2:
        return mean > _MATTERS
    error = float(values.std(ddof=1)) / np.sqrt(len(values))
    return mean > _MATTERS and mean > error * float(stats.t.ppf(1.0 - _LEVEL, len(values) - 1))


def calibration_and_judging(
    held_out: Sequence[RecordingSamples],
) -> tuple[list[RecordingSamples], list[RecordingSamples]]:
    """First and second halves of held-out parts: bands that were widened on a part would look right there.

    A part of a single sample is judged on.
    """
    middles = [len(recording) // 2 for recording in held_out]
    return (
        [part.subset(list(range(middle))) for part, middle in zip(held_out, middles, strict=True) if middle],
        [part.subset(list(range(middle, len(part)))) for part, middle in zip(held_out, middles, strict=True)],
    )


def judged_adaptation(
    before: Encoder,
    adapted: Encoder,
    held_out: Sequence[RecordingSamples],
    worlds: Sequence[RecordingSamples],
    share: float = 1.0,
) -> tuple[Encoder, Adaptation]:
    """The encoder to use, and what it is worth.

    Its weights are those from before where the adapted ones are worse beyond chance on the held-out part. Its bands are
    widened on the first half of that part where they hold too little, and the second half judges the result.

    Args:
        before: encoder before the adaptation.
        adapted: after it, from :func:`keep_obstacles`.
        held_out: held-out parts of the robot's recordings.
        worlds: randomised worlds of neither training.
        share: share of the change that ``adapted`` has.
    """
    worse = got_worse(before, adapted, held_out) if share else ()
    chosen, share = (before, 0.0) if worse else (adapted, share)
    calibration, judging = calibration_and_judging(held_out)
    if calibration:
        chosen = widened(chosen, calibration, _sensors(before))
    return chosen, compare(before, chosen, judging, worlds, share, worse)


def compare(
    before: Encoder,
    after: Encoder,
    held_out: Sequence[RecordingSamples],
    worlds: Sequence[RecordingSamples],
    share: float = 1.0,
    worse: tuple[str, ...] = (),
) -> Adaptation:
    """Errors before and after on samples that neither training saw."""
    sensors = _sensors(before)
    judged = [judge(encoder, held_out, sensors) for encoder in (before, after)]
    others = [judge(encoder, worlds, sensors) if worlds else None for encoder in (before, after)]
    return Adaptation(judged[0], judged[1], others[0], others[1], share, worse)


def _sensors(encoder: Encoder) -> Augmentation:
    return CAMERAS if encoder.config.takes_images else SWEEP


def _cm(metres: float) -> str:
    return f"{100 * metres:.1f} cm"
