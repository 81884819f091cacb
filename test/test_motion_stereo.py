"""Motion stereo: walls from the images of a moving camera, in drawn scenes whose geometry is known, and simulated."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import wall
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CameraModel, MotionState
from monoforce_ros.perception import Observation, SeenObstacles, choose_terrain_source
from monoforce_ros.perception.epipolar import EpipolarPair, PinholeImage, pinhole_image
from monoforce_ros.perception.motion_stereo import MotionStereo
from monoforce_ros.perception.standing_points import standing_on
from monoforce_ros.robots import load_robot
from monoforce_ros.synthetic import AHEAD_KINDS
from monoforce_ros.terrain import Grid, TerrainMap

MATRIX = np.array([[175.0, 0, 159.5], [0, 175.0, 119.5], [0, 0, 1]])
WIDE = np.array([[350.0, 0, 319.5], [0, 350.0, 239.5], [0, 0, 1]])
CAMERAS = {
    "pinhole": CameraModel(320, 240, MATRIX, np.zeros(5)),
    "barrel": CameraModel(640, 480, WIDE, np.array([-0.25, 0.06, 0.001, -0.001, 0.0])),
    "fisheye": CameraModel(
        320, 240, np.array([[130.0, 0, 159.5], [0, 130.0, 119.5], [0, 0, 1]]), np.array([0.02, -0.01, 0.0, 0.0]),
        "equidistant",
    ),
}  # fmt: skip
GROUND = -0.13
"""Height of the ground below a Husky's base [m]."""
GRID = Grid.square()


def mounted(yaw: float = 0.0) -> np.ndarray:
    """Pose of a camera on the robot that looks 14° down, turned about the vertical [rad]."""
    pose = np.eye(4)
    tilt = Rotation.from_euler("x", -14.0, degrees=True).as_matrix()
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix() @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ tilt
    pose[:3, 3] = [0.3, 0.0, 0.55]
    return pose


def texture(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    layers = [
        cv2.resize(random.standard_normal((size, size)), (512, 512), interpolation=cv2.INTER_CUBIC)
        for size in (512, 128, 32)
    ]
    return np.clip(120.0 + 22.0 * sum(layers), 0.0, 255.0)


def stripes(_: int) -> np.ndarray:
    """A pattern that repeats itself every 12 cm along both axes."""
    phase = np.arange(512) // 6 % 2
    return np.where(phase[:, None] ^ phase[None, :], 190.0, 60.0)


def picture(camera, pose, distance=None, height=0.7, width=4.0, draw=texture, seed=0):
    """What a camera at a pose ``[4, 4]`` sees of level ground and of a wall across x at a distance [m]; its textures
    have 512 × 512 pixels of 2 cm on the ground and 1 cm on the wall."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(np.stack([u, v], axis=-1))
    shown = np.isfinite(rays).all(axis=-1)
    rays = np.where(shown[..., None], rays, [0.0, 0.0, 1.0]) @ pose[:3, :3].T
    origin = pose[:3, 3]
    image = np.full(shown.shape, 230.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        down = (GROUND - origin[2]) / rays[..., 2]
        ground = shown & (down > 0.0) & (down < 60.0)
        at = origin + rays * np.where(ground, down, 0.0)[..., None]
        image = np.where(ground, looked_up(draw(seed), at[..., 0] / 0.02, at[..., 1] / 0.02), image)
        if distance is not None:
            ahead = (distance - origin[0]) / rays[..., 0]
            at = origin + rays * np.where(np.isfinite(ahead), ahead, 0.0)[..., None]
            hit = shown & (ahead > 0.0) & (np.abs(at[..., 1]) < width / 2)
            hit &= (at[..., 2] < GROUND + height) & (at[..., 2] > GROUND)
            image = np.where(hit, looked_up(draw(seed + 1), at[..., 1] / 0.01, at[..., 2] / 0.01), image)
    return np.repeat(np.where(shown, image, 0.0).astype(np.uint8)[..., None], 3, axis=2)


def looked_up(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    wrapped = [np.mod(np.nan_to_num(v, posinf=0.0, neginf=0.0), 512.0).astype(np.float32) for v in (x, y)]
    return cv2.remap(values.astype(np.float32), *wrapped, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def state(x: float, yaw: float = 0.0, y: float = 0.0) -> MotionState:
    turn = Rotation.from_euler("z", yaw).as_matrix()
    return MotionState(10**9 + round(x * 1.25e9), np.array([x, y, 0.0]), turn, np.array([0.8, 0, 0]), np.zeros(3))


def drive(camera="pinhole", noise=0.0, stop=1.6, yaw=0.0, **scene):
    """Observations and measured motion of a robot that drives along x, an image every 16 cm.

    Attitudes and positions are measured with ``noise`` times 0.2° and 3 mm, and yaw drifts by 0.3° a second.
    """
    random = np.random.default_rng(3)
    model, camera_pose = CAMERAS[camera], mounted(yaw)
    frames = []
    for x in np.arange(0.0, stop + 0.01, 0.16):
        true = state(float(x))
        image = picture(model, true.odometry_from_base @ camera_pose, **scene)
        off = Rotation.from_euler("z", noise * np.radians(0.3) * x / 0.8) * Rotation.from_rotvec(
            noise * np.radians(0.2) * random.standard_normal(3)
        )
        measured = replace(
            true, rotation=off.as_matrix() @ true.rotation,
            position=true.position + noise * 0.003 * random.standard_normal(3),
        )  # fmt: skip
        frames.append((seen(image, model, camera_pose, measured.stamp), measured))
    return frames


def seen(image, model, camera_pose, stamp):
    return Observation(
        stamp, images={"front": image}, cameras={"front": model}, base_from_cameras={"front": camera_pose}
    )


def standing_after(frames):
    """What stands on the ground in the terrain frame of the last frame ``[rows, columns]`` [m]."""
    stereo = MotionStereo()
    for observation, motion in frames:
        points = stereo.points(observation, motion, GROUND)
    return standing_on(points, motion.terrain_from_base, GROUND, 1.0, GRID).heights, points


def ahead(heights):
    """Places with something on the path, ``|y| < 0.5``, and its heights [m]."""
    rows = np.abs(GRID.y) < 0.5
    columns = np.isfinite(heights[rows]).any(axis=0)
    return GRID.x[columns], heights[rows][:, columns]


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("camera", list(CAMERAS))
@pytest.mark.parametrize("distance", [3.2, 4.4])
def test_a_wall_is_where_it_stands_and_as_high(camera, distance, noise):
    heights, points = standing_after(drive(camera, noise, distance=distance))
    expected = distance - 1.6
    places, tops = ahead(heights)
    assert len(places) >= 2
    # A distance is known to a twentieth, an obstacle of unknown depth is 0.2 m deep, and the matcher's windows are a
    # tenth of the wall's height.
    assert abs(places[0] - expected) < 0.1 + 0.05 * expected
    assert places[-1] < expected + 0.35 + 0.1 * expected
    assert abs(np.nanmedian(tops) - 0.7) < 0.25
    (measured,) = points
    assert np.isfinite(measured.points).all() and (measured.errors > 0.0).all()


def test_errors_are_as_large_as_they_say():
    _, (points,) = standing_after(drive(noise=1.0, distance=4.4))
    offsets = points.points - points.origin
    certain = (points.errors < 0.3) & (points.points[:, 2] < GROUND + 0.5)
    offsets = offsets[certain]
    # Where rays meet the ground or the wall; noise of the last attitude is none of the points'.
    ranges = np.linalg.norm(offsets, axis=1)
    directions = offsets / ranges[:, None]
    with np.errstate(divide="ignore"):
        true = np.fmin(
            np.where(directions[:, 2] < 0.0, (GROUND - points.origin[2]) / directions[:, 2], np.inf),
            (4.4 - 1.6 - points.origin[0]) / directions[:, 0],
        )
    ratio = (ranges - true) / points.errors[certain]
    assert certain.sum() > 1000
    assert np.median(np.abs(ratio)) < 1.5
    assert (np.abs(ratio) < 4.0).mean() > 0.9


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_level_ground_stays_level(added, noise):
    frames = drive(noise=noise)
    _, points = standing_after(frames)
    assert points
    _, maps = added(frames)
    near = torch.from_numpy(np.hypot(*np.meshgrid(GRID.x, GRID.y)) < 3.0)
    for terrain in maps:
        raised = terrain.height > GROUND + 0.05
        assert not (raised & near).any()
        assert raised.sum() < 25


def bricks(_: int) -> np.ndarray:
    """Courses of bricks of 48 by 24 cm."""
    row, column = np.mgrid[:512, :512]
    joints = (row % 12 < 2) | ((column + row // 12 % 2 * 12) % 24 < 2)
    return np.where(joints, 200.0, 110.0)


def curve(yaw_rate=0.4, late=0.0, scale=1.0, tilt=0.0, pitching=0.0, flicker=0.0, draw=texture, seed=21):
    """Observations and measured motion of a robot that drives at 0.8 m/s on level ground, five images a second.

    Args:
        yaw_rate: [rad/s].
        late: time by which images are older than their stamps say [s].
        scale: of odometry's positions.
        tilt: of the camera, more than its calibration says [°].
        pitching: amplitude of the robot's pitch [°].
        flicker: share by which rows are lit differently in each image.
        draw, seed: texture of the ground.
    """
    random, model, calibrated = np.random.default_rng(seed), CAMERAS["pinhole"], mounted()
    true = calibrated.copy()
    true[:3, :3] = calibrated[:3, :3] @ Rotation.from_euler("x", tilt, degrees=True).as_matrix()

    def pose(time):
        angle = yaw_rate * time
        position = 0.8 * time * np.array([np.sinc(angle / np.pi), 0.5 * angle * np.sinc(0.5 * angle / np.pi) ** 2, 0.0])
        pitch = np.radians(pitching) * np.sin(9.0 * time)
        return position, Rotation.from_euler("zy", [angle, pitch])

    frames = []
    for time in 0.2 * np.arange(15):
        position, turn = pose(max(time - late, 0.0))
        base = np.eye(4)
        base[:3, :3], base[:3, 3] = turn.as_matrix(), position
        image = picture(model, base @ true, draw=draw, seed=seed).astype(float)
        image *= 1.0 + flicker * np.sin(np.linspace(0.0, 9.0, model.height) + random.uniform(0.0, 6.0))[:, None, None]
        image = np.clip(image + 2.0 * random.standard_normal(image.shape), 0.0, 255.0).astype(np.uint8)
        position, turn = pose(time)
        noise = Rotation.from_rotvec(np.radians(0.2) * random.standard_normal(3))
        motion = MotionState(
            10**9 + round(time * 1e9), scale * position, (turn * noise).as_matrix(), np.array([0.8, 0.0, 0.0]),
            np.array([0.0, 0.0, yaw_rate]),
        )  # fmt: skip
        frames.append((seen(image, model, calibrated, motion.stamp), motion))
    return frames


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"late": 0.1},
        {"scale": 1.05},
        {"tilt": 1.0},
        {"flicker": 0.15},
        {"draw": bricks},
        {"late": 0.1, "scale": 0.95, "tilt": -1.0, "pitching": 1.0, "flicker": 0.1},
    ],
    ids=["nothing", "late", "scale", "tilt", "flicker", "bricks", "all"],
)
@pytest.mark.parametrize("yaw_rate", [0.0, 0.4], ids=["straight", "curve"])
def test_nothing_stands_on_level_ground_whatever_odometry_says(added, yaw_rate, wrong):
    for seed in (31, 32):
        _, maps = added(curve(yaw_rate=yaw_rate, seed=seed, **wrong))
        assert all((terrain.height < GROUND + 0.1).all() for terrain in maps)


@pytest.mark.parametrize("yaw", [np.pi / 2, np.pi], ids=["left", "back"])
def test_cameras_that_look_aside_or_back_measure_too(yaw):
    heights, points = standing_after(drive(yaw=yaw))
    assert sum(len(part.points) for part in points) > 1000
    assert not np.isfinite(heights).any()


@pytest.mark.parametrize("draw", [stripes, lambda seed: np.full((512, 512), 120.0)], ids=["repeated", "blank"])
def test_repeated_and_blank_textures_make_no_wrong_wall(draw):
    heights, _ = standing_after(drive(draw=draw))
    assert not np.isfinite(heights).any()


def test_images_of_other_places_say_nothing():
    frames = drive(distance=3.2)
    other = drive(distance=2.9, seed=7)
    random = np.random.default_rng(0)
    order = random.permutation(len(frames))
    for images in (
        [other[i][0].images if i % 2 else frames[i][0].images for i in range(len(frames))],
        [frames[i][0].images for i in order],
        [{"front": random.integers(0, 255, (240, 320, 3), np.uint8)} for _ in frames],
        [{"front": np.ascontiguousarray(observation.images["front"][::-1])} for observation, _ in frames],
    ):
        mixed = [(replace(o, images=i), m) for (o, m), i in zip(frames, images, strict=True)]
        heights, _ = standing_after(mixed)
        assert not np.isfinite(heights).any()


def test_an_image_that_does_not_change_is_far_away():
    frames = drive(distance=3.2)
    frozen = [(replace(o, images=frames[0][0].images), m) for o, m in frames]
    heights, _ = standing_after(frozen)
    assert not np.isfinite(heights).any()


@pytest.fixture
def added():
    """Adds what a drive saw to level ground; returns the maps."""
    robot = load_robot("husky")

    def run(frames, obstacles=None):
        level = TerrainMap.flat(GRID, height=GROUND)
        obstacles = obstacles or SeenObstacles(robot, 2e6, GRID)
        return level, [obstacles.added(level, level, observation, motion) for observation, motion in frames]

    return run


def test_a_robot_that_has_not_moved_keeps_its_map(added):
    frames = drive(distance=2.0, stop=0.0) * 5
    level, maps = added([(o, replace(m, stamp=m.stamp + i * 10**8)) for i, (o, m) in enumerate(frames)])
    assert all(terrain is level for terrain in maps)


def test_a_robot_that_stops_keeps_the_wall(added):
    frames = drive(distance=3.2)
    last, motion = frames[-1]
    still = [(last, replace(motion, stamp=motion.stamp + i * 5 * 10**8)) for i in range(1, 7)]
    _, maps = added(frames + still)
    for terrain in maps[-6:]:
        places, _ = ahead(np.where(terrain.height > GROUND + 0.3, terrain.height, np.nan))
        assert len(places) and abs(places[0] - 1.6) < 0.2
        assert torch.equal(terrain.height, terrain.geometric_height)
        assert terrain.observed[terrain.height > GROUND + 0.3].all()


def test_a_wall_too_near_to_be_seen_is_remembered_and_one_that_has_gone_is_not(added):
    robot = load_robot("husky")
    for remains in (True, False):
        obstacles = SeenObstacles(robot, 2e6, GRID)
        frames = drive(distance=2.4)
        model, pose = CAMERAS["pinhole"], mounted()
        _, maps = added(frames, obstacles)
        assert (maps[-1].height > GROUND + 0.3).any()
        # The camera turns away; or it sees the ground behind, where the wall stood.
        further = []
        for index in range(1, 5):
            motion = replace(state(1.6 + 0.02 * index), stamp=frames[-1][1].stamp + index * 2 * 10**8)
            blank = np.full((240, 320, 3), 128, np.uint8)
            image = blank if remains else picture(model, motion.odometry_from_base @ pose)
            further.append((seen(image, model, pose, motion.stamp), motion))
        if not remains:
            # Earlier images without the wall, too.
            further = drive(distance=None)[:-1] + further
            further = [(o, replace(m, stamp=frames[-1][1].stamp + (i + 1) * 10**8)) for i, (o, m) in enumerate(further)]
            further = [(replace(o, stamp=m.stamp), m) for o, m in further]
        _, maps = added(further, obstacles)
        assert bool((maps[-1].height > GROUND + 0.3).any()) == remains


def test_what_is_soft_stops_no_robot():
    robot = load_robot("husky")
    level = TerrainMap.flat(GRID, height=GROUND)
    hedge = replace(level, geometric_height=level.geometric_height + 0.6)
    obstacles = SeenObstacles(robot, 2e6, GRID)
    for observation, motion in drive(distance=3.2):
        terrain = obstacles.added(level, hedge, observation, motion)
    assert (terrain.geometric_height > GROUND + 0.4).any()
    assert (terrain.height < GROUND + 0.15).all()


def test_unusable_images_and_jumps_of_odometry_are_left_out():
    frames = drive(distance=3.2)
    stereo = MotionStereo()
    for observation, motion in frames[:-1]:
        stereo.points(observation, motion, GROUND)
    last, motion = frames[-1]
    assert not stereo.points(replace(last, cameras={}), motion, GROUND)
    assert not stereo.points(replace(last, images={"front": last.images["front"][::2]}), motion, GROUND)
    assert stereo.points(last, motion, GROUND)
    assert not stereo.points(last, replace(motion, position=motion.position + 50.0), GROUND)
    changed = replace(CAMERAS["pinhole"], matrix=MATRIX * [[1.1], [1.1], [1.0]])
    again = MotionStereo()
    for observation, state_ in frames[:-1]:
        again.points(observation, state_, GROUND)
    assert not again.points(replace(last, cameras={"front": changed}), motion, GROUND)


def test_a_robot_that_hardly_moves_uses_its_points_again():
    frames = drive(distance=3.2)
    stereo = MotionStereo()
    for observation, motion in frames:
        points = stereo.points(observation, motion, GROUND)
    (measured,) = points
    step = np.array([0.05, 0.0, 0.0])
    blank = replace(observation, images={"front": np.full((240, 320, 3), 128, np.uint8)})
    turn = Rotation.from_euler("z", 0.3).as_matrix()
    moved = replace(motion, stamp=motion.stamp + 10**8, position=motion.position + step, rotation=turn)
    (again,) = stereo.points(blank, moved, GROUND)
    assert np.allclose(again.points, (measured.points - step) @ turn)
    assert np.allclose(again.origin, (measured.origin - step) @ turn)
    assert not stereo.points(blank, replace(moved, stamp=motion.stamp + 6 * 10**8), GROUND)


def test_displacements_and_ranges_of_a_pair_agree():
    image = PinholeImage(np.zeros((240, 320), np.uint8), np.full((240, 320), 255, np.uint8), MATRIX)
    turn = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
    for translation in ([0.0, 0.1, 0.8], [0.9, 0.0, 0.1], [0.1, 0.0, -0.7]):
        pair = EpipolarPair(image, image, turn, np.array(translation), np.array([0.0, 1.0, 0.2]), 0.6)
        rows, columns = np.nonzero(pair.seen)
        moved = pair.displacement(np.full(pair.seen.shape, 3.0, np.float32))[rows, columns]
        ranges, change = pair.ranges(columns, moved)
        assert np.allclose(ranges, 3.0, rtol=1e-3)
        assert (change > 0.0).all()
        # A point's pixel in the earlier image is that of its displaced cell.
        points = pair.directions(rows, columns) * 3.0 + translation
        seen_from = points @ turn.T
        u = np.log(
            np.tan(0.5 * np.arccos(np.clip((points / np.linalg.norm(points, axis=1)[:, None]) @ pair.axes[2], -1, 1)))
        )
        assert np.allclose((u - pair.u[0]) / pair.step, columns - moved, atol=0.02)
        assert np.isfinite(seen_from).all()


def test_a_fisheye_is_straightened_and_its_border_left_out():
    camera = CAMERAS["fisheye"]
    found = pinhole_image(picture(camera, state(0.0).odometry_from_base @ mounted(), distance=2.0), camera)
    assert found.pixels.shape == (240, 320) and found.seen.dtype == np.uint8
    assert found.pixels[found.seen == 0].max(initial=0) == 0


def test_a_robot_that_drives_sees_a_simulated_wall(one_thread):
    robot = load_robot("husky")
    systems = {judged.title: judged for judged in wall.driving_systems(robot)}
    found = wall.driving_scene(AHEAD_KINDS[0], 433_502)
    assert found.stops
    driven = {
        name: wall.distance(wall.predicted_after(systems[f"images, driving{name}"], robot, found))
        for name in ("", ", motion stereo", ", as the node uses them")
    }
    assert driven[""] > found.driven + wall.FOUND_WITHIN
    for name in (", motion stereo", ", as the node uses them"):
        assert abs(driven[name] - found.driven) < wall.FOUND_WITHIN


def test_a_lidar_beside_the_camera_measures_what_stands(one_thread):
    """With a sweep maps are as without motion stereo; when it is gone, the images that were kept count."""
    robot = load_robot("husky")
    frames = drive(distance=3.2)
    x, y = np.meshgrid(np.arange(-6.0, 6.0, 0.08), np.arange(-6.0, 6.0, 0.08))
    cloud = np.stack([x, y, np.full_like(x, GROUND)], axis=-1).reshape(-1, 3).astype(np.float32)
    cloud = cloud[np.hypot(cloud[:, 0], cloud[:, 1]) > 1.0]
    sources = [
        choose_terrain_source("lidar_camera", robot, fallback=True, motion_stereo=stereo) for stereo in (True, False)
    ]
    for observation, motion in frames[:-2]:
        with_stereo, without = (s.terrain(replace(observation, cloud=cloud), motion) for s in sources)
        assert torch.equal(with_stereo.height, without.height)
    # What stands is seen from two places.
    for observation, motion in frames[-2:]:
        with_stereo, without = (s.terrain(observation, motion) for s in sources)
    assert (with_stereo.height > GROUND + 0.3).any()
    assert not (without.height > GROUND + 0.3).any()
