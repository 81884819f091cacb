"""The same seeds give the same trajectories, diagnoses and encoder outputs as in ``data/reference_values.json``.

A change that is meant to alter results writes the file anew, and says so in CHANGELOG.md:
``scripts/run.sh python test/test_reference_values.py``.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import ROOT
from recorded_rollout import recorded
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import SmoothedMotion
from monoforce_ros.core import CameraModel, CommandTrack
from monoforce_ros.discrepancy import DiagnosisSettings, Evidence, diagnose
from monoforce_ros.effects.catalogue import drive_speeds, recorded_commands, recorded_motion
from monoforce_ros.encoder import CameraView, load_encoder
from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap, terrain_from_cloud

FILE = ROOT / "test" / "data" / "reference_values.json"

pytestmark = pytest.mark.usefixtures("one_thread")

EFFECTS = (
    ("command_delay", {"delay": 0.13}),
    ("actuator_deadband", {"width": 0.03}),
    ("actuator_saturation", {"limit": 0.7}),
    ("actuator_lag", {"time_constant": 0.2}),
    ("drive_gain", {"gain": 0.93}),
    ("drive_asymmetry", {"difference": 0.04}),
    ("turning_scrub", {"track_width_factor": 1.2}),
    ("rolling_resistance", {"coefficient": 0.04}),
    ("vegetation_drag", {"coefficient": 2e4, "yield_speed": 0.4}),
    ("friction_scale", {"factor": 0.8}),
    ("friction_anisotropy", {"factor": 0.7}),
    ("terrain_softness", {"factor": 2.0}),
    ("viscous_drag", {"coefficient": 20.0}),
    ("quadratic_drag", {"coefficient": 10.0}),
    ("gravity_tilt", {"about_x": 0.03, "about_y": -0.02}),
    ("constant_force", {"x": 10.0, "y": -5.0}),
    ("payload", {"mass": 8.0, "x": 0.1, "y": -0.05, "z": 0.2}),
    ("learned_term", {"force_x:vx": -5.0, "torque_z:vx wz": 3.0}),
)


def hills(grid: Grid) -> TerrainMap:
    x, y = (torch.from_numpy(v) for v in np.meshgrid(grid.x, grid.y))
    ground = 0.12 * torch.sin(0.9 * x) * torch.cos(0.7 * y) + 0.03 * torch.sin(3.1 * x + 2.0 * y)
    terrain = TerrainMap.from_height(ground, grid)
    grass = 0.2 * torch.clamp(torch.sin(0.6 * x + 1.0), min=0.0)
    return replace(terrain, geometric_height=ground + grass)


def trajectories(name: str, backend: str) -> dict:
    """Where a robot with one value of every effect is after 3 s, and what carries it."""
    robot = replace(load_robot(name).to(torch.float64), effects=EFFECTS)
    twists = torch.tensor([[0.8, 0.3], [-0.5, 0.6], [0.3, -0.9]], dtype=torch.float64)[:, None].expand(3, 500, 2)
    with torch.no_grad():
        result = rollout(
            hills(Grid.square(16.0, 0.1)),
            robot,
            drive_speeds(robot, twists, 0.01, history=200),
            State.at_rest(robot.ground_clearance + 0.05, batch=3, dtype=torch.float64),
            options=PhysicsOptions(),
            backend=backend,
        )
    return {
        "position": result.position[:, ::100].tolist(),
        "rotation": result.rotation[:, -1].tolist(),
        "load": result.normal_forces.sum(-1)[:, ::100].tolist(),
        "force": result.forces.sum(2)[:, -1].tolist(),
    }


def camera_maps() -> dict:
    """What the shipped encoder makes of a drawn picture."""
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    sky, ground = np.array([160, 190, 230]), np.array([90, 110, 60])
    image = np.where((v < 90)[..., None], sky, ground + 25 * np.sin(0.2 * u + 0.13 * v)[..., None])
    image = np.clip(image, 0, 255).astype(np.uint8)
    camera = CameraModel(320, 240, np.array([[200.0, 0, 159.5], [0, 200.0, 119.5], [0, 0, 1]]), np.zeros(0))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [-110, 0, -90], degrees=True).as_matrix()
    pose[:3, 3] = [0.3, 0.0, 0.4]
    support = np.array([[0.25, 0.28, -0.13], [0.25, -0.28, -0.13], [-0.25, 0.28, -0.13], [-0.25, -0.28, -0.13]])
    found = load_encoder("", "camera").terrain([CameraView(image, camera, pose)], support)
    return _map_values(found)


def lidar_maps() -> dict:
    """Interpolation of a drawn sweep."""
    random = np.random.default_rng(5)
    xy = random.uniform(-6.0, 6.0, (4000, 2))
    points = np.column_stack([xy, 0.2 * np.sin(xy[:, 0]) * np.cos(0.8 * xy[:, 1])])
    return _map_values(terrain_from_cloud(points, Grid.square(), material=TerrainDefaults()))


def _map_values(found: TerrainMap) -> dict:
    cells = (slice(4, None, 24), slice(4, None, 24))
    return {key: getattr(found, key).double()[cells].tolist() for key in ("height", "geometric_height", "friction")} | {
        "observed": int(found.observed.sum())
    }


def diagnosis() -> dict:
    """A recording in our own physics with two effects hidden in it."""
    husky = load_robot("husky")
    hidden = (("command_delay", {"delay": 0.25}), ("turning_scrub", {"track_width_factor": 1.35}))
    robot, random = replace(husky, effects=hidden), np.random.default_rng(11)
    twists = np.repeat(random.uniform([-0.2, -0.9], [0.9, 0.9], (20, 2)), 150, axis=0)
    speeds = drive_speeds(robot, torch.as_tensor(twists[None], dtype=torch.float32), 0.01)
    flat = TerrainMap.flat(Grid.square(2.0, 1.0))
    result = rollout(flat, robot, speeds, State.at_rest(0.13), with_forces=False)
    motion = recorded(result, 10**9)
    commands = CommandTrack(10**9 + np.arange(len(twists)) * 10_000_000, twists)
    motion, commands = recorded_motion(motion, robot), recorded_commands(commands, robot)
    smoothed = SmoothedMotion(motion, 0.003, 0.002, (slice(0, len(motion)),))
    found = diagnose(Evidence(smoothed, commands), husky, settings=DiagnosisSettings(max_effects=2))
    return {
        "verdict": found.verdict,
        # The class of a dead time has three members; which one comes first is decided far below any sensor's noise.
        "effects": {
            " or ".join(sorted((entry.name, *entry.indistinguishable))): [
                abs(estimate.value) for estimate in entry.parameters.values()
            ]
            if entry.indistinguishable
            else {key: estimate.value for key, estimate in entry.parameters.items()}
            for entry in found.effects
        },
        "gap": {metric: [row.before, row.after] for metric, row in found.gap.items()},
    }


CASES = {
    "husky, torch": (lambda: trajectories("husky", "torch"), 1e-9),
    "husky, warp": (lambda: trajectories("husky", "warp"), 1e-9),
    "marv, warp": (lambda: trajectories("marv", "warp"), 1e-9),
    "camera": (camera_maps, 2e-3),
    "lidar": (lidar_maps, 1e-5),
    "diagnosis": (diagnosis, 5e-3),
}
"""What is computed and how far it may be off [SI units, or as a part of larger values]: processors differ."""


def close(found, expected, tolerance: float, where: str) -> None:
    if isinstance(expected, dict):
        assert sorted(found) == sorted(expected), where
        for key, value in expected.items():
            close(found[key], value, tolerance, f"{where}, {key}")
    elif isinstance(expected, str):
        assert found == expected, where
    else:
        np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance, err_msg=where)


@pytest.mark.parametrize("name", CASES)
def test_results_are_those_of_the_reference(name):
    compute, tolerance = CASES[name]
    close(compute(), json.loads(FILE.read_text())[name], tolerance, name)


if __name__ == "__main__":
    FILE.parent.mkdir(exist_ok=True)
    torch.set_num_threads(1)
    FILE.write_text(json.dumps({name: compute() for name, (compute, _) in CASES.items()}, indent=1) + "\n")
