"""LiveWorld: a simulated robot that obeys commands as they come, and what its sensors say meanwhile."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from monoforce_ros.bags import builders
from monoforce_ros.synthetic.course import CourseSettings, build_course
from monoforce_ros.synthetic.odometry import Odometry, OdometrySettings
from monoforce_ros.synthetic.random_streams import DEFAULT_SEED, random_stream
from monoforce_ros.synthetic.recording import CAMERA_PREFIX, LIDAR_FRAME, ODOM_FRAME
from monoforce_ros.synthetic.scenery import build_scenery
from monoforce_ros.synthetic.sensors import Camera, CameraSettings, Lidar, LidarSettings, encode_jpeg
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import build_model


@dataclass(frozen=True, kw_only=True)
class LiveSettings:
    """What is simulated."""

    seed: int = DEFAULT_SEED
    robot: str = "husky"
    terrain: TerrainSettings = field(default_factory=TerrainSettings)
    course: CourseSettings | None = None
    """A test track in place of the terrain's world."""
    camera: CameraSettings | None = None
    """None draws no images."""
    lidar: LidarSettings | None = field(default_factory=LidarSettings)
    """None casts no rays."""
    odometry: OdometrySettings = field(default_factory=OdometrySettings)


class LiveWorld:
    """A world that goes on as long as it is asked to.

    Raises:
        RobotFileError, DrawingError, ValueError: as :func:`monoforce_ros.synthetic.recording.record`.
    """

    def __init__(self, settings: LiveSettings):
        self.settings = settings
        self.robot = Vehicle.load(settings.robot)
        if settings.course is not None:
            scenery = build_course(settings.course, settings.seed)
        else:
            scenery = build_scenery(settings.terrain, settings.seed)
        frames = [frame for frame in self.robot.sensors if frame.startswith(CAMERA_PREFIX)] if settings.camera else []
        view = {frame: settings.camera.vertical_field_of_view for frame in frames} if settings.camera else {}
        model = build_model(scenery, self.robot, settings.seed, view, ())
        self.simulation = Simulation(model, scenery, self.robot, ())
        self.route = scenery.route.points - self.simulation.odom_origin[:2]
        """The world's track in the odometry frame ``[n, 2]`` [m]."""
        self._odometry = Odometry(settings.odometry, random_stream(settings.seed, "odometry"), ())
        self._lidar = None
        if settings.lidar is not None:
            pose = self.robot.sensor(LIDAR_FRAME, "--lidar none")
            self._lidar = Lidar(model, pose, settings.lidar, random_stream(settings.seed, "lidar"))
        self._cameras = [Camera(model, frame, settings.camera) for frame in view]

    def close(self) -> None:
        """Free the cameras' graphics library."""
        for camera in self._cameras:
            camera.close()

    @property
    def time(self) -> float:
        """Simulated [s]."""
        return self.simulation.time

    def advance(self, until: float) -> None:
        """Simulate up to a time [s]."""
        while self.simulation.time < until:
            self.simulation.step()

    def odometry(self, stamp: int) -> object:
        """``nav_msgs/Odometry`` of now."""
        state = self._odometry.read(self.simulation.state())
        motion = (state.position, state.quaternion, state.linear_velocity, state.angular_velocity)
        return builders.odometry(stamp, ODOM_FRAME, self.robot.base_frame, *motion)

    def cloud(self, stamp: int) -> object | None:
        """``sensor_msgs/PointCloud2`` of now; None without a lidar."""
        if self._lidar is None:
            return None
        self.simulation.update_kinematics()
        points = self._lidar.start(self.simulation.data, self.simulation.world_pose())()
        return builders.point_cloud(stamp, LIDAR_FRAME, np.asarray(points))

    def images(self, stamp: int) -> Iterator[tuple[str, object, object]]:
        """Frame, image and ``CameraInfo`` of every camera, now."""
        self.simulation.update_kinematics()
        for camera in self._cameras:
            view, frame = camera.settings, camera.frame
            data = encode_jpeg(camera.capture(self.simulation.data).copy(), view.quality)
            lens = view.distortion or [0.0] * 5
            info = builders.camera_info(stamp, frame, view.width, view.height, view.matrix, lens)
            yield frame, builders.compressed_image(stamp, frame, "jpeg", data), info
