"""Assessed candidates → the messages that planners and people read: markers, a table of costs, best path, occupancy."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from scipy.spatial.transform import Rotation

from monoforce_ros.messages import encoding
from monoforce_ros.motion import MotionState, transform_points
from monoforce_ros.physics import Rollout
from monoforce_ros.planning import Assessment, Occupancy
from monoforce_ros.planning.choice import WAYPOINTS
from monoforce_ros.prediction.live_gap import HORIZONS, GapSummary

_SHOWN = 0.1
"""Time between the points of a drawn path [s]."""
_REFUSED = (0.45, 0.45, 0.45, 0.35)


def candidate_markers(motion: MotionState, rollout: Rollout, assessment: Assessment, frame_id: str) -> bytes:
    """``visualization_msgs/MarkerArray``: paths from green (cheapest) to red, grey where not feasible, the best thick.

    Namespaces ``candidates`` and ``best_candidate``.
    """
    times = rollout.times
    stride = max(1, round(_SHOWN / float(times[1] - times[0])))
    positions = rollout.position[:, ::stride].double().cpu().numpy()
    usable = rollout.valid.cpu().numpy()
    paths = transform_points(motion.odometry_from_terrain, positions)
    lines = np.stack([paths[:, :-1], paths[:, 1:]], axis=2).reshape(len(paths), -1, 3)
    cost, feasible = assessment.cost.cpu().numpy(), assessment.feasible.cpu().numpy()
    low, high = (cost[feasible].min(), cost[feasible].max()) if feasible.any() else (0.0, 1.0)
    shade = np.clip((np.nan_to_num(cost, posinf=high) - low) / max(high - low, 1e-6), 0.0, 1.0)
    colours = colormaps["RdYlGn_r"](shade).astype(np.float32)
    colours[~feasible] = _REFUSED
    each = np.repeat(colours[usable], lines.shape[1], axis=0)
    best = assessment.best
    chosen = lines[best] if best is not None else np.zeros((0, 3))
    return encoding.marker_array(
        motion.stamp,
        frame_id,
        [
            encoding.ListMarker("candidates", "lines", lines[usable].reshape(-1, 3), each, 0.015),
            encoding.ListMarker("best_candidate", "lines", chosen, np.array([0.1, 0.9, 0.3, 1.0]), 0.06),
        ],
    )


def candidate_costs(
    motion: MotionState, rollout: Rollout, fan: np.ndarray, assessment: Assessment, frame_id: str
) -> bytes:
    """``sensor_msgs/PointCloud2``: a point where each candidate ends, with its command, cost and every term as fields.

    ``x_25``, ``y_25`` and so on are where it is after that share of the horizon, in per cent.
    A message with stamp and frame that every ROS has, that planners read by field names and RViz colours by cost.
    """
    end = transform_points(motion.odometry_from_terrain, rollout.position[:, -1].double().cpu().numpy())
    turned = motion.odometry_from_terrain[:3, :3] @ rollout.rotation[:, -1].double().cpu().numpy()
    channels = {
        "x": end[:, 0],
        "y": end[:, 1],
        "z": end[:, 2],
        "heading": np.arctan2(turned[:, 1, 0], turned[:, 0, 0]),
        "speed": fan[:, 0],
        "yaw_rate": fan[:, 1],
        "cost": assessment.cost.cpu().numpy(),
        "feasible": assessment.feasible.cpu().numpy().astype(np.float32),
    }
    for share in WAYPOINTS:
        step = round(share / 100 * (rollout.position.shape[1] - 1))
        place = transform_points(motion.odometry_from_terrain, rollout.position[:, step].double().cpu().numpy())
        channels |= {f"x_{share}": place[:, 0], f"y_{share}": place[:, 1]}
    channels |= {name: value.cpu().numpy() for name, value in assessment.terms.items()}
    return encoding.point_cloud(motion.stamp, frame_id, channels)


def best_path(motion: MotionState, rollout: Rollout, best: int, frame_id: str, time_step: float) -> bytes:
    """``nav_msgs/Path`` of the best candidate, as far as the map reaches."""
    times = rollout.times.double().numpy()
    stride = max(1, round(time_step / (times[1] - times[0])))
    outside = np.flatnonzero(~rollout.inside[best].numpy())
    end = int(outside[0]) if len(outside) else len(times)
    chosen = np.arange(0, max(1, end), stride)
    pose = motion.odometry_from_terrain
    return encoding.path(
        frame_id,
        motion.stamp + np.rint(times[chosen] * 1e9).astype(np.int64),
        transform_points(pose, rollout.position[best].double().numpy()[chosen]),
        Rotation.from_matrix(pose[:3, :3] @ rollout.rotation[best].double().numpy()[chosen]).as_quat(),
    )


def live_gap(found: GapSummary) -> bytes:
    """``std_msgs/Float32MultiArray``: a row for each horizon; the second dimension's label names the columns."""
    columns = ("horizon", "median_position_error", "median_heading_error", "noise_floor", "count")
    count = np.full(len(HORIZONS), found.count)
    values = np.column_stack([HORIZONS, found.position, found.heading, found.floor, count])
    return encoding.float_table("horizon", columns, values)


def occupancy_grid(stamp: int, found: Occupancy, frame_id: str) -> bytes:
    """``nav_msgs/OccupancyGrid``, axes along those of the frame."""
    return encoding.occupancy_grid(stamp, frame_id, found.resolution, (*found.origin, found.height), found.data)
