"""Candidates: command sequences to choose from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_QUARTERS = 4


@dataclass(frozen=True)
class CandidateSettings:
    """A fan of arcs, and of turns on the spot that lead elsewhere."""

    count: int = 32
    speeds: tuple[float, ...] = (0.4, 0.8)
    """Forward speeds [m/s]; candidates are shared out among them. At 0 a robot turns on the spot."""
    yaw_rate: float = 0.8
    """Largest yaw rate of an arc [rad/s]."""
    stop: bool = True
    """Standing still is a candidate too, the last one."""

    def __post_init__(self):
        if not 1 <= self.count <= 4096:
            raise ValueError(f"candidates: got {self.count}, expected 1 to 4096")
        if not self.speeds or not all(np.isfinite(v) and abs(v) <= 20.0 for v in self.speeds):
            raise ValueError(f"candidate speeds: got {list(self.speeds)}, expected finite speeds up to 20 m/s")
        if not 0.0 <= self.yaw_rate <= 10.0:
            raise ValueError(f"candidate yaw rate: got {self.yaw_rate}, expected 0 to 10 rad/s")


def fan_of_arcs(settings: CandidateSettings) -> np.ndarray:
    """Forward speed [m/s] and yaw rate [rad/s] of each candidate over four quarters of the horizon, ``[count, 4, 2]``.

    Yaw rates are spread evenly from right to left and held; straight on is among them where a speed has an odd number
    of arcs. A robot that stands before a wall must turn first and drive then: turns on the spot last half the horizon
    or three quarters of it, every other one, and go straight on at the largest speed; the fastest to either side go on
    turning.
    """
    arcs = settings.count - int(settings.stop and settings.count > 1)
    # What does not come out even goes to the speeds named last: a single arc must not be a turn on the spot.
    shares = np.array_split(np.arange(arcs), len(settings.speeds))[::-1]
    onward = max(settings.speeds)
    fan = []
    for speed, share in zip(settings.speeds, shares, strict=True):
        last = len(share) - 1
        for index, rate in enumerate(np.linspace(-settings.yaw_rate, settings.yaw_rate, last + 1) if last else [0.0]):
            rank = min(index, last - index)
            turning = _QUARTERS if speed or onward <= 0.0 or not rank else 2 + rank % 2
            fan.append([[speed, rate]] * turning + [[onward, 0.0]] * (_QUARTERS - turning))
    fan += [[[0.0, 0.0]] * _QUARTERS] * (settings.count - arcs)
    return np.array(fan)


def over_horizon(sequences: np.ndarray, before: np.ndarray, steps: int) -> np.ndarray:
    """Commands of candidates over a horizon, after the commands that led there.

    Args:
        sequences: commands that each candidate holds one after another, for equal shares of the horizon ``[N, K, 2]``.
        before: commands of the steps before the candidates begin ``[history, 2]``.
        steps: of the horizon from there on.

    Returns:
        ``[N, history + steps, 2]``.
    """
    led = np.broadcast_to(before, (len(sequences), *before.shape))
    share = np.arange(steps) * sequences.shape[1] // steps
    return np.concatenate([led, sequences[:, share]], axis=1)
