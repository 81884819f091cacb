"""Selection: which of the assessed candidates to execute on the way to a goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from monoforce_ros.core import LARGEST_COMMAND, wrap_angle
from monoforce_ros.planning.goal_planner import CostToGo

WAYPOINTS = (25, 50, 75)
"""Shares of the horizon at which candidates report their position, besides its end [%]."""
_LOOKAHEAD = 0.5
"""Lookahead distance [m]."""
_PROGRESS = 0.1
"""Smallest progress towards the goal for which a candidate is better than standing [m]."""
COMMAND_FIELDS = ("speed", "yaw_rate", "lateral_speed")
"""Fields of a candidate's command; the last one only of robots that move sideways."""
FIELDS = (
    *("x", "y", "heading", "speed", "yaw_rate", "cost", "feasible"),
    *(f"{axis}_{share}" for share in WAYPOINTS for axis in "xy"),
)
"""Required fields of the candidates."""


@dataclass(frozen=True)
class SelectionWeights:
    """Weights of the criteria of a selection."""

    cost: float = 1.0
    """Weight of the candidate's own cost."""
    distance: float = 3.0
    """Weight of the remaining path length to the goal, over the largest distance that a candidate covers."""
    heading: float = 1.0
    """Weight of the angle between the final heading and the goal, over half a turn."""
    clearance: float = 1.0
    """Weight of the proximity of lethal cells, 0 to 1, averaged over the waypoints."""
    change: float = 0.5
    """Weight of the difference from the previous command, over the largest command of all candidates. It keeps the
    robot from alternating between two similarly good paths."""


def select_candidate(
    candidates: Mapping[str, np.ndarray],
    robot: np.ndarray,
    goal: np.ndarray,
    weights: SelectionWeights = SelectionWeights(),
    cost_to_go: CostToGo | None = None,
    previous_command: tuple[float, ...] | None = None,
) -> int | None:
    """Index of the best feasible candidate; None without a feasible one.

    Candidates with values that are not finite or commands above :data:`LARGEST_COMMAND` are left out.

    Args:
        candidates: :data:`FIELDS` and, of robots that move sideways, ``lateral_speed``, each ``[N]``; positions and
            headings in the odometry frame.
        robot: position of the robot ``[2]`` [m].
        goal: position of the goal ``[2]`` [m].
        weights: weights of the criteria.
        cost_to_go: path lengths to the goal around obstacles; without it, straight distances are used.
        previous_command: forward speed [m/s] and yaw rate [rad/s] of the last command, and its lateral speed [m/s] if
            the candidates have one.

    Raises:
        ValueError: a field is missing.
    """
    missing = [name for name in FIELDS if name not in candidates]
    if missing:
        raise ValueError(f"candidates: fields {missing} are missing; got {sorted(candidates)}")
    names = [*FIELDS, *(name for name in COMMAND_FIELDS if name in candidates and name not in FIELDS)]
    finite = np.all([np.isfinite(candidates[name]) for name in names if name != "cost"], axis=0)
    sane = np.all([np.abs(candidates[name]) <= LARGEST_COMMAND for name in names if name in COMMAND_FIELDS], axis=0)
    usable = np.flatnonzero(finite & sane)
    if len(usable) < len(finite):
        # A diverged rollout has no place; its values would spoil the scores of all others.
        rest = {name: values[usable] for name, values in candidates.items()}
        found = select_candidate(rest, robot, goal, weights, cost_to_go, previous_command) if len(usable) else None
        return None if found is None else int(usable[found])
    feasible = (candidates["feasible"] > 0.5) & np.isfinite(candidates["cost"])
    if not feasible.any():
        return None
    end = np.column_stack([candidates["x"], candidates["y"]])
    path = [np.broadcast_to(robot, end.shape)]
    path += [np.column_stack([candidates[f"x_{share}"], candidates[f"y_{share}"]]) for share in WAYPOINTS]
    path.append(end)
    remaining, nearest_at_end = _nearest(np.stack(path, axis=1), goal)
    towards = np.arctan2(goal[1] - end[:, 1], goal[0] - end[:, 0])
    misalignment = np.abs(wrap_angle(candidates["heading"] - towards)) / np.pi
    proximity = np.zeros(len(end))
    start = float(np.linalg.norm(robot - goal))
    if cost_to_go is not None:
        # The remaining path length from the best waypoint; a candidate that reaches the goal keeps its distance.
        from_waypoints = np.stack([cost_to_go.at(place) for place in path[1:]], axis=1)
        reaches_goal = remaining < _LOOKAHEAD
        remaining = np.minimum(from_waypoints.min(axis=1), np.where(reaches_goal, remaining, np.inf))
        nearest_at_end = ~reaches_goal
        # Paths may bend: instead of the direction of the goal, use the progress that moving straight on would make.
        heading = np.column_stack([np.cos(candidates["heading"]), np.sin(candidates["heading"])])
        progress = (cost_to_go.at(end) - cost_to_go.at(end + _LOOKAHEAD * heading)) / _LOOKAHEAD
        misalignment = np.clip(0.5 * (1.0 - progress), 0.0, 1.0)
        proximity = np.mean([cost_to_go.proximity_at(place) for place in path[1:]], axis=0)
        start = float(cost_to_go.at(robot))
    # The final heading of a candidate that passes the goal does not matter.
    misalignment = np.where(nearest_at_end, misalignment, 0.0)
    # Standing makes no progress; allow it only if no feasible candidate does.
    commands = np.column_stack([candidates[name] for name in COMMAND_FIELDS if name in candidates])
    standing = (np.abs(commands) < 1e-6).all(axis=1)
    if (feasible & ~standing & (start - remaining > _PROGRESS)).any():
        feasible = feasible & ~standing
    reach = max(float(np.linalg.norm(end - robot, axis=1).max()), 0.1)
    score = weights.cost * candidates["cost"] + weights.distance * remaining / reach
    score = score + weights.heading * misalignment + weights.clearance * proximity
    if previous_command is not None:
        largest = np.maximum(np.abs(commands).max(axis=0), 1e-6)
        previous = np.resize([*previous_command, 0.0], commands.shape[1])
        score = score + weights.change * (np.abs(commands - previous) / largest).mean(axis=1)
    score = np.where(feasible, score, np.inf)
    best = int(score.argmin())
    # A goal at an astronomical distance makes all scores infinite.
    return best if np.isfinite(score[best]) else None


def _nearest(paths: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest distance of each polyline ``[N, K, 2]`` to the goal [m], and whether it is at the end; each ``[N]``."""
    start, step = paths[:, :-1], np.diff(paths, axis=1)
    length = np.maximum((step**2).sum(axis=2), 1e-12)
    along = np.clip(((goal - start) * step).sum(axis=2) / length, 0.0, 1.0)
    distance = np.linalg.norm(start + along[..., None] * step - goal, axis=2)
    nearest = distance.min(axis=1)
    at_end = np.linalg.norm(paths[:, -1] - goal, axis=1)
    return nearest, at_end <= nearest + 1e-6
