"""Refinement: a candidate's commands improved by the gradient of its cost through the rollout."""

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
"""Commands are changed at so many times, linearly between them."""
_STRIDES = (0.2, 0.05, 0.0125)
"""Tried step lengths [m/s, rad/s at the knot that changes most]."""
_ALONE = ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0))
"""Speed and yaw rate are changed together and each alone: the cost is far steeper in one than in the other."""
_STAY = 4.0
"""Weight of the squared distance between the old end and the new, over the way driven: a cheaper way to the same place,
not standing still."""
_MOST = 40


@dataclass(frozen=True)
class Refinement:
    """A candidate before and after."""

    sequence: np.ndarray
    """Forward speed [m/s] and yaw rate [rad/s] of each step from where the candidate begins ``[T, 2]``."""
    cost_before: float
    cost: float
    """Weighted terms; what keeps the end in place is not in it."""
    rounds: int
    round_seconds: float
    """The longest round took; 0 without any [s]."""


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
    """Lower a feasible candidate's cost by descending through the rollout, with its end kept where it is.

    Each round takes one gradient and tries several steps along it at once; the best that is feasible is kept, so that
    the result never costs more than what was given.

    Args:
        predictor: rolls out.
        prediction: whose map and start are used.
        before: commands that led there, ``[history, 2]`` or longer where the candidate begins later.
        sequence: commands of equal shares of the rest of the horizon ``[K, 2]``.
        weights: of the cost.
        limits: of what is feasible.
        seconds: budget; no round begins that would likely exceed it.
        round_seconds: how long a round takes on this machine, from an earlier refinement.
    """
    started = time.monotonic()
    steps, robot = predictor.history + predictor.steps - len(before), predictor.robot
    every = force_every(predictor.options.time_step)
    base = torch.from_numpy(over_horizon(sequence[None], np.zeros((0, 2)), steps)[0]).float()
    led = torch.from_numpy(np.ascontiguousarray(before)).float()
    bound = torch.tensor([robot.maximum_speed, robot.maximum_yaw_rate]).clamp(max=1e3)
    # Never beyond what the robot takes, nor far beyond what the candidate asks for.
    bound = torch.minimum(bound, 1.25 * base.abs().amax(dim=0) + 0.2)
    place = torch.linspace(0, _KNOTS - 1, steps)
    low = place.floor().long().clamp(max=_KNOTS - 2)
    share = (place - low)[:, None]

    def commands(change: Tensor) -> Tensor:
        """``[B, T, 2]`` of changes at the knots ``[B, K, 2]``."""
        return (base + (1 - share) * change[:, low] + share * change[:, low + 1]).clamp(-bound, bound)

    def score(change: Tensor) -> tuple[Tensor, Assessment]:
        twists = torch.cat([led.expand(len(change), -1, -1), commands(change)], dim=1)
        asked = twists[:, predictor.history :]
        motions = [prediction.motion] * len(change)
        rolled = predictor.differentiable_roll_out(
            prediction.terrain, motions, twists, start_states(motions), robot, with_forces=False,
            with_contact=True, force_every=every,
        )  # fmt: skip
        found = assess(rolled, prediction.terrain, robot, asked, weights=weights, limits=limits)
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
    while count < _MOST and time.monotonic() - started + max(slowest, round_seconds) < seconds:
        round_started = time.monotonic()
        leaf = change.clone().requires_grad_()
        place_now, found = score(leaf)
        total = found.cost + _STAY * ((place_now - end) / reach).square().sum(dim=1)
        (gradient,) = torch.autograd.grad(total.sum(), leaf)
        if not bool(torch.isfinite(gradient).all()):
            break
        with torch.no_grad():
            tried = change - _steps_along(gradient[0])
            place_now, found = score(tried)
            totals = found.cost + _STAY * ((place_now - end) / reach).square().sum(dim=1)
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
    """Steps ``[B, K, 2]`` to try: each length along the gradient, of both commands and of each."""
    directions = []
    for kept in _ALONE:
        direction = gradient * torch.tensor(kept)
        directions.append(direction / direction.abs().amax().clamp_min(1e-12))
        # The signs alone move every knot, not just the steepest.
        directions.append(direction.sign())
    return (torch.stack(directions)[:, None] * torch.tensor(_STRIDES)[None, :, None, None]).flatten(0, 1)
