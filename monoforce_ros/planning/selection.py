"""Choice: which of the assessed candidates leads to a goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from monoforce_ros.core import wrap_angle
from monoforce_ros.planning.goal_planner import CostToGo

WAYPOINTS = (25, 50, 75)
"""Shares of the horizon at which a candidate's place is known beside its end [%]."""
_LOOK = 0.5
"""Length of a look ahead [m]."""
_NEARER = 0.1
"""What a candidate must gain of the way to be better than standing [m]."""
FIELDS = (
    *("x", "y", "heading", "speed", "yaw_rate", "cost", "feasible"),
    *(f"{axis}_{share}" for share in WAYPOINTS for axis in "xy"),
)
"""What must be known of each candidate."""


@dataclass(frozen=True)
class SelectionWeights:
    """What counts how much."""

    cost: float = 1.0
    distance: float = 3.0
    """Of how near to the goal a candidate comes, over how far any comes."""
    heading: float = 1.0
    """Of the angle between the last heading and the goal, over half a turn."""
    clearance: float = 1.0
    """Of how near to what is lethal a candidate comes, 0 to 1, on the average of the places where it is looked at."""
    change: float = 0.5
    """Of how far a candidate's command is from the former one, over the largest among the candidates: of two ways that
    are about as good a robot must keep to one."""


def select_candidate(
    candidates: Mapping[str, np.ndarray],
    robot: np.ndarray,
    goal: np.ndarray,
    weights: SelectionWeights = SelectionWeights(),
    ways: CostToGo | None = None,
    former: tuple[float, float] | None = None,
) -> int | None:
    """Index of the best feasible candidate; None where there is none.

    Args:
        candidates: :data:`FIELDS`, each ``[N]``; places and headings in the odometry frame.
        robot: where the robot is ``[2]`` [m].
        goal: where it shall go ``[2]`` [m].
        weights: of cost, distance, heading and clearance.
        ways: to the goal around obstacles; without them distances are straight.
        former: forward speed [m/s] and yaw rate [rad/s] that the robot was told last.

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
    way = [np.broadcast_to(robot, end.shape)]
    way += [np.column_stack([candidates[f"x_{share}"], candidates[f"y_{share}"]]) for share in WAYPOINTS]
    nearest, at_end = _nearest(np.stack([*way, end], axis=1), goal)
    if ways is not None:
        # How far it still is from the best place on the way; a candidate that reaches the goal itself keeps its own.
        left = np.stack([ways.at(place) for place in way[1:]] + [ways.at(end)], axis=1)
        nearest, at_end = np.minimum(left.min(axis=1), np.where(nearest < _LOOK, nearest, np.inf)), nearest >= _LOOK
    reach = max(float(np.linalg.norm(end - robot, axis=1).max()), 0.1)
    towards = np.arctan2(goal[1] - end[:, 1], goal[0] - end[:, 0])
    off = np.abs(wrap_angle(candidates["heading"] - towards)) / np.pi
    if ways is not None:
        # Where the way is not straight, looking along it counts: by how much half a metre ahead would shorten it.
        ahead = end + _LOOK * np.column_stack([np.cos(candidates["heading"]), np.sin(candidates["heading"])])
        off = np.clip(0.5 * (1.0 - (ways.at(end) - ways.at(ahead)) / _LOOK), 0.0, 1.0)
    # A candidate that passes the goal may look anywhere.
    off = np.where(at_end, off, 0.0)
    close = 0.0 if ways is None else np.mean([ways.near(place) for place in (*way[1:], end)], axis=0)
    # To stand leads nowhere, and tomorrow as little as today: only where nothing feasible leads nearer.
    here = float(np.linalg.norm(robot - goal)) if ways is None else float(ways.at(robot))
    standing = (np.abs(candidates["speed"]) < 1e-6) & (np.abs(candidates["yaw_rate"]) < 1e-6)
    if (feasible & ~standing & (here - nearest > _NEARER)).any():
        feasible = feasible & ~standing
    score = weights.cost * candidates["cost"] + weights.distance * nearest / reach + weights.heading * off
    score = score + weights.clearance * close
    if former is not None:
        asked = np.column_stack([candidates["speed"], candidates["yaw_rate"]])
        largest = np.maximum(np.abs(asked).max(axis=0), 1e-6)
        score = score + weights.change * (np.abs(asked - former) / largest).mean(axis=1)
    return int(np.where(feasible, score, np.inf).argmin())


def _nearest(ways: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least distance of each polyline ``[N, K, 2]`` to the goal [m], and whether that is at its end; each ``[N]``."""
    start, step = ways[:, :-1], np.diff(ways, axis=1)
    length = np.maximum((step**2).sum(axis=2), 1e-12)
    along = np.clip(((goal - start) * step).sum(axis=2) / length, 0.0, 1.0)
    away = np.linalg.norm(start + along[..., None] * step - goal, axis=2)
    nearest = away.min(axis=1)
    end = np.linalg.norm(ways[:, -1] - goal, axis=1)
    return nearest, end <= nearest + 1e-6
