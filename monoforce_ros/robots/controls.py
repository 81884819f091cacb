"""Controls: speeds of the drives and angles of the joints over a rollout."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Controls:
    """Inputs of a rollout at each step; every tensor may require gradients."""

    drive_speeds: Tensor
    """Surface speed of each drive during each step [m/s], ``[B, T, D]``; of a drive with motor limits, its command."""
    joint_angles: Tensor | None = None
    """Angle of each joint at the beginning of each step [rad], ``[B, T, J]``; of a joint with dynamics, its target.
    None holds the robot's angles."""
    joint_rates: Tensor | None = None
    """Rate of each joint during each step [rad/s], ``[B, T, J]``; None: the joints stand still."""
    start_angles: Tensor | None = None
    """Angles of joints with dynamics at the start [rad], ``[B, J]``; None: their first target."""
    start_rates: Tensor | None = None
    """Their rates at the start [rad/s], ``[B, J]``; None: zero."""
