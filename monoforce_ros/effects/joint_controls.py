"""Joint controls: controls of a rollout from commands to drives, steering and flippers."""

from __future__ import annotations

import torch
from torch import Tensor

from monoforce_ros.effects.catalogue import CATALOGUE, commanded, effect_values
from monoforce_ros.robots import Controls, RobotModel, servo_response


def controls(
    robot: RobotModel,
    twists: Tensor,
    time_step: float,
    *,
    history: int = 0,
    joint_start: Tensor | None = None,
    flippers: Tensor | None = None,
) -> Controls:
    """Controls of a rollout from commanded twists: drive speeds, and angles of the joints that are commanded.

    Args:
        robot: its effects act in the order of :func:`speed_effects`.
        twists: forward speed [m/s], yaw rate [rad/s] and, optionally, lateral speed [m/s],
            ``[B, history + T, 2]`` or ``[B, history + T, 3]``.
        time_step: time between twists [s].
        history: number of twists before the start; delay, lag and steering need them.
        joint_start: measured angles of the joints at the start, ``[B, J]`` [rad]. Of joints that are NaN, as of all
            without it, steering follows from the commands before the start, and others are at the angles of the
            robot's points.
        flippers: commanded angles of the flippers ``[B, T, F]`` [rad]; None or NaN holds them.

    Raises:
        ValueError: a shape does not fit the robot.
    """
    speeds, steering = commanded(robot, twists, time_step)
    batch, steps = speeds.shape[0], speeds.shape[1] - history
    count = len(robot.flippers)
    if flippers is not None and tuple(flippers.shape) != (batch, steps, count):
        raise ValueError(f"flippers: got shape {tuple(flippers.shape)}, expected [{batch}, {steps}, {count}]")
    if joint_start is not None and tuple(joint_start.shape) != (batch, len(robot.joints)):
        raise ValueError(f"joint start: got shape {tuple(joint_start.shape)}, expected [{batch}, {len(robot.joints)}]")
    if not steering.shape[-1] and flippers is None and joint_start is None:
        return Controls(speeds[:, history:])
    rest = speeds.new_zeros(0) if robot.joint_angles is None else robot.joint_angles.to(speeds)
    start = rest.expand(batch, -1)
    measured = None
    if joint_start is not None:
        measured = joint_start.to(speeds)
        start = torch.where(measured.isnan(), start, measured)
    angles, rates = start[:, None].expand(-1, steps, -1), torch.zeros_like(start)[:, None].expand(-1, steps, -1)
    driven = speeds[:, history:]
    if steering.shape[-1]:
        assert robot.steered is not None
        moved = list(robot.steered.joints)
        if measured is None or bool(measured[:, moved].isnan().any()):
            followed = _followed(robot, moved, steering, steering[:, 0], time_step)
            followed = followed[0][:, history:], followed[1][:, history:]
        if measured is not None:
            begin = measured[:, moved]
            if bool(begin.isnan().any()):
                begin = torch.where(begin.isnan(), followed[0][:, 0], begin)
                start = _placed(start[:, None], moved, begin[:, None])[:, 0]
            followed = _followed(robot, moved, steering[:, history:], begin, time_step)
        angles, rates = _placed(angles, moved, followed[0]), _placed(rates, moved, followed[1])
        driven = robot.steered.divided(driven, followed[0])
    if flippers is not None:
        moved = list(range(len(robot.joints) - count, len(robot.joints)))
        begin = start[:, moved]
        targets = flippers.to(speeds)
        targets = _flipper_targets(robot, torch.where(targets.isnan(), begin[:, None], targets), begin)
        turned, turning = _followed(robot, moved, targets, begin, time_step)
        angles, rates = _placed(angles, moved, turned), _placed(rates, moved, turning)
    return Controls(driven, angles, rates, start_angles=None if joint_start is None else start)


def _flipper_targets(robot: RobotModel, targets: Tensor, start: Tensor) -> Tensor:
    """Targets ``[B, T, F]`` with the robot's effects on flippers."""
    for name, parameters in robot.effects:
        effect = CATALOGUE[name]
        if effect.needs == "flippers":
            targets = effect.flipper_angles(targets, start, effect_values(name, parameters, targets), robot.flippers)
    return targets


def _followed(
    robot: RobotModel, joints: list[int], targets: Tensor, start: Tensor, time_step: float
) -> tuple[Tensor, Tensor]:
    """Angles and rates of joints ``[B, T, n]`` that follow commands within their limits."""
    chosen = [robot.joints[index] for index in joints]
    low, high = (targets.new_tensor([getattr(joint, name) for joint in chosen]) for name in ("low", "high"))
    lags, rates = (
        targets.new_tensor([getattr(joint, name) for joint in chosen]) for name in ("time_constant", "maximum_rate")
    )
    return servo_response(torch.minimum(torch.maximum(targets, low), high), start, lags, rates, time_step)


def _placed(values: Tensor, columns: list[int], entries: Tensor) -> Tensor:
    """Values ``[B, T, J]`` with other columns."""
    listed = list(values.unbind(-1))
    for column, entry in zip(columns, entries.unbind(-1), strict=True):
        listed[column] = entry
    return torch.stack(listed, dim=-1)
