"""Recurrences over time: signals whose next value depends on the one before, for effects of the drives."""

from __future__ import annotations

import importlib
from functools import cache
from types import ModuleType

import torch
from torch import Tensor


def follow(target: Tensor, change: Tensor) -> Tensor:
    """The signal that follows ``target`` ``[R, T]`` and changes by at most ``change``, a scalar or ``[R]``, a step.

    Its first value is assumed to have been reached; an infinite change returns ``target`` bit for bit.
    """
    kernels = _kernels(target, change)
    if kernels is not None:
        return kernels.follow(target, change)
    state = target[:, 0]
    values = []
    for wanted in target.unbind(1):
        state = torch.minimum(torch.maximum(wanted, state - change), state + change)
        values.append(state)
    return torch.stack(values, dim=1)


def droop(wanted: Tensor, loss: Tensor, share: Tensor) -> Tensor:
    """What drives lose of ``wanted`` ``[R, T]`` to dry friction until integral action restores it, ``[R, T]``.

    Args:
        wanted: signal; its first value has been held for long.
        loss: friction in units of the signal, a scalar or ``[R]``.
        share: of what is lost that integral action takes back in a step, a scalar or ``[R]``.
    """
    kernels = _kernels(wanted, loss, share)
    if kernels is not None:
        return kernels.droop(wanted, loss, share)
    held = loss * torch.sign(wanted[:, 0])
    lost = []
    for value in wanted.unbind(1):
        lost.append(torch.clamp(value + held, -loss, loss) - held)
        held = held + share * lost[-1]
    return torch.stack(lost, dim=1)


def follow_loaded(target: Tensor, change: Tensor, load: Tensor, turning: float) -> Tensor:
    """Drives that follow ``target`` ``[B, T, D]`` with what a load that turning puts on them leaves of their change.

    A drive that runs faster than the mean of all, by at least ``turning``, is braked by the load: it speeds up by less
    and slows down by more. One that runs slower is driven by it.

    Args:
        target: its first values are assumed to have been reached.
        change: largest change in a step, a scalar or ``[B]``; infinite returns ``target`` bit for bit.
        load: share of it, a scalar or ``[B]``, below one.
        turning: difference from the mean at which the load is whole, in units of the signal.
    """
    kernels = _kernels(target, change, load)
    if kernels is not None:
        return kernels.follow_loaded(target, change, load, turning)
    change, load = (factor.reshape(-1, 1) for factor in (change, load))
    if bool(torch.isinf(change).all()):
        return target
    # Of limits that are none a step of zero load keeps products finite.
    taken = torch.where(torch.isinf(change), 0.0, load * change)
    state = target[:, 0]
    values = []
    for wanted in target.unbind(1):
        apart = state - state.mean(dim=-1, keepdim=True)
        braked = taken * torch.clamp(apart / turning, -1.0, 1.0)
        state = torch.minimum(torch.maximum(wanted, state - change - braked), state + change - braked)
        values.append(state)
    return torch.stack(values, dim=1)


def _kernels(*tensors: Tensor) -> ModuleType | None:
    """The compiled kernels; None where gradients are asked for, or Warp is not installed."""
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return None
    return _compiled()


@cache
def _compiled() -> ModuleType | None:
    try:
        return importlib.import_module("monoforce_ros.effects.recurrence_kernels")
    except ImportError as error:
        if error.name != "warp":
            raise
        return None
