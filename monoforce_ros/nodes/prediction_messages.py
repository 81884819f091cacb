"""A Prediction → messages: height map, terrain, path, contact forces."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps

from monoforce_ros.core import quaternions
from monoforce_ros.messages import encoding
from monoforce_ros.planning import AlignedGrid
from monoforce_ros.prediction import FORCE_LENGTH, Prediction, cell_points, contact_points, force_steps, usable_steps
from monoforce_ros.robots import RobotModel
from monoforce_ros.terrain import TerrainMap

_COLOURS = colormaps["turbo"](np.linspace(0.0, 1.0, 256))[:, :3]
_COLOURED = 1.0
"""Height above or below the robot at which its colour is the last one [m]."""
_UNKNOWN, _FAINTEST = 0.5, 0.15
"""Expected error of a height [m] from which on a cell is drawn as one of which nothing is known, and its opacity: no
wheel of a shipped robot climbs half a metre."""


def height_map(prediction: Prediction, frame_id: str) -> bytes:
    """``nav_msgs/GridCells``: the predicted map at its height, in cells along the axes of the odometry frame.

    GridCells draws squares along these axes, whereas the map lies along the robot's heading.
    """
    terrain, pose = prediction.terrain, prediction.motion.odometry_from_terrain
    aligned = AlignedGrid.around(terrain.grid, pose)
    heights = aligned.resampled(terrain.height.double().numpy() + pose[2, 3], np.nan)
    rows, columns = np.nonzero(aligned.inside)
    places = np.stack([columns, rows], axis=1) + 0.5
    points = np.column_stack([aligned.origin + places * aligned.resolution, heights[rows, columns]])
    return encoding.grid_cells(prediction.stamp, frame_id, aligned.resolution, points)


def terrain_cloud(prediction: Prediction, frame_id: str) -> bytes:
    """``sensor_msgs/PointCloud2``: every cell with all channels; heights are z coordinates in the odometry frame.

    Maps of an encoder have two more: the expected absolute errors of ``geometric_height`` and of H_d [m]. The last one,
    ``rgba``, is for viewers: the height as a colour, which fades with the expected error.
    """
    terrain, transform = prediction.terrain, prediction.motion.odometry_from_terrain
    points = cell_points(terrain, transform)
    return encoding.point_cloud(
        prediction.stamp,
        frame_id,
        {
            "x": points[:, 0],
            "y": points[:, 1],
            "z": points[:, 2],
            "geometric_height": terrain.geometric_height.numpy().ravel() + transform[2, 3],
            "stiffness": terrain.stiffness.numpy(),
            "damping": terrain.damping.numpy(),
            "friction": terrain.friction.numpy(),
            "observed": terrain.observed.numpy().astype(np.float32),
            **{name: getattr(terrain, name).numpy() for name in terrain.spreads},
            "rgba": _faded(terrain),
        },
    )


def _faded(terrain: TerrainMap) -> np.ndarray:
    """Colour of each cell, packed as RViz reads it (0xAARRGGBB), ``[rows * columns]`` uint32.

    Where the map does not tell its errors, cells without a measurement nearby fade.
    """
    height = terrain.height.numpy().ravel()
    colour = np.rint(255.0 * _COLOURS[np.clip((height / _COLOURED + 1.0) * 128.0, 0.0, 255.0).astype(int)])
    spread = terrain.height_spread
    if spread is None:
        unsure = (~terrain.measured_nearby()).ravel().astype(float)
    else:
        unsure = np.clip(spread.numpy().ravel() / _UNKNOWN, 0.0, 1.0)
    alpha = np.rint(254.0 * (1.0 - (1.0 - _FAINTEST) * unsure)).astype(np.uint32)
    # Whoever reads all fields as float32 gets no NaN and no infinity.
    alpha[alpha == 127] = 128
    red, green, blue = colour.T.astype(np.uint32)
    return (alpha << 24) | (red << 16) | (green << 8) | blue


def path(prediction: Prediction, frame_id: str, time_step: float) -> bytes:
    """``nav_msgs/Path`` every ``time_step`` [s], up to the edge of the map; each pose has its own stamp."""
    times = prediction.rollout.times.double().numpy()
    stride = max(1, round(time_step / (times[1] - times[0])))
    chosen = np.arange(0, max(1, usable_steps(prediction)), stride)
    return encoding.path(
        frame_id,
        prediction.stamp + np.rint(times[chosen] * 1e9).astype(np.int64),
        prediction.positions()[chosen],
        quaternions(prediction.rotations()[chosen]),
    )


def contact_forces(prediction: Prediction, robot: RobotModel, frame_id: str) -> bytes:
    """``visualization_msgs/MarkerArray``: contact points and forces along the path, coloured by size.

    ``contact_forces`` are lines, as long as the force in units of the robot's weight, that start at ``contact_points``.
    """
    weight = float(robot.mass.mean()) * 9.81
    contacts = [contact_points(prediction, robot, step) for step in force_steps(prediction)]
    feet, forces = (np.concatenate(parts) for parts in zip(*contacts, strict=True))
    tips = feet + forces * (FORCE_LENGTH / weight)
    colours = colormaps["turbo"](np.clip(np.linalg.norm(forces, axis=1) / (0.25 * weight), 0, 1)).astype(np.float32)
    return encoding.marker_array(
        prediction.stamp,
        frame_id,
        [
            encoding.ListMarker(
                "contact_forces",
                "lines",
                np.stack([feet, tips], axis=1).reshape(-1, 3),
                np.repeat(colours, 2, axis=0),
                0.012,
            ),
            encoding.ListMarker("contact_points", "spheres", feet, colours, 0.03),
        ],
    )
