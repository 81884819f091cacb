"""Recording: drives a robot through a world and writes what its sensors say into a bag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from monoforce_ros.bags import BagWriter, builders
from monoforce_ros.synthetic.command_profile import CommandProfile, make_profile
from monoforce_ros.synthetic.labels import world_labels, write_labels
from monoforce_ros.synthetic.random_streams import DEFAULT_SEED, random_stream
from monoforce_ros.synthetic.scenery import Scenery, build_scenery
from monoforce_ros.synthetic.sensors import Camera, CameraSettings, Imu, ImuSettings, Lidar, LidarSettings, encode_jpeg
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import TIME_STEP, build_model

START_STAMP = 1_700_000_000 * 10**9
"""Stamp of the first message [ns]."""
ODOM_FRAME = "odom"
LIDAR_FRAME = "lidar"
IMU_FRAME = "imu_link"
CAMERA_PREFIX = "camera"

_ODOMETRY_RATE = 50.0
_COMMAND_RATE = 20.0
_STEPS_PER_CHECK = 50


@dataclass(frozen=True, kw_only=True)
class RecordingSettings:
    """What to record.

    Attributes:
        seed: of the world, the drive and the sensors' noise; each has its own random stream, so that the trajectory
            does not depend on which sensors record it.
        duration: [s].
        robot: name or YAML file.
        commands: ``random``, ``straight``, ``circle`` or a CSV file with the columns t,v,w.
        terrain: the ground.
        camera: settings of every camera of the robot, or None to record no images.
        lidar: settings, or None to record no clouds.
        imu: settings.
        storage: ``mcap`` or ``sqlite3``.
        labels: write the world's truth beside the bag.
        overwrite: replace an existing bag.
    """

    seed: int = DEFAULT_SEED
    duration: float = 10.0
    robot: str = "husky"
    commands: str = "random"
    terrain: TerrainSettings = field(default_factory=TerrainSettings)
    camera: CameraSettings | None = field(default_factory=CameraSettings)
    lidar: LidarSettings | None = field(default_factory=LidarSettings)
    imu: ImuSettings = field(default_factory=ImuSettings)
    storage: str = "mcap"
    labels: bool = False
    overwrite: bool = False

    def __post_init__(self):
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed: got {self.seed}, expected 0 to {2**32 - 1}")
        if not 0.1 <= self.duration <= 3600.0:
            raise ValueError(f"duration: got {self.duration}, expected 0.1 to 3600 s")


@dataclass(frozen=True)
class Summary:
    """What came of a recording.

    Attributes:
        duration: recorded [s].
        distance: driven [m].
        mishap: why the drive ended early, or None.
        messages: number of messages by topic.
    """

    duration: float
    distance: float
    mishap: str | None
    messages: dict[str, int]


def record(out: Path, settings: RecordingSettings, progress: Callable[[float], None] = lambda seconds: None) -> Summary:
    """Simulate a drive and write it as a bag.

    Poses are those of the base frame in the odom frame, which is the world frame shifted to where the robot starts; see
    ``Simulation``. Stamps start at ``START_STAMP`` and follow the simulated time.

    Args:
        out: folder of the bag.
        settings: what to record.
        progress: called with the simulated seconds [s] since its last call.

    Raises:
        FileExistsError: the bag exists and ``overwrite`` is off.
        DrawingError: images are asked for and nothing can draw them.
        RobotFileError: the robot's file is unusable.
        ValueError: a setting is.
    """
    robot = Vehicle.load(settings.robot)
    with BagWriter(out, storage=settings.storage, overwrite=settings.overwrite) as bag:
        scenery = build_scenery(settings.terrain, settings.seed)
        profile = make_profile(settings.commands, scenery.route, random_stream(settings.seed, "commands"))
        drive = _Drive(bag, settings, robot, scenery, profile)
        try:
            summary = drive.run(progress)
        finally:
            drive.close()
        if settings.labels:
            write_labels(out, world_labels(scenery, drive.simulation.odom_origin))
    return summary


class _Drive:
    """One recording: a simulation and the sensors that watch it."""

    def __init__(
        self, bag: BagWriter, settings: RecordingSettings, robot: Vehicle, scenery: Scenery, profile: CommandProfile
    ):
        self._bag, self._settings, self._robot, self._profile = bag, settings, robot, profile
        view, lidar_pose = {}, None
        if settings.camera is not None:
            frames = [frame for frame in robot.sensors if frame.startswith(CAMERA_PREFIX)]
            if not frames:
                robot.sensor(f"{CAMERA_PREFIX}_front", "--camera none")
            view = dict.fromkeys(frames, settings.camera.vertical_field_of_view)
        if settings.lidar is not None:
            lidar_pose = robot.sensor(LIDAR_FRAME, "--lidar none")
        model = build_model(scenery, robot, settings.seed, view)
        self.simulation = Simulation(model, scenery, robot)
        self._imu = Imu(settings.imu, random_stream(settings.seed, "imu"))
        self._imu.add(self.simulation.data)
        self._tasks: list[tuple[float, Callable[[], None]]] = [
            (_COMMAND_RATE, self._write_command),
            (_ODOMETRY_RATE, self._write_odometry),
            (_ODOMETRY_RATE, self._write_wheels),
            (settings.imu.rate, self._write_imu),
        ]
        if settings.lidar is not None:
            self._lidar = Lidar(model, lidar_pose, settings.lidar, random_stream(settings.seed, "lidar"))
            self._tasks.append((settings.lidar.rate, self._write_cloud))
        self._cameras = [Camera(model, frame, settings.camera) for frame in view]
        if self._cameras:
            self._tasks.append((settings.camera.rate, self._write_images))
        self._messages: dict[str, int] = {}

    @property
    def _stamp(self) -> int:
        return START_STAMP + round(self.simulation.time * 1e9)

    def close(self) -> None:
        """Free the cameras' graphics library."""
        for camera in self._cameras:
            camera.close()

    def run(self, progress: Callable[[float], None]) -> Summary:
        """Drive until the end, or until something goes wrong, which is not recorded any more."""
        simulation = self.simulation
        written = [0] * len(self._tasks)
        distance, last_position, reported, mishap = 0.0, np.zeros(3), 0.0, None
        self._write("/tf_static", builders.static_transforms(self._stamp, self._robot.base_frame, self._robot.sensors))
        while True:
            for index, (rate, write) in enumerate(self._tasks):
                if simulation.time * rate >= written[index] - 1e-6:
                    write()
                    written[index] += 1
            if simulation.time >= self._settings.duration - TIME_STEP / 2:
                break
            simulation.step()
            self._imu.add(simulation.data)
            if simulation.steps % _STEPS_PER_CHECK == 0:
                mishap = simulation.mishap()
                if mishap is not None:
                    break
                position = simulation.state().position
                distance, last_position = distance + float(np.linalg.norm(position - last_position)), position
                progress(simulation.time - reported)
                reported = simulation.time
        progress(simulation.time - reported)
        return Summary(simulation.time, distance, mishap, self._messages)

    def _write(self, topic: str, message: object) -> None:
        self._bag.write(topic, message, self._stamp)
        self._messages[topic] = self._messages.get(topic, 0) + 1

    def _write_command(self) -> None:
        state = self.simulation.state()
        position = (state.position + self.simulation.odom_origin)[:2]
        forward, yaw_rate = self._profile.command(self.simulation.time, position, state.heading)
        self.simulation.drive(forward, yaw_rate)
        self._write("/cmd_vel", builders.twist_stamped(self._stamp, self._robot.base_frame, forward, yaw_rate))

    def _write_odometry(self) -> None:
        state = self.simulation.state()
        motion = (state.position, state.quaternion, state.linear_velocity, state.angular_velocity)
        self._write("/odom", builders.odometry(self._stamp, ODOM_FRAME, self._robot.base_frame, *motion))

    def _write_wheels(self) -> None:
        names = [wheel.joint for wheel in self._robot.wheels]
        self._write("/joint_states", builders.joint_state(self._stamp, names, *self.simulation.wheel_states()))

    def _write_imu(self) -> None:
        self._write("/imu/data", builders.imu(self._stamp, IMU_FRAME, *self._imu.read()))

    def _write_cloud(self) -> None:
        self.simulation.update_kinematics()
        points = self._lidar.scan(self.simulation.data, self.simulation.world_pose())
        self._write("/points", builders.point_cloud(self._stamp, LIDAR_FRAME, points))

    def _write_images(self) -> None:
        self.simulation.update_kinematics()
        for camera in self._cameras:
            view = camera.settings
            data = encode_jpeg(camera.capture(self.simulation.data), view.quality)
            image = builders.compressed_image(self._stamp, camera.frame, "jpeg", data)
            info = builders.camera_info(self._stamp, camera.frame, view.width, view.height, view.matrix, [0.0] * 5)
            self._write(f"/{camera.frame}/image_raw/compressed", image)
            self._write(f"/{camera.frame}/camera_info", info)
