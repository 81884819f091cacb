"""Choice: which of the assessed candidates leads to a goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

FIELDS = ("x", "y", "heading", "speed", "yaw_rate", "cost", "feasible")
"""What must be known of each candidate."""


@dataclass(frozen=True)
class ChoiceWeights:
    """What counts how much."""

    cost: float = 1.0
    distance: float = 3.0
    """Of the distance left to the goal, over how far any candidate comes."""
    heading: float = 1.0
    """Of the angle between the last heading and the goal, over half a turn."""


def choose(
    candidates: Mapping[str, np.ndarray],
    robot: np.ndarray,
    goal: np.ndarray,
    weights: ChoiceWeights = ChoiceWeights(),
) -> int | None:
    """Index of the best feasible candidate; None where there is none.

    Args:
        candidates: :data:`FIELDS`, each ``[N]``; places and headings in the odometry frame.
        robot: where the robot is ``[2]`` [m].
        goal: where it shall go ``[2]`` [m].

    Raises:
        ValueError: a field is missing.
    """
    missing = [name for name in FIELDS if name not in candidates]
    if missing:
        raise ValueError(f"candidates: fields {missing} are missing; got {sorted(candidates)}")
    feasible = (candidates["feasible"] > 0.5) & np.isfinite(candidates["cost"])
    if not feasible.any():
        return None
    end = np.column_stack([candidates["x"], candidates["y"]])
    left = np.linalg.norm(goal - end, axis=1)
    reach = max(float(np.linalg.norm(end - robot, axis=1).max()), 0.1)
    towards = np.arctan2(goal[1] - end[:, 1], goal[0] - end[:, 0])
    off = np.abs((candidates["heading"] - towards + np.pi) % (2.0 * np.pi) - np.pi) / np.pi
    # A candidate that comes to the goal itself may look anywhere.
    off = np.where(left < 0.3, 0.0, off)
    score = weights.cost * candidates["cost"] + weights.distance * left / reach + weights.heading * off
    return int(np.where(feasible, score, np.inf).argmin())
