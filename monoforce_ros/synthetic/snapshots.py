"""Snapshots: what a robot sees from random places of a randomised world, with the world's true surfaces.

A recording shows one route of a world; for pretraining many worlds and many places in each count more than motion.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core import CameraModel
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.labels import world_labels
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.synthetic.recorded_camera import RecordedCamera
from monoforce_ros.synthetic.sensors import Camera, Lidar, LidarSettings, encode_jpeg
from monoforce_ros.synthetic.terrain_shape import HeightField
from monoforce_ros.synthetic.varied.settings import WorldSettings
from monoforce_ros.synthetic.varied.world import VariedWorld, draw_world
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import build_model

_OFF_TRACK = 1.5
"""Largest distance from the track at which the robot is placed [m]: obstacles stand beside the track."""
_STEEPEST = math.radians(25.0)
"""Largest tilt at which the robot is placed."""
_FACING = 0.4
"""Share of the places from which the robot faces an obstacle: few places along a track do."""
_FACED_FROM, _FACED_TO = 0.8, 6.0
"""Range of the distances to that obstacle, of which the logarithm is uniform [m]."""
_FACED_ASIDE = 0.3
"""Standard deviation of the heading towards it [rad]."""
_STANDS_OUT, _STANDS_OUT_REACH = 0.3, 0.3
"""Height of an obstacle above the lowest ground nearby [m]; distance that is nearby [m]."""
_UNEVEN = 0.12
"""Largest height difference between the ground under a wheel and the plane under all wheels [m]; the robot would not
rest like that."""
_TRACE_LENGTH, _TRACE_STEP = 6.0, 0.15
"""Length of the path that the robot has come along, and distance of its points [m]."""
_TIGHTEST = 1.0
"""Smallest radius of that path [m]."""
_ATTEMPTS = 30
"""Random places tried for each snapshot."""


@dataclass(frozen=True)
class Snapshot:
    """Sensor data at one place; poses are in the world frame, z up."""

    world_from_base: np.ndarray
    """``[4, 4]``."""
    images: tuple[np.ndarray, ...]
    """RGB uint8, one per camera."""
    sweep: np.ndarray
    """Lidar points ``[n, 3]`` in the world frame [m], ring by ring."""
    trace: np.ndarray
    """Ground under the wheels along the path that led to this place ``[k, 3]`` [m]; empty if there is none."""


@dataclass(frozen=True)
class WorldSnapshots:
    """Snapshots of one world, and its true surfaces."""

    robot: str
    """Name of the robot's file."""
    cameras: tuple[CameraModel, ...]
    base_from_cameras: np.ndarray
    """``[cameras, 4, 4]``."""
    snapshots: tuple[Snapshot, ...]
    labels: dict[str, np.ndarray]
    """As :func:`monoforce_ros.synthetic.labels.world_labels`, in the world frame."""


def take_snapshots(
    settings: WorldSettings,
    seed: int,
    count: int,
    lidar: LidarSettings = LidarSettings(rings=32, columns=512, range_noise=0.01),  # noqa: B008  (frozen)
) -> WorldSnapshots:
    """Place the robot of a randomised world at random places and record its sensors.

    Most places lie along the track and up to 1.5 m beside it, with any heading; the others face an obstacle. Fewer than
    ``count`` snapshots result where a world has few places at which a robot can stand.

    Args:
        settings: ranges that the world is drawn from.
        seed: seed of the world.
        count: number of places.
        lidar: settings of the lidar.

    Raises:
        DrawingError: no graphics library can render images.
    """
    world = draw_world(settings, seed)
    robot = world.robot()
    rig = world.rig(robot)
    sensors = {name: pose for name, pose in robot.sensors.items() if not name.startswith("camera")}
    robot = dataclasses.replace(robot, sensors=sensors | {camera.frame: camera.pose for camera in rig})
    random = random_stream(seed, "snapshots")
    model = build_model(
        world.scenery, robot, seed, {entry.frame: entry.settings.vertical_field_of_view for entry in rig}, ()
    )
    data = mujoco.MjData(model)
    labels = world_labels(world.scenery, np.zeros(3))
    support = HeightField(labels["support_height"], float(labels["resolution"]), labels["origin"])
    obstacles = _obstacle_cells(labels, world.scenery.route.points)
    places = []
    for _ in range(count):
        faced = obstacles if len(obstacles) and random.uniform() < _FACING else None
        place = _standing_place(world, robot, support, random, faced)
        if place is not None:
            places.append(place)
    views: list[list[np.ndarray]] = [[] for _ in places]
    # One camera after the other: each holds a renderer of the whole world.
    for entry in rig:
        camera = Camera(model, entry.frame, entry.settings, entry.imaging)
        try:
            for images, place in zip(views, places, strict=True):
                _move(model, data, place)
                images.append(_compressed(camera.capture(data), entry.settings.quality))
        finally:
            camera.close()
    pose = robot.sensors.get(robot.lidar_frame)
    scanner = None if pose is None else Lidar(model, pose, lidar, random_stream(seed, "lidar"))
    snapshots = []
    for images, place in zip(views, places, strict=True):
        sweep = np.zeros((0, 3))
        if scanner is not None and pose is not None:
            _move(model, data, place)
            at = place @ pose
            sweep = scanner.scan(data, place) @ at[:3, :3].T + at[:3, 3]
        snapshots.append(Snapshot(place, tuple(images), sweep, _trace(place, robot, support, random)))
    return WorldSnapshots(
        robot=robot.name,
        cameras=tuple(_model(entry) for entry in rig),
        base_from_cameras=np.array([entry.pose for entry in rig]),
        snapshots=tuple(snapshots),
        labels=labels,
    )


def _obstacle_cells(labels: dict[str, np.ndarray], route: np.ndarray) -> np.ndarray:
    """Positions ``[n, 2]`` [m] of cells that stand out of the ground, obstacles and tall grass, near the route."""
    heights, resolution = labels["visible_height"], float(labels["resolution"])
    window = np.ones((2 * round(_STANDS_OUT_REACH / resolution) + 1,) * 2, np.uint8)
    rows, columns = np.nonzero(heights - cv2.erode(heights, window) > _STANDS_OUT)
    cells = np.column_stack([columns, rows]) * resolution + labels["origin"]
    reach = _FACED_TO + _OFF_TRACK
    near = (cells > route.min(axis=0) - reach).all(axis=1) & (cells < route.max(axis=0) + reach).all(axis=1)
    return cells[near]


def _standing_place(
    world: VariedWorld, robot: Vehicle, support: HeightField, random: np.random.Generator, faced: np.ndarray | None
) -> np.ndarray | None:
    """Pose ``[4, 4]`` of a robot at rest, world ← base; None if no place was found.

    It faces one of the positions ``faced`` ``[n, 2]`` if there are any.
    """
    route = world.scenery.route
    for _ in range(_ATTEMPTS):
        heading = random.uniform(-math.pi, math.pi)
        if faced is None:
            along = random.uniform(0.0, 1.0)
            middle = route.points[int(along * (len(route.points) - 1))]
            xy = middle + random.uniform(-_OFF_TRACK, _OFF_TRACK, 2)
        else:
            distance = math.exp(random.uniform(math.log(_FACED_FROM), math.log(_FACED_TO)))
            towards = np.array([math.cos(heading), math.sin(heading)])
            xy = faced[random.integers(len(faced))] - distance * towards
            heading += random.normal(0.0, _FACED_ASIDE)
        pose = _resting_pose(robot, support, xy, heading)
        if pose is not None:
            return pose
    return None


def _resting_pose(robot: Vehicle, support: HeightField, xy: np.ndarray, heading: float) -> np.ndarray | None:
    """Pose ``[4, 4]`` at a place on the plane through the ground under the wheels; None if it cannot rest there."""
    if not support.contains(xy, 3.0):
        return None
    turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    wheels = np.array([wheel.centre[:2] for wheel in robot.wheels])
    bottoms = np.array([wheel.centre[2] - wheel.radius for wheel in robot.wheels])
    touching = bottoms < bottoms.min() + 0.02
    under = wheels[touching] @ turn.T + xy
    ground = support.height_at(under)
    system = np.column_stack([wheels[touching], np.ones(touching.sum())])
    (slope_x, slope_y, height), *_ = np.linalg.lstsq(system, ground, rcond=None)
    if np.abs(system @ [slope_x, slope_y, height] - ground).max() > _UNEVEN:
        return None
    if math.hypot(slope_x, slope_y) > math.tan(_STEEPEST):
        return None
    ahead = np.array([turn[0, 0], turn[1, 0], slope_x])
    left = np.array([turn[0, 1], turn[1, 1], slope_y])
    up = np.cross(ahead, left)
    axes = np.stack([ahead / np.linalg.norm(ahead), np.cross(up, ahead), up], axis=1)
    axes[:, 1:] /= np.linalg.norm(axes[:, 1:], axis=0)
    pose = np.eye(4)
    pose[:3, :3] = axes
    pose[:3, 3] = np.array([*xy, height]) - bottoms.min() * axes[:, 2]
    return None if _body_in_ground(robot, support, pose) else pose


def _body_in_ground(robot: Vehicle, support: HeightField, pose: np.ndarray) -> bool:
    """Whether the ground reaches more than 5 cm into the hull."""
    for centre, size in robot.hull:
        x, y = (np.linspace(-0.5, 0.5, max(2, math.ceil(edge / 0.1))) * edge for edge in size[:2])
        below = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), -size[2] / 2 + 0.05)], axis=-1).reshape(-1, 3)
        points = (below + centre) @ pose[:3, :3].T + pose[:3, 3]
        if (support.height_at(points[:, :2]) > points[:, 2]).any():
            return True
    return False


def _move(model: mujoco.MjModel, data: mujoco.MjData, pose: np.ndarray) -> None:
    mujoco.mj_resetData(model, data)
    data.qpos[:3] = pose[:3, 3]
    data.qpos[3:7] = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


def _trace(place: np.ndarray, robot: Vehicle, support: HeightField, random: np.random.Generator) -> np.ndarray:
    """Ground under the wheels ``[k, 3]`` along an arc that ends at a place, of random length and curvature.

    The arc ends where the robot could not have stood.
    """
    length = random.uniform(0.0, _TRACE_LENGTH) if random.uniform() < 0.8 else 0.0
    curvature, backwards = random.uniform(-1.0, 1.0) / _TIGHTEST, -1.0 if random.uniform() < 0.85 else 1.0
    heading, xy = math.atan2(place[1, 0], place[0, 0]), place[:2, 3].copy()
    sides = np.array([wheel.side for wheel in robot.wheels])
    offsets = np.array([sides.min(), sides.max()])
    points = []
    for _ in range(int(length / _TRACE_STEP)):
        xy = xy + backwards * _TRACE_STEP * np.array([math.cos(heading), math.sin(heading)])
        heading += backwards * _TRACE_STEP * curvature
        pose = _resting_pose(robot, support, xy, heading)
        if pose is None:
            break
        across = xy + offsets[:, None] * np.array([-math.sin(heading), math.cos(heading)])
        points.append(np.column_stack([across, support.height_at(across)]))
    return np.concatenate(points) if points else np.zeros((0, 3))


def _compressed(image: np.ndarray, quality: int) -> np.ndarray:
    """The image after JPEG compression."""
    decoded = cv2.imdecode(np.frombuffer(encode_jpeg(image, quality), np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None, "encoded above"
    return np.ascontiguousarray(decoded[..., ::-1])


def _model(camera: RecordedCamera) -> CameraModel:
    settings = camera.settings
    distortion = np.array(settings.distortion or [0.0] * 5, float)
    return CameraModel(
        settings.width, settings.height, settings.matrix, distortion, settings.distortion_model, camera.frame
    )
