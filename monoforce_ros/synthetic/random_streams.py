"""Random streams: one independent generator for each purpose."""

from __future__ import annotations

import numpy as np

DEFAULT_SEED = 12
"""The world that shows most within ten seconds: stones, grass, trees, and the ramp at the end."""


def random_stream(seed: int, purpose: str) -> np.random.Generator:
    """A generator that depends on the seed and the purpose alone.

    With one generator for everything, a changed camera setting would change the trajectory.
    """
    return np.random.default_rng([seed, *purpose.encode()])
