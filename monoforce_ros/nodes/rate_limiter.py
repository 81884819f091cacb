"""RateLimiter: which inputs are used where more come than the largest rate allows."""

from __future__ import annotations

_EARLY = 0.25
"""Share of a period by which an input may come before its time: sensors jitter about their rate."""


class RateLimiter:
    """Leaves inputs out rather than make them wait: what is used is fresh.

    Sleeping between inputs would delay each by what the one before came late.
    """

    def __init__(self):
        self._next = 0.0

    def due(self, now: float, rate: float) -> bool:
        """Whether an input that came at ``now`` [s] is to be used, with at most ``rate`` [Hz] of them on average."""
        period = 1.0 / rate
        if now < self._next - _EARLY * period:
            return False
        self._next = max(self._next, now - period) + period
        return True
