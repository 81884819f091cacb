"""Wheel units: whether measured wheel speeds and the robot's file describe the same wheels.

Some drivers publish revolutions per minute, others the speed of the motor before its gear. A radius or a track width in
the robot's file may be wrong. Both show as a ratio that is the same in all of a recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from monoforce_ros.core import CommandTrack, MotionTrack, WheelTrack
from monoforce_ros.discrepancy.healthy_wheels import HealthyWheels
from monoforce_ros.discrepancy.wheel_motion import half_track, side_speeds, wheel_ways
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel

PLAUSIBLE = (0.4, 2.5)
"""Wheel speeds over commanded ones, and over those of the ground, that drives, tyres and a radius may explain: beyond
lie the units that are in use, the nearest of them one revolution for a second, 0.16, and rpm, 9.5."""
_STANDING = 0.02
"""A ratio below says that the wheels stand, or that their sensors are dead: the smallest one of a unit is that of
metres per second, the radius of the wheels."""
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
        return PLAUSIBLE[0] < self.value < PLAUSIBLE[1]

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

    @property
    def of_commands(self) -> tuple[_Ratio, ...]:
        """Over the commanded speeds, the surer one first."""
        return tuple(ratio for ratio in (self.commanded, self.commanded_anyhow) if ratio is not None)

    @property
    def of_ground(self) -> tuple[_Ratio, ...]:
        """Over those of the ground, the surer one first."""
        return tuple(ratio for ratio in (self.ground, self.ground_anyhow) if ratio is not None)

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


@dataclass(frozen=True)
class WheelUnit:
    """The unit in which wheel speeds were recorded."""

    factor: float = 1.0
    """Recorded speeds over those in rad/s."""
    text: str = ""
    """In words; empty for rad/s."""


def wheel_unit(
    motion: MotionTrack, wheels: WheelTrack | None, commands: CommandTrack, robot: RobotModel, known: float = 1.0
) -> WheelUnit:
    """The unit of recorded wheel speeds.

    They are in rad/s unless neither commands nor the ground explain how fast they are: drives that follow a tenth of
    their commands move the robot as slowly, wheels that turn in place follow their commands. Where the robot hardly
    moves, slow wheels may be slow drives; fast ones are not. The ground's ratio counts first: by it drives that run too
    slow keep that.

    Args:
        motion: measured motion.
        wheels: measured wheel speeds as recorded.
        commands: recorded commands.
        robot: its wheel radius and track width are used.
        known: factor when the robot was commissioned, which counts as long as it explains the speeds.
    """
    if wheels is None or robot.wheel_radius is None:
        return WheelUnit()
    if known != 1.0:
        scaled = _Ratios.of(motion, replace(wheels, speeds=wheels.speeds / known), commands, robot)
        found = [ratio for ratio in (*scaled.of_commands, *scaled.of_ground) if ratio.value > _STANDING]
        if not found or any(ratio.plausible for ratio in found):
            return WheelUnit(known, f"wheel speeds are divided by {known:.4g}, as when the robot was commissioned")
    ratios = _Ratios.of(motion, wheels, commands, robot)
    commanded, ground = next(iter(ratios.of_commands), None), next(iter(ratios.of_ground), None)
    if commanded is None or commanded.plausible or commanded.value < _STANDING:
        return WheelUnit()
    if ground is None and commanded.value < 1.0:
        return WheelUnit()
    if ground is not None and (ground.plausible or ground.value < _STANDING):
        return WheelUnit()
    units = {
        "revolutions per minute": 30.0 / math.pi,
        "revolutions per second": 0.5 / math.pi,
        "degrees per second": 180.0 / math.pi,
        "metres per second": robot.wheel_radius,
    }
    # In turns wheels slip, so that the ground's ratio is the surest one straight ahead and the least sure one anyhow.
    known_as: dict[str, list[str]] = {}
    for of_what, ratio in (("ground", ratios.ground), ("commands", commanded), ("ground", ground)):
        if ratio is None:
            continue
        near = [name for name, size in units.items() if abs(math.log(ratio.value / size)) < math.log(1.0 + _SAME)]
        measured = f"wheel speeds are {ratio.value:.3g} times those of the {of_what} by the file's radius of "
        measured += f"{robot.wheel_radius:.3g} m"
        if len(near) == 1:
            return WheelUnit(units[near[0]], f"{measured}: they are taken for {near[0]}, and converted to rad/s")
        known_as.setdefault(measured, near)
    measured, near = next(iter(known_as.items()))
    ratio = ratios.ground or commanded
    what = " or ".join(near) or "those of the motors before a gear, or of another unit"
    return WheelUnit(
        ratio.value,
        f"{measured}: they are {what}, or the radius is wrong; they are divided by this ratio, so that they do not "
        "show whether all drives run too slow or too fast; publish rad/s of the wheels",
    )


def in_rad_per_second(healthy: HealthyWheels, radius: float | None) -> HealthyWheels:
    """What was learned of wheels whose unit nobody recognised, for speeds in rad/s.

    Args:
        healthy: of a robot that was commissioned with speeds as they were recorded, or with a known unit.
        radius: of the wheels, by the robot's file [m]; None if it has none.
    """
    if radius is None or PLAUSIBLE[0] < healthy.ratio * radius < PLAUSIBLE[1]:
        return healthy
    return replace(healthy, ratio=1.0 / radius, unit=healthy.unit * healthy.ratio * radius)


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
    scrubs = any(CATALOGUE[name].like_track_width for name, _ in robot.effects)
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
