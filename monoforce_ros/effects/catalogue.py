"""Catalogue: all effects by name, and the combined action of a robot's effects."""

from __future__ import annotations

import importlib
import inspect
import math
import pkgutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.effects.effect import STAGES, Effect, Parameter
from monoforce_ros.effects.setup import Setup
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap


class EffectError(ValueError):
    """Unknown effect, unknown parameter of an effect, or a value out of bounds."""


_NO_EFFECTS = frozenset(
    {"catalogue", "effect", "first_order", "joint_controls", "page", "ramp", "sentences", "setup", "timing"}
)
"""Modules of this package without an effect."""
_SINGLE = float(torch.finfo(torch.float32).eps)
"""Relative spacing of single-precision numbers."""


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
"""Effects by name, sorted by stage."""


def only_effect(has: Callable[[Effect], object]) -> str:
    """Name of the one effect with a property.

    Raises:
        EffectError: none or several have it.
    """
    found = [name for name, effect in CATALOGUE.items() if has(effect)]
    if len(found) != 1:
        raise EffectError(f"effects with a property of which there is one: got {found or 'none'}")
    return found[0]


def speed_effects() -> tuple[Effect, ...]:
    """Effects that change twists or drive speeds, in the order in which they act on a command."""
    # Twists are changed before they become drive speeds, whatever the order.
    return tuple(sorted((e for e in CATALOGUE.values() if e.order is not None), key=lambda e: (e.order, e.name)))


def identifiable_effects(robot: RobotModel | None = None) -> tuple[Effect, ...]:
    """Effects that a recording of motion and commands can identify; sensors and clocks first, then dynamics.

    Args:
        robot: effects on joints that it does not have are left out; None leaves out none.
    """
    first = ("measurement", "command", "contact", "body")
    found = [effect for effect in CATALOGUE.values() if effect.identified and effect.applies_to(robot)]
    return tuple(sorted(found, key=lambda e: (first.index(e.stage), e.order or 0, e.name)))


def wheel_effects() -> tuple[Effect, ...]:
    """Effects that measured wheel speeds reveal, in the order in which they act on a command."""
    return tuple(effect for effect in speed_effects() if effect.wheel_response is not None)


def separating_manoeuvre(first: str, second: str) -> str:
    """Manoeuvre for which a recording separates two effects.

    Where neither effect defines one, a recording with that which makes each of them observable is the best there is;
    empty for an effect without one, and where only a sensor separates the two.
    """
    one, two = _catalogued(first), _catalogued(second)
    known = one.separated_by.get(second, "") or two.separated_by.get(first, "")
    if known or separating_sensor(first, second) or not (one.manoeuvre and two.manoeuvre):
        return known
    return one.manoeuvre if one.manoeuvre == two.manoeuvre else f"{one.manoeuvre}, and {two.manoeuvre}"


def separating_sensor(first: str, second: str) -> str:
    """Sensor that separates two effects if no manoeuvre does; empty if neither effect defines one."""
    one, two = _catalogued(first), _catalogued(second)
    return one.separated_by_sensor.get(second, "") or two.separated_by_sensor.get(first, "")


def effect_values(name: str, parameters: Mapping[str, float | Tensor], like: Tensor | None = None) -> dict[str, Tensor]:
    """Values of all parameters of an effect; missing ones are neutral.

    Raises:
        EffectError: the effect or a parameter is unknown, or a value is out of bounds (neutral values are allowed).
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
        given = parameters.get(key, parameter.neutral)
        value = torch.as_tensor(given, dtype=dtype, device=device)
        if not _inside(parameter, value.detach() if isinstance(given, Tensor) else given):
            raise EffectError(
                f"effect {name}: {key} is {value.detach().tolist()}, expected {parameter.low:g} to {parameter.high:g} "
                f"{parameter.unit}"
            )
        values[key] = value
    return values


def _inside(parameter: Parameter, value: float | Tensor) -> bool:
    """Whether a value, or each of several, is within its bounds or neutral; a number as if of single precision."""
    if isinstance(value, Tensor):
        return bool(((value >= parameter.low) & (value <= parameter.high) | (value == parameter.neutral)).all())
    if parameter.low <= value <= parameter.high or value == parameter.neutral:
        return True
    return any(math.isclose(value, bound, rel_tol=_SINGLE) for bound in (parameter.low, parameter.high))


def drive_speeds(robot: RobotModel, twists: Tensor, time_step: float, *, history: int = 0) -> Tensor:
    """Drive speeds from commanded twists, with the robot's effects on commands.

    Args:
        robot: its effects act in the order of :func:`speed_effects`.
        twists: forward speed [m/s], yaw rate [rad/s] and, optionally, lateral speed [m/s],
            ``[B, history + T, 2]`` or ``[B, history + T, 3]``.
        time_step: time between twists [s].
        history: number of twists before the start; delay and lag need them.

    Returns:
        ``[B, T, D]`` [m/s].
    """
    return commanded(robot, twists, time_step)[0][:, history:]


def commanded(robot: RobotModel, twists: Tensor, time_step: float) -> tuple[Tensor, Tensor]:
    """Drive speeds ``[B, T, D]`` [m/s] and steering angles ``[B, T, S]`` [rad] that the base demands for twists.

    Args:
        robot: its effects on commands act.
        twists: as for :func:`drive_speeds`, ``[B, T, 2]`` or ``[B, T, 3]``.
        time_step: time between twists [s].
    """
    given = dict(robot.effects)
    active = [
        (effect, effect_values(effect.name, given[effect.name], twists))
        for effect in speed_effects()
        if effect.name in given
    ]
    # The base limits a command before it ramps to it.
    twists = robot.limited_twist(twists)
    twists, lateral = twists[..., :2], twists[..., 2:]
    for effect, values in active:
        twists = effect.twists(twists, values, time_step)
    speeds, steering = robot.command(torch.cat([twists, lateral], dim=-1) if lateral.shape[-1] else twists)
    for effect, values in active:
        speeds = effect.drive_speeds(speeds, values, time_step, robot.drive_offsets)
        if effect.acts_on_steering and steering.shape[-1]:
            steering = effect.drive_speeds(steering, values, time_step, torch.zeros_like(steering[0, 0]))
        if effect.needs == "steering" and steering.shape[-1]:
            steering = effect.steering_angles(steering, speeds, values, time_step)
    return speeds, steering


def applied_setup(terrain: TerrainMap, robot: RobotModel) -> Setup:
    """Terrain, robot and loads with the robot's contact and body effects applied."""
    setup = Setup.plain(terrain, robot)
    for name, parameters in robot.effects:
        values = effect_values(name, parameters, robot.points)
        setup = CATALOGUE[name].setup(setup, values)
    return setup


def turned_effects(robot: RobotModel, heading: Tensor) -> RobotModel:
    """The robot with effects expressed in frames yawed by ``heading`` ``[B]`` [rad] relative to the odometry frame."""
    turned = tuple((name, _catalogued(name).turned(parameters, heading)) for name, parameters in robot.effects)
    return replace(robot, effects=turned) if robot.effects else robot


def recorded_motion(motion: MotionTrack, robot: RobotModel) -> MotionTrack:
    """Motion as recorded under the robot's measurement effects.

    The catalogue's order is that in which they act: a sensor's place on the robot before its heading there.
    """
    for name, parameters in _in_order(robot.effects):
        values = {key: float(value) for key, value in effect_values(name, parameters).items()}
        motion = CATALOGUE[name].motion(motion, values)
    return motion


def recorded_commands(commands: CommandTrack, robot: RobotModel) -> CommandTrack:
    """Commands as recorded under the robot's measurement effects."""
    for name, parameters in _in_order(robot.effects):
        values = {key: float(value) for key, value in effect_values(name, parameters).items()}
        commands = CATALOGUE[name].commands(commands, values)
    return commands


def corrected_motion(motion: MotionTrack, effects: Iterable[tuple[str, Mapping[str, float | Tensor]]]) -> MotionTrack:
    """Recorded motion with measurement effects removed, by applying each with the opposite sign, the last one first."""
    for name, parameters in reversed(_in_order(effects)):
        if _catalogued(name).stage == "measurement":
            motion = CATALOGUE[name].motion(motion, {key: -float(value) for key, value in _full(name, parameters)})
    return motion


def corrected_commands(
    commands: CommandTrack, effects: Iterable[tuple[str, Mapping[str, float | Tensor]]]
) -> CommandTrack:
    """Recorded commands with measurement effects removed."""
    for name, parameters in reversed(_in_order(effects)):
        if _catalogued(name).stage == "measurement":
            commands = CATALOGUE[name].commands(
                commands, {key: -float(value) for key, value in _full(name, parameters)}
            )
    return commands


def _in_order[Values](effects: Iterable[tuple[str, Values]]) -> list[tuple[str, Values]]:
    """Effects in the order of the catalogue."""
    order = list(CATALOGUE)
    return sorted(effects, key=lambda entry: order.index(_catalogued(entry[0]).name))


def _catalogued(name: str) -> Effect:
    if name not in CATALOGUE:
        raise EffectError(f"effect {name!r} is unknown; expected one of {sorted(CATALOGUE)}")
    return CATALOGUE[name]


def _full(name: str, parameters: Mapping[str, float | Tensor]) -> Iterable[tuple[str, float]]:
    return [(key, float(value)) for key, value in effect_values(name, parameters).items()]
