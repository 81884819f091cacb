"""Speed of the rollout with PyTorch eager, torch.compile and Warp on this machine.

    scripts/run.sh python benchmarks/rollout.py [--json FILE] [--quick]

Every figure is the median of several runs after a warm-up; the first call, with compilation, is reported separately.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import write_text
from monoforce_ros.physics import PhysicsOptions, State, rollout
from monoforce_ros.physics.problem import Problem
from monoforce_ros.physics.torch_backend import integrate
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.terrain import Grid, TerrainMap

STEPS = 500
SPACING = 0.066
"""Point spacing that gives about 200 points for the Husky [m]."""


def bumpy_ground() -> TerrainMap:
    """Hills of 8 cm."""
    grid = Grid.square(25.6, 0.1)
    x, y = np.meshgrid(grid.x, grid.y)
    return TerrainMap.from_height(torch.from_numpy((0.08 * np.sin(1.3 * x) * np.cos(0.9 * y)).astype(np.float32)), grid)


def problem(robot: RobotModel, batch: int, steps: int, device: str) -> tuple:
    """A bumpy map and a fan of arcs, as in planning."""
    terrain = bumpy_ground().to(device=device)
    fan = torch.stack([torch.linspace(0.3, 1.0, batch), torch.linspace(-0.6, 0.6, batch)], dim=-1)
    speeds = robot.drive_speeds(fan[:, None].expand(batch, steps, 2)).to(device)
    state = State.at_rest(0.14, batch=batch)
    state = State(*(getattr(state, n).to(device) for n in ("position", "rotation", "velocity", "angular_velocity")))
    return terrain, robot.to(device=device), speeds, state


def timed(work, repeats: int, device: str) -> float:
    """Median duration [s], including all work on the device."""
    durations = []
    for _ in range(repeats):
        if device == "cuda":
            torch.cuda.synchronize()
        began = time.perf_counter()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        durations.append(time.perf_counter() - began)
    return statistics.median(durations)


def backends(device: str) -> dict:
    """Rollout functions by name."""
    options = PhysicsOptions()

    def eager(terrain, robot, speeds, state):
        return rollout(terrain, robot, speeds, state, options=options, with_forces=False, backend="torch").position

    def warp(terrain, robot, speeds, state):
        return rollout(terrain, robot, speeds, state, options=options, with_forces=False, backend="warp").position

    # Compile a single step and call it in a loop; compiling an unrolled loop of 500 steps takes minutes.
    step = torch.compile(lambda p: integrate(p, options, False), dynamic=False)

    def compiled(terrain, robot, speeds, state):
        posed, _ = Problem.pose(terrain, robot, speeds, state)
        fields = {name: getattr(posed, name) for name in posed.__dataclass_fields__}
        positions = []
        for index in range(posed.steps):
            fields["drive_speeds"] = posed.drive_speeds[:, index : index + 1]
            motion = step(Problem(**fields))
            for name in ("centre", "rotation", "velocity", "angular_velocity"):
                fields[name] = getattr(motion, name)[:, 1]
            positions.append(fields["centre"])
        return torch.stack(positions, dim=1)

    return {"torch eager": eager, "torch.compile": compiled, "warp": warp}


def measure(name: str, function, batch: int, *, backward: bool, quick: bool, device: str, robot: RobotModel) -> dict:
    """Duration of one case: first call, later calls, and nanoseconds per point and step."""
    slow = name != "warp"
    steps = 50 if quick else STEPS
    terrain, robot, speeds, state = problem(robot, batch, steps, device)
    if backward:
        terrain = TerrainMap(
            *(
                getattr(terrain, n).clone().requires_grad_(n == "height")
                for n in ("height", "geometric_height", "stiffness", "damping", "friction")
            ),
            terrain.observed,
            terrain.grid,
        )

    def work():
        if not backward:
            with torch.no_grad():
                function(terrain, robot, speeds, state)
            return
        terrain.height.grad = None
        function(terrain, robot, speeds, state)[:, ::50].sum().backward()

    began = time.perf_counter()
    work()
    first = time.perf_counter() - began
    repeats = 1 if quick else (2 if slow and batch > 1 else 5 if slow else 7)
    seconds = timed(work, repeats, device)
    points = len(robot.points)
    return {
        "backend": name,
        "batch": batch,
        "backward": backward,
        "steps": steps,
        "points": points,
        "first_call_s": first,
        "seconds": seconds,
        "ns_per_point_step": 1e9 * seconds / (batch * steps * points),
    }


def backward_memory(batch: int, robot: RobotModel, steps: int) -> int:
    """Bytes that a Warp rollout stores for its backward pass."""
    stored = 0

    def pack(tensor):
        nonlocal stored
        stored += tensor.untyped_storage().nbytes()
        return tensor

    terrain, robot, speeds, state = problem(robot, batch, steps, "cpu")
    state.position.requires_grad_(True)
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        rollout(terrain, robot, speeds, state, with_forces=False, backend="warp")
    return stored


ALL_EFFECTS = (
    ("rolling_resistance", {"coefficient": 0.03}),
    ("vegetation_drag", {"coefficient": 1e4}),
    ("viscous_drag", {"coefficient": 10.0}),
    ("quadratic_drag", {"coefficient": 5.0}),
    ("gravity_tilt", {"about_x": 0.02, "about_y": 0.02}),
    ("constant_force", {"x": 5.0, "y": 5.0}),
    ("payload", {"mass": 5.0, "x": 0.1, "y": 0.0, "z": 0.2}),
    ("friction_scale", {"factor": 0.9}),
    ("friction_anisotropy", {"factor": 0.9}),
    ("terrain_softness", {"factor": 1.5}),
    ("learned_term", {"force_x:vx": -3.0, "torque_z:wz": -2.0}),
)


def cold_start() -> float:
    """Duration of the first Warp rollout in a new process with an empty kernel cache, without imports [s]."""
    with tempfile.TemporaryDirectory() as cache:
        lines = [
            "import time, torch, warp as wp",
            f"wp.config.kernel_cache_dir = {cache!r}",
            "from monoforce_ros.physics import State, rollout",
            "from monoforce_ros.robots import load_robot",
            "from monoforce_ros.terrain import TerrainMap",
            "robot, terrain, began = load_robot('husky'), TerrainMap.flat(), time.perf_counter()",
            "rollout(terrain, robot, torch.zeros(1, 10, 2), State.at_rest(0.14), backend='warp')",
            "print(time.perf_counter() - began)",
        ]
        done = subprocess.run([sys.executable, "-c", "; ".join(lines)], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def table(rows: list[dict]) -> str:
    """Markdown table with the speed-up over PyTorch eager, measured in the same run."""
    eager = {(r["batch"], r["backward"]): r["seconds"] for r in rows if r["backend"] == "torch eager"}
    lines = [
        "| case | backend | first call [s] | median [ms] | ns per point and step | times faster than eager |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        ratio = eager.get((r["batch"], r["backward"]))
        case = f"B = {r['batch']}, {'forward + backward' if r['backward'] else 'forward'}"
        lines.append(
            f"| {case} | {r['backend']} | {r['first_call_s']:.2f} | {1e3 * r['seconds']:.1f} | "
            f"{r['ns_per_point_step']:.1f} | {f'{ratio / r["seconds"]:.1f}' if ratio else '–'} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--quick", action="store_true", help="50 steps and one run each, for testing")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--backends", nargs="+", default=["torch eager", "torch.compile", "warp"])
    options = parser.parse_args()
    torch.set_num_threads(1)
    robot = load_robot("husky", spacing=SPACING)
    cases = [(1, False), (64, False), (512, False), (1, True), (32, True)]
    rows = []
    for batch, backward in cases:
        for name, function in backends(options.device).items():
            # Slow backends take minutes with large batches and give no additional information.
            if name not in options.backends or (name != "warp" and batch == 512 and not options.quick and backward):
                continue
            if name == "torch.compile" and backward:
                continue
            rows.append(
                measure(
                    name,
                    function,
                    batch,
                    backward=backward,
                    quick=options.quick,
                    device=options.device,
                    robot=robot,
                )
            )
            print(f"{rows[-1]['backend']:>14} B={batch:<4} {'backward' if backward else 'forward':<9}", end=" ")
            print(f"first {rows[-1]['first_call_s']:7.2f} s  median {1e3 * rows[-1]['seconds']:9.1f} ms", flush=True)
    loaded = dataclasses.replace(robot, effects=ALL_EFFECTS)
    ratios = {}
    for batch, backward in ((64, False), (32, True)):
        pair = [
            measure(
                "warp",
                backends(options.device)["warp"],
                batch,
                backward=backward,
                quick=options.quick,
                device=options.device,
                robot=which,
            )["seconds"]
            for which in (robot, loaded)
        ]
        ratios[f"B = {batch}, {'forward + backward' if backward else 'forward'}"] = pair[1] / pair[0]
    stored = backward_memory(64, robot, 50 if options.quick else STEPS)
    print("\n" + table(rows))
    cold = cold_start()
    print(
        f"\nfirst Warp rollout, including kernel compilation: {cold:.1f} s; later processes load kernels from the cache"
    )
    for case, ratio in ratios.items():
        print(f"with all contact and body effects, {case}: {ratio:.2f} times the duration without")
    print(f"stored for the backward pass at B = 64: {stored / 1e6:.1f} MB; body points: {len(robot.points)}")
    if options.json:
        machine = {
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "torch": torch.__version__,
            "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }
        content = {
            "machine": machine,
            "rows": rows,
            "kept_for_backward_b64_bytes": stored,
            "effects": ratios,
            "cold_s": cold,
        }
        write_text(options.json, json.dumps(content, indent=2))


if __name__ == "__main__":
    main()
