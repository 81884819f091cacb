"""Compare robots that steer, trail casters or move flippers with MuJoCo: the same robot, ground and commands, 5 s.

    scripts/run.sh python benchmarks/mujoco_drives.py [--only CASE...] [--json FILE]

MuJoCo's model is built here from the robot file: bodies for wheels, hubs and flippers, its own contacts, friction and
servos. Nothing is fitted; the rollout has its default ground and body points. Without a spring in the file, a wheel has
a stiff one as its tyre (see synthetic/vehicle.py).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from monoforce_ros.core import write_text
from monoforce_ros.effects import controls
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import Controls, RobotModel, load_robot, robot_file
from monoforce_ros.synthetic.graphics import mujoco
from monoforce_ros.synthetic.vehicle_parts import set_inertia
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

SECONDS, STEP, MUJOCO_STEP = 5.0, 0.01, 0.001
FRICTION = 0.8
_WHEELS_SHARE = 0.12
_TYRE_STIFFNESS, _TYRE_DAMPING, _SERVO_GAIN, _GEAR_INERTIA = 1200.0, 56.0, 24.0, 0.008
"""Of each kilogram of the robot, divided among its wheels, as in synthetic/vehicle.py."""
_FLIPPER_WHEELS = 8
"""Wheels in the belt of a flipper: between four the edge of a step reaches the hull; six and eight differ by 3 cm."""
_SETTLE = 1.0

Heights = Callable[[np.ndarray, np.ndarray], np.ndarray]


def gentle(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Hills of up to 0.1 m that are several metres long, level around the start [m]."""
    away = 1.0 - np.exp(-(x**2 + y**2) / 2.0)
    return 0.05 * away * (np.sin(0.5 * x) * np.cos(0.4 * y) + 0.5 * np.sin(0.3 * x + 0.7 * y))


def step_of(height: float, at: float, run: float = 0.1) -> Heights:
    """A step up of ``height`` [m] at x = ``at`` [m], as steep as the map's cells allow (``run`` [m])."""
    return lambda x, y: height * np.clip((x - at) / run, 0.0, 1.0)


def rover(kind: str) -> dict[str, Any]:
    """A robot of 40 kg with four steered wheels."""
    corners = [("fl", 0.35, 0.3), ("fr", 0.35, -0.3), ("rl", -0.35, 0.3), ("rr", -0.35, -0.3)]
    return {
        "name": kind, "mass": 40.0, "centre_of_mass": [0.0, 0.0, 0.05], "inertia_box": [0.8, 0.6, 0.3],
        "command": {"track_width": 0.6}, "drive": {"kind": kind},
        "wheels": [
            {"name": n, "drive": n, "centre": [x, y, 0.0], "radius": 0.12, "width": 0.08} for n, x, y in corners
        ],
        "steering": [
            {"name": f"{n}_joint", "wheel": n, "maximum_angle": 1.57, "maximum_rate": 2.0, "time_constant": 0.05}
            for n, _, _ in corners
        ],
    }  # fmt: skip


def porter() -> dict[str, Any]:
    """A robot of 30 kg with two driven wheels and a caster."""
    return {
        "name": "differential", "mass": 30.0, "centre_of_mass": [-0.1, 0.0, 0.05], "inertia_box": [0.6, 0.5, 0.3],
        "command": {"track_width": 0.5}, "drive": {"kind": "differential"},
        "wheels": [
            {"name": "left", "drive": "left", "centre": [0.0, 0.25, 0.0], "radius": 0.12, "width": 0.04},
            {"name": "right", "drive": "right", "centre": [0.0, -0.25, 0.0], "radius": 0.12, "width": 0.04},
            {"name": "rear", "drive": None, "centre": [-0.42, 0.0, -0.06], "radius": 0.06, "width": 0.03},
        ],
        "casters": [{"name": "caster", "wheel": "rear", "pivot": [-0.36, 0.0, 0.05]}],
    }  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Case:
    """A robot, its commands (forward, yaw rate, lateral), and the ground."""

    content: Mapping[str, Any]
    twists: tuple[tuple[float, float, float], ...]
    heights: Heights = gentle
    flippers: Callable[[np.ndarray], np.ndarray] | None = None
    """Commanded angles ``[T, F]`` [rad] at times ``[T]`` [s]."""
    seconds: float = SECONDS
    start_x: float = 0.0

    def robot(self) -> RobotModel:
        """The rollout's model of the robot."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.yaml"
            path.write_text(yaml.safe_dump(dict(self.content)))
            return load_robot(path)


def _shipped(name: str) -> dict[str, Any]:
    return yaml.safe_load(robot_file(name).read_text(encoding="utf-8"))


def _climb(times: np.ndarray) -> np.ndarray:
    """Front flippers raised before the step, all pressed down on it, then the rear ones lift the tail [rad]."""
    front = np.interp(times, [0.0, 1.0, 3.0, 4.5, 6.0, 8.0], [0.7, 0.7, 0.7, -0.4, 0.0, 0.0])
    rear = np.interp(times, [0.0, 3.0, 4.5, 6.0, 9.0, 11.0], [0.0, 0.0, -0.5, -0.9, -0.9, 0.0])
    return np.stack([front, front, rear, rear], axis=-1)


def cases() -> dict[str, Case]:
    """The comparisons by name."""
    return {
        "ackermann": Case(_shipped("rally_car"), ((1.5, 0.0, 0), (1.5, 0.5, 0), (1.5, -0.5, 0), (-1.0, 0.3, 0))),
        "ackermann, full size": Case(_shipped("offroad_car"), ((3.0, 0.0, 0), (3.0, 0.4, 0), (3.0, -0.5, 0))),
        "four_wheel_steering": Case(rover("four_wheel_steering"), ((0.5, 0.0, 0.3), (0.5, 0.4, 0.0), (0.0, 0.0, 0.4))),
        "independent": Case(rover("independent"), ((0.4, 0.3, 0.2), (0.0, 0.6, 0.0), (-0.5, 0.0, 0.2))),
        "differential": Case(porter(), ((0.5, 0.0, 0.0), (0.5, 0.4, 0.0), (0.3, -0.5, 0.0), (-0.3, 0.0, 0.0))),
        "flippers": Case(
            _shipped("marv"), ((0.25, 0.0, 0.0),), step_of(0.3, 1.0), flippers=_climb, seconds=12.0, start_x=0.0
        ),
    }


class Engine:
    """A robot file as a MuJoCo model on a height field."""

    def __init__(self, content: Mapping[str, Any], robot: RobotModel, heights: Heights):
        self.robot = robot
        spec = mujoco.MjSpec()
        spec.option.timestep = MUJOCO_STEP
        # Damping of servos on light hubs would need far shorter steps.
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        # Half a cell finer than the map, so that both engines see the same ground.
        size, cells = 20.0, 801
        axis = np.linspace(-size, size, cells)
        ground = heights(*np.meshgrid(axis, axis))
        self.low, span = float(ground.min()) - 1e-3, float(np.ptp(ground)) + 2e-3
        spec.add_hfield(
            name="ground", nrow=cells, ncol=cells, size=[size, size, span, 0.5],
            userdata=((ground - self.low) / span).ravel().tolist(),
        )  # fmt: skip
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=[0, 0, self.low], contype=1, conaffinity=2,
            friction=[FRICTION, 0.005, 0.0001],
        )  # fmt: skip
        self._add_robot(spec, content)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.actuators = {self.model.actuator(i).name: i for i in range(self.model.nu)}

    def _add_robot(self, spec: mujoco.MjSpec, content: Mapping[str, Any]) -> None:
        robot, mass = self.robot, float(content["mass"])
        base = spec.worldbody.add_body(name="base", pos=[0.0, 0.0, robot.ground_clearance])
        base.add_freejoint()
        self.wheels = [self._wheel_entry(wheel) for wheel in content.get("wheels", [])]
        steered = robot.steered
        self.differentials = {
            f"differential_{index}": [robot.drive_names[drive] for drive in drives]
            for index, drives in enumerate(() if steered is None else steered.differentials)
        }
        self.arms = {joint.name: joint for joint in robot.joints if joint.kind == "flipper"}
        flippers = content.get("flippers", [])
        share = mass / (len(self.wheels) + _FLIPPER_WHEELS * len(flippers))
        wheel_mass = _WHEELS_SHARE * share
        for entry in flippers:
            self.wheels += self._flipper_wheels(spec, base, entry, wheel_mass)
        flipper_mass = sum(float(entry["mass"]) for entry in flippers)
        on_base = [wheel for wheel in self.wheels if wheel["carrier"] is None]
        # The rest of the body, so that the whole has the robot's mass, centre of mass and inertia.
        parts = [(wheel_mass, wheel["centre"]) for wheel in on_base]
        parts += [(float(j.mass), np.array(j.place)) for j in self.arms.values()]
        rest = mass - wheel_mass * len(on_base) - flipper_mass
        whole = robot.centre_of_mass.double().numpy()
        centre = (mass * whole - sum(m * np.asarray(c) for m, c in parts)) / rest
        inertia = robot.inertia.double().numpy() - _steiner(rest, centre - whole)
        for part, place in parts:
            inertia = inertia - _steiner(part, np.asarray(place) - whole)
        set_inertia(base, rest, inertia, centre)
        for box in content.get("hull", []):
            base.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=box["centre"],
                size=np.array(box["size"]) / 2,
                mass=0.0,
                **_collides(),
            )
        springs = {entry["wheel"]: entry for entry in content.get("suspension", [])}
        pivots = {e["wheel"]: e for section in ("steering", "casters") for e in content.get(section, [])}
        for wheel in self.wheels:
            self._add_wheel(spec, base, wheel, wheel_mass, share, springs, pivots, mass)
        # A differential is a tendon: as long as the mean of its wheels' angles, it pulls at all of them alike.
        for name, wheels in self.differentials.items():
            tendon = spec.add_tendon(name=name)
            for wheel in wheels:
                tendon.wrap_joint(wheel, 1.0 / len(wheels))

    def _wheel_entry(self, wheel: Mapping[str, Any]) -> dict[str, Any]:
        steered = self.robot.steered is not None
        drive = None if wheel["drive"] is None else (wheel["name"] if steered else str(wheel["drive"]))
        return {
            "name": wheel["name"], "drive": drive, "centre": np.array(wheel["centre"], float), "carrier": None,
            "radius": wheel["radius"], "width": wheel["width"],
        }  # fmt: skip

    def _flipper_wheels(
        self, spec: mujoco.MjSpec, base: Any, entry: Mapping[str, Any], wheel_mass: float
    ) -> list[dict[str, Any]]:
        joint, place = np.array(entry["joint"], float), np.array(self.arms[entry["name"]].place)
        angle, forward = float(entry["angle"]), 1.0 if entry["end"] == "front" else -1.0
        direction = np.array([forward * np.cos(angle), 0.0, np.sin(angle)])
        shares = np.linspace(0.0, 1.0, _FLIPPER_WHEELS)
        centres = [share * float(entry["length"]) * direction for share in shares]
        arm = base.add_body(name=entry["name"], pos=joint)
        # With its wheels it has the flipper's mass and centre of mass, and a small inertia: the rollout's flippers are
        # point masses.
        own = float(entry["mass"]) - wheel_mass * len(centres)
        centre = (float(entry["mass"]) * (place - joint) - wheel_mass * np.sum(centres, axis=0)) / own
        set_inertia(arm, own, np.full(3, 0.01), centre)
        hinge = arm.add_joint(
            name=entry["name"], type=mujoco.mjtJoint.mjJNT_HINGE, axis=self.arms[entry["name"]].axis, damping=5.0
        )
        hinge.armature = 0.05
        servo = spec.add_actuator(name=entry["name"], target=entry["name"], trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=3000.0, kv=150.0)
        return [
            {
                "name": f"{entry['name']}_{k}", "drive": entry["drive"], "carrier": arm, "width": entry["width"],
                "centre": middle, "radius": entry["root_radius"] + share * (entry["tip_radius"] - entry["root_radius"]),
            }
            for k, (share, middle) in enumerate(zip(shares, centres, strict=True))
        ]  # fmt: skip

    def _add_wheel(
        self, spec: mujoco.MjSpec, base: Any, wheel: dict[str, Any], wheel_mass: float, share: float,
        springs: Mapping[str, Any], pivots: Mapping[str, Any], mass: float,
    ) -> None:  # fmt: skip
        name, carrier, centre = wheel["name"], wheel["carrier"] or base, wheel["centre"]
        light = 0.02 * wheel_mass
        if wheel["carrier"] is None:
            carrier = _massive(carrier.add_body(name=f"{name}_tyre", pos=centre), light)
            spring = springs.get(name)
            stiffness = spring["stiffness"] if spring else share * _TYRE_STIFFNESS
            preloads = {joint.name: joint.dynamics.preload for joint in self.robot.joints if joint.dynamics}
            load = preloads[spring["name"]] if spring else share * 9.81
            tyre = carrier.add_joint(name=f"{name}_tyre", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
            tyre.stiffness = [stiffness, 0.0, 0.0]
            tyre.damping = [spring["damping"] if spring else share * _TYRE_DAMPING, 0.0, 0.0]
            tyre.springref = -load / stiffness
            centre = np.zeros(3)
        if name in pivots:
            pivot = np.array(pivots[name].get("pivot", wheel["centre"]), float) - wheel["centre"]
            carrier = _massive(carrier.add_body(name=f"{name}_hub", pos=pivot), light)
            hinge = carrier.add_joint(
                name=pivots[name]["name"], type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=1e-4 * mass
            )
            centre = -pivot
            if "maximum_angle" in pivots[name]:
                hinge.damping = [0.002 * mass, 0.0, 0.0]
                servo = spec.add_actuator(
                    name=pivots[name]["name"], target=pivots[name]["name"], trntype=mujoco.mjtTrn.mjTRN_JOINT
                )
                servo.set_to_position(kp=10.0 * mass, kv=0.3 * mass)
        body = carrier.add_body(name=name, pos=centre)
        across = wheel_mass * (3 * wheel["radius"] ** 2 + wheel["width"] ** 2) / 12
        set_inertia(body, wheel_mass, np.array([across, wheel_mass * wheel["radius"] ** 2 / 2, across]))
        axle = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        lying = np.roll(Rotation.from_euler("x", 90, degrees=True).as_quat(), 1)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[wheel["radius"], wheel["width"] / 2, 0.0], quat=lying,
            **_collides(),
        )  # fmt: skip
        if wheel["drive"] is not None:
            axle.armature = share * _GEAR_INERTIA * (wheel["radius"] / 0.165) ** 2
            behind = next((tendon for tendon, wheels in self.differentials.items() if name in wheels), None)
            through = mujoco.mjtTrn.mjTRN_JOINT if behind is None else mujoco.mjtTrn.mjTRN_TENDON
            servo = spec.add_actuator(name=f"{name}_drive", target=behind or name, trntype=through)
            # One motor turns a belt, and all of it acts on whichever of the belt's wheels carries the load. With a
            # share of it on each wheel, the robot slows down where it stands on few of them.
            belt = wheel["carrier"] is not None
            driven = sum(other["drive"] == wheel["drive"] for other in self.wheels) if belt else 1
            servo.set_to_velocity(kv=driven * share * _SERVO_GAIN * (wheel["radius"] / 0.165) ** 2)

    def drive(self, given: Controls, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions ``[T + 1, 3]`` and rotations ``[T + 1, 3, 3]`` under the controls, after a second at rest.

        Args:
            given: of a batch of one.
            rest: angles of the joints in the file ``[J]``, which are MuJoCo's zero.
        """
        names = self.robot.joint_names
        angles = None if given.joint_angles is None else given.joint_angles[0].double().numpy()
        speeds = given.drive_speeds[0].double().numpy()
        for wheels in self.differentials.values():
            # Servos at one differential act on the same mean speed.
            behind = [self.robot.drive_names.index(wheel) for wheel in wheels]
            speeds[:, behind] = speeds[:, behind].mean(axis=1, keepdims=True)
        positions, rotations = [], []
        for index in range(-round(_SETTLE / STEP), len(speeds) + 1):
            if index >= 0:
                positions.append(self.data.body("base").xpos.copy())
                rotations.append(self.data.body("base").xmat.reshape(3, 3).copy())
            step = min(max(index, 0), len(speeds) - 1)
            for wheel in self.wheels:
                if wheel["drive"] is not None:
                    speed = speeds[step, self.robot.drive_names.index(wheel["drive"])] if index >= 0 else 0.0
                    self.data.ctrl[self.actuators[f"{wheel['name']}_drive"]] = speed / wheel["radius"]
            for joint, name in enumerate(names):
                if name in self.actuators and angles is not None:
                    self.data.ctrl[self.actuators[name]] = angles[step, joint] - rest[joint]
            for _ in range(round(STEP / MUJOCO_STEP)):
                mujoco.mj_step(self.model, self.data)
        return np.array(positions), np.array(rotations)


def _massive(body: Any, mass: float) -> Any:
    set_inertia(body, mass, np.full(3, 1e-3 * mass))
    return body


def _steiner(mass: float, arm: np.ndarray) -> np.ndarray:
    return mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))


def _collides() -> dict[str, Any]:
    # Like the tyres of synthetic/vehicle.py.
    friction = [FRICTION, 0.005, 0.0001]
    return {"contype": 2, "conaffinity": 1, "friction": friction, "solref": [0.02, 1.0], "priority": 1}


def compare(case: Case, twist: tuple[float, float, float]) -> dict[str, Any]:
    """Errors at the end and both trajectories of one command."""
    robot = case.robot()
    steps = round(case.seconds / STEP)
    ramp = torch.linspace(0.0, case.seconds, steps).clamp(max=1.0)[:, None]
    twists = (ramp * torch.tensor(twist))[None]
    flippers, start = None, None
    rest = np.zeros(0) if robot.joint_angles is None else robot.joint_angles.double().numpy()
    if case.flippers is not None:
        flippers = torch.from_numpy(case.flippers(STEP * np.arange(steps))).float()[None]
        start = flippers[:, 0]
    given = controls(robot, twists, STEP, flippers=flippers, joint_start=start)
    positions, rotations = Engine(case.content, robot, case.heights).drive(given, rest)
    grid = Grid.square(40.0, 0.05 if case.flippers else 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    terrain = TerrainMap.from_height(
        torch.from_numpy(case.heights(x, y).astype(np.float32)),
        grid,
        material=TerrainDefaults(friction=FRICTION),
    )
    state = State(
        *(torch.from_numpy(v.astype(np.float32))[None] for v in (positions[0], rotations[0], np.zeros(3), np.zeros(3)))
    )
    result = rollout(terrain, robot, given, state, with_forces=False)
    predicted, turned = result.position[0].double().numpy(), result.rotation[0].double().numpy()
    return {
        "position_error_m": float(np.linalg.norm(predicted[-1] - positions[-1])),
        "rotation_error_deg": float(np.degrees(Rotation.from_matrix(turned[-1].T @ rotations[-1]).magnitude())),
        "distance_m": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "height_m": [float(positions[-1, 2] - positions[0, 2]), float(predicted[-1, 2] - predicted[0, 2])],
        "mujoco": positions,
        "rollout": predicted,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=sorted(cases()), help="names of cases")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    print("| drive | command (m/s, rad/s, m/s) | way [m] | Δx [m] | ΔR [deg] | height gained: MuJoCo, here [m] |")
    print("|---|---|---|---|---|---|")
    for name, case in cases().items():
        if options.only and name not in options.only:
            continue
        for twist in case.twists:
            row = compare(case, twist)
            way = row["height_m"]
            print(
                f"| {name} | {twist} | {row['distance_m']:.2f} | {row['position_error_m']:.3f} | "
                f"{row['rotation_error_deg']:.1f} | {way[0]:.3f}, {way[1]:.3f} |",
                flush=True,
            )
            rows.append(
                {"case": name, "twist": twist} | {k: v for k, v in row.items() if k not in ("mujoco", "rollout")}
            )
    if options.json:
        write_text(options.json, json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
