"""Baselines for ``hidden_effects.py``: other ways to reduce the error, cross-validated on the same folds.

``refit``: the commissioning parameters, refitted. ``network``: a small neural network that predicts the model's
error at the end of a window from its start state and commands. ``sindy``: accelerations by sparse regression (pysindy)
instead of the physics, integrated from the start of each window.

Baselines are trained and tested on all windows of a fold, including those that reach into the next block; ``diagnose``
is tested only on windows that end within their block.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch

from monoforce_ros.discrepancy.commissioning import COMMISSIONED
from monoforce_ros.discrepancy.evidence import Evidence, EvidenceWindows, sample_motion
from monoforce_ros.discrepancy.fit import fit_effects
from monoforce_ros.discrepancy.gap import relative_motion
from monoforce_ros.discrepancy.hypothesis import Predictions
from monoforce_ros.discrepancy.trial import folds_of
from monoforce_ros.robots import RobotModel

_STEP = 0.05
_HISTORY = 0.5


def baseline_errors(
    evidence: Evidence, data: EvidenceWindows, robot: RobotModel, scale: np.ndarray
) -> dict[str, np.ndarray]:
    """Residuals ``[W, 3]`` at the last sample of each window, for each baseline trained on the other folds."""
    predictions = Predictions(robot, data)
    before = predictions.residuals([()])[0][:, -1]
    folds = folds_of(data.starts, 2)
    results = {name: before.copy() for name in ("refit", "network", "sindy")}
    features = _features(data)
    for fold in np.unique(folds):
        fitted, held_out = folds != fold, folds == fold
        train, test = replace(data, starts=data.starts[fitted]), replace(data, starts=data.starts[held_out])
        present = dict(robot.effects)
        start = tuple((name, dict(present.get(name, values))) for name, values in COMMISSIONED)
        fit = fit_effects(Predictions(robot, train), [start], scale, iterations=6)
        results["refit"][held_out] = Predictions(robot, test).residuals([fit.effects])[0][:, -1]
        results["network"][held_out] = before[held_out] - _network(features[fitted], before[fitted], features[held_out])
        results["sindy"][held_out] = _sindy(evidence, train, test)
    return results


def _features(data: EvidenceWindows) -> np.ndarray:
    """Start velocity and commands around each window, ``[W, F]``."""
    _, _, linear, angular = sample_motion(data.motion, data.starts)
    stamps = data.starts[:, None] + (np.arange(-2, 9) * 0.25e9).astype(np.int64)
    commanded = data.commands.sample(stamps).reshape(len(data.starts), -1)
    return np.concatenate([linear[:, :2], angular[:, 2:], commanded], axis=1)


def _network(features: np.ndarray, errors: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Errors predicted by a small network, ``[Q, 3]``."""
    torch.manual_seed(0)
    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-6
    size = errors.std(axis=0) + 1e-6
    x = torch.as_tensor((features - mean) / spread, dtype=torch.float32)
    y = torch.as_tensor(errors / size, dtype=torch.float32)
    net = torch.nn.Sequential(
        torch.nn.Linear(x.shape[1], 32), torch.nn.Tanh(), torch.nn.Linear(32, 32), torch.nn.Tanh(),
        torch.nn.Linear(32, 3),
    )  # fmt: skip
    optimiser = torch.optim.AdamW(net.parameters(), lr=3e-3, weight_decay=0.1)
    for _ in range(400):
        optimiser.zero_grad()
        torch.nn.functional.smooth_l1_loss(net(x), y).backward()
        optimiser.step()
    with torch.no_grad():
        return net(torch.as_tensor((queries - mean) / spread, dtype=torch.float32)).numpy() * size


def _sindy(evidence: Evidence, train: EvidenceWindows, test: EvidenceWindows) -> np.ndarray:
    """Residuals of predictions by sparse regression of the accelerations, ``[W, 3]``."""
    import pysindy

    motion = evidence.smoothed.motion

    def pieces(data: EvidenceWindows) -> tuple[list[np.ndarray], list[np.ndarray]]:
        count = round(data.horizon / _STEP) + 1
        stamps = data.starts[:, None] + (np.arange(count) * _STEP * 1e9).astype(np.int64)
        _, _, linear, angular = sample_motion(motion, stamps)
        states = np.stack([linear[..., 0], angular[..., 2]], axis=-1)
        return list(states), list(data.commands.sample(stamps))

    states, commanded = pieces(train)
    model = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=0.05, alpha=0.05),
        feature_library=pysindy.PolynomialLibrary(degree=2),
        differentiation_method=pysindy.SmoothedFiniteDifference(),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit(states, t=_STEP, u=commanded)
    starts, commands = pieces(test)
    now = np.array([state[0] for state in starts])
    commands = np.array(commands)
    position, heading = np.zeros((len(now), 2)), np.zeros(len(now))
    for step in range(commands.shape[1] - 1):
        rate = np.asarray(model.predict(now, u=commands[:, step]))
        now = np.clip(now + _STEP * rate, -5.0, 5.0)
        heading = heading + _STEP * now[:, 1]
        position = position + _STEP * now[:, :1] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    predicted = np.concatenate([position, heading[:, None]], axis=1)
    return predicted - relative_motion(motion, test)[:, -1]
