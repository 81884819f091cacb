"""Motion regimes by which errors are grouped, in the running node and in ``diagnose``."""

from __future__ import annotations

import numpy as np

TURNING_RATE, STRAIGHT_RATE = 0.3, 0.1
"""Mean commanded yaw rate above which a window is a turn, and below which it is straight [rad/s]."""
STANDING_SPEED, STANDING_RATE = 0.05, 0.05
"""A robot is standing below both [m/s, rad/s]."""
FAST_SHARE = 0.6
"""Share of the robot's top speed above which motion is fast."""
SPEED_CHANGE = 0.3
"""Sum of changes of the commanded speed above which a window is changing speed [m/s]."""


def motion_regimes(twists: np.ndarray, fast: float) -> dict[str, np.ndarray]:
    """Regimes of windows from their commands; a window may be in several.

    Args:
        twists: forward speed [m/s] and yaw rate [rad/s] over each window ``[..., T, 2]``.
        fast: mean speed above which a window is fast [m/s].

    Returns:
        masks ``[...]`` by name of the regime.
    """
    speed, rate = twists[..., 0].mean(axis=-1), twists[..., 1].mean(axis=-1)
    size, turning = np.abs(twists[..., 0]).mean(axis=-1), np.abs(twists[..., 1]).mean(axis=-1)
    turns = turning > TURNING_RATE
    return {
        "turning": turns,
        # Turns one way round for most of a window.
        "turning left": turns & (rate > 0.5 * TURNING_RATE),
        "turning right": turns & (rate < -0.5 * TURNING_RATE),
        "straight": (turning < STRAIGHT_RATE) & (size > STANDING_SPEED),
        "reversing": speed < -STANDING_SPEED,
        "fast": size > fast,
        "changing speed": np.abs(np.diff(twists[..., 0], axis=-1)).sum(axis=-1) > SPEED_CHANGE,
        "standing": (size < STANDING_SPEED) & (turning < STANDING_RATE),
    }
