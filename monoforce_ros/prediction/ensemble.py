"""Spread: uncertainty of a prediction, from an ensemble of rollouts with varied parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from monoforce_ros.core import wrap_angle
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.physics import State
from monoforce_ros.prediction.predictor import Prediction, Predictor, start_states
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

_STARTS = 5
"""Random numbers of a member that vary its start; those of effects follow."""
_UNCERTAIN = tuple(effect for effect in reversed(CATALOGUE.values()) if effect.uncertainty)
"""Effects that vary in every ensemble."""

COVERAGE = 0.9
"""Share of outcomes that the band should contain."""
_RAYLEIGH = float(np.sqrt(-2.0 * np.log(1.0 - COVERAGE)))
"""Radius, in standard deviations of each axis, that contains this share of a normal distribution in two dimensions."""

_HALF_WIDTH = float(2.0 * np.sqrt(np.log(2.0)))
"""Lag at which the correlation of white noise after a Gaussian filter has fallen to a half, in the filter's widths."""


@dataclass(frozen=True)
class EnsembleSettings:
    """Standard deviations of the varied quantities."""

    members: int = 24
    """Number of rollouts."""
    friction: float = 0.15
    """Of the logarithm of the ground's friction [-]."""
    speed: float = 0.03
    """Of each horizontal component of the initial velocity [m/s]."""
    yaw_rate: float = 0.03
    """Of the initial yaw rate [rad/s]."""
    heading: float = 0.01
    """Of the initial heading [rad]."""
    gain: float = 0.03
    """Of the gain of the drives, common and differential [-]; covers unmodelled drive dynamics."""
    drift: float = 0.08
    """Of the position along and across the heading, per metre driven [-]; covers the remaining errors of maps and
    physics, and was measured on synthetic recordings with a lidar (benchmarks/uncertainty.py)."""
    correlation_length: float = 1.6
    """Distance within which the correlation of errors of predicted heights falls to a half [m], measured by
    benchmarks/terrain_errors.py; only for maps that tell the spread of their heights."""
    position: float = 0.05
    """Of the position at any time [m]: odometry is noisy, and a wheel may or may not slip off the edge of a stone."""
    scale: float = 1.4
    """Factor on the whole band, calibrated for :data:`COVERAGE` on ten synthetic recordings with a lidar [-]."""
    seed: int = 0

    def __post_init__(self):
        if not 2 <= self.members <= 1024:
            raise ValueError(f"ensemble members: got {self.members}, expected 2 to 1024")
        for name, high in (
            ("friction", 2.0),
            ("speed", 5.0),
            ("yaw_rate", 5.0),
            ("heading", 1.0),
            ("gain", 1.0),
            ("drift", 1.0),
            ("position", 1.0),
            ("correlation_length", 10.0),
        ):
            if not 0.0 <= getattr(self, name) <= high:
                raise ValueError(f"ensemble {name}: got {getattr(self, name)}, expected 0 to {high:g}")
        if not 0.0 < self.scale <= 100.0:
            raise ValueError(f"ensemble scale: got {self.scale}, expected above 0, at most 100")


@dataclass(frozen=True)
class Spread:
    """Uncertainty of one prediction about its path, at each time of its rollout ``[T + 1]``."""

    along: np.ndarray
    """Standard deviation along the heading [m]."""
    across: np.ndarray
    """Standard deviation across the heading [m]."""
    up: np.ndarray
    """Standard deviation of the height [m]."""
    heading: np.ndarray
    """Standard deviation of the heading [rad]."""
    radius: np.ndarray
    """Radius of the circle about the predicted position that contains :data:`COVERAGE` of the outcomes [m]."""
    valid: int
    """Number of members whose rollout stayed finite."""


def spread(predictor: Predictor, prediction: Prediction, twists: np.ndarray, settings: EnsembleSettings) -> Spread:
    """Uncertainty of a prediction, from a batch of variants rolled out on its map.

    The members vary friction, initial velocities and heading, the gain of each side's drives, each parameter of the
    robot's effects within its confidence interval, and heights whose spread the map tells. They are the same in each
    call, so that bands do not flicker.

    Args:
        predictor: robot and physics of the rollouts.
        prediction: provides the map, the start state and the nominal path.
        twists: commands of the prediction ``[history + T, 2]``.
        settings: standard deviations of the varied quantities.

    Raises:
        ValueError: fewer than half of the members stayed finite.
    """
    count = settings.members
    random = np.random.default_rng(settings.seed)
    drawn = _antithetic(random, count, _STARTS + len(_UNCERTAIN))
    robot = _varied_robot(predictor.robot, drawn, settings)
    motions = [prediction.motion] * count
    start = _varied_start(start_states([prediction.motion]), drawn, settings)
    terrain = _varied_terrain(prediction.terrain, count, settings)
    commands = torch.as_tensor(twists, dtype=torch.float32).expand(count, -1, -1)
    with torch.no_grad():
        rolled = predictor.differentiable_roll_out(
            terrain, motions, commands, start, robot, with_forces=False, joints=prediction.joints
        )
    finite = (rolled.valid & torch.isfinite(rolled.position).all(dim=(1, 2))).numpy()
    if finite.sum() < max(2, count // 2):
        raise ValueError(f"{count - int(finite.sum())} of {count} members of the ensemble diverged")
    nominal = prediction.rollout.position[0].double().numpy()
    attitude = prediction.rollout.rotation[0].double().numpy()
    offset = rolled.position.double().numpy()[finite] - nominal
    heading = np.arctan2(attitude[:, 1, 0], attitude[:, 0, 0])
    cosine, sine = np.cos(heading), np.sin(heading)
    along = cosine * offset[..., 0] + sine * offset[..., 1]
    across = cosine * offset[..., 1] - sine * offset[..., 0]
    rotation = rolled.rotation.double().numpy()[finite]
    turn = wrap_angle(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]) - heading)
    driven = np.linalg.norm(np.diff(nominal[:, :2], axis=0, prepend=nominal[:1, :2]), axis=1).cumsum()
    drift = np.hypot(settings.drift * driven, settings.position)
    radius = np.hypot(np.quantile(np.hypot(along, across), COVERAGE, axis=0), _RAYLEIGH * drift)

    def deviation(values: np.ndarray, added: np.ndarray | float = 0.0) -> np.ndarray:
        return settings.scale * np.sqrt((values**2).mean(axis=0) + np.square(added))

    return Spread(
        along=deviation(along, drift),
        across=deviation(across, drift),
        up=deviation(offset[..., 2], settings.position),
        heading=deviation(turn),
        radius=settings.scale * radius,
        valid=int(finite.sum()),
    )


def _antithetic(random: np.random.Generator, count: int, *size: int) -> torch.Tensor:
    """Standard normal numbers ``[count, *size]`` in pairs of opposite sign: for even counts their mean is zero."""
    half = random.standard_normal(((count + 1) // 2, *size))
    return torch.from_numpy(np.concatenate([half, -half])[:count]).float()


def _varied_start(state: State, drawn: torch.Tensor, settings: EnsembleSettings) -> State:
    """Start states of the members."""
    count = len(drawn)
    angle = settings.heading * drawn[:, 0]
    cosine, sine, zero = angle.cos(), angle.sin(), torch.zeros(count)
    turn = torch.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1.0], dim=1).view(-1, 3, 3)
    flat = torch.tensor([1.0, 1.0, 0.0])
    return State(
        position=state.position.expand(count, 3).clone(),
        rotation=turn @ state.rotation,
        velocity=(turn @ state.velocity[0]) + settings.speed * drawn[:, 1:4] * flat,
        angular_velocity=(turn @ state.angular_velocity[0])
        + settings.yaw_rate * drawn[:, 4:5] * torch.tensor([0.0, 0.0, 1.0]),
    )


def _varied_terrain(terrain: TerrainMap, count: int, settings: EnsembleSettings) -> TerrainMap:
    """One map for each member, whose heights differ by smooth random fields; the map itself if it tells no spread."""
    scale = terrain.height_spread
    if scale is None:
        return terrain
    random = np.random.default_rng(settings.seed + 2)
    sigma = settings.correlation_length / terrain.grid.resolution / _HALF_WIDTH
    fields = []
    for _ in range((count + 1) // 2):
        noise = gaussian_filter(random.standard_normal(terrain.height.shape), sigma, mode="wrap")
        fields += [noise / noise.std()]
    drawn = torch.from_numpy(np.stack([*fields, *(-field for field in fields)])[:count]).to(terrain.height)
    # The standard deviation of a Laplace distribution is √2 times its scale.
    change = np.sqrt(2.0) * scale * drawn
    maps = [replace(terrain, height=terrain.height + entry, geometric_height=terrain.geometric_height + entry)
            for entry in change]  # fmt: skip
    return TerrainMap.stack(maps)


def _varied_robot(robot: RobotModel, drawn: torch.Tensor, settings: EnsembleSettings) -> RobotModel:
    """The robot with one value of each effect parameter per member."""
    intervals = dict(robot.effect_intervals)
    random = np.random.default_rng(settings.seed + 1)
    effects: dict[str, dict[str, float | torch.Tensor]] = {}
    for name, parameters in robot.effects:
        varied = dict(parameters)
        for key, (low, high) in intervals.get(name, {}).items():
            unit = _antithetic(random, len(drawn))
            # A 95 % interval is 3.92 standard deviations wide; values stay within it, because parameters have bounds.
            value = torch.as_tensor(varied[key], dtype=torch.float32)
            varied[key] = (value + unit * (high - low) / 3.92).clamp(low, high)
        effects[name] = varied
    deviations = {"friction": settings.friction, "gain": settings.gain}
    for column, effect in enumerate(_UNCERTAIN, start=_STARTS):
        parameter, change = effect.parameters[0], deviations[effect.uncertainty] * drawn[:, column]
        values = effects.setdefault(effect.name, {parameter.name: parameter.neutral})
        value = torch.as_tensor(values[parameter.name], dtype=torch.float32)
        varied_value = value * torch.exp(change) if parameter.neutral == 1.0 else value + change
        values[parameter.name] = varied_value.clamp(parameter.low, parameter.high)
    return replace(robot, effects=tuple(effects.items()))
