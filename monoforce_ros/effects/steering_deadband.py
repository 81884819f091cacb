"""Loose steering."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory


class SteeringDeadband(Effect):
    """Loose steering."""

    name = "steering_deadband"
    stage = "command"
    summary = (
        "Loose steering: within the play the wheels stay as they are, and the caster trail straightens them while the "
        "robot drives forwards."
    )
    formula = "dδ/ds = -alignment δ, δ_cmd - width ≤ δ ≤ δ_cmd + width"
    source = "play in the linkage (backlash); a wheel that trails its steering axis, over the way s"
    cause = "play in the steering"
    remedy = "look for play in rods, joints and gear of the steering"
    parameters = (
        Parameter("width", "rad", 0.0, 0.0, 0.5, 0.03, "half of the play"),
        Parameter("alignment", "1/m", 1.0, 0.0, 20.0, 0.5, "share by which the wheels straighten in a metre"),
    )
    order = 44
    needs = "steering"
    identified = ("width", "alignment")
    manoeuvre = "slight and sharp turns to both sides"

    def steering_angles(self, angles: Tensor, speeds: Tensor, values: Values, time_step: float) -> Tensor:
        """Steering angles with this effect applied; see :class:`Effect`."""
        width = per_trajectory(values["width"], 3)
        kept = torch.exp(-per_trajectory(values["alignment"], 3) * speeds.mean(-1, keepdim=True) * time_step)
        low, high = angles - width, angles + width
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (angles, kept, width)):
            angle, listed = angles[:, 0].expand_as(high[:, 0]), []
            for share, least, most in zip(kept.unbind(1), low.unbind(1), high.unbind(1), strict=True):
                angle = torch.minimum(torch.maximum(share * angle, least), most)
                listed.append(angle)
            return torch.stack(listed, 1)
        return torch.from_numpy(_within(*(tensor.cpu().numpy() for tensor in (angles, kept, low, high)))).to(angles)

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return f"The steering has a play of ±{math.degrees(values['width']):.1f}°."


def _within(angles: np.ndarray, kept: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    # Time first, as in robots/servo.py: torch takes several times longer for so little work per step.
    shares, least, most = (np.ascontiguousarray(np.moveaxis(values, 1, 0)) for values in (kept, low, high))
    result = np.empty_like(least)
    angle = np.broadcast_to(angles[:, 0], least[0].shape)
    for index in range(len(least)):
        result[index] = angle = np.clip(shares[index] * angle, least[index], most[index])
    return np.moveaxis(result, 0, 1)
