"""Candidates: command sequences to choose from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CandidateSettings:
    """A fan of arcs."""

    count: int = 32
    speeds: tuple[float, ...] = (0.4, 0.8)
    """Forward speeds [m/s]; candidates are shared out among them."""
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
    """Forward speed [m/s] and yaw rate [rad/s] of each candidate, ``[count, 2]``, held over the horizon.

    Yaw rates are spread evenly from right to left; straight on is among them where a speed has an odd number of arcs.
    """
    arcs = settings.count - int(settings.stop and settings.count > 1)
    shares = np.array_split(np.arange(arcs), len(settings.speeds))
    fan = [
        [speed, rate]
        for speed, share in zip(settings.speeds, shares, strict=True)
        for rate in (np.linspace(-settings.yaw_rate, settings.yaw_rate, len(share)) if len(share) > 1 else [0.0])
        if len(share)
    ]
    fan += [[0.0, 0.0]] * (settings.count - arcs)
    return np.array(fan)


def over_horizon(sequences: np.ndarray, before: np.ndarray, steps: int) -> np.ndarray:
    """Commands of candidates over a horizon, after the commands that led to now.

    Args:
        sequences: commands that each candidate holds one after another, for equal shares of the horizon ``[N, K, 2]``.
        before: commands of the steps before now ``[history, 2]``.
        steps: of the horizon.

    Returns:
        ``[N, history + steps, 2]``.
    """
    led = np.broadcast_to(before, (len(sequences), *before.shape))
    share = np.arange(steps) * sequences.shape[1] // steps
    return np.concatenate([led, sequences[:, share]], axis=1)
