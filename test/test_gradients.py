"""Gradients of the rollout in float64 against central differences, for every differentiable input."""

import dataclasses

import numpy as np
import pytest
import torch

from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.physics.rotation import exponential_map
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

GRID = Grid.square(6.0, 0.2)
STEPS = 25


def inputs() -> dict[str, torch.Tensor]:
    robot = load_robot("husky").to(torch.float64)
    x, y = (torch.from_numpy(v) for v in np.meshgrid(GRID.x, GRID.y))
    speeds = robot.drive_speeds(torch.tensor([0.7, 0.5], dtype=torch.float64).expand(1, STEPS, 2))
    full = torch.ones(GRID.rows, GRID.columns, dtype=torch.float64)
    return {
        "height": 0.05 * torch.sin(1.7 * x + 0.4) * torch.cos(1.1 * y),
        "stiffness": 2e6 * full,
        "damping": 4e4 * full,
        "friction": 0.8 * full,
        "speeds": speeds.clone(),
        "turn": torch.tensor([[0.05, -0.08, 0.3]], dtype=torch.float64),
        "position": torch.tensor([[0.1, -0.05, 0.16]], dtype=torch.float64),
        "velocity": torch.tensor([[0.5, 0.1, -0.1]], dtype=torch.float64),
        "angular_velocity": torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64),
        "mass": robot.mass.clone(),
        "centre_of_mass": robot.centre_of_mass.clone(),
        "inertia": robot.inertia.clone(),
        "friction_longitudinal": robot.friction_longitudinal.clone(),
        "friction_lateral": robot.friction_lateral.clone(),
    }


def outcome(given: dict[str, torch.Tensor], options: PhysicsOptions, backend: str) -> torch.Tensor:
    terrain = TerrainMap(
        given["height"],
        given["height"],
        given["stiffness"],
        given["damping"],
        given["friction"],
        torch.ones(GRID.rows, GRID.columns, dtype=torch.bool),
        GRID,
    )
    robot = dataclasses.replace(
        load_robot("husky").to(torch.float64),
        **{
            name: given[name]
            for name in ("mass", "centre_of_mass", "inertia", "friction_longitudinal", "friction_lateral")
        },
    )
    rotation = exponential_map(given["turn"])
    state = State(given["position"], rotation, given["velocity"], given["angular_velocity"])
    result = rollout(terrain, robot, given["speeds"], state, options=options, backend=backend)
    # Weights make every component count and none cancel.
    weights = torch.linspace(0.5, 1.5, STEPS + 1, dtype=torch.float64)[:, None]
    return (
        (weights * result.position[0] * torch.tensor([1.0, 2.0, 3.0])).sum()
        + (result.rotation[0, -1] * torch.arange(9.0).reshape(3, 3)).sum()
        + 0.3 * result.velocity[0].sum()
        + 0.1 * result.angular_velocity[0].sum()
        + 1e-3 * result.forces[0, -1].sum()
    )


BACKENDS = ["torch", "warp"]
TANGENTIAL = ["coulomb", "sigmoid"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("tangential", TANGENTIAL)
@pytest.mark.parametrize("name", sorted(inputs()))
def test_gradient_matches_finite_differences(name, tangential, backend):
    options = PhysicsOptions(tangential_force=tangential)
    given = inputs()
    given[name].requires_grad_(True)
    (gradient,) = torch.autograd.grad(outcome(given, options, backend), given[name])
    generator = torch.Generator().manual_seed(1)
    direction = torch.randn(given[name].shape, generator=generator, dtype=torch.float64)
    if name == "inertia":
        direction = direction + direction.T
    scale = max(1e-3, float(given[name].detach().abs().mean()))
    step = 1e-5 * scale
    with torch.no_grad():
        base = given[name].detach()
        values = []
        # Five points: the error of the difference itself is far below the tolerance.
        for factor in (-2, -1, 1, 2):
            given[name] = base + factor * step * direction
            values.append(float(outcome(given, options, backend)))
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
    analytic = float((gradient * direction).sum())
    assert abs(analytic) > 0
    # Rounding of the outcome, a sum over many steps, divided by the step of the difference.
    rounding = 10 * torch.finfo(torch.float64).eps * max(map(abs, values)) / step
    assert analytic == pytest.approx(numeric, rel=1e-6, abs=rounding)


@pytest.mark.parametrize("lookup", ["bilinear", "constant"])
@pytest.mark.parametrize("normal", ["normal", "vertical"])
@pytest.mark.parametrize("tangential", [*TANGENTIAL, "none"])
def test_both_backends_have_the_same_outcome_and_gradients(lookup, normal, tangential):
    options = PhysicsOptions(lookup=lookup, normal_force=normal, tangential_force=tangential)
    outcomes, gradients = [], []
    for backend in BACKENDS:
        given = {name: value.requires_grad_(True) for name, value in inputs().items()}
        outcomes.append(outcome(given, options, backend))
        gradients.append(torch.autograd.grad(outcomes[-1], list(given.values()), allow_unused=True))
    assert float(outcomes[1]) == pytest.approx(float(outcomes[0]), rel=1e-12)
    for name, first, second in zip(inputs(), *gradients, strict=True):
        first = torch.zeros(()) if first is None else first
        second = torch.zeros(()) if second is None else second
        scale = max(float(first.abs().max()), 1e-12)
        assert float((first - second).abs().max()) <= 1e-10 * scale, name
