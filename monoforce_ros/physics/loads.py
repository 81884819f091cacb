"""Loads other than contact: weight, drag, learned wrench and gyroscopic torque, for the PyTorch integrators.

``warp_kernels/loads.py`` has the same formulas as a device function; a test compares both.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from monoforce_ros.physics.problem import Problem
from monoforce_ros.physics.rotation import cross

SMALLEST_SPEED = 1e-6
"""Keeps the gradient of a speed finite at rest [m/s]."""


@dataclass(frozen=True)
class ExternalLoads:
    """Loads on a batch of bodies at one time, in terrain axes about the centre of mass."""

    force: Tensor
    """``[B, 3]`` [N]."""
    torque: Tensor
    """``[B, 3]`` [N m]."""
    drag: Tensor
    """Rate at which the force decreases with velocity, ``[B]`` [N s/m], for an implicit integrator."""


@dataclass(frozen=True)
class LoadModel:
    """Inputs of the loads other than the state; every entry may require gradients."""

    weight: Tensor
    """``[B, 3]`` [N]."""
    linear_drag: Tensor
    """``[B]`` [N s/m]."""
    quadratic_drag: Tensor
    """``[B]`` [N s²/m²]."""
    wrench: Tensor
    """Body-frame force and torque per feature of the motion, ``[B, 6, F]``."""

    @classmethod
    def of(cls, problem: Problem, gravity: float) -> LoadModel:
        """Loads of a problem under ``gravity`` [m/s²]."""
        _, linear, quadratic, _ = problem.resistance.unbind(-1)
        weight = problem.mass[:, None] * tilted_gravity(problem.gravity_tilt, gravity)
        return cls(weight, linear, quadratic, problem.wrench)

    def at(self, rotation: Tensor, velocity: Tensor, angular_velocity: Tensor, inertia: Tensor) -> ExternalLoads:
        """Loads in a state.

        Args:
            rotation: terrain ← base, ``[B, 3, 3]``.
            velocity: velocity of the centre of mass [m/s], ``[B, 3]``.
            angular_velocity: angular velocity in terrain axes [rad/s], ``[B, 3]``.
            inertia: inertia about the centre of mass in terrain axes [kg m²], ``[B, 3, 3]``.
        """
        in_body = rotation.transpose(1, 2) @ torch.stack([velocity, angular_velocity], dim=-1)
        extra = (self.wrench @ motion_features(in_body, rotation)[..., None])[..., 0]
        speed = torch.sqrt((velocity * velocity).sum(-1) + SMALLEST_SPEED**2)
        drag = self.linear_drag + self.quadratic_drag * speed
        gyroscopic = cross(angular_velocity, (inertia @ angular_velocity[..., None])[..., 0])
        return ExternalLoads(
            force=self.weight - drag[:, None] * velocity + (rotation @ extra[:, :3, None])[..., 0],
            torque=(rotation @ extra[:, 3:, None])[..., 0] - gyroscopic,
            drag=drag,
        )


def tilted_gravity(tilt: Tensor, gravity: float) -> Tensor:
    """Gravity ``[B, 3]`` [m/s²] rotated about the y axis, then the x axis, by ``tilt`` ``[B, 2]`` (x, y) [rad]."""
    about_x, about_y = tilt.unbind(-1)
    level = torch.cos(about_y)
    return -gravity * torch.stack([torch.sin(about_y), -torch.sin(about_x) * level, torch.cos(about_x) * level], -1)


def motion_features(in_body: Tensor, rotation: Tensor) -> Tensor:
    """Features ``[B, F]`` (:data:`monoforce_ros.effects.FEATURES`) of the body-frame velocities ``[B, 3, 2]``."""
    forward, left, rate = in_body[:, 0, 0], in_body[:, 1, 0], in_body[:, 2, 1]
    listed = [torch.ones_like(forward), forward, left, rate]
    listed += [forward * forward.abs(), left * left.abs(), rate * rate.abs(), forward * rate, left * rate]
    return torch.stack([*listed, rotation[:, 2, 0], rotation[:, 2, 1]], dim=-1)
