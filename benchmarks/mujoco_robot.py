"""MuJoCo robot: the MuJoCo model that follows from a robot file and the effects in it, and its parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.robots import RobotModel
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.terrain import TerrainDefaults, TerrainMap

TIME_STEP = 1.0 / 120.0
"""Of which half a second has a whole number [s]."""
GRAVITY = 9.81
"""[m/s²]."""
WHEEL_SHARE = 0.12
"""Share of a robot's mass in its wheels; robot files do not state it."""
_SETTLING = 1.0
"""Time in which the model comes to rest on level ground, before windows start at that height [s]."""


@dataclass(frozen=True)
class Range:
    """Start and bounds of a free parameter, in a unit by which it plausibly differs from its start."""

    low: float
    high: float
    start: float = 0.0


FREE: Mapping[str, Range] = {
    # Logarithms of a factor on what the robot file, or a default, says.
    "mass": Range(-1.1, 1.1),
    "inertia_x": Range(-1.1, 1.1),
    "inertia_y": Range(-1.1, 1.1),
    "inertia_z": Range(-1.1, 1.1),
    "friction": Range(-3.0, 1.1),
    "friction_rear": Range(-1.5, 1.5),
    "friction_right": Range(-1.5, 1.5),
    "contact_time": Range(-0.8, 1.6),
    "servo_gain_left": Range(-3.0, 3.0),
    "servo_gain_right": Range(-3.0, 3.0),
    "torque_limit": Range(-3.5, 1.1),
    "armature": Range(-2.0, 2.0),
    "wheel_radius": Range(-0.3, 0.3),
    "wheel_spacing": Range(-0.4, 0.4),
    "command_left": Range(-2.0, 0.7),
    "command_right": Range(-2.0, 0.7),
    "command_turn": Range(-1.5, 0.7),
    "speed_limit": Range(-2.5, 0.2),
    # Centre of mass: shares of wheelbase, track width and wheel radius.
    "centre_x": Range(-0.5, 0.5),
    "centre_y": Range(-0.5, 0.5),
    "centre_z": Range(-0.5, 1.5),
    # Resistances: shares of the robot's weight, at 1 m/s where they grow with speed.
    "axle_friction": Range(0.0, 0.8, 0.01),
    "axle_damping": Range(0.0, 0.8, 0.01),
    "viscosity": Range(0.0, 1.5, 0.01),
    "density": Range(0.0, 1.5, 0.01),
    # Tilt of gravity about the world's axes [0.1 rad].
    "gravity_x": Range(-4.0, 4.0),
    "gravity_y": Range(-4.0, 4.0),
    # Pose of the localisation's site on the base [m, m, rad].
    "site_x": Range(-1.0, 1.0),
    "site_y": Range(-1.0, 1.0),
    "site_yaw": Range(-0.6, 0.6),
    # Commands [s], beside the dead time and the lag of the robot file.
    "dead_time": Range(-0.5, 1.0),
    "lag": Range(-0.3, 1.0),
}
"""All parameters, all free."""


@dataclass(frozen=True)
class Nominal:
    """What the robot file says, and where it says nothing, what is usual.

    Attributes:
        robot: of the file.
        wheels: centres, left ones first, ``[N, 3]`` [m].
        friction: coefficient of the ground with the file's effect.
        servo_gain: of a wheel [N m s/rad].
        dead_time, lag: of the commands [s].
        turn: by which the commanded difference of the sides is divided for scrub.
        gain: of both drives.
    """

    robot: RobotModel
    wheels: np.ndarray
    friction: float
    servo_gain: float
    dead_time: float
    lag: float
    turn: float
    gain: float

    @classmethod
    def of(cls, robot: RobotModel) -> Nominal:
        """Of a robot on four or more wheels, two sides of which are driven; raises ``ValueError`` for another one."""
        if robot.number_of_drives != 2 or not robot.wheel_radius or robot.flippers or robot.steered is not None:
            raise ValueError(f"{robot.name}: only robots that turn by the speeds of two sides of wheels are modelled")
        wheels = _wheel_centres(robot)
        effects = {
            name: {key: float(value) for key, value in values.items()}
            for name, values in robot.effects
            if name != "learned_term"
        }

        def value(name: str, key: str, neutral: float) -> float:
            return effects.get(name, {}).get(key, neutral)

        load = float(robot.mass) * GRAVITY / len(wheels)
        # A servo of gain N r² / loss loses this speed at a traction of the load.
        loss = max(value("drive_compliance", "speed_loss", 0.05), 0.01)
        return cls(
            robot=robot,
            wheels=wheels,
            friction=TerrainDefaults().friction * value("friction_scale", "factor", 1.0),
            servo_gain=load * robot.wheel_radius**2 / loss,
            dead_time=value("command_delay", "delay", 0.0),
            lag=value("actuator_lag", "time_constant", 0.0) + value("actuator_lag", "second_time_constant", 0.0),
            turn=value("turning_scrub", "track_width_factor", 1.0),
            gain=value("drive_gain", "gain", 1.0),
        )

    @property
    def track(self) -> float:
        """Distance of the sides of wheels [m]."""
        return float(np.ptp(self.wheels[:, 1]))

    @property
    def wheelbase(self) -> float:
        """Distance of the first and the last axle [m]."""
        return float(np.ptp(self.wheels[:, 0]))

    @property
    def radius(self) -> float:
        """Of the wheels [m]."""
        assert self.robot.wheel_radius is not None
        return self.robot.wheel_radius


def _wheel_centres(robot: RobotModel) -> np.ndarray:
    """Centres of the wheels, left ones first, ``[N, 3]`` [m]: points of a tread lie a radius around them."""
    points, tangents = robot.points.double().numpy(), robot.point_tangents.double().numpy()
    driven = robot.point_drives.numpy() >= 0
    # The surface moves across the spoke: forward at the top, down at the front.
    spokes = np.stack([-tangents[:, 2], np.zeros(len(points)), tangents[:, 0]], axis=1)
    centres = (points - float(robot.wheel_radius or 0.0) * spokes)[driven]
    left = centres[:, 1] > 0
    found = []
    for side in (left, ~left):
        stations = np.sort(centres[side, 0])
        middle, height = centres[side, 1].mean(), centres[side, 2].mean()
        groups = np.split(stations, np.flatnonzero(np.diff(stations) > 0.5 * float(robot.wheel_radius or 0.0)) + 1)
        found += [[float(group.mean()), float(middle), float(height)] for group in reversed(groups)]
    return np.array(found)


class MujocoModel:
    """A robot's MuJoCo model on its ground, for given parameters.

    Args:
        nominal: what the robot file says.
        terrain: a map in its own frame, or None for level ground.
    """

    def __init__(self, nominal: Nominal, terrain: TerrainMap | None):
        self.nominal = nominal
        self._terrain = terrain
        self.spec = mujoco.MjSpec()
        self.spec.option.timestep = TIME_STEP
        self.spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        self.spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self._low = self._add_ground()
        base = self.spec.worldbody.add_body(name="base")
        base.add_freejoint()
        base.add_site(name="localisation")
        base.explicitinertial = True
        for index, centre in enumerate(nominal.wheels):
            self._add_wheel(base, index, centre)

    def _add_ground(self) -> float:
        """The ground; the lowest of its heights [m]."""
        if self._terrain is None:
            self.spec.worldbody.add_geom(
                name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], contype=1, conaffinity=2
            )
            return 0.0
        heights, grid = self._terrain.height.double().numpy(), self._terrain.grid
        low, high = float(heights.min()), max(float(heights.max()), float(heights.min()) + 1e-3)
        half = 0.5 * (grid.columns - 1) * grid.resolution, 0.5 * (grid.rows - 1) * grid.resolution
        self.spec.add_hfield(
            name="ground", nrow=grid.rows, ncol=grid.columns, size=[*half, high - low, 0.5],
            userdata=((heights - low) / (high - low)).ravel().tolist(),
        )  # fmt: skip
        self.spec.worldbody.add_geom(
            name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", contype=1, conaffinity=2,
            pos=[grid.origin[0] + half[0], grid.origin[1] + half[1], low],
        )  # fmt: skip
        return low

    def _add_wheel(self, base: mujoco.MjsBody, index: int, centre: np.ndarray) -> None:
        wheel = base.add_body(name=f"wheel_{index}", pos=centre)
        wheel.explicitinertial = True
        wheel.ipos = [0.0, 0.0, 0.0]
        wheel.add_joint(name=f"axle_{index}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        wheel.add_geom(
            name=f"tyre_{index}", type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, contype=2, conaffinity=1, priority=1, condim=3
        )
        servo = self.spec.add_actuator(name=f"servo_{index}", target=f"axle_{index}")
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT

    def compiled(self, values: Mapping[str, float]) -> mujoco.MjModel:
        """The model with these parameters, by the names of :data:`FREE`."""
        nominal, robot, spec = self.nominal, self.nominal.robot, self.spec
        count, wheels = len(nominal.wheels), nominal.wheels
        radius = nominal.radius * math.exp(values["wheel_radius"])
        total = float(robot.mass) * math.exp(values["mass"])
        weight, load = total * GRAVITY, total * GRAVITY / count
        wheel_mass = WHEEL_SHARE * float(robot.mass) / count
        base = spec.body("base")
        base.mass = total - wheel_mass * count
        shift = np.array([values["centre_x"], values["centre_y"], values["centre_z"]])
        shift *= (nominal.wheelbase, nominal.track, nominal.radius)
        base.ipos = robot.centre_of_mass.double().numpy() + shift
        moments = np.diagonal(robot.inertia.double().numpy()) * (1.0 - WHEEL_SHARE)
        moments = moments * np.exp([values["inertia_x"], values["inertia_y"], values["inertia_z"]])
        # Larger than the sum of the others no moment of inertia is.
        base.inertia = np.minimum(moments, 0.999 * (moments.sum() - moments))
        spread = float(robot.point_widths.max()) if robot.point_widths is not None else 0.6 * radius
        spin = wheel_mass * radius**2 / 2
        middle = float(wheels[:, 0].mean())
        for index, centre in enumerate(wheels):
            body, joint = spec.body(f"wheel_{index}"), spec.joint(f"axle_{index}")
            body.pos = [centre[0], centre[1] * math.exp(values["wheel_spacing"]), centre[2]]
            body.mass, body.inertia = wheel_mass, [0.6 * spin, spin, 0.6 * spin]
            gain = nominal.servo_gain * math.exp(
                values["servo_gain_left" if index < count // 2 else "servo_gain_right"]
            )
            joint.armature = (spin + 0.02 * nominal.servo_gain) * math.exp(values["armature"])
            joint.frictionloss = values["axle_friction"] * load * radius
            joint.damping = [values["axle_damping"] * load * radius**2, 0.0, 0.0]
            rear = (middle - centre[0]) / (0.5 * nominal.wheelbase)
            side = -1.0 if index < count // 2 else 1.0
            friction = nominal.friction * math.exp(
                values["friction"] + 0.5 * rear * values["friction_rear"] + 0.5 * side * values["friction_right"]
            )
            tyre = spec.geom(f"tyre_{index}")
            tyre.size, tyre.friction = [radius, spread / 2, radius], [friction, 0.005, 0.0001]
            tyre.solref = [max(0.02 * math.exp(values["contact_time"]), 2.2 * TIME_STEP), 1.0]
            servo = spec.actuator(f"servo_{index}")
            servo.set_to_velocity(kv=gain)
            limit = 3.0 * nominal.friction * load * radius * math.exp(values["torque_limit"])
            servo.forcelimited, servo.forcerange = True, [-limit, limit]
        # Chosen so that a parameter of 1 resists with the robot's weight at 1 m/s.
        size = (nominal.wheelbase + nominal.track) / 2
        spec.option.viscosity = values["viscosity"] * weight / (3 * math.pi * size)
        spec.option.density = values["density"] * 2 * weight / size**2
        tilt = 0.1 * np.array([values["gravity_x"], values["gravity_y"]])
        spec.option.gravity = GRAVITY * np.array([*np.sin(tilt), -math.sqrt(max(1.0 - (np.sin(tilt) ** 2).sum(), 0.1))])
        spec.site("localisation").pos = [values["site_x"], values["site_y"], 0.0]
        spec.site("localisation").quat = Rotation.from_euler("z", values["site_yaw"]).as_quat(scalar_first=True)
        return spec.compile()

    def resting_height(self, model: mujoco.MjModel) -> float:
        """Height of the base's origin above level ground at rest [m]."""
        depth = float(self.nominal.wheels[:, 2].mean()) - float(model.geom("tyre_0").size[0])
        if self._terrain is None:
            data = mujoco.MjData(model)
            data.qpos[2] = -depth
            mujoco.mj_step(model, data, round(_SETTLING / TIME_STEP))
            if np.isfinite(data.qpos[2]) and abs(data.qpos[2] + depth) < 0.2 * self.nominal.radius:
                return float(data.qpos[2])
        # Over hills of the width of the tyre: a millimetre of the contact's own depth is less than the map's error.
        return -depth

    def ground_under(self, xy: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Height ``[W]`` [m] and attitude ``[W, 3, 3]`` of the plane through the ground under the wheels.

        Args:
            xy: of the base ``[W, 2]`` [m].
            yaw: its heading ``[W]`` [rad].
        """
        turn = Rotation.from_euler("z", yaw[:, None]).as_matrix()
        if self._terrain is None:
            return np.zeros(len(xy)), turn
        heights, grid = self._terrain.height.double().numpy(), self._terrain.grid
        feet = self.nominal.wheels[:, :2]
        places = xy[:, None] + np.einsum("wij,nj->wni", turn[:, :2, :2], feet)
        column, row = ((places - grid.origin) / grid.resolution).transpose(2, 0, 1)
        column, row = column.clip(0, grid.columns - 1.001), row.clip(0, grid.rows - 1.001)
        left, below = column.astype(int), row.astype(int)
        right, above = column - left, row - below
        under = (
            heights[below, left] * (1 - right) * (1 - above) + heights[below, left + 1] * right * (1 - above)
            + heights[below + 1, left] * (1 - right) * above + heights[below + 1, left + 1] * right * above
        )  # fmt: skip
        plane = under @ np.linalg.pinv(np.c_[feet, np.ones(len(feet))]).T
        lean = Rotation.from_euler("yx", np.stack([-np.arctan(plane[:, 0]), np.arctan(plane[:, 1])], axis=1))
        return plane[:, 2], turn @ lean.as_matrix()
