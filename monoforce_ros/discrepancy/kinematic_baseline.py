"""Kinematic baseline: how far a fitted kinematic model gets, on windows that begin with a step of the command.

The measure of the literature on commanded ground vehicles (Baril et al. 2024, DRIVE): position errors of open-loop
predictions over windows of 2 s after a step. The baseline is tested on blocks of a recording to which it was not
fitted, as the effects are; the measured speed at the start is given to both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from monoforce_ros.core import CommandTrack, MotionTrack
from monoforce_ros.discrepancy.evidence import EvidenceWindows, sample_motion
from monoforce_ros.discrepancy.gap import relative_motion

HORIZON = 2.0
"""Length of the windows [s]."""
FEWEST_STEPS = 6
"""A comparison needs at least as many windows, and half as many to fit to."""
_STEP = 0.05
"""Time step of the kinematic model [s]."""
_HISTORY = 2.0
"""Commands before a window that a delay reaches [s]."""
_LEAST_STEP = 0.1
"""Share of the range of a command that counts as a step; slower ramps and noise are no steps."""
_BLOCK, _RESAMPLES = 8.0, 500
"""Length of the blocks that the interval of a difference resamples [s], and how often."""
_APART = 1.0
"""Shortest time between windows that count separately [s]."""
_BOUNDS = ((0.2, 0.1, 0.0, 0.01, 0.1, 0.1), (2.0, 2.0, 1.5, 3.0, 30.0, 30.0))
"""Of gain of speed and of yaw rate, delay and lag [s], largest speed [m/s] and yaw rate [rad/s]."""
_STARTS = ((0.9, 0.7, 0.1, 0.1, 0.9), (0.9, 0.7, 0.4, 0.3, 0.9), (0.95, 0.7, 0.3, 0.3, 0.6))
"""Gains, delay, lag and limits over the largest commands at which fits start."""


@dataclass(frozen=True)
class KinematicModel:
    """A differential drive whose speed and yaw rate follow commands with gains, limits, a dead time and a lag."""

    speed_gain: float
    yaw_gain: float
    delay: float
    """[s]."""
    lag: float
    """Time constant [s]."""
    largest_speed: float
    """[m/s]."""
    largest_yaw_rate: float
    """[rad/s]."""

    def drive(self, commanded: np.ndarray, start: np.ndarray, history: int, step: float) -> np.ndarray:
        """Displacement in the start's frame.

        Args:
            commanded: speeds and yaw rates ``[W, H + T, 2]`` [m/s, rad/s].
            start: measured speed and yaw rate at the start ``[W, 2]``.
            history: H, the number of commands before the start.
            step: time step [s].

        Returns:
            positions and headings after each step ``[W, T, 3]`` [m, m, rad].
        """
        windows, total, _ = commanded.shape
        limits = np.array([self.largest_speed, self.largest_yaw_rate])
        wanted = np.clip(commanded * [self.speed_gain, self.yaw_gain], -limits, limits)
        index = np.clip(np.arange(history, total) - self.delay / step, 0, total - 1)
        low = np.floor(index).astype(int)
        part = (index - low)[None, :, None]
        wanted = (1 - part) * wanted[:, low] + part * wanted[:, np.minimum(low + 1, total - 1)]
        decay = np.exp(-step / max(self.lag, 1e-3))
        state, place = start.astype(float).copy(), np.zeros((windows, 3))
        result = []
        for number in range(wanted.shape[1]):
            before = state
            state = wanted[:, number] + decay * (state - wanted[:, number])
            speed, turn = 0.5 * (before + state).T * step
            middle = place[:, 2] + 0.5 * turn
            place = place + np.stack([speed * np.cos(middle), speed * np.sin(middle), turn], axis=1)
            result.append(place)
        return np.stack(result, axis=1)


@dataclass(frozen=True)
class StepComparison:
    """Median position errors after 2 s on windows that begin with a step of the command, on held-out blocks."""

    windows: int
    before: float
    """Of the nominal model [m]."""
    after: float | None
    """With the added effects [m]; None where there are none."""
    kinematic: float
    """Of the kinematic model [m]."""
    ideal: float
    """Of a differential drive that follows its commands at once [m]."""
    models: tuple[KinematicModel, ...]
    """The kinematic model as fitted without each part of the recording."""
    ahead: tuple[float, float] | None = None
    """Median error of the kinematic fit less that of the effects: 95 % interval over blocks of 8 s [m]. One that holds
    zero tells neither from the other."""
    selected_apart: bool = False
    """Whether effects were also selected without the part on which they are tested; else on the whole recording."""
    reckoned: float | None = None
    """Of dead reckoning from measured wheel speeds and, where there is one, the gyro [m]; None without them."""


def step_starts(commands: CommandTrack, starts: np.ndarray) -> np.ndarray:
    """Those of the possible starts [ns] at which a step of the command has just occurred, ``[S]``.

    A step changes speed or yaw rate by a tenth of its range or more; its window is the first possible one after it.
    """
    if len(commands) < 2 or not len(starts):
        return starts[:0]
    changes = np.abs(np.diff(commands.twists, axis=0))
    spans = np.maximum(np.ptp(commands.twists, axis=0), 1e-6)
    stamps = commands.stamps[1:][(changes > _LEAST_STEP * spans).any(axis=1)]
    place = np.searchsorted(starts, stamps)
    stamps, place = stamps[place < len(starts)], place[place < len(starts)]
    near = starts[place] - stamps <= round(0.25e9)
    found: list[int] = []
    for start in starts[place[near]]:
        if not found or start - found[-1] >= round(_APART * 1e9):
            found.append(int(start))
    return np.array(found, np.int64)


def fit_kinematics(motion: MotionTrack, commands: CommandTrack, starts: np.ndarray) -> KinematicModel:
    """The kinematic model that best predicts windows of 2 s, by robust least squares over positions.

    Args:
        motion: smoothed motion.
        commands: commands to the base.
        starts: starts of the windows ``[W]`` [ns].

    Raises:
        ValueError: there is no window.
    """
    if not len(starts):
        raise ValueError("fit_kinematics: got no windows, expected at least one")
    data = _windows(motion, commands, starts)
    commanded, start, measured = _arrays(data)
    largest = np.maximum(np.abs(commanded).reshape(-1, 2).max(axis=0), 0.2)
    scale = max(float(np.median(np.abs(measured[:, -1, :2]))), 0.05)

    def residuals(values: np.ndarray) -> np.ndarray:
        predicted = KinematicModel(*(float(value) for value in values)).drive(
            commanded, start, round(_HISTORY / _STEP), _STEP
        )
        error = (predicted - measured)[:, 4::5]
        # A heading error of one radian displaces a robot by about the distance that it drives next.
        return np.concatenate([(error[..., :2] / scale).ravel(), error[..., 2].ravel()])

    best, cost = None, np.inf
    low, high = np.array(_BOUNDS[0]), np.array(_BOUNDS[1])
    for first in _STARTS:
        fit = least_squares(
            residuals, np.clip([*first[:4], *(first[4] * largest)], low, high), bounds=(low, high), loss="soft_l1",
            f_scale=0.2, x_scale=(1.0, 1.0, 0.2, 0.2, largest[0], largest[1]), diff_step=1e-3, max_nfev=60,
        )  # fmt: skip
        if fit.cost < cost:
            best, cost = fit.x, fit.cost
    assert best is not None
    return KinematicModel(*(float(value) for value in best))


def compare_on_steps(
    motion: MotionTrack,
    commands: CommandTrack,
    starts: np.ndarray,
    folds: np.ndarray,
    errors: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray | None]],
    reckoned: np.ndarray | None = None,
) -> StepComparison | None:
    """Errors of the nominal model, of the added effects and of a kinematic fit on the same windows.

    Args:
        motion: smoothed motion.
        commands: commands to the base.
        starts: starts of windows after steps ``[W]`` [ns].
        folds: the part of the recording in which each lies ``[W]``; no part is fitted to itself.
        errors: position errors after 2 s of windows without and with the effects ``[W]`` [m], by starts and folds.
        reckoned: those of dead reckoning ``[W]`` [m].

    Returns:
        None where there are too few windows.
    """
    parts = np.unique(folds)
    fewest = min((int((folds != part).sum()) for part in parts), default=0)
    if len(starts) < FEWEST_STEPS or len(parts) < 2 or fewest < FEWEST_STEPS // 2:
        return None
    before, after = errors(starts, folds)
    kinematic = np.zeros(len(starts))
    models = []
    for fold in parts:
        model = fit_kinematics(motion, commands, starts[folds != fold])
        models.append(model)
        kinematic[folds == fold] = position_errors(model, motion, commands, starts[folds == fold])
    ideal = KinematicModel(1.0, 1.0, 0.0, 0.0, np.inf, np.inf)
    return StepComparison(
        windows=len(starts),
        before=float(np.median(before)),
        after=None if after is None else float(np.median(after)),
        kinematic=float(np.median(kinematic)),
        ideal=float(np.median(position_errors(ideal, motion, commands, starts))),
        models=tuple(models),
        ahead=None if after is None else _interval(starts, kinematic, after),
        reckoned=None if reckoned is None else float(np.median(reckoned)),
    )


def _interval(starts: np.ndarray, first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """95 % interval of the difference of two medians, blocks of 8 s resampled."""
    _, block = np.unique((starts - starts[0]) // round(_BLOCK * 1e9), return_inverse=True)
    members = [np.flatnonzero(block == number) for number in range(block.max() + 1)]
    random = np.random.default_rng(0)
    drawn = [
        np.concatenate([members[number] for number in random.integers(len(members), size=len(members))])
        for _ in range(_RESAMPLES)
    ]
    differences = [np.median(first[chosen]) - np.median(second[chosen]) for chosen in drawn]
    low, high = np.quantile(differences, (0.025, 0.975))
    return float(low), float(high)


def position_errors(
    model: KinematicModel, motion: MotionTrack, commands: CommandTrack, starts: np.ndarray
) -> np.ndarray:
    """Position errors of a model at the end of windows, ``[W]`` [m]."""
    commanded, start, measured = _arrays(_windows(motion, commands, starts))
    predicted = model.drive(commanded, start, round(_HISTORY / _STEP), _STEP)
    return np.linalg.norm((predicted - measured)[:, -1, :2], axis=1)


def _windows(motion: MotionTrack, commands: CommandTrack, starts: np.ndarray) -> EvidenceWindows:
    samples = np.arange(1, round(HORIZON / _STEP) + 1) * _STEP
    return EvidenceWindows(motion, commands, starts, HORIZON, samples)


def _arrays(data: EvidenceWindows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Commands with history, measured start speeds and measured motion of windows."""
    steps = np.arange(-round(_HISTORY / _STEP), len(data.samples))
    stamps = data.starts[:, None] + np.rint(steps * _STEP * 1e9).astype(np.int64)
    _, _, linear, angular = sample_motion(data.motion, data.starts)
    start = np.stack([linear[:, 0], angular[:, 2]], axis=1)
    # A differential drive has no lateral speed.
    return data.commands.sample(stamps)[..., :2], start, relative_motion(data.motion, data)
