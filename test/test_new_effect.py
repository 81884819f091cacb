"""A new effect is one new file: everything that knows effects finds it, and a file that is incomplete is refused."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

PACKAGE = ROOT / "monoforce_ros"

SIDE_WIND = '''
"""Wind across the robot."""

from __future__ import annotations

from dataclasses import replace

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class SideWind(Effect):
    """Wind across the robot."""

    name = "side_wind"
    stage = "body"
    summary = "A constant force to the left."
    formula = "f_y = F"
    source = "aerodynamics"
    parameters = (Parameter("force", "N", 0.0, -500.0, 500.0, 50.0, "force to the left"),)
    identified = ("force",)
    manoeuvre = "the same stretch in opposite directions"

    def setup(self, setup: Setup, values: Values) -> Setup:
        return replace(setup, loads=setup.loads.with_wrench(1, "1", values["force"]))
'''

SLOW_RIGHT = '''
"""The right drive loses speed."""

from __future__ import annotations

from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values, per_trajectory


class SlowRight(Effect):
    """The right drive loses speed."""

    name = "slow_right"
    stage = "command"
    summary = "The right drive is slower by a share."
    formula = "u_right ← (1 - s) u"
    source = "a worn belt"
    parameters = (Parameter("share", "-", 0.0, 0.0, 0.9, 0.1, "lost share of the speed"),)
    ORDER

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        right = (offsets < 0).to(speeds)
        return speeds * (1.0 - per_trajectory(values["share"], 3) * right)
'''

SCRIPT = """
import json
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.discrepancy import DiagnosisSettings, Evidence, diagnose

from monoforce_ros.effects import CATALOGUE, drive_speeds, identifiable_effects
from monoforce_ros.effects.page import catalogue_page
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

torch.set_num_threads(1)
husky = load_robot("husky")
file = Path("husky.yaml")
text = Path(SHIPPED).read_text()
file.write_text(text + "\\neffects:\\n  - name: side_wind\\n    parameters: {force: 150.0}\\n")
windy = load_robot(file)
flat = TerrainMap.flat(Grid.square(2.0, 1.0))
result = {
    "stage order": list(CATALOGUE),
    "page": catalogue_page().count("### side_wind"),
    "candidate": any(effect.name == "side_wind" for effect in identifiable_effects()),
}
still = torch.zeros(1, 200, 2)
for backend in ("torch", "warp"):
    calm, blown = (
        rollout(flat, robot, drive_speeds(robot, still, 0.01), State.at_rest(0.13), backend=backend)
        for robot in (husky, windy)
    )
    result[backend] = float(blown.position[0, -1, 1] - calm.position[0, -1, 1])
random = np.random.default_rng(3)
twists = np.repeat(random.uniform([-0.6, -0.9], [0.9, 0.9], (16, 2)), 150, axis=0)
speeds = drive_speeds(windy, torch.as_tensor(twists[None], dtype=torch.float32), 0.01)
rolled = rollout(flat, windy, speeds, State.at_rest(0.13), with_forces=False)
rotations = Rotation.from_matrix(rolled.rotation[0, ::5].double().numpy())
motion = MotionTrack(
    stamps=(10**9 + np.arange(len(rotations)) * 50_000_000).astype(np.int64),
    positions=rolled.position[0, ::5].double().numpy(),
    quaternions=rotations.as_quat(),
    linear_velocities=rotations.inv().apply(rolled.velocity[0, ::5].double().numpy()),
    angular_velocities=rotations.inv().apply(rolled.angular_velocity[0, ::5].double().numpy()),
)
commands = CommandTrack(10**9 + np.arange(len(twists)) * 10_000_000, twists)
smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
found = diagnose(Evidence(smoothed, commands), husky, settings=DiagnosisSettings(max_effects=1))
result["named"] = [entry.name for entry in found.effects]
result["tried"] = "side_wind" in str(found.candidates)
print(json.dumps(result))
"""


def package_with(folder: Path, files: dict[str, str]) -> dict[str, str]:
    """Environment in which the package has further effect files; every other file is the project's own."""
    copy = folder / "monoforce_ros"
    (copy / "effects").mkdir(parents=True)
    for entry in PACKAGE.iterdir():
        if entry.name not in ("effects", "__pycache__"):
            (copy / entry.name).symlink_to(entry)
    for entry in (PACKAGE / "effects").glob("*.py"):
        (copy / "effects" / entry.name).symlink_to(entry)
    for name, text in files.items():
        (copy / "effects" / name).write_text(text)
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}


def run(folder: Path, script: str, environment: dict[str, str]) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", script], cwd=folder, env=environment, capture_output=True, text=True, timeout=250
    )


def test_a_new_file_is_found_by_catalogue_page_rollout_diagnosis_and_robot_files(tmp_path):
    order = "order = 65"
    environment = package_with(
        tmp_path, {"side_wind.py": SIDE_WIND, "slow_right.py": SLOW_RIGHT.replace("ORDER", order)}
    )
    shipped = ROOT / "config" / "robots" / "husky.yaml"
    done = run(tmp_path, SCRIPT.replace("SHIPPED", repr(str(shipped))), environment)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert "side_wind" in result["stage order"] and "slow_right" in result["stage order"]
    assert result["page"] == 1 and result["candidate"] and result["tried"]
    # 150 N are less than friction holds: the robot creeps to the left by the same way in both backends.
    assert result["torch"] > 1e-4
    assert result["warp"] == pytest.approx(result["torch"], rel=0.02)
    # A force to the left acts as `constant_force` does: either name is right.
    assert result["named"] in (["side_wind"], ["constant_force"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (SLOW_RIGHT.replace("ORDER", ""), "SlowRight changes drive speeds but has no order"),
        (SLOW_RIGHT.replace("ORDER", 'order = "65"'), "order: got '65', expected a whole number"),
        (SIDE_WIND.replace('stage = "body"', 'stage = "soul"'), "stage: got 'soul', expected one of"),
        (
            SIDE_WIND.replace('identified = ("force",)', 'identified = ("froce",)'),
            r"parameters \['froce'\] are unknown",
        ),
        (SIDE_WIND.replace('name = "side_wind"', 'name = "payload"'), "an effect named 'payload' exists already"),
        (SIDE_WIND.replace('    manoeuvre = "the same stretch in opposite directions"\n', ""), "has no manoeuvre"),
    ],
)
def test_an_incomplete_file_is_refused_with_its_name(tmp_path, text, words):
    environment = package_with(tmp_path, {"zz_new.py": text})
    done = run(tmp_path, "import monoforce_ros.effects", environment)
    assert done.returncode != 0
    assert "zz_new.py" in done.stderr
    assert re.search(words, done.stderr), done.stderr
