"""Flippers: whether measured angles follow the commanded ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from monoforce_ros.bags import JointRecord
from monoforce_ros.core import NANOSECOND
from monoforce_ros.discrepancy.comparison import GapRow
from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.effects import CATALOGUE, flipper_place, only_effect
from monoforce_ros.robots import RobotModel, servo_response

BLOCKED = only_effect(lambda effect: effect.joints_measure)
"""Effect that measured angles of flippers show."""
_PIECE, _STEP = 2.0, 0.02
"""Length of the pieces, that of a diagnosed window, and time step of the modelled servos, below their time constants
(0.05 s of the shipped robot's) [s]."""
_SMALLEST_MOVE = 0.05
"""Change of a commanded angle that an encoder of 1° tells from none within a piece [rad]."""
_FEWEST = 5
"""Pieces with such a change: with fewer the spread of their ratios is unknown."""
_SMALLEST_SHARE = 0.2
"""A servo that is slower than its file says by 0.4 s loses a fifth of a move within a piece of 2 s."""
_QUANTILE = 1.96
"""Of the normal distribution, for an interval of 95 %."""


@dataclass(frozen=True)
class FlipperFinding:
    """Share of its commanded motion that each flipper loses; those that lose none have zeros."""

    shares: tuple[tuple[str, float, float], ...]
    """Place, lost share and half the width of its 95 % interval, of every flipper."""
    before: float
    """RMS difference between measured and commanded changes of the angles within 2 s [rad]."""
    after: float
    """The same with the lost shares."""

    @property
    def effect(self) -> tuple[str, dict[str, float]]:
        """As an effect of the catalogue."""
        return BLOCKED, {place: share for place, share, _ in self.shares}

    @property
    def estimate(self) -> EffectEstimate:
        """As an effect with intervals."""
        values = {
            place: ParameterEstimate(share, share, share, "-").with_half_width(width) if share else
            ParameterEstimate(0.0, 0.0, 0.0, "-")
            for place, share, width in self.shares
        }  # fmt: skip
        return EffectEstimate(BLOCKED, values)

    @property
    def row(self) -> GapRow:
        """Difference between measured and commanded motion without and with the lost shares."""
        gain = self.before - self.after
        width = max(width for _, share, width in self.shares if share) * self.before
        return GapRow(
            horizon=_PIECE, before=self.before, after=self.after, gain_low=gain - width, gain_high=gain + width,
            unit="rad", noise=self.after,
        )  # fmt: skip

    def summary(self) -> str:
        """One line for a report."""
        lost = [f"{place.replace('_', ' ')} {100 * share:.0f} %" for place, share, _ in self.shares if share]
        return f"measured angles: flippers lose a part of their commanded motion ({', '.join(lost)})"


def compare_with_commands(joints: JointRecord | None, robot: RobotModel, spans: np.ndarray) -> FlipperFinding | None:
    """Compare measured flipper angles with what the servos of the robot's file make of the commands.

    Within pieces of 2 s, each from its measured start, the measured change of the angle is a share of the one that was
    commanded; the rest is lost.

    Args:
        joints: of the recording.
        robot: limits, lags and rates of its flippers.
        spans: begin and end of each part of the recording that counts ``[S, 2]`` [ns]; pieces lie within one.

    Returns:
        None without both measured and commanded angles, and where every flipper follows.
    """
    count = len(robot.flippers)
    if joints is None or joints.measured is None or joints.commanded is None or not count:
        return None
    known = dict(dict(robot.effects).get(BLOCKED, {}))
    length = round(_PIECE / NANOSECOND)
    starts = np.concatenate(
        [np.zeros(0, np.int64), *(np.arange(first, last - length, length) for first, last in spans)]
    )
    if not len(starts):
        return None
    times = starts[:, None] + (np.arange(round(_PIECE / _STEP)) * _STEP / NANOSECOND).astype(np.int64)
    wanted = joints.commanded.held(times)[..., -count:]
    begin, end = (joints.measured.at(s)[..., -count:] for s in (starts, times[:, -1]))
    chosen = robot.joints[-count:]
    low, high, lags, rates = (
        np.array([getattr(joint, name) for joint in chosen])
        for name in ("low", "high", "time_constant", "maximum_rate")
    )
    complete = np.isfinite(wanted).all(axis=(1, 2)) & np.isfinite(begin).all(axis=1) & np.isfinite(end).all(axis=1)
    if not complete.any():
        return None
    wanted, begin, end = wanted[complete], begin[complete], end[complete]
    targets, from_angles = torch.as_tensor(np.clip(wanted, low, high)), torch.as_tensor(begin)
    followed, _ = servo_response(targets, from_angles, torch.as_tensor(lags), torch.as_tensor(rates), _STEP)
    commanded, measured = followed[:, -1].numpy() - begin, end - begin
    shares = []
    for index, flipper in enumerate(robot.flippers):
        place = flipper_place(flipper)
        share, width = _lost(commanded[:, index], measured[:, index])
        loses = share - width > max(_SMALLEST_SHARE, float(known.get(place, 0.0)))
        shares.append((place, min(1.0, share), width) if loses else (place, 0.0, 0.0))
    if not any(share for _, share, _ in shares):
        return None
    left = measured - commanded * (1.0 - np.array([share for _, share, _ in shares]))
    before, after = (float(np.sqrt((values**2).mean())) for values in (measured - commanded, left))
    return FlipperFinding(_complete(shares), before, after)


def _lost(commanded: np.ndarray, measured: np.ndarray) -> tuple[float, float]:
    """Lost share of the commanded changes ``[n]`` and half the width of its 95 % interval."""
    moves = np.abs(commanded) > _SMALLEST_MOVE
    if moves.sum() < _FEWEST:
        return 0.0, 0.0
    commanded, measured = commanded[moves], measured[moves]
    energy = float((commanded**2).sum())
    share = 1.0 - float((commanded * measured).sum()) / energy
    residuals = commanded * (measured - (1.0 - share) * commanded)
    return share, _QUANTILE * float(np.sqrt((residuals**2).sum() * len(residuals) / (len(residuals) - 1))) / energy


def _complete(shares: list[tuple[str, float, float]]) -> tuple[tuple[str, float, float], ...]:
    """The shares with zeros for places at which the robot has no flipper."""
    named = [place for place, _, _ in shares]
    missing = [(p.name, 0.0, 0.0) for p in CATALOGUE[BLOCKED].parameters if p.name not in named]
    return (*shares, *missing)
