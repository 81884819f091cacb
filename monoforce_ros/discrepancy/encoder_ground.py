"""Encoder ground: the ground of a whole recording as the terrain encoder predicted it along the drive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from monoforce_ros.bags import MAXIMUM_GAP, BagError, Recording, chosen_cameras, image_frames, observe
from monoforce_ros.core import MotionState, MotionTrack, StaleDataError
from monoforce_ros.messages import MessageError
from monoforce_ros.perception import CAMERA_SOURCES, choose_terrain_source
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import Grid, TerrainMap, fill_holes, interpolated

SPACING: Final = 0.25
"""Distance between the places of which maps are made [m]: a tenth of the first metres that a camera sees well."""
_TURN: Final = np.radians(20.0)
"""A turn after which a map is made, too [rad]: a third of the view of a usual lens."""
_SMALLEST_SPREAD: Final = 0.02
"""Spread that no cell falls below [m], so that one map does not decide alone: a fifth of a cell."""

_ALL_SEEN: Final = 0.99
"""Share of the four cells about a place from which all of them count as seen: all but rounding."""


@dataclass(frozen=True)
class EncoderGround:
    """A terrain source with an encoder, as ``--terrain`` names it."""

    kind: str
    """``camera`` or ``lidar_camera``."""
    checkpoint: str = ""
    """File of the encoder; empty for the shipped one."""

    @classmethod
    def named(cls, terrain: str) -> EncoderGround | None:
        """The source that ``KIND`` or ``KIND:CHECKPOINT`` names; None where that is no source with cameras."""
        kind, _, checkpoint = terrain.partition(":")
        return cls(kind, checkpoint) if kind in CAMERA_SOURCES else None


def encoder_maps(
    recording: Recording, motion: MotionTrack, robot: RobotModel, grid: Grid, ground: EncoderGround
) -> tuple[TerrainMap, tuple[TerrainMap, TerrainMap], int]:
    """Map of a whole recording in the odometry frame, two from alternate predictions, and the number of predictions.

    Each prediction counts by the inverse of its variance in a cell. As the node does, it follows the encoder as far as
    the ground has confirmed it. Heights are the encoder's; material is what ground has by default, for what friction
    does to the motion is asked of the recording.

    Args:
        recording: with images.
        motion: smoothed poses of the base frame.
        robot: its file may know the poses of the cameras.
        grid: cells in the odometry frame.
        ground: the encoder.

    Raises:
        BagError: no image of the recording can be used.
        CheckpointError: the encoder cannot be loaded.
    """
    cameras = chosen_cameras(recording, robot)
    topics = cameras.topics
    if not topics:
        what = "no usable images" if any(recording.images.values()) else "no images"
        raise BagError(
            f"{recording.path}: {what}, which --terrain {ground.kind} needs; use lidar, traced, flat or a map"
            f"{''.join(f'; {remark}' for remark in cameras.remarks)}"
        )
    mosaics = [_Mosaic(grid), _Mosaic(grid)]
    count, refused = 0, ""
    source = choose_terrain_source(ground.kind, robot, checkpoint=ground.checkpoint, fallback=True)
    for stamp, state in _places(recording, motion, topics):
        try:
            found = source.terrain(observe(recording, robot, stamp, source.sensors, topics), state)
        except (BagError, MessageError, StaleDataError, ValueError) as error:
            refused = str(error)
            continue
        mosaics[count % 2].add(found, state)
        count += 1
    if not count:
        raise BagError(
            f"{recording.path}: --terrain {ground.kind}: no image can be used: {refused or 'none near a pose'}"
        )
    even, odd = mosaics
    return even.joined(odd).terrain(), (even.terrain(), odd.terrain() if count > 1 else even.terrain()), count


def _places(recording: Recording, motion: MotionTrack, topics: Sequence[str]) -> Iterator[tuple[int, MotionState]]:
    """Stamps of images at which the robot has moved on [ns], and its motion there."""
    previous: MotionState | None = None
    for frame in image_frames(recording, topics, MAXIMUM_GAP):
        try:
            state = motion.at(frame.stamp, maximum_gap=MAXIMUM_GAP)
        except StaleDataError:
            continue
        if previous is not None:
            moved = float(np.linalg.norm(state.position - previous.position))
            turned = previous.rotation[:, 0] @ state.rotation[:, 0]
            if moved < SPACING and turned > np.cos(_TURN):
                continue
        previous = state
        yield int(frame.stamp), state


class _Mosaic:
    """Heights of many maps, weighted, in the odometry frame."""

    def __init__(self, grid: Grid):
        self._grid = grid
        self._sums = np.zeros((2, grid.rows, grid.columns))
        """Of the supporting and the visible height, each times its weight."""
        self._weights = np.zeros((grid.rows, grid.columns))

    def add(self, terrain: TerrainMap, motion: MotionState) -> None:
        """Add the observed cells of a map in the terrain frame of a motion."""
        pose, local, grid = motion.odometry_from_terrain, terrain.grid, self._grid
        reach = 0.5 * float(np.hypot(local.rows, local.columns)) * local.resolution
        middle = pose[:2, :2] @ (
            np.array(local.origin) + 0.5 * local.resolution * np.array([local.columns, local.rows])
        )
        low = np.floor((pose[:2, 3] + middle - reach - np.array(grid.origin)) / grid.resolution).astype(int)
        high = np.ceil((pose[:2, 3] + middle + reach - np.array(grid.origin)) / grid.resolution).astype(int) + 1
        low, high = np.maximum(low, 0), np.minimum(high, (grid.columns, grid.rows))
        if (low >= high).any():
            return
        columns, rows = np.arange(low[0], high[0]), np.arange(low[1], high[1])
        places = np.stack(np.meshgrid(grid.x[columns], grid.y[rows]), axis=-1)
        cells = ((places - pose[:2, 3]) @ pose[:2, :2] - np.array(local.origin)) / local.resolution
        spread = terrain.geometric_spread
        weight = (
            np.ones(terrain.height.shape)
            if spread is None
            else 1.0 / (spread.double().numpy() ** 2 + _SMALLEST_SPREAD**2)
        )
        weight = np.where(terrain.observed.numpy(), weight, 0.0)
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        # Between cells of which one was not seen nothing is known of the slope.
        seen = interpolated(terrain.observed.numpy(), cells) > _ALL_SEEN
        weights = np.where(seen, interpolated(weight, cells), 0.0)
        self._weights[part] += weights
        for number, channel in enumerate((terrain.height, terrain.geometric_height)):
            heights = channel.double().numpy()
            self._sums[number][part] += (
                np.where(seen, interpolated(weight * heights, cells), 0.0) + weights * pose[2, 3]
            )

    def joined(self, other: _Mosaic) -> _Mosaic:
        """Both together."""
        result = _Mosaic(self._grid)
        result._sums, result._weights = self._sums + other._sums, self._weights + other._weights
        return result

    def terrain(self) -> TerrainMap:
        """The map; cells that no prediction observed are interpolated."""
        known = self._weights > 0.0
        heights = self._sums / np.where(known, self._weights, 1.0)
        support, visible = (torch.from_numpy(fill_holes(height, known).astype(np.float32)) for height in heights)
        return TerrainMap.from_height(
            support, self._grid, geometric_height=torch.maximum(visible, support), observed=torch.from_numpy(known)
        )
