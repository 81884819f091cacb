"""Candidates: command sequences for a planner to select from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_QUARTERS = 4
_FEWEST = 6
"""Candidates from which on some move sideways."""


@dataclass(frozen=True)
class CandidateSettings:
    """Settings of a fan of arcs and of turns in place followed by driving straight."""

    count: int = 32
    speeds: tuple[float, ...] = (0.4, 0.8)
    """Forward speeds [m/s], among which the candidates are divided. At 0 the robot turns in place; one that cannot
    backs out along arcs instead."""
    yaw_rate: float = 0.8
    """Largest yaw rate [rad/s]."""
    curvature: float = float("inf")
    """Largest curvature that the steering reaches [1/m]; infinite for a robot that turns in place."""
    stop: bool = True
    """Add standing still as the last candidate."""
    lateral: float = 0.0
    """Lateral speed of the candidates that move sideways [m/s]; 0 for a robot that cannot."""

    def __post_init__(self):
        if not 1 <= self.count <= 4096:
            raise ValueError(f"candidates: got {self.count}, expected 1 to 4096")
        if not self.speeds or not all(np.isfinite(v) and abs(v) <= 20.0 for v in self.speeds):
            raise ValueError(f"candidate speeds: got {list(self.speeds)}, expected finite speeds up to 20 m/s")
        if not 0.0 <= self.yaw_rate <= 10.0:
            raise ValueError(f"candidate yaw rate: got {self.yaw_rate}, expected 0 to 10 rad/s")
        if not 0.0 <= self.lateral <= 20.0:
            raise ValueError(f"candidate lateral speed: got {self.lateral}, expected 0 to 20 m/s")
        if not self.curvature >= 0.0:
            raise ValueError(f"candidate curvature: got {self.curvature}, expected 0 or more, in 1/m")


def fan_of_arcs(settings: CandidateSettings) -> np.ndarray:
    """Forward speed [m/s] and yaw rate [rad/s] of each candidate over four quarters of the horizon, ``[count, 4, 2]``.

    Of a robot that moves sideways also the lateral speed [m/s], ``[count, 4, 3]``.

    Each arc holds one yaw rate; the rates are evenly spaced from right to left, and include 0 for a speed with an odd
    number of arcs. A robot in front of a wall must first turn and then drive: turns in place last half or three
    quarters of the horizon, alternately, and continue straight at the largest speed; the fastest turns to either side
    last the whole horizon. A robot that cannot turn in place reverses instead, at its lowest speed. One that moves
    sideways does so to either side, alone and at the largest forward speed: two or, of 12 candidates or more, four.
    """
    arcs = settings.count - int(settings.stop and settings.count > 1)
    sideways = 0 if not settings.lateral or settings.count < _FEWEST else 4 if settings.count >= 2 * _FEWEST else 2
    arcs -= sideways
    # Assign a remainder to the last speeds: a single arc must not be a turn in place.
    shares = np.array_split(np.arange(arcs), len(settings.speeds))[::-1]
    fastest = max(settings.speeds)
    moving = [abs(speed) for speed in settings.speeds if speed]
    turns_in_place = np.isinf(settings.curvature)
    fan = []
    for speed, share in zip(settings.speeds, shares, strict=True):
        first = speed if speed or turns_in_place or not moving else -min(moving)
        limit = settings.yaw_rate if turns_in_place else min(settings.yaw_rate, abs(first) * settings.curvature)
        last = len(share) - 1
        for index, rate in enumerate(np.linspace(-limit, limit, last + 1) if last else [0.0]):
            rank = min(index, last - index)
            turning = _QUARTERS if speed or fastest <= 0.0 or not rank else 2 + rank % 2
            fan.append([[first, rate]] * turning + [[fastest, 0.0]] * (_QUARTERS - turning))
    standing = settings.count - arcs - sideways
    if not settings.lateral:
        return np.array(fan + [[[0.0, 0.0]] * _QUARTERS] * standing)
    crabbing = [(speed, 0.0, side * settings.lateral) for speed in (0.0, max(fastest, 0.0)) for side in (1.0, -1.0)]
    listed = [[[*command, 0.0] for command in quarters] for quarters in fan]
    listed += [[list(command)] * _QUARTERS for command in crabbing[:sideways]]
    return np.array(listed + [[[0.0] * 3] * _QUARTERS] * standing)


def over_horizon(sequences: np.ndarray, before: np.ndarray, steps: int) -> np.ndarray:
    """Commands of candidates over the horizon, with the commands before it.

    Args:
        sequences: consecutive commands of each candidate, for equal shares of the horizon ``[N, K, 2]`` or
            ``[N, K, 3]`` with lateral speeds.
        before: commands of the steps before the candidates start ``[history, 2]`` or ``[history, 3]``.
        steps: number of steps after that.

    Returns:
        ``[N, history + steps, 2]`` or ``[N, history + steps, 3]``.
    """
    history = np.broadcast_to(before, (len(sequences), *before.shape))
    index = np.arange(steps) * sequences.shape[1] // steps
    return np.concatenate([history, sequences[:, index]], axis=1)
