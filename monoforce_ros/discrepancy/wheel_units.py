"""Wheel units: whether measured wheel speeds and the robot's file describe the same wheels.

Some drivers publish revolutions per minute, others the speed of the motor before its gear. A radius or a track width in
the robot's file may be wrong. Both show as a ratio that is the same in all of a recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.core import CommandTrack, MotionTrack, WheelTrack
from monoforce_ros.discrepancy.wheel_motion import half_track, side_speeds, wheel_ways
from monoforce_ros.robots import RobotModel

_PLAUSIBLE = (0.4, 2.5)
"""Wheel speeds over commanded ones, and over those of the ground, that drives, tyres and a radius may explain: beyond
lie the units that are in use, the nearest of them one revolution for a second, 0.16, and rpm, 9.5."""
_SAME = 0.1
"""Relative difference within which two radii are one: a tyre's rolling radius changes by 5 % from new to worn and with
its pressure, and wheels that pull on firm ground slip by 5 %."""
_FEWEST = 20
"""Pieces that say a ratio: they overlap, so that these are five which do not, and five lie all on one side of it by
chance in one of sixteen cases."""
_LEAST_WAY = 0.3
"""Way in a piece that counts [m]: three times what poses wander."""
_STRAIGHT = 0.1
"""Difference of the sides' ways over their mean up to which a piece is straight."""


@dataclass(frozen=True)
class _Ratio:
    """A ratio over pieces: its median, and the quartiles that say whether most pieces agree."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, ways: np.ndarray, references: np.ndarray) -> _Ratio | None:
        """Of ways ``[n]`` over reference ways ``[n]`` [m]; None of too few."""
        if len(ways) < _FEWEST:
            return None
        low, value, high = np.quantile(ways / references, (0.25, 0.5, 0.75))
        return cls(float(value), float(low), float(high))

    @property
    def differs(self) -> bool:
        """Whether three of four pieces say that it is not 1, all to the same side."""
        return self.low > 1.0 + _SAME or self.high < 1.0 / (1.0 + _SAME)

    @property
    def plausible(self) -> bool:
        """Whether it may be that of drives, tyres and a radius."""
        return _PLAUSIBLE[0] < self.value < _PLAUSIBLE[1]

    def over(self, other: _Ratio) -> _Ratio:
        """Divided by the median of another one."""
        return _Ratio(self.value / other.value, self.low / other.value, self.high / other.value)

    def agrees(self, other: _Ratio) -> bool:
        """Whether two ratios are one."""
        return abs(math.log(self.value / other.value)) < math.log(1.0 + _SAME)


@dataclass(frozen=True)
class _Ratios:
    """Speeds of the wheels' rims, by the file's radius, over others."""

    commanded: _Ratio | None = None
    """Over the commanded speeds, straight ahead."""
    ground: _Ratio | None = None
    """Over those of the ground, straight ahead."""
    turning: _Ratio | None = None
    """Of the sides' differences over the commanded ones."""
    commanded_anyhow: _Ratio | None = None
    """Of the sides over the commanded speeds, straight ahead and in turns."""
    ground_anyhow: _Ratio | None = None
    """Of the sides over the ground under them, straight ahead and in turns."""

    @classmethod
    def of(cls, motion: MotionTrack, wheels: WheelTrack, commands: CommandTrack, robot: RobotModel) -> _Ratios:
        ways = wheel_ways(motion, wheels, robot)
        if ways is None or not len(commands):
            return cls()
        stamps, starts, width = ways.stamps, ways.starts, ways.width
        twists = commands.sample(stamps)
        bounds = (robot.maximum_speed, robot.maximum_yaw_rate, robot.maximum_lateral_speed)[: twists.shape[1]]
        travelled = np.cumsum(side_speeds(robot, np.clip(twists, -np.array(bounds), bounds)), axis=0) * ways.step
        # Ways with their signs, [pieces, 2], of the known pieces.
        asked = (travelled[starts + width] - travelled[starts])[ways.usable]
        turned = ways.rolled[ways.usable]
        ground, furthest = ways.ground[ways.usable].mean(axis=1), ways.turned[ways.usable].mean(axis=1)
        mean, middle = np.abs(asked.mean(axis=1)), np.abs(turned.mean(axis=1))
        # Those in which the robot turned neither aside nor back.
        straight = (ways.apart[ways.usable] < _STRAIGHT * middle) & (middle > (1.0 - _STRAIGHT) * furthest)
        driven = straight & (mean > _LEAST_WAY)
        moved = straight & (ground > _LEAST_WAY)
        turns, difference = asked[:, 1] - asked[:, 0], turned[:, 1] - turned[:, 0]
        turning = (np.abs(turns) > _LEAST_WAY) & (difference * turns > 0.0)
        asked_anyhow = np.abs(asked).mean(axis=1)
        driven_anyhow, moved_anyhow = asked_anyhow > _LEAST_WAY, ground > _LEAST_WAY
        return cls(
            _Ratio.of(middle[driven], mean[driven]),
            _Ratio.of(middle[moved], ground[moved]),
            _Ratio.of(np.abs(difference[turning]), np.abs(turns[turning])),
            _Ratio.of(np.abs(turned[driven_anyhow]).mean(axis=1), asked_anyhow[driven_anyhow]),
            _Ratio.of(furthest[moved_anyhow], ground[moved_anyhow]),
        )


def in_rad_per_second(
    motion: MotionTrack, wheels: WheelTrack | None, commands: CommandTrack, robot: RobotModel
) -> tuple[WheelTrack | None, str]:
    """Wheel speeds in rad/s, and in words which unit they were recorded in; empty where they were in rad/s.

    They were not if neither commands nor the ground explain how fast they are: drives that follow a tenth of their
    commands move the robot as slowly, wheels that turn in place follow their commands.

    Args:
        motion: measured motion.
        wheels: measured wheel speeds as recorded.
        commands: recorded commands.
        robot: its wheel radius and track width are used.
    """
    if wheels is None or robot.wheel_radius is None:
        return wheels, ""
    ratios = _Ratios.of(motion, wheels, commands, robot)
    commanded, ground = ratios.commanded or ratios.commanded_anyhow, ratios.ground or ratios.ground_anyhow
    if commanded is None or commanded.plausible or (ground is not None and ground.plausible):
        return wheels, ""
    ratio = commanded.value
    units = {
        "revolutions per minute": 30.0 / math.pi,
        "revolutions per second": 0.5 / math.pi,
        "degrees per second": 180.0 / math.pi,
        "metres per second": robot.wheel_radius,
    }
    near = {name: size for name, size in units.items() if abs(math.log(ratio / size)) < math.log(1.0 + _SAME)}
    measured = f"wheel speeds are {ratio:.3g} times those of the commands by the file's radius of "
    measured += f"{robot.wheel_radius:.3g} m"
    if len(near) == 1:
        ((name, factor),) = near.items()
        text = f"{measured}: they are taken for {name}, and converted to rad/s"
    else:
        factor = ratio
        what = " or ".join(near) or "those of the motors before a gear, or of another unit"
        text = (
            f"{measured}: they are {what}, and divided by this ratio, so that they do not show whether all drives run "
            "too slow or too fast; publish rad/s of the wheels"
        )
    return replace(wheels, speeds=wheels.speeds / factor), text


def contradictions(
    motion: MotionTrack,
    wheels: WheelTrack | None,
    commands: CommandTrack,
    robot: RobotModel,
    known_ratio: float | None = None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Where measured wheel speeds [rad/s] contradict the robot's file.

    Args:
        motion: measured motion.
        wheels: measured wheel speeds.
        commands: recorded commands.
        robot: the nominal model.
        known_ratio: of measured [rad/s] and rim speeds [m/s] when the robot was commissioned; None if unknown.

    Returns:
        reasons to doubt the file, and what else the wheels show that may have another cause.
    """
    if wheels is None or robot.wheel_radius is None:
        return (), ()
    ratios = _Ratios.of(motion, wheels, commands, robot)
    commanded, ground, turning = ratios.commanded, ratios.ground, ratios.turning
    doubts, remarks = [], []
    radius = robot.wheel_radius
    learned = known_ratio is not None and abs(math.log(known_ratio * radius)) > math.log(1.0 + _SAME)
    if ground is not None and ground.differs and not learned:
        if commanded is not None and commanded.differs and commanded.agrees(ground):
            doubts.append(
                f"the wheels contradict the robot's file: by its wheel radius of {radius:.3g} m they run "
                f"{commanded.value:.2f} times as fast as commanded, and {ground.value:.2f} times as fast as the robot "
                f"moves; a radius of {radius / ground.value:.3g} m fits both (wheels in the robot's file)"
            )
        elif commanded is not None and not commanded.differs:
            remarks.append(
                f"straight ahead the wheels run as commanded, but {ground.value:.2f} times as fast as the robot moves: "
                f"they slip, or their radius is {radius / ground.value:.3g} m and not {radius:.3g} m as in the robot's "
                "file, or the poses are to another scale"
            )
    scrubs = "turning_scrub" in dict(robot.effects)
    if turning is not None and commanded is not None and robot.steered is None and not scrubs:
        relative = turning.over(commanded)
        if relative.differs:
            track = 2.0 * half_track(robot)
            remarks.append(
                f"in turns the wheels of both sides differ by {relative.value:.2f} times as much as the file's track "
                f"width of {track:.3g} m asks for: the base controller has one of {track * relative.value:.3g} m (its "
                "wheel separation times its multiplier; command.track_width in the robot's file), or the drives do not "
                "follow turns"
            )
    return tuple(doubts), tuple(remarks)
