"""Following a plan: the point on a global planner's path to head for next."""

from __future__ import annotations

import numpy as np


def plan_target(plan: np.ndarray, robot: np.ndarray, lookahead: float) -> tuple[np.ndarray, float]:
    """The point of a path that lies ``lookahead`` beyond the point nearest to the robot.

    Of a path that comes near the robot more than once, the part nearest to its start counts, within 0.1 m: a robot that
    follows a loop must not skip it.

    Args:
        plan: positions ``[n, 2]`` [m], n ≥ 1.
        robot: position ``[2]`` [m].
        lookahead: distance along the path [m].

    Returns:
        the point ``[2]`` [m], at most the end of the path, and the length of the path from the nearest point to its
        end [m].

    Raises:
        ValueError: the plan is empty or not finite.
    """
    if plan.ndim != 2 or plan.shape[1] != 2 or not len(plan) or not np.isfinite(plan).all():
        raise ValueError(f"plan: got shape {plan.shape}, expected at least one finite position [n, 2]")
    if len(plan) == 1:
        return plan[0], 0.0
    start, step = plan[:-1], np.diff(plan, axis=0)
    length = np.linalg.norm(step, axis=1)
    share = np.clip(((robot - start) * step).sum(axis=1) / np.maximum(length, 1e-9) ** 2, 0.0, 1.0)
    distance = np.linalg.norm(start + share[:, None] * step - robot, axis=1)
    nearest = int(np.argmax(distance <= distance.min() + 0.1))
    along = np.concatenate([[0.0], np.cumsum(length)])
    # Within the tolerance the first segment is taken, but its nearest segment before the distance grows again.
    while nearest + 1 < len(distance) and distance[nearest + 1] < distance[nearest]:
        nearest += 1
    here = along[nearest] + share[nearest] * length[nearest]
    ahead = min(here + lookahead, along[-1])
    return np.array([np.interp(ahead, along, plan[:, axis]) for axis in (0, 1)]), float(along[-1] - here)
