"""Ramp: a signal that follows its target at a limited rate, for the effects that limit accelerations."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.effect import per_trajectory
from monoforce_ros.effects.recurrence import follow


def ramped(target: Tensor, rate: Tensor, time_step: float) -> Tensor:
    """The signal that follows ``target`` ``[B, T]``, changing by at most ``rate`` per second.

    Args:
        target: its first value is assumed to have been reached.
        rate: largest change per second, a scalar or ``[B]``; infinite returns ``target`` bit for bit.
        time_step: time between values [s].
    """
    return follow(target, per_trajectory(rate, 1) * time_step)


def ramped_array(target: np.ndarray, rate: np.ndarray | float, time_step: float) -> np.ndarray:
    """The same for arrays ``[..., T]``, at the stamps of the targets (:func:`at_stamps`).

    Args:
        target: see :func:`ramped`.
        rate: a scalar, or ``[..., 1]``.
        time_step: time between values [s].
    """
    rows = torch.from_numpy(np.ascontiguousarray(target).reshape(-1, target.shape[-1]))
    rates = np.broadcast_to(rate, (*target.shape[:-1], 1)).ravel()
    followed = follow(rows, torch.tensor(rates * time_step, dtype=rows.dtype))
    return at_stamps(followed.numpy().reshape(target.shape))


def at_stamps(result: np.ndarray) -> np.ndarray:
    """Values ``[..., T]`` at the stamps of targets, from those that a filter reaches with each of them.

    A filter acts on a target for a whole time step. A target that was sampled changed half a step before its stamp on
    average, so that the filter is early by half a step.
    """
    return np.concatenate([result[..., :1], 0.5 * (result[..., 1:] + result[..., :-1])], axis=-1)
