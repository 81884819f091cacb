"""Vegetation: its drag is recovered from motion through it, and no mud lies below it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from monoforce_ros.effects.catalogue import drive_speeds
from monoforce_ros.encoder import EncoderConfig
from monoforce_ros.physics import State, rollout
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.rest import rest_depth
from monoforce_ros.robots import load_robot
from monoforce_ros.robots.robot_copy import write_robot
from monoforce_ros.synthetic.course import CourseSettings, build_course
from monoforce_ros.synthetic.scenery import build_scenery
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap
from monoforce_ros.training.recording_samples import Chunks, RecordingSamples, Segment
from monoforce_ros.training.vegetation_fit import EFFECT, fit_vegetation

pytestmark = pytest.mark.usefixtures("one_thread")
GRID = Grid.square(30.0, 0.1)
COUNT, HISTORY = 200, 50
INJECTED = {"coefficient": 2.0e4, "yield_speed": 0.3}


def recording(robot, height: float) -> RecordingSamples:
    """Simulated chunks of motion on level ground under vegetation."""
    random = np.random.default_rng(3)
    ground = torch.zeros(GRID.rows, GRID.columns)
    terrain = TerrainMap.from_height(ground, GRID, geometric_height=ground + height)
    options, steps = PhysicsOptions(), 100
    twists = np.stack([random.uniform(0.2, 0.9, COUNT), random.uniform(-0.7, 0.7, COUNT)], axis=1)
    held = torch.from_numpy(np.repeat(twists[:, None], HISTORY + 2 * steps, axis=1)).float()
    rest = robot.ground_clearance - float(rest_depth(robot, TerrainDefaults.stiffness))
    state = State.at_rest(rest, batch=COUNT)
    speeds = drive_speeds(robot, held, options.time_step, history=HISTORY)
    found = rollout(terrain, robot, speeds, state, options=options, with_forces=False)
    # The robot accelerates in the first second; the second one is recorded.
    every = np.arange(steps, 2 * steps + 1, 10)
    rotation = found.rotation[:, steps].numpy()
    pose = np.tile(np.eye(4), (COUNT, 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = rotation, found.position[:, steps].numpy()
    stamps = 10**12 + np.arange(COUNT) * 10**10
    chunks = Chunks(
        stamps, np.linspace(0, 1, 11), found.position[:, every].double().numpy(),
        found.rotation[:, every].double().numpy(),
        np.einsum("wji,wj->wi", rotation, found.velocity[:, steps].numpy()),
        np.einsum("wji,wj->wi", rotation, found.angular_velocity[:, steps].numpy()),
        held[:, : HISTORY + steps].numpy(), HISTORY,
    )  # fmt: skip
    known = np.ones((GRID.rows, GRID.columns), bool)
    seen = (ground + height).numpy()
    unknown = np.full(known.shape, np.nan, np.float32)
    segment = Segment(GRID, np.eye(4), seen, known, ground.numpy(), known, unknown)
    points, ends = np.zeros((0, 3), np.float32), np.zeros(COUNT, np.int64)
    return RecordingSamples(
        name="injected",
        cameras=(),
        images=torch.zeros(COUNT, 0, 4, 4, 3, dtype=torch.uint8),
        stamps=stamps,
        odometry_from_base=pose,
        odometry_from_cameras=np.zeros((COUNT, 0, 4, 4)),
        support=np.zeros((COUNT, 0, 3)),
        sweeps=points,
        sweep_ends=ends,
        traces=points,
        trace_ends=ends,
        segment_of=np.zeros(COUNT, int),
        segments=(segment,),
        chunks=chunks,
    )


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def test_an_injected_drag_is_recovered(husky):
    injected = replace(husky, effects=((EFFECT, INJECTED),))
    found = fit_vegetation([recording(injected, 0.35)], husky, EncoderConfig())
    assert found is not None and found.chunks >= 30
    # Coefficient and yield speed are correlated: compare the drag at the speeds driven.
    for speed in (0.2, 0.6):
        drag = found.coefficient * (speed + found.yield_speed)
        assert drag == pytest.approx(INJECTED["coefficient"] * (speed + INJECTED["yield_speed"]), rel=0.15)
    assert found.after < 0.1 * found.before


def test_nothing_is_fitted_without_drag_or_without_vegetation(husky):
    assert fit_vegetation([recording(husky, 0.35)], husky, EncoderConfig()) is None
    assert fit_vegetation([recording(husky, 0.05)], husky, EncoderConfig()) is None


def test_the_written_robot_file_has_the_drag(husky, tmp_path):
    injected = replace(husky, effects=((EFFECT, INJECTED),))
    found = fit_vegetation([recording(injected, 0.35)], husky, EncoderConfig())
    file = write_robot("husky", tmp_path / "robot.yaml", [found.effect], [], "none", found_by="train")
    written = load_robot(file)
    assert dict(written.effects)[EFFECT]["coefficient"] == pytest.approx(found.coefficient, rel=1e-4)


@pytest.mark.parametrize("seed", [12, 50000, 50004, 51000, 61004])
def test_there_is_no_mud_under_tall_grass(seed):
    for ground in ("mixed", "grass"):
        scenery = build_scenery(TerrainSettings(ground=ground), seed)
        x, y = scenery.grass.canopy.grid()
        tall = scenery.grass.canopy.heights > 0.1
        assert tall.any()
        for patch in scenery.patches:
            assert not (patch.contains(np.stack([x, y], axis=-1)) & tall).any()


def test_a_yard_has_walls_and_grass_but_room_for_the_robot():
    walls, grassy = 0, 0
    for seed in range(53000, 53008):
        scenery = build_scenery(TerrainSettings(ground="yard"), seed)
        walls += len(scenery.walls)
        x, y = scenery.grass.canopy.grid()
        grassy += bool((scenery.grass.canopy.heights > 0.2).any())
        near = np.hypot(x, y) < 0.7
        assert not scenery.grass.canopy.heights[near].any()
        assert not any(wall.contains(x[near], y[near]).any() for wall in scenery.walls)
    assert walls >= 10 and grassy >= 5


def test_a_course_has_what_its_settings_say():
    scenery = build_course(CourseSettings(wall=2.5, wall_width=3.0, grass=None), 1)
    (wall,) = scenery.walls
    assert wall.contains(np.array([2.6]), np.array([1.4])).all()
    assert not wall.contains(np.array([2.3]), np.array([0.0])).any()
    assert not scenery.grass.canopy.heights.any()
    grass = build_course(CourseSettings(wall=None, grass=4.0, grass_depth=2.0), 1)
    assert not grass.walls and float(grass.grass.height_at(np.array([[5.0, 0.0]]))[0]) > 0.3
    assert CourseSettings.draw(5) == CourseSettings.draw(5) != CourseSettings.draw(6)
    with pytest.raises(ValueError, match="course wall: got 0"):
        CourseSettings(wall=0.0)
