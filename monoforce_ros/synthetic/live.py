"""LiveWorld: a simulated robot and its sensors, stepped and commanded by the caller."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from monoforce_ros.bags import builders
from monoforce_ros.synthetic.course import CourseSettings, build_course
from monoforce_ros.synthetic.odometry import Odometry, OdometrySettings
from monoforce_ros.synthetic.random_streams import DEFAULT_SEED, random_stream
from monoforce_ros.synthetic.recording import CAMERA_PREFIX, ODOM_FRAME
from monoforce_ros.synthetic.scenery import Scenery, build_scenery
from monoforce_ros.synthetic.sensors import Camera, CameraSettings, Lidar, LidarSettings, encode_jpeg
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import build_model


@dataclass(frozen=True, kw_only=True)
class LiveSettings:
    """Settings of a live simulation."""

    seed: int = DEFAULT_SEED
    robot: str = "husky"
    terrain: TerrainSettings = field(default_factory=TerrainSettings)
    course: CourseSettings | None = None
    """An obstacle course instead of the terrain's world."""
    scenery: Scenery | None = None
    """A world that was laid out already, instead of the terrain's or the course's."""
    camera: CameraSettings | None = None
    """None renders no images."""
    lidar: LidarSettings | None = field(default_factory=LidarSettings)
    """None simulates no lidar."""
    odometry: OdometrySettings = field(default_factory=OdometrySettings)


class LiveWorld:
    """A simulation that runs as far as :meth:`advance` is called.

    Raises:
        RobotFileError, DrawingError, ValueError: as :func:`monoforce_ros.synthetic.recording.record`.
    """

    def __init__(self, settings: LiveSettings):
        self.settings = settings
        self.robot = Vehicle.load(settings.robot)
        if settings.scenery is not None:
            scenery = settings.scenery
        elif settings.course is not None:
            scenery = build_course(settings.course, settings.seed)
        else:
            scenery = build_scenery(settings.terrain, settings.seed)
        fields_of_view: dict[str, float] = {}
        if settings.camera is not None:
            frames = [frame for frame in self.robot.sensors if frame.startswith(CAMERA_PREFIX)]
            fields_of_view = dict.fromkeys(frames, settings.camera.vertical_field_of_view)
        model = build_model(scenery, self.robot, settings.seed, fields_of_view, ())
        self.simulation = Simulation(model, scenery, self.robot, ())
        self.route = scenery.route.points - self.simulation.odom_origin[:2]
        """The world's track in the odometry frame ``[n, 2]`` [m]."""
        self._odometry = Odometry(settings.odometry, random_stream(settings.seed, "odometry"), ())
        self._lidar = None
        if settings.lidar is not None:
            pose = self.robot.sensor(self.robot.lidar_frame, "--lidar none")
            self._lidar = Lidar(model, pose, settings.lidar, random_stream(settings.seed, "lidar"))
        self._cameras: list[Camera] = []
        if settings.camera is not None:
            self._cameras = [Camera(model, frame, settings.camera) for frame in fields_of_view]

    def close(self) -> None:
        """Free the cameras' graphics library."""
        for camera in self._cameras:
            camera.close()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.simulation.time

    def advance(self, until: float) -> None:
        """Simulate up to a time [s]."""
        while self.simulation.time < until:
            self.simulation.step()

    def odometry(self, stamp: int) -> object:
        """Current ``nav_msgs/Odometry``."""
        state = self._odometry.read(self.simulation.state())
        motion = (state.position, state.quaternion, state.linear_velocity, state.angular_velocity)
        return builders.odometry(stamp, ODOM_FRAME, self.robot.base_frame, *motion)

    def joint_states(self, stamp: int) -> object | None:
        """Current ``sensor_msgs/JointState`` of wheels, steering, casters and flippers; None if only wheels move."""
        if not (self.robot.servos or self.robot.casters):
            return None
        return builders.joint_state(stamp, self.simulation.joint_names, *self.simulation.joint_states())

    def cloud(self, stamp: int) -> object | None:
        """Current ``sensor_msgs/PointCloud2``; None without a lidar."""
        if self._lidar is None:
            return None
        self.simulation.update_kinematics()
        points = self._lidar.start(self.simulation.data, self.simulation.world_pose())()
        return builders.point_cloud(stamp, self.robot.lidar_frame, np.asarray(points))

    def images(self, stamp: int) -> Iterator[tuple[str, object, object]]:
        """Frame, current image and ``CameraInfo`` of every camera."""
        self.simulation.update_kinematics()
        for camera in self._cameras:
            settings, frame = camera.settings, camera.frame
            data = encode_jpeg(camera.capture(self.simulation.data).copy(), settings.quality)
            distortion = settings.distortion or [0.0] * 5
            info = builders.camera_info(stamp, frame, settings.width, settings.height, settings.matrix, distortion)
            yield frame, builders.compressed_image(stamp, frame, "jpeg", data), info
