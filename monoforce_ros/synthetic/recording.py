"""Recording: simulate a robot in a world and write its sensor data to a bag."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.bags import BagWriter, builders
from monoforce_ros.core import write_text
from monoforce_ros.synthetic.command_profile import CommandProfile, make_profile
from monoforce_ros.synthetic.fault import Fault
from monoforce_ros.synthetic.faults import VegetationDrag
from monoforce_ros.synthetic.flipper_program import HOLD, make_flipper_program
from monoforce_ros.synthetic.hidden import write_truth
from monoforce_ros.synthetic.labels import world_labels, write_labels
from monoforce_ros.synthetic.odometry import Odometry, OdometrySettings
from monoforce_ros.synthetic.random_streams import DEFAULT_SEED, random_stream
from monoforce_ros.synthetic.recorded_camera import RecordedCamera
from monoforce_ros.synthetic.scenery import Scenery, build_scenery
from monoforce_ros.synthetic.sensors import Camera, CameraSettings, Imu, ImuSettings, Lidar, LidarSettings, encode_jpeg
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.terrain_shape import TerrainSettings
from monoforce_ros.synthetic.varied.settings import WorldSettings
from monoforce_ros.synthetic.varied.world import draw_world
from monoforce_ros.synthetic.vehicle import Vehicle
from monoforce_ros.synthetic.world import TIME_STEP, build_model

START_STAMP = 1_700_000_000 * 10**9
"""Stamp of the first message [ns]."""
ODOM_FRAME = "odom"
IMU_FRAME = "imu_link"
CAMERA_PREFIX = "camera"

_WHEEL_RATE = 50.0
# Yaw of each camera on the robot, relative to the front camera [rad].
_SIDES = {"front": 0.0, "left": math.pi / 2, "right": -math.pi / 2, "rear": math.pi}
_COMMAND_RATE = 20.0
_STEPS_PER_CHECK = 50
_LONGEST_OUTBOX = 500


@dataclass(frozen=True, kw_only=True)
class RecordingSettings:
    """Settings of a recording.

    Attributes:
        seed: seed of world, commands and sensor noise; each has its own random stream, so that the trajectory does not
            depend on the recorded sensors.
        duration: [s].
        robot: name or YAML file.
        commands: ``random``, ``steps``, ``sweep``, ``straight``, ``circle``, ``spin``, ``crab`` or a CSV file with the
            columns t,v,w or t,v,w,y.
        command_type: ``twist``, or ``ackermann`` to record steering angles as AckermannDriveStamped.
        flippers: ``hold``, ``steps`` or a CSV file with the columns t and names of flippers.
        terrain: the ground.
        camera: settings of every camera, or None to record no images.
        cameras: number of cameras, one to four: front, left, right and rear. A camera that the robot file lacks is the
            front camera turned about the base frame's z axis. By default those of the robot file.
        lidar: settings, or None to record no clouds.
        imu: settings.
        odometry: settings.
        hidden: injected faults; the ground truth goes to a file next to the bag and not into it. None writes no file.
        storage: ``mcap`` or ``sqlite3``.
        labels: write the world's ground truth next to the bag.
        overwrite: replace an existing bag.
        world: ranges that a randomised world is drawn from, with its robot and cameras; ``robot``, ``terrain``,
            ``cameras`` and the settings of ``camera`` then have no effect, and ``commands`` named ``random`` follow
            that world's track. None is a world of ``terrain``.
    """

    seed: int = DEFAULT_SEED
    duration: float = 10.0
    robot: str = "husky"
    commands: str = "random"
    command_type: str = "twist"
    flippers: str = HOLD
    terrain: TerrainSettings = field(default_factory=TerrainSettings)
    camera: CameraSettings | None = field(default_factory=CameraSettings)
    lidar: LidarSettings | None = field(default_factory=LidarSettings)
    imu: ImuSettings = field(default_factory=ImuSettings)
    cameras: int | None = None
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    hidden: tuple[Fault, ...] | None = None
    storage: str = "mcap"
    labels: bool = False
    overwrite: bool = False
    world: WorldSettings | None = None

    def __post_init__(self):
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed: got {self.seed}, expected 0 to {2**32 - 1}")
        if not 0.1 <= self.duration <= 3600.0:
            raise ValueError(f"duration: got {self.duration}, expected 0.1 to 3600 s")
        if self.cameras is not None and not 1 <= self.cameras <= len(_SIDES):
            raise ValueError(f"cameras: got {self.cameras}, expected 1 to {len(_SIDES)}")
        if self.command_type not in ("twist", "ackermann"):
            raise ValueError(f"command type: got {self.command_type!r}, expected twist or ackermann")
        if (self.terrain.flat or self.terrain.bare) and any(isinstance(p, VegetationDrag) for p in self.hidden or ()):
            raise ValueError("hidden vegetation_drag: got a world without vegetation; leave out --flat and --bare")


@dataclass(frozen=True)
class Summary:
    """Result of a recording.

    Attributes:
        duration: recorded [s].
        distance: driven [m].
        mishap: why the recording ended early, or None.
        messages: number of messages by topic.
    """

    duration: float
    distance: float
    mishap: str | None
    messages: dict[str, int]


def record(out: Path, settings: RecordingSettings, progress: Callable[[float], object] | None = None) -> Summary:
    """Simulate a robot and write its sensor data as a bag.

    Poses are those of the base frame in the odom frame, which is the world frame shifted to the robot's start; see
    ``Simulation``. Stamps start at ``START_STAMP`` and follow the simulated time.

    Args:
        out: folder of the bag.
        settings: settings of the recording.
        progress: called with the simulated seconds [s] since its last call.

    Raises:
        FileExistsError: the bag exists and ``overwrite`` is off.
        DrawingError: images are recorded and no graphics library can render them.
        RobotFileError: the robot file is invalid.
        ValueError: a setting is invalid.
    """
    if settings.world is None:
        description = None
        robot = Vehicle.load(settings.robot)
        if settings.camera is not None and settings.cameras is not None:
            robot = dataclasses.replace(robot, sensors=_with_cameras(robot, settings.cameras))
        rig = _robots_cameras(robot, settings.camera)
    else:
        world = draw_world(settings.world, settings.seed)
        description = world.description
        robot = world.robot()
        rig = () if settings.camera is None else world.rig(robot)
        robot = dataclasses.replace(robot, sensors=_with_rig(robot, rig))
    if settings.command_type == "ackermann" and robot.wheelbase is None:
        raise ValueError(f"command type: got ackermann for {robot.name}, which is no car, expected twist")
    problems = [problem for fault in settings.hidden or () if (problem := fault.complaint(robot))]
    if problems:
        raise ValueError(f"hidden {problems[0]}")
    with BagWriter(out, storage=settings.storage, overwrite=settings.overwrite) as bag:
        scenery = build_scenery(settings.terrain, settings.seed) if settings.world is None else world.scenery
        if settings.world is not None and settings.commands == "random":
            profile = world.driver(robot)
        else:
            random = random_stream(settings.seed, "commands")
            profile = make_profile(
                settings.commands,
                scenery.route,
                random,
                robot.maximum_speed,
                robot.maximum_curvature,
                crabs=robot.crabs,
            )
        session = _Session(bag, settings, robot, scenery, profile, rig)
        try:
            summary = session.run(progress or (lambda seconds: None))
        finally:
            session.close()
        if settings.labels:
            write_labels(out, world_labels(scenery, session.simulation.odom_origin) | session.truth())
        if settings.hidden is not None:
            write_truth(out, settings.hidden, settings.seed)
        if description is not None:
            write_text(world_file(out), json.dumps(description | _rig_description(robot, rig), indent=1) + "\n")
    return summary


def world_file(bag: Path) -> Path:
    """Path of the description of a bag's randomised world, next to the bag."""
    return bag.with_name(f"{bag.name}.world.json")


def _rig_description(robot: Vehicle, rig: Sequence[RecordedCamera]) -> dict[str, object]:
    views = [camera.settings.horizontal_field_of_view for camera in rig]
    return {
        "robot": robot.name,
        "cameras": len(rig),
        "field_of_view_deg": [round(math.degrees(view), 1) for view in views],
        "camera_height": [round(float(camera.pose[2, 3] + robot.clearance), 3) for camera in rig],
        "distortion_model": [camera.settings.distortion_model for camera in rig],
    }


class _Session:
    """One recording: a simulation and its sensors."""

    def __init__(
        self,
        bag: BagWriter,
        settings: RecordingSettings,
        robot: Vehicle,
        scenery: Scenery,
        profile: CommandProfile,
        rig: Sequence[RecordedCamera],
    ):
        self._bag, self._settings, self._robot, self._profile = bag, settings, robot, profile
        fields_of_view = {camera.frame: camera.settings.vertical_field_of_view for camera in rig}
        lidar_pose = None if settings.lidar is None else robot.sensor(robot.lidar_frame, "--lidar none")
        hidden = settings.hidden or ()
        model = build_model(scenery, robot, settings.seed, fields_of_view, hidden)
        self.simulation = Simulation(model, scenery, robot, hidden)
        self._odometry = Odometry(settings.odometry, random_stream(settings.seed, "odometry"), hidden)
        self._flippers = make_flipper_program(
            settings.flippers, robot.flippers, random_stream(settings.seed, "flippers")
        )
        self._command_offset = round(1e9 * sum(fault.command_stamp_offset for fault in hidden))
        self._pose_offset = round(1e9 * sum(fault.pose_stamp_offset for fault in hidden))
        self._gyro_offset = np.array([0.0, 0.0, sum(fault.gyro_offset for fault in hidden)])
        # Other threads render clouds and images; later messages wait for them, so that the bag is in order.
        self._workers = ThreadPoolExecutor(2, thread_name_prefix="recording")
        self._outbox: deque[tuple[str, int, object]] = deque()
        self._scan: Future[object] | None = None
        self._delayed: deque[tuple[int, str, object]] = deque()
        self._truth: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._imu = Imu(settings.imu, random_stream(settings.seed, "imu"))
        self._imu.add(self.simulation.data)
        self._tasks: list[tuple[float, Callable[[], None]]] = [
            (_COMMAND_RATE, self._write_command),
            (settings.odometry.rate, self._write_odometry),
            (_WHEEL_RATE, self._write_wheels),
            (settings.imu.rate, self._write_imu),
        ]
        if settings.lidar is not None and lidar_pose is not None:
            self._lidar = Lidar(model, lidar_pose, settings.lidar, random_stream(settings.seed, "lidar"))
            self._tasks.append((settings.lidar.rate, self._write_cloud))
        self._cameras: list[Camera] = []
        if rig:
            self._cameras = [Camera(model, entry.frame, entry.settings, entry.imaging) for entry in rig]
            self._tasks.append((rig[0].settings.rate, self._write_images))
        self._messages: dict[str, int] = {}

    @property
    def _stamp(self) -> int:
        return START_STAMP + round(self.simulation.time * 1e9)

    def close(self) -> None:
        """End the threads and free the cameras' graphics library."""
        self._workers.shutdown()
        for camera in self._cameras:
            camera.close()

    def run(self, progress: Callable[[float], object]) -> Summary:
        """Record to the end, or until the simulation fails; the failure itself is not recorded."""
        simulation = self.simulation
        written = [0] * len(self._tasks)
        distance, last_position, reported, mishap = 0.0, np.zeros(3), 0.0, None
        self._write("/tf_static", builders.static_transforms(self._stamp, self._robot.base_frame, self._robot.sensors))
        while True:
            self._deliver(self._stamp)
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
        self._deliver(None)
        self._flush(wait=True)
        progress(simulation.time - reported)
        return Summary(simulation.time, distance, mishap, self._messages)

    def truth(self) -> dict[str, np.ndarray]:
        """True stamps ``[n]`` [ns], positions ``[n, 3]`` [m] and quaternions ``[n, 4]`` in the odom frame."""
        stamps, positions, quaternions = zip(*self._truth, strict=True)
        return {
            "true_stamps": np.array(stamps, np.int64),
            "true_positions": np.array(positions),
            "true_quaternions": np.array(quaternions),
        }

    def _deliver(self, now: int | None) -> None:
        """Write delayed messages that have arrived by ``now`` [ns], or all."""
        while self._delayed and (now is None or self._delayed[0][0] <= now):
            arrival, topic, message = self._delayed.popleft()
            self._write(topic, message, arrival)

    def _write(self, topic: str, message: object, stamp: int | None = None) -> None:
        self._outbox.append((topic, self._stamp if stamp is None else stamp, message))
        self._messages[topic] = self._messages.get(topic, 0) + 1
        self._flush(wait=len(self._outbox) > _LONGEST_OUTBOX)

    def _flush(self, *, wait: bool) -> None:
        """Write finished messages in order, or wait for all."""
        while self._outbox:
            topic, stamp, message = self._outbox[0]
            if isinstance(message, Future):
                if not (wait or message.done()):
                    return
                message = message.result()
            self._outbox.popleft()
            self._bag.write(topic, message, stamp)

    def _write_command(self) -> None:
        state = self.simulation.state()
        position = (state.position + self.simulation.odom_origin)[:2]
        command = self._profile.command(self.simulation.time, position, state.heading)
        self.simulation.drive(*command)
        stamp = self._stamp + self._command_offset
        if self._settings.command_type == "ackermann":
            assert self._robot.wheelbase is not None
            angle = steering_angle(command[0], command[1], self._robot.wheelbase, self._robot.maximum_curvature)
            message = builders.ackermann_drive(stamp, self._robot.base_frame, command[0], angle)
            self._write("/ackermann_cmd", message)
        else:
            self._write("/cmd_vel", builders.twist_stamped(stamp, self._robot.base_frame, *command))
        if self._flippers is not None:
            angles = self._flippers.angles(self.simulation.time)
            self.simulation.move_flippers(angles)
            names = [arm.name for arm in self._robot.flippers]
            self._write("/flipper_commands", builders.joint_state(stamp, names, angles, []))

    def _write_odometry(self) -> None:
        true = self.simulation.state()
        self._truth.append((self._stamp, true.position, true.quaternion))
        state = self._odometry.read(true)
        motion = (state.position, state.quaternion, state.linear_velocity, state.angular_velocity)
        stamp = self._stamp + self._pose_offset
        message = builders.odometry(stamp, ODOM_FRAME, self._robot.base_frame, *motion)
        self._delayed.append((self._stamp + round(1e9 * self._settings.odometry.latency), "/odom", message))
        self._deliver(self._stamp)

    def _write_wheels(self) -> None:
        names = self.simulation.joint_names
        self._write("/joint_states", builders.joint_state(self._stamp, names, *self.simulation.joint_states()))

    def _write_imu(self) -> None:
        turning, force = self._imu.read()
        self._write("/imu/data", builders.imu(self._stamp, IMU_FRAME, turning + self._gyro_offset, force))

    def _write_cloud(self) -> None:
        # Scans run one after the other: they share the lidar's memory and its noise.
        if self._scan is not None:
            self._scan.result()
        self.simulation.update_kinematics()
        points, stamp = self._lidar.start(self.simulation.data, self.simulation.world_pose()), self._stamp
        frame = self._robot.lidar_frame
        self._scan = self._workers.submit(lambda: builders.point_cloud(stamp, frame, points()))
        self._write("/points", self._scan)

    def _write_images(self) -> None:
        self.simulation.update_kinematics()
        stamp = self._stamp
        for camera in self._cameras:
            settings, frame = camera.settings, camera.frame
            pixels = camera.capture(self.simulation.data).copy()

            def encode(pixels: np.ndarray = pixels, frame: str = frame, quality: int = settings.quality) -> object:
                return builders.compressed_image(stamp, frame, "jpeg", encode_jpeg(pixels, quality))

            info = builders.camera_info(
                stamp, frame, settings.width, settings.height, settings.matrix, settings.distortion or [0.0] * 5,
                settings.distortion_model,
            )  # fmt: skip
            self._write(f"/{frame}/image_raw/compressed", self._workers.submit(encode))
            self._write(f"/{frame}/camera_info", info)


def steering_angle(forward: float, yaw_rate: float, wheelbase: float, maximum_curvature: float) -> float:
    """Angle of the bicycle's wheel that turns as commanded [rad]; 0 at standstill.

    Args:
        forward: speed [m/s].
        yaw_rate: [rad/s].
        wheelbase: of the bicycle [m].
        maximum_curvature: that the steering reaches [1/m].
    """
    if abs(forward) < 1e-3:
        return 0.0
    return math.atan(wheelbase * float(np.clip(yaw_rate / forward, -maximum_curvature, maximum_curvature)))


def _robots_cameras(robot: Vehicle, settings: CameraSettings | None) -> tuple[RecordedCamera, ...]:
    """The cameras of the robot's file."""
    if settings is None:
        return ()
    frames = [frame for frame in robot.sensors if frame.startswith(CAMERA_PREFIX)]
    if not frames:
        robot.sensor(f"{CAMERA_PREFIX}_front", "--camera none")
    return tuple(RecordedCamera(frame, robot.sensors[frame], settings) for frame in frames)


def _with_rig(robot: Vehicle, rig: Sequence[RecordedCamera]) -> Mapping[str, np.ndarray]:
    """The robot's sensors with the cameras of a rig instead of its own."""
    sensors = {frame: pose for frame, pose in robot.sensors.items() if not frame.startswith(CAMERA_PREFIX)}
    return sensors | {camera.frame: camera.pose for camera in rig}


def _with_cameras(robot: Vehicle, count: int) -> Mapping[str, np.ndarray]:
    """The robot's sensors with ``count`` cameras."""
    front = robot.sensor(f"{CAMERA_PREFIX}_front", "--camera none")
    sensors = {frame: pose for frame, pose in robot.sensors.items() if not frame.startswith(CAMERA_PREFIX)}
    for side, yaw in list(_SIDES.items())[:count]:
        frame = f"{CAMERA_PREFIX}_{side}"
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
        sensors[frame] = robot.sensors.get(frame, turn @ front)
    return sensors
