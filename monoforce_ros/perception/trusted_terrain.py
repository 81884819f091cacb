"""TrustedTerrain: an encoder's terrain to the degree that the ground has confirmed it, and a fallback otherwise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from monoforce_ros.core import MotionState
from monoforce_ros.perception.encoder_terrain import EncoderTerrain
from monoforce_ros.perception.ground_alignment import standing
from monoforce_ros.perception.lidar import usable_returns
from monoforce_ros.perception.observation import Observation, TerrainSource, used_sensors
from monoforce_ros.perception.seen_obstacles import SeenObstacles
from monoforce_ros.perception.temporal_memory import TemporalMemory
from monoforce_ros.perception.trust import BLOCK, FEWEST_BLOCKS, TerrainTrust, TrustReport
from monoforce_ros.terrain import Grid, LidarSettings, TerrainError, TerrainMap, cell_heights

_LEAST_MATERIAL = 1e-6
"""Stiffness, damping and friction that count as none, in their units."""
_SMALLEST_SPREAD = 1e-4
"""Below which a spread is none [m]."""


class TrustedTerrain:
    """An encoder's terrain to the degree that the ground has confirmed it, and a fallback otherwise.

    The encoder keeps predicting meanwhile, and is used again once it is no worse than level ground. What it makes of
    images beside a sweep says nothing of what it makes of images alone: each set of sensors earns trust for itself.

    Args:
        source: source of the encoder's maps, with or without temporal memory.
        encoder: the encoder's own source within it.
        fallbacks: sources of the maps where the encoder is not trusted; the first one whose sensors have measured
            enough.
        expected: see :class:`TerrainTrust`.
        memory: of earlier observations, which fill the map that results.
        obstacles: what images from several places show to stand on the ground, for maps without a sweep.
    """

    def __init__(
        self,
        source: TerrainSource,
        encoder: EncoderTerrain,
        fallbacks: Sequence[TerrainSource],
        expected: float = 0.0,
        memory: TemporalMemory | None = None,
        obstacles: SeenObstacles | None = None,
    ):
        self.source = source
        """Source of the encoder's maps."""
        self._encoder, self._fallbacks, self._memory = encoder, tuple(fallbacks), memory
        self._expected, self._obstacles = expected, obstacles
        self._trusts: dict[tuple[str, ...], TerrainTrust] = {}
        """By the sensors that an observation had."""
        self.report: TrustReport | None = None
        """Result of the last comparison; None before the first map."""
        self._fell_back_to: TerrainSource | None = None
        self._measured_at: np.ndarray | None = None
        """Where the robot was when predictions were last compared with a sweep ``[2]`` [m]."""
        self.predicted: TerrainMap | None = None
        """The encoder's last map, before any of it was replaced by the fallback's."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors of the source."""
        return self.source.sensors

    @property
    def grid(self) -> Grid:
        """Grid of the source."""
        return self.source.grid

    @property
    def fallback_report(self) -> TrustReport | None:
        """Report of the fallback of the last map, if that one has an encoder that has to be trusted, too."""
        return self._fell_back_to.report if isinstance(self._fell_back_to, TrustedTerrain) else None

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """The encoder's map or the fallback's; raises the source's errors."""
        self.predicted = predicted = self.source.terrain(observation, motion)
        other = self._fallback(observation, motion)
        encoder = self._encoder
        _, support = standing(encoder.robot, observation.flipper_angles, motion, encoder.stiffness)
        cameras = {}
        for name, pose in observation.base_from_cameras.items():
            axis = (motion.terrain_from_base @ pose)[:3, 2]
            cameras[name] = float(np.arctan2(axis[1], axis[0]))
        swept = "lidar" in used_sensors(self.source, observation)
        present = {"lidar": swept, "camera": bool(observation.images)}
        sensors = tuple(name for name in self.sensors if present[name])
        in_use = self._trusts.setdefault(sensors, TerrainTrust(self.grid, self._expected))
        measured = self._measured(observation, motion) if swept and present["camera"] else None
        for trust in self._trusts.values():
            if trust is not in_use:
                trust.follow(motion, support, measured)
        report = replace(
            in_use.update(motion, support, predicted, cameras, encoder.start_error, other, measured),
            sensors=sensors,
            missing=tuple(name for name in self.sensors if not present[name]),
        )
        if "camera" not in sensors:
            # Adaptation needs images.
            report = replace(report, remedy="use terrain_source lidar_interpolation")
        self.report = report
        used = blended(other, predicted, report.share, report.spread_factor)
        if not (report.trusted or other.spreads):
            used = _with_measured_error(used, report)
        if self._obstacles is not None and swept:
            self._obstacles.follow(observation, motion)
        elif self._obstacles is not None:
            # What looks soft need not be confirmed: it only takes back what stereo adds, to which hedges are walls.
            used = self._obstacles.added(used, predicted, observation, motion)
        return used if self._memory is None else self._memory.recalled(used, observation, motion, swept=swept)

    def _measured(self, observation: Observation, motion: MotionState) -> np.ndarray | None:
        """The visible surface that the lidar measures ``[n, 3]`` in the terrain frame [m], every half metre."""
        place = motion.position[:2]
        near = self._measured_at is not None and float(np.linalg.norm(place - self._measured_at)) < BLOCK
        if near or observation.cloud is None:
            return None
        self._measured_at = place.copy()
        robot, grid = self._encoder.robot, self.grid
        posed, support = standing(robot, observation.flipper_angles, motion, self._encoder.stiffness)
        points = usable_returns(observation.cloud, posed, motion, support, grid)
        heights, hit = cell_heights(points, grid, replace(LidarSettings(), headroom=robot.headroom))
        x, y = np.meshgrid(grid.x, grid.y)
        return np.column_stack([x[hit], y[hit], heights[hit]])

    def _fallback(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Map of the first fallback whose sensors have measured enough; the last one's error if there is none."""
        measured = {"lidar": observation.cloud is not None, "camera": bool(observation.images)}
        usable = [f for f in self._fallbacks if all(measured[sensor] for sensor in f.sensors)]
        for fallback in usable[:-1]:
            try:
                self._fell_back_to = fallback
                return fallback.terrain(observation, motion)
            except TerrainError:
                continue
        self._fell_back_to = usable[-1]
        return usable[-1].terrain(observation, motion)


def blended(fallback: TerrainMap, predicted: TerrainMap, share: float, spread_factor: float = 1.0) -> TerrainMap:
    """The fallback's map with a share of its difference to a predicted one.

    Stiffness, damping and friction are interpolated in their logarithms. Cells count as observed where the predicted
    map says so; level ground alone would count as observed everywhere.

    Where the predicted map tells spreads, the result does. A fallback with spreads of its own: those of a mean of two
    heights are at most their mean. A fallback without: if the surface is Laplace distributed about the predicted
    height with scale b, 90 % of it lie within b (ln 10 + ln cosh(m / b)) of a height that is m apart from that.

    Args:
        fallback: what is used of share 0.
        predicted: what is used of share 1.
        share: 0 to 1.
        spread_factor: on the predicted spreads.
    """
    changed: dict[str, Any] = {"observed": predicted.observed}
    if share > 0.0:
        for name in ("height", "geometric_height"):
            changed[name] = torch.lerp(getattr(fallback, name), getattr(predicted, name), share)
        for name in ("stiffness", "damping", "friction"):
            # The defaults of damping and friction may be 0.
            start, end = (getattr(terrain, name).clamp_min(_LEAST_MATERIAL).log() for terrain in (fallback, predicted))
            changed[name] = torch.lerp(start, end, share).exp()
    apart = {
        "geometric_spread": predicted.geometric_height - fallback.geometric_height,
        "decrease_spread": _decrease(predicted) - _decrease(fallback),
    }
    for name, difference in apart.items():
        own, other = getattr(predicted, name), getattr(fallback, name)
        if own is None:
            changed[name] = other if share <= 0.0 else None
            continue
        own = spread_factor * own
        changed[name] = _spread_about(own, (1.0 - share) * difference) if other is None else other.lerp(own, share)
    return replace(fallback, **changed)


def _with_measured_error(terrain: TerrainMap, report: TrustReport) -> TerrainMap:
    """The fallback's map beside a prediction that is not trusted, which then says as little of the fallback's errors.

    Spreads are those that the prediction implies, weighing as much as three blocks, and the error of the supporting
    ground that the wheels measured.
    """
    blocks = report.travelled / BLOCK
    if not blocks or terrain.geometric_spread is None:
        return terrain
    weight = blocks / (blocks + FEWEST_BLOCKS)
    own, decrease = terrain.geometric_spread, terrain.decrease_spread
    return replace(
        terrain,
        geometric_spread=own.lerp(torch.full_like(own, report.fallback_error), weight),
        decrease_spread=None if decrease is None else (1.0 - weight) * decrease,
    )


def _spread_about(spread: torch.Tensor, apart: torch.Tensor) -> torch.Tensor:
    """Scale of the Laplace distribution about a height ``apart`` from the predicted one with the same 90 % band [m]."""
    ratio = apart.abs() / spread.clamp_min(_SMALLEST_SPREAD)
    # ln cosh, which overflows.
    beyond = ratio + torch.log1p(torch.exp(-2.0 * ratio)) - math.log(2.0)
    return spread.clamp_min(_SMALLEST_SPREAD) * (1.0 + beyond / math.log(10.0))


def _decrease(terrain: TerrainMap) -> torch.Tensor:
    """Height of the visible surface above the supporting ground (H_d) [m]."""
    return terrain.geometric_height - terrain.height
