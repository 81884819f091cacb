"""Refinement: gradient descent on a candidate's commands, through the rollout."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.planning.candidates import over_horizon
from monoforce_ros.planning.costs import Assessment, CostWeights, Limits, assess, force_every
from monoforce_ros.prediction import Prediction, Predictor, start_states

_KNOTS = 10
"""Number of times at which commands change; linear in between."""
_STRIDES = (0.2, 0.05, 0.0125)
"""Step lengths of the line search, as the largest change at a knot [m/s, rad/s]."""
_COMPONENTS = ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0))
"""Search directions: speed and yaw rate together and each alone, since the cost is much steeper in one of them."""
_END_WEIGHT = 4.0
"""Weight of the squared displacement of the end, over the distance driven: a cheaper path to the same place is wanted,
not standing still."""
_MAXIMUM_ROUNDS = 40


@dataclass(frozen=True)
class Refinement:
    """A refined candidate."""

    sequence: np.ndarray
    """Forward speed [m/s] and yaw rate [rad/s] of each step after the start of the candidate ``[T, 2]``."""
    cost_before: float
    cost: float
    """Weighted sum of the cost terms, without the penalty on displacing the end."""
    rounds: int
    """Number of gradient steps."""
    round_seconds: float
    """Duration of the slowest round; 0 without any [s]."""


def refine(
    predictor: Predictor,
    prediction: Prediction,
    before: np.ndarray,
    sequence: np.ndarray,
    *,
    weights: CostWeights = CostWeights(),  # noqa: B008  (frozen)
    limits: Limits = Limits(),  # noqa: B008  (frozen)
    seconds: float = 0.1,
    round_seconds: float = 0.0,
) -> Refinement:
    """Reduce the cost of a feasible candidate by gradient descent through the rollout, with its end kept in place.

    Each round computes one gradient and evaluates several steps along it as a batch. The best feasible one is kept, so
    that the cost never increases.

    Args:
        predictor: robot and physics of the rollouts.
        prediction: provides the map and the start state.
        before: commands before the candidate ``[history, 2]``; longer if the candidate starts later.
        sequence: commands for equal shares of the rest of the horizon ``[K, 2]``.
        weights: weights of the cost terms.
        limits: limits of the cost terms.
        seconds: time budget; no round starts that would probably exceed it [s].
        round_seconds: duration of a round on this machine, from an earlier refinement [s].
    """
    started = time.monotonic()
    steps, robot = predictor.history + predictor.steps - len(before), predictor.robot
    every = force_every(predictor.options.time_step)
    base = torch.from_numpy(over_horizon(sequence[None], np.zeros((0, 2)), steps)[0]).float()
    history = torch.from_numpy(np.ascontiguousarray(before)).float()
    bound = torch.tensor([robot.maximum_speed, robot.maximum_yaw_rate]).clamp(max=1e3)
    # Within the robot's limits, and not far beyond the candidate's commands.
    bound = torch.minimum(bound, 1.25 * base.abs().amax(dim=0) + 0.2)
    place = torch.linspace(0, _KNOTS - 1, steps)
    low = place.floor().long().clamp(max=_KNOTS - 2)
    share = (place - low)[:, None]

    def commands(change: Tensor) -> Tensor:
        """``[B, T, 2]`` of changes at the knots ``[B, K, 2]``."""
        return (base + (1 - share) * change[:, low] + share * change[:, low + 1]).clamp(-bound, bound)

    def score(change: Tensor) -> tuple[Tensor, Assessment]:
        twists = torch.cat([history.expand(len(change), -1, -1), commands(change)], dim=1)
        motions = [prediction.motion] * len(change)
        rolled = predictor.differentiable_roll_out(
            prediction.terrain, motions, twists, start_states(motions), robot, with_forces=False,
            with_contact=True, force_every=every, joints=prediction.joints,
        )  # fmt: skip
        found = assess(
            rolled, prediction.terrain, robot, twists[:, predictor.history :], weights=weights, limits=limits
        )
        return rolled.position[:, -1], found

    change = torch.zeros(1, _KNOTS, 2)
    with torch.no_grad():
        end, found = score(change)
    cost_before = best = best_cost = float(found.cost)
    reach = float((end[0] - end.new_zeros(3)).norm().clamp_min(0.5))
    count = 0
    if not bool(found.feasible):
        return Refinement(base.numpy().astype(np.float64), cost_before, cost_before, 0, 0.0)
    slowest = 0.0
    while count < _MAXIMUM_ROUNDS and time.monotonic() - started + max(slowest, round_seconds) < seconds:
        round_started = time.monotonic()
        leaf = change.clone().requires_grad_()
        place_now, found = score(leaf)
        total = found.cost + _END_WEIGHT * ((place_now - end) / reach).square().sum(dim=1)
        (gradient,) = torch.autograd.grad(total.sum(), leaf)
        if not bool(torch.isfinite(gradient).all()):
            break
        with torch.no_grad():
            tried = change - _steps_along(gradient[0])
            place_now, found = score(tried)
            totals = found.cost + _END_WEIGHT * ((place_now - end) / reach).square().sum(dim=1)
            totals = torch.where(found.feasible & torch.isfinite(totals), totals, torch.inf)
            index = int(totals.argmin())
        count += 1
        slowest = max(slowest, time.monotonic() - round_started)
        if not float(totals[index]) < best - 1e-6:
            break
        best, best_cost, change = float(totals[index]), float(found.cost[index]), tried[index : index + 1]
    sequence = commands(change)[0].detach().numpy().astype(np.float64)
    return Refinement(sequence, cost_before, best_cost, count, slowest)


def _steps_along(gradient: Tensor) -> Tensor:
    """Steps ``[B, K, 2]`` of the line search: each length along the gradient of both commands and of each alone."""
    directions = []
    for mask in _COMPONENTS:
        direction = gradient * torch.tensor(mask)
        directions.append(direction / direction.abs().amax().clamp_min(1e-12))
        # The signs move every knot, not only the steepest.
        directions.append(direction.sign())
    return (torch.stack(directions)[:, None] * torch.tensor(_STRIDES)[None, :, None, None]).flatten(0, 1)
