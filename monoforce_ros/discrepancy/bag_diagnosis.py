"""Bag diagnosis: a recorded drive, from the bag to the report and the robot's new file."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from monoforce_ros.bags import Recording, smooth
from monoforce_ros.discrepancy.comparison import compare, gap_table
from monoforce_ros.discrepancy.diagnosis import Diagnosis, Settings, diagnose
from monoforce_ros.discrepancy.gap import noisy_motions
from monoforce_ros.discrepancy.hypothesis import Effects, Evidence, corrected_evidence, window_starts
from monoforce_ros.discrepancy.report import write_diagnosis
from monoforce_ros.robots import RobotModel, fingerprint, load_robot, read_nominal_residual, write_robot
from monoforce_ros.terrain import Grid, load_terrain
from monoforce_ros.training import split_maps

_MARGIN = 4.0


@dataclass(frozen=True)
class Topics:
    """Names of topics; those that are None are found by type."""

    odometry: str | None = None
    commands: str | None = None
    cloud: str | None = None


@dataclass(frozen=True)
class BagDiagnosis:
    """What came of a bag."""

    bag: Path
    diagnosis: Diagnosis
    report: Path
    """``report.json``."""
    page: Path
    robot_file: Path | None
    """A copy of the robot's file that holds what was found, where something was."""
    complaints: tuple[str, ...] = ()
    """What was wrong with the bag."""

    def without_arrays(self) -> BagDiagnosis:
        """The same without the arrays of its pictures, which are drawn."""
        return replace(self, diagnosis=replace(self.diagnosis, details={}))


def read_drive(bag: Path, robot: RobotModel, terrain: str, topics: Topics = Topics()) -> tuple[Evidence, Recording]:
    """A bag's smoothed motion, commands and ground.

    Args:
        bag: the recording.
        robot: whose own body is taken out of the lidar's sweeps.
        terrain: ``flat``, ``lidar`` (all sweeps of the drive as one map) or a file of ``fit_terrain``.
        topics: where they are not to be found by type.

    Raises:
        BagError, TerrainError, TerrainFileError: what is needed is not there, or damaged.
    """
    recording = Recording.open(bag, odometry=topics.odometry, commands=topics.commands, cloud=topics.cloud)
    smoothed = smooth(recording.motion)
    drive = Evidence(smoothed, recording.commands, turning=recording.angular_velocity, wheels=recording.wheels)
    if terrain == "flat":
        return drive, recording
    if terrain != "lidar":
        ground, pose = load_terrain(Path(terrain))
        return replace(drive, terrain=ground, odometry_from_terrain=pose), recording
    motion = smoothed.motion
    low, high = motion.positions.min(axis=0)[:2] - _MARGIN, motion.positions.max(axis=0)[:2] + _MARGIN
    columns, rows = np.ceil((high - low) / 0.1).astype(int) + 1
    grid = Grid(int(rows), int(columns), 0.1, (float(low[0]), float(low[1])))
    ground, halves = split_maps(recording, motion, robot, grid)
    return replace(drive, terrain=ground, odometry_from_terrain=np.eye(4), halves=halves), recording


def diagnose_bag(
    bag: Path,
    robot: str | Path,
    out: Path,
    *,
    terrain: str = "flat",
    topics: Topics = Topics(),
    settings: Settings = Settings(),  # noqa: B008
    held_out: Sequence[Path] = (),
    progress: Callable[[float, str], None] = lambda share, what: None,
) -> BagDiagnosis:
    """Diagnose a bag and write ``report.json``, ``report.html`` and, where something was found, the robot's new file.

    Args:
        bag: the recording.
        robot: name or file of the nominal robot; a commissioned file brings what disagreed on the healthy robot.
        out: folder of the reports.
        terrain: see :func:`read_drive`.
        topics: where they are not to be found by type.
        settings: of the diagnosis.
        held_out: further bags on which before and after are compared; nothing is fitted to them.
        progress: called with the share of the work done and what comes next.
    """
    began = time.monotonic()
    model = load_robot(robot)
    progress(0.0, "reading")
    drive, recording = read_drive(bag, model, terrain, topics)
    diagnosis = diagnose(
        drive,
        model,
        nominal_residual=read_nominal_residual(robot, settings.samples),
        settings=settings,
        progress=progress,
    )
    data = fingerprint([bag])
    robot_file = None
    if diagnosis.effects:
        robot_file = write_robot(robot, out / f"{model.name}.yaml", diagnosis.effects, [bag], data)
    if held_out:
        progress(0.97, "held-out bags")
        tables = {other.name: _held_out(other, model, diagnosis.fitted, terrain, topics) for other in held_out}
        diagnosis = replace(diagnosis, held_out=tables)
    inputs = {
        "bag": str(bag),
        "data": data,
        "robot": str(robot),
        "terrain": terrain,
        "topics": ", ".join(f"{role} {topic}" for role, topic in recording.topics.items()),
        "noise of the poses": f"{100 * drive.smoothed.position_noise:.1f} cm, "
        f"{np.degrees(drive.smoothed.rotation_noise):.2f}°",
        "duration_s": round(time.monotonic() - began, 1),
    }
    report, page = write_diagnosis(out, diagnosis, inputs, robot_file)
    return BagDiagnosis(bag, diagnosis, report, page, robot_file, recording.warnings)


def _held_out(bag: Path, robot: RobotModel, effects: Effects, terrain: str, topics: Topics) -> dict[str, dict]:
    """Errors before and after on a drive that no fit saw."""
    drive, _ = read_drive(bag, robot, terrain, topics)
    drive = corrected_evidence(drive, robot.effects)
    starts = window_starts(drive.smoothed.motion, drive.smoothed.stretches, 2.0, 1.0)
    if not len(starts):
        raise ValueError(f"{bag}: no windows of 2 s without a gap: it cannot show what was gained")
    data = drive.cut(starts, np.array([2.0]))
    parts = [effects, effects] if effects else None
    return gap_table(compare(robot, data, drive.smoothed, parts, noisy_motions(drive.smoothed), within_blocks=False))
