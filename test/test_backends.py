"""The compiled backend against the reference, beyond what the physics and gradient tests compare."""

import dataclasses

import numpy as np
import pytest
import torch

from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.physics.warp_launch import chunks
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

FIELDS = ("position", "rotation", "velocity", "angular_velocity", "normal_forces", "tangential_forces", "forces")
GRID = Grid(90, 120, 0.1, (-4.0, -4.5))  # neither square nor centred


def bumps(seed: int, dtype=torch.float64) -> TerrainMap:
    x, y = np.meshgrid(GRID.x, GRID.y)
    phase = np.random.default_rng(seed).uniform(0, 6, 2)
    height = 0.08 * np.sin(1.5 * x + phase[0]) * np.cos(1.1 * y + phase[1])
    return TerrainMap.from_height(torch.from_numpy(height).to(dtype), GRID)


def batch(size: int, steps: int, dtype=torch.float64):
    robot = load_robot("husky").to(dtype)
    speed = torch.linspace(-0.4, 1.0, size, dtype=dtype)
    turn = torch.linspace(-0.8, 0.8, size, dtype=dtype)
    twists = torch.stack([speed, turn], dim=-1)[:, None].expand(size, steps, 2)
    return robot, robot.drive_speeds(twists), State.at_rest(0.16, batch=size, dtype=dtype)


@pytest.mark.parametrize("size", [1, 7, 33])
def test_batches_of_any_size_agree(size):
    robot, speeds, state = batch(size, 60)
    first, second = (rollout(bumps(0), robot, speeds, state, backend=b) for b in ("torch", "warp"))
    for field in FIELDS:
        assert float((getattr(first, field) - getattr(second, field)).abs().max()) < 1e-9, field
    assert torch.equal(first.inside, second.inside)


def test_each_trajectory_may_have_its_own_map_and_robot():
    robot, speeds, state = batch(5, 60)
    terrain = TerrainMap.stack([bumps(seed) for seed in range(5)])
    robot = dataclasses.replace(
        robot,
        mass=torch.linspace(30, 70, 5, dtype=torch.float64),
        centre_of_mass=robot.centre_of_mass + 0.05 * torch.randn(5, 3, generator=torch.Generator().manual_seed(0)),
        friction_lateral=torch.linspace(0.5, 1.0, 5, dtype=torch.float64),
    )
    first, second = (rollout(terrain, robot, speeds, state, backend=b) for b in ("torch", "warp"))
    for field in FIELDS:
        assert float((getattr(first, field) - getattr(second, field)).abs().max()) < 1e-9, field
    alone = rollout(bumps(3), dataclasses.replace(
        robot, mass=robot.mass[3], centre_of_mass=robot.centre_of_mass[3], friction_lateral=robot.friction_lateral[3]
    ), speeds[3:4], State(*(getattr(state, f.name)[3:4] for f in dataclasses.fields(state))))  # fmt: skip
    assert float((alone.position[0] - second.position[3]).abs().max()) < 1e-9


def test_single_precision_follows_double_precision():
    robot, speeds, state = batch(16, 500)
    exact = rollout(bumps(1), robot, speeds, state, with_forces=False)
    robot, speeds, state = batch(16, 500, torch.float32)
    quick = rollout(bumps(1, torch.float32), robot, speeds, state, with_forces=False)
    assert quick.position.dtype == torch.float32
    assert float((exact.position - quick.position).norm(dim=-1).median()) < 1e-4
    assert float((exact.position - quick.position).norm(dim=-1).max()) < 0.01


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("backward", [True, False])
@pytest.mark.parametrize(
    ("first", "count", "steps"), [(0, 1, 500), (3, 29, 500), (0, 2100, 500), (0, 9, 10**7), (0, 4, 0)]
)
def test_launches_take_each_trajectory_of_a_share_once(device, backward, first, count, steps):
    parts = chunks((first, count), steps, torch.device(device), backward=backward)
    assert [i for start, width in parts for i in range(start, start + width)] == list(range(first, first + count))


def test_a_gpu_gets_a_batch_at_once_also_backwards():
    # In parts of eight, 32 trajectories took four times as long as eight on an H100.
    assert chunks((0, 512), 500, torch.device("cuda"), backward=True) == [(0, 512)]


def test_a_batch_split_over_threads_has_the_gradient_of_its_parts():
    robot, speeds, state = batch(24, 40)
    gradients = []
    for part in (slice(0, 24), slice(0, 12), slice(12, 24)):
        height = bumps(2).height.clone().requires_grad_(True)
        terrain = TerrainMap.from_height(height, GRID)
        start = State(*(getattr(state, f.name)[part] for f in dataclasses.fields(state)))
        rollout(terrain, robot, speeds[part], start, with_forces=False).position.sum().backward()
        gradients.append(height.grad)
    scale = float(gradients[0].abs().max())
    assert float((gradients[0] - gradients[1] - gradients[2]).abs().max()) < 1e-11 * scale


def test_a_rollout_of_no_steps_is_its_start():
    robot, speeds, state = batch(2, 0)
    result = rollout(bumps(0), robot, speeds, state)
    assert result.position.shape == (2, 1, 3) and torch.equal(result.position[:, 0], state.position)


def test_unknown_backends_are_named():
    robot, speeds, state = batch(1, 2)
    with pytest.raises(ValueError, match="backend: got 'abacus', expected one of"):
        rollout(bumps(0), robot, speeds, state, backend="abacus")


def test_unknown_friction_and_centre_of_mass_are_recovered_by_gradient_descent():
    robot, _, state = batch(6, 120)
    twists = torch.tensor([[0.5, 1.0], [0.8, -1.0], [0.0, 1.5], [0.6, 0.5], [-0.5, 0.8], [1.0, 0.0]]).double()
    speeds = robot.drive_speeds(twists[:, None].expand(6, 120, 2))
    state = dataclasses.replace(state, position=state.position * 0.8)
    x = torch.from_numpy(np.meshgrid(GRID.x, GRID.y)[0])

    def predict(low, high, offset):
        # Two kinds of ground side by side.
        friction = torch.where(x < 0.3, low, high)
        terrain = dataclasses.replace(bumps(0), friction=friction)
        shifted = dataclasses.replace(robot, centre_of_mass=torch.stack([offset, 0 * offset, 0 * offset + 0.05]))
        return rollout(terrain, shifted, speeds, state, with_forces=False)

    truth = torch.tensor([0.35, 0.7, 0.06], dtype=torch.float64)
    with torch.no_grad():
        target = predict(*truth)
    guess = torch.tensor([0.6, 0.6, 0.0], dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([guess], lr=0.03)
    for step in range(150):
        optimiser.param_groups[0]["lr"] = 0.03 * (1 - step / 150) + 1e-4
        optimiser.zero_grad()
        result = predict(*guess)
        loss = ((result.position - target.position) ** 2).sum() + ((result.rotation - target.rotation) ** 2).sum()
        loss.backward()
        optimiser.step()
    np.testing.assert_allclose(guess.detach().numpy(), truth.numpy(), atol=0.02)


def test_an_unknown_control_is_recovered_from_its_trajectory():
    robot, _, state = batch(1, 100)
    truth = robot.drive_speeds(torch.tensor([0.7, 0.6]).double().expand(1, 100, 2))
    target = rollout(bumps(0), robot, truth, state, with_forces=False)
    guess = torch.full((1, 2), 0.2, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([guess], max_iter=40, line_search_fn="strong_wolfe")

    def loss():
        optimiser.zero_grad()
        result = rollout(bumps(0), robot, guess[:, None].expand(1, 100, 2), state, with_forces=False)
        error = ((result.position - target.position) ** 2).sum()
        error.backward()
        return error

    optimiser.step(loss)
    np.testing.assert_allclose(guess.detach().numpy(), truth[:, 0].numpy(), atol=0.02)


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_forces_of_every_fifth_step_are_those_of_all(backend):
    husky = load_robot("husky")
    grid = Grid.square(6.4, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    heights = torch.from_numpy(0.05 * np.sin(2 * x) * np.cos(3 * y)).requires_grad_()
    terrain = TerrainMap.from_height(heights, grid)
    speeds = torch.full((20, 43, 2), 0.5, dtype=torch.float64)
    speeds[:, :, ::2] += torch.linspace(-0.3, 0.3, 20, dtype=torch.float64)[:, None, None]
    state = State.at_rest(0.2, batch=20, dtype=torch.float64)
    whole = rollout(terrain, husky, speeds, state, backend=backend)
    some = rollout(terrain, husky, speeds, state, backend=backend, force_every=5)
    assert some.force_every == 5 and some.forces.shape[:2] == (20, 9)
    for name in ("forces", "normal_forces", "tangential_forces"):
        torch.testing.assert_close(getattr(some, name), getattr(whole, name)[:, ::5])
    (gradient,) = torch.autograd.grad((some.forces**2).sum(), heights)
    heights.grad = None
    (expected,) = torch.autograd.grad((whole.forces[:, ::5] ** 2).sum(), heights)
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="every 0 steps"):
        rollout(terrain, husky, speeds, state, backend=backend, force_every=0)


@pytest.mark.parametrize("lookup", ["bilinear", "constant"])
@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_a_trajectory_that_diverges_on_its_way_is_marked_and_leaves_the_others(backend, lookup):
    robot, speeds, state = batch(2, 150, dtype=torch.float32)
    # Torque that grows with the turn: explicit, and far beyond what a step can hold.
    weights = {"torque_z:wz": torch.tensor([0.0, 2000.0]), "torque_z:1": torch.tensor([0.0, 50.0])}
    wild = dataclasses.replace(robot, effects=(("learned_term", weights),))
    options = PhysicsOptions(lookup=lookup)
    result = rollout(bumps(0, torch.float32), wild, speeds, state, backend=backend, options=options)
    calm = rollout(bumps(0, torch.float32), robot, speeds, state, backend=backend, options=options)
    assert result.valid.tolist() == [True, False]
    assert torch.equal(result.position[0], calm.position[0])
    assert torch.isnan(result.position[1]).all()
