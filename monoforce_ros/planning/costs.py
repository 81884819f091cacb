"""Costs of a predicted motion, as named terms that are 1 at their limit."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from monoforce_ros.physics import Rollout
from monoforce_ros.planning.clearance import FURTHER, LARGEST, closeness
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap, polar

_GRAVITY = 9.81
_FORCE_INTERVAL = 0.06
"""Time between the steps at which forces are evaluated [s]; short compared with the averaging below."""
_LEAST_CLEARANCE = 0.05
"""For tracked robots, whose belts reach as low as their hulls [m]: half the resolution of the encoder's map."""
_SMOOTHED = 0.2
"""Averaging time of forces [s]: a bouncing tyre does not count as an unloaded wheel."""


@dataclass(frozen=True)
class CostWeights:
    """Weights of the cost terms."""

    roll: float = 1.0
    pitch: float = 1.0
    force_variation: float = 0.5
    wheel_load: float = 1.0
    slip: float = 1.0
    effort: float = 0.3
    unobserved: float = 1.0
    collision: float = 3.0
    obstacle_clearance: float = 1.0

    def __post_init__(self):
        for name, value in asdict(self).items():
            if not 0.0 <= value <= 1e6:
                raise ValueError(f"cost weight {name}: got {value}, expected 0 or more")


@dataclass(frozen=True)
class Limits:
    """Values at which the cost terms are 1; a candidate beyond any of them is infeasible."""

    roll: float = 0.5
    """Largest absolute roll [rad]."""
    pitch: float = 0.6
    """Largest absolute pitch [rad]."""
    force_variation: float = 1.0
    """Standard deviation of the total ground load over the robot's weight [-]."""
    wheel_load: float = 0.95
    """Relative loss of load on one side, compared with half the total; at 1 the side is unloaded [-]."""
    slip: float = 0.6
    """Mean difference of commanded and achieved forward speed over the mean commanded drive speed [-]."""
    effort: float = 0.6
    """Mean power at the ground over weight times 1 m/s [-]."""
    unobserved: float = 0.8
    """Share of the path over ground without measurements nearby, or off the map [-]."""
    collision: float = 0.25
    """Horizontal force of steep contacts over the robot's weight [-]."""
    obstacle_clearance: float = 0.1
    """Smallest distance of the robot's outline from what it cannot climb [m]; below it a candidate is infeasible.

    A cell of a map of 0.1 m: an obstacle's place is known to half a cell, and the odometry's and the rollout's over the
    time between two predictions to a few centimetres."""

    def __post_init__(self):
        for name, value in asdict(self).items():
            largest = LARGEST if name == "obstacle_clearance" else 1e3
            if not 1e-3 <= value <= largest:
                raise ValueError(f"limit of {name}: got {value}, expected 0.001 to {largest:g}")


TERMS = tuple(entry.name for entry in fields(CostWeights))


def force_every(time_step: float) -> int:
    """Interval, in steps of ``time_step`` [s], at which :func:`assess` needs contact forces."""
    return max(1, round(_FORCE_INTERVAL / time_step))


_REMEMBERED = 2.0
"""Distance from the robot within which a map may hold what sensors saw before and no longer see [m]: their blind zone,
1.5 m for a lidar 0.8 m high whose lowest ring looks 28° down, and half a robot."""
_SETTLED = 0.6
"""Time in which a body that starts inside the ground is pushed out of it [s]: of a Husky, a Warthog and a TRADR with
their wheels or tracks in ground of 0.25 m, on one side, at the front or at a corner, seven of nine came to rest within
0.5 s. What presses longer is held against no candidate either: see the limits in :func:`assess`."""


@dataclass(frozen=True)
class Assessment:
    """Costs and feasibility of ``N`` candidates."""

    terms: dict[str, Tensor]
    """Cost terms, each ``[N]`` and 1 at its limit."""
    cost: Tensor
    """Weighted sum of the terms ``[N]``; infinite for a diverged rollout."""
    feasible: Tensor
    """Whether no term exceeds its limit ``[N]`` bool."""

    @property
    def best(self) -> int | None:
        """Index of the feasible candidate with the lowest cost; None without a feasible one."""
        return self.best_among(torch.ones_like(self.feasible))

    def best_among(self, chosen: Tensor) -> int | None:
        """Index of the feasible one with the lowest cost among some candidates ``[N]`` bool; None without one."""
        possible = self.feasible & chosen
        return int(torch.where(possible, self.cost, torch.inf).argmin()) if bool(possible.any()) else None

    def joined(self, other: Assessment) -> Assessment:
        """These candidates followed by others."""
        terms = {name: torch.cat([value, other.terms[name]]) for name, value in self.terms.items()}
        return Assessment(terms, torch.cat([self.cost, other.cost]), torch.cat([self.feasible, other.feasible]))

    def violations(self, index: int) -> str:
        """The limits that a candidate exceeds, in words; empty for a feasible one."""
        if not bool(torch.isfinite(self.cost[index])):
            return "the rollout diverged"
        over = {name: float(value[index]) for name, value in self.terms.items() if not float(value[index]) <= 1.0}
        words = [
            "too close to an obstacle"
            if name == "obstacle_clearance"
            else f"{name.replace('_', ' ')} {value:.1f} times its limit"
            for name, value in over.items()
        ]
        return ", ".join(words)


def assess(
    rollout: Rollout,
    terrain: TerrainMap,
    robot: RobotModel,
    twists: Tensor,
    *,
    weights: CostWeights = CostWeights(),
    limits: Limits = Limits(),
    standing: Rollout | None = None,
) -> Assessment:
    """Terms, cost and feasibility of candidates, each of them by itself. Differentiable in the rollout.

    Args:
        rollout: rollout of all candidates ``[N]``, with contact force sums.
        terrain: the map of the rollout.
        robot: the robot of the rollout.
        twists: commanded forward speed [m/s] and yaw rate [rad/s] of each step ``[N, T, 2]``.
        weights: weights of the terms.
        limits: limits of the terms.
        standing: of a robot that stands, the rollout without commands ``[1]``, from the same start and with the same
            times. Where the map exerts forces beyond a limit even then, candidates with no larger ones are feasible.

    Raises:
        ValueError: a rollout has no contact force sums, or the shape of ``twists`` does not match it.
    """
    contact = rollout.contact
    if contact is None or (standing is not None and standing.contact is None):
        raise ValueError("costs: the rollout has no contact forces; roll out with `with_contact=True`")
    expected = (rollout.position.shape[0], rollout.position.shape[1] - 1, 2)
    if tuple(twists.shape) != expected:
        raise ValueError(f"costs: got twists {tuple(twists.shape)}, expected {expected} for the rollout")
    weight = robot.mass * _GRAVITY
    step = rollout.force_every * float(rollout.times[1] - rollout.times[0])
    rolls = torch.atan2(rollout.rotation[..., 2, 1], rollout.rotation[..., 2, 2]).abs()
    pitches = torch.asin(rollout.rotation[..., 2, 0].clamp(-1.0, 1.0)).abs()
    roll, pitch = (angles[:, 1:].amax(dim=1) for angles in (rolls, pitches))
    raw = {
        "roll": roll,
        "pitch": pitch,
        **_contact_terms(rollout, step, weight),
        "slip": _slip(rollout, robot, twists),
        "effort": _effort(contact.traction, robot, twists[:, :: rollout.force_every]) / weight,
        "unobserved": _unobserved(rollout, terrain, robot),
    }
    # A robot that leans beyond a limit, or stands too close, has to get away: what makes it no worse is feasible.
    starts = {"roll": rolls[:, 0] / limits.roll, "pitch": pitches[:, 0] / limits.pitch}
    if standing is not None:
        own = _contact_terms(standing, step, weight)
        if any(float(value) > getattr(limits, name) for name, value in own.items()):
            # The robot does stand here. What the map does to it then is the map's error, such as grass taken for
            # ground around the wheels, and no candidate's fault.
            skipped = round(_SETTLED / step)
            raw |= _contact_terms(rollout, step, weight, skipped=skipped)
            own = _contact_terms(standing, step, weight, skipped=skipped)
            starts |= {name: value.detach() / getattr(limits, name) for name, value in own.items()}
    terms = {name: torch.nan_to_num(value / getattr(limits, name), nan=torch.inf) for name, value in raw.items()}
    terms["obstacle_clearance"], leaves = closeness(rollout, terrain, robot, limits.obstacle_clearance)
    starts["obstacle_clearance"] = torch.where(leaves, torch.inf, 0.0)
    cost = sum(getattr(weights, name) * terms[name] for name in TERMS)
    cost = torch.where(rollout.valid, cost, torch.inf)
    most = {name: (starts[name] + FURTHER).clamp_min(1.0) if name in starts else 1.0 for name in TERMS}
    feasible = torch.stack([value <= most[name] for name, value in terms.items()]).all(dim=0) & rollout.valid
    return Assessment(terms, cost, feasible)


def _contact_terms(rollout: Rollout, step: float, weight: Tensor, skipped: int = 0) -> dict[str, Tensor]:
    """Terms of the forces that the map exerts, also on a robot that stands ``[N]``, without the first ones."""
    contact = rollout.contact
    assert contact is not None
    # Of a horizon shorter than that, the last two remain.
    skipped = max(0, min(skipped, contact.load.shape[1] - 2))
    load = _smoothed(contact.load[:, skipped:].sum(dim=2), step)
    return {
        "force_variation": load.std(dim=1) / weight,
        "wheel_load": _load_loss(contact.sides[:, skipped:], step),
        "collision": _push(contact.push[:, skipped:], step) / weight,
    }


def _smoothed(values: Tensor, step: float) -> Tensor:
    """Moving average along time of ``[N, T]``."""
    width = max(1, min(values.shape[1], round(_SMOOTHED / step)))
    return functional.avg_pool1d(values[:, None], width, stride=1)[:, 0]


def _load_loss(sides: Tensor, step: float) -> Tensor:
    """Largest share of half the load that either side loses ``[N]``, from the loads of both ``[N, S, 2]`` [N]."""
    left, right = (_smoothed(side, step) for side in sides.unbind(-1))
    lighter = torch.minimum(left, right) / (left + right).clamp_min(1e-6)
    return 1.0 - 2.0 * lighter.amin(dim=1)


def _slip(rollout: Rollout, robot: RobotModel, twists: Tensor) -> Tensor:
    """Mean difference of commanded and achieved forward speed over the mean commanded drive speed ``[N]``.

    Yaw does not count: a skid-steered robot loses part of it to scrubbing on any ground. A robot that brakes takes time
    for it: its own speed at the start counts like a commanded one.
    """
    ahead = (rollout.velocity[:, 1:] * rollout.rotation[:, 1:, :, 0]).sum(-1)
    arm = float(robot.drive_offsets.abs().max())
    commanded = (twists[..., 0].abs() + arm * twists[..., 1].abs()).mean(dim=1)
    own = (rollout.velocity[:, 0] * rollout.rotation[:, 0, :, 0]).sum(-1).abs()
    return (twists[..., 0] - ahead).abs().mean(dim=1) / torch.maximum(commanded, own).clamp_min(0.1)


def _effort(traction: Tensor, robot: RobotModel, twists: Tensor) -> Tensor:
    """Mean power of the drives at the ground [W] ``[N]``, from their traction ``[N, S, D]`` [N]."""
    speed = twists[..., :1] - robot.drive_offsets.to(twists) * twists[..., 1:]
    return (traction * speed).sum(dim=2).abs().mean(dim=1)


def _unobserved(rollout: Rollout, terrain: TerrainMap, robot: RobotModel) -> Tensor:
    """Share of the path with a wheel, a track or the middle of the robot over unknown ground ``[N]``, from 0 to 1.

    Off the map ground is unknown. Where the map tells the spread of its heights, a cell is unknown to the degree that
    its height may be off by more than the clearance below the hull: the probability of that for a Laplace distribution.
    Elsewhere cells without a measurement nearby are. So is ground that nothing was measured behind, whatever an encoder
    makes of it: it may be a drop.

    No sensor sees the ground below the robot and close around it, but the first is known to support it. Within a
    robot's length from the start only what may be a drop counts, under the wheels of either end, too: the result is the
    larger one of the share of the whole path over such ground, and the share of the rest of the path over any unknown
    ground.
    """
    grid = terrain.grid
    place = rollout.position.detach()[..., :2]
    # Ground under the wheels or tracks of either side counts as that under the middle does.
    driven_points = robot.points[robot.point_drives >= 0][:, :2]
    reach = torch.stack([driven_points.amin(0), driven_points.new_zeros(2), driven_points.amax(0)]).to(place)
    axes = rollout.rotation.detach()[..., :2, :2]
    under = torch.cartesian_prod(reach[:, 0], reach[:, 1])
    spots = place[..., None, :] + (axes[..., None, :, :] @ under[:, :, None])[..., 0]
    column = ((spots[..., 0] - grid.origin[0]) / grid.resolution).round()
    row = ((spots[..., 1] - grid.origin[1]) / grid.resolution).round()
    on_map = (column >= 0) & (column < grid.columns) & (row >= 0) & (row < grid.rows)
    column = column.clamp(0, grid.columns - 1).nan_to_num(0.0).long()
    row = row.clamp(0, grid.rows - 1).nan_to_num(0.0).long()
    beyond = torch.from_numpy(terrain.extrapolated()).to(place)
    if terrain.height_spread is None:
        unknown = 1.0 - torch.from_numpy(terrain.measured_nearby()).to(place)
    else:
        unknown = torch.exp(-_hull_clearance(robot) / terrain.height_spread.to(place).clamp_min(1e-4))
    unknown = torch.maximum(unknown, beyond)
    drop = beyond * torch.from_numpy(_looked_at(terrain, robot)).to(place)
    # Between two rows of returns the ends of a robot are over a gap most of the time, its middle is not.
    middle = under[:, 0] == 0.0
    degree, close = (
        torch.where(on_map[..., chosen], values[row[..., chosen], column[..., chosen]], 1.0)
        .amax(dim=-1)
        .masked_fill(~rollout.inside, 1.0)
        for values, chosen in ((unknown, middle), (drop, torch.ones_like(middle)))
    )
    low, high = robot.bounds
    moved = ((place - place[:, :1]).norm(dim=-1) > float(high[0] - low[0])).to(degree)
    driven = functional.pad((place[:, 1:] - place[:, :-1]).norm(dim=-1), (1, 0))
    # Turning in place displaces a robot by centimetres, which are no path.
    return torch.maximum(_share(degree, driven * moved), _share(close, driven, shortest=grid.resolution))


def _share(degree: Tensor, driven: Tensor, *, shortest: float = 1e-6) -> Tensor:
    """Sum of values ``[N, T + 1]`` times lengths driven ``[N, T + 1]``, over the whole length, at least one [m]."""
    return (degree * driven).sum(dim=1) / driven.sum(dim=1).clamp_min(shortest)


def _looked_at(terrain: TerrainMap, robot: RobotModel) -> np.ndarray:
    """Cells not below the robot, in directions where its sensors look ``[rows, columns]`` bool.

    The robot is at the origin of the map's frame. Cameras and some lidars look ahead only: where ground some metres
    away was measured in less than half of all directions, the widest direction ahead with such ground is taken for
    the edge of the field of view. A robot that backs out there drives over ground that it came from. Nearer cells may
    be remembered from before, beside and behind the robot.
    """
    grid = terrain.grid
    x, y = np.meshgrid(grid.x, grid.y)
    low, high = (bound.double().cpu().numpy() for bound in robot.bounds)
    half = 0.5 * grid.resolution
    outside = (x < low[0] - half) | (x > high[0] + half) | (y < low[1] - half) | (y > high[1] + half)
    distance, sector = polar(grid)
    away = terrain.observed.cpu().numpy() & outside & (distance > _REMEMBERED)
    ahead = away & (x > 0.0)
    if not ahead.any() or len(np.unique(sector[away])) >= 0.5 * len(np.unique(sector)):
        return outside
    bearing = np.abs(np.arctan2(y, x))
    return outside & (bearing <= bearing[ahead].max())


def _hull_clearance(robot: RobotModel) -> float:
    """Height of the hull's lowest point above the lowest driven one [m], at least :data:`_LEAST_CLEARANCE`."""
    driven = robot.point_drives >= 0
    if bool(driven.all()):
        return _LEAST_CLEARANCE
    return max(float(robot.points[~driven][:, 2].min() - robot.points[driven][:, 2].min()), _LEAST_CLEARANCE)


def _push(push: Tensor, step: float) -> Tensor:
    """Largest horizontal force of steep contacts [N] ``[N]``, from those of each step ``[N, S, 2]``."""
    return _smoothed(push.norm(dim=-1), step).amax(dim=1)
