"""Clusters of body points, and forces summed without a look at each point."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from monoforce_ros.physics import State, rollout
from monoforce_ros.physics.clusters import point_clusters
from monoforce_ros.physics.contact_summary import ContactSummary
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

SUMS = ("load", "traction", "sides", "push", "force")


def test_every_point_is_in_one_cluster_and_in_its_boxes():
    points = load_robot("marv").points.double()
    found = point_clusters(points)
    clusters, groups = found.clusters, found.groups
    assert sorted(found.order.tolist()) == list(range(len(points)))
    assert int(clusters.edges[0]) == 0 and int(clusters.edges[-1]) == len(points)
    assert int(groups.edges[0]) == 0 and int(groups.edges[-1]) == len(clusters.centres)
    for k, (first, last) in enumerate(zip(clusters.edges[:-1], clusters.edges[1:], strict=True)):
        away = (points[found.order[first:last]] - clusters.centres[k]).abs()
        assert 1 <= len(away) <= 8 and bool((away < clusters.halves[k]).all())
    for k, (first, last) in enumerate(zip(groups.edges[:-1], groups.edges[1:], strict=True)):
        away = (points[found.order[clusters.edges[first] : clusters.edges[last]]] - groups.centres[k]).abs()
        assert 1 <= len(away) <= 64 and bool((away < groups.halves[k]).all())
    # Small against the robot, or they tell nothing.
    assert float(clusters.radii.median()) < 0.2 * float(np.ptp(points.numpy(), axis=0).max())


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), resolution=st.sampled_from([0.05, 0.1, 0.37]), spread=st.floats(0.01, 1.5))
def test_the_ceiling_is_never_below_ground_that_a_cluster_may_touch(seed, resolution, spread):
    random = np.random.default_rng(seed)
    grid = Grid(17, 23, resolution, (-1.3, 0.4))
    height = torch.from_numpy(random.normal(size=(17, 23)))
    points = torch.from_numpy(random.normal(size=(40, 3)) * spread)
    found = point_clusters(points)
    boxes = found.clusters
    ceiling = boxes.ceiling(height[None], resolution)[0].numpy()
    turn = torch.from_numpy(np.linalg.qr(random.normal(size=(3, 3)))[0])
    place = torch.from_numpy(random.uniform(-3, 6, size=3))

    def nodes(x, low, cells):
        return np.clip((x - low) / resolution, 0, cells - 1)

    for k, (first, last) in enumerate(zip(boxes.edges[:-1], boxes.edges[1:], strict=True)):
        middle = (place + turn @ boxes.centres[k]).numpy()
        row = int(nodes(middle[1], grid.origin[1], 17) + 0.5)
        column = int(nodes(middle[0], grid.origin[0], 23) + 0.5)
        for x, y, _ in (place + points[found.order[first:last]] @ turn.T).numpy():
            r, c = (min(int(nodes(v, low, n)), n - 2) for v, low, n in ((y, 0.4, 17), (x, -1.3, 23)))
            assert ceiling[row, column] >= float(height[r : r + 2, c : c + 2].max())


def fallen(size: int):
    """Robots over bumps and a step, thrown so that belts, hull and walls are touched."""
    grid = Grid.square(6.4, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    height = 0.1 * np.sin(2 * x) * np.cos(3 * y) + 0.6 * (x > 1.2)
    terrain = TerrainMap.from_height(torch.from_numpy(height), grid)
    husky = load_robot("husky").to(torch.float64)
    state = State.at_rest(0.5, batch=size, dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(size, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn).sign()[:, None, None]
    rotation = torch.where((torch.arange(size) % 2 == 0)[:, None, None], state.rotation, turn)
    velocity = torch.tensor([1.2, 0.1, 0.0], dtype=torch.float64).expand(size, 3)
    state = State(state.position, rotation, velocity, state.angular_velocity)
    speeds = torch.full((size, 90, 2), 1.0, dtype=torch.float64)
    speeds[:, :, 0] -= torch.linspace(0, 0.6, size, dtype=torch.float64)[:, None]
    return terrain, husky, speeds, state


def test_leaving_out_clusters_in_the_air_changes_nothing():
    terrain, husky, speeds, state = fallen(12)
    first, second = (rollout(terrain, husky, speeds, state, backend=b) for b in ("torch", "warp"))
    assert float(first.forces.norm(dim=-1).amax()) > 100.0
    for name in ("position", "rotation", "forces"):
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize("every", [1, 4])
def test_sums_are_those_of_the_points(every):
    terrain, husky, speeds, state = fallen(12)
    outcomes = [
        rollout(terrain, husky, speeds, state, with_forces=False, with_contact=True, force_every=every, backend=b)
        for b in ("torch", "warp")
    ]
    points = rollout(terrain, husky, speeds, state, force_every=every)
    expected = ContactSummary.of_points(
        husky, points.rotation[:, :-1:every], points.normal_forces, points.tangential_forces, points.forces
    )
    # Of each kind there must be something to sum up.
    assert all(float(getattr(expected, name).abs().max()) > 1.0 for name in SUMS)
    assert float(expected.load[..., -1].max()) > 1.0
    torch.testing.assert_close(expected.load.sum(-1), points.normal_forces.sum(-1))
    for outcome in outcomes:
        assert outcome.forces is None and outcome.force_every == every
        for name in SUMS:
            torch.testing.assert_close(getattr(outcome.contact, name), getattr(expected, name), rtol=1e-6, atol=1e-5)


def test_sums_carry_gradients():
    terrain, husky, speeds, state = fallen(3)
    given = speeds.clone().requires_grad_()
    gradients = []
    for backend in ("torch", "warp"):
        found = rollout(
            terrain, husky, given[:, :20], state, with_forces=False, with_contact=True, force_every=3, backend=backend
        ).contact
        total = sum(getattr(found, name).square().sum() for name in SUMS)
        gradients.append(torch.autograd.grad(total, given)[0])
    assert float(gradients[0].abs().max()) > 0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-6, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(reach=st.integers(0, 12), rows=st.integers(1, 30), columns=st.integers(1, 30))
def test_the_ceiling_is_the_highest_node_within_reach(reach, rows, columns):
    height = torch.randn(2, rows, columns)
    boxes = point_clusters(torch.zeros(1, 3)).clusters
    boxes = dataclasses.replace(boxes, halves=torch.tensor([[max(reach - 2.0, 0.0), 0.0, 0.0]]))
    reach = max(reach, 2)
    pooled = torch.nn.functional.max_pool2d(height[:, None], 2 * reach + 1, 1, reach)[:, 0]
    assert torch.equal(boxes.ceiling(height, 1.0), pooled)
