"""World recording: empty drives of a healthy Husky through the package's own worlds, with the lidar's clouds."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path

from benchmark_case import DURATION, Case
from case_recording import CaseFiles

from monoforce_ros.core import write_text
from monoforce_ros.robots import robot_file
from monoforce_ros.synthetic import LidarSettings, TerrainSettings
from monoforce_ros.synthetic.odometry import OdometrySettings
from monoforce_ros.synthetic.recording import RecordingSettings, record

_COMMISSIONING = 90.0
_NOISE = (0.01, math.radians(0.5))
"""Of the poses [m, rad]."""
_SHORTEST = 40.0
"""Of a drive that ended early [s]; a shorter one is not used."""


def record_world(cases: Sequence[Case], work: Path) -> None:
    """Record the commissioning and the empty drives of one kind of ground, each in another world of this kind."""
    files = [CaseFiles.of(case, work) for case in cases]
    files[0].folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(robot_file("husky"), files[0].robot)
    if not files[0].commissioning.exists():
        _record(cases[0], files[0].commissioning, cases[0].platform_seed * 100, _COMMISSIONING)
    for case, entry in zip(cases, files, strict=True):
        if entry.truth.exists():
            continue
        duration = _record(case, entry.bag, case.seed, DURATION) if not entry.bag.exists() else DURATION
        content = {
            "case": case.name, "kind": case.kind, "engine": case.engine, "ground": case.ground,
            "usable": duration >= _SHORTEST, "hidden": [], "displacement_m": [], "draws": 1,
            "sensors": {"wheels": True, "gyro": True},
        }  # fmt: skip
        write_text(entry.truth, json.dumps(content, indent=1) + "\n")


def _record(case: Case, bag: Path, seed: int, duration: float) -> float:
    """Record one drive; returns its length, which is shorter after a mishap [s]."""
    if case.ground == "bare":
        terrain = TerrainSettings(bare=True, roughness=0.6)
    else:
        terrain = TerrainSettings(ground=case.ground)
    settings = RecordingSettings(
        seed=seed,
        duration=duration,
        commands="random",
        terrain=terrain,
        camera=None,
        lidar=LidarSettings(rate=2.0),
        odometry=OdometrySettings.slam(*_NOISE),
    )
    return record(bag, settings).duration
