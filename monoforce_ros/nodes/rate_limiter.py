"""RateLimiter: selects which inputs are used if they arrive faster than the largest rate allows."""

from __future__ import annotations

_EARLY = 0.25
"""Share of a period by which an input may be early: sensors jitter about their rate."""


class RateLimiter:
    """Skips inputs instead of delaying them, so that used inputs are fresh.

    Sleeping between inputs would add the lateness of each input to the next one.
    """

    def __init__(self) -> None:
        self._next = 0.0

    def due(self, now: float, rate: float) -> bool:
        """Whether to use an input that arrived at ``now`` [s], for at most ``rate`` [Hz] inputs on average."""
        period = 1.0 / rate
        if now < self._next - _EARLY * period:
            return False
        self._next = max(self._next, now - period) + period
        return True
