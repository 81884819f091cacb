"""Windows: sections of a recording with their motion and commands, including the commands before each section."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monoforce_ros.bags.joint_record import JointRecord
from monoforce_ros.core import CommandTrack, MotionState, MotionTrack, StaleDataError


@dataclass(frozen=True)
class Windows:
    """Sections of a recording, all of the same length."""

    starts: tuple[MotionState, ...]
    """Measured state at the start of each window, ``[W]``."""
    twists: np.ndarray
    """Commanded forward speed [m/s] and yaw rate [rad/s] at each physics step, beginning ``history`` steps before the
    start, ``[W, history + T, 2]``; ``[W, history + T, 3]`` with lateral speeds [m/s]."""
    history: int
    """Physics steps before the start."""
    times: np.ndarray
    """Times since the start at which the motion is sampled [s], ``[K]``."""
    positions: np.ndarray
    """Measured positions at these times in the odometry frame [m], ``[W, K, 3]``."""
    rotations: np.ndarray
    """Measured rotations odometry ← base, ``[W, K, 3, 3]``."""
    velocities: np.ndarray
    """Measured velocity in base axes [m/s], ``[W, K, 3]``."""
    angular_velocities: np.ndarray
    """Measured angular velocity in base axes [rad/s], ``[W, K, 3]``."""
    joint_start: np.ndarray | None = None
    """Measured angles of the joints at the start [rad], ``[W, J]``, NaN where unknown."""
    flippers: np.ndarray | None = None
    """Commanded angles of the flippers at each physics step [rad], ``[W, T, F]``, NaN where unknown."""

    def __len__(self) -> int:
        return len(self.starts)


def cut_windows(
    motion: MotionTrack,
    commands: CommandTrack,
    *,
    length: float = 5.0,
    stride: float = 1.0,
    history: float = 2.0,
    time_step: float = 0.01,
    sample_time: float = 0.1,
    maximum_gap: float = 0.3,
    timeout: float = np.inf,
    joints: JointRecord | None = None,
    stretches: Sequence[slice] | None = None,
) -> Windows:
    """Cut a recording into windows.

    Windows with a gap in the odometry are left out: nothing is interpolated over more than ``maximum_gap``.

    Args:
        motion: measured or smoothed motion.
        commands: recorded commands; zero before the first one.
        length: length of a window [s].
        stride: time between the starts of windows [s].
        history: duration of the commands before each start [s], for delays and lags of the drives.
        time_step: time step of the physics [s].
        sample_time: time between samples of the motion [s].
        maximum_gap: largest time between a sample and the odometry around it [s].
        timeout: age beyond which a command is ignored [s].
        joints: recorded joints of the robot.
        stretches: of a smoothed motion (:class:`~monoforce_ros.bags.SmoothedMotion`): windows across a jump of the
            localisation are left out.

    Raises:
        ValueError: no window is left; the message gives the duration of the odometry.
    """
    steps, before = round(length / time_step), round(history / time_step)
    times = np.arange(round(length / sample_time) + 1) * sample_time
    starts, sampled = [], []
    if len(motion):
        first, last = int(motion.stamps[0]), int(motion.stamps[-1])
        parts = [slice(0, len(motion))] if stretches is None else stretches
        whole = [(int(motion.stamps[part.start]), int(motion.stamps[part.stop - 1])) for part in parts]
        for start in range(first, last - round(length * 1e9) + 1, round(stride * 1e9)):
            if not any(low <= start and start + round(length * 1e9) <= high for low, high in whole):
                continue
            try:
                states = [motion.at(start + round(1e9 * time), maximum_gap=maximum_gap) for time in times]
            except StaleDataError:
                continue
            starts.append(states[0])
            sampled.append(states)
    if not starts:
        span = (int(motion.stamps[-1]) - int(motion.stamps[0])) * 1e-9 if len(motion) else 0.0
        raise ValueError(
            f"windows: got {span:.1f} s of odometry, expected at least {length:g} s without a gap of more than "
            f"{maximum_gap:g} s"
        )
    offsets = np.rint(np.arange(-before, steps) * time_step * 1e9).astype(np.int64)
    first_stamps = np.array([state.stamp for state in starts])
    stamps = first_stamps[:, None] + offsets
    return Windows(
        starts=tuple(starts),
        twists=commands.sample(stamps, timeout=timeout),
        history=before,
        times=times,
        positions=np.array([[state.position for state in states] for states in sampled]),
        rotations=np.array([[state.rotation for state in states] for states in sampled]),
        velocities=np.array([[state.linear_velocity for state in states] for states in sampled]),
        angular_velocities=np.array([[state.angular_velocity for state in states] for states in sampled]),
        joint_start=None if joints is None else joints.start(first_stamps),
        flippers=None if joints is None else joints.flipper_angles(stamps[:, before:]),
    )
