"""Wheel motion: wheels that turn while the robot does not, and stretches that nobody commanded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CommandTrack, MotionTrack, WheelTrack
from monoforce_ros.robots import RobotModel

_STEP = 0.1
"""Between samples of ways and commands [s]: the time in which a base controller reads a command at 10 Hz."""
_PIECE = 2.0
"""Length of the pieces in which wheels and motion are compared [s]: longer than clocks and filters are late."""
_SHORTEST = 3.0
"""Shortest stretch that is reported [s]: more than one piece, and more than wheels may spin when a robot starts."""
_LARGEST_GAP = 1.0
"""Between measurements over which ways are interpolated [s]: half a piece."""
_PIECES = 9
"""Overlapping pieces over which ways are added up: 6 s, so that neither a start nor a wandering pose decides."""
_LEAST_WAY = 0.1
"""Way of the wheels in a piece that counts as turning [m]."""
_STAYING = 0.2
"""Way of the robot over that of its wheels below which it stays. Ground with the lowest friction of the
catalogue, 0.016, accelerates a robot from rest by 0.3 m in a piece: a fifth of what wheels turn at 0.75 m/s."""
_NEARLY_ALL = 0.8
"""Share of the driven time from which a recording is called one without motion: poses wander in the rest."""
_STOPPING = 2.0
"""Time after a command that a base needs to stop [s]: the longest dead time of the catalogue."""
_SLOWEST = 0.05
"""Speed of a wheel below which it may creep at a command of zero [m/s]."""


@dataclass(frozen=True)
class WheelsWithoutMotion:
    """Wheels that turn while the robot does not: off the ground, dug in or blocked."""

    stretches: tuple[tuple[int, int], ...]
    """Start and end of each stretch [ns]."""
    side: str
    """``both``, ``left`` or ``right``."""
    share: float
    """Share of the pieces in which these wheels turn."""
    wheel_distance: float
    """Way of these wheels over all stretches [m]."""
    moved: float
    """Largest distance of the robot from its place within a piece of a stretch [m]."""
    followed: float | None
    """Speed of these wheels over the commanded speed, its median; None without commands."""
    origin: int
    """Stamp from which :meth:`summary` counts [ns]."""

    def summary(self) -> str:
        """What was seen, in plain words."""
        spans = [
            f"{(low - self.origin) * 1e-9:.0f} to {(high - self.origin) * 1e-9:.0f} s" for low, high in self.stretches
        ]
        listed = ", ".join(spans[:4]) + (f" and {len(spans) - 4} more" if len(spans) > 4 else "")
        wheels = "the wheels turn" if self.side == "both" else f"the {self.side} wheels turn"
        place = "the robot stays" if self.side == "both" else f"the {self.side} side of the robot stays"
        text = (
            f"{wheels} ({self.wheel_distance:.1f} m) but {place} where it is (within {self.moved:.2f} m) at {listed}: "
            "off the ground, dug in or blocked"
        )
        if self.share > _NEARLY_ALL:
            text += "; this is nearly the whole recording, which shows drives but neither ground nor sensors"
        return text


def half_track(robot: RobotModel) -> float:
    """Lateral distance of the outer drives from the centre line [m]."""
    return 0.5 * float((robot.drive_offsets.max() - robot.drive_offsets.min()).abs())


def side_speeds(robot: RobotModel, twists: np.ndarray) -> np.ndarray:
    """Commanded speeds of the left and right wheels ``[..., 2]`` [m/s].

    Args:
        robot: of one that steers, the driven wheels of each side count.
        twists: forward speed [m/s], yaw rate [rad/s] and, of a robot that crabs, lateral speed [m/s], ``[..., 2]`` or
            ``[..., 3]``.
    """
    if robot.steered is None:
        return twists[..., :1] + half_track(robot) * np.array([-1.0, 1.0]) * twists[..., 1:2]
    speeds = robot.command(torch.as_tensor(twists, dtype=torch.float64))[0].numpy()
    across = robot.steered.drive_places[:, 1].numpy()
    sides = [across > 0.0, across < 0.0]
    every = np.ones(len(across), bool)
    return np.stack([speeds[..., side if side.any() else every].mean(axis=-1) for side in sides], axis=-1)


def wheels_without_motion(
    motion: MotionTrack, wheels: WheelTrack | None, commands: CommandTrack, robot: RobotModel
) -> WheelsWithoutMotion | None:
    """Stretches in which wheels turn while the robot, or one side of it, stays where it is.

    In pieces of 2 s the way of each side of the robot is compared with that of its wheels: the largest distance from
    where it was when the piece began. A side stays if its way over 6 s is less than a fifth of its wheels' way, which
    even a robot on ice exceeds. Poses that are dead reckoned from the wheels always agree with them: nothing is found.

    Args:
        motion: measured motion.
        wheels: measured wheel speeds.
        commands: recorded commands; may be empty.
        robot: its wheel radius and track width are used.

    Returns:
        The finding for both sides, else for the side that stays longer; None if there is none, or without wheel
        speeds or a wheel radius.
    """
    if wheels is None:
        return None
    ways = wheel_ways(motion, wheels, robot)
    if ways is None:
        return None
    stamps, starts, width, usable = ways.stamps, ways.starts, ways.width, ways.usable
    speeds = ways.speeds
    # Of the ground under the left and the right side, under both together, and of their wheels, [pieces, 3].
    ground, turned = (np.column_stack([way, way.mean(axis=1)]) for way in (ways.ground, ways.turned))
    driven = usable[:, None] & (turned > _LEAST_WAY)
    added = [uniform_filter1d(way * driven, _PIECES, axis=0, mode="constant") for way in (ground, turned)]
    # A piece in which the robot stops or starts has a share of its own.
    staying = driven & (added[0] < _STAYING * added[1]) & (ground < 2.0 * _STAYING * turned)
    # A side that follows its wheels turns the robot about the other one.
    both = staying[:, 2] & ~(driven & (ground > 2.0 * _STAYING * turned))[:, :2].any(axis=1)
    found = {"left": staying[:, 0], "right": staying[:, 1], "both": both}
    spans = {name: _stretches(mask, starts, width) for name, mask in found.items()}
    counts = {name: int(mask.sum()) if spans[name] else 0 for name, mask in found.items()}
    single = max(("left", "right"), key=lambda name: counts[name])
    # Both sides stay for most of that time; else a moment in which the other side is slow would count as both.
    side = "both" if counts["both"] > 0.5 * counts[single] else single
    if not spans[side]:
        return None
    column = list(found).index(side)
    speeds = np.column_stack([speeds, np.abs(speeds).mean(axis=1)])
    where = np.unique(np.concatenate([np.arange(low, high + 1) for low, high in spans[side]]))
    kept = found[side] & np.isin(starts, where)
    return WheelsWithoutMotion(
        stretches=tuple((int(stamps[low]), int(stamps[high])) for low, high in spans[side]),
        side=side,
        share=float(kept.sum() / max(1, driven[:, column].sum())),
        wheel_distance=float(np.abs(speeds[where, column]).sum() * _STEP),
        moved=float(ground[kept, column].max()),
        followed=_followed(commands, stamps[where], speeds[where], robot, column),
        origin=int(motion.stamps[0]),
    )


@dataclass(frozen=True)
class WheelWays:
    """Ways of wheels and ground in overlapping pieces of 2 s, by side: left, right."""

    stamps: np.ndarray
    """Times of the samples, ``[m]`` [ns]."""
    step: float
    """Time between samples [s]."""
    speeds: np.ndarray
    """Of the wheels' rims, ``[m, 2]`` [m/s]."""
    starts: np.ndarray
    """Index of the first sample of each piece, ``[n]``."""
    width: int
    """Samples between start and end of a piece."""
    usable: np.ndarray
    """Pieces in which wheels and motion were measured throughout, ``[n]`` bool."""
    ground: np.ndarray
    """Largest distance of each side of the robot from where it was when the piece began, ``[n, 2]`` [m]."""
    turned: np.ndarray
    """The same of the wheels' rims along their way, ``[n, 2]`` [m]."""
    rolled: np.ndarray
    """Way of the wheels' rims from start to end of a piece, with its sign, ``[n, 2]`` [m]."""
    apart: np.ndarray
    """Largest difference of the ways of both sides' wheels within a piece, ``[n]`` [m]."""


def wheel_ways(motion: MotionTrack, wheels: WheelTrack, robot: RobotModel) -> WheelWays | None:
    """Ways of wheels and of the ground under them; None for a recording that is too short, or without a wheel radius.

    Args:
        motion: measured motion.
        wheels: measured wheel speeds.
        robot: its wheel radius and track width are used.
    """
    if robot.wheel_radius is None or len(wheels) < 10 or len(motion) < 10:
        return None
    first, last = max(motion.stamps[0], wheels.stamps[0]), min(motion.stamps[-1], wheels.stamps[-1])
    stamps = np.arange(first, last + 1, round(_STEP * 1e9), dtype=np.int64)
    width = round(_PIECE / _STEP)
    starts = np.arange(0, len(stamps) - width, round(0.5 / _STEP))
    if len(starts) < _PIECES:
        return None
    speeds = _interpolated(wheels.stamps, wheels.speeds * robot.wheel_radius, stamps)
    sides = _sides(motion, stamps, half_track(robot))
    rolled = np.cumsum(speeds, axis=0) * _STEP
    inside = starts[:, None] + np.arange(width + 1)
    along = rolled[inside] - rolled[starts][:, None]
    return WheelWays(
        stamps,
        _STEP,
        speeds,
        starts,
        width,
        usable=(_near(wheels.stamps, stamps) & _near(motion.stamps, stamps))[inside].all(axis=1),
        ground=np.linalg.norm(sides[inside] - sides[starts][:, None], axis=3).max(axis=1),
        turned=np.abs(along).max(axis=1),
        rolled=along[:, -1],
        apart=np.abs(along[..., 1] - along[..., 0]).max(axis=1),
    )


def _stretches(mask: np.ndarray, starts: np.ndarray, width: int) -> list[tuple[int, int]]:
    """First and last step of each run of pieces; pauses of the wheels do not divide it."""
    found = [(int(starts[low]), int(starts[high]) + width) for low, high in runs(mask)]
    return [(low, high) for low, high in _merged(found, width) if (high - low) * _STEP >= _SHORTEST]


def undriven_stretches(
    commands: CommandTrack,
    wheels: WheelTrack | None,
    motion: MotionTrack | None,
    robot: RobotModel,
    *,
    timeout: float = 1.0,
) -> np.ndarray:
    """Stretches in which the robot is driven while its commands are zero or silent: by a joystick, for example.

    Wheels that turn 2 s after the last command other than zero are driven by something else. A base without time-out
    keeps its last command: wheels that follow it although it is old are driven by it. Without wheel speeds the measured
    motion counts where it begins at rest, because a robot may coast or slide after a command.

    Args:
        commands: recorded commands.
        wheels: measured wheel speeds, if known.
        motion: measured motion with velocities, for a recording without wheel speeds.
        robot: its wheel radius and track width are used.
        timeout: age at which a command is silent [s], at least; five times the usual time between commands if longer.

    Returns:
        start and end of each stretch, ``[n, 2]`` int64 [ns].
    """
    nothing = np.zeros((0, 2), np.int64)
    half = half_track(robot)
    if wheels is not None and robot.wheel_radius is not None and len(wheels) > 1:
        source, speeds = wheels.stamps, wheels.speeds * robot.wheel_radius
    elif motion is not None and len(motion) > 1:
        source = motion.stamps
        yaw = half * motion.angular_velocities[:, 2]
        speeds = motion.linear_velocities[:, 0][:, None] + np.stack([-yaw, yaw], axis=1)
    else:
        return nothing
    by_wheels = source is not motion.stamps if motion is not None else True
    stamps = np.arange(source[0], source[-1] + 1, round(_STEP * 1e9), dtype=np.int64)
    known = _near(source, stamps)
    measured = _interpolated(source, speeds, stamps)
    usual = float(np.median(np.diff(commands.stamps))) * 1e-9 if len(commands) > 1 else 0.0
    timeout = max(timeout, 5.0 * usual)
    held, active = (side_speeds(robot, commands.sample(stamps, timeout=age)) for age in (np.inf, timeout))
    # Difference of neighbouring measurements: noise and quantisation, as long as the speed changes slowly.
    noise = 1.4826 / np.sqrt(2.0) * float(np.median(np.abs(np.diff(speeds, axis=0))))
    floor = max(_SLOWEST if by_wheels else 2.0 * _SLOWEST, 5.0 * noise)
    stopping = round(_STOPPING / _STEP) + 1
    commanded = np.abs(active).max(axis=1)
    # The window ends at each time: the filter is centred, so it is shifted.
    quiet = maximum_filter1d(commanded, stopping, origin=stopping // 2, mode="nearest") < 0.2 * _SLOWEST
    follows = np.abs(measured - held).max(axis=1) < 0.3 * np.abs(held).max(axis=1)
    moving = quiet & known & ~follows & (np.abs(measured).max(axis=1) > floor)
    # Pauses of a joystick drive belong to it.
    spans = _merged(runs(moving), round(1.0 / _STEP))
    if not by_wheels:
        spans = [(low, high) for low, high in spans if low > 0 and quiet[low - 1] and known[low - 1]]
    margin = round(0.5 / _STEP)
    kept = [
        (int(stamps[max(0, low - margin)]), int(stamps[min(len(stamps) - 1, high + margin)]))
        for low, high in spans
        if high - low + 1 >= 0.5 / _STEP
    ]
    return np.array(kept, np.int64).reshape(-1, 2)


def _interpolated(stamps: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values ``[n, d]`` at other stamps, ``[m, d]``."""
    times, wanted = (stamps - stamps[0]) * 1e-9, (at - stamps[0]) * 1e-9
    return np.stack([np.interp(wanted, times, column) for column in values.T], axis=1)


def _near(stamps: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Whether measurements surround a time closely enough to interpolate, ``[m]`` bool."""
    after = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
    return stamps[after] - stamps[after - 1] <= _LARGEST_GAP * 1e9


def _sides(motion: MotionTrack, stamps: np.ndarray, half: float) -> np.ndarray:
    """Positions of the left and the right wheels, ``[m, 2, 2]`` [m] in the plane."""
    left = Rotation.from_quat(motion.quaternions).as_matrix()[:, :2, 1]
    points = motion.positions[:, None, :2] + half * np.stack([left, -left], axis=1)
    return _interpolated(motion.stamps, points.reshape(-1, 4), stamps).reshape(-1, 2, 2)


def _followed(
    commands: CommandTrack, stamps: np.ndarray, speeds: np.ndarray, robot: RobotModel, column: int
) -> float | None:
    if not len(commands):
        return None
    commanded = side_speeds(robot, commands.sample(stamps))
    commanded = np.column_stack([commanded, np.abs(commanded).mean(axis=1)])[:, column]
    driven = np.abs(commanded) > _SLOWEST
    return float(np.median(speeds[driven, column] / commanded[driven])) if driven.any() else None


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of true values of a mask ``[n]``."""
    edges = np.flatnonzero(np.diff(np.r_[0, mask.astype(int), 0]))
    return [(int(low), int(high) - 1) for low, high in zip(edges[::2], edges[1::2], strict=True)]


def _merged(found: list[tuple[int, int]], gap: int) -> list[tuple[int, int]]:
    merged: list[tuple[int, int]] = []
    for low, high in found:
        if merged and low - merged[-1][1] <= gap:
            merged[-1] = (merged[-1][0], high)
        else:
            merged.append((low, high))
    return merged
