"""Wheels: what measured wheel speeds say of how the drives follow commands, whatever the ground does then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from monoforce_ros.core import CommandTrack, WheelTrack
from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.robots import RobotModel

_STEP = 0.02
_HISTORY = 2.0
_LONGEST_GAP = 1.0
_BLOCK = 6.0
_MOST = 1500
"""Samples of each side that are looked at."""
_BETTER = 0.08
"""Part of the squared error that a model with one more effect must take away on blocks that its fit did not see."""
_MODELS: tuple[tuple[str, ...], ...] = (
    (),
    ("delay",),
    ("lag",),
    ("limit",),
    ("width",),
    ("delay", "lag"),
    ("delay", "limit"),
    ("lag", "limit"),
    ("delay", "width"),
    ("lag", "width"),
    ("delay", "lag", "limit"),
    ("delay", "lag", "width"),
)
_EFFECTS = {
    "delay": ("command_delay", "delay"),
    "width": ("actuator_deadband", "width"),
    "limit": ("actuator_saturation", "limit"),
    "lag": ("actuator_lag", "time_constant"),
}
_LEAST = {"delay": 0.06, "lag": 0.08, "width": 0.02}
"""Values below which an effect is none [s, s, m/s]."""
_FASTEST_SHARE = 0.95
"""Of the fastest command: a limit beyond it is none."""


@dataclass(frozen=True)
class WheelFinding:
    """How the drives follow commands."""

    effects: Effects
    """With a parameter each, in the order in which a command meets them; empty where the wheels do as they are told."""
    halves: tuple[float, ...]
    """Half of each parameter's 95 % interval."""
    error_before: float
    """Root mean square of wheel minus commanded speed [m/s], at the best constant ratio of the two."""
    error_after: float
    ratio: float
    """Measured speed [rad/s] over commanded [m/s]: one over the wheel's radius."""

    def told(self) -> str:
        """In plain words."""
        words = {
            "command_delay": "{:.2f} s late",
            "actuator_lag": "with a time constant of {:.2f} s",
            "actuator_saturation": "up to {:.2f} m/s and no faster",
            "actuator_deadband": "slower by {:.2f} m/s",
        }
        parts = [words[name].format(next(iter(values.values()))) for name, values in self.effects]
        return "the measured wheel speeds follow the commands " + ", ".join(parts or ["as they are told"])


def compare_with_wheels(commands: CommandTrack, wheels: WheelTrack | None, robot: RobotModel) -> WheelFinding | None:
    """How measured wheel speeds follow commands; None without wheel speeds that follow them at all.

    Dead time, dead band, saturation and lag are fitted to both sides in every sensible combination, each on every other
    block of the drive; the one with the fewest that predicts the other blocks well is taken.
    """
    if wheels is None or len(wheels) < 100 or not len(commands):
        return None
    pieces = _pieces(commands, wheels, robot)
    if not pieces:
        return None
    top = float(np.quantile(np.concatenate([np.abs(told[:, index]).max(axis=1) for told, _, index in pieces]), 0.995))
    if top < 0.1:
        return None
    ratio = _ratio(pieces, top)
    if ratio is not None and robot.wheel_radius is not None and 0.4 < ratio * robot.wheel_radius < 2.5:
        # A wheel's speed times its radius is what was commanded; a drive that does less says so.
        ratio = 1.0 / robot.wheel_radius
    if len(pieces) < 2 or ratio is None:
        return None
    pieces = [(told, speeds / ratio, index) for told, speeds, index in pieces]
    block = np.arange(len(pieces)) % 2
    scores: dict[tuple[str, ...], tuple[float, np.ndarray, np.ndarray]] = {}
    for names in _MODELS:
        lost, fits = 0.0, []
        for left in (0, 1):
            seen = [piece for piece, own in zip(pieces, block, strict=True) if own != left]
            other = [piece for piece, own in zip(pieces, block, strict=True) if own == left]
            fit = _fit(names, seen, top)
            fits.append(fit)
            lost += float(np.minimum(_residuals(fit, names, other) ** 2, (0.5 * top) ** 2).sum())
        scores[names] = (lost, np.mean(fits, axis=0), np.abs(fits[0] - fits[1]))
    nothing = scores[()][0]
    best: tuple[str, ...] = ()
    for size in (1, 2, 3):
        found = min((names for names in _MODELS if len(names) == size), key=lambda names: scores[names][0])
        if scores[found][0] < (1.0 - _BETTER) * scores[best][0]:
            best = found
    values, spread = scores[best][1], scores[best][2]
    effects, halves = [], []
    for key in ("delay", "width", "limit", "lag"):
        if key not in best:
            continue
        index = best.index(key)
        value = float(values[index])
        none = value > _FASTEST_SHARE * top if key == "limit" else value < _LEAST[key]
        if not none:
            name, parameter = _EFFECTS[key]
            effects.append((name, {parameter: value}))
            # Two halves of the data differ by the square root of two of what each is off.
            halves.append(float(max(1.4 * spread[index], 0.02 * value)))
    count = sum(len(index) for _, _, index in pieces) * 2
    spreads = [
        float(np.var(np.concatenate([values.ravel() for values in side])))
        for side in ([speeds for _, speeds, _ in pieces], [told[:, index] for told, _, index in pieces])
    ]
    if scores[best][0] / count > 0.5 * min(spreads):
        # The wheels do something else than what the commands say.
        return None
    return WheelFinding(
        tuple(effects), tuple(halves), float(np.sqrt(nothing / count)), float(np.sqrt(scores[best][0] / count)), ratio
    )


def _ratio(pieces: list, top: float) -> float | None:
    """Measured [rad/s] over commanded speed [m/s] where a command of middling size has held for a while."""
    settled = round(1.5 / _STEP)
    ratios = []
    for told, speeds, index in pieces:
        for side in range(2):
            for place, shown in zip(index, speeds[side], strict=True):
                held = told[side, max(0, place - settled) : place + 1]
                if np.ptp(held) < 0.02 * top and 0.1 * top < abs(held[-1]) < 0.6 * top:
                    ratios.append(shown / held[-1])
    if len(ratios) < 20:
        told = np.concatenate([told[:, index].ravel() for told, _, index in pieces])
        shown = np.concatenate([speeds.ravel() for _, speeds, _ in pieces])
        ratio = float(told @ shown) / max(float(told @ told), 1e-9)
    else:
        ratio = float(np.median(ratios))
    return ratio if ratio > 0.1 else None


def _pieces(commands: CommandTrack, wheels: WheelTrack, robot: RobotModel) -> list:
    """Blocks: commanded speeds of both sides with history ``[2, T]`` [m/s], measured ``[2, n]``, their places in T."""
    every = max(1, -(-len(wheels) // _MOST))
    stamps, speeds = wheels.stamps[::every], wheels.speeds[::every]
    half = 0.5 * float((robot.drive_offsets.max() - robot.drive_offsets.min()).abs())
    breaks = np.flatnonzero(np.diff(stamps) > _LONGEST_GAP * 1e9) + 1
    pieces = []
    for run in np.split(np.arange(len(stamps)), breaks):
        if len(run) < 10:
            continue
        length = (stamps[run[-1]] - stamps[run[0]]) * 1e-9
        for part in np.array_split(run, max(1, round(length / _BLOCK))):
            if len(part) < 10:
                continue
            first = int(stamps[part[0]]) - round(_HISTORY * 1e9)
            count = round((int(stamps[part[-1]]) - first) * 1e-9 / _STEP) + 1
            twists = commands.sample(first + np.rint(np.arange(count) * _STEP * 1e9).astype(np.int64))
            told = np.stack([twists[:, 0] - half * twists[:, 1], twists[:, 0] + half * twists[:, 1]])
            index = np.rint((stamps[part] - first) * 1e-9 / _STEP).astype(int)
            pieces.append((told, speeds[part].T, index))
    return pieces


def _model(values: np.ndarray, names: tuple[str, ...], told: np.ndarray) -> np.ndarray:
    """Speeds ``[2, T]`` that drives make of commanded ones."""
    known = dict(zip(names, values, strict=True))
    if "delay" in known:
        place = np.arange(told.shape[1]) - known["delay"] / _STEP
        told = np.stack([np.interp(place, np.arange(told.shape[1]), side) for side in told])
    if "width" in known:
        told = np.sign(told) * np.maximum(np.abs(told) - known["width"], 0.0)
    if "limit" in known:
        told = np.clip(told, -known["limit"], known["limit"])
    if "lag" in known and known["lag"] > 1e-4:
        kept = np.exp(-_STEP / known["lag"])
        told = lfilter([1.0 - kept], [1.0, -kept], told, axis=1, zi=kept * told[:, :1])[0]
    return told


def _residuals(values: np.ndarray, names: tuple[str, ...], pieces: list) -> np.ndarray:
    """Measured minus modelled speed [m/s], all samples of both sides."""
    return np.concatenate([(speeds - _model(values, names, told)[:, index]).ravel() for told, speeds, index in pieces])


def _fit(names: tuple[str, ...], pieces: list, top: float) -> np.ndarray:
    """Parameters by robust least squares from a few starts."""
    starts = {"delay": (0.05, 0.3, 0.7), "lag": (0.1, 0.4), "limit": (0.9 * top, 0.6 * top), "width": (0.05 * top,)}
    low = {"delay": 0.0, "lag": 0.0, "limit": 0.02 * top, "width": 0.0}
    high = {"delay": 1.8, "lag": 2.0, "limit": 1.5 * top, "width": 0.6 * top}
    if not names:
        return np.zeros(0)
    best = None
    for number in range(max(len(starts[name]) for name in names)):
        start = [starts[name][number % len(starts[name])] for name in names]
        fit = least_squares(
            _residuals, start, args=(names, pieces), loss="soft_l1", f_scale=0.05 * top, diff_step=1e-2, max_nfev=20,
            bounds=([low[name] for name in names], [high[name] for name in names]),
        )  # fmt: skip
        if best is None or fit.cost < best.cost:
            best = fit
    return best.x
