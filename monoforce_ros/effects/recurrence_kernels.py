"""Recurrences over time as compiled kernels: a step depends on the one before, so that array operations are many and
small. Import this module only where Warp is installed (:mod:`recurrence`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import warp as wp
from torch import Tensor

from monoforce_ros.core import start_warp

start_warp()


@wp.kernel
def _follow(target: wp.array2d(dtype=Any), change: wp.array(dtype=Any), result: wp.array2d(dtype=Any)):
    row = wp.tid()
    state = target[row, 0]
    for index in range(target.shape[1]):
        state = wp.min(wp.max(target[row, index], state - change[row]), state + change[row])
        result[row, index] = state


@wp.kernel
def _droop(
    wanted: wp.array2d(dtype=Any), loss: wp.array(dtype=Any), share: wp.array(dtype=Any), result: wp.array2d(dtype=Any)
):
    row = wp.tid()
    # Drives at rest hold nothing; Warp's sign of zero is one.
    held = wanted.dtype(0.0)
    if wanted[row, 0] > wanted.dtype(0.0):
        held = loss[row]
    if wanted[row, 0] < wanted.dtype(0.0):
        held = -loss[row]
    for index in range(wanted.shape[1]):
        load = wp.clamp(wanted[row, index] + held, -loss[row], loss[row])
        result[row, index] = load - held
        held = held + share[row] * (load - held)


@wp.kernel
def _follow_loaded(
    target: wp.array3d(dtype=Any),
    change: wp.array(dtype=Any),
    load: wp.array(dtype=Any),
    turning: wp.array(dtype=Any),
    result: wp.array3d(dtype=Any),
):
    row = wp.tid()
    drives = target.shape[2]
    for index in range(target.shape[1]):
        before = wp.max(index - 1, 0)
        mean = target.dtype(0.0)
        for drive in range(drives):
            if index == 0:
                mean += target[row, 0, drive] / target.dtype(drives)
            else:
                mean += result[row, before, drive] / target.dtype(drives)
        for drive in range(drives):
            state = target[row, 0, drive]
            if index > 0:
                state = result[row, before, drive]
            braked = target.dtype(0.0)
            if wp.isfinite(change[row]):
                share = wp.clamp((state - mean) / turning[row], target.dtype(-1.0), target.dtype(1.0))
                braked = load[row] * change[row] * share
            wanted = wp.max(target[row, index, drive], state - change[row] - braked)
            result[row, index, drive] = wp.min(wanted, state + change[row] - braked)


def _overloads(kernel: wp.Kernel, factors: int, signal: Any = wp.array2d) -> dict[torch.dtype, wp.Kernel]:
    """A kernel of a signal and some factors for each floating point type."""
    return {
        torch_type: wp.overload(
            kernel, [signal(dtype=warp_type), *[wp.array(dtype=warp_type)] * factors, signal(dtype=warp_type)]
        )
        for torch_type, warp_type in ((torch.float32, wp.float32), (torch.float64, wp.float64))
    }


_FOLLOW, _DROOP = _overloads(_follow, 1), _overloads(_droop, 2)
_FOLLOW_LOADED = _overloads(_follow_loaded, 3, wp.array3d)


def follow(target: Tensor, change: Tensor) -> Tensor:
    """See :func:`monoforce_ros.effects.recurrence.follow`."""
    return _launched(_FOLLOW, target, change)


def droop(wanted: Tensor, loss: Tensor, share: Tensor) -> Tensor:
    """See :func:`monoforce_ros.effects.recurrence.droop`."""
    return _launched(_DROOP, wanted, loss, share)


def follow_loaded(target: Tensor, change: Tensor, load: Tensor, turning: float) -> Tensor:
    """See :func:`monoforce_ros.effects.recurrence.follow_loaded`."""
    return _launched(_FOLLOW_LOADED, target, change, load, torch.tensor(turning, dtype=torch.float64))


def _launched(kernels: Mapping[torch.dtype, wp.Kernel], signal: Tensor, *factors: Tensor) -> Tensor:
    """What a kernel makes of ``signal`` ``[R, T]`` or ``[R, T, D]`` with factors, scalars or ``[R]``."""
    signal = signal.detach().contiguous()
    result = torch.empty_like(signal)
    rows = [factor.detach().to(signal).expand(len(signal)).contiguous() for factor in factors]
    # Arrays of Warp's own take longer to make than a kernel takes on some hundred rows.
    arrays = [wp.from_torch(entry, return_ctype=True) for entry in (signal, *rows, result)]
    device = wp.device_from_torch(signal.device)
    wp.launch(kernels[signal.dtype], len(signal), inputs=arrays[:-1], outputs=arrays[-1:], device=device)
    return result
