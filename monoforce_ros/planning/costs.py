"""Costs: what a predicted motion would ask of the robot, as named terms of which 1 is the limit."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.physics import Rollout
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

_GRAVITY = 9.81
_FORCE_INTERVAL = 0.06
"""Time between the steps whose forces decide [s]: enough for what is averaged below."""
_SMOOTHED = 0.2
"""Forces of single steps are averaged over this time [s]: a tyre's bounce is not a lost wheel."""


@dataclass(frozen=True)
class CostWeights:
    """Weights of the terms of a candidate's cost."""

    roll: float = 1.0
    pitch: float = 1.0
    force_variation: float = 0.5
    wheel_load: float = 1.0
    slip: float = 1.0
    effort: float = 0.3
    unobserved: float = 1.0
    collision: float = 3.0

    def __post_init__(self):
        for name, value in asdict(self).items():
            if not 0.0 <= value <= 1e6:
                raise ValueError(f"cost weight {name}: got {value}, expected 0 or more")


@dataclass(frozen=True)
class Limits:
    """Where a term is 1; beyond it a candidate is not feasible."""

    roll: float = 0.5
    """Largest roll, either side [rad]."""
    pitch: float = 0.6
    """[rad]."""
    force_variation: float = 1.0
    """Standard deviation of the load on the ground over the robot's weight."""
    wheel_load: float = 0.95
    """Share of half the load that one side may lose; at 1 it hangs in the air."""
    slip: float = 0.6
    """Mean difference of commanded and driven speed over the commanded one."""
    effort: float = 0.6
    """Mean power at the ground over weight times 1 m/s."""
    unobserved: float = 0.8
    """Share of the way over ground that nothing has measured nearby, or off the map."""
    collision: float = 0.25
    """Push of steep contacts over the robot's weight."""

    def __post_init__(self):
        for name, value in asdict(self).items():
            if not 1e-3 <= value <= 1e3:
                raise ValueError(f"limit of {name}: got {value}, expected 0.001 to 1000")


TERMS = tuple(entry.name for entry in fields(CostWeights))


def force_every(time_step: float) -> int:
    """Steps of ``time_step`` [s] of which one's forces are needed to assess a rollout."""
    return max(1, round(_FORCE_INTERVAL / time_step))


@dataclass(frozen=True)
class Assessment:
    """What each of ``N`` candidates costs."""

    terms: dict[str, Tensor]
    """Each ``[N]``, 1 at its limit."""
    cost: Tensor
    """Weighted sum ``[N]``; infinite for a rollout that diverged."""
    feasible: Tensor
    """Whether every term keeps its limit ``[N]`` bool."""

    @property
    def best(self) -> int | None:
        """The cheapest feasible candidate; None where there is none."""
        if not bool(self.feasible.any()):
            return None
        return int(torch.where(self.feasible, self.cost, torch.inf).argmin())

    def joined(self, other: Assessment) -> Assessment:
        """These candidates and others after them."""
        terms = {name: torch.cat([value, other.terms[name]]) for name, value in self.terms.items()}
        return Assessment(terms, torch.cat([self.cost, other.cost]), torch.cat([self.feasible, other.feasible]))

    def why_not(self, index: int) -> str:
        """What keeps a candidate from being feasible, in words; empty where nothing does."""
        if not bool(torch.isfinite(self.cost[index])):
            return "the rollout diverged"
        over = {name: float(value[index]) for name, value in self.terms.items() if not float(value[index]) <= 1.0}
        return ", ".join(f"{name.replace('_', ' ')} {value:.1f} times its limit" for name, value in over.items())


def assess(
    rollout: Rollout,
    terrain: TerrainMap,
    robot: RobotModel,
    twists: Tensor,
    *,
    weights: CostWeights = CostWeights(),
    limits: Limits = Limits(),
) -> Assessment:
    """Terms, cost and feasibility of rolled out candidates. Differentiable in the rollout.

    Args:
        rollout: with the sums of its contact forces, ``[N]``.
        terrain: the map that all rolled on.
        robot: what rolled.
        twists: commanded forward speed [m/s] and yaw rate [rad/s] of each step ``[N, T, 2]``.

    Raises:
        ValueError: the rollout has no sums of forces, or shapes do not fit.
    """
    if rollout.contact is None:
        raise ValueError("costs: the rollout has no contact forces; roll out with `with_contact=True`")
    expected = (rollout.position.shape[0], rollout.position.shape[1] - 1, 2)
    if tuple(twists.shape) != expected:
        raise ValueError(f"costs: got twists {tuple(twists.shape)}, expected {expected} for the rollout")
    weight = robot.mass * _GRAVITY
    step = rollout.force_every * float(rollout.times[1] - rollout.times[0])
    rotation = rollout.rotation[:, 1:]
    roll = torch.atan2(rotation[..., 2, 1], rotation[..., 2, 2]).abs().amax(dim=1)
    pitch = torch.asin(rotation[..., 2, 0].clamp(-1.0, 1.0)).abs().amax(dim=1)
    load = _smoothed(rollout.contact.load.sum(dim=2), step)
    raw = {
        "roll": roll,
        "pitch": pitch,
        "force_variation": load.std(dim=1) / weight,
        "wheel_load": _unloaded(rollout, step),
        "slip": _slip(rollout, robot, twists),
        "effort": _effort(rollout, robot, twists) / weight,
        "unobserved": _unobserved(rollout, terrain),
        "collision": _push(rollout, step) / weight,
    }
    terms = {name: torch.nan_to_num(raw[name] / getattr(limits, name), nan=torch.inf) for name in TERMS}
    cost = sum(getattr(weights, name) * terms[name] for name in TERMS)
    cost = torch.where(rollout.valid, cost, torch.inf)
    feasible = torch.stack([value <= 1.0 for value in terms.values()]).all(dim=0) & rollout.valid
    return Assessment(terms, cost, feasible)


def _smoothed(values: Tensor, step: float) -> Tensor:
    """Moving average along time of ``[N, T]``."""
    width = max(1, min(values.shape[1], round(_SMOOTHED / step)))
    return functional.avg_pool1d(values[:, None], width, stride=1)[:, 0]


def _unloaded(rollout: Rollout, step: float) -> Tensor:
    """Of half the load, the largest share that either side loses ``[N]``."""
    left, right = (_smoothed(side, step) for side in rollout.contact.sides.unbind(-1))
    lighter = torch.minimum(left, right) / (left + right).clamp_min(1e-6)
    return 1.0 - 2.0 * lighter.amin(dim=1)


def _slip(rollout: Rollout, robot: RobotModel, twists: Tensor) -> Tensor:
    """Mean difference of commanded and driven forward speed, over how fast the drives were asked to run ``[N]``.

    Yaw does not count: a skid-steered robot scrubs part of it away on the best of grounds.
    """
    ahead = (rollout.velocity[:, 1:] * rollout.rotation[:, 1:, :, 0]).sum(-1)
    reach = float(robot.drive_offsets.abs().max())
    asked = (twists[..., 0].abs() + reach * twists[..., 1].abs()).mean(dim=1)
    return (twists[..., 0] - ahead).abs().mean(dim=1) / asked.clamp_min(0.1)


def _effort(rollout: Rollout, robot: RobotModel, twists: Tensor) -> Tensor:
    """Mean power that the drives bring to the ground [W] ``[N]``."""
    twists = twists[:, :: rollout.force_every]
    speed = twists[..., :1] - robot.drive_offsets.to(twists) * twists[..., 1:]
    return (rollout.contact.traction * speed).sum(dim=2).abs().mean(dim=1)


def _unobserved(rollout: Rollout, terrain: TerrainMap) -> Tensor:
    """Share of the way over cells without a measurement, or off the map ``[N]``."""
    grid = terrain.grid
    place = rollout.position.detach()[..., :2]
    column = ((place[..., 0] - grid.origin[0]) / grid.resolution).round().clamp(0, grid.columns - 1).nan_to_num(0.0)
    row = ((place[..., 1] - grid.origin[1]) / grid.resolution).round().clamp(0, grid.rows - 1).nan_to_num(0.0)
    nearby = torch.from_numpy(terrain.measured_nearby()).to(place.device)
    known = nearby[row.long(), column.long()] & rollout.inside
    away = (place - place[:, :1]).norm(dim=-1)
    # Where the robot stands nothing sees the ground, and it is known to carry.
    moved = away > 1.0
    return ((~known) & moved).sum(dim=1) / moved.sum(dim=1).clamp_min(1)


def _push(rollout: Rollout, step: float) -> Tensor:
    """Largest horizontal push of steep contacts [N] ``[N]``."""
    return _smoothed(rollout.contact.push.norm(dim=-1), step).amax(dim=1)
