"""Soft soil against Bekker's, Janosi's and Wong's closed forms, and what follows from them for a whole robot."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import yaml
from scipy.integrate import quad
from scipy.optimize import brentq

from monoforce_ros.physics import SOILS, OdeOptions, PhysicsOptions, Soil, SoilError, State, read_soil, rollout
from monoforce_ros.physics.body_contact import BodyContact
from monoforce_ros.physics.problem import Problem
from monoforce_ros.physics.soil import LIMITS
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

SAND = SOILS["dry_sand"]
RADIUS, WIDTH = 0.25, 0.15
GRID = Grid.square(16.0, 0.2)


def double(robot):
    return robot.to(torch.float64)


def flat() -> TerrainMap:
    return TerrainMap.flat(GRID, dtype=torch.float64)


@pytest.fixture(scope="module")
def husky():
    return double(load_robot("husky"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A single wheel, sampled every 4 mm."""
    content = {
        "name": "wheel", "mass": 30.0, "inertia_box": [0.4, 0.2, 0.4], "command": {"track_width": 0.3},
        "wheels": [{"name": "a", "drive": "a", "centre": [0, 0, 0], "radius": RADIUS, "width": WIDTH}],
    }  # fmt: skip
    path = tmp_path_factory.mktemp("robot") / "wheel.yaml"
    path.write_text(yaml.safe_dump(content))
    return double(load_robot(path, spacing=0.004))


def forces(robot, soil: Soil, depth: float, speed: float, rim: float) -> np.ndarray:
    """Force of the ground [N] on a robot whose lowest point is ``depth`` below the ground, moving along x."""
    state = State.at_rest(robot.ground_clearance - depth, dtype=torch.float64)
    options = PhysicsOptions(soil=soil, slip_regularisation=1e-4)
    rims = torch.full((1, 1, robot.number_of_drives), rim, dtype=torch.float64)
    problem, _ = Problem.pose(flat(), robot, rims, state, soil=soil)
    moving = torch.tensor([[speed, 0.0, 0.0]], dtype=torch.float64)
    _, touch = BodyContact.of(problem, options).at(
        0, problem.centre, problem.rotation, moving, torch.zeros_like(moving), step_time=0.0
    )
    return touch.vectors[0].sum(1).numpy()


def wong(soil: Soil, depth: float, slip: float) -> tuple[float, float]:
    """Load and drawbar pull [N] of a driven rigid wheel (Wong and Reece, 1967), pressure by Bekker and Lyasko."""
    modulus = soil.cohesive_modulus / WIDTH + soil.frictional_modulus
    dug = (1.0 + slip) / (1.0 - 0.5 * slip)
    entry = math.acos(1.0 - depth / RADIUS)

    def normal(angle):
        return modulus * max(RADIUS * (math.cos(angle) - math.cos(entry)) / dug, 0.0) ** soil.exponent

    def shear(angle):
        way = RADIUS * ((entry - angle) - (1.0 - slip) * (math.sin(entry) - math.sin(angle)))
        return (soil.cohesion + normal(angle) * soil.friction) * (1.0 - math.exp(-way / soil.shear_modulus))

    load = quad(lambda a: normal(a) * math.cos(a) + shear(a) * math.sin(a), 0.0, entry)[0]
    pull = quad(lambda a: shear(a) * math.cos(a) - normal(a) * math.sin(a), 0.0, entry)[0]
    return WIDTH * RADIUS * load, WIDTH * RADIUS * pull


def test_a_plate_sinks_as_bekker_says(tmp_path):
    content = {
        "name": "plate", "mass": 30.0, "inertia_box": [0.3, 0.2, 0.1], "command": {"track_width": 0.3},
        "wheels": [{"name": "a", "drive": "a", "centre": [0, 0, 0.5], "radius": 0.1, "width": 0.05}],
        "hull": [{"name": "plate", "centre": [0, 0, 0.05], "size": [0.3, 0.2, 0.1]}],
    }  # fmt: skip
    path = tmp_path / "plate.yaml"
    path.write_text(yaml.safe_dump(content))
    plate = double(load_robot(path))
    plate = plate.with_points(plate.point_drives < 0)
    for name, soil in SOILS.items():
        state = State.at_rest(-0.03, dtype=torch.float64)
        problem, _ = Problem.pose(flat(), plate, torch.zeros(1, 1, 1, dtype=torch.float64), state, soil=soil)
        still = torch.zeros(1, 3, dtype=torch.float64)
        body = BodyContact.of(problem, PhysicsOptions(soil=soil))
        _, touch = body.at(0, problem.centre, problem.rotation, still, still, step_time=0.0)
        modulus = soil.cohesive_modulus / 0.2 + soil.frictional_modulus
        expected = [0.0, 0.0, 0.3 * 0.2 * modulus * 0.03**soil.exponent]
        assert touch.vectors[0].sum(1).numpy() == pytest.approx(expected, rel=1e-3, abs=1e-6), name


def test_a_rolling_wheel_has_bekkers_load_and_resistance(wheel):
    soil = dataclasses.replace(SAND, friction=0.0, cohesion=0.0)
    modulus = soil.cohesive_modulus / WIDTH + soil.frictional_modulus
    for depth in (0.01, 0.03):
        resistance, _, load = forces(wheel, soil, depth, 1.0, 1.0)
        # His resistance is exact, his load an expansion for shallow contact.
        assert -resistance == pytest.approx(
            WIDTH * modulus * depth ** (soil.exponent + 1) / (soil.exponent + 1), rel=0.01
        )
        assert load == pytest.approx(wong(soil, depth, 0.0)[0], rel=0.01)
        shallow = WIDTH * modulus * math.sqrt(2 * RADIUS) * depth ** (soil.exponent + 0.5) * (3 - soil.exponent) / 3
        assert load == pytest.approx(shallow, rel=0.06)


def test_pull_first_rises_and_then_falls_with_slip_as_the_wheel_digs_in(wheel):
    loose = dataclasses.replace(SAND, frictional_modulus=4e5, shear_modulus=0.01)
    pulls, depths = [], []
    for slip in (0.02, 0.1, 0.3, 0.5, 0.8, 0.95):
        sunk = brentq(lambda depth, slip=slip: forces(wheel, loose, depth, 1.0 - slip, 1.0)[2] - 400.0, 1e-3, 0.24)
        pull = float(forces(wheel, loose, sunk, 1.0 - slip, 1.0)[0])
        closed = brentq(lambda depth, slip=slip: wong(loose, depth, slip)[0] - 400.0, 1e-3, 0.24)
        assert sunk == pytest.approx(closed, rel=0.04), slip
        assert pull == pytest.approx(wong(loose, closed, slip)[1], abs=0.05 * 400.0), slip
        pulls.append(pull)
        depths.append(sunk)
    assert np.all(np.diff(depths) > 0) and depths[-1] > 2.0 * depths[0]
    best = int(np.argmax(pulls))
    assert 0 < best < len(pulls) - 1 and pulls[-1] < 0.8 * pulls[best]


def test_pressure_rises_with_the_sinking_speed_and_soil_does_not_follow_a_surface_that_leaves(wheel):
    soil = dataclasses.replace(SAND, rate=2.0)
    state = State.at_rest(RADIUS - 0.03, dtype=torch.float64)
    problem, _ = Problem.pose(flat(), wheel, torch.zeros(1, 1, 1, dtype=torch.float64), state, soil=soil)
    body = BodyContact.of(problem, PhysicsOptions(soil=soil))
    found = []
    for velocity in (0.0, -0.1, 0.0005, 0.01):
        moving = torch.tensor([[0.0, 0.0, velocity]], dtype=torch.float64)
        _, touch = body.at(0, problem.centre, problem.rotation, moving, 0 * moving, step_time=0.0)
        found.append(float(touch.force[0, 0].sum()))
    still, sinking, rising, leaving = found
    assert 1.18 < sinking / still < 1.2  # points beside the lowest sink more slowly along their normal
    assert 0.5 < rising / still < 0.55 and leaving == 0.0


def drive(robot, soil, twist, seconds, *, start=None, terrain=None, backend="torch", heading=0.0, **more):
    state = start or State.at_rest(robot.ground_clearance - 0.01, heading=heading, dtype=torch.float64)
    steps = round(seconds / 0.01)
    speeds = robot.drive_speeds(torch.tensor(twist, dtype=torch.float64).expand(1, steps, 2))
    with torch.no_grad():
        return rollout(
            terrain or flat(), robot, speeds, state, options=PhysicsOptions(soil=soil), backend=backend,
            with_forces=False, **more,
        )  # fmt: skip


def sinkage(robot, result) -> float:
    return robot.ground_clearance - float(result.position[0, -1, 2])


@pytest.mark.parametrize("name", SOILS)
def test_a_robot_comes_to_rest_and_a_heavier_one_deeper(husky, name):
    # Permanently: what sank deeper than its equilibrium, because it was dropped, rises slower than 3 mm/s.
    depths = []
    for factor in (1.0, 2.0):
        loaded = dataclasses.replace(husky, mass=factor * husky.mass)
        start = State.at_rest(husky.ground_clearance, dtype=torch.float64)
        result = drive(loaded, SOILS[name], (0.0, 0.0), 1.5, start=start, backend="warp")
        assert float(result.velocity[0, -20:].abs().max()) < 3e-3
        assert float(result.velocity[0, :, 2].max()) < 3e-3
        depths.append(sinkage(loaded, result))
    assert depths[1] > 1.15 * depths[0]


@pytest.mark.parametrize("backend", ["torch", "warp"])
def test_a_held_back_robot_spins_its_wheels_and_digs_in(husky, backend):
    held = dataclasses.replace(husky, effects=(("constant_force", {"x": -320.0, "y": 0.0}),))
    rolling = drive(husky, SAND, (0.8, 0.0), 3.0, backend=backend)
    stuck = drive(held, SAND, (0.8, 0.0), 3.0, backend=backend)
    assert 0.5 < float(rolling.velocity[0, -1, 0]) < 0.75
    assert abs(float(stuck.velocity[0, -1, 0])) < 0.3
    assert sinkage(held, stuck) > 1.5 * sinkage(husky, rolling)
    # On ground as firm as usual the same force only slows the robot down a little.
    firm = drive(held, None, (0.8, 0.0), 3.0, backend=backend)
    assert float(firm.velocity[0, -1, 0]) > 0.7 and sinkage(held, firm) < 0.02


def test_results_depend_neither_on_the_sampling_nor_on_the_heading(husky):
    fine = double(load_robot("husky", spacing=0.0125))
    base = drive(husky, SAND, (0.8, 0.2), 3.0)
    dense = drive(fine, SAND, (0.8, 0.2), 3.0)
    turned = drive(husky, SAND, (0.8, 0.2), 3.0, heading=0.9)
    way = [float(result.position[0, -1, :2].norm()) for result in (base, dense, turned)]
    assert len(fine.points) > 8 * len(husky.points)
    assert way[1] == pytest.approx(way[0], rel=0.04) and way[2] == pytest.approx(way[0], rel=1e-6)
    assert sinkage(fine, dense) == pytest.approx(sinkage(husky, base), abs=0.003)


def test_a_kerb_stays_firm_in_soft_soil(husky):
    x = torch.from_numpy(GRID.x).expand(GRID.rows, -1)
    kerb = TerrainMap.from_height(0.4 * (x > 1.5).double(), GRID)
    result = drive(husky, SAND, (0.8, 0.0), 4.0, terrain=kerb)
    free = drive(husky, SAND, (0.8, 0.0), 4.0)
    assert float(free.position[0, -1, 0]) > 1.8
    assert float(result.position[0, -1, 0]) < 1.2


def test_neutral_options_are_firm_ground(husky):
    assert PhysicsOptions().soil is None
    with pytest.raises(ValueError, match="soil: got tangential_force 'sigmoid', expected 'coulomb'"):
        PhysicsOptions(soil=SAND, tangential_force="sigmoid")
    bare = dataclasses.replace(husky, point_widths=None)
    with pytest.raises(ValueError, match="soil: got robot 'husky' without point_widths"):
        drive(bare, SAND, (0.0, 0.0), 0.02)


STRONG = {"rate": 0.5, "slip_sinkage": 0.8, "unloading_speed": 0.05}
"""Values at which every parameter matters in a short rollout."""


def objective(given: dict[str, torch.Tensor], backend: str, robot) -> torch.Tensor:
    x, y = (torch.from_numpy(v) for v in np.meshgrid(GRID.x, GRID.y))
    height = given["height"] * torch.sin(1.7 * x + 0.4) * torch.cos(1.1 * y)
    soil = Soil(**{name: given[name] for name in LIMITS})
    speeds = robot.drive_speeds(torch.tensor([0.9, 0.6], dtype=torch.float64).expand(1, 40, 2)) * given["speed"]
    state = State.at_rest(robot.ground_clearance - 0.01, dtype=torch.float64)
    terrain = TerrainMap.from_height(height, GRID)
    result = rollout(terrain, robot, speeds, state, options=PhysicsOptions(soil=soil), backend=backend)
    return result.position[0, -1] @ result.position.new_tensor([1.0, 2.0, 3.0]) + 1e-5 * result.forces[0, -1].sum()


def given_values() -> dict[str, torch.Tensor]:
    values = dataclasses.asdict(SAND) | STRONG | {"height": 0.05, "speed": 1.0}
    return {name: torch.tensor(float(value), dtype=torch.float64) for name, value in values.items()}


def gradients(backend: str, robot) -> dict[str, float]:
    given = {name: value.clone().requires_grad_(True) for name, value in given_values().items()}
    found = torch.autograd.grad(objective(given, backend, robot), list(given.values()))
    return {name: float(value) for name, value in zip(given, found, strict=True)}


@pytest.fixture(scope="module")
def reference(husky):
    return gradients("torch", husky)


@pytest.mark.parametrize("name", [*LIMITS, "height", "speed"])
def test_gradients_match_finite_differences(husky, reference, name):
    given = given_values()
    step = 1e-6 * float(given[name])
    ends = []
    for sign in (1.0, -1.0):
        with torch.no_grad():
            ends.append(float(objective(given | {name: given[name] + sign * step}, "torch", husky)))
    numeric = (ends[0] - ends[1]) / (2 * step)
    assert reference[name] == pytest.approx(numeric, rel=1e-6, abs=1e-9 / float(given[name]))
    assert abs(reference[name]) * float(given[name]) > 1e-6


def test_both_backends_agree_with_gradients(husky, reference):
    with torch.no_grad():
        values = [float(objective(given_values(), backend, husky)) for backend in ("torch", "warp")]
    assert values[0] == pytest.approx(values[1], rel=1e-9)
    found = gradients("warp", husky)
    for name, value in reference.items():
        assert found[name] == pytest.approx(value, rel=1e-6), name


@pytest.mark.parametrize("name", ["marv", "rally_car"])
def test_backends_agree_for_robots_in_which_something_moves(name):
    robot = double(load_robot(name))
    results = [drive(robot, SAND, (0.6, 0.3), 0.5, backend=backend) for backend in ("torch", "warp")]
    assert float((results[0].position - results[1].position).abs().max()) < 1e-7


def test_the_neural_ode_variant_takes_soil(husky):
    soil = dataclasses.replace(SAND, unloading_speed=0.05)
    robot = husky.with_points(husky.point_drives >= 0)
    values = []
    for adjoint in (False, True):
        modulus = torch.tensor(SAND.frictional_modulus, dtype=torch.float64, requires_grad=True)
        result = rollout(
            flat(), robot, torch.full((1, 8, 2), 0.5, dtype=torch.float64),
            State.at_rest(robot.ground_clearance - 0.015, dtype=torch.float64), with_forces=False,
            options=PhysicsOptions(soil=dataclasses.replace(soil, frictional_modulus=modulus)),
            ode=OdeOptions(method="rk4", step=0.002, adjoint=adjoint),
        )  # fmt: skip
        values.append(float(torch.autograd.grad(result.position[0, -1, 2], modulus)[0]))
    assert values[0] > 0 and values[1] == pytest.approx(values[0], rel=0.05)


def test_the_modulus_is_recovered_from_how_deep_a_robot_sinks(husky):
    speeds = torch.full((1, 60, 2), 0.6, dtype=torch.float64)
    start = State.at_rest(husky.ground_clearance - 0.01, dtype=torch.float64)

    def predict(logarithm):
        soil = dataclasses.replace(SAND, frictional_modulus=torch.exp(logarithm))
        options = PhysicsOptions(soil=soil)
        return rollout(flat(), husky, speeds, start, options=options, with_forces=False, backend="torch").position

    truth = math.log(SAND.frictional_modulus)
    target = predict(torch.tensor(truth, dtype=torch.float64))
    guess = torch.tensor(truth + 0.2, dtype=torch.float64, requires_grad=True)
    tried = []
    for _ in range(8):
        residual = predict(guess)[0, :, 2] - target[0, :, 2]
        tried.append((float(residual.detach().square().mean()), float(guess.detach())))
        slope = torch.autograd.grad(residual.sum(), guess)[0] / len(residual)
        with torch.no_grad():
            guess -= residual.mean() / slope
    # Points that leave the soil and come back make the height jump by 2 mm: that is 15 % of the modulus.
    assert min(tried)[1] == pytest.approx(truth, abs=0.15)


def test_soils_by_name_and_file_and_their_errors(tmp_path):
    assert read_soil("") is None and read_soil("snow") is SOILS["snow"]
    file = tmp_path / "dune.yaml"
    file.write_text("soil: dry_sand\nshear_modulus: 0.01\n")
    assert read_soil(file) == dataclasses.replace(SAND, shear_modulus=0.01)
    for content, message in (
        ("exponent: 1.0\n", "got no cohesive_modulus, frictional_modulus, cohesion"),
        ("soil: dry_sand\nexponent: 9.0\n", "soil exponent: got 9.0, expected 0.1 to 3"),
        ("soil: dry_sand\nexponent: soft\n", "soil exponent: got 'soft'"),
        ("soil: dry_sand\nexponent: .nan\n", "soil exponent: got nan"),
        ("soil: quicksand\n", "soil: got 'quicksand', expected one of"),
        ("stiffness: 1.0\n", r"got \['stiffness'\], expected a mapping with some of"),
        ("- 1\n", "got list, expected a mapping"),
        ("a: [\n", "soil file"),
    ):
        file.write_text(content)
        with pytest.raises(SoilError, match=message):
            read_soil(file)
    with pytest.raises(SoilError, match="got 'mud', expected one of"):
        read_soil("mud")
    with pytest.raises(SoilError, match="soil file"):
        read_soil(tmp_path / "none.yaml")
    with pytest.raises(SoilError, match=r"soil exponent: got shape \(2,\), expected \[\] or \[3\]"):
        dataclasses.replace(SAND, exponent=torch.ones(2)).table(torch.zeros(1), 3)
