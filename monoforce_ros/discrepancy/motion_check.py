"""Motion check: what makes a comparison of motion with commands meaningless.

``diagnose`` and ``evaluate --check`` share it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import mannwhitneyu

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import (
    NANOSECOND,
    CommandTrack,
    DelayCorrelation,
    EffortTrack,
    MotionTrack,
    WheelTrack,
    wrap_angle,
)

_LAGS = np.arange(-0.5, 1.525, 0.025)
"""Delays from command to motion that a base may have [s]: dead times of real Warthogs reach 0.65 s, and their poses are
up to 0.85 s late. Motion before its command is that of clocks which are apart; the half second is a choice, and beyond
it other offsets are tried (:func:`_unrelated`)."""
_STEP = 0.1
"""Time between samples for everything but the delay [s]."""
_SPAN = 2.0
"""Time over which motion is judged: the length of a diagnosed window [s]."""
_MOVED, _TURNED = 0.1, np.radians(5.0)
"""Motion over that time below which a robot stands: 5 cm/s and 2.5°/s, slower than any base is driven [m, rad]."""
_LEAST_MOVING = 2.0
"""Time that a robot must move: a single window [s]."""
_COMMANDED = 0.05
"""Speed [m/s] or yaw rate [rad/s] from which on a command asks for motion: that which separates a robot that moves from
one that stands (:data:`_MOVED`)."""
_NOISES, _COURSE_NOISES = 5.0, 10.0
"""Standard deviations of the poses' noise beyond which a robot moved: noise alone does in less than one of a million
cases; and from which on its course is known within 8° (√2 / 10), less than half of a curve that counts."""
_STILL_HEADING, _CURVED_COURSE = np.radians(1.0), np.radians(20.0)
"""A heading that stays within the first while the direction of travel changes by more than the second is not measured.
A rigid robot that does not slip changes both alike; ice or a slope turns the course by less."""
_SIDEWAYS = np.radians(45.0)
"""Median angle between heading and direction of travel beyond which x is not the forward axis: it is nearer to y."""
_UNRELATED = 0.5
"""Largest correlation of commands and motion at which they may be unrelated: three quarters of the variance is then
something else. Whether they are is tested against the same commands at other times."""
_RELATED, _BETTER = np.sqrt(0.5), 1.5
"""Correlation at another offset of the clocks from which on these are apart: half of the variance is shared; and how
many times that without one it must be, since the best of some hundred offsets is larger by chance."""
_LONG_ENOUGH = 20.0
"""Length from which on motion can be called unrelated [s]: ten windows; of a shorter one chance correlations are
large."""
_IDENTIFIED = 2.0
"""Largest offset of a clock that ``diagnose`` identifies as an effect: the bound of the catalogue [s]."""
_BROKEN = 0.1
"""Share of poses before a jump or a pause from which on these are no motion: stretches of ten poses are too short for a
window at any rate of odometry above 5 Hz."""
_GAP = 0.5
"""Time without a pose in which motion is unknown [s]."""
_WORKING, _IDLE = 1.5, 100.0
"""Times the current at rest from which motors work, and from which that at rest is none. Both are choices, not
calibrated: a reading that drifts changes by some hundredths, and a drive that is blocked draws a multiple."""
_ALPHA = 0.05
"""Probability that motors which work no harder while something is commanded pass for blocked ones."""
_SHIFTS = 19
"""Shifts of the commands against which the correlation is tested: it must exceed 95 % of them."""


def motion_faults(
    smoothed: SmoothedMotion,
    commands: CommandTrack,
    wheels: WheelTrack | None = None,
    efforts: EffortTrack | None = None,
) -> tuple[str, ...]:
    """What makes any comparison of this motion with these commands meaningless; empty where nothing does.

    Args:
        smoothed: measured motion.
        commands: commands to the base.
        wheels: measured wheel speeds, if there are any.
        efforts: currents or torques of the motors, if there are any.

    Returns:
        one sentence each, with what to do.
    """
    if not len(commands):
        return ("commands: no Twist or TwistStamped; record the commands of the base controller (cmd_vel)",)
    motion = smoothed.motion
    if len(motion) < 2:
        return (f"{len(motion)} poses, expected a recording of them: record nav_msgs/Odometry",)
    jumps = len(smoothed.stretches) - 1
    if jumps > _BROKEN * len(motion):
        return (
            f"the odometry jumps or pauses {jumps} times in {len(motion)} poses, which is no motion of one robot: two "
            "sources publish on the topic, a clock was set back while it was recorded, or positions are not in metres",
        )
    apart = max(int(motion.stamps[0] - commands.stamps[-1]), int(commands.stamps[0] - motion.stamps[-1])) * NANOSECOND
    if apart > 0:
        return (
            f"commands and poses do not overlap in time, they are {apart:.0f} s apart: different clocks stamped them; "
            "synchronise the robot's clocks before recording",
        )
    still = _standing(smoothed, commands, wheels, efforts)
    if still:
        return (still,)
    # Speeds of wrong poses are wrong, too: whether they follow the commands says nothing then.
    crabs = commands.twists.shape[-1] > 2 and float(np.abs(commands.twists[:, 2]).max()) >= _COMMANDED
    faults = tuple(_pose_faults(smoothed, crabs=crabs))
    other = "" if faults else _unrelated(smoothed, commands, wheels)
    return (other,) if other else faults


def command_delay(motion: MotionTrack, commands: CommandTrack) -> tuple[float, float]:
    """Delay from command to motion [s], and the correlation of both at that delay, 0 to 1; NaN and 0 if unknown."""
    return _correlated(_Followed.by_motion(motion), commands, _LAGS, (0, 1))


@dataclass(frozen=True)
class _Followed:
    """What may follow commands: speeds and yaw rates in any unit."""

    stamps: np.ndarray
    """``[n]`` [ns]."""
    values: np.ndarray
    """``[n, 2]``."""

    @classmethod
    def by_motion(cls, motion: MotionTrack) -> _Followed:
        """Those of the base."""
        return cls(motion.stamps, np.stack([motion.linear_velocities[:, 0], motion.angular_velocities[:, 2]], axis=1))

    @classmethod
    def by_wheels(cls, wheels: WheelTrack) -> _Followed:
        """Those that the wheels ask for."""
        left, right = wheels.speeds.T
        return cls(wheels.stamps, np.stack([left + right, right - left], axis=1))


def _correlated(
    followed: _Followed, commands: CommandTrack, lags: np.ndarray, axes: Sequence[int]
) -> tuple[float, float]:
    """The best of the lags [s] and the correlation there, of speed (axis 0), yaw rate (axis 1) or both."""
    first = int(followed.stamps[0])
    stamps = np.concatenate(
        [np.arange(low, high, 25_000_000, dtype=np.int64) for low, high in _without_gaps(followed.stamps)]
    )
    if len(stamps) < 80:
        return float("nan"), 0.0
    seconds, times = (stamps - first) * NANOSECOND, (followed.stamps - first) * NANOSECOND
    pieces = []
    for axis in axes:
        measured = np.interp(seconds, times, followed.values[:, axis])
        spread = float(measured.std())
        # Both signals in units of one scale: a robot that turns at a third of what is commanded follows all the same,
        # and an axis counts by how much it moves and is commanded to.
        scale = np.sqrt(spread * float(commands.sample(stamps)[:, axis].std()))

        def delayed(lag: float, axis: int = axis, scale: float = scale) -> tuple[np.ndarray, np.ndarray]:
            commanded = commands.sample(stamps - round(1e9 * lag))[:, axis]
            own = float(commanded.std())
            # A nearly constant command carries no information about delay.
            return (commanded - commanded.mean()) * scale / max(own, 1e-9), np.full(len(stamps), own > 0.02)

        pieces.append(((measured - measured.mean()) * scale / max(spread, 1e-9), delayed))
    correlation = DelayCorrelation.of(pieces, lags)
    if not len(correlation) or correlation.values.max() <= 0.0:
        return float("nan"), 0.0
    best = int(np.argmax(correlation.values))
    return float(lags[best]), float(correlation.values[best])


def _without_gaps(stamps: np.ndarray) -> list[tuple[int, int]]:
    """First and last stamp [ns] of each part of a track without gaps."""
    ends = np.flatnonzero(np.diff(stamps) * NANOSECOND > _GAP)
    firsts, lasts = np.r_[0, ends + 1], np.r_[ends, len(stamps) - 1]
    return [(int(stamps[low]), int(stamps[high])) for low, high in zip(firsts, lasts, strict=True)]


def _sampled(smoothed: SmoothedMotion) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Times [s], positions ``[n, 2]`` [m] and unwrapped headings ``[n]`` [rad] of each gap-free stretch."""
    motion = smoothed.motion
    for stretch in smoothed.stretches:
        times = (motion.stamps[stretch] - motion.stamps[0]) * NANOSECOND
        if len(times) < 2 or times[-1] - times[0] < _SPAN:
            continue
        at = np.arange(times[0], times[-1], _STEP)
        headings = np.unwrap(Rotation.from_quat(motion.quaternions[stretch]).as_euler("ZYX")[:, 0])
        places = np.stack([np.interp(at, times, motion.positions[stretch, axis]) for axis in range(2)], axis=1)
        yield at, places, np.interp(at, times, headings)


def _standing(
    smoothed: SmoothedMotion, commands: CommandTrack, wheels: WheelTrack | None, efforts: EffortTrack | None
) -> str:
    """That the robot does not move; empty if it does."""
    span = round(_SPAN / _STEP)
    least = max(_MOVED, _NOISES * smoothed.position_noise), max(_TURNED, _NOISES * smoothed.rotation_noise)
    moving = judged = 0.0
    for _, places, headings in _sampled(smoothed):
        shift = np.linalg.norm(places[span:] - places[:-span], axis=1)
        turn = np.abs(headings[span:] - headings[:-span])
        moving += _STEP * float(np.sum((shift > least[0]) | (turn > least[1])))
        judged += _STEP * len(shift)
    # In less than two windows a robot that moves all the time falls short of one: half the time is enough there.
    if moving >= min(_LEAST_MOVING, 0.5 * judged):
        return ""
    largest = np.abs(commands.twists).max(axis=0)
    if (largest < _COMMANDED).all():
        return "the robot stands, and nothing is commanded: drive forward at changing speed and turn both ways for 30 s"
    asked = f"commands reach {largest[0]:.2f} m/s and {largest[1]:.2f} rad/s"
    # Rad/s: at a wheel radius of 0.1 m or more, 5 cm/s at most.
    if wheels is not None and len(wheels) and np.quantile(np.abs(wheels.speeds), 0.95) > 0.5:
        fastest = float(np.quantile(np.abs(wheels.speeds), 0.95))
        return (
            f"the robot does not move although its wheels turn, at up to {fastest:.1f} rad/s ({asked}): they are off "
            "the ground, dug in, or the robot is blocked; or the poses are of something that stands"
        )
    strained = _strained(commands, efforts)
    if strained is not None:
        than = f"{strained:.2g} times the current that they draw" if strained < _IDLE else "current, and hardly any"
        return (
            f"the robot does not move although {asked}, and its motors work: they draw {than} while nothing is "
            "commanded; it is blocked, dug in, or a brake holds it"
        )
    return (
        f"the robot does not move although {asked}: emergency stop, motors off, wrong command topic, or poses of "
        "something that stands; check them and record again"
    )


def _strained(commands: CommandTrack, efforts: EffortTrack | None) -> float | None:
    """How many times the current of the motors is larger while something is commanded; None if that is not certain."""
    if efforts is None or len(efforts) < 2:
        return None
    asked = (np.abs(commands.sample(efforts.stamps)) >= _COMMANDED).any(axis=1)
    numbers = (efforts.stamps - efforts.stamps[0]) // round(_SPAN / NANOSECOND)
    driven: list[float] = []
    idle: list[float] = []
    for number in np.unique(numbers):
        inside = numbers == number
        if asked[inside].all() or not asked[inside].any():
            (driven if asked[inside].all() else idle).append(float(efforts.efforts[inside].mean()))
    if not driven or not idle or mannwhitneyu(driven, idle, alternative="greater").pvalue >= _ALPHA:
        return None
    ratio = float(np.median(driven)) / max(float(np.median(idle)), 1e-9)
    return ratio if ratio >= _WORKING else None


def _pose_faults(smoothed: SmoothedMotion, *, crabs: bool = False) -> Iterator[str]:
    """Faults of the poses alone; a robot that was commanded to move sideways has no course of its heading."""
    motion = smoothed.motion
    rotations = Rotation.from_quat(motion.quaternions).as_matrix()
    # Nearer to its side than to its wheels, for most of the time: 45°.
    if np.median(rotations[:, 2, 2]) < np.sqrt(0.5):
        yield (
            "by its poses the robot lies on its side or upside down: record poses of the base frame in a frame whose "
            "z axis points up"
        )
        return
    if crabs:
        return
    courses, headings, offsets = [], [], []
    least = max(0.2, _COURSE_NOISES * smoothed.position_noise)
    for _, places, heading in _sampled(smoothed):
        step = round(0.5 / _STEP)
        moved = places[step:] - places[:-step]
        far = np.linalg.norm(moved, axis=1) > least
        if not far.any():
            continue
        course = np.arctan2(moved[:, 1], moved[:, 0])[far]
        middle = heading[step // 2 : step // 2 + len(moved)][far]
        courses.append(course)
        headings.append(heading)
        offsets.append(wrap_angle(2 * (course - middle)) / 2)  # modulo half a turn: it may drive in reverse
    if not courses:
        return
    course = np.concatenate(courses)
    # Spread of a direction whose sign is unknown: by doubled angles.
    mean = np.angle(np.mean(np.exp(2j * course)))
    spread = float(np.quantile(np.abs(wrap_angle(2 * course - mean)) / 2, 0.9))
    heading = np.concatenate(headings)
    turned = float(np.ptp(heading))
    if turned < _STILL_HEADING and spread > _CURVED_COURSE:
        yield (
            f"the poses' orientation never changes ({np.degrees(turned):.2f}°) while the robot drives curves (of "
            f"{np.degrees(2 * spread):.0f}°): the localisation measures no heading; record poses with orientation, for "
            "example from lidar SLAM"
        )
        return
    sideways = float(np.median(np.abs(np.concatenate(offsets))))
    if sideways > _SIDEWAYS:
        yield (
            f"by its poses the robot drives sideways, {np.degrees(sideways):.0f}° from its x axis: these are poses of "
            "another frame; record those of the base frame, x forward"
        )


def _unrelated(smoothed: SmoothedMotion, commands: CommandTrack, wheels: WheelTrack | None) -> str:
    """That motion does not follow the commands at any plausible delay; empty if it does, or if that is unknown."""
    motion = smoothed.motion
    largest = np.abs(commands.twists).max(axis=0)
    if (largest < _COMMANDED).all():
        return "the robot moves, but nothing is commanded: another topic drives it, such as a joystick; record that one"
    span = (int(motion.stamps[-1]) - int(motion.stamps[0])) * NANOSECOND
    followed = _Followed.by_motion(motion)
    correlation = _follows(followed, commands)
    if correlation >= _UNRELATED or correlation <= 0.0 or span < _LONG_ENOUGH:
        return ""
    # The clocks may be apart by more than a base can be late.
    wide = np.arange(-min(60.0, 0.5 * span), min(60.0, 0.5 * span), 0.1)
    offset, best = _correlated(followed, commands, wide, (0, 1))
    if best > max(_RELATED, _BETTER * correlation):
        if abs(offset) <= _IDENTIFIED:
            return ""
        return (
            f"motion follows the commands {offset:+.1f} s later (correlation {best:.2f}), which no base does: "
            "different clocks stamped them; synchronise the robot's clocks before recording"
        )
    # The same commands at other times are as unrelated as commands can be.
    first, length = int(commands.stamps[0]), max(int(commands.stamps[-1] - commands.stamps[0]), 1)
    chance = []
    for number in range(1, _SHIFTS + 1):
        moved = (commands.stamps - first + number * length // (_SHIFTS + 1)) % length + first
        order = np.argsort(moved, kind="stable")
        chance.append(_follows(followed, CommandTrack(moved[order], commands.twists[order])))
    if correlation > float(np.quantile(chance, 0.95)):
        return ""
    by_wheels = _follows(_Followed.by_wheels(wheels), commands) if wheels is not None and len(wheels) > 1 else 0.0
    if by_wheels >= _UNRELATED:
        return (
            f"the wheels follow the commands (correlation {by_wheels:.2f}) and the robot does not ({correlation:.2f}): "
            "it is blocked, dug in or off the ground for most of the time, or the poses are of something else; record "
            "again where it can drive"
        )
    return (
        f"motion does not follow the commands (correlation {correlation:.2f}, no larger than with the commands of "
        "other times): wrong topic, another source of commands such as a joystick, or other clocks"
    )


def _follows(followed: _Followed, commands: CommandTrack) -> float:
    """The larger correlation of speed and of yaw rate with their commands.

    A fault may spoil one of them: a robot that is pulled aside still drives forward as commanded.
    """
    return max(_correlated(followed, commands, _LAGS, (axis,))[1] for axis in (0, 1))
