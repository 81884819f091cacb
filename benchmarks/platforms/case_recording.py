"""Case recording: platforms and their drives as bags, robot files, maps and truth files in a folder."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmark_case import DURATION, Case
from drawn_platform import Platform, draw_platform, write_robot_file
from drive_commands import FollowingDriver, LeadingDriver, ManoeuvreDriver, ReplayedCommands
from drive_session import DriveJob, Trace
from ground_shape import Ground, draw_hills, write_map
from hidden_effect import HiddenEffect, draw_effect
from injection import TICK, Measurement
from sensor_recording import measured_poses, write_bag

from monoforce_ros.core import write_text

SMALLEST_EFFECT = 0.1
"""Smallest displacement that a hidden effect must cause in ``EFFECT_TIME``, median over the drive [m]."""
EFFECT_TIME = 5.0
"""[s]."""
COMPARED = 30.0
"""Length of the drive over which displacements are compared, unless an effect begins later [s]."""
MOST_DRAWS = 8
"""Of the strength of an effect, and of a drive to commission a platform. A platform on which no strength matters does
not get this case."""
CHECK_DURATION = 30.0
"""Of a second drive with the same effect, on which only the improvement is checked [s]."""


@dataclass(frozen=True)
class CaseFiles:
    """Files of a case in the folder of its platform."""

    folder: Path
    name: str

    @classmethod
    def of(cls, case: Case, work: Path) -> CaseFiles:
        """Files of a case below the benchmark's folder."""
        return cls(work / "recordings" / case.set_name / case.platform_name, f"{case.number:02d}-{case.kind}")

    @property
    def robot(self) -> Path:
        """The robot file as a user writes it."""
        return self.folder / "platform.yaml"

    @property
    def commissioning(self) -> Path:
        """Bag of the healthy robot."""
        return self.folder / "commissioning"

    @property
    def bag(self) -> Path:
        """The drive."""
        return self.folder / self.name

    @property
    def check(self) -> Path:
        """A second drive with the same effect."""
        return self.folder / f"{self.name}-check"

    @property
    def truth(self) -> Path:
        """What is hidden; written last."""
        return self.folder / f"{self.name}.truth.json"

    def terrain(self, bag: Path) -> Path:
        """Map of the ground of a bag, over hills."""
        return bag.with_name(f"{bag.name.removesuffix('-check')}.terrain.npz")


def record_platform(cases: Sequence[Case], work: Path) -> None:
    """Record the commissioning and the cases of one platform with MuJoCo, unless their truth files exist."""
    import mujoco_engine

    files = [CaseFiles.of(case, work) for case in cases]
    if all(entry.truth.exists() for entry in files):
        return
    platform = draw_platform(cases[0].platform_seed)
    write_robot_file(platform, files[0].robot)
    if not files[0].commissioning.exists():
        _record_commissioning(platform, cases[0], files[0], mujoco_engine.simulate)
    for case, entry in zip(cases, files, strict=True):
        if not entry.truth.exists():
            _record_case(platform, case, entry, mujoco_engine.simulate)


@dataclass
class _Attempt:
    """A case of one attempt among the jobs of a batch: the indices of its drives."""

    case: Case
    hidden: tuple[HiddenEffect, ...]
    drive: int
    without: list[tuple[int, float]]
    """Drives without one of the effects, with the onset of that effect [s]."""
    check: int | None


def record_together(
    platforms: Sequence[Sequence[Case]],
    work: Path,
    simulate_together: Callable[[Sequence[DriveJob]], list[Trace]],
) -> None:
    """Record platforms with an engine that simulates many drives at once, unless their truth files exist.

    A drive and those without one of its effects are simulated side by side under the same commands. Cases whose effect
    does not matter are drawn again in the next batch.

    Args:
        platforms: the cases of each platform.
        work: folder of the benchmark.
        simulate_together: the engine.
    """
    todo = [case for cases in platforms for case in cases if not CaseFiles.of(case, work).truth.exists()]
    for cases in platforms:
        write_robot_file(draw_platform(cases[0].platform_seed), CaseFiles.of(cases[0], work).robot)
    for attempt in range(MOST_DRAWS):
        jobs: list[DriveJob] = []
        healthy: list[tuple[int, Case]] = []
        for cases in platforms:
            if not CaseFiles.of(cases[0], work).commissioning.exists():
                healthy.append((len(jobs), cases[0]))
                jobs.append(commissioning_job(draw_platform(cases[0].platform_seed), cases[0], attempt))
        attempts = [_add_attempt(jobs, case, attempt) for case in todo]
        if not jobs:
            return
        traces = simulate_together(jobs)
        for index, case in healthy:
            _write_commissioning(case, CaseFiles.of(case, work), jobs[index], traces[index], attempt)
        todo = [entry.case for entry in attempts if not _keep(entry, jobs, traces, work, attempt)]


def _add_attempt(jobs: list[DriveJob], case: Case, attempt: int) -> _Attempt:
    """Add the drives of one attempt of a case to the jobs."""
    platform = draw_platform(case.platform_seed)
    hidden = draw_hidden(case, platform, attempt)
    job = hidden_job(platform, case, hidden)
    leader = LeadingDriver(job.driver)
    entry = _Attempt(case, hidden, len(jobs), [], None)
    jobs.append(dataclasses.replace(job, driver=leader))
    for index, effect in enumerate(hidden):
        if effect.kind.moves:
            others = [other for number, other in enumerate(hidden) if number != index]
            duration = DURATION if case.late else COMPARED
            follower = FollowingDriver(leader)
            entry.without.append((len(jobs), effect.onset))
            jobs.append(dataclasses.replace(hidden_job(platform, case, others), driver=follower, duration=duration))
    if hidden:
        entry.check = len(jobs)
        jobs.append(hidden_job(platform, case, hidden, check=True))
    return entry


def _keep(entry: _Attempt, jobs: Sequence[DriveJob], traces: Sequence[Trace], work: Path, attempt: int) -> bool:
    """Write an attempt if its effects matter, or give it up if it was the last; whether the case is done."""
    files, job, trace = CaseFiles.of(entry.case, work), jobs[entry.drive], traces[entry.drive]
    displacements = [displacement(job, trace, jobs[index], traces[index], onset) for index, onset in entry.without]
    check = entry.check
    usable = trace.mishap is None and all(value >= SMALLEST_EFFECT for value in displacements)
    usable = usable and (check is None or traces[check].mishap is None)
    if not usable and attempt + 1 < MOST_DRAWS:
        return False
    if usable:
        write_case(entry.case, files, entry.hidden, job, trace)
        if check is not None:
            seed = entry.case.seed * 10 + 1
            _write(traces[check], jobs[check], combined_measurement(jobs[check]), seed, files, files.check)
    write_truth(entry.case, files, entry.hidden, displacements, attempt + 1, usable=usable)
    return True


def _driver(platform: Platform, seed: int) -> ManoeuvreDriver:
    return ManoeuvreDriver(platform.maximum_speed, platform.maximum_yaw_rate, seed)


def _ground(case: Case, seed: int, platform: Platform) -> Ground:
    return draw_hills(seed, platform.friction) if case.ground == "hills" else Ground()


def commissioning_job(platform: Platform, case: Case, attempt: int = 0) -> DriveJob:
    """The healthy drive of 60 to 120 s from which a platform is commissioned; the seed is the platform's own.

    Another attempt has another ground and other commands: a platform that tips over is not commissioned on that drive.
    """
    # Cases have the seeds that follow the platform's own; the last ones of its hundred are free.
    seed = platform.seed * 100 + (100 - attempt if attempt else 0)
    duration = float(np.random.default_rng([seed, 10]).uniform(60.0, 120.0))
    return DriveJob(platform, _ground(case, seed, platform), _driver(platform, seed), (), round(duration, 1))


def _record_commissioning(platform: Platform, case: Case, files: CaseFiles, simulate) -> None:
    for attempt in range(MOST_DRAWS):
        job = commissioning_job(platform, case, attempt)
        if _write_commissioning(case, files, job, simulate(job), attempt):
            return


def _write_commissioning(case: Case, files: CaseFiles, job: DriveJob, trace: Trace, attempt: int) -> bool:
    """Write the drive unless it ended too early; ``RuntimeError`` where that was the last attempt."""
    if trace.mishap is not None and len(trace.positions) * TICK < 45.0:
        if attempt + 1 == MOST_DRAWS:
            raise RuntimeError(f"{case.platform_name}: {MOST_DRAWS} commissioning drives ended early: {trace.mishap}")
        return False
    _write(trace, job, Measurement(), job.platform.seed * 100, files, files.commissioning)
    return True


def _write(trace: Trace, job: DriveJob, measurement: Measurement, seed: int, files: CaseFiles, bag: Path) -> None:
    if job.ground.heights is not None and not files.terrain(bag).exists():
        write_map(job.ground, trace.positions[0], seed, files.terrain(bag))
    if not bag.exists():
        write_bag(trace, job.platform, measurement, seed, bag)


def draw_hidden(case: Case, platform: Platform, attempt: int) -> tuple[HiddenEffect, ...]:
    """The effects of a case, with the strengths of one attempt."""
    random = np.random.default_rng([case.seed, 11, attempt])
    onset = float(random.uniform(20.0, 40.0)) if case.late else 0.0
    return tuple(draw_effect(name, random, platform, onset) for name in case.effects)


def hidden_job(platform: Platform, case: Case, hidden: Sequence[HiddenEffect], *, check: bool = False) -> DriveJob:
    """The drive of a case, or its second one."""
    seed = case.seed * 10 + int(check)
    injections = tuple(effect.injection(platform) for effect in hidden)
    ground = _ground(case, case.seed, platform)
    return DriveJob(platform, ground, _driver(platform, seed), injections, CHECK_DURATION if check else DURATION)


def combined_measurement(job: DriveJob) -> Measurement:
    """The hidden errors of stamps and sensors of a drive; each field is that of the one injection that sets it."""
    fields = {}
    for injection in job.injections:
        for field in dataclasses.fields(Measurement):
            value = getattr(injection.measurement, field.name)
            if value != field.default:
                fields[field.name] = value
    return Measurement(**fields)


def _record_case(platform: Platform, case: Case, files: CaseFiles, simulate) -> None:
    for attempt in range(MOST_DRAWS):
        hidden = draw_hidden(case, platform, attempt)
        job = hidden_job(platform, case, hidden)
        trace = simulate(job)
        displacements: list[float] = []
        if trace.mishap is not None:
            continue
        for index, effect in enumerate(hidden):
            if not effect.kind.moves:
                continue
            # Both of a pair must matter: each is taken away in turn.
            others = [other for number, other in enumerate(hidden) if number != index]
            without = dataclasses.replace(
                hidden_job(platform, case, others),
                driver=ReplayedCommands(trace.commands),
                duration=DURATION if case.late else COMPARED,
            )
            displacements.append(displacement(job, trace, without, simulate(without), effect.onset))
        if all(value >= SMALLEST_EFFECT for value in displacements):
            break
    else:
        write_truth(case, files, hidden, displacements, MOST_DRAWS, usable=False)
        return
    write_case(case, files, hidden, job, trace)
    if hidden:
        second = hidden_job(platform, case, hidden, check=True)
        _write(simulate(second), second, combined_measurement(second), case.seed * 10 + 1, files, files.check)
    write_truth(case, files, hidden, displacements, attempt + 1, usable=True)


def write_case(case: Case, files: CaseFiles, hidden: Sequence[HiddenEffect], job: DriveJob, trace: Trace) -> None:
    """Write the bag of a case, and its map."""
    _write(trace, job, combined_measurement(job), case.seed * 10, files, files.bag)


def write_truth(
    case: Case,
    files: CaseFiles,
    hidden: Sequence[HiddenEffect],
    displacements: Sequence[float],
    draws: int,
    *,
    usable: bool,
) -> None:
    """Write what is hidden in a case; the file marks the case as recorded."""
    platform = draw_platform(case.platform_seed)
    content = {
        "case": case.name,
        "kind": case.kind,
        "engine": case.engine,
        "ground": case.ground,
        "usable": usable,
        "hidden": [
            {
                "name": effect.name,
                "values": dict(effect.values),
                "onset_s": effect.onset,
                "names": list(effect.kind.names),
                "estimated": list(effect.kind.estimated),
            }
            for effect in hidden
        ],
        "displacement_m": [round(value, 4) for value in displacements],
        "draws": draws,
        "sensors": {"wheels": platform.wheels is not None, "gyro": platform.gyro is not None},
        "platform": dataclasses.asdict(platform),
    }
    write_text(files.truth, json.dumps(content, indent=1) + "\n")


def displacement(job: DriveJob, trace: Trace, other_job: DriveJob, other: Trace, onset: float = 0.0) -> float:
    """Median displacement between two drives with the same commands, after ``EFFECT_TIME`` from the same pose [m].

    Both drives are taken as their sensors show them, without noise. Time shifts of poses and commands count.
    """
    count = round(EFFECT_TIME / TICK)
    tracks = []
    for one, drive in ((job, trace), (other_job, other)):
        measurement = combined_measurement(one)
        positions, rotations = measured_poses(drive.positions - drive.positions[0], drive.rotations, measurement)
        late = round((measurement.pose_offset - measurement.command_offset) / TICK)
        index = np.clip(np.arange(len(positions)) - late, 0, len(positions) - 1)
        tracks.append((positions[index], rotations[index]))
    length = min(len(track[0]) for track in tracks)
    starts = np.arange(round(onset / TICK), length - count, round(0.5 / TICK))
    if not len(starts):
        return 0.0
    moves = [
        rotations[starts].inv().apply(positions[starts + count] - positions[starts])[:, :2]
        for positions, rotations in tracks
    ]
    return float(np.median(np.linalg.norm(moves[0] - moves[1], axis=1)))
