"""Observation: the sensor data of one time; TerrainSource: the interface that turns it into a terrain map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from monoforce_ros.core import CameraModel, MotionState, MotionTrack
from monoforce_ros.terrain import Grid, TerrainMap


@dataclass(frozen=True)
class Observation:
    """Sensor data of one time."""

    stamp: int
    """[ns]."""
    cloud: np.ndarray | None = None
    """Lidar returns ``[n, 3]`` [m] in the base frame."""
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    """RGB pixels ``[height, width, 3]`` of each camera, by an arbitrary name."""
    cameras: Mapping[str, CameraModel] = field(default_factory=dict)
    base_from_cameras: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Pose ``[4, 4]`` of each camera in the base frame."""
    flipper_angles: np.ndarray | None = None
    """Measured angles of the robot's flippers ``[F]`` [rad], NaN where unknown; None: as in its file."""
    track: MotionTrack | None = None
    """Measured motion of the base, from which sources know the ground that the robot drove over; they do not look at
    what comes after ``stamp``. None: they know it where they were asked for a map."""


class TerrainSource(Protocol):
    """Makes a map of the ground around the robot."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors that an observation must contain: ``lidar``, ``camera``, both or none."""

    @property
    def grid(self) -> Grid:
        """Cells of the maps."""

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Map in the terrain frame (origin at the robot, x along its heading, z up)."""


class DerivedTerrain:
    """Maps made of those of another source: its sensors and its grid.

    Args:
        source: the other source.
    """

    def __init__(self, source: TerrainSource):
        self._source = source

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors of the source."""
        return self._source.sensors

    @property
    def used(self) -> tuple[str, ...] | None:
        """Sensors of which the source made its last map, if it says so."""
        return getattr(self._source, "used", None)

    @property
    def grid(self) -> Grid:
        """Grid of the source."""
        return self._source.grid


def used_sensors(source: TerrainSource, observation: Observation) -> tuple[str, ...]:
    """Sensors of which a source made its last map: those that it says (``used``), else all that had measured.

    A covered lidar measures too little to be used beside images.
    """
    used: tuple[str, ...] | None = getattr(source, "used", None)
    if used is not None:
        return used
    measured = {"lidar": observation.cloud is not None, "camera": bool(observation.images)}
    return tuple(name for name in source.sensors if measured[name])
