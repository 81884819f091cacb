"""Robust statistics."""

from __future__ import annotations

import numpy as np


def huber(scaled: np.ndarray, delta: float) -> np.ndarray:
    """Huber's loss of residuals in units of their scale: quadratic up to ``delta``, linear beyond (Huber 1964)."""
    size = np.abs(scaled)
    return np.where(size <= delta, 0.5 * size**2, delta * (size - 0.5 * delta))
