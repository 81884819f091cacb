"""Refinement: gradient descent on a candidate's commands and flipper angles, through the rollout."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.physics import Rollout
from monoforce_ros.planning.candidates import over_horizon
from monoforce_ros.planning.costs import Assessment, CostWeights, Limits, assess, force_every
from monoforce_ros.prediction import Prediction, Predictor, start_states

_KNOTS = 10
"""Number of times at which commands change; linear in between."""
_STRIDES = (0.2, 0.05, 0.0125)
"""Step lengths of the line search, as the largest change at a knot [m/s, rad/s]."""
_FLIPPER_STRIDES = (0.2, 0.07, 0.025, 0.008, 0.0025, 0.0008)
"""The same for robots with flippers: on the edge of a step the cost falls only over a few thousandths of a radian."""
_FLIPPER_FACTOR = 2.0
"""Change of a flipper's angle [rad] in a step of the line search over that of a speed."""
_BUNDLE, _BUNDLE_SPREAD = 8, 0.03
"""Number of gradients that are averaged for flippers, at angles that differ by this standard deviation [rad]: on edges
a single gradient holds only for the next millimetre (randomised smoothing; Suh, Pang and Tedrake, "Bundled gradients
through contact via randomized smoothing", 2022)."""
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
    flippers: np.ndarray | None = None
    """Commanded angles of the flippers [rad] over the whole horizon, ``[delay + T, F]``; None without flippers."""


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
    flippers: np.ndarray | None = None,
    only_flippers: bool = False,
    standing: Rollout | None = None,
) -> Refinement:
    """Reduce the cost of a feasible candidate by gradient descent through the rollout, with its end kept in place.

    Angles of flippers are refined with the commands.

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
        flippers: commanded angles to start from, over the whole horizon ``[delay + T, F]`` [rad]; those before the
            start of the candidate stay. None: the prediction's.
        only_flippers: whether to keep speed and yaw rate as they are.
        standing: of a robot that stands, the rollout without commands ``[1]``; see :func:`assess`.
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

    program = _FlipperProgram.of(predictor, prediction, steps, flippers)

    def commands(change: Tensor) -> tuple[Tensor, Tensor]:
        """``[B, T, 2]`` and flipper angles ``[B, T, F]`` of changes at the knots ``[B, K, 2 + F]``."""
        along = (1 - share) * change[:, low] + share * change[:, low + 1]
        return (base + along[..., :2]).clamp(-bound, bound), program.changed(along[..., 2:])

    def score(change: Tensor) -> tuple[Tensor, Assessment]:
        commanded, angles = commands(change)
        twists = torch.cat([history.expand(len(change), -1, -1), commanded], dim=1)
        motions = [prediction.motion] * len(change)
        rolled = predictor.differentiable_roll_out(
            prediction.terrain, motions, twists, start_states(motions), robot, with_forces=False,
            with_contact=True, force_every=every, joints=prediction.joints, flippers=program.whole(angles),
        )  # fmt: skip
        found = assess(
            rolled, prediction.terrain, robot, twists[:, predictor.history :], weights=weights, limits=limits,
            standing=standing,
        )  # fmt: skip
        return rolled.position[:, -1], found

    def refinement(change: Tensor, cost: float, count: int, slowest: float) -> Refinement:
        with torch.no_grad():
            commanded, angles = commands(change)
            whole = program.whole(angles)
        sequence = commanded[0].numpy().astype(np.float64)
        found = None if whole is None else whole[0].numpy().astype(np.float64)
        return Refinement(sequence, cost_before, cost, count, slowest, found)

    change = torch.zeros(1, _KNOTS, 2 + program.count)
    with torch.no_grad():
        end, found = score(change)
    cost_before = best = best_cost = float(found.cost)
    reach = float((end[0] - end.new_zeros(3)).norm().clamp_min(0.5))
    count = 0
    if not bool(found.feasible):
        return refinement(change, cost_before, 0, 0.0)
    slowest = 0.0
    while count < _MAXIMUM_ROUNDS and time.monotonic() - started + max(slowest, round_seconds) < seconds:
        round_started = time.monotonic()
        leaf = program.bundle(change, count).requires_grad_()
        place_now, found = score(leaf)
        total = found.cost + _END_WEIGHT * ((place_now - end) / reach).square().sum(dim=1)
        (gradients,) = torch.autograd.grad(total.sum(), leaf)
        if only_flippers:
            gradients[..., :2] = 0.0
        if not bool(torch.isfinite(gradients).all()):
            break
        with torch.no_grad():
            steps_tried = [_steps_along(gradients[0])]
            if len(gradients) > 1:
                largest = gradients.abs().amax(dim=(1, 2), keepdim=True).clamp_min(1e-12)
                steps_tried.append(_steps_along(program.paired((gradients / largest).mean(dim=0))))
            tried = change - torch.cat(steps_tried)
            place_now, found = score(tried)
            totals = found.cost + _END_WEIGHT * ((place_now - end) / reach).square().sum(dim=1)
            totals = torch.where(found.feasible & torch.isfinite(totals), totals, torch.inf)
            index = int(totals.argmin())
        count += 1
        slowest = max(slowest, time.monotonic() - round_started)
        if not float(totals[index]) < best - 1e-6:
            break
        best, best_cost, change = float(totals[index]), float(found.cost[index]), tried[index : index + 1]
    return refinement(change, best_cost, count, slowest)


@dataclass(frozen=True)
class _FlipperProgram:
    """Commanded flipper angles over the horizon; none for a robot without flippers."""

    before: Tensor
    """Before the start of the candidate, ``[delay, F]`` [rad]."""
    base: Tensor
    """After it, ``[T, F]`` [rad]."""
    low: Tensor
    """Smallest angles, ``[F]`` [rad]."""
    high: Tensor
    pairs: Tensor
    """Averages over the flippers of the same end, ``[F, F]``."""

    @classmethod
    def of(cls, predictor: Predictor, prediction: Prediction, steps: int, given: np.ndarray | None) -> _FlipperProgram:
        """Angles of a prediction, or ``given`` ones ``[delay + T, F]``, of which the last ``steps`` change."""
        robot = predictor.robot
        angles, joints = robot.flipper_angles, robot.joints[len(robot.joints) - len(robot.flippers) :]
        if not joints or angles is None:
            return cls(torch.zeros(0, 0), torch.zeros(steps, 0), torch.zeros(0), torch.zeros(0), torch.zeros(0, 0))
        whole = angles.float().expand(predictor.steps, -1)
        if prediction.joints is not None:
            commanded_flippers = prediction.joints.flippers(1, predictor.steps, predictor.options.time_step)
            whole = whole if commanded_flippers is None else commanded_flippers[0]
        whole = whole if given is None else torch.as_tensor(given, dtype=torch.float32)
        if whole.shape != (predictor.steps, len(joints)):
            raise ValueError(f"flippers: got shape {tuple(whole.shape)}, expected [{predictor.steps}, {len(joints)}]")
        delay = predictor.steps - steps
        low, high = (torch.tensor([getattr(joint, name) for joint in joints]) for name in ("low", "high"))
        ends = [flipper.end for flipper in robot.flippers]
        same = torch.tensor([[float(one == other) for other in ends] for one in ends])
        return cls(whole[:delay], whole[delay:], low, high, same / same.sum(dim=0))

    @property
    def count(self) -> int:
        """Number of flippers."""
        return self.base.shape[1]

    def changed(self, change: Tensor) -> Tensor:
        """Angles ``[B, T, F]`` within the flippers' limits, from changes of the base."""
        return (self.base + change).clamp(self.low, self.high) if self.count else change

    def bundle(self, change: Tensor, seed: int) -> Tensor:
        """Changes ``[1, K, 2 + F]``, and with flippers others near them ``[B, K, 2 + F]``."""
        if not self.count:
            return change.clone()
        noise = torch.randn(_BUNDLE - 1, *change.shape[1:], generator=torch.Generator().manual_seed(seed))
        noise[..., :2] = 0.0
        return torch.cat([change, change + _BUNDLE_SPREAD * self.paired(noise)])

    def paired(self, values: Tensor) -> Tensor:
        """Values ``[..., 2 + F]`` with those of the flippers of each end averaged: unequal sides roll the robot."""
        return torch.cat([values[..., :2], values[..., 2:] @ self.pairs], dim=-1)

    def whole(self, angles: Tensor) -> Tensor | None:
        """Angles of the whole horizon ``[B, delay + T, F]``; None without flippers."""
        return torch.cat([self.before.expand(len(angles), -1, -1), angles], dim=1) if self.count else None


def _steps_along(gradient: Tensor) -> Tensor:
    """Steps ``[B, K, 2 + F]`` of the line search, from a gradient ``[K, 2 + F]``.

    Each length along the gradient of all commands and of speed, yaw rate and flippers alone, since the cost is much
    steeper in one of them.
    """
    columns = gradient.shape[1]
    parts = [slice(0, columns), slice(0, 1), slice(1, 2)] + ([slice(2, columns)] if columns > 2 else [])
    scale = gradient.new_tensor([1.0, 1.0] + [_FLIPPER_FACTOR] * (columns - 2))
    strides = gradient.new_tensor(_FLIPPER_STRIDES if columns > 2 else _STRIDES)
    directions = []
    for part in parts:
        direction = torch.zeros_like(gradient)
        direction[:, part] = gradient[:, part]
        directions.append(direction / direction.abs().amax().clamp_min(1e-12) * scale)
        # The signs move every knot, not only the steepest.
        directions.append(direction.sign() * scale)
    return (torch.stack(directions)[:, None] * strides[None, :, None, None]).flatten(0, 1)
