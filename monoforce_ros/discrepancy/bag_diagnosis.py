"""Bag diagnosis: from a bag to the report and the copy of the robot's file with the identified effects."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from monoforce_ros.bags import DETECTED, BagError, ReadOptions, Recording, smooth
from monoforce_ros.discrepancy.command_changes import uncovered_doubt
from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.diagnosis import Diagnosis, DiagnosisSettings, diagnose
from monoforce_ros.discrepancy.encoder_ground import encoder_maps
from monoforce_ros.discrepancy.evidence import COMPONENTS, MOTION, Evidence
from monoforce_ros.discrepancy.ground import Ground, beyond_commissioning, choose_ground
from monoforce_ros.discrepancy.held_out_bags import HeldOutBag, named_bags, refuse_unusable
from monoforce_ros.discrepancy.interruption import uninterrupted
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.discrepancy.nominal_residual import residual_complaint
from monoforce_ros.discrepancy.partial_effects import effects_for_file, file_entry, with_advice
from monoforce_ros.discrepancy.report import write_diagnosis
from monoforce_ros.discrepancy.separate_stretches import laid_apart
from monoforce_ros.discrepancy.step_errors import compare_after_steps
from monoforce_ros.discrepancy.terrain_evidence import supporting_terrain, traced_terrain
from monoforce_ros.discrepancy.verdict import Decision, Verdict
from monoforce_ros.discrepancy.wheel_units import contradictions, in_rad_per_second, wheel_unit
from monoforce_ros.discrepancy.wheels import compare_with_wheels
from monoforce_ros.discrepancy.wording import finding
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.encoder import CheckpointError
from monoforce_ros.robots import RobotModel, fingerprint, load_robot, write_robot
from monoforce_ros.robots import robot_file as robot_file_of
from monoforce_ros.terrain import Grid, TerrainError, TerrainFileError, load_terrain
from monoforce_ros.training import split_maps

_MARGIN = 4.0
"""Of a lidar map around the driven path [m]."""


def usable_folder(out: Path) -> None:
    """Make a folder, or raise ``ValueError``: before the work, for its results would be lost after it."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{out}: --out cannot be made a folder: {error}") from error
    if not os.access(out, os.W_OK):
        raise ValueError(f"{out}: --out cannot be written to, expected a folder with write permission")


@dataclass(frozen=True)
class BagDiagnosis:
    """The diagnosis of a bag and the files written for it."""

    bag: Path
    diagnosis: Diagnosis
    report: Path
    """``report.json``."""
    page: Path
    robot_file: Path | None
    """A copy of the robot's file with the identified effects; None where there are none."""
    complaints: tuple[str, ...] = ()
    """Problems found when reading the bag."""
    doubts: tuple[str, ...] = ()
    """Reasons to doubt the result that lie in the recording or in the robot's file, such as ground without a map."""
    ground: Ground | None = None
    """The terrain that the recording was compared on."""

    def without_arrays(self) -> BagDiagnosis:
        """The same without the arrays for figures, to pass it between processes."""
        return replace(self, diagnosis=replace(self.diagnosis, details=None))


def read_evidence(
    bag: Path, robot: RobotModel, terrain: str, reading: ReadOptions = DETECTED
) -> tuple[Evidence, Recording]:
    """A bag's smoothed motion, commands and ground.

    Args:
        bag: the recording.
        robot: its own body is removed from the lidar's sweeps.
        terrain: ``auto`` (see :func:`choose_ground`), ``flat``, ``lidar`` (all sweeps of the recording as one map),
            ``traced`` (by the wheels along the poses), ``camera`` or ``lidar_camera`` (by the terrain encoder along the
            drive; ``camera:FILE`` with other weights) or a file of ``fit_terrain``.
        reading: topics and frames that replace those that the bag says.

    Raises:
        BagError, TerrainError, TerrainFileError: required data are missing or damaged.
    """
    evidence, recording, _ = read_with_ground(bag, robot, terrain, reading)
    return evidence, recording


def read_with_ground(
    bag: Path, robot: RobotModel, terrain: str, reading: ReadOptions = DETECTED, known_unit: float = 1.0
) -> tuple[Evidence, Recording, Ground]:
    """As :func:`read_evidence`, and which ground was taken; ``known_unit``: see :func:`wheel_unit`."""
    recording = reading.open(bag, robot)
    robot = reading.robot_in_bag(robot)
    smoothed = smooth(recording.motion)
    unit = wheel_unit(smoothed.motion, recording.wheels, recording.commands, robot, known_unit)
    if unit.text and recording.wheels is not None:
        wheels = replace(recording.wheels, speeds=recording.wheels.speeds / unit.factor)
        recording = replace(recording, wheels=wheels, warnings=(unit.text, *recording.warnings))
    evidence = Evidence(
        smoothed, recording.commands, gyro=recording.angular_velocity, wheels=recording.wheels,
        wheel_unit=unit.factor, efforts=recording.efforts, joints=recording.joints,
    )  # fmt: skip
    ground = choose_ground(terrain, recording, smoothed, robot)
    if ground.source == "flat":
        return replace(evidence, components=MOTION if ground.unknown else COMPONENTS), recording, ground
    if ground.source not in ("lidar", "traced") and ground.encoder is None:
        terrain_map, pose = load_terrain(Path(ground.source))
        evidence = replace(evidence, terrain=terrain_map, odometry_from_terrain=pose, components=COMPONENTS)
        return evidence, recording, ground
    if ground.apart:
        smoothed = laid_apart(smoothed, _MARGIN)
        evidence = replace(evidence, smoothed=smoothed)
    motion = smoothed.motion
    low, high = motion.positions.min(axis=0)[:2] - _MARGIN, motion.positions.max(axis=0)[:2] + _MARGIN
    columns, rows = np.ceil((high - low) / 0.1).astype(int) + 1
    try:
        grid = Grid(int(rows), int(columns), 0.1, (float(low[0]), float(low[1])))
    except ValueError as error:
        raise BagError(
            f"{bag}: the poses reach over {high[0] - low[0]:.0f} × {high[1] - low[1]:.0f} m, more than one map holds: "
            "are the odometry's positions in metres, and without jumps? Otherwise cut the recording, or use --terrain "
            f"flat ({error})"
        ) from error
    if ground.source == "traced":
        terrain_map = traced_terrain(motion, robot, grid)
        return replace(evidence, terrain=terrain_map, odometry_from_terrain=np.eye(4)), recording, ground
    if ground.encoder is None:
        maps, parts = split_maps(recording, motion, robot, grid)
    else:
        maps, parts, count = encoder_maps(recording, motion, robot, grid, ground.encoder)
        ground = replace(ground, description=f"{ground.description}: {count} predictions along the drive")
    whole, even, odd = (supporting_terrain(part, motion, robot) for part in (maps, *parts))
    evidence = replace(evidence, terrain=whole, odometry_from_terrain=np.eye(4), split_maps=(even, odd))
    evidence = replace(evidence, components=COMPONENTS)
    return evidence, recording, ground


def diagnose_bag(
    bag: Path,
    robot: str | Path,
    out: Path,
    *,
    terrain: str = "auto",
    reading: ReadOptions = DETECTED,
    settings: DiagnosisSettings = DiagnosisSettings(),  # noqa: B008
    held_out: Sequence[Path] = (),
    local_effects: bool = False,
    progress: Callable[[float, str], None] = lambda share, step: None,
) -> BagDiagnosis:
    """Diagnose a bag; write ``report.json``, ``report.html`` and, if effects were identified, a new robot file.

    Args:
        bag: the recording.
        robot: name or file of the nominal robot; a commissioned file contains the nominal residual RMS.
        out: folder of the reports.
        terrain: see :func:`read_evidence`.
        reading: topics and frames that replace those that the bag says.
        settings: settings of the diagnosis.
        held_out: further recordings on which errors before and after are compared; nothing is fitted to them.
        local_effects: whether the robot file also gets effects that act on a part of the ground only, with which
            predictions on all other ground get worse.
        progress: called with the share of the work done and the next step.

    Raises:
        BagError, TerrainError, TerrainFileError: required data are missing or damaged.
        ValueError: a held-out recording is the diagnosed one, missing or too short, or ``out`` holds the nominal file.
    """
    began = time.monotonic()
    model = load_robot(robot)
    found_file = out / f"{model.name}.yaml"
    if found_file.exists() and found_file.resolve() == robot_file_of(robot).resolve():
        raise ValueError(f"{out}: got the folder of the nominal robot file {found_file.name}, expected another --out")
    commissioned = found_file.exists() and NominalModel.read(str(found_file), settings.samples) is not None
    if commissioned and not _written_by_diagnosis(found_file):
        # It would be replaced by what was found, and the commissioning be lost.
        raise ValueError(f"{out}: got the folder of the commissioned file {found_file.name}, expected another --out")
    progress(0.0, "reading")
    nominal = NominalModel.read(robot, settings.samples)
    if nominal is not None and nominal.wheels is not None:
        nominal = replace(nominal, wheels=in_rad_per_second(nominal.wheels, model.wheel_radius))
    unit = 1.0 if nominal is None or nominal.wheels is None else nominal.wheels.unit
    evidence, recording, ground = read_with_ground(bag, model, terrain, reading, unit)
    data = fingerprint([bag])
    named = named_bags(held_out)
    refuse_unusable(named, bag, data)
    usable_folder(out)
    others = {name: _held_out(path, model, nominal, terrain, reading) for name, path in named.items()}
    steeper = beyond_commissioning(ground.slope, None if nominal is None else nominal.slope)
    # A robot that was commissioned on such slopes is known there, without a map, too.
    known = nominal is not None and nominal.slope is not None and not steeper
    unexplained, by_name = ground.unexplained or steeper, ground.uneven and not known

    def ground_explains(decision: Decision) -> bool:
        names = () if decision.trial is None else decision.trial.names
        return bool(unexplained) and may_be_the_ground(decision.verdict, names, named=by_name)

    diagnosis = diagnose(
        evidence,
        model,
        nominal=nominal,
        settings=settings,
        ground_explains=ground_explains,
        progress=progress,
    )
    rest: tuple[str, ...] = ()
    if diagnosis.set_aside is not None and diagnosis.verdict == Verdict.EFFECT_FOUND:
        rest = without_blame_for_ground(diagnosis, unexplained, named=by_name).advice
    else:
        diagnosis = without_blame_for_ground(diagnosis, unexplained, named=by_name)
    large = residual_complaint(None if nominal is None else nominal.residual, evidence.smoothed, evidence.commands)
    # Named effects stay, with this doubt.
    steeper = steeper if diagnosis.effects else ""
    harder = "" if nominal is None else uncovered_doubt(evidence, settings.horizon, nominal.changes)
    ratio = None if nominal is None or nominal.wheels is None else nominal.wheels.ratio
    wrong, remarks = contradictions(evidence.smoothed.motion, evidence.wheels, evidence.commands, model, ratio)
    diagnosis = replace(diagnosis, remarks=(*diagnosis.remarks, *remarks))
    doubts = list(dict.fromkeys(text for text in (*wrong, ground.complaint, *rest, steeper, harder, large) if text))
    if diagnosis.verdict == Verdict.NOT_IDENTIFIABLE:
        diagnosis = _with_wheels(diagnosis, evidence, model)
    for_file = effects_for_file(diagnosis, local=local_effects)
    # On ground that no map shows slopes pass for effects: of that only what sensors measured belongs into a robot file.
    credible = bool(for_file) and (bool(rest) or not ground.unknown) and not any(map(complaint, for_file))
    diagnosis = with_advice(diagnosis, local=local_effects, written=credible)
    elsewhere = len(for_file) < len(diagnosis.effects)
    in_file = {effect.name for effect in for_file}
    fitted = tuple(entry for entry in diagnosis.fitted if entry[0] in in_file)
    if diagnosis.verdict != Verdict.NOT_IDENTIFIABLE:
        progress(0.96, "comparing with a kinematic fit")
        parts = None if diagnosis.by_part is None or elsewhere else diagnosis.by_part.beside(diagnosis.shift)
        after_steps = compare_after_steps(evidence, model, (*fitted, *diagnosis.shift), parts)
        diagnosis = replace(diagnosis, steps=after_steps)
    if others and elsewhere:
        remark = "held-out recordings are not compared: where on them the ground is like that is not known"
        diagnosis = replace(diagnosis, remarks=(*diagnosis.remarks, remark))
    elif others:
        progress(0.97, "held-out recordings")
        tables = {}
        for name, other in others.items():
            try:
                tables[name] = other.table(fitted)
            except (ValueError, ArithmeticError, RuntimeError, MemoryError) as error:
                # The diagnosis took minutes and does not depend on it.
                remark = f"the held-out recording {name} could not be compared: {error}"
                diagnosis = replace(diagnosis, remarks=(*diagnosis.remarks, remark))
        diagnosis = replace(diagnosis, held_out=tables)
    smoothed = evidence.smoothed
    motion = smoothed.motion
    steps = [np.linalg.norm(np.diff(motion.positions[part, :2], axis=0), axis=1).sum() for part in smoothed.stretches]
    inputs = {
        "bag": str(bag),
        "data": data,
        "robot": str(robot),
        "recording_s": round(float(motion.stamps[-1] - motion.stamps[0]) * 1e-9, 1),
        "driven_m": round(float(np.sum(steps)), 1),
        "terrain": terrain,
        "ground": ground.description,
        "ground_unknown": ground.unknown,
        "topics": ", ".join(f"{role} {topic}" for role, topic in recording.topics.items()),
        **({"problems of the bag": "; ".join(recording.warnings)} if recording.warnings else {}),
        "noise of the poses": f"{100 * smoothed.position_noise:.1f} cm, {np.degrees(smoothed.rotation_noise):.2f}°",
        "duration_s": round(time.monotonic() - began, 1),
    }
    # Files last: what ends the work before leaves none of it, and those of an earlier run together.
    robot_file = None
    # Together, or a robot file of this diagnosis would lie beside the report of an earlier one.
    with uninterrupted():
        if credible:
            effects = [file_entry(diagnosis, effect) for effect in for_file]
            robot_file = write_robot(robot, found_file, effects, [bag], data)
        elif found_file.exists():
            # Rename the robot file of an earlier diagnosis, which would be mistaken for a result of this one.
            found_file.replace(found_file.with_suffix(".earlier.yaml"))
        report, page = write_diagnosis(out, diagnosis, inputs, robot_file, doubts, in_file)
    return BagDiagnosis(bag, diagnosis, report, page, robot_file, recording.warnings, tuple(doubts), ground)


def _written_by_diagnosis(found_file: Path) -> bool:
    """Whether the report beside a robot file says that its diagnosis wrote the file: the same may replace it.

    Not where the file is newer than the report: then commissioning replaced it.
    """
    report = found_file.parent / "report.json"
    try:
        written = json.loads(report.read_text(encoding="utf-8")).get("robot_file")
        newer = found_file.stat().st_mtime_ns > report.stat().st_mtime_ns
    except (OSError, ValueError, AttributeError):
        return False
    return not newer and isinstance(written, str) and Path(written).name == found_file.name


def _held_out(
    bag: Path, robot: RobotModel, nominal: NominalModel | None, terrain: str, reading: ReadOptions
) -> HeldOutBag:
    """A held-out recording, read and checked before the work of a diagnosis, which an error would lose after it."""
    unit = 1.0 if nominal is None or nominal.wheels is None else nominal.wheels.unit
    try:
        return HeldOutBag.of(read_with_ground(bag, robot, terrain, reading, unit)[0], robot, nominal)
    except (BagError, CheckpointError, TerrainError, TerrainFileError, ValueError, OSError) as error:
        raise ValueError(f"{bag}: --held-out got a recording that cannot be compared: {error}") from error


def may_be_the_ground(verdict: Verdict, names: Sequence[str], *, named: bool) -> bool:
    """Whether slopes that no map shows may be the cause of what was found.

    Args:
        verdict: an error without a name may be theirs.
        names: of effects that were found; slopes neither delay a command nor turn a sensor.
        named: whether forces that slopes exert may pass for effects, too.
    """
    return verdict == Verdict.UNKNOWN_EFFECT or (named and any(_is_force(name) for name in names))


def _is_force(name: str) -> bool:
    effect = CATALOGUE[name]
    return effect.stage in ("contact", "body") and effect.like_a_slope


def without_blame_for_ground(diagnosis: Diagnosis, unexplained: str, *, named: bool) -> Diagnosis:
    """The diagnosis; ``not_identifiable`` where the error may be the ground's.

    Args:
        diagnosis: of a recording.
        unexplained: why an error without a name may be the ground's; empty if it is not.
        named: see :func:`may_be_the_ground`.
    """
    aside = diagnosis.set_aside
    names = [effect.name for effect in diagnosis.effects]
    if not unexplained or (aside is None and not may_be_the_ground(diagnosis.verdict, names, named=named)):
        return diagnosis
    nameless = (aside or diagnosis.verdict) == Verdict.UNKNOWN_EFFECT
    found = diagnosis.known_parts if nameless or aside is not None else diagnosis.effects
    forces = () if nameless else tuple(effect for effect in found if _is_force(effect.name))
    return Diagnosis(
        Verdict.NOT_IDENTIFIABLE,
        known_parts=found,
        advice=(unexplained, *(f"on known ground this would mean: {finding(effect)}" for effect in forces)),
        noise_floor=diagnosis.noise_floor,
        commissioned=diagnosis.commissioned,
    )


def _with_wheels(diagnosis: Diagnosis, evidence: Evidence, robot: RobotModel) -> Diagnosis:
    """A refused diagnosis with what the wheels say of the drives alone."""
    wheels = compare_with_wheels(evidence.commands, evidence.wheels, robot)
    remarks = diagnosis.remarks if wheels is None else (*diagnosis.remarks, wheels.summary())
    return replace(diagnosis, remarks=remarks)
