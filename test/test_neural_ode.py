"""The Neural-ODE variant integrates the same physics."""

import dataclasses

import numpy as np
import pytest
import torch

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


def test_unknown_solvers_are_named():
    with pytest.raises(ValueError, match="ode method: got 'magic', expected one of"):
        OdeOptions(method="magic")
