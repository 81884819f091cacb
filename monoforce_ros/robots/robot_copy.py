"""Copies of robot files with identified effects, their confidence intervals and their provenance."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from monoforce_ros.core import write_text
from monoforce_ros.robots.loader import RobotFileError, robot_file

_FORM: dict[str, Any] = {"sort_keys": False, "allow_unicode": True}


def fingerprint(paths: Sequence[Path]) -> str:
    """A hash of the contents of bags, 16 hexadecimal digits."""
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
    effects: Sequence[Mapping[str, Any]],
    bags: Sequence[Path],
    data_fingerprint: str,
    commissioning: Mapping[str, Any] | None = None,
    found_by: str = "diagnose",
) -> Path:
    """Write a copy of a robot's file with effects added, or with new values of effects that it has.

    Args:
        robot: name or file of the nominal robot.
        out: the copy; it appears once it is complete.
        effects: entries with ``name``, ``parameters`` {name: {value, low, high, unit}} and, optionally,
            ``indistinguishable``: names of effects that explain the data equally well, and ``part``: where or when
            alone the effect acts, in a sentence, which also becomes a comment beside it.
        bags: recordings from which the effects were identified.
        data_fingerprint: fingerprint of the bags.
        commissioning: nominal residual of the healthy robot, for later runs: ``samples_s`` and ``residual_rms``.
        found_by: name of the tool that identified the effects.
    """
    content = yaml.safe_load(robot_file(robot).read_text(encoding="utf-8"))
    present = {entry["name"]: entry for entry in content.get("effects", [])}
    for effect in effects:
        # ``rivals`` is the former name of the key.
        indistinguishable = list(effect.get("indistinguishable", effect.get("rivals", [])))
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
                "indistinguishable": indistinguishable,
                "rivals": list(indistinguishable),  # the former name, kept for one release
                **({"part": str(effect["part"])} if effect.get("part") else {}),
            },
        }
    if commissioning is not None:
        content["commissioning"] = dict(commissioning)
    dumped = yaml.safe_dump({key: value for key, value in content.items() if key != "effects"}, **_FORM)
    listed = "".join(map(_listed, present.values()))
    write_text(out, f"{dumped}effects:\n{listed}" if listed else f"{dumped}effects: []\n")
    return out


def _listed(effect: Mapping[str, Any]) -> str:
    """An entry of the list of effects, below a comment on the part in which alone it acts."""
    provenance = effect.get("provenance")
    part = provenance.get("part") if isinstance(provenance, Mapping) else None
    comment = f"# {effect['name']}: {' '.join(str(part).split())}\n" if part else ""
    return comment + yaml.safe_dump([effect], **_FORM)


def read_commissioning(robot: str | Path) -> Mapping[str, Any] | None:
    """What commissioning wrote into a robot file, unchecked; None without commissioning.

    Args:
        robot: name or file.
    """
    entry = yaml.safe_load(robot_file(robot).read_text(encoding="utf-8")).get("commissioning")
    if entry is not None and not isinstance(entry, Mapping):
        raise RobotFileError(f"{robot_file(robot)}: commissioning: got {type(entry).__name__}, expected a mapping")
    return entry


def read_nominal_residual(robot: str | Path, samples: Sequence[float]) -> np.ndarray | None:
    """RMS residual of the healthy robot from its file, ``[K, 3]`` [m, m, rad], or ``[K, 6]`` with roll, pitch [rad] and
    height [m], or ``[K, 9]`` with their rates [rad/s, m/s], too; None without commissioning.

    Args:
        robot: name or file.
        samples: times in a window at which the residual is needed [s], ``[K]``.

    Raises:
        RobotFileError: the file's entry is invalid or for other times.
    """
    path = robot_file(robot)
    entry = yaml.safe_load(path.read_text(encoding="utf-8")).get("commissioning")
    if entry is None:
        return None
    try:
        times, rows = np.array(entry["samples_s"], float), np.array(entry["residual_rms"], float)
    except (KeyError, TypeError, ValueError) as error:
        raise RobotFileError(f"{path}: commissioning: expected samples_s and residual_rms, got {error!r}") from error
    known = rows.shape in tuple((len(samples), count) for count in (3, 6, 9))
    if not known or times.shape != (len(samples),) or not np.allclose(times, samples):
        raise RobotFileError(
            f"{path}: commissioning: got residuals {rows.shape} at {times.tolist()} s, expected 3, 6 or 9 each at "
            f"{list(samples)} s; commission the robot again"
        )
    if not (np.isfinite(rows).all() and (rows >= 0).all()):
        raise RobotFileError(f"{path}: commissioning.residual_rms: expected finite numbers of 0 or more")
    return rows
