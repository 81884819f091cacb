"""Fusion of a lidar and cameras: surfaces measured by the lidar, compliance predicted from images."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from monoforce_ros.core import MotionState
from monoforce_ros.perception.clearance import clear_of_robot
from monoforce_ros.perception.lidar import LidarTerrain
from monoforce_ros.perception.observation import Observation, TerrainSource
from monoforce_ros.terrain import Grid, TerrainError, TerrainMap

_RIGID_BELOW, _COMPLIANT_FROM = 0.02, 0.06
"""Compliance (H_g − H_t of the encoder) up to which a surface counts as rigid, and from which on as compliant [m]."""
_HEIGHT_TOLERANCE = 0.25
"""How far a compliant surface measured by the lidar may lie above the surface that the encoder predicts [m]."""


def apply_compliance(lidar: TerrainMap, camera: TerrainMap) -> TerrainMap:
    """The lidar's surfaces, lowered to the predicted supporting ground where the encoder predicts that they are
    compliant (H_d).

    Material is blended likewise: compliant cells take the encoder's, rigid ones that of the lidar's map. The encoder's
    material is fitted to trajectories on all kinds of ground; on rigid ground the configured one predicts better.

    Args:
        lidar: map from a lidar.
        camera: map from an encoder, on the same grid.
    """
    compliance, share = _compliance(camera)
    height = lowered_where_compliant(lidar.height, camera, camera.height)
    surfaces = replace(
        material_by_compliance(lidar, camera), height=height, geometric_height=height + share * compliance
    )
    return replace(surfaces, observed=lidar.observed | camera.observed)


def lowered_where_compliant(surface: Tensor, predicted: TerrainMap, ground: Tensor) -> Tensor:
    """A measured surface ``[rows, columns]`` [m], lowered to the supporting ground, shaped like it, where a predicted
    map says that it is compliant (H_d)."""
    compliance, share = _compliance(predicted)
    # A surface far above the predicted one is another object, which the encoder has not recognised.
    above = (surface - ground).clamp_min(0.0)
    return surface - share * torch.minimum(above, compliance + _HEIGHT_TOLERANCE)


def material_by_compliance(rigid: TerrainMap, predicted: TerrainMap) -> TerrainMap:
    """A predicted map with the material of another one where it is rigid, and its own where it is compliant (H_d)."""
    _, share = _compliance(predicted)
    return replace(
        predicted,
        stiffness=torch.lerp(rigid.stiffness, predicted.stiffness, share),
        damping=torch.lerp(rigid.damping, predicted.damping, share),
        friction=torch.lerp(rigid.friction, predicted.friction, share),
    )


def _compliance(terrain: TerrainMap) -> tuple[Tensor, Tensor]:
    """H_d [m], and how far a cell counts as compliant, 0 to 1."""
    compliance = (terrain.geometric_height - terrain.height).clamp_min(0.0)
    return compliance, ((compliance - _RIGID_BELOW) / (_COMPLIANT_FROM - _RIGID_BELOW)).clamp(0.0, 1.0)


@dataclass
class LidarCameraTerrain:
    """Lidar heights, lowered by the compliance that an encoder of images predicts (H_d); both on the encoder's grid.

    For encoders that take no sweeps; others make one map of both sensors.
    A lidar locates walls accurately but measures the top of grass; an encoder recognises grass, but its heights are
    less accurate.
    """

    lidar: LidarTerrain
    camera: TerrainSource
    """Source of the encoder's maps, with or without temporal memory."""
    sensors: ClassVar[tuple[str, ...]] = ("lidar", "camera")
    used: tuple[str, ...] = field(default=(), init=False)
    """Sensors of which the last map was made: a sweep with too few points is left out beside images."""

    @property
    def grid(self) -> Grid:
        """The encoder's grid."""
        return self.camera.grid

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Fused map, or the map of the only available sensor; raises ``ValueError`` if neither suffices."""
        self.used = ("camera",)
        if observation.cloud is None:
            return self.camera.terrain(observation, motion)
        if not observation.images:
            self.used = ("lidar",)
            return self.lidar.terrain(observation, motion)
        seen = self.camera.terrain(observation, motion)
        try:
            measured = self.lidar.terrain(observation, motion)
        except TerrainError:
            return seen
        self.used = self.sensors
        fused = apply_compliance(measured, seen)
        # What is still high is rigid.
        return clear_of_robot(fused, self.lidar.robot, motion)
