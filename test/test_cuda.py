"""What runs on a GPU gives what it gives on the CPU; skipped without one."""

import dataclasses

import numpy as np
import pytest
import torch

from monoforce_ros.core import CameraModel, homogeneous
from monoforce_ros.encoder import CameraView, load_encoder
from monoforce_ros.encoder.view import EncoderInput, encoder_input
from monoforce_ros.physics import State, rollout
from monoforce_ros.robots import load_robot
from monoforce_ros.terrain import Grid, TerrainMap

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no CUDA GPU")

GRID = Grid(90, 120, 0.1, (-4.0, -4.5))
FIELDS = ("position", "rotation", "velocity", "angular_velocity", "normal_forces", "tangential_forces", "forces")
FORWARD = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])


def moved(value, device: str):
    """A dataclass of tensors on a device."""
    tensors = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return dataclasses.replace(value, **{n: t.to(device) for n, t in tensors.items() if isinstance(t, torch.Tensor)})


def driven(device: str, backend: str, *, steps: int = 80, name: str = "husky"):
    """Trajectories over hills, and the gradients of where they end with respect to height and friction."""
    x, y = np.meshgrid(GRID.x, GRID.y)
    height = torch.from_numpy(0.08 * np.sin(1.5 * x) * np.cos(1.1 * y)).to(device).requires_grad_(True)
    friction = torch.full((GRID.rows, GRID.columns), 0.8, dtype=torch.float64, device=device, requires_grad=True)
    terrain = dataclasses.replace(TerrainMap.from_height(height, GRID), friction=friction)
    robot = load_robot(name).to(torch.float64)
    twists = torch.stack([torch.linspace(-0.4, 1.0, 9), torch.linspace(-0.8, 0.8, 9)], dim=-1).double()
    speeds = robot.drive_speeds(twists[:, None].expand(9, steps, 2)).to(device)
    start = moved(State.at_rest(0.16, batch=9, dtype=torch.float64), device)
    result = rollout(terrain, robot.to(device=device), speeds, start, backend=backend)
    result.position[:, -1].sum().backward()
    return result, height.grad.cpu(), friction.grad.cpu()


@pytest.mark.parametrize("backend", ["warp", "torch"])
def test_motion_forces_and_gradients_are_those_of_the_cpu(backend):
    expected, *gradients = driven("cpu", "warp")
    found, *found_gradients = driven("cuda", backend)
    for field in FIELDS:
        value = getattr(found, field)
        assert value.is_cuda
        assert float((value.cpu() - getattr(expected, field)).detach().abs().max()) < 1e-7, field
    for found_gradient, gradient in zip(found_gradients, gradients, strict=True):
        assert float(gradient.abs().max()) > 0.0
        assert float((found_gradient - gradient).norm() / gradient.norm()) < 1e-6


@pytest.mark.parametrize("sensors", ["image", "sweep", "both"])
def test_the_shipped_encoder_sees_what_it_sees_on_the_cpu(sensors):
    random = np.random.default_rng(3)
    matrix = np.array([[190.0, 0, 159.5], [0, 190.0, 119.5], [0, 0, 1]])
    image = random.integers(0, 255, (240, 320, 3)).astype(np.uint8)
    views = [
        CameraView(image, CameraModel(320, 240, matrix, np.zeros(5)), homogeneous(FORWARD, np.array([0.2, 0, 0.5])))
    ]
    sweep = np.column_stack([random.uniform(-6, 6, (4000, 2)), random.normal(0, 0.1, 4000)])
    encoder = load_encoder("")
    support = np.array([[0.3, 0.3, 0.0], [-0.3, 0.3, 0.0], [-0.3, -0.3, 0.0], [0.3, -0.3, 0.0]])
    given = encoder_input(
        views if sensors != "sweep" else [], support, encoder.config, sweep=None if sensors == "image" else sweep
    )
    batch = EncoderInput.stack([given])
    with torch.inference_mode():
        expected = encoder(batch)
        found = encoder.to("cuda")(batch.to("cuda"))
    for name in ("geometric_height", "decrease", "friction", "geometric_spread"):
        difference = (getattr(found, name).cpu() - getattr(expected, name)).abs()
        assert float(difference.max()) < 0.02, name
        assert float(difference.median()) < 0.001, name
    assert float((found.covered.cpu() == expected.covered).float().mean()) > 0.999
