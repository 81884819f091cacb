"""Synthetic worlds: reproducible, with plausible motion, and consistent with their labels."""

import subprocess
import sys

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import Recording
from monoforce_ros.robots import RobotFileError
from monoforce_ros.synthetic import cli
from monoforce_ros.synthetic.command_profile import CommandTable, make_profile
from monoforce_ros.synthetic.graphics import DrawingError
from monoforce_ros.synthetic.labels import GroundClass, labels_file
from monoforce_ros.synthetic.recording import START_STAMP, RecordingSettings, record
from monoforce_ros.synthetic.scenery import build_scenery
from monoforce_ros.synthetic.sensors import CameraSettings, LidarSettings
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.synthetic.vegetation import GrassSettings
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import TIME_STEP, build_model


def read(bag):
    """Messages of a bag by topic: lists of (stamp [ns], message)."""
    messages = {}
    with AnyReader([bag]) as reader:
        for connection, stamp, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            messages.setdefault(connection.topic, []).append((stamp, message))
    return messages


def motion(messages):
    """Stamps [s], positions, rotations (odom ← base), linear and angular velocities (base) of a bag's odometry."""
    stamps, poses, quaternions, linear, angular = [], [], [], [], []
    for stamp, message in messages["/odom"]:
        pose, twist = message.pose.pose, message.twist.twist
        stamps.append((stamp - START_STAMP) * 1e-9)
        poses.append([pose.position.x, pose.position.y, pose.position.z])
        quaternions.append([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
        linear.append([twist.linear.x, twist.linear.y, twist.linear.z])
        angular.append([twist.angular.x, twist.angular.y, twist.angular.z])
    return np.array(stamps), np.array(poses), Rotation.from_quat(quaternions), np.array(linear), np.array(angular)


@pytest.fixture(scope="module")
def husky():
    return Vehicle.load("husky")


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Six seconds without images, with labels."""
    out = tmp_path_factory.mktemp("synthetic") / "drive"
    summary = record(out, RecordingSettings(duration=6.0, camera=None, labels=True))
    assert summary.mishap is None
    return out


@pytest.fixture(scope="module")
def messages(bag):
    return read(bag)


def drive(robot, scenery, forward, yaw_rate, seconds):
    """Body-frame velocities and up-vectors under a constant command, after a second of acceleration."""
    simulation = Simulation(build_model(scenery, robot, 0, {}), scenery, robot)
    velocities, upright = [], []
    for step in range(round(seconds / TIME_STEP)):
        share = min(1.0, step * TIME_STEP)
        simulation.drive(share * forward, share * yaw_rate)
        simulation.step()
        if step * TIME_STEP > 1.5:
            state = simulation.state()
            velocities.append([state.linear_velocity[0], state.angular_velocity[2]])
            upright.append(state.rotation[2, 2])
    return np.array(velocities), np.array(upright)


def test_topics_rates_and_frames(messages):
    counts = {topic: len(entries) for topic, entries in messages.items()}
    assert counts == {
        "/tf_static": 1,
        "/cmd_vel": 121,
        "/odom": 301,
        "/joint_states": 301,
        "/imu/data": 601,
        "/points": 31,
    }
    odometry = messages["/odom"][0][1]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert messages["/points"][0][1].header.frame_id == "lidar"
    assert messages["/imu/data"][0][1].header.frame_id == "imu_link"
    children = {entry.child_frame_id for entry in messages["/tf_static"][0][1].transforms}
    assert children == {"camera_front", "lidar", "imu_link"}
    assert min(entries[0][0] for entries in messages.values()) == START_STAMP


def test_starts_at_rest_at_the_odom_origin(messages):
    _, positions, rotations, linear, angular = motion(messages)
    np.testing.assert_allclose(positions[0], 0.0, atol=1e-9)
    assert np.linalg.norm(rotations[0].as_rotvec()) < 0.02
    assert np.linalg.norm(linear[0]) < 5e-3
    assert np.linalg.norm(angular[0]) < 5e-3


def test_drives_sensibly(messages):
    _, positions, rotations, linear, _ = motion(messages)
    assert 1.5 < np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() < 6.0
    assert rotations.as_matrix()[:, 2, 2].min() > np.cos(np.radians(30))
    commands = np.array([message.twist.linear.x for _, message in messages["/cmd_vel"]])
    # After half a second, the commanded speed is within the documented range.
    assert commands[10:].min() > 0.25
    assert commands.max() <= 1.0
    assert abs(linear[50:, 0].mean() / commands[20:].mean() - 1.0) < 0.15


def test_odometry_twist_is_the_derivative_of_the_pose_in_the_body_frame(messages):
    stamps, positions, rotations, linear, angular = motion(messages)
    steps = np.diff(stamps)[:, None]
    middle = rotations[:-1] * Rotation.from_rotvec(0.5 * (rotations[:-1].inv() * rotations[1:]).as_rotvec())
    from_poses = middle.inv().apply(np.diff(positions, axis=0) / steps)
    turning = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / steps
    assert np.median(np.abs(from_poses - (linear[:-1] + linear[1:]) / 2)) < 0.01
    assert np.median(np.abs(turning - (angular[:-1] + angular[1:]) / 2)) < 0.03


def test_imu_measures_gravity_at_rest_and_the_turning_rate(messages):
    first = messages["/imu/data"][0][1].linear_acceleration
    assert abs(first.z - 9.81) < 0.2
    _, _, _, _, angular = motion(messages)
    turning = np.array([message.angular_velocity.z for _, message in messages["/imu/data"]])
    np.testing.assert_allclose(np.cumsum(turning)[-1] / 100, np.cumsum(angular[:, 2])[-1] / 50, atol=0.03)


def test_wheel_speeds_follow_the_commands(messages, husky):
    speeds = np.array([message.velocity for _, message in messages["/joint_states"]])
    commands = [(message.twist.linear.x, message.twist.angular.z) for _, message in messages["/cmd_vel"]]
    commanded = np.array([husky.wheel_speeds(*command) for command in commands])
    # 40 ms after every second command, when the servos have settled and the next command has not arrived.
    late = speeds[2::5]
    assert np.median(np.abs(late - commanded[::2][: len(late)])) < 0.3


@pytest.mark.parametrize(("forward", "yaw_rate"), [(0.0, 0.8), (0.5, 0.8)])
def test_skid_steering_turns_less_than_commanded(husky, forward, yaw_rate):
    level = build_scenery(TerrainSettings(flat=True), 0)
    velocities, upright = drive(husky, level, forward, yaw_rate, 4.0)
    assert 0.3 < velocities[:, 1].mean() / yaw_rate < 0.7
    assert abs(velocities[:, 0].mean() - forward) < 0.05
    assert upright.min() > 0.999


def test_grass_slows_a_robot_and_does_not_carry_it(husky):
    scenery = build_scenery(TerrainSettings(roughness=0.0), 0)
    centre = scenery.grass.canopy.heights.max()
    assert centre > 0.8 * GrassSettings().height
    position = scenery.route.at(4.9)[0]
    ground = float(scenery.ground.height_at(position))
    wheel = np.array([[*position, ground + 0.165]])
    force = scenery.grass.wheel_forces(scenery.ground, wheel, np.array([0.165]), np.array([[0.5, 0.0, 0.0]]))[0]
    assert force[0] < -20.0
    assert abs(force[1]) < 1e-9
    assert 10.0 < force[2] < 0.7 * husky.mass * 9.81 / 4
    outside = np.array([[0.0, 0.0, 0.165]])
    assert scenery.grass.wheel_forces(scenery.ground, outside, np.array([0.165]), np.zeros((1, 3))) is None


def test_lidar_points_lie_on_the_labelled_ground(bag, messages, husky):
    with np.load(labels_file(bag)) as labels:
        support, visible, classes = labels["support_height"], labels["visible_height"], labels["ground_class"]
        resolution, origin = float(labels["resolution"]), labels["origin"]
    stamps, positions, rotations, _, _ = motion(messages)
    grass_heights = []
    for stamp, cloud in messages["/points"][::5]:
        index = int(np.argmin(np.abs(stamps - (stamp - START_STAMP) * 1e-9)))
        pose = husky.sensors["lidar"]
        points = cloud.data.view(np.float32).reshape(-1, 3).astype(float)
        assert np.linalg.norm(points, axis=1).max() < 20.1
        points = rotations[index].apply(points @ pose[:3, :3].T + pose[:3, 3]) + positions[index]
        column, row = np.round((points[:, :2] - origin) / resolution).astype(int).T
        kind = classes[row, column]
        is_ground = (kind == GroundClass.GROUND) & (np.linalg.norm(points[:, :2] - positions[index, :2], axis=1) < 5.0)
        errors = points[is_ground, 2] - support[row, column][is_ground]
        assert is_ground.sum() > 300
        assert np.median(np.abs(errors)) < 0.02
        grass = kind == GroundClass.GRASS
        grass_heights.append(points[grass, 2] - support[row, column][grass])
        # A few rays end at a rock or a trunk that shares a cell with grass.
        assert (points[grass, 2] < visible[row, column][grass] + 0.3).mean() > 0.97
    # The lidar measures the blades, well above the surface that carries the wheels.
    assert np.median(np.concatenate(grass_heights)) > 0.1


def test_the_height_field_is_the_simulated_ground(husky):
    from monoforce_ros.synthetic.graphics import mujoco

    scenery = build_scenery(TerrainSettings(), 3)
    model = build_model(scenery, husky, 3, {})
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    positions = np.random.default_rng(0).uniform(-6.0, 6.0, (200, 2))
    for group in (3, 4):
        groups = np.zeros(mujoco.mjNGROUP, np.uint8)
        groups[group] = 1
        for position in positions:
            top, geom = np.array([*position, 20.0]), np.zeros(1, np.int32)
            distance = mujoco.mj_ray(model, data, top, np.array([0.0, 0.0, -1.0]), groups, True, -1, geom, None)
            assert abs(20.0 - distance - scenery.ground.height_at(position)) < 1e-4


def test_same_seed_same_trajectory_whatever_the_sensors(tmp_path, messages):
    record(tmp_path / "bare", RecordingSettings(duration=3.0, camera=None, lidar=None))
    _, bare, _, _, _ = motion(read(tmp_path / "bare"))
    _, with_lidar, _, _, _ = motion(messages)
    np.testing.assert_array_equal(bare, with_lidar[: len(bare)])
    record(tmp_path / "other", RecordingSettings(seed=7, duration=3.0, camera=None, lidar=None))
    _, other, _, _, _ = motion(read(tmp_path / "other"))
    assert np.abs(other - bare).max() > 0.05


def test_images_and_the_same_trajectory_with_them(tmp_path, messages):
    settings = RecordingSettings(duration=1.0, camera=CameraSettings(rate=2.0), lidar=LidarSettings(rings=4))
    try:
        record(tmp_path / "drawn", settings)
    except DrawingError as error:
        pytest.skip(str(error))
    drawn = read(tmp_path / "drawn")
    _, positions, _, _, _ = motion(drawn)
    np.testing.assert_array_equal(positions, motion(messages)[1][: len(positions)])
    import cv2

    images = [
        cv2.imdecode(message.data, cv2.IMREAD_COLOR) for _, message in drawn["/camera_front/image_raw/compressed"]
    ]
    assert [image.shape for image in images] == [(240, 320, 3)] * 3
    sky, ground = images[0][:20].mean(axis=(0, 1)), images[0][-40:].mean(axis=(0, 1))
    assert sky[0] > sky[2]
    assert ground[0] < ground[2]
    info = drawn["/camera_front/camera_info"][0][1]
    assert (info.width, info.height, info.header.frame_id) == (320, 240, "camera_front")
    assert info.k[0] == pytest.approx(160 / np.tan(np.radians(42.5)))
    assert info.k[2] == pytest.approx(159.5)


def test_refuses_an_existing_folder(tmp_path, capsys):
    assert cli.main([str(tmp_path), "--quiet"]) == 1
    assert "--force" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--camera", "big"], "320x240"),
        (["--duration", "-1"], "duration"),
        (["--robot", "nobody"], "nobody"),
        (["--commands", "nowhere.csv"], "nowhere.csv"),
        (["--lidar-rate", "0"], "lidar rate"),
    ],
)
def test_wrong_options_are_explained_and_leave_nothing_behind(tmp_path, capsys, options, message):
    assert cli.main([str(tmp_path / "bag"), "--quiet", "--camera", "none", *options]) == 1
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_robot_without_the_sensor_is_named(tmp_path, husky):
    text = (
        "name: bare\nmass: 20.0\ninertia_box: [0.5, 0.4, 0.2]\ncommand: {track_width: 0.5}\nwheels:\n"
        "  - {name: left, drive: left, centre: [0.0, 0.25, 0.0], radius: 0.15, width: 0.1}\n"
        "  - {name: right, drive: right, centre: [0.0, -0.25, 0.0], radius: 0.15, width: 0.1}\n"
    )
    (tmp_path / "bare.yaml").write_text(text)
    with pytest.raises(RobotFileError, match="--lidar none"):
        record(tmp_path / "bag", RecordingSettings(robot=str(tmp_path / "bare.yaml"), camera=None))


def test_the_lidar_of_an_imported_robot_may_have_another_name(tmp_path):
    text = (
        "name: scout\nmass: 20.0\ninertia_box: [0.5, 0.4, 0.2]\ncommand: {track_width: 0.5}\nwheels:\n"
        + "".join(
            f"  - {{name: {side}_{end}, drive: {side}, centre: [{x}, {y}, 0.0], radius: 0.15, width: 0.1}}\n"
            for side, y in (("left", 0.25), ("right", -0.25))
            for end, x in (("front", 0.25), ("rear", -0.25))
        )
        + "sensors:\n  imu_link: {translation: [0.0, 0.0, 0.1], quaternion: [0, 0, 0, 1]}\n"
        "  velodyne: {translation: [0.0, 0.0, 0.5], quaternion: [0, 0, 0, 1]}\n"
    )
    (tmp_path / "scout.yaml").write_text(text)
    settings = RecordingSettings(robot=str(tmp_path / "scout.yaml"), camera=None, duration=0.5)
    record(tmp_path / "bag", settings)
    recording = Recording.open(tmp_path / "bag")
    points, frame = recording.cloud(recording.clouds[0])
    assert frame == "velodyne" and len(points) > 1000


def test_command_files(tmp_path):
    file = tmp_path / "commands.csv"
    file.write_text("t,v,w\n0.0,0.5,0.0\n1.0,0.2,-0.3\n")
    profile = make_profile(str(file), None, None)
    assert profile.command(0.5, np.zeros(2), 0.0) == (0.5, 0.0)
    assert profile.command(1.0, np.zeros(2), 0.0) == (0.2, -0.3)
    file.write_text("t,v,w\n0.0,fast,0.0\n")
    with pytest.raises(ValueError, match="line 2"):
        make_profile(str(file), None, None)
    with pytest.raises(ValueError, match="ascending"):
        CommandTable(np.array([1.0, 0.0]), np.zeros((2, 2)))


def test_a_recording_ends_at_the_edge_of_the_world(tmp_path):
    (tmp_path / "turn.csv").write_text("0.0,1.0,0.0\n")
    summary = record(
        tmp_path / "bag",
        RecordingSettings(
            duration=40.0,
            commands=str(tmp_path / "turn.csv"),
            terrain=TerrainSettings(flat=True),
            camera=None,
            lidar=None,
        ),
    )
    assert "edge" in summary.mishap
    assert summary.duration < 25.0


def test_settings_name_the_field():
    for make, field in (
        (lambda: TerrainSettings(roughness=-1.0), "roughness"),
        (lambda: CameraSettings(width=0), "width"),
        (lambda: LidarSettings(rings=0), "rings"),
        (lambda: GrassSettings(spring=-1.0), "spring"),
        (lambda: RecordingSettings(seed=-1), "seed"),
    ):
        with pytest.raises(ValueError, match=field):
            make()


def test_the_bundled_bag_is_what_the_command_in_the_readme_records(tmp_path, demo_bag):
    again = tmp_path / "again"
    assert cli.main([str(again), "--camera", "none", "--lidar", "none", "--quiet"]) in (0, None)
    bundled, remade = (Recording.open(path).motion for path in (demo_bag, again))
    assert np.array_equal(bundled.stamps, remade.stamps)
    # Another processor may round differently, and contacts magnify that; it stays far below what can be seen.
    assert np.abs(bundled.positions - remade.positions).max() < 0.01


def test_drawing_and_torchs_compiler_live_in_one_process():
    # Loaded the other way round, the two libraries' LLVMs crash the process.
    done = subprocess.run(
        [sys.executable, "-c", "import monoforce_ros.synthetic.graphics, torch, triton.backends"],
        capture_output=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr.decode()[-500:]
