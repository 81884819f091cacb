"""SoilContact: pressure, shear and slip sinkage where a surface touches soft ground.

``warp_kernels/soil.py`` has the same formulas as device functions; a test compares both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

SHALLOWEST = 5e-4
"""Depth below which pressure is linear, so that its stiffness is finite for exponents below 1 [m]. At 1 cm it changes
the pressure by 0.1 %."""
FACING = 0.1
"""Range of the cosine between a face and the ground in which a face that turns away from the soil loses contact."""
SMALLEST_CURVATURE = 0.01
"""Of the straight runs of a track [1/m]: at a few centimetres of depth, their points count as metres behind the front
end of the contact, where shear is fully mobilised."""


@dataclass(frozen=True)
class SoilPressure:
    """Forces of soft ground per contact area."""

    load: Tensor
    """Pressure that friction acts on, ``[B, N]`` [Pa]."""
    pressing: Tensor
    """Pressure over the step, as the implicit integrator takes it, ``[B, N]`` [Pa]."""
    gain: Tensor
    """Rate at which it decreases with velocity, ``[B, N]`` [Pa s/m]."""
    shear: Tensor
    """Mobilised shear strength, ``[B, N]`` [Pa]."""


@dataclass(frozen=True)
class SoilContact:
    """Soft ground under surfaces: Bekker's pressure along the surface's normal and Janosi's shear along the surface.

    Pressure ``p = (k_c / b + k_φ) (z / K_ss)^n (1 + rate ż)`` at depth z, width b and sinking speed ż. Soil does not
    follow a surface that leaves it, so that pressure falls to zero at the unloading speed. At slip ratio i the soil is
    carried away from below the wheel, ``K_ss = 1 + s (3 i / 2) / (1 - i / 2)`` (Lyasko; 4 when it spins on the spot).
    Shear ``(c + p tan φ) (1 - exp(-j / K))``, where j is the slip speed times the time since the surface's entry.
    """

    parameters: Tensor
    """``[B, 9]``, in the order of the fields of :class:`monoforce_ros.physics.soil.Soil`."""
    faces: Tensor
    """Outward normals of all surfaces in terrain axes, belts included, ``[B, 3, N]``."""
    widths: Tensor
    """Smaller edge length of each surface, ``[N]`` [m]."""
    curvatures: Tensor
    """Along the belt, ``[N]`` [1/m]; 0 on straight runs."""
    belted: Tensor
    """1 on belts, 0 on the hull, ``[N]``."""

    def part(self, chosen: Tensor) -> SoilContact:
        """The same for some of the points ``[n]`` (indices)."""
        return replace(
            self,
            faces=self.faces[..., chosen],
            widths=self.widths[chosen],
            curvatures=self.curvatures[chosen],
            belted=self.belted[chosen],
        )

    def direction(self, ground: Tensor, firm: Tensor, soft: Tensor) -> tuple[Tensor, Tensor]:
        """Direction in which the ground pushes ``[B, 3, N]``, and the share of a face that lies on soil ``[B, N]``.

        Args:
            ground: normal of the ground, ``[B, 3, N]``.
            firm: direction in which rigid ground would push, ``[B, 3, N]``.
            soft: 1 on soil, 0 on ground too steep for it, ``[B, N]``.
        """
        # A surface without a normal is pushed along the ground's.
        push = (1.0 - (self.faces * self.faces).sum(1, keepdim=True)) * ground - self.faces
        facing = (1.0 + (push * ground).sum(1) / FACING).clamp(0.0, 1.0)
        mixed = soft[:, None] * push + (1.0 - soft)[:, None] * firm
        return mixed * torch.rsqrt((mixed * mixed).sum(1, keepdim=True) + 1e-12), facing

    def pressure(
        self,
        depth: Tensor,
        approach: Tensor,
        slip: Tensor,
        travel: Tensor,
        rolling: Tensor,
        belt: Tensor,
        entering: Tensor,
        softness: Tensor,
        step_time: float,
        slowest: float,
    ) -> SoilPressure:
        """Pressure and shear strength of soil.

        Args:
            depth: of the points below the surface, ``[B, N]`` [m].
            approach: speed at which a surface moves into the soil, ``[B, N]`` [m/s].
            slip: of the surface along the belt and across it, ``[B, 2, N]`` [m/s].
            travel: speed of the body along the ground in the belt's plane, ``[B, N]`` [m/s].
            rolling: speed of the body along the surface, ``[B, N]`` [m/s]; 0 on wheels that roll freely.
            belt: speed of the belt along the surface, ``[B, N]`` [m/s].
            entering: speed of the belt downwards into the ground, ``[B, N]`` [m/s].
            softness: divisor of the moduli, ``[B, N]`` or ``[B, 1]``.
            step_time: time over which the pressure follows the motion [s].
            slowest: regularisation of all speeds [m/s].
        """
        k_c, k_phi, n, cohesion, friction, shear, rate, sinkage, unloading = self.parameters[..., None].unbind(1)
        depth = depth.clamp_min(1e-9)
        turning = torch.sqrt(belt * belt + slowest**2)
        fastest = torch.maximum(turning, torch.sqrt(travel * travel + slowest**2))
        along, across = slip.unbind(1)
        # The slip of the whole wheel: its surface slips along itself in front even where it rolls.
        sliding = torch.sqrt((travel + belt) ** 2 + across * across + slowest**2)
        ratio = self.belted * ((sliding - slowest) / fastest).clamp_max(1.0)
        dug = 1.0 + sinkage * 1.5 * ratio / (1.0 - 0.5 * ratio)
        sunk = depth / dug
        square = sunk * sunk + SHALLOWEST**2
        stiffness = (k_c / self.widths + k_phi) / softness * square ** (0.5 * (n - 1.0))
        static = stiffness * sunk
        slope = stiffness * (1.0 + (n - 1.0) * sunk * sunk / square) / dug
        sinking = approach >= 0.0
        follows = 1.0 + approach * torch.where(sinking, rate, 1.0 / unloading)
        holds = follows.clamp_min(0.0)
        load = static * holds
        pressing = load + step_time * slope * holds * approach
        # The pressure is gone at the unloading speed. This secant, other than the tangent, keeps a step from throwing
        # the surface out of the soil, and with it a robot at rest from rattling.
        fading = (follows > 0.0) / (approach.clamp_min(0.0) + unloading)
        gain = (static * (rate * sinking + fading) + step_time * slope * holds) * (pressing > 0.0)
        # Way of the belt since it entered the soil, on a circle of the belt's curvature (second order in the angle).
        curvature = self.curvatures.clamp_min(SMALLEST_CURVATURE)
        incline = entering / turning
        reach = incline.abs() + torch.sqrt(incline * incline + 2.0 * depth * curvature)
        way = torch.where(incline >= 0.0, 2.0 * depth / reach, reach / curvature)
        # Mean slip along this way: the surface turns against its direction of travel.
        along = along - rolling * curvature * way * (0.5 * incline + curvature * way / 6.0)
        displacement = torch.sqrt(along * along + across * across + slowest**2) * way / turning
        mobilised = 1.0 - torch.exp(-displacement / shear)
        strength = (friction * load + cohesion * holds.clamp_max(1.0)) * mobilised
        return SoilPressure(load, pressing.clamp_min(0.0), gain, strength)
