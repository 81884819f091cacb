"""Setup: terrain, robot and additional loads that a rollout integrates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

FEATURES = ("1", "vx", "vy", "wz", "vx|vx|", "vy|vy|", "wz|wz|", "vx wz", "vy wz", "pitch", "roll")
"""Features of a learned body wrench: body-frame velocity of the centre of mass [m/s], yaw rate [rad/s], and the sines
of pitch (nose up) and roll (left side up)."""


FEATURE_SIZES = (1.0, 0.5, 1.0, 0.5, 0.3, 1.0, 0.3, 1.0, 1.0, 1.0, 1.0)
"""Typical magnitude of each feature in a recording, for comparing their weights."""


@dataclass(frozen=True)
class Loads:
    """Loads other than weight and contact; each is a scalar or ``[B]`` unless noted otherwise. Zero means none."""

    gravity_tilt: Tensor
    """Tilt of gravity about the terrain frame's x and y axes [rad], ``[2]`` or ``[B, 2]``."""
    rolling_resistance: Tensor
    """Force against rolling as a fraction of the load on each point [-]."""
    linear_drag: Tensor
    """Force against the velocity of the centre of mass [N s/m]."""
    quadratic_drag: Tensor
    """Force against the velocity of the centre of mass, times its speed [N s²/m²]."""
    vegetation_drag: Tensor
    """Force against motion per contact area, speed and height of the vegetation above the ground [N s/m⁴]."""
    vegetation_yield: Tensor
    """Speed at which the speed-independent bending force of vegetation equals its viscous drag [m/s]."""
    wrench: Tensor
    """Body-frame force [N] and torque [N m] per feature of ``FEATURES``, ``[6, F]`` or ``[B, 6, F]``."""
    friction_creep: Tensor
    """Factor on the slip at which friction on firm ground is mobilised [-]; one, not zero, is the physics' own."""
    drive_compliance: Tensor | None = None
    """Surface speed that a drive loses when it pulls with as much as the load on its wheel [m/s]; None: drives hold
    their speed, which takes less computing than a loss of zero."""
    tyre_slip: Tensor | None = None
    """Slip over rolling speed at which 71 % of the friction is mobilised [-]; None: friction does not depend on the
    rolling speed."""

    @classmethod
    def none(cls, like: Tensor) -> Loads:
        """No additional load, with the precision and device of ``like``."""
        zero = torch.zeros((), dtype=like.dtype, device=like.device)
        return cls(zero.expand(2), zero, zero, zero, zero, zero, zero.expand(6, len(FEATURES)), torch.ones_like(zero))

    def with_wrench(self, row: int, feature: str, weight: Tensor) -> Loads:
        """These loads with one more term of the body wrench.

        Args:
            row: 0, 1, 2 for the force along body x, y, z [N]; 3, 4, 5 for the torque about them [N m].
            feature: one of :data:`FEATURES`.
            weight: weight of the feature, a scalar or ``[B]``.
        """
        selected = torch.zeros(6, len(FEATURES), dtype=self.wrench.dtype, device=self.wrench.device)
        selected[row, FEATURES.index(feature)] = 1.0
        return replace(self, wrench=self.wrench + weight.to(self.wrench)[..., None, None] * selected)


@dataclass(frozen=True)
class Setup:
    """Terrain, robot and loads; contact and body effects modify them."""

    terrain: TerrainMap
    robot: RobotModel
    loads: Loads
    softness: Tensor
    """Divisor of the terrain's stiffness and damping [-], a scalar or ``[B]``; 1 keeps the map's values. It is not part
    of the map, because a map for each trajectory would exceed the memory."""

    @classmethod
    def plain(cls, terrain: TerrainMap, robot: RobotModel) -> Setup:
        """A setup without effects."""
        like = robot.points
        return cls(terrain, robot, Loads.none(like), torch.ones((), dtype=like.dtype, device=like.device))
