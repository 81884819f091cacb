"""LiveGap: error of recent predictions, measured while the robot drives."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import torch

from monoforce_ros.core import FAST_SHARE, CommandTrack, MotionTrack, StaleDataError, motion_regimes, wrap_angle
from monoforce_ros.perception import unbroken
from monoforce_ros.prediction.predictor import Prediction, Predictor

HORIZONS = (1.0, 2.0, 5.0)
"""Times after the start of a prediction at which its error is measured [s]."""
_INTERVAL = 0.5
"""Smallest time between predictions that are compared [s]."""
_MAXIMUM_SAMPLES = 120
_MAXIMUM_GAP = 0.3
"""Largest time between a compared pose and the nearest odometry [s]."""
_MINIMUM_SAMPLES = 6
"""Smallest number of comparisons for a statement about the error or about a regime."""
_SECOND_DIFFERENCE_VARIANCE = 6.0
"""Variance of the second difference of independent values, over their own variance."""


@dataclass(frozen=True)
class GapSample:
    """Errors of one prediction."""

    stamp: int
    """Start of the prediction [ns]."""
    position: np.ndarray
    """Distance between predicted and measured position at each of :data:`HORIZONS` [m]; NaN if unknown."""
    heading: np.ndarray
    """Predicted minus measured heading [rad]."""
    moved: np.ndarray
    """Distance between the start and the measured position [m]."""
    regimes: frozenset[str]
    """Motion regimes of the commands during the first 2 s."""


@dataclass(frozen=True)
class GapSummary:
    """Statistics of the error over the last minute or so."""

    count: int
    """Number of compared predictions."""
    position: np.ndarray
    """Median position error at each horizon [m]; NaN without a comparison."""
    heading: np.ndarray
    """Median absolute heading error [rad]."""
    floor: np.ndarray
    """Noise floor: median position error that odometry noise alone causes [m]."""
    worst: str
    """The motion regime with the largest error at 2 s; empty unless it differs clearly from the others."""

    @property
    def excessive(self) -> bool:
        """Whether the error at 2 s exceeds both 0.25 m and three times the noise floor."""
        return bool(self.count >= _MINIMUM_SAMPLES and self.position[1] > max(3.0 * self.floor[1], 0.25))


@dataclass
class LiveGap:
    """Keeps predictions until their horizon has passed, and compares them with the measured motion.

    Commands may have changed after a prediction was made. Each prediction is therefore rolled out again on its map and
    from its start, under the recorded commands, so that only the error of the model remains.
    """

    predictor: Predictor
    """Robot and physics of the predictions."""
    command_timeout: float = np.inf
    """Age from which on a command no longer acts [s], as in the predictions: bases stop without new ones."""
    _waiting: deque[Prediction] = field(default_factory=deque)
    _samples: deque[GapSample] = field(default_factory=lambda: deque(maxlen=_MAXIMUM_SAMPLES))
    _noise: tuple[float, float] = (0.0, 0.0)

    def clear(self) -> None:
        """Forget all predictions, as after a backward time jump."""
        self._waiting.clear()
        self._samples.clear()

    def remember(self, prediction: Prediction) -> None:
        """Keep a prediction for a later comparison, unless the last one is too recent."""
        if self._waiting and prediction.stamp - self._waiting[-1].stamp < _INTERVAL * 1e9:
            return
        self._waiting.append(prediction)

    def compare(self, motion: MotionTrack, commands: CommandTrack) -> GapSample | None:
        """Compare the oldest prediction if its last horizon has passed; None otherwise, or without a known error.

        Args:
            motion: measured motion from the start of the prediction until now.
            commands: recorded commands until now.
        """
        last = min(HORIZONS[-1], self.predictor.steps * self.predictor.options.time_step)
        if not self._waiting or not len(motion) or motion.stamps[-1] < self._waiting[0].stamp + round(last * 1e9):
            return None
        prediction = self._waiting.popleft()
        if not unbroken(motion, prediction.motion):
            # Another estimator, or a jump of this one: its poses say nothing of where the robot was predicted to go.
            return None
        stamps = self.predictor.command_stamps(prediction.stamp)
        twists = commands.sample(stamps, timeout=self.command_timeout)
        rolled = self.predictor.roll_out(
            prediction.terrain, [prediction.motion], twists[None], with_forces=False, joints=prediction.joints
        )
        again = Prediction(prediction.motion, prediction.terrain, rolled)
        sample = _compared(again, motion, twists[self.predictor.history :], self.predictor)
        self._noise = odometry_noise(motion)
        if np.isfinite(sample.position).any():
            self._samples.append(sample)
            return sample
        return None

    def summary(self) -> GapSummary:
        """Statistics of the errors so far."""
        empty = np.full(len(HORIZONS), np.nan)
        if not self._samples:
            return GapSummary(0, empty, empty, empty, "")
        position = np.array([sample.position for sample in self._samples])
        heading = np.abs([sample.heading for sample in self._samples])
        moved = np.array([sample.moved for sample in self._samples])
        spread, turn = self._noise
        # Medians of normal errors: 1.18 σ in two dimensions (positions of start and end), 0.67 σ in one (heading).
        floor = np.hypot(1.18 * np.sqrt(2.0) * spread, 0.67 * turn * _median(moved))
        return GapSummary(len(self._samples), _median(position), _median(heading), floor, self._worst(position[:, 1]))

    def _worst(self, errors: np.ndarray) -> str:
        """The regime with the largest error at 2 s, if that is over 1.5 times the error outside of it."""
        found, largest = "", 1.5
        for regime in sorted(set().union(*(sample.regimes for sample in self._samples))):
            inside = np.array([regime in sample.regimes for sample in self._samples])
            known = np.isfinite(errors)
            if (inside & known).sum() < _MINIMUM_SAMPLES or (~inside & known).sum() < _MINIMUM_SAMPLES:
                continue
            ratio = np.median(errors[inside & known]) / max(np.median(errors[~inside & known]), 1e-3)
            if ratio > largest:
                found, largest = regime, ratio
        return found


def odometry_noise(motion: MotionTrack) -> tuple[float, float]:
    """Standard deviation of measured positions [m] and headings [rad], from their second differences.

    Motion is smooth over three consecutive poses, noise is not. The median makes the estimate robust to jumps.
    """
    if len(motion) < 8:
        return 0.0, 0.0
    x, y, z, w = motion.quaternions.T
    heading = np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2)))
    values = np.column_stack([motion.positions[:, :2], heading])
    second = np.abs(values[:-2] - 2.0 * values[1:-1] + values[2:])
    deviation = 1.4826 * np.median(second, axis=0) / np.sqrt(_SECOND_DIFFERENCE_VARIANCE)
    return float(np.hypot(*deviation[:2]) / np.sqrt(2.0)), float(deviation[2])


def _compared(prediction: Prediction, motion: MotionTrack, twists: np.ndarray, predictor: Predictor) -> GapSample:
    """Errors of a prediction under the recorded commands ``[T, 2]``."""
    count = len(HORIZONS)
    position, heading, moved = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
    positions, rotations = prediction.positions(), prediction.rotations()
    inside = torch.cumprod(prediction.rollout.inside[0].int(), dim=0).bool().numpy()
    for i, horizon in enumerate(HORIZONS):
        step = round(horizon / predictor.options.time_step)
        if step >= len(positions) or not inside[step] or not bool(prediction.rollout.valid[0]):
            continue
        try:
            state = motion.at(prediction.stamp + round(horizon * 1e9), maximum_gap=_MAXIMUM_GAP)
        except StaleDataError:
            continue
        position[i] = np.linalg.norm(positions[step] - state.position)
        turned = np.arctan2(rotations[step][1, 0], rotations[step][0, 0]) - state.heading
        heading[i] = wrap_angle(turned)
        moved[i] = np.linalg.norm(state.position - prediction.motion.position)
    first = twists[: round(2.0 / predictor.options.time_step)]
    return GapSample(prediction.stamp, position, heading, moved, _regimes(first, predictor))


def _regimes(twists: np.ndarray, predictor: Predictor) -> frozenset[str]:
    """Motion regimes of commands ``[T, 2]``."""
    masks = motion_regimes(twists[None], FAST_SHARE * predictor.robot.maximum_speed)
    return frozenset(name for name, mask in masks.items() if mask[0])


def _median(values: np.ndarray) -> np.ndarray:
    """Median of the finite values of each column; NaN without any."""
    known = np.isfinite(values).any(axis=0)
    return np.array([np.nanmedian(values[:, i]) if known[i] else np.nan for i in range(values.shape[1])])
