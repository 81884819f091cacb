"""Random streams: an independent generator for each purpose."""

from __future__ import annotations

import numpy as np

DEFAULT_SEED = 12
"""A world with stones, grass, trees and the ramp within the first ten seconds."""


def random_stream(seed: int, purpose: str) -> np.random.Generator:
    """A generator that depends only on the seed and the purpose.

    With a single generator, a changed camera setting would change the trajectory.
    """
    return np.random.default_rng([seed, *purpose.encode()])
