"""Timing: effects that begin or grow in the middle of a recording, as values for each of its trajectories.

An effect of a robot file always acts. In a recording it may begin at some time (a load falls off, a belt tears) or grow
(a battery empties). The trajectories of a recording start at different times, and a parameter may have a value for each
trajectory ``[B]``: before the onset it is neutral, which leaves the trajectory unchanged bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.catalogue import CATALOGUE, EffectError, effect_values


def values_from(
    name: str, values: Mapping[str, float], starts: np.ndarray, onset: float, *, like: Tensor | None = None
) -> dict[str, Tensor]:
    """Values of all parameters for each trajectory of an effect that begins at ``onset``.

    Args:
        name: effect.
        values: its parameters once it acts; missing ones are neutral.
        starts: start of each trajectory since the recording's first stamp [s], ``[B]``.
        onset: time at which the effect begins, on the same clock [s].
        like: tensor with the precision and device of the result.

    Returns:
        Values ``[B]`` by parameter, neutral for trajectories that start before the onset. Those that contain it
        (:func:`contains`) are neither: leave them out.

    Raises:
        EffectError: as :func:`monoforce_ros.effects.effect_values`.
    """
    acting = torch.from_numpy(np.asarray(starts, float) >= onset)
    neutral = effect_values(name, {}, like)
    return {
        key: torch.where(acting.to(value.device), value, neutral[key])
        for key, value in effect_values(name, values, like).items()
    }


def values_growing(
    name: str,
    values: Mapping[str, float],
    starts: np.ndarray,
    since: float,
    until: float,
    *,
    like: Tensor | None = None,
) -> dict[str, Tensor]:
    """Values of all parameters for each trajectory of an effect that grows linearly from neutral.

    Args:
        name: effect, such as ``drive_gain`` for a battery that empties.
        values: its parameters at ``until`` and after.
        starts: start of each trajectory since the recording's first stamp [s], ``[B]``.
        since: time until which the effect is neutral [s].
        until: time from which it is complete [s].
        like: tensor with the precision and device of the result.

    Raises:
        EffectError: as :func:`values_from`; or a parameter has an infinite neutral value and cannot grow from it.
        ValueError: the growth takes no time.
    """
    if not until > since:
        raise ValueError(f"growth of {name}: got {since:g} s to {until:g} s, expected an end after the start")
    known = {parameter.name: parameter for parameter in CATALOGUE[name].parameters} if name in CATALOGUE else {}
    unbounded = [key for key in values if key in known and math.isinf(known[key].neutral)]
    if unbounded:
        raise EffectError(f"effect {name}: {unbounded} have no finite neutral value to grow from; use values_from")
    share = torch.from_numpy(np.clip((np.asarray(starts, float) - since) / (until - since), 0.0, 1.0))
    neutral = effect_values(name, {}, like)
    complete = effect_values(name, values, like)
    return {key: torch.lerp(neutral[key].expand(len(share)), value.expand(len(share)), share.to(value))
            for key, value in complete.items() if key in values} | {
        key: value for key, value in neutral.items() if key not in values
    }  # fmt: skip


def contains(starts: np.ndarray, duration: float, onset: float) -> np.ndarray:
    """Which trajectories contain the onset of an effect, ``[B]`` bool.

    Args:
        starts: start of each trajectory since the recording's first stamp [s], ``[B]``.
        duration: of a trajectory [s].
        onset: time at which the effect begins [s].
    """
    starts = np.asarray(starts, float)
    return (starts < onset) & (onset < starts + duration)
