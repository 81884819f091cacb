"""Recurrences: compiled and differentiable versions agree, with gradients checked in float64."""

from __future__ import annotations

import math

import pytest
import torch

from monoforce_ros.effects import recurrence
from monoforce_ros.effects.recurrence import droop, follow, follow_loaded


def signals(rows: int = 3, steps: int = 60) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    steps_of = torch.randn(rows, steps // 10, generator=generator, dtype=torch.float64).repeat_interleave(10, dim=1)
    steps_of[0, :10] = 0.0
    return steps_of


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("each", [False, True])
def test_kernels_and_loops_agree(monkeypatch, dtype, each):
    target = signals().to(dtype)
    change, share = torch.tensor([0.05, 0.2, 0.4], dtype=dtype), torch.tensor([0.02, 0.1, 0.5], dtype=dtype)
    if not each:
        change, share = change[0], share[0]
    compiled = follow(target, change), droop(target, change, share)
    assert recurrence._kernels(target) is not None
    monkeypatch.setattr(recurrence, "_kernels", lambda *tensors: None)
    for fast, slow in zip(compiled, (follow(target, change), droop(target, change, share)), strict=True):
        assert fast.dtype == dtype
        torch.testing.assert_close(fast, slow, rtol=0, atol=1e-6 if dtype == torch.float32 else 1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("each", [False, True])
def test_kernel_and_loop_of_loaded_drives_agree(monkeypatch, dtype, each):
    target = torch.stack([signals(), signals().roll(7, 1), -0.5 * signals().flip(1)], dim=-1).to(dtype)
    change, load = torch.tensor([0.05, math.inf, 0.4], dtype=dtype), torch.tensor([0.3, 0.5, 0.9], dtype=dtype)
    if not each:
        change, load = change[0], load[0]
    compiled = follow_loaded(target, change, load, 0.02)
    monkeypatch.setattr(recurrence, "_kernels", lambda *tensors: None)
    slow = follow_loaded(target, change, load, 0.02)
    torch.testing.assert_close(compiled, slow, rtol=0, atol=1e-6 if dtype == torch.float32 else 1e-14)
    if each:
        assert torch.equal(compiled[1], target[1]) and torch.equal(slow[1], target[1])


def test_a_load_on_drives_that_turn_slows_their_beginning_and_hastens_their_end():
    command = torch.zeros(2, 300, dtype=torch.float64)
    command[:, 20:150] = 1.0
    turning, ahead = torch.stack([-command[0], command[0]], dim=-1), torch.stack([command[0], command[0]], dim=-1)
    turned, driven = follow_loaded(torch.stack([turning, ahead]), torch.tensor(0.02), torch.tensor(0.4), 0.02)
    torch.testing.assert_close(driven[:, 0], follow(command[:1], torch.tensor(0.02))[0])
    torch.testing.assert_close(turned[:, 0], -turned[:, 1])

    def taken(speed, start, reached):
        return int(torch.nonzero(reached(speed[start:]))[0])

    # The whole load but for the slowest 0.02: 0.6 of the change at first, 1.4 of it at the end.
    assert taken(turned[:, 1], 20, lambda v: v >= 0.99) == pytest.approx(1.0 / (0.6 * 0.02), abs=3)
    assert taken(turned[:, 1], 150, lambda v: v <= 0.01) == pytest.approx(1.0 / (1.4 * 0.02), abs=3)


def test_a_slice_of_a_larger_signal_is_followed():
    both = torch.stack([signals(), -signals()], dim=-1)
    torch.testing.assert_close(follow(both[..., 1], torch.tensor(0.1)), -follow(both[..., 0], torch.tensor(0.1)))


def test_an_infinite_change_returns_the_target_bit_for_bit():
    target = signals()
    assert torch.equal(follow(target, torch.tensor(math.inf)), target)
    both = torch.stack([target, -target], dim=-1)
    assert torch.equal(follow_loaded(both, torch.tensor(math.inf), torch.tensor(0.5), 0.02), both)


def test_drives_at_rest_lose_nothing_until_they_turn():
    wanted = torch.zeros(1, 50, dtype=torch.float64)
    wanted[:, 20:] = 1.0
    lost = droop(wanted, torch.tensor(0.3), torch.tensor(0.1))
    assert not lost[:, :20].any()
    # At first the whole loss; integral action takes a tenth of the rest back in each step.
    torch.testing.assert_close(lost[0, 20:], 0.3 * 0.9 ** torch.arange(30, dtype=torch.float64), rtol=1e-6, atol=0)


def test_gradients_are_those_of_finite_differences():
    # Neither at rest nor at a limit exactly, where there is no derivative.
    times = torch.arange(30, dtype=torch.float64)
    target = torch.stack([torch.sin(0.31 * times + 0.4), 1.3 * torch.cos(0.17 * times)]).requires_grad_()
    change = torch.tensor([0.07, 0.21], dtype=torch.float64, requires_grad=True)
    share = torch.tensor(0.13, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(follow, (target, change))
    assert torch.autograd.gradcheck(droop, (target, change, share))
    both = torch.stack([target, 0.7 * target.flip(1)], dim=-1)
    assert torch.autograd.gradcheck(lambda *given: follow_loaded(*given, 0.02), (both, change, share))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_cuda_gives_the_same():
    target, change = signals().float(), torch.tensor([0.05, 0.2, 0.4])
    torch.testing.assert_close(follow(target.cuda(), change.cuda()).cpu(), follow(target, change))
    both, load = torch.stack([target, -target], dim=-1), torch.tensor(0.4)
    on_cuda = follow_loaded(both.cuda(), change.cuda(), load.cuda(), 0.02)
    torch.testing.assert_close(on_cuda.cpu(), follow_loaded(both, change, load, 0.02))
