"""JointMotion: measured angles of a robot's joints, and how its flippers go on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from monoforce_ros.robots import RobotModel


@dataclass(frozen=True)
class JointMotion:
    """Joints at the start of a prediction; steering then follows the commands, flippers these targets."""

    start: np.ndarray
    """Angles of all joints ``[J]``, or ``[B, J]`` for each prediction of a batch [rad]; NaN where unknown."""
    flipper_targets: np.ndarray
    """Commanded angles of the flippers at the start ``[F]`` [rad]."""
    flipper_rates: np.ndarray
    """Rates at which these change ``[F]`` [rad/s]; 0 holds them."""
    program: np.ndarray | None = None
    """Commanded angles of the flippers at each step ``[B, T, F]`` [rad] instead, NaN where unknown."""

    @classmethod
    def recorded(cls, start: np.ndarray, program: np.ndarray | None) -> JointMotion:
        """Of a recording: measured angles ``[B, J]`` and the program of the flippers ``[B, T, F]`` [rad]."""
        return cls(start, np.zeros(0), np.zeros(0), program)

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        angles: np.ndarray,
        rates: np.ndarray,
        targets: np.ndarray | None = None,
        target_rates: np.ndarray | None = None,
    ) -> JointMotion:
        """From measurements and commands, in which NaN stands for what is not known.

        Args:
            robot: joints that were not measured are at the angles of its file.
            angles, rates: measured, ``[J]`` [rad, rad/s]; flippers without a command go on at their rates.
            targets, target_rates: commands for the joints, ``[J]`` [rad, rad/s].
        """
        assert robot.joint_angles is not None
        at_rest = robot.joint_angles.double().cpu().numpy()
        start = np.where(np.isfinite(angles), angles, at_rest)
        unknown = np.full(len(start), np.nan)
        wanted = unknown if targets is None else targets
        wanted_rates = unknown if target_rates is None else target_rates
        commanded = np.isfinite(wanted) | np.isfinite(wanted_rates)
        going_on = np.where(np.isfinite(rates), rates, 0.0)
        # A commanded angle is the target, whatever speed comes with it; a commanded speed alone turns the joint.
        moving = np.where(np.isfinite(wanted), 0.0, wanted_rates)
        flippers = slice(len(start) - len(robot.flippers), None)
        return cls(
            start=start,
            flipper_targets=np.where(np.isfinite(wanted), wanted, start)[flippers],
            flipper_rates=np.where(commanded, moving, going_on)[flippers],
        )

    def flippers(self, batch: int, steps: int, time_step: float) -> torch.Tensor | None:
        """Commanded angles of the flippers over a horizon, ``[B, T, F]`` [rad]; None without flippers."""
        if self.program is not None:
            return torch.as_tensor(self.program, dtype=torch.float32)
        if not len(self.flipper_targets):
            return None
        times = time_step * np.arange(1, steps + 1)[:, None]
        angles = self.flipper_targets + self.flipper_rates * times
        return torch.as_tensor(angles, dtype=torch.float32).expand(batch, -1, -1)
