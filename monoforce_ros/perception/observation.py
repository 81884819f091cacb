"""Observation: what the sensors measured at one time, and what makes a map of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from monoforce_ros.core import CameraModel, MotionState
from monoforce_ros.terrain import Grid, TerrainMap


@dataclass(frozen=True)
class Observation:
    """What the sensors saw at one time."""

    stamp: int
    """[ns]."""
    cloud: np.ndarray | None = None
    """Lidar returns ``[n, 3]`` [m] in the base frame."""
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    """RGB pixels ``[height, width, 3]`` of each camera, by any name."""
    cameras: Mapping[str, CameraModel] = field(default_factory=dict)
    base_from_cameras: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Pose ``[4, 4]`` of each camera in the base frame."""


class TerrainSource(Protocol):
    """Makes a map of the ground around the robot."""

    sensors: ClassVar[tuple[str, ...]]
    """What an observation must hold: ``lidar``, ``camera``, both or nothing."""
    grid: Grid
    """Where the maps' cells lie."""

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Map in the terrain frame (origin at the robot, x along its heading, z up)."""
