"""Baselines of ``hidden_effects.py`` and ``platforms``: other ways to reduce the error, cross-validated on equal folds.

``refit``: the commissioning parameters, refitted. ``network``: a small neural network that predicts the model's
error at the end of a window from its start state and commands. ``sindy``: accelerations by sparse regression (pysindy)
instead of the physics, integrated from the start of each window. ``mujoco_sysid``: the robot's MuJoCo model with all
its parameters free (``mujoco_sysid.py``).

Baselines are trained and tested on all windows of a fold, including those that reach into the next block; ``diagnose``
is tested only on windows that end within their block.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

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


METHODS = ("refit", "network", "sindy")
SYSID_SECONDS = 60.0
"""Of a processor for MuJoCo's system identification on each of the two folds: together more than ``diagnose`` takes for
its whole search. The other methods end by themselves long before."""


@dataclass(frozen=True)
class BaselineErrors:
    """What a method leaves of windows to which it was not fitted.

    Attributes:
        residuals: predicted minus measured at the last sample, ``[W, 3]`` [m, m, rad].
        seconds: of a processor for all folds.
    """

    residuals: np.ndarray
    seconds: float

    @property
    def median(self) -> float:
        """Median position error [m]."""
        return float(np.median(np.hypot(self.residuals[:, 0], self.residuals[:, 1])))


def baseline_errors(
    evidence: Evidence, data: EvidenceWindows, robot: RobotModel, scale: np.ndarray, methods: tuple[str, ...] = METHODS
) -> dict[str, BaselineErrors]:
    """Errors of each method, trained on the other folds.

    Args:
        evidence: of the recording.
        data: its windows.
        robot: nominal, with the effects of its file.
        scale: of residuals ``[K, 3]`` [m, m, rad].
        methods: of :data:`METHODS`, and ``mujoco_sysid``.
    """
    before = Predictions(robot, data).residuals([()])[0][:, -1]
    folds = folds_of(data.starts, 2)
    features = _features(data)

    def refit(train: EvidenceWindows, test: EvidenceWindows, _: np.ndarray) -> np.ndarray:
        present = dict(robot.effects)
        start = tuple((name, dict(present.get(name, values))) for name, values in COMMISSIONED)
        fit = fit_effects(Predictions(robot, train), [start], scale, iterations=6)
        return Predictions(robot, test).residuals([fit.effects])[0][:, -1]

    def network(_train: EvidenceWindows, _test: EvidenceWindows, held_out: np.ndarray) -> np.ndarray:
        predicted = _network(features[~held_out], before[~held_out], features[held_out])
        return before[held_out] - predicted

    def sindy(train: EvidenceWindows, test: EvidenceWindows, _: np.ndarray) -> np.ndarray:
        return _sindy(evidence, train, test)

    def mujoco_sysid(train: EvidenceWindows, test: EvidenceWindows, _: np.ndarray) -> np.ndarray:
        from mujoco_sysid import held_out_errors

        return held_out_errors(robot, train, test, scale, SYSID_SECONDS)

    known: dict[str, Callable[[EvidenceWindows, EvidenceWindows, np.ndarray], np.ndarray]] = {
        "refit": refit, "network": network, "sindy": sindy, "mujoco_sysid": mujoco_sysid,
    }  # fmt: skip
    results = {}
    for name in methods:
        began, residuals = time.process_time(), before.copy()
        for fold in np.unique(folds):
            held_out = folds == fold
            train, test = (replace(data, starts=data.starts[part]) for part in (~held_out, held_out))
            residuals[held_out] = known[name](train, test, held_out)
        results[name] = BaselineErrors(residuals, time.process_time() - began)
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
