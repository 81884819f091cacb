"""What is kept from one rollout to the next never outlives what it was made from."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from monoforce_ros.effects import controls
from monoforce_ros.physics import State, rollout
from monoforce_ros.physics.identity_cache import IdentityCache
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap


def test_a_value_is_made_once_and_again_when_its_tensor_changed():
    cache, made = IdentityCache[float](2), []

    def total(values: torch.Tensor, factor: float = 1.0) -> float:
        def make() -> float:
            made.append(values)
            return factor * float(values.sum())

        return cache.get((values,), make, values=factor)

    ones = torch.ones(3)
    assert [total(ones), total(ones), len(made)] == [3.0, 3.0, 1]
    assert [total(ones, 2.0), total(ones), len(made)] == [6.0, 3.0, 2]
    ones += 1.0
    assert [total(ones), len(made)] == [6.0, 3]
    # The oldest ones go; a tensor of the same values is another one.
    for _ in range(3):
        total(torch.ones(3))
    assert len(made) == 6 and len(cache._entries) == 2
    assert total(ones) == 6.0 and len(made) == 7


def test_no_object_takes_the_place_of_one_that_is_gone():
    cache = IdentityCache[float](4)
    for value in range(50):
        fresh = torch.full((3,), float(value))
        assert cache.get((fresh,), lambda fresh=fresh: float(fresh[0])) == value
        del fresh


def test_nothing_is_kept_of_tensors_with_gradients_or_of_inference_mode():
    cache = IdentityCache[torch.Tensor]()
    leaf = torch.ones(2, requires_grad=True)
    first = cache.get((leaf,), lambda: 2 * leaf)
    assert cache.get((leaf,), lambda: 2 * leaf) is not first
    with torch.inference_mode():
        inferred = torch.ones(2)
        cache.get((inferred,), lambda: 2 * inferred)
    assert not cache._entries
    plain = torch.ones(2)
    with torch.inference_mode():
        assert not cache.get((plain,), lambda: 2 * plain).is_inference(), "it may be used outside of that mode, too"


@pytest.mark.parametrize("name", ["husky", "rally_car"])
def test_rollouts_follow_what_changes_between_them(name):
    """Points in place, another map, another mass, and the first ones again: always as a fresh robot does."""
    ground = Grid.square(6.4, 0.1)
    slope = torch.linspace(-0.2, 0.2, ground.columns).expand(ground.rows, -1)
    flat = TerrainMap.flat(ground)
    tilted = TerrainMap.from_height(slope.contiguous(), ground)

    def end(robot, terrain) -> torch.Tensor:
        given = controls(robot, torch.tensor([[[0.5, 0.2]]]).expand(1, 60, 2), 0.01)
        state = State.at_rest(robot.ground_clearance)
        return rollout(terrain, robot, given, state, with_forces=False, backend="warp").position[0, -1]

    robot = load_robot(name)
    raised = replace(robot, points=robot.points + torch.tensor([0.0, 0.0, 0.05]))
    expected = [end(load_robot(name), flat), end(load_robot(name), tilted), end(raised, flat)]
    assert torch.equal(end(robot, flat), expected[0]) and torch.equal(end(robot, tilted), expected[1])
    heavy = replace(robot, mass=1.5 * robot.mass)
    assert not torch.equal(end(heavy, flat), expected[0])
    robot.points.add_(torch.tensor([0.0, 0.0, 0.05]))
    assert torch.equal(end(robot, flat), expected[2])
    robot.points.sub_(torch.tensor([0.0, 0.0, 0.05]))
    torch.testing.assert_close(end(robot, flat), expected[0], rtol=0, atol=1e-5)
    flat.height.add_(0.1)
    assert float(end(robot, flat)[2]) > float(expected[0][2]) + 0.05


def test_rollouts_in_several_threads_do_not_share_what_they_write():
    robot, terrain = load_robot("rally_car"), TerrainMap.flat(Grid.square(12.8, 0.1))
    given = [
        controls(robot, torch.tensor([[[0.5, turn]]]).expand(width, 80, 2), 0.01)
        for turn, width in ((0.0, 1), (0.3, 3), (-0.3, 16), (0.6, 1), (0.1, 9))
    ]

    def end(entry) -> torch.Tensor:
        state = State.at_rest(robot.ground_clearance, batch=len(entry.drive_speeds))
        return rollout(terrain, robot, entry, state, with_forces=False, backend="warp").position[:, -1]

    alone = [end(entry) for entry in given]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(end, given * 8))
    for index, found in enumerate(together):
        assert torch.equal(found, alone[index % len(given)])
