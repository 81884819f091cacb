"""The Neural-ODE variant integrates the same physics."""

import dataclasses

import numpy as np
import pytest
import torch

from monoforce_ros.effects import drive_speeds
from monoforce_ros.physics import OdeOptions, PhysicsOptions, State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

GRID = Grid.square(8.0, 0.1)


def case(steps=60):
    robot = load_robot("husky", spacing=0.08).to(torch.float64)
    x, y = (torch.from_numpy(v) for v in np.meshgrid(GRID.x, GRID.y))
    terrain = TerrainMap.from_height(0.05 * torch.sin(1.3 * x) * torch.cos(0.9 * y), GRID)
    speeds = robot.drive_speeds(torch.tensor([0.7, 0.5]).double().expand(1, steps, 2))
    return terrain, robot, speeds, State.at_rest(0.15, dtype=torch.float64)


@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_solvers_agree_with_the_rollout_at_a_short_time_step(method):
    terrain, robot, speeds, state = case()
    solved = rollout(terrain, robot, speeds, state, ode=OdeOptions(method=method))
    fine = rollout(terrain, robot, speeds.repeat_interleave(10, dim=1), state, options=PhysicsOptions(time_step=0.001))
    assert float((solved.position - fine.position[:, ::10]).norm(dim=-1).max()) < 0.005
    identity = solved.rotation @ solved.rotation.transpose(-1, -2)
    assert float((identity - torch.eye(3)).abs().max()) < 1e-9


def test_gradients_by_adjoint_agree_with_those_through_the_solver():
    terrain, robot, speeds, state = case(12)
    gradients = []
    for adjoint in (False, True):
        height = terrain.height.clone().requires_grad_(True)
        bumps = dataclasses.replace(terrain, height=height)
        options = OdeOptions(method="rk4", step=0.0005, adjoint=adjoint)
        rollout(bumps, robot, speeds, state, ode=options).position[0, -1].sum().backward()
        gradients.append(height.grad)
    scale = float(gradients[0].abs().max())
    assert scale > 0 and float((gradients[0] - gradients[1]).abs().max()) < 0.02 * scale


PARAMETERS = {
    "payload": {"mass": 6.0, "x": 0.1, "y": -0.05, "z": 0.2},
    "gravity_tilt": {"about_x": 0.04, "about_y": -0.03},
    "rolling_resistance": {"coefficient": 0.1},
    "vegetation_drag": {"coefficient": 2e4, "yield_speed": 0.3},
    "viscous_drag": {"coefficient": 30.0},
    "quadratic_drag": {"coefficient": 20.0},
    "constant_force": {"x": 20.0, "y": -10.0},
    "learned_term": {"force_x:vx": -10.0, "torque_z:wz": -5.0},
    "friction_scale": {"factor": 0.8},
    "friction_creep": {"factor": 2.0},
    "terrain_softness": {"factor": 2.0},
    "drive_gain": {"gain": 0.9},
    "actuator_lag": {"time_constant": 0.2},
}


def test_the_adjoint_gives_the_gradient_of_every_parameter():
    terrain, robot, _, state = case(8)
    robot = load_robot("husky", spacing=0.12).to(torch.float64)
    gradients = []
    for adjoint in (False, True):
        height = terrain.height.clone().requires_grad_(True)
        # Vegetation depends on the height too: neither path may be lost or counted twice.
        ground = dataclasses.replace(terrain, height=height, geometric_height=terrain.height + 0.15)
        values = {
            (name, key): torch.tensor(value, dtype=torch.float64, requires_grad=True)
            for name, parameters in PARAMETERS.items()
            for key, value in parameters.items()
        }
        effects = tuple((name, {key: values[name, key] for key in keys}) for name, keys in PARAMETERS.items())
        loaded = dataclasses.replace(robot, effects=effects)
        velocity = torch.tensor([[0.5, 0.05, 0.0]], dtype=torch.float64, requires_grad=True)
        ramp = torch.linspace(0.3, 1.0, 8, dtype=torch.float64)[:, None]
        speeds = drive_speeds(loaded, (ramp * torch.tensor([0.7, 0.5]))[None], 0.01)
        start = dataclasses.replace(state, velocity=velocity)
        options = OdeOptions(method="rk4", step=0.0005, adjoint=adjoint)
        result = rollout(ground, loaded, speeds, start, ode=options)
        # Of attitude and motion, each in units of its own size.
        (result.position[0, -1].sum() + result.velocity[0, -1].sum() + 3.0 * result.rotation[0, -1, 2, 0]).backward()
        found = {name: value.grad for name, value in values.items()}
        gradients.append(found | {("height", ""): height.grad, ("velocity", ""): velocity.grad})
    for name, expected in gradients[0].items():
        got, scale = gradients[1][name], float(expected.abs().max())
        assert scale > 0.0, name
        assert got is not None, name
        assert float((got - expected).abs().max()) < 0.02 * scale, name


def test_friction_that_is_mobilised_at_little_slip_is_integrated_in_shorter_steps():
    """At steps of 1 ms the derivative by the factor grows to 1e21 within 0.6 s, and the robot trembles."""
    robot = load_robot("husky", spacing=0.3).to(torch.float64)
    value = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    robot = dataclasses.replace(robot, effects=(("friction_creep", {"factor": value}),))
    speeds = torch.full((1, 40, 2), 0.5, dtype=torch.float64)
    state = State.at_rest(0.14, dtype=torch.float64)
    result = rollout(TerrainMap.flat(GRID).to(torch.float64), robot, speeds, state, ode=OdeOptions(), with_forces=False)
    assert float(result.angular_velocity[0, -5:].detach().abs().max()) < 0.05
    # Straight ahead it hardly matters at which slip friction is mobilised.
    (derivative,) = torch.autograd.grad(result.position[0, -1, 0], value)
    assert abs(float(derivative)) < 0.01


@pytest.mark.parametrize("adjoint", [False, True])
def test_forces_are_returned(adjoint):
    terrain, robot, speeds, state = case(40)
    options = OdeOptions(method="rk4", adjoint=adjoint)
    solved = rollout(terrain, robot, speeds, state, ode=options, with_forces=True, with_contact=True, force_every=10)
    fine = rollout(terrain, robot, speeds.repeat_interleave(10, dim=1), state, options=PhysicsOptions(time_step=0.001))
    assert solved.normal_forces.shape == (1, 4, len(robot.points)) and float(solved.normal_forces.min()) >= 0.0
    weight = float(robot.mass) * 9.81
    for name in ("normal_forces", "forces", "tangential_forces"):
        got, expected = getattr(solved, name).sum(2), getattr(fine, name)[:, ::100].sum(2)
        assert float((got - expected).abs().max()) < 0.03 * max(weight, float(expected.abs().max())), name
    assert float((solved.contact.force - solved.forces.sum(2)).abs().max()) < 1e-9
    without = rollout(terrain, robot, speeds, state, ode=options, with_forces=False)
    assert without.forces is None and torch.equal(without.position, solved.position)


def test_unknown_solvers_are_named():
    with pytest.raises(ValueError, match="ode method: got 'magic', expected one of"):
        OdeOptions(method="magic")
