"""Robot copy: a robot's file with what was found, where it was found, and how sure that is."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import yaml

from monoforce_ros.core import write_text
from monoforce_ros.robots.loader import RobotFileError, robot_file


def fingerprint(paths: Sequence[Path]) -> str:
    """A short hash of the bags' contents."""
    digest = hashlib.sha256()
    for path in paths:
        files = [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())
        for file in files:
            with file.open("rb") as stream:
                while chunk := stream.read(1 << 20):
                    digest.update(chunk)
    return digest.hexdigest()[:16]


def write_robot(
    robot: str | Path,
    out: Path,
    effects: Sequence[dict],
    bags: Sequence[Path],
    data_fingerprint: str,
    commissioning: dict | None = None,
    found_by: str = "diagnose",
) -> Path:
    """Write a copy of a robot's file with effects added, or with new values where it had them.

    Args:
        robot: name or file of the nominal robot.
        out: the copy; it appears when it is complete.
        effects: ``name`` and ``parameters`` {name: {value, low, high, unit}}.
        bags: where they were found.
        data_fingerprint: of these.
        commissioning: what disagreed on the healthy robot, kept for later runs.
        found_by: what found the effects.
    """
    content = yaml.safe_load(robot_file(robot).read_text(encoding="utf-8"))
    present = {entry["name"]: entry for entry in content.get("effects", [])}
    for effect in effects:
        present[effect["name"]] = {
            "name": effect["name"],
            "parameters": {
                key: {
                    name: (value if isinstance(value, str) else float(f"{value:.6g}")) for name, value in entry.items()
                }
                for key, entry in effect["parameters"].items()
            },
            "provenance": {
                "found_by": found_by,
                "date": datetime.now(UTC).date().isoformat(),
                "bags": [path.name for path in bags],
                "data": data_fingerprint,
                "rivals": list(effect.get("rivals", [])),
            },
        }
    content["effects"] = list(present.values())
    if commissioning is not None:
        content["commissioning"] = commissioning
    write_text(out, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
    return out


def read_nominal_residual(robot: str | Path, samples: Sequence[float]) -> np.ndarray | None:
    """What disagreed on the healthy robot, ``[K, 3]`` [m, m, rad], by its file; None if it was never commissioned.

    Raises:
        RobotFileError: the file's entry makes no sense or is for other times.
    """
    path = robot_file(robot)
    entry = yaml.safe_load(path.read_text(encoding="utf-8")).get("commissioning")
    if entry is None:
        return None
    try:
        times, rows = np.array(entry["samples_s"], float), np.array(entry["residual_rms"], float)
    except (KeyError, TypeError, ValueError) as error:
        raise RobotFileError(f"{path}: commissioning: expected samples_s and residual_rms, got {error!r}") from error
    if rows.shape != (len(samples), 3) or times.shape != (len(samples),) or not np.allclose(times, samples):
        raise RobotFileError(
            f"{path}: commissioning: got residuals {rows.shape} at {times.tolist()} s, expected three each at "
            f"{list(samples)} s; commission the robot again"
        )
    if not (np.isfinite(rows).all() and (rows >= 0).all()):
        raise RobotFileError(f"{path}: commissioning.residual_rms: expected finite numbers of 0 or more")
    return rows
