"""Wheel joints: the speed of each side's wheels from joint states as drivers publish them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from monoforce_ros.core import NANOSECOND, CommandTrack, EffortTrack, MotionTrack, WheelTrack

WheelSample = tuple[int, Mapping[str, tuple[float, float]]]
"""A joint state: its stamp [ns], and the angle [rad] and rate [rad/s] of each wheel, NaN where the message has none."""
EffortSample = tuple[int, Mapping[str, float]]
"""The stamp of a joint state [ns], and the effort of each wheel that has one."""

_LONGEST_STEP = 1.0
"""Time over which angles are differentiated, and rates of different messages belong together, at most [s]."""
_AGAINST = -0.5
"""Cosine between a wheel's speeds and the commanded ones below which it turns against them. Unrelated series of some
dozen independent values have cosines within ±0.3; a wheel that follows late or slowly is above 0.5."""
_FEWEST = 20
"""Samples of a wheel that is commanded to turn which decide about its sign."""
_TURNING = 0.05
"""Commanded speed of a side from which on a sample says something [m/s]."""
_HALF_TRACK = 0.3
"""Half of a robot's track width where only signs of sides are asked for [m]."""


def wheel_track(
    samples: Sequence[WheelSample], sides: Mapping[str, str], commands: CommandTrack, motion: MotionTrack
) -> tuple[WheelTrack | None, list[str]]:
    """Mean speed of the left and of the right wheels over time, and what had to be mended, in words.

    Rates that a driver leaves out, as NaN, or as zero while the angles change, follow from the angles. Wheels of
    different messages (a controller for each side) are interpolated to the times of the first. Wheels that turn
    against the commands are mounted mirrored and their driver does not say so: their signs are turned.

    Args:
        samples: joint states in the order of the bag.
        sides: ``left`` or ``right`` for each wheel's name.
        commands: as recorded; without commands signs are left as they are.
        motion: measured poses, which decide where all wheels turn against the commands.

    Returns:
        None for the track if a side has no wheels or no finite speeds.
    """
    series: dict[str, list[tuple[int, float, float]]] = defaultdict(list)
    for stamp, joints in samples:
        for name, (angle, rate) in joints.items():
            series[name].append((stamp, angle, rate))
    texts: list[str] = []
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    differentiated = []
    for name, entries in series.items():
        stamps, rates, by_angle = _rates(entries)
        if len(stamps) > 1 or (len(stamps) == 1 and not by_angle):
            found[name] = stamps, rates
            differentiated += [name] if by_angle else []
    if {sides[name] for name in found} != {"left", "right"}:
        return None, []
    if differentiated:
        texts.append(f"{_listed(differentiated)}: no speeds; they follow from the angles")
    stamps, speeds = _together(found)
    if not len(stamps):
        return None, []
    names = list(found)
    against = _against(stamps, speeds, [sides[name] for name in names], commands, motion)
    if against.any():
        speeds = np.where(against, -speeds, speeds)
        turned = _listed([name for name, reversed_ in zip(names, against, strict=True) if reversed_])
        texts.append(
            f"{turned}: the speeds have the opposite sign of the commands (mounted mirrored?); they are taken with the "
            "other sign. Forward is positive on both sides in diff_drive_controller and REP 103"
        )
    left = np.array([sides[name] == "left" for name in names])
    mean = np.stack([speeds[:, left].mean(axis=1), speeds[:, ~left].mean(axis=1)], axis=1)
    return WheelTrack(stamps, mean), texts


def effort_track(samples: Sequence[EffortSample], sides: Mapping[str, str]) -> EffortTrack | None:
    """Mean magnitude of the efforts of the left and of the right wheels over time.

    Signs are left out: drivers publish them by the direction of the motor, the command or the wheel. None if a side has
    no efforts, or none of them is ever other than zero, as of drivers that measure none.

    Args:
        samples: efforts by wheel in the order of the bag.
        sides: ``left`` or ``right`` for each wheel's name.
    """
    series: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for stamp, joints in samples:
        for name, effort in joints.items():
            series[name].append((stamp, abs(effort)))
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name, entries in series.items():
        stamps, first = np.unique(np.array([stamp for stamp, _ in entries], np.int64), return_index=True)
        found[name] = stamps, np.array([entries[index][1] for index in first])
    if {sides[name] for name in found} != {"left", "right"}:
        return None
    stamps, efforts = _together(found)
    left = np.array([sides[name] == "left" for name in found])
    if not len(stamps) or not efforts.any():
        return None
    return EffortTrack(stamps, np.stack([efforts[:, left].mean(axis=1), efforts[:, ~left].mean(axis=1)], axis=1))


def _rates(entries: Sequence[tuple[int, float, float]]) -> tuple[np.ndarray, np.ndarray, bool]:
    """Stamps ``[n]`` [ns] and rates ``[n]`` [rad/s] of a joint, and whether they follow from its angles."""
    stamps, first = np.unique(np.array([entry[0] for entry in entries], np.int64), return_index=True)
    angles, rates = np.array([entries[index][1:] for index in first], np.float64).T
    known = np.isfinite(rates)
    if known.any() and (rates[known] != 0.0).any():
        return stamps[known], rates[known], False
    measured = np.isfinite(angles)
    if measured.sum() < 2 or np.ptp(angles[measured]) == 0.0:
        return stamps[known], rates[known], False
    stamps, angles = stamps[measured], np.unwrap(angles[measured])
    step = np.diff(stamps) * NANOSECOND
    short = step <= _LONGEST_STEP
    middle = stamps[:-1] + np.diff(stamps) // 2
    return middle[short], (np.diff(angles) / step)[short], True


def _together(series: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Stamps ``[n]`` [ns] and the rates of all joints there ``[n, J]``: their own, or between neighbours in time."""
    own = list(series.values())
    common = own[0][0]
    if not all(np.array_equal(stamps, common) for stamps, _ in own):
        common = common[(common >= max(s[0] for s, _ in own)) & (common <= min(s[-1] for s, _ in own))]
        for stamps, _ in own:
            right = np.clip(np.searchsorted(stamps, common), 0, len(stamps) - 1)
            left = np.where(stamps[right] == common, right, np.maximum(right - 1, 0))
            common = common[(stamps[right] - stamps[left]) * NANOSECOND <= _LONGEST_STEP]
    start = common[0] if len(common) else 0
    return common, np.stack([np.interp(common - start, stamps - start, rates) for stamps, rates in own], axis=1)


def _against(
    stamps: np.ndarray, speeds: np.ndarray, sides: Sequence[str], commands: CommandTrack, motion: MotionTrack
) -> np.ndarray:
    """Whether each wheel turns against what it is commanded, ``[J]``."""
    none = np.zeros(len(sides), bool)
    if len(commands) < 2:
        return none
    asked = _side_speeds(commands.sample(stamps)[:, :2], sides)
    cosines = np.array([_cosine(wanted, got) for wanted, got in zip(asked.T, speeds.T, strict=True)])
    against = cosines < _AGAINST
    if not against.all():
        return against
    # All of them: the commands may have the wrong sign, or the wheels. The poses decide.
    seconds = (motion.stamps - stamps[0]) * NANOSECOND
    twists = np.stack([motion.linear_velocities[:, 0], motion.angular_velocities[:, 2]], axis=1)
    there = (stamps - stamps[0]) * NANOSECOND
    moved = _side_speeds(np.stack([np.interp(there, seconds, values) for values in twists.T], axis=1), sides)
    cosines = np.array([_cosine(way, got) for way, got in zip(moved.T, speeds.T, strict=True)])
    return against if (cosines < _AGAINST).all() else none


def _side_speeds(twists: np.ndarray, sides: Sequence[str]) -> np.ndarray:
    """Speeds of wheels ``[n, J]`` [m/s] at forward speeds and yaw rates ``[n, 2]``."""
    places = np.array([-_HALF_TRACK if side == "left" else _HALF_TRACK for side in sides])
    return twists[:, :1] + twists[:, 1:2] * places


def _cosine(wanted: np.ndarray, got: np.ndarray) -> float:
    turning = np.abs(wanted) > _TURNING
    if turning.sum() < _FEWEST:
        return 0.0
    wanted, got = wanted[turning], got[turning]
    size = float(np.linalg.norm(wanted) * np.linalg.norm(got))
    return float(wanted @ got) / size if size > 0.0 else 0.0


def _listed(names: Sequence[str]) -> str:
    return ", ".join(sorted(names))
