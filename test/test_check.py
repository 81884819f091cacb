"""`evaluate --check`: contents, missing data and faults of a bag, each in one sentence."""

import re
import subprocess

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, ReadOptions, builders
from monoforce_ros.core import CommandTrack, MotionTrack, pose_matrix
from monoforce_ros.evaluation.check import BagCheck, check_bag, check_text, command_delay
from monoforce_ros.evaluation.cli import main
from monoforce_ros.evaluation.findings import Level
from monoforce_ros.evaluation.twist_check import twist_fault, with_usable_twists
from monoforce_ros.robots import load_robot

START = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def husky():
    return load_robot("husky")


def write(
    path,
    *,
    delay=0.2,
    commands=True,
    clock=0.0,
    gap=False,
    info=True,
    frame="base_link",
    sign=1.0,
    camera=True,
    **extra,
):
    """Twenty seconds of a recording in which motion follows commands by ``delay``."""
    times = np.arange(0.0, 20.0, 0.05)

    def commanded(t):
        return 0.5 + 0.3 * np.sin(0.9 * t), 0.5 * np.sin(1.7 * t)

    heading = np.cumsum(commanded(times - delay)[1]) * 0.05
    speed = commanded(times - delay)[0]
    place = np.cumsum(np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=1), axis=0) * 0.05
    place = place * extra.get("unit", 1.0)
    per_turn = np.degrees(1.0) if extra.get("degrees") else 1.0
    with BagWriter(path) as bag:
        bag.write(
            "/tf_static", builders.transforms(START, "base_link", {"lidar": np.eye(4)} | extra.get("extra", {})), START
        )
        for i, time in enumerate(times):
            at = START + round(1e9 * time)
            if time > 10.0:
                at -= round(1e9 * extra.get("set_back", 0.0))
            at += round(1e9 * extra.get("pause", 0.0)) * bool(time > 10.0)
            if not (gap and 8.0 < time < 11.0):
                # A height that a sine of the place gives; the pitch follows from it.
                slope = extra.get("slope", 0.0) * np.cos(place[i, 0] / 0.8)
                height = 0.8 * extra.get("slope", 0.0) * np.sin(place[i, 0] / 0.8)
                turn = Rotation.from_euler("ZY", [heading[i], -slope * np.cos(heading[i])]).as_quat()
                stamp = at - round(1e9 * clock)
                odometry = builders.odometry(
                    stamp,
                    "odom",
                    frame,
                    [*place[i], height],
                    turn,
                    [sign * speed[i], 0, 0],
                    [0, 0, commanded(time - delay)[1]],
                )
                bag.write("/odom", odometry, at)
                if extra.get("wheel_odometry") and i % 2:
                    bag.write("/platform/odom", odometry, at)
            if commands:
                bag.write(
                    "/cmd_vel",
                    builders.twist_stamped(at, "base_link", *(commanded(time) * np.array([1.0, per_turn]))),
                    at,
                )
            if i % 4 == 0 and extra.get("clouds", True):
                bag.write("/points", builders.point_cloud(at, "lidar", extra.get("points", np.ones((5, 3)))), at)
            if i % 4 == 0:
                if camera:
                    image = builders.image(at, "camera_front", np.full((4, 6, 3), 9, np.uint8))
                    bag.write("/camera_front/image_raw", image, at)
                if camera and info:
                    calibration = builders.camera_info(
                        at, "camera_front", 6, 4, [[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]], [0] * 5
                    )
                    bag.write("/camera_front/camera_info", calibration, at)
    return path


def texts(check: BagCheck, level: Level) -> str:
    return " | ".join(finding.text for finding in check.findings if finding.level is level)


def test_a_good_bag_is_complete_and_its_rates_are_reported(tmp_path, husky):
    check = check_bag(write(tmp_path / "drive"), husky)
    assert check.usable
    assert not texts(check, Level.MISSING)
    assert not texts(check, Level.WARNING)
    assert re.search(r"motion follows commands 0\.(15|18|2.) s later", texts(check, Level.NOTE))
    assert "images /camera_front/image_raw: 100, 6 × 4" in texts(check, Level.OK)
    topics = {topic.topic: topic for topic in check.topics}
    assert topics["/odom"].rate == pytest.approx(20.0, rel=0.01)
    assert topics["/points"].rate == pytest.approx(5.0, rel=0.01)
    assert topics["/points"].frames == {"lidar"}
    text = check_text(check)
    assert "usable: predictions" in text
    assert "/cmd_vel" in text


@pytest.mark.parametrize(
    ("fault", "level", "message"),
    [
        ({"commands": False}, Level.MISSING, "record the commands of the base controller"),
        ({"clock": 1.3}, Level.WARNING, r"received \+1.30 s after their stamps"),
        ({"clock": 100.0}, Level.MISSING, "do not overlap in time"),
        ({"gap": True}, Level.WARNING, "no messages for 3"),
        ({"info": False}, Level.WARNING, "no CameraInfo on /camera_front/camera_info"),
        (
            {"frame": "imu"},
            Level.MISSING,
            "odometry describes the frame 'imu', lengths in the robot file refer to 'base_link', and the offset "
            "between them is unknown: no transform has 'imu'",
        ),
        ({"sign": -1.0}, Level.WARNING, "the opposite sign of its poses"),
        ({"unit": 1000.0}, Level.MISSING, r"jumps or pauses \d+ times in 400 poses, .* not in metres"),
        ({"set_back": 5.0125}, Level.MISSING, "a clock was set back"),
        ({"degrees": True}, Level.WARNING, "turns in a second: are they in degrees?"),
        ({"points": np.full((5, 3), 4000.0)}, Level.WARNING, "are they in millimetres?"),
        ({"points": np.zeros((0, 3))}, Level.WARNING, "the first cloud cannot be used: point cloud size: got 0 points"),
    ],
)
def test_each_fault_is_reported(tmp_path, husky, fault, level, message):
    check = check_bag(write(tmp_path / "drive", **fault), husky)
    assert re.search(message, texts(check, level))
    assert check.usable == (level is not Level.MISSING)


@pytest.mark.parametrize("pause", [60.0, 3600.0])
def test_a_long_pause_does_not_unrelate_motion_and_commands(tmp_path, husky, pause):
    check = check_bag(write(tmp_path / "drive", pause=pause), husky)
    assert check.usable and not texts(check, Level.MISSING)
    assert "does not follow" not in texts(check, Level.WARNING)
    assert re.search(r"motion follows commands 0\.(15|18|2.) s later \(correlation 0.9", texts(check, Level.NOTE))


def test_an_evaluation_without_anything_to_compare_fails(tmp_path, husky, capsys):
    bag = write(tmp_path / "drive", unit=1000.0)
    assert main([str(bag), "--terrain", "flat", "--stride", "2", "--out", str(tmp_path / "out"), "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "not in metres" in said and "nothing can be compared" in said and "evaluate --check" in said
    assert not (tmp_path / "out").exists()


def test_an_offset_that_the_bag_knows_is_reported_and_applied(tmp_path, husky):
    bag = write(
        tmp_path / "drive", frame="base_footprint", extra={"base_footprint": pose_matrix([0, 0, -0.13, 0, 0, 0])}
    )
    check = check_bag(bag, husky)
    assert check.usable
    applied = "frames: base_link is at (0.000, 0.000, 0.130) m and turned by 0.0° in base_footprint"
    assert applied in texts(check, Level.OK)
    given = check_bag(
        write(tmp_path / "given", frame="gps"), husky, ReadOptions(odometry_child_pose=(0.5, 0, 0, 0, 0, 0))
    )
    assert given.usable and "base_link is at (-0.500, 0.000, 0.000) m" in texts(given, Level.OK)


def test_a_choice_among_several_topics_is_reported_and_can_be_made(tmp_path, husky):
    bag = write(tmp_path / "drive", wheel_odometry=True)
    check = check_bag(bag, husky)
    chosen = "odometry: /odom is used, with the most messages of its type, not /platform/odom; --odometry TOPIC selects"
    assert check.usable and chosen in texts(check, Level.WARNING)
    named = check_bag(bag, husky, ReadOptions(odometry="/platform/odom"))
    assert "odometry /platform/odom: " in texts(named, Level.OK)
    assert "is used, with the most messages" not in texts(named, Level.WARNING)
    absent = check_bag(bag, husky, ReadOptions(odometry="/nowhere"))
    assert not absent.usable and "topic /nowhere is absent" in texts(absent, Level.MISSING)


def test_the_exit_status_is_1_for_an_unusable_bag(tmp_path, executables, ros_environment, real_data):
    def run(bag):
        return subprocess.run(
            [executables / "evaluate", "--check", bag], env=ros_environment, capture_output=True, text=True,
            timeout=120, check=False,
        )  # fmt: skip

    good = run(write(tmp_path / "drive"))
    assert good.returncode == 0, good.stderr
    real = run(next((real_data / "husky_outdoor").glob("*.bag")))
    assert real.returncode == 1
    assert "MISSING  commands" in real.stdout
    nothing = run(tmp_path / "nowhere")
    assert nothing.returncode == 1
    assert "does not exist" in nothing.stderr


@pytest.mark.parametrize("yaw_gain", [1.0, 0.3, 0.05])
def test_a_robot_that_turns_less_than_commanded_follows_its_commands(yaw_gain):
    random = np.random.default_rng(7)
    stamps = (10**9 + np.arange(1600) * 25_000_000).astype(np.int64)
    twists = np.repeat(random.uniform([-0.5, -1.0], [0.9, 1.0], (40, 2)), 40, axis=0)
    commands = CommandTrack(stamps, twists)
    done = commands.sample(stamps - 200_000_000) * [1.0, yaw_gain]
    done[:, 0] += 0.3 * random.standard_normal(len(done))
    zeros = np.zeros((len(stamps), 3))
    linear, angular = zeros.copy(), zeros.copy()
    linear[:, 0], angular[:, 2] = done.T
    motion = MotionTrack(stamps, zeros, np.tile([0.0, 0, 0, 1], (len(stamps), 1)), linear, angular)
    delay, correlation = command_delay(motion, commands)
    assert delay == pytest.approx(0.2, abs=0.03)
    assert correlation > 0.6


@pytest.mark.parametrize("clouds", [False, True])
def test_slopes_that_no_map_shows_are_said_before_diagnose_meets_them(tmp_path, husky, clouds):
    check = check_bag(write(tmp_path / "hills", slope=0.2, clouds=clouds), husky)
    said = texts(check, Level.WARNING)
    assert ("ground, for diagnose: the ground is not level" in said) is not clouds, said
    assert check.usable


def turned_twists(motion, kind):
    velocity = motion.linear_velocities
    if kind == "zero":
        velocity = 0.0 * velocity
    elif kind == "of the odometry frame":
        velocity = Rotation.from_quat(motion.quaternions).apply(velocity)
    elif kind == "backwards":
        velocity = -velocity
    return MotionTrack(motion.stamps, motion.positions, motion.quaternions, velocity, motion.angular_velocities)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("right", ""),
        ("zero", "twists are zero"),
        ("of the odometry frame", "in the frame of its poses"),
        ("backwards", "opposite sign"),
    ],
)
def test_twists_that_are_not_those_of_the_poses_are_named_and_replaced(kind, text):
    times = np.arange(0.0, 20.0, 0.05)
    heading = 0.3 * times + 1.0
    places = np.cumsum(0.5 * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1), axis=0) * 0.05
    ahead = np.tile([0.5, 0.0, 0.0], (len(times), 1))
    turning = np.tile([0.0, 0.0, 0.3], (len(times), 1))
    stamps = START + np.rint(times * 1e9).astype(np.int64)
    true = MotionTrack(stamps, places, Rotation.from_euler("z", heading[:, None]).as_quat(), ahead, turning)
    stated = turned_twists(true, kind)
    assert (text in twist_fault(stated, true)) and bool(twist_fault(stated, true)) == bool(text)
    used, said = with_usable_twists(stated, true)
    np.testing.assert_allclose(used.linear_velocities, ahead, atol=1e-9)
    assert bool(said) == bool(text)


def with_sensors(path, *, cloud_offset=0.0, optical=True, encoding="rgb8", size=(48, 64)):
    """Twenty seconds with a lidar and a camera, whose stamps, frame, encoding or size may be wrong."""
    mounted = np.eye(4)
    mounted[:3, 3] = [0.3, 0.0, 0.4]
    if optical:
        mounted[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    frames = {"lidar": np.eye(4), "camera": mounted}
    with BagWriter(path) as bag:
        bag.write("/tf_static", builders.static_transforms(START, "base_link", frames), START)
        for i in range(400):
            at = START + i * 50_000_000
            place = [0.02 * i, 0.0, 0.0]
            bag.write(
                "/odom", builders.odometry(at, "odom", "base_link", place, [0, 0, 0, 1], [0.4, 0, 0], [0] * 3), at
            )
            bag.write("/cmd_vel", builders.twist_stamped(at, "base_link", 0.4, 0.0), at)
            if i % 10 == 0:
                late = at + round(1e9 * cloud_offset)
                bag.write("/points", builders.point_cloud(late, "lidar", np.full((30, 3), 2.0)), at)
                image = builders.image(at, "camera", np.zeros((*size, 3), np.uint8))
                image.encoding = encoding
                bag.write("/cam/image_raw", image, at)
                info = builders.camera_info(at, "camera", 64, 48, [[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]], [0] * 5)
                bag.write("/cam/camera_info", info, at)
    return path


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ({}, ""),
        (
            {"cloud_offset": 7200.0},
            "0% of its messages have stamps within the odometry, the others are 7200 s after it",
        ),
        ({"optical": False}, "its frame camera looks up at the sky"),
        ({"encoding": "rgb161"}, "the images cannot be used: image encoding: got 'rgb161'"),
        ({"size": (24, 32)}, "the images cannot be used: images are 32 × 24 px, but CameraInfo says 64 × 48 px"),
    ],
)
def test_sensors_that_cannot_be_used_are_not_called_ok(tmp_path, husky, fault, text):
    check = check_bag(with_sensors(tmp_path / "drive", **fault), husky)
    texts = check_text(check)
    assert text in texts
    assert ("clouds /points: 40" in texts) == ("cloud_offset" not in fault)
    assert ("images /cam/image_raw: 40" in texts) == (not {"optical", "encoding", "size"} & set(fault))
