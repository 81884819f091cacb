"""Contents and recording of worlds: kerbs, walls, mud, tracks, lenses, SLAM, many bags in parallel."""

import subprocess

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import Recording
from monoforce_ros.synthetic.command_profile import make_profile
from monoforce_ros.synthetic.labels import GroundClass, labels_file, world_labels
from monoforce_ros.synthetic.odometry import OdometrySettings
from monoforce_ros.synthetic.recording import RecordingSettings, record
from monoforce_ros.synthetic.scenery import build_scenery
from monoforce_ros.synthetic.sensors import CameraSettings
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import TIME_STEP, build_model


@pytest.fixture(scope="module")
def scenery():
    return build_scenery(TerrainSettings(), 4)


def test_a_world_has_every_ground_class(scenery):
    labels = world_labels(scenery, np.zeros(3))
    # Obstacles of other kinds stand in randomised worlds only.
    expected = set(GroundClass) - {GroundClass.OBSTACLE}
    assert {int(value) for value in np.unique(labels["ground_class"])} == {int(entry) for entry in expected}
    assert 0.2 < labels["friction"].min() < 0.75
    assert len(scenery.kerbs) == 2


def test_walls_are_clear_of_the_route(scenery):
    assert len(scenery.walls) >= 3
    for wall in scenery.walls:
        assert not wall.contains(*scenery.route.points.T, margin=0.9).any()


def test_kerbs_rise_abruptly_and_descend_gently(scenery):
    kerb = scenery.kerbs[0]
    forward = np.array([np.cos(kerb.heading), np.sin(kerb.heading)])
    before, edge, behind = (kerb.height_at(*(kerb.centre + s * forward)) for s in (-0.01, 0.01, 3.2))
    assert (before, edge) == (0.0, pytest.approx(kerb.height))
    assert behind == 0.0


def test_a_wall_stops_a_robot(scenery):
    robot = Vehicle.load("husky")
    wall = scenery.walls[0]
    simulation = Simulation(build_model(scenery, robot, 0, {}), scenery, robot)
    across = np.array([-np.sin(wall.heading), np.cos(wall.heading)])
    start = wall.centre - 1.2 * across
    heading = np.arctan2(across[1], across[0])
    simulation.data.qpos[:2] = start
    simulation.data.qpos[2] = scenery.ground.height_at(start) + 0.25
    simulation.data.qpos[3:7] = [np.cos(heading / 2), 0, 0, np.sin(heading / 2)]
    for _ in range(round(3.0 / TIME_STEP)):
        simulation.drive(0.6, 0.0)
        simulation.step()
    # Half the robot's length and half the wall's thickness before its centre, although 1.8 m were commanded.
    assert (simulation.data.qpos[:2] - wall.centre) @ across < -0.35


def test_friction_is_low_in_mud_only(scenery):
    robot = Vehicle.load("husky")
    simulation = Simulation(build_model(scenery, robot, 0, {}), scenery, robot)
    patch = scenery.patches[0]
    for place, friction in ((patch.area.centre, patch.friction), (np.zeros(2), 1.0)):
        simulation.data.qpos[:2] = place
        simulation.data.qpos[2] = scenery.ground.height_at(place) + 0.2
        simulation.update_kinematics()
        simulation.step()
        simulation.step()
        np.testing.assert_allclose(simulation.model.geom_friction[simulation.tyres, 0], friction)


def test_bare_hills_have_nothing_on_them():
    bare = build_scenery(TerrainSettings(bare=True), 4)
    assert np.ptp(bare.ground.heights) > 0.3
    assert not (bare.rocks or bare.trees or bare.walls or bare.patches or bare.grass.tiles)


@pytest.mark.parametrize(("name", "speed"), [("tradr", 0.4), ("warthog", 2.0)])
def test_tracks_and_heavy_robots_drive(name, speed):
    robot = Vehicle.load(name)
    level = build_scenery(TerrainSettings(flat=True), 4)
    simulation = Simulation(build_model(level, robot, 0, {}), level, robot)
    assert abs(simulation.state().position[2]) < 0.01
    states = []
    for step in range(round(3.0 / TIME_STEP)):
        simulation.drive(min(1.0, step * TIME_STEP) * speed, 0.0)
        simulation.step()
        states.append(simulation.state())
    assert states[-1].linear_velocity[0] == pytest.approx(speed, rel=0.03)
    assert max(np.arccos(state.rotation[2, 2]) for state in states) < np.radians(4.0)
    simulation.drive(0.0, 0.8)
    for _ in range(round(2.0 / TIME_STEP)):
        simulation.step()
    assert 0.2 < simulation.state().angular_velocity[2] < 0.75  # skid steering turns less than commanded


@pytest.mark.parametrize("blocked", [True, False])
def test_a_driver_reverses_from_what_stops_the_robot_and_passes_it(blocked):
    """A wall across the way at x = 2 m that ends 0.4 m beside it; the robot is a point that stops at it."""
    level = build_scenery(TerrainSettings(flat=True), 4)
    driver = make_profile("random", level.route, np.random.default_rng(3), 1.0)
    position, heading, step = np.zeros(2), 0.0, 0.05
    speeds, places = [], []
    for number in range(round(40.0 / step)):
        speed, yaw_rate = driver.command(number * step, position, heading)
        heading += yaw_rate * step
        moved = position + speed * step * np.array([np.cos(heading), np.sin(heading)])
        crosses = (position[0] - 2.0) * (moved[0] - 2.0) <= 0.0 and abs(moved[1]) < 0.4
        position = position if blocked and crosses else moved
        speeds.append(speed)
        places.append(position)
    stood = np.linalg.norm(np.array(places)[50:] - np.array(places)[:-50], axis=1) < 0.05
    assert stood.any() == blocked
    assert max(place[0] for place in places) > 4.0
    # A robot that moves on is never reversed.
    assert min(speeds) < -0.3 if blocked else min(speeds) >= 0.0


@pytest.mark.parametrize("name", ["steps", "sweep"])
def test_excitation_drivers_stay_near_the_start(name):
    robot = Vehicle.load("husky")
    level = build_scenery(TerrainSettings(flat=True), 4)
    simulation = Simulation(build_model(level, robot, 0, {}), level, robot)
    driver = make_profile(name, level.route, np.random.default_rng(2), 1.0)
    commands, places = [], []
    for step in range(round(60.0 / TIME_STEP)):
        if step % 25 == 0:
            state = simulation.state()
            commands.append(driver.command(simulation.time, state.position[:2], state.heading))
            simulation.drive(*commands[-1])
            places.append(state.position[:2])
        simulation.step()
    forward, turning = np.array(commands).T
    assert np.linalg.norm(places, axis=1).max() < 15.0
    assert turning.min() < -0.4
    assert turning.max() > 0.6
    assert forward.max() > 0.8
    if name == "steps":
        assert forward.min() < -0.15
        assert ((forward == 0.0) & (turning == 0.0)).any()


def test_distorted_pixels_are_taken_from_the_direction_of_their_rays():
    settings = CameraSettings(distortion=(-0.25, 0.06, 0.001, -0.002, 0.0), width=160, height=120)
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.7, 0.7, 300), rng.uniform(-0.5, 0.5, 300), np.ones(300)])
    projected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), settings.matrix, np.array(settings.distortion))
    pixels = projected[:, 0]
    inside = (pixels > 1).all(axis=1) & (pixels < [158, 118]).all(axis=1)
    drawn = settings.drawn_pixels()
    columns, rows = np.floor(pixels[inside]).astype(int).T
    u, w = (pixels[inside] - np.floor(pixels[inside])).T[:, :, None]
    there = (1 - w) * ((1 - u) * drawn[rows, columns] + u * drawn[rows, columns + 1]) + w * (
        (1 - u) * drawn[rows + 1, columns] + u * drawn[rows + 1, columns + 1]
    )
    scale = settings.oversampling * settings.matrix[0, 0]
    expected = rays[inside, :2] * scale + (np.array(settings.drawn_size) - 1) / 2
    np.testing.assert_allclose(there, expected, atol=0.1)
    assert (drawn.reshape(-1, 2).min(axis=0) >= 0).all()
    assert (drawn.reshape(-1, 2).max(axis=0) <= np.array(settings.drawn_size) - 1).all()


def test_four_distorted_cameras_on_tracks(tmp_path):
    lens = (-0.2, 0.05, 0.0, 0.0, 0.0)
    camera = CameraSettings(width=96, height=64, rate=2.0, distortion=lens)
    record(
        tmp_path / "drive",
        RecordingSettings(duration=0.6, robot="tradr", camera=camera, cameras=4, storage="sqlite3", lidar=None),
    )
    recording = Recording.open(tmp_path / "drive")
    assert len(recording.images) == 4
    for topic, frames in recording.images.items():
        assert recording.image(frames[0]).std() > 10.0
        np.testing.assert_allclose(recording.cameras[topic].distortion[:5], lens)
    front, rear = (recording.base_from(f"camera_{side}", "base_link") for side in ("front", "rear"))
    np.testing.assert_allclose(front[:2, 2], -rear[:2, 2], atol=1e-6)


def test_slam_has_the_configured_noise_latency_and_drift(tmp_path):
    out = tmp_path / "drive"
    odometry = OdometrySettings.slam(0.03, np.radians(1.5))
    flat = TerrainSettings(flat=True)
    record(out, RecordingSettings(duration=20.0, terrain=flat, camera=None, lidar=None, odometry=odometry, labels=True))
    truth = np.load(labels_file(out))
    with AnyReader([out]) as reader:
        connections = [c for c in reader.connections if c.topic == "/odom"]
        delays = []
        for connection, received, data in reader.messages(connections):
            message = reader.deserialize(data, connection.msgtype)
            delays.append(received - (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec))
    # Messages delayed beyond the end arrive at the end.
    assert np.median(delays) == pytest.approx(1e8)
    motion = Recording.open(out).motion
    np.testing.assert_array_equal(motion.stamps, truth["true_stamps"])
    error = motion.positions - truth["true_positions"]
    noise = np.diff(error, axis=0).std() / np.sqrt(2)
    assert noise == pytest.approx(0.03, rel=0.15)
    turns = (Rotation.from_quat(truth["true_quaternions"]).inv() * Rotation.from_quat(motion.quaternions)).as_rotvec()
    assert np.diff(turns, axis=0).std() / np.sqrt(2) == pytest.approx(np.radians(1.5), rel=0.15)
    drift = np.linalg.norm(error[-40:].mean(axis=0) - error[:40].mean(axis=0))
    assert 0.01 < drift < 0.6


def test_many_bags_in_parallel(tmp_path, executables, ros_environment):
    command = [executables / "synthesize", tmp_path / "set", "--count", "3", "--jobs", "2", "--duration", "1"]
    command += ["--camera", "none", "--lidar", "none", "--seed", "5", "--hide-random", "2", "--flat"]
    done = subprocess.run(command, env=ros_environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "3/3" in done.stderr
    bags = sorted(path.name for path in (tmp_path / "set").iterdir() if path.is_dir())
    assert bags == ["0005", "0006", "0007"]
    assert len(list((tmp_path / "set").glob("*.hidden.json"))) == 3
    ends = [Recording.open(tmp_path / "set" / bag).motion.positions[-1] for bag in bags]
    assert not np.allclose(ends[0], ends[1])


def test_the_kind_of_ground_sets_the_amount_of_grass(tmp_path):
    covered = {}
    for ground in ("rigid", "mixed", "grass"):
        world = build_scenery(TerrainSettings(ground=ground), 3)
        covered[ground] = float((world.grass.height_at(world.route.points) > 0.1).mean())
        assert len(world.rocks) > 50 and len(world.walls) >= 3
    assert covered["rigid"] == 0.0 < covered["mixed"] < 0.5 * covered["grass"] and covered["grass"] > 0.4
    with pytest.raises(ValueError, match="ground: got 'snow'"):
        TerrainSettings(ground="snow")
