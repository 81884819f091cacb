"""DRIVE: commands and measured motion of Clearpath robots (github.com/norlab-ulaval/DRIVE).

Two formats are read: 2 s windows at 20 Hz, three for each command held for 6 s (``.npz``, or a ``.csv(.gz)`` table with
a row each), and continuous ``.csv(.gz)`` logs. The gyro's sign and the delay of the lidar's poses are estimated by
comparing the two; poses that are repeated until the next one arrives are dropped, and windows are joined by their order
and masks.
"""

from __future__ import annotations

import csv
import gzip
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, builders, smooth
from monoforce_ros.core import DelayCorrelation, Delayed, MotionTrack
from monoforce_ros.datasets.dataset import DatasetError, odometry_message

WHEEL_RADIUS, TRACK_WIDTH = 0.3, 1.08
"""Dimensions of the Warthog that recorded the data [m]."""
BASE_FRAME = "base_link"
START_STAMP = 1_700_000_000 * 10**9
"""Stamp of the first sample of windows, which have no time [ns]."""
PAUSE = 4.0
"""Time between runs of windows in a bag [s], longer than any gap that is interpolated."""
WINDOW_LENGTH = 2.0
"""Length of a window [s]."""
LARGEST_FILE = 1_000_000_000
"""Size of unpacked data beyond which a file is rejected [bytes]."""

_FIELDS = (
    "cmd_left", "cmd_right", "left_wheel_vel", "right_wheel_vel", "icp_x", "icp_y", "icp_z", "icp_roll", "icp_pitch",
    "icp_yaw", "imu_yaw_rate",
)  # fmt: skip
_COLUMNS = (
    "ros_time", "meas_left_vel", "meas_right_vel", "cmd_vel_x", "cmd_vel_omega", "icp_pos_x", "icp_pos_y",
    "icp_pos_z", "icp_quat_x", "icp_quat_y", "icp_quat_z", "icp_quat_w", "imu_z",
)  # fmt: skip
_CURRENTS = ("left_wheel_current", "right_wheel_current")
_TRUTH = {"True": 1.0, "False": 0.0}
_LONGEST_REPEAT = 0.25
_LAGS = np.arange(-10, 61) * 0.05
"""Candidate delays [s]."""
_LONG_RUN, _TRANSIENT = 20.0, 3.0
"""Runs shorter than the first have one command; their turn rate changes mostly within the second [s]."""
_FASTEST_TURN = 2.5
_WEAKEST = 0.5
"""Correlation below which the clocks are considered unknown."""


@dataclass(frozen=True)
class DriveRun:
    """Samples without interruption."""

    stamps: np.ndarray
    """``[n]`` int64 [ns], evenly spaced."""
    twists: np.ndarray
    """Commanded forward speed [m/s] and yaw rate [rad/s], ``[n, 2]``."""
    wheels: np.ndarray
    """Measured speeds of the left and right wheels [rad/s], ``[n, 2]``."""
    positions: np.ndarray
    """From lidar localisation, ``[n, 3]`` [m]."""
    quaternions: np.ndarray
    """``[n, 4]`` x, y, z, w."""
    gyro: np.ndarray
    """Yaw rate as recorded, of unknown sign, ``[n]`` [rad/s]."""
    currents: np.ndarray | None = None
    """Of the left and right motors, ``[n, 2]`` [A]; None where none were recorded."""


@dataclass(frozen=True)
class ClockFinding:
    """Result of comparing the lidar's headings with the gyro."""

    gyro_sign: int
    """1, or -1 where the gyro is mounted upside down; 0 if unknown."""
    pose_delay: float
    """Delay of the poses relative to the gyro [s]; NaN if unknown."""
    correlation: float
    """Correlation of the two yaw rates at this delay, 0 to 1."""


@dataclass(frozen=True)
class DriveRecording:
    """One file of the dataset."""

    path: Path
    runs: tuple[DriveRun, ...]
    steady: np.ndarray | None = None
    """Whether each window is in steady state, ``[windows]`` bool, in the order of the file."""

    @classmethod
    def open(cls, path: str | Path) -> DriveRecording:
        """Read a file of windows or a continuous log, depending on its extension.

        Raises:
            DatasetError: the file is missing, too large, damaged, or of another layout.
        """
        path = Path(path)
        if not path.is_file():
            raise DatasetError(f"{path}: no such file; expected .npz windows or a .csv or .csv.gz log of DRIVE")
        if path.suffix == ".npz":
            return _open_windows(path)
        if path.name.endswith((".csv", ".csv.gz")):
            return _open_log(path)
        raise DatasetError(f"{path}: got {path.suffix or 'no extension'}, expected .npz, .csv or .csv.gz")

    def clocks(self) -> ClockFinding:
        """Estimate the gyro's sign and the delay of the poses from the turns of all runs.

        All delays are compared over the same pose samples; before and after a run the gyro is assumed to keep its first
        and last value, as the command is held there. The steady part of a run has no information on the delay and is
        not used.
        """
        pairs = [pair for pair in map(_yaw_rates, self.runs) if pair is not None]
        found = DelayCorrelation.of(map(_delayed_gyro, pairs), _LAGS)
        if not len(found) or np.sqrt(found.energies.sum(axis=0).prod(axis=0)).max() < 0.2:
            return ClockFinding(0, float("nan"), 0.0)
        best = found.strongest
        correlation = float(found.values[best])
        if abs(correlation) < _WEAKEST:
            return ClockFinding(0, float("nan"), abs(correlation))
        return ClockFinding(1 if correlation > 0 else -1, float(_LAGS[best]), abs(correlation))


def drive_to_bag(
    recording: DriveRecording,
    out: str | Path,
    *,
    correct_delay: bool = False,
    storage: str = "mcap",
    overwrite: bool = False,
) -> list[str]:
    """Write a recording as a bag: commands, odometry, wheel speeds and yaw rate.

    Velocities of the odometry are derivatives of the smoothed poses. Runs of windows are separated by a pause, and each
    starts at the origin.

    Args:
        recording: file of the dataset.
        out: folder of the bag.
        correct_delay: correct the pose stamps by the delay relative to the gyro instead of keeping them as recorded.
        storage: ``mcap`` or ``sqlite3``.
        overwrite: replace an existing bag.

    Returns:
        remarks on findings and corrections.
    """
    clocks = recording.clocks()
    remarks = []
    if clocks.gyro_sign == 0:
        remarks.append("the gyro's sign is unknown, since it does not correlate with the headings of the poses")
    else:
        remarks.append(
            f"the poses are {clocks.pose_delay:.2f} s late relative to the gyro "
            f"(correlation {clocks.correlation:.2f}); "
            + ("their stamps are corrected" if correct_delay else "their stamps are left as recorded")
        )
        if clocks.gyro_sign < 0:
            remarks.append("the gyro has the opposite sign of the poses' yaw rate: its sign is corrected")
    shift = round(1e9 * clocks.pose_delay) if correct_delay and clocks.gyro_sign else 0
    messages: list[tuple[int, str, object]] = []
    for run in recording.runs:
        fresh = _fresh_poses(run)
        motion = smooth(
            MotionTrack(
                stamps=run.stamps[fresh] - shift,
                positions=run.positions[fresh],
                quaternions=run.quaternions[fresh],
                linear_velocities=np.zeros((int(fresh.sum()), 3)),
                angular_velocities=np.zeros((int(fresh.sum()), 3)),
                frame_id="odom",
                child_frame_id=BASE_FRAME,
            )
        ).motion
        # Poses stay as recorded; velocities, which were not recorded, come from the smoothed motion.
        motion = MotionTrack(
            motion.stamps, run.positions[fresh], run.quaternions[fresh], motion.linear_velocities,
            motion.angular_velocities, "odom", BASE_FRAME,
        )  # fmt: skip
        messages += [(int(motion.stamps[i]), "/odom", odometry_message(motion, i)) for i in range(len(motion))]
        for index, stamp in enumerate(run.stamps.tolist()):
            twist = builders.twist_stamped(stamp, BASE_FRAME, *run.twists[index].tolist())
            currents = () if run.currents is None else run.currents[index]
            names = ["left_wheel", "right_wheel"]
            wheels = builders.joint_state(stamp, names, [0.0, 0.0], run.wheels[index], currents)
            messages += [(stamp, "/cmd_vel", twist), (stamp, "/joint_states", wheels)]
            if clocks.gyro_sign:
                rate = np.array([0.0, 0.0, clocks.gyro_sign * run.gyro[index]])
                messages.append((stamp, "/imu/data", builders.imu(stamp, "imu_link", rate, np.zeros(3))))
    if clocks.gyro_sign:
        remarks.append("/imu/data contains only the yaw rate")
    first = min(stamp for stamp, _, _ in messages)
    about = builders.string("; ".join([f"from DRIVE {recording.path.name}", *remarks]))
    with BagWriter(out, storage=storage, overwrite=overwrite) as bag:
        bag.write("/about", about, first)
        for stamp, topic, message in sorted(messages, key=lambda entry: entry[0]):
            bag.write(topic, message, stamp)
    return remarks


def _fresh_poses(run: DriveRun) -> np.ndarray:
    """Whether each sample has a new pose, ``[n]`` bool; the log repeats a pose until the next one arrives."""
    same = (np.diff(run.positions, axis=0) == 0.0).all(axis=1) & (np.diff(run.quaternions, axis=0) == 0.0).all(axis=1)
    fresh = np.r_[True, ~same]
    last = 0
    for index in range(1, len(fresh)):
        # A robot at rest repeats its pose too, so a repeated pose is accepted at intervals.
        if not fresh[index] and (run.stamps[index] - run.stamps[last]) * 1e-9 >= _LONGEST_REPEAT:
            fresh[index] = True
        if fresh[index]:
            last = index
    return fresh


def _yaw_rates(run: DriveRun) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Yaw rates of poses and gyro at the same times, averaged over a third of a second, and their time step [s].

    Headings are interpolated between new poses; larger rates than a robot's are jumps of the localisation and clipped.
    """
    if len(run.stamps) < 40:
        return None
    step = float(np.median(np.diff(run.stamps))) * 1e-9
    reach = max(1, round(0.33 / step))
    fresh = _fresh_poses(run)
    times = (run.stamps - run.stamps[0]) * 1e-9
    yaw = np.unwrap(Rotation.from_quat(run.quaternions[fresh]).as_euler("ZYX")[:, 0])
    yaw = np.interp(times, times[fresh], yaw)
    pose = np.clip((yaw[reach:] - yaw[:-reach]) / (reach * step), -_FASTEST_TURN, _FASTEST_TURN)
    gyro = np.convolve(run.gyro, np.ones(reach) / reach, mode="valid")[: len(pose)]
    return pose[: len(gyro)], gyro, step


def _delayed_gyro(pair: tuple[np.ndarray, np.ndarray, float]) -> tuple[np.ndarray, Delayed]:
    """Yaw rate of the poses in the transient part of a run, and of the gyro as a function of the delay."""
    pose, gyro, step = pair
    reach = int(np.rint(np.abs(_LAGS).max() / step))
    padded = np.pad(gyro, reach, mode="edge")
    count = len(pose) if len(pose) * step > _LONG_RUN else min(len(pose), round(_TRANSIENT / step))

    def delayed(lag: float) -> tuple[np.ndarray, np.ndarray]:
        first = reach - int(np.rint(lag / step))
        return padded[first : first + count], np.ones(count, bool)

    return pose[:count], delayed


def _open_windows(path: Path) -> DriveRecording:
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > LARGEST_FILE:
            raise DatasetError(f"{path}: got {size} bytes, expected at most {LARGEST_FILE}")
        with np.load(path, allow_pickle=False) as content:
            names = (*_FIELDS, "steady_state_mask", "transitory_state_mask", "dt")
            missing = sorted(set(names) - set(content.files))
            if missing:
                raise DatasetError(f"{path}: got no {', '.join(missing)}; expected windows of DRIVE")
            data = {name: np.asarray(content[name], np.float64) for name in names}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path}: not readable: {error}") from error
    return _runs_of_windows(path, data)


def _runs_of_windows(path: Path, data: dict[str, np.ndarray]) -> DriveRecording:
    """Join windows to runs; ``data`` has the fields ``[windows, samples]``, the masks ``[windows]`` and ``dt`` [s]."""
    shapes = {data[name].shape for name in _FIELDS}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or min(next(iter(shapes))) < 2:
        raise DatasetError(f"{path}: got shapes {sorted(shapes)}, expected [windows, samples] for all")
    count = next(iter(shapes))[0]
    steady, transitory = data["steady_state_mask"] > 0.5, data["transitory_state_mask"] > 0.5
    if steady.shape != (count,) or transitory.shape != (count,) or not 0.001 <= float(data["dt"]) <= 1.0:
        raise DatasetError(f"{path}: masks or time step do not fit its {count} windows")
    finite = np.logical_and.reduce([np.isfinite(data[name]).all(axis=1) for name in _FIELDS])
    step = round(1e9 * float(data["dt"]))
    runs, begin = [], START_STAMP
    starts = [k for k in range(count) if transitory[k] or k == 0 or not (steady[k] and finite[k - 1])]
    for start, stop in zip(starts, [*starts[1:], count], strict=True):
        members = [k for k in range(start, stop) if finite[k]]
        if not members:
            continue
        run = _join(data, members, begin, step)
        runs.append(run)
        begin = int(run.stamps[-1]) + round(PAUSE * 1e9)
    if not runs:
        raise DatasetError(f"{path}: no window has finite numbers")
    return DriveRecording(path, tuple(runs), steady)


def _join(data: dict[str, np.ndarray], members: list[int], begin: int, step: int) -> DriveRun:
    """Join consecutive windows, which each start at the origin, into one run."""
    positions, rotations = [], []
    origin, turn = np.zeros(3), Rotation.identity()
    for k in members:
        window = np.stack([data[name][k] for name in ("icp_x", "icp_y", "icp_z")], axis=1)
        angles = np.stack([data[name][k] for name in ("icp_yaw", "icp_pitch", "icp_roll")], axis=1)
        window_turn = Rotation.from_euler("ZYX", angles)
        # Relative to the first sample, which is not exactly zero due to rounding.
        relative = window_turn[0].inv() * window_turn
        moved = window_turn[0].inv().apply(window - window[0])
        positions.append(origin + turn.apply(moved))
        rotations.append((turn * relative).as_quat())
        # Extrapolate to the start of the next window: one step at the speed of the last half second.
        reach = min(10, len(moved) - 1)
        drift = (relative[-1 - reach].inv() * relative[-1]).as_rotvec() / reach
        ahead = relative[-1].inv().apply(moved[-1] - moved[-1 - reach]) / reach
        origin = positions[-1][-1] + (turn * relative[-1]).apply(ahead)
        turn = turn * relative[-1] * Rotation.from_rotvec(drift)

    def joined(name: str) -> np.ndarray:
        return np.concatenate([data[name][k] for k in members])

    left, right = WHEEL_RADIUS * joined("cmd_left"), WHEEL_RADIUS * joined("cmd_right")
    return DriveRun(
        stamps=begin + step * np.arange(len(left), dtype=np.int64),
        twists=np.stack([(left + right) / 2, (right - left) / TRACK_WIDTH], axis=1),
        wheels=np.stack([joined("left_wheel_vel"), joined("right_wheel_vel")], axis=1),
        positions=np.concatenate(positions),
        quaternions=np.concatenate(rotations),
        gyro=joined("imu_yaw_rate"),
    )


def _window_table(path: Path, names: list[str], rows: Iterator[list[str]]) -> dict[str, np.ndarray]:
    """Windows from a table with one row each and columns ``FIELD_0``, ``FIELD_1``, … as the dataset publishes them."""
    index = {name: number for number, name in enumerate(names)}
    count = sum(name.startswith("cmd_left_") and name[9:].isdigit() for name in names)
    wanted = {
        field: [f"{'imu_yaw' if field == 'imu_yaw_rate' else field}_{number}" for number in range(count)]
        for field in _FIELDS
    } | {mask: [mask] for mask in ("steady_state_mask", "transitory_state_mask")}
    missing = sorted({name for columns in wanted.values() for name in columns} - set(index))
    if missing:
        raise DatasetError(
            f"{path}: got no column {', '.join(missing[:4])}{' …' if len(missing) > 4 else ''}; expected windows of "
            f"DRIVE with {count} samples each"
        )
    table: list[list[float]] = []
    read = 0
    columns = [index[name] for names in wanted.values() for name in names]
    for number, row in enumerate(rows, start=2):
        read += sum(map(len, row)) + len(row)
        if read > LARGEST_FILE:
            raise DatasetError(f"{path}: more than {LARGEST_FILE} bytes of text")
        if len(row) <= max(columns):
            raise DatasetError(f"{path}, line {number}: got {len(row)} columns, expected {len(index)}")
        # Masks are written as 1.0 or True.
        cells = [row[column] for column in columns]
        table.append([_TRUTH[cell] if cell in _TRUTH else float(cell or "nan") for cell in cells])
    values = np.array(table).reshape(len(table), len(columns))
    edges = np.cumsum([len(names) for names in wanted.values()])[:-1]
    data = dict(zip(wanted, np.split(values, edges, axis=1), strict=True))
    for mask in ("steady_state_mask", "transitory_state_mask"):
        data[mask] = data[mask][:, 0]
    return data | {"dt": np.array(WINDOW_LENGTH / count)}


def _open_log(path: Path) -> DriveRecording:
    unpack = gzip.open if path.suffix == ".gz" else open
    rows: list[list[float]] = []
    stamps: list[int] = []
    read = 0
    try:
        with unpack(path, "rt", encoding="utf-8", newline="") as stream:
            reader = csv.reader(stream)
            names = next(reader, [])
            if "cmd_left_0" in names:
                return _runs_of_windows(path, _window_table(path, names, reader))
            missing = sorted(set(_COLUMNS) - set(names))
            if missing:
                raise DatasetError(f"{path}: got no column {', '.join(missing)}; expected a continuous log of DRIVE")
            columns = [names.index(name) for name in _COLUMNS]
            # Later logs of the dataset have currents, too.
            columns += [names.index(name) for name in _CURRENTS] if set(_CURRENTS) <= set(names) else []
            for number, row in enumerate(reader, start=2):
                read += sum(map(len, row)) + len(row)
                if read > LARGEST_FILE:
                    raise DatasetError(f"{path}: more than {LARGEST_FILE} bytes of text")
                if len(row) <= max(columns):
                    raise DatasetError(f"{path}, line {number}: got {len(row)} columns, expected {len(names)}")
                # A double cannot represent current stamps in nanoseconds.
                stamps.append(int(row[columns[0]]))
                rows.append([float(row[column] or "nan") for column in columns[1:]])
    except (OSError, EOFError, UnicodeDecodeError, csv.Error, ValueError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path}: not readable: {error}") from error
    if len(rows) < 20:
        raise DatasetError(f"{path}: got {len(rows)} rows, expected at least 20")
    values, times = np.array(rows), np.array(stamps, np.int64)
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    norms = np.linalg.norm(values[:, 7:11], axis=1)
    keep = np.r_[True, np.diff(times) > 0] & np.isfinite(values[:, :12]).all(axis=1) & (np.abs(norms - 1.0) < 0.01)
    times, values = times[keep], values[keep]
    runs = []
    for part in np.split(np.arange(len(times)), np.flatnonzero(np.diff(times) > 1_000_000_000) + 1):
        if len(part) >= 20:
            row = values[part]
            currents = row[:, 12:] if row.shape[1] > 12 else None
            runs.append(
                DriveRun(times[part], row[:, 2:4], row[:, 0:2], row[:, 4:7], row[:, 7:11], row[:, 11], currents)
            )
    if not runs:
        raise DatasetError(f"{path}: no 20 consecutive samples without a gap")
    return DriveRecording(path, tuple(runs))
