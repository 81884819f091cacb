"""Diagnosis run: the package's own commands on the recordings of a case, in processes of their own."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import yaml
from benchmark_case import Case
from case_recording import CaseFiles

from monoforce_ros.bags import BagReader, BagWriter
from monoforce_ros.core import write_text

ABLATIONS = {"wheels": "sensor_msgs/msg/JointState", "imu": "sensor_msgs/msg/Imu"}
"""Message types that an ablation takes out of every recording."""


@dataclass(frozen=True)
class Judged:
    """The code that is judged, and where its results go.

    Attributes:
        code: root of the repository whose package runs.
        results: folder of the results of this code.
        without: of ``ABLATIONS``, or empty.
        timeout: of one command [s].
    """

    code: Path
    results: Path
    without: str
    timeout: float


def code_version(code: Path) -> str:
    """Fingerprint of the package's source files, by which results are kept apart."""
    digest = hashlib.sha256()
    for file in sorted((code / "monoforce_ros").rglob("*.py")):
        digest.update(str(file.relative_to(code)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]


def diagnose_case(case: Case, work: Path, judged: Judged) -> dict | None:
    """The row of a recorded case, from its file where there is one; None where the case cannot be judged."""
    files = CaseFiles.of(case, work)
    truth = json.loads(files.truth.read_text())
    if not _can_be_judged(truth, judged):
        return None
    result = judged.results / "cases" / f"{case.name}.json"
    if result.exists():
        return json.loads(result.read_text())
    nominal = _nominal(case, files, judged)
    row = {key: truth[key] for key in ("case", "kind", "engine", "ground", "hidden", "displacement_m", "sensors")}
    if nominal is None:
        row |= {"verdict": "error", "message": "commissioning failed", "seconds": 0.0, "cpu_seconds": 0.0}
    else:
        out = judged.results / "reports" / case.name
        held_out = ["--held-out", str(_bag(files.check, judged))] if files.check.exists() else []
        arguments = [
            str(_bag(files.bag, judged)),
            "--robot",
            str(nominal),
            *_terrain(case, files, files.bag),
            *held_out,
        ]
        status, message, seconds, cpu = _diagnose([*arguments, "--out", str(out), "--quiet", "--jobs", "1"], judged)
        report = out / "report.json"
        row |= {"seconds": seconds, "cpu_seconds": cpu, "report": str(out / "report.html")}
        if status in (0, 3) and report.exists():  # 3: the recording cannot be diagnosed
            content = json.loads(report.read_text())
            keys = ("verdict", "effects", "gap", "held_out", "numbers", "remarks", "advice")
            row |= {key: content[key] for key in keys if key in content}
        else:
            row |= {"verdict": "error", "message": message}
        row["healthy"] = healthy_values(nominal)
    write_text(result, json.dumps(row, indent=1) + "\n")
    return row


def _can_be_judged(truth: dict, judged: Judged) -> bool:
    """Whether the drive is usable, and its platform has the sensor that an ablation takes away."""
    sensor = {"imu": "gyro"}.get(judged.without, judged.without)
    return truth["usable"] and truth["sensors"].get(sensor, True)


def healthy_values(robot_file: Path) -> dict[str, dict[str, float]]:
    """Effects with their values in a commissioned robot file."""
    effects = yaml.safe_load(robot_file.read_text(encoding="utf-8")).get("effects", [])
    return {
        effect["name"]: {key: float(entry["value"]) for key, entry in effect["parameters"].items()}
        for effect in effects
    }


def commission_platform(case: Case, work: Path, judged: Judged) -> None:
    """Commission the platform of a case, unless it was or its commissioning failed."""
    files = CaseFiles.of(case, work)
    result = judged.results / "cases" / f"{case.name}.json"
    if _can_be_judged(json.loads(files.truth.read_text()), judged) and not result.exists():
        _nominal(case, files, judged)


def _nominal(case: Case, files: CaseFiles, judged: Judged) -> Path | None:
    """The commissioned robot file of a platform by this code, made once; None where commissioning failed."""
    folder = judged.results / "nominal" / case.platform_name
    failure = folder / "failure.txt"
    if commissioned_file(folder) is None and not failure.exists():
        bag = files.commissioning
        arguments = ["--commission", str(_bag(bag, judged)), "--robot", str(files.robot), *_terrain(case, files, bag)]
        # A failure costs all drives of the platform, and the bag is up to twice as long.
        patient = replace(judged, timeout=4 * judged.timeout)
        status, message, seconds, _ = _diagnose([*arguments, "--out", str(folder), "--quiet"], patient)
        if status == 0:
            write_text(folder / "seconds.txt", f"{seconds:.1f}\n")
        else:
            write_text(failure, message)
    return commissioned_file(folder)


def commissioned_file(folder: Path) -> Path | None:
    """The robot file that ``diagnose --commission`` wrote, which bears the robot's name; None without one."""
    return next(iter(sorted(folder.glob("*.yaml"))), None)


def _terrain(case: Case, files: CaseFiles, bag: Path) -> list[str]:
    if case.engine == "worlds":
        return ["--terrain", "lidar"]
    file = files.terrain(bag)
    return ["--terrain", str(file)] if file.exists() else []


def _bag(bag: Path, judged: Judged) -> Path:
    """The bag, or a copy without the ablated sensor."""
    if not judged.without:
        return bag
    copy = bag.parent / f"without-{judged.without}" / bag.name
    if not copy.exists():
        with BagReader(bag) as reader, BagWriter(copy) as writer:
            kept = [topic for topic, kind in reader.topics.items() if kind != ABLATIONS[judged.without]]
            for message in reader.messages(kept):
                writer.write_serialized(message.topic, message.message_type, message.data, message.received)
    return copy


def add_baselines(case: Case, work: Path, judged: Judged) -> dict:
    """The row of a diagnosed case with the median position errors of other methods after 2 s [m]."""
    files, result = CaseFiles.of(case, work), judged.results / "cases" / f"{case.name}.json"
    row = json.loads(result.read_text())
    robot = commissioned_file(judged.results / "nominal" / case.platform_name)
    if "mujoco_sysid" not in row.get("baselines", {}) and robot is not None:
        terrain = (_terrain(case, files, files.bag) or ["--terrain", "flat"])[1]
        out = judged.results / "reports" / case.name / "baselines.json"
        out.parent.mkdir(parents=True, exist_ok=True)
        script = str(Path(__file__).with_name("baseline_run.py"))
        arguments = [script, str(_bag(files.bag, judged)), str(robot), terrain, str(out)]
        # The system identification alone takes twice as long as a diagnosis.
        status, message, _, _ = _run(arguments, replace(judged, timeout=4 * judged.timeout))
        if status != 0:
            # Not kept: pysindy and mujoco[sysid] may be installed later.
            return row | {"baselines": {"error": message}}
        row["baselines"] = json.loads(out.read_text())
        write_text(result, json.dumps(row, indent=1) + "\n")
    return row


def _diagnose(arguments: list[str], judged: Judged) -> tuple[int, str, float, float]:
    return _run(["-m", "monoforce_ros.discrepancy.cli", *arguments], judged)


def _run(arguments: list[str], judged: Judged) -> tuple[int, str, float, float]:
    """Run Python with the judged code: its exit status, last words, wall time and processor time [s]."""
    environment = os.environ | {"PYTHONPATH": str(judged.code), "OMP_NUM_THREADS": "1"}
    began, used = time.monotonic(), _children_seconds()
    try:
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=judged.code,
            env=environment,
            capture_output=True,
            text=True,
            timeout=judged.timeout,
        )
        status, output = done.returncode, done.stdout + done.stderr
    except subprocess.TimeoutExpired:
        status, output = -1, f"timeout after {judged.timeout:g} s"
    return status, output.strip()[-2000:], time.monotonic() - began, _children_seconds() - used


def _children_seconds() -> float:
    """Processor time of the finished child processes of this worker, which runs one at a time [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def has_result(case: Case, judged: Judged) -> bool:
    """Whether a case was diagnosed, so that its result may have been seen."""
    return (judged.results / "cases" / f"{case.name}.json").exists()


def forget(case: Case, judged: Judged) -> None:
    """Remove the result and the report of a case, so that it is diagnosed again."""
    (judged.results / "cases" / f"{case.name}.json").unlink(missing_ok=True)
    shutil.rmtree(judged.results / "reports" / case.name, ignore_errors=True)
