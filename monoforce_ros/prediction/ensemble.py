"""Spread: how far a prediction may be off, from an ensemble over what is not known exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from monoforce_ros.core import wrap_angle
from monoforce_ros.physics import State
from monoforce_ros.prediction.predictor import Prediction, Predictor, start_states
from monoforce_ros.robots import RobotModel

COVERAGE = 0.9
"""Share of outcomes that the band shall hold."""
_RAYLEIGH = float(np.sqrt(-2.0 * np.log(1.0 - COVERAGE)))
"""Radius that holds that share of a normal distribution in two dimensions, in standard deviations of each."""


@dataclass(frozen=True)
class EnsembleSettings:
    """What is varied, as standard deviations."""

    members: int = 24
    friction: float = 0.15
    """Of the logarithm of the ground's friction."""
    speed: float = 0.03
    """Of each component of the start's velocity [m/s]."""
    yaw_rate: float = 0.03
    """Of the start's angular velocities [rad/s]."""
    heading: float = 0.01
    """Of the start's heading [rad]."""
    gain: float = 0.03
    """Of the drives' gain, each side on its own: what a model of the drives leaves out."""
    drift: float = 0.08
    """Of the position along and across, per metre driven [-]: what maps and physics get wrong beside all this; measured
    on synthetic drives with a lidar (benchmarks/uncertainty.py)."""
    position: float = 0.05
    """Of the start's position [m]: odometry jumps about, and a wheel on the edge of a stone may slip off it or not."""
    scale: float = 1.4
    """On the whole band; set so that it held :data:`COVERAGE` of what happened on ten synthetic drives with a lidar."""
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
        ):
            if not 0.0 <= getattr(self, name) <= high:
                raise ValueError(f"ensemble {name}: got {getattr(self, name)}, expected 0 to {high:g}")
        if not 0.0 < self.scale <= 100.0:
            raise ValueError(f"ensemble scale: got {self.scale}, expected above 0, at most 100")


@dataclass(frozen=True)
class Spread:
    """Of one prediction at each time of its rollout ``[T + 1]``, about its own path."""

    along: np.ndarray
    """Standard deviation along the heading [m]."""
    across: np.ndarray
    """To the side [m]."""
    up: np.ndarray
    """[m]."""
    heading: np.ndarray
    """[rad]."""
    radius: np.ndarray
    """Of the circle about the predicted position that holds :data:`COVERAGE` of the outcomes [m]."""
    valid: int
    """Members whose rollout stayed finite."""


def spread(predictor: Predictor, prediction: Prediction, twists: np.ndarray, settings: EnsembleSettings) -> Spread:
    """Roll out variants of a prediction on its own map, all at once.

    Varied are friction, the start's velocities and heading, the gain of each side's drives, and each parameter of the
    robot's effects within its interval. The same members are drawn each time, so that bands do not flicker.

    Args:
        predictor: rolls out.
        prediction: whose map and start are varied.
        twists: its commands ``[history + T, 2]``.
        settings: what is varied.

    Raises:
        ValueError: fewer than half of the members stayed finite.
    """
    count = settings.members
    random = np.random.default_rng(settings.seed)
    # Antithetic pairs: the mean of what is drawn is zero however few there are.
    drawn = random.standard_normal(((count + 1) // 2, 8))
    drawn = torch.from_numpy(np.concatenate([drawn, -drawn])[:count]).float()
    robot = _varied_robot(predictor.robot, drawn, settings)
    motions = [prediction.motion] * count
    start = _varied_start(start_states([prediction.motion]), drawn, settings)
    terrain = prediction.terrain
    given = torch.as_tensor(twists, dtype=torch.float32).expand(count, -1, -1)
    with torch.no_grad():
        rolled = predictor.differentiable_roll_out(terrain, motions, given, start, robot, with_forces=False)
    finite = (rolled.valid & torch.isfinite(rolled.position).all(dim=(1, 2))).numpy()
    if finite.sum() < max(2, count // 2):
        raise ValueError(f"{count - int(finite.sum())} of {count} members of the ensemble diverged")
    nominal, turned = prediction.rollout.position[0].double().numpy(), prediction.rollout.rotation[0].double().numpy()
    away = rolled.position.double().numpy()[finite] - nominal
    heading = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    cosine, sine = np.cos(heading), np.sin(heading)
    along = cosine * away[..., 0] + sine * away[..., 1]
    across = cosine * away[..., 1] - sine * away[..., 0]
    rotation = rolled.rotation.double().numpy()[finite]
    turn = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]) - heading
    turn = wrap_angle(turn)
    driven = np.linalg.norm(np.diff(nominal[:, :2], axis=0, prepend=nominal[:1, :2]), axis=1).cumsum()
    drift = np.hypot(settings.drift * driven, settings.position)
    radius = np.hypot(np.quantile(np.hypot(along, across), COVERAGE, axis=0), _RAYLEIGH * drift)

    def deviation(values: np.ndarray, beside: np.ndarray | float = 0.0) -> np.ndarray:
        return settings.scale * np.sqrt((values**2).mean(axis=0) + np.square(beside))

    return Spread(
        deviation(along, drift), deviation(across, drift), deviation(away[..., 2], settings.position), deviation(turn),
        settings.scale * radius, int(finite.sum()),
    )  # fmt: skip


def _varied_start(state: State, drawn: torch.Tensor, settings: EnsembleSettings) -> State:
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


def _varied_robot(robot: RobotModel, drawn: torch.Tensor, settings: EnsembleSettings) -> RobotModel:
    """The robot with effects that have a value of their own in each trajectory."""
    intervals = dict(robot.effect_intervals)
    random = np.random.default_rng(settings.seed + 1)
    effects = {}
    for name, parameters in robot.effects:
        varied = dict(parameters)
        for key, (low, high) in intervals.get(name, {}).items():
            half = len(drawn) // 2 + len(drawn) % 2
            unit = random.standard_normal(half)
            unit = torch.from_numpy(np.concatenate([unit, -unit])[: len(drawn)]).float()
            # The interval holds 95 %; what is drawn stays within it, as bounds of parameters do.
            middle = torch.as_tensor(varied[key], dtype=torch.float32)
            varied[key] = (middle + unit * (high - low) / 3.92).clamp(low, high)
        effects[name] = varied
    friction = torch.exp(settings.friction * drawn[:, 5])
    known = effects.setdefault("friction_scale", {"factor": 1.0})
    known["factor"] = (torch.as_tensor(known["factor"], dtype=torch.float32) * friction).clamp(0.02, 3.0)
    gain = effects.setdefault("drive_gain", {"gain": 1.0})
    drives = torch.as_tensor(gain["gain"], dtype=torch.float32) * (1.0 + settings.gain * drawn[:, 6])
    gain["gain"] = drives.clamp(0.2, 2.0)
    uneven = effects.setdefault("drive_asymmetry", {"difference": 0.0})
    sides = torch.as_tensor(uneven["difference"], dtype=torch.float32) + settings.gain * drawn[:, 7]
    uneven["difference"] = sides.clamp(-1.0, 1.0)
    return replace(robot, effects=tuple(effects.items()))
