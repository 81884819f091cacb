"""LiveGap: how far predictions were off, seconds later, while the robot drives."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import torch

from monoforce_ros.core import FAST_SHARE, CommandTrack, MotionTrack, StaleDataError, motion_regimes, wrap_angle
from monoforce_ros.prediction.predictor import Prediction, Predictor

HORIZONS = (1.0, 2.0, 5.0)
_EVERY = 0.5
"""Least time between the predictions that are kept to be compared [s]."""
_KEPT = 120
_LARGEST_GAP = 0.3
_FEWEST = 6
"""Comparisons that a regime needs to be named."""
_FREEDOM = 6.0
"""Variance of the second difference of three noisy values, in units of theirs."""


@dataclass(frozen=True)
class GapSample:
    """One prediction, compared."""

    stamp: int
    """Of the prediction [ns]."""
    position: np.ndarray
    """Distance to where the robot was at each of :data:`HORIZONS` [m]; NaN where that is not known."""
    heading: np.ndarray
    """[rad], signed: predicted minus measured."""
    moved: np.ndarray
    """Distance from the start to where the robot was [m]."""
    regimes: frozenset[str]


@dataclass(frozen=True)
class GapSummary:
    """Running error over the last minute or so of comparisons."""

    count: int
    position: np.ndarray
    """Median at each horizon [m]; NaN without a comparison."""
    heading: np.ndarray
    """Median size [rad]."""
    floor: np.ndarray
    """What the noise of the odometry alone makes of it [m]."""
    worst: str
    """The regime in which the error at 2 s is largest, in words; empty where none stands out."""

    @property
    def excessive(self) -> bool:
        """Whether the error at 2 s is more than noise and a quarter of a metre or a tenth of the way explain."""
        return bool(self.count >= _FEWEST and self.position[1] > max(3.0 * self.floor[1], 0.25))


@dataclass
class LiveGap:
    """Keeps predictions until it is known what happened, and compares.

    The driver may have changed his mind after a prediction was made: each is rolled out again on its own map and from
    its own start, with the commands that were really given, so that only the model's error is left.
    """

    predictor: Predictor
    _waiting: deque[Prediction] = field(default_factory=deque)
    _samples: deque[GapSample] = field(default_factory=lambda: deque(maxlen=_KEPT))
    _noise: tuple[float, float] = (0.0, 0.0)

    def clear(self) -> None:
        """Forget everything: time began anew."""
        self._waiting.clear()
        self._samples.clear()

    def remember(self, prediction: Prediction) -> None:
        """Keep a prediction for later, unless the last one kept is too recent."""
        if self._waiting and prediction.stamp - self._waiting[-1].stamp < _EVERY * 1e9:
            return
        self._waiting.append(prediction)

    def compare(self, motion: MotionTrack, commands: CommandTrack) -> GapSample | None:
        """Compare the oldest prediction whose last horizon has passed; None where none has.

        Args:
            motion: measured, up to now; at least from the prediction on.
            commands: given, up to now.
        """
        last = min(HORIZONS[-1], self.predictor.steps * self.predictor.options.time_step)
        if not self._waiting or not len(motion) or motion.stamps[-1] < self._waiting[0].stamp + round(last * 1e9):
            return None
        prediction = self._waiting.popleft()
        twists = commands.sample(self.predictor.command_stamps(prediction.stamp))
        rolled = self.predictor.roll_out(prediction.terrain, [prediction.motion], twists[None], with_forces=False)
        again = Prediction(prediction.motion, prediction.terrain, rolled)
        sample = _compared(again, motion, twists[self.predictor.history :], self.predictor)
        self._noise = odometry_noise(motion)
        if np.isfinite(sample.position).any():
            self._samples.append(sample)
            return sample
        return None

    def summary(self) -> GapSummary:
        """The running error."""
        empty = np.full(len(HORIZONS), np.nan)
        if not self._samples:
            return GapSummary(0, empty, empty, empty, "")
        position = np.array([sample.position for sample in self._samples])
        heading = np.abs([sample.heading for sample in self._samples])
        moved = np.array([sample.moved for sample in self._samples])
        spread, turn = self._noise
        # Median of a normal error: of both ends' positions, in two dimensions, and of the start's heading, in one.
        floor = np.hypot(1.18 * np.sqrt(2.0) * spread, 0.67 * turn * _median(moved))
        return GapSummary(len(self._samples), _median(position), _median(heading), floor, self._worst(position[:, 1]))

    def _worst(self, errors: np.ndarray) -> str:
        """The regime whose error at 2 s is half again as large as that of the rest."""
        found, largest = "", 1.5
        for regime in sorted(set().union(*(sample.regimes for sample in self._samples))):
            inside = np.array([regime in sample.regimes for sample in self._samples])
            known = np.isfinite(errors)
            if (inside & known).sum() < _FEWEST or (~inside & known).sum() < _FEWEST:
                continue
            ratio = np.median(errors[inside & known]) / max(np.median(errors[~inside & known]), 1e-3)
            if ratio > largest:
                found, largest = regime, ratio
        return found


def odometry_noise(motion: MotionTrack) -> tuple[float, float]:
    """Standard deviation of measured positions [m] and headings [rad], from their second differences.

    Motion is smooth over three neighbouring poses, noise is not; robust against jumps.
    """
    if len(motion) < 8:
        return 0.0, 0.0
    x, y, z, w = motion.quaternions.T
    heading = np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2)))
    values = np.column_stack([motion.positions[:, :2], heading])
    second = np.abs(values[:-2] - 2.0 * values[1:-1] + values[2:])
    deviation = 1.4826 * np.median(second, axis=0) / np.sqrt(_FREEDOM)
    return float(np.hypot(*deviation[:2]) / np.sqrt(2.0)), float(deviation[2])


def _compared(prediction: Prediction, motion: MotionTrack, twists: np.ndarray, predictor: Predictor) -> GapSample:
    count = len(HORIZONS)
    position, heading, moved = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
    positions, rotations = prediction.positions(), prediction.rotations()
    inside = torch.cumprod(prediction.rollout.inside[0].int(), dim=0).bool().numpy()
    for i, horizon in enumerate(HORIZONS):
        step = round(horizon / predictor.options.time_step)
        if step >= len(positions) or not inside[step] or not bool(prediction.rollout.valid[0]):
            continue
        try:
            state = motion.at(prediction.stamp + round(horizon * 1e9), maximum_gap=_LARGEST_GAP)
        except StaleDataError:
            continue
        position[i] = np.linalg.norm(positions[step] - state.position)
        turned = np.arctan2(rotations[step][1, 0], rotations[step][0, 0]) - state.heading
        heading[i] = wrap_angle(turned)
        moved[i] = np.linalg.norm(state.position - prediction.motion.position)
    first = twists[: round(2.0 / predictor.options.time_step)]
    return GapSample(prediction.stamp, position, heading, moved, _regimes(first, predictor))


def _regimes(twists: np.ndarray, predictor: Predictor) -> frozenset[str]:
    """Regimes of commands ``[T, 2]``."""
    masks = motion_regimes(twists[None], FAST_SHARE * predictor.robot.maximum_speed)
    return frozenset(name for name, mask in masks.items() if mask[0])


def _median(values: np.ndarray) -> np.ndarray:
    """Median of each column over what is known; NaN where nothing is."""
    known = np.isfinite(values).any(axis=0)
    return np.array([np.nanmedian(values[:, i]) if known[i] else np.nan for i in range(values.shape[1])])
