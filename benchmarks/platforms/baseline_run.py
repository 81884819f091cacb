"""Baseline run: median errors of other methods on one recording, cross-validated like ``diagnose``.

    python baseline_run.py BAG ROBOT_FILE flat|lidar|MAP OUT.json

``run.py --baselines`` starts it in a process of its own, with the judged code on the path.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy import read_evidence
from monoforce_ros.discrepancy.evidence import MOTION, window_starts
from monoforce_ros.discrepancy.gap import noise_floor, noisy_motions, residual_scale
from monoforce_ros.discrepancy.nominal import NominalModel
from monoforce_ros.robots import load_robot

SAMPLES = np.array([0.5, 1.0, 1.5, 2.0])
"""Times in a window of 2 s [s]."""


def main() -> None:
    bag, robot, terrain, out = sys.argv[1:]
    # baselines.py lies beside this folder.
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from baselines import METHODS, baseline_errors

    torch.set_num_threads(1)
    model = load_robot(robot)
    evidence, _ = read_evidence(Path(bag), model, terrain)
    evidence = replace(evidence, components=MOTION)
    smoothed = evidence.smoothed
    data = evidence.cut(window_starts(smoothed.motion, smoothed.stretches, 2.0, 1.0), SAMPLES)
    floor = noise_floor(smoothed.motion, noisy_motions(smoothed), data)
    nominal = NominalModel.read(robot, tuple(SAMPLES))
    nominal = None if nominal is None else nominal.of_motion()
    scale = np.sqrt((residual_scale(floor, data, nominal) ** 2).reshape(-1, *floor.shape).mean(axis=0))
    errors = baseline_errors(evidence, data, model, scale, (*METHODS, "mujoco_sysid"))
    found = {name: entry.median for name, entry in errors.items()}
    found["seconds"] = {name: round(entry.seconds, 1) for name, entry in errors.items()}
    write_text(Path(out), json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
