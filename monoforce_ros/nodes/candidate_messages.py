"""Assessed candidates, ensemble and monitor → messages: markers, tables, best path, occupancy grid."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib import colormaps

from monoforce_ros.core import MotionState, quaternions, transform_points
from monoforce_ros.messages import CdrWriter, encoding
from monoforce_ros.physics import Rollout
from monoforce_ros.planning import WAYPOINTS, Assessment
from monoforce_ros.prediction import HORIZONS, GapSummary, Prediction, Spread, usable_steps
from monoforce_ros.robots import RobotModel

_PATH_INTERVAL = 0.1
"""Time between the points of a drawn path [s]."""
_CIRCLE_INTERVAL = 0.5
"""Time between the circles drawn along a path [s]."""
_INFEASIBLE = (0.45, 0.45, 0.45, 0.35)


def candidate_markers(
    motion: MotionState, rollout: Rollout, assessment: Assessment, best: int | None, frame_id: str
) -> bytes:
    """``visualization_msgs/MarkerArray``: paths from green (cheapest) to red, infeasible ones grey, the best one thick.

    Namespaces ``candidates`` and ``best_candidate``.
    """
    times = rollout.times
    stride = max(1, round(_PATH_INTERVAL / float(times[1] - times[0])))
    positions = rollout.position[:, ::stride].double().cpu().numpy()
    valid = rollout.valid.cpu().numpy()
    paths = transform_points(motion.odometry_from_terrain, positions)
    lines = np.stack([paths[:, :-1], paths[:, 1:]], axis=2).reshape(len(paths), -1, 3)
    cost, feasible = assessment.cost.cpu().numpy(), assessment.feasible.cpu().numpy()
    low, high = (cost[feasible].min(), cost[feasible].max()) if feasible.any() else (0.0, 1.0)
    shade = np.clip((np.nan_to_num(cost, posinf=high) - low) / max(high - low, 1e-6), 0.0, 1.0)
    colours = colormaps["RdYlGn_r"](shade).astype(np.float32)
    colours[~feasible] = _INFEASIBLE
    each = np.repeat(colours[valid], lines.shape[1], axis=0)
    chosen = lines[best] if best is not None else np.zeros((0, 3))
    return encoding.marker_array(
        motion.stamp,
        frame_id,
        [
            encoding.ListMarker("candidates", "lines", lines[valid].reshape(-1, 3), each, 0.015),
            encoding.ListMarker("best_candidate", "lines", chosen, np.array([0.1, 0.9, 0.3, 1.0]), 0.06),
        ],
    )


def candidate_costs(
    motion: MotionState, rollout: Rollout, commands: np.ndarray, assessment: Assessment, frame_id: str, start: float
) -> bytes:
    """``sensor_msgs/PointCloud2``: a point at the end of each candidate, with command, cost and every term as fields.

    Of a robot that moves sideways ``lateral_speed`` is a field. ``x_25``, ``y_25`` and so on are positions after that
    percentage of the horizon, ``start`` is the time after the stamp at which the candidates take effect [s]. The
    message type is standard; planners read it by field names, and RViz can colour it by
    cost.
    """
    end = transform_points(motion.odometry_from_terrain, rollout.position[:, -1].double().cpu().numpy())
    rotation = motion.odometry_from_terrain[:3, :3] @ rollout.rotation[:, -1].double().cpu().numpy()
    channels = {
        "x": end[:, 0],
        "y": end[:, 1],
        "z": end[:, 2],
        "heading": np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
        "speed": commands[:, 0],
        "yaw_rate": commands[:, 1],
        **({"lateral_speed": commands[:, 2]} if commands.shape[-1] > 2 else {}),
        "cost": assessment.cost.cpu().numpy(),
        "feasible": assessment.feasible.cpu().numpy().astype(np.float32),
        "start": np.full(len(end), start),
    }
    for share in WAYPOINTS:
        step = round(share / 100 * (rollout.position.shape[1] - 1))
        position = transform_points(motion.odometry_from_terrain, rollout.position[:, step].double().cpu().numpy())
        channels |= {f"x_{share}": position[:, 0], f"y_{share}": position[:, 1]}
    channels |= {name: value.cpu().numpy() for name, value in assessment.terms.items()}
    return encoding.point_cloud(motion.stamp, frame_id, channels)


def candidate_rollouts(
    motion: MotionState,
    rollout: Rollout,
    robot: RobotModel,
    sequences: np.ndarray,
    assessment: Assessment,
    best: int | None,
    frame_id: str,
    time_step: float,
) -> bytes:
    """``monoforce_msgs/Candidates``: the complete rollouts of all candidates, sampled every ``time_step`` [s].

    Args:
        motion: common start.
        rollout: rollout of ``N`` candidates, with contact forces.
        robot: that was simulated.
        sequences: commands, each for an equal share of the horizon ``[N, K, 2]``.
        assessment: assessment of the rollouts.
        best: index of the best one, if any is feasible.
        frame_id: frame of the odometry.
        time_step: time between samples [s].
    """
    times = rollout.times.double().cpu().numpy()
    stride = max(1, round(time_step / (times[1] - times[0])))
    chosen = np.arange(0, len(times), stride)
    count, horizon = len(rollout.position), len(times) - 1
    pose = motion.odometry_from_terrain
    axes = pose[:3, :3]
    rotation = axes @ rollout.rotation[:, chosen].double().cpu().numpy()
    positions = transform_points(pose, rollout.position[:, chosen].double().cpu().numpy())
    states = np.concatenate([positions, quaternions(rotation)], axis=-1)
    linear, angular = (
        value[:, chosen].double().cpu().numpy() @ axes.T for value in (rollout.velocity, rollout.angular_velocity)
    )
    share = np.minimum(chosen, horizon - 1) * sequences.shape[1] // horizon
    if rollout.contact is None:
        raise ValueError("the rollout of the candidates has no contact forces")
    forces = _averaged(rollout.contact.force, chosen, rollout.force_every) @ axes.T
    loads = rollout.contact.load
    writer = CdrWriter()
    writer.header(motion.stamp, frame_id)
    writer.string(robot.name)
    writer.fields("I", count)
    for values in (
        times[chosen], sequences[:, share], states, np.concatenate([linear, angular], axis=-1), forces,
    ):  # fmt: skip
        writer.sequence(np.asarray(values, "<f4").reshape(-1), 4)
    writer.strings((*robot.drive_names, "hull"))
    writer.sequence(np.asarray(_averaged(loads, chosen, rollout.force_every), "<f4").reshape(-1), 4)
    writer.sequence(rollout.inside[:, chosen].cpu().numpy().astype(np.uint8).reshape(-1), 1)
    writer.strings(tuple(assessment.terms))
    terms = torch.stack(list(assessment.terms.values()), dim=-1)
    writer.sequence(np.asarray(terms.cpu().numpy(), "<f4").reshape(-1), 4)
    writer.sequence(np.asarray(assessment.cost.cpu().numpy(), "<f4"), 4)
    writer.sequence(assessment.feasible.cpu().numpy().astype(np.uint8), 1)
    writer.fields("i", -1 if best is None else best)
    return writer.bytes()


def _averaged(values: torch.Tensor, chosen: np.ndarray, every: int) -> np.ndarray:
    """Means of values at every ``every``-th step ``[N, T / every, ...]`` over the interval before each chosen step.

    The first sample is the value at the start; a sample without values since its predecessor repeats it.
    """
    summed = torch.cat([torch.zeros_like(values[:, :1]), values.cumsum(dim=1)], dim=1).cpu().double().numpy()
    ends = np.minimum(-(-chosen // every), values.shape[1])
    starts = np.concatenate([[0], ends[:-1]])
    ends = np.maximum(ends, 1)
    starts = np.minimum(starts, ends - 1)
    count = (ends - starts).reshape(1, -1, *[1] * (summed.ndim - 2))
    return (summed[:, ends] - summed[:, starts]) / count


def spread_table(prediction: Prediction, found: Spread, frame_id: str, time_step: float) -> bytes:
    """``sensor_msgs/PointCloud2``: poses of the path with their uncertainty.

    ``time`` [s], standard deviations ``along``, ``across``, ``up`` [m] and ``heading`` [rad], and ``radius_90`` [m].
    """
    chosen = _path_steps(prediction, time_step)
    positions = prediction.positions()[chosen]
    channels = {"x": positions[:, 0], "y": positions[:, 1], "z": positions[:, 2]}
    channels["time"] = prediction.rollout.times.double().numpy()[chosen]
    channels |= {name: getattr(found, name)[chosen] for name in ("along", "across", "up", "heading")}
    channels["radius_90"] = found.radius[chosen]
    return encoding.point_cloud(prediction.stamp, frame_id, channels)


def spread_band(prediction: Prediction, found: Spread, frame_id: str, time_step: float) -> bytes:
    """``visualization_msgs/MarkerArray``: circles around the path's poses that contain 90 % of the outcomes."""
    chosen = _path_steps(prediction, max(time_step, _CIRCLE_INTERVAL))[1:]
    angle = np.linspace(0.0, 2.0 * np.pi, 25)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(25)], axis=1)
    rings = prediction.positions()[chosen][:, None] + found.radius[chosen][:, None, None] * circle
    lines = np.stack([rings[:, :-1], rings[:, 1:]], axis=2).reshape(-1, 3)
    colour = np.array([0.2, 0.5, 1.0, 0.6])
    return encoding.marker_array(
        prediction.stamp, frame_id, [encoding.ListMarker("spread_90", "lines", lines, colour, 0.02)]
    )


def _path_steps(prediction: Prediction, time_step: float) -> np.ndarray:
    """Steps every ``time_step`` [s] up to the edge of the map."""
    times = prediction.rollout.times.double().numpy()
    return np.arange(0, max(1, usable_steps(prediction)), max(1, round(time_step / (times[1] - times[0]))))


def best_path(motion: MotionState, rollout: Rollout, best: int, frame_id: str, time_step: float) -> bytes:
    """``nav_msgs/Path`` of the best candidate, up to the edge of the map."""
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
        quaternions(pose[:3, :3] @ rollout.rotation[best].double().numpy()[chosen]),
    )


def live_gap(found: GapSummary) -> bytes:
    """``std_msgs/Float32MultiArray``: one row per horizon; the label of the second dimension names the columns."""
    columns = ("horizon", "median_position_error", "median_heading_error", "noise_floor", "count")
    count = np.full(len(HORIZONS), found.count)
    values = np.column_stack([HORIZONS, found.position, found.heading, found.floor, count])
    return encoding.float_table("horizon", columns, values)
