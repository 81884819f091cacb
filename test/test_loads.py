"""External loads are the same formulas in PyTorch and in Warp."""

import dataclasses

import torch
import warp as wp
from scipy.spatial.transform import Rotation

from monoforce_ros.effects import FEATURES
from monoforce_ros.physics import State
from monoforce_ros.physics.loads import LoadModel
from monoforce_ros.physics.problem import Problem
from monoforce_ros.physics.warp_kernels import external_loads, types
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

EFFECTS = (
    ("gravity_tilt", {"about_x": 0.2, "about_y": -0.3}),
    ("viscous_drag", {"coefficient": 30.0}),
    ("quadratic_drag", {"coefficient": 20.0}),
    ("learned_term", {f"{row}:{name}": 3.0 + i for row in ("force_x", "torque_z") for i, name in enumerate(FEATURES)}),
)
KINDS, LOADS_AT = types(True), external_loads(True)
Robots, Options, StateStruct = KINDS.Robots, KINDS.Options, KINDS.State
vec3, mat33 = KINDS.vec3, KINDS.mat33


@wp.kernel
def evaluate(
    robots: Robots,
    options: Options,
    rotation: wp.array(dtype=mat33),
    velocity: wp.array(dtype=vec3),
    angular: wp.array(dtype=vec3),
    force: wp.array(dtype=vec3),
    torque: wp.array(dtype=vec3),
    drag: wp.array(dtype=wp.float64),
):
    b = wp.tid()
    state = StateStruct()
    state.rotation = rotation[b]
    state.linear = velocity[b]
    state.angular = angular[b]
    loads = LOADS_AT(robots, options, b, state)
    force[b] = loads.force
    torque[b] = loads.torque
    drag[b] = loads.drag


def test_both_backends_assemble_the_same_loads():
    count = 16
    random = torch.Generator().manual_seed(2)
    rotation = torch.from_numpy(Rotation.random(count, random_state=1).as_matrix())
    velocity, angular = (torch.randn(count, 3, generator=random, dtype=torch.float64) for _ in range(2))
    robot = dataclasses.replace(load_robot("husky").to(torch.float64), effects=EFFECTS)
    state = State(torch.zeros_like(velocity), rotation, velocity, angular)
    flat = TerrainMap.flat(Grid.square(2.0, 1.0), dtype=torch.float64)
    problem, _ = Problem.pose(flat, robot, torch.zeros(count, 1, robot.number_of_drives).double(), state)
    # Without inertia there is no gyroscopic torque, which the Warp kernel adds itself.
    expected = LoadModel.of(problem, 9.81).at(rotation, velocity, angular, torch.zeros_like(rotation))

    robots, options = Robots(), Options()
    robots.mass = wp.from_torch(problem.mass.contiguous())
    robots.tilt = wp.from_torch(problem.gravity_tilt.contiguous(), dtype=KINDS.vec2)
    robots.resistance = wp.from_torch(problem.resistance.contiguous(), dtype=KINDS.vec4)
    robots.wrench = wp.from_torch(problem.wrench.contiguous(), dtype=KINDS.wrench)
    options.gravity = wp.float64(9.81)
    force, torque, drag = torch.zeros_like(velocity), torch.zeros_like(velocity), torch.zeros_like(velocity[:, 0])
    states = [wp.from_torch(t.contiguous(), dtype=k) for t, k in ((rotation, mat33), (velocity, vec3), (angular, vec3))]
    outputs = [wp.from_torch(t, dtype=k) for t, k in ((force, vec3), (torque, vec3), (drag, wp.float64))]
    wp.launch(evaluate, dim=count, inputs=[robots, options, *states], outputs=outputs, device="cpu")
    for got, wanted in ((force, expected.force), (torque, expected.torque), (drag, expected.drag)):
        torch.testing.assert_close(got, wanted, rtol=1e-12, atol=1e-12)
    assert float(expected.torque.abs().max()) > 1.0 and float(expected.drag.min()) > 30.0
