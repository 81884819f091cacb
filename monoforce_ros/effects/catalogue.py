"""Catalogue: every effect by name, and how the effects of a robot act together."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.effects.effect import STAGES, Effect
from monoforce_ros.effects.setup import Loads, Setup
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap


class EffectError(ValueError):
    """An effect that does not exist, or a parameter that it does not have or that is out of bounds."""


_NO_EFFECTS = frozenset({"catalogue", "effect", "page", "setup"})
"""Modules of this package that hold no effect."""


def _discover() -> dict[str, Effect]:
    found: dict[str, Effect] = {}
    for module in pkgutil.iter_modules([str(Path(__file__).parent)]):
        if module.name in _NO_EFFECTS:
            continue
        content = importlib.import_module(f"{__package__}.{module.name}")
        for _, kind in inspect.getmembers(content, inspect.isclass):
            if not issubclass(kind, Effect) or kind.__module__ != content.__name__:
                continue
            effect = kind()
            complaint = effect.complaint()
            if complaint:
                raise EffectError(f"{content.__file__}: {kind.__name__} {complaint}")
            if effect.name in found:
                raise EffectError(f"{content.__file__}: an effect named {effect.name!r} exists already")
            found[effect.name] = effect
    return dict(sorted(found.items(), key=lambda entry: (STAGES.index(entry[1].stage), entry[0])))


CATALOGUE: dict[str, Effect] = _discover()
"""Effects by name, in the order of their stages."""


def speed_effects() -> tuple[Effect, ...]:
    """Effects that change drive speeds, in the order in which a command meets them."""
    return tuple(sorted((e for e in CATALOGUE.values() if e.order is not None), key=lambda e: (e.order, e.name)))


def identifiable_effects() -> tuple[Effect, ...]:
    """Effects that a recording of motion and commands can identify; sensors and clocks come before dynamics."""
    first = ("measurement", "command", "contact", "body")
    found = [effect for effect in CATALOGUE.values() if effect.identified]
    return tuple(sorted(found, key=lambda e: (first.index(e.stage), e.order or 0, e.name)))


def wheel_effects() -> tuple[Effect, ...]:
    """Effects that measured wheel speeds show, in the order in which a command meets them."""
    return tuple(effect for effect in speed_effects() if effect.wheel_response is not None)


def separating_manoeuvre(first: str, second: str) -> str:
    """What to drive so that a recording separates two effects; empty where neither file says."""
    one, two = _catalogued(first), _catalogued(second)
    return one.separated_by.get(second, "") or two.separated_by.get(first, "")


def separating_sensor(first: str, second: str) -> str:
    """The sensor that separates two effects which no manoeuvre does; empty where that is not so."""
    one, two = _catalogued(first), _catalogued(second)
    return one.separated_by_sensor.get(second, "") or two.separated_by_sensor.get(first, "")


def effect_values(name: str, parameters: Mapping[str, float | Tensor], like: Tensor | None = None) -> dict[str, Tensor]:
    """Values of all parameters of an effect, the neutral one where none is given.

    Raises:
        EffectError: the effect or a parameter is unknown, or a value out of bounds (its neutral value is always in).
    """
    if name not in CATALOGUE:
        raise EffectError(f"effect {name!r} is unknown; expected one of {sorted(CATALOGUE)}")
    known = {parameter.name: parameter for parameter in CATALOGUE[name].parameters}
    unknown = sorted(set(parameters) - set(known))
    if unknown:
        raise EffectError(f"effect {name}: parameters {unknown} are unknown; expected some of {sorted(known)}")
    dtype = like.dtype if like is not None else torch.float32
    device = like.device if like is not None else None
    values = {}
    for key, parameter in known.items():
        value = torch.as_tensor(parameters.get(key, parameter.neutral), dtype=dtype, device=device)
        inside = (value >= parameter.low) & (value <= parameter.high) | (value == parameter.neutral)
        if not bool(inside.detach().all()):
            raise EffectError(
                f"effect {name}: {key} is {value.detach().tolist()}, expected {parameter.low:g} to {parameter.high:g} "
                f"{parameter.unit}"
            )
        values[key] = value
    return values


def drive_speeds(robot: RobotModel, twists: Tensor, time_step: float, *, history: int = 0) -> Tensor:
    """Drive speeds that result from commanded twists, with the robot's command effects.

    Args:
        robot: its ``effects`` act in the order in which a command meets them.
        twists: forward speed [m/s] and yaw rate [rad/s], ``[B, history + T, 2]``.
        time_step: between them [s].
        history: how many of them lie before the start: delay and lag need what was commanded then.

    Returns:
        ``[B, T, D]`` [m/s].
    """
    speeds = robot.drive_speeds(twists)
    active = dict(robot.effects)
    for effect in speed_effects():
        if effect.name in active:
            values = effect_values(effect.name, active[effect.name], speeds)
            speeds = effect.drive_speeds(speeds, values, time_step, robot.drive_offsets)
    return speeds[:, history:]


def applied_setup(terrain: TerrainMap, robot: RobotModel) -> Setup:
    """Terrain, robot and loads with the robot's contact and body effects in them."""
    setup = Setup(terrain, robot, Loads.none(robot.points))
    for name, parameters in robot.effects:
        values = effect_values(name, parameters, robot.points)
        setup = CATALOGUE[name].setup(setup, values)
    return setup


def turned_effects(robot: RobotModel, heading: Tensor) -> RobotModel:
    """The robot for rollouts in frames turned about the vertical by ``heading`` ``[B]`` [rad] from the odometry's."""
    turned = tuple((name, CATALOGUE[name].turned(parameters, heading)) for name, parameters in robot.effects)
    return replace(robot, effects=turned) if robot.effects else robot


def recorded_motion(motion: MotionTrack, robot: RobotModel) -> MotionTrack:
    """Motion as the robot's measurement effects would have it recorded."""
    for name, parameters in robot.effects:
        values = {key: float(value) for key, value in effect_values(name, parameters).items()}
        motion = CATALOGUE[name].motion(motion, values)
    return motion


def recorded_commands(commands: CommandTrack, robot: RobotModel) -> CommandTrack:
    """Commands as the robot's measurement effects would have them recorded."""
    for name, parameters in robot.effects:
        values = {key: float(value) for key, value in effect_values(name, parameters).items()}
        commands = CATALOGUE[name].commands(commands, values)
    return commands


def corrected_motion(motion: MotionTrack, effects: Iterable[tuple[str, Mapping[str, float | Tensor]]]) -> MotionTrack:
    """Recorded motion without what measurement effects did to it: each undoes itself with the opposite sign."""
    for name, parameters in effects:
        if _catalogued(name).stage == "measurement":
            motion = CATALOGUE[name].motion(motion, {key: -float(value) for key, value in _full(name, parameters)})
    return motion


def corrected_commands(
    commands: CommandTrack, effects: Iterable[tuple[str, Mapping[str, float | Tensor]]]
) -> CommandTrack:
    """Recorded commands without what measurement effects did to them."""
    for name, parameters in effects:
        if _catalogued(name).stage == "measurement":
            commands = CATALOGUE[name].commands(
                commands, {key: -float(value) for key, value in _full(name, parameters)}
            )
    return commands


def _catalogued(name: str) -> Effect:
    if name not in CATALOGUE:
        raise EffectError(f"effect {name!r} is unknown; expected one of {sorted(CATALOGUE)}")
    return CATALOGUE[name]


def _full(name: str, parameters: Mapping[str, float | Tensor]) -> Iterable[tuple[str, float]]:
    return [(key, float(value)) for key, value in effect_values(name, parameters).items()]
