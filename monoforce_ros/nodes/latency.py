"""Latency: how long after their sensor data results are published, as measured while the node runs."""

from __future__ import annotations

from collections import deque

import numpy as np

LARGEST = 1.0
"""Largest latency that candidates wait for [s]: what was measured longer ago says too little about where to drive."""
_COUNT = 10
"""Number of recent latencies whose median counts: two seconds of a prediction at 5 Hz."""


class Latency:
    """Median of the recent latencies; a single slow result changes nothing."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_COUNT)

    def add(self, seconds: float) -> None:
        """Add a latency [s]; negative ones, as of a clock that was set back, are left out."""
        if np.isfinite(seconds) and seconds >= 0.0:
            self._recent.append(seconds)

    @property
    def typical(self) -> float:
        """Median of the recent latencies, up to :data:`LARGEST` [s]; 0 before the first ones."""
        # The first result loads kernels.
        return min(float(np.median(self._recent)), LARGEST) if len(self._recent) > 2 else 0.0
