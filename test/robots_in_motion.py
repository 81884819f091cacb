"""Robots with joints for tests: files written from a few lines, and rollouts on level ground."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
import yaml
from torch import Tensor

from monoforce_ros.physics import Rollout, State, rest_depth, rollout
from monoforce_ros.robots import Controls, RobotModel, load_robot
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

STIFFNESS = 2e6


def car(**changes) -> dict:
    """A car with rear-wheel drive, 2.8 m between the axles."""
    corners = [
        ("front_left", 1.4, 0.75),
        ("front_right", 1.4, -0.75),
        ("rear_left", -1.4, 0.75),
        ("rear_right", -1.4, -0.75),
    ]
    content = {
        "name": "car",
        "mass": 1500.0,
        "centre_of_mass": [0.0, 0.0, 0.25],
        "inertia_box": [4.0, 1.7, 1.3],
        "command": {"track_width": 1.5},
        "drive": {"kind": "ackermann"},
        "wheels": [
            {"name": name, "drive": "rear" if x < 0 else None, "centre": [x, y, 0.0], "radius": 0.38, "width": 0.25}
            for name, x, y in corners
        ],
        "steering": [
            {"name": f"{name}_steering", "wheel": name, "maximum_angle": 0.6} for name in ("front_left", "front_right")
        ],
        "hull": [{"name": "body", "centre": [0.0, 0.0, 0.5], "size": [4.0, 1.6, 0.8]}],
    }
    return content | changes


def written(folder: Path, content: dict, *, double: bool = True) -> RobotModel:
    """The robot of a file with this content."""
    path = folder / f"{content['name']}.yaml"
    path.write_text(yaml.safe_dump(content))
    return load_robot(path).to(torch.float64 if double else torch.float32)


def level(friction: float = 1.0, size: float = 60.0, resolution: float = 0.5) -> TerrainMap:
    """Level ground in double precision."""
    grid = Grid.square(size, resolution)
    height = torch.zeros(grid.rows, grid.columns, dtype=torch.float64)
    return TerrainMap.from_height(height, grid, material=TerrainDefaults(stiffness=STIFFNESS, friction=friction))


def standing(robot: RobotModel, forward: float = 0.0) -> State:
    """The robot on level ground, at the depth at which it rests, moving forward [m/s]."""
    height = robot.ground_clearance - rest_depth(robot, STIFFNESS)
    state = State.at_rest(height, dtype=robot.points.dtype)
    velocity = state.velocity.clone()
    velocity[:, 0] = forward
    return State(state.position, state.rotation, velocity, state.angular_velocity)


def driven(robot: RobotModel, controls: Controls, terrain: TerrainMap, start: State, **options) -> Rollout:
    """A rollout with what its checks need."""
    result = rollout(terrain, robot, controls, start, **options)
    assert bool(result.valid.all())
    return result


def hills(resolution: float = 0.2, size: float = 30.0) -> TerrainMap:
    """Smooth hills in double precision."""
    grid = Grid.square(size, resolution)
    x, y = (torch.from_numpy(values).double() for values in np.meshgrid(grid.x, grid.y))
    return TerrainMap.from_height(0.05 * torch.sin(0.9 * x + 0.3) * torch.cos(0.7 * y), grid)


BACKENDS = ("torch", "warp")
MOTION = ("position", "rotation", "velocity", "angular_velocity", "joint_angles", "joint_rates", "drive_speeds")
FORCES = ("normal_forces", "tangential_forces", "forces")


def outcome(robot: RobotModel, given: Mapping[str, Tensor], backend: str) -> tuple[Tensor, Rollout]:
    """A number to which every component of a rollout over hills contributes, and the rollout.

    ``given`` has fields of :class:`Controls`, and ``height``, ``velocity``, ``angular_velocity``, ``mass`` and
    ``centre_of_mass``.
    """
    controls = Controls(**{name: value for name, value in given.items() if name in CONTROLS})
    robot = dataclasses.replace(robot, mass=given["mass"], centre_of_mass=given["centre_of_mass"])
    batch, steps, _ = controls.drive_speeds.shape
    state = State.at_rest(robot.ground_clearance + 0.01, batch=batch, dtype=torch.float64)
    state = dataclasses.replace(state, velocity=given["velocity"], angular_velocity=given["angular_velocity"])
    terrain = hills()
    terrain = TerrainMap.from_height(given["height"], terrain.grid)
    result = rollout(terrain, robot, controls, state, backend=backend)
    weights = torch.linspace(0.5, 1.5, steps + 1).double()[:, None]
    weight = 1e3  # [N]
    total = (
        (weights * result.position * torch.tensor([1.0, 2.0, 3.0])).sum()
        + (result.rotation[:, -1] * torch.arange(9.0).reshape(3, 3)).sum()
        + 0.3 * result.velocity.sum()
        + 0.1 * result.angular_velocity.sum()
        + (result.forces[:, -1].sum() + result.normal_forces[:, 3].square().sum() / weight) / weight
        + result.joint_angles.square().sum()
        + 0.1 * result.joint_rates.square().sum()
        + 0.1 * result.drive_speeds.square().sum()
    )
    return total, result


CONTROLS = tuple(field.name for field in dataclasses.fields(Controls))


def inputs(robot: RobotModel, controls: Controls) -> dict[str, Tensor]:
    """Inputs of :func:`outcome`, every one with a gradient."""
    batch = controls.drive_speeds.shape[0]
    named = {name: getattr(controls, name) for name in CONTROLS}
    given = {name: value.clone() for name, value in named.items() if value is not None}
    given["height"] = hills().height.clone()
    given["velocity"] = torch.tensor([0.5, 0.1, -0.1]).double().repeat(batch, 1)
    given["angular_velocity"] = torch.tensor([0.05, -0.1, 0.2]).double().repeat(batch, 1)
    given["mass"], given["centre_of_mass"] = robot.mass.clone(), robot.centre_of_mass.clone()
    return {name: value.requires_grad_(True) for name, value in given.items()}


def check_backends_agree(robot: RobotModel, controls: Controls) -> None:
    """Both backends have the same motion, forces and gradients in double precision."""
    found = []
    for backend in BACKENDS:
        given = inputs(robot, controls)
        total, result = outcome(robot, given, backend)
        found.append((result, torch.autograd.grad(total, list(given.values()), allow_unused=True), given))
    (first, first_gradients, given), (second, second_gradients, _) = found
    for name in (*MOTION, *FORCES):
        one, other = getattr(first, name).detach(), getattr(second, name).detach()
        assert float((one - other).abs().amax() if one.numel() else 0.0) < 1e-8, name
    for name, one, other in zip(given, first_gradients, second_gradients, strict=True):
        one = torch.zeros(1).double() if one is None else one
        other = torch.zeros(1).double() if other is None else other
        if one.numel():
            assert float((one - other).abs().max()) <= 1e-8 * max(float(one.abs().max()), 1e-9), name


def check_gradient(robot: RobotModel, controls: Controls, name: str, backend: str = "warp") -> None:
    """The gradient by one input is that of central differences."""
    given = inputs(robot, controls)
    (gradient,) = torch.autograd.grad(outcome(robot, given, backend)[0], given[name])
    base = given[name].detach()
    direction = torch.randn(base.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    # Short enough that no point crosses into another cell of the map, where the normal jumps.
    step = 3e-7 * max(0.1, float(base.abs().mean()))
    values = []
    with torch.no_grad():
        # Five points: the error of the difference itself is far below the tolerance.
        for factor in (-2, -1, 1, 2):
            given[name] = base + factor * step * direction
            values.append(float(outcome(robot, given, backend)[0]))
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
    analytic = float((gradient * direction).sum())
    assert abs(analytic) > 0
    assert abs(analytic - numeric) <= 1e-5 * max(abs(numeric), abs(analytic)), (analytic, numeric)
