"""Healthy wheels: how the drives followed commands when the robot was commissioned, by measured wheel speeds.

On two healthy drives of one robot the wheels may look different: a lag passes for a limit of the acceleration where all
starts are hard. Whether the drives have changed is therefore not whether the wheels show another model, but whether the
model of commissioning no longer predicts them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import nnls

from monoforce_ros.discrepancy.hypothesis import Effects
from monoforce_ros.effects import CATALOGUE, wheel_effects
from monoforce_ros.robots import RobotModel

_SAME = 1e-3
"""Relative difference of values in a robot file within which they are the same: more than rounding."""


@dataclass(frozen=True)
class HealthyWheels:
    """How the drives of the healthy robot follow commands, and how exactly that predicts them."""

    effects: Effects
    """In the order in which they act on a command."""
    ratio: float
    """Measured speed [rad/s] over that of the wheels' rims [m/s]."""
    noise: float
    """Mean squared error of a wheel's speed where the effects change nothing [m²/s²]."""
    share: float
    """Further mean squared error, as a share of the mean square of what the effects change."""
    unit: float = 1.0
    """Recorded speeds over those in rad/s, which are meant by ``ratio``."""
    in_file: Effects = ()
    """Effects of the drives in the robot file when this was learned."""

    def expected(self, samples: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Expected sum of squared errors [m²/s²] of blocks with so many samples and squared changes by the effects."""
        return self.noise * samples + self.share * changes

    @classmethod
    def learned(
        cls, effects: Effects, ratio: float, losses: np.ndarray, samples: np.ndarray, changes: np.ndarray
    ) -> HealthyWheels:
        """From the blocks of a healthy recording.

        Args:
            effects: that the wheels show.
            ratio: measured speed [rad/s] over that of the wheels' rims [m/s].
            losses: sum of squared errors of each block, held out, ``[n]`` [m²/s²].
            samples: of each block, ``[n]``.
            changes: sum of squared changes by the effects, ``[n]`` [m²/s²].
        """
        (noise, share), _ = nnls(np.stack([samples, changes], axis=1).astype(float), losses)
        return cls(effects, ratio, float(noise), float(share))

    def known_to(self, robot: RobotModel) -> bool:
        """Whether a robot's file still says of the drives what it said when this was learned.

        A file with effects that were found later, or with values that somebody changed, describes other drives.
        """
        then, now = dict(self.in_file), dict(drives_of(robot.effects))
        if then.keys() != now.keys():
            return False
        return all(
            value == now[name].get(key) or abs(value - now[name].get(key, np.inf)) <= _SAME * abs(value)
            for name, values in then.items()
            for key, value in values.items()
        )

    def entry(self) -> dict[str, Any]:
        """The entry ``commissioning.wheels`` of a robot file."""
        return {
            "effects": _listed(self.effects),
            "ratio_rad_m": float(f"{self.ratio:.5g}"),
            "unit": float(f"{self.unit:.5g}"),
            "noise_m2_s2": float(f"{self.noise:.4g}"),
            "share": float(f"{self.share:.4g}"),
            "drives": _listed(self.in_file),
        }

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> HealthyWheels:
        """From the entry of a robot file.

        Raises:
            KeyError, TypeError, ValueError: the entry is invalid.
        """
        effects, in_file = (
            tuple(
                (str(name), {str(key): float(value) for key, value in dict(values).items()})
                for name, values in dict(entry[key]).items()
            )
            for key in ("effects", "drives")
        )
        for name, values in effects:
            response = None if name not in CATALOGUE else CATALOGUE[name].wheel_response
            if response is None or set(values) != {response.parameter, *response.further}:
                raise ValueError(f"wheels.effects: got {name} {values}, expected effects that wheel speeds show")
        ratio, noise, share = (float(entry[key]) for key in ("ratio_rad_m", "noise_m2_s2", "share"))
        unit = float(entry.get("unit", 1.0))
        numbers = [ratio, noise, share, unit, *(value for _, values in effects for value in values.values())]
        if not np.isfinite(numbers).all() or min(ratio, unit) <= 0 or noise < 0 or share < 0:
            raise ValueError("wheels: expected finite numbers, ratio and unit above 0, noise and share of 0 or more")
        return cls(effects, ratio, noise, share, unit, in_file)


def drives_of(effects: Sequence[tuple[str, Mapping[str, Any]]]) -> Effects:
    """Those effects that wheel speeds show."""
    names = {effect.name for effect in wheel_effects()}
    return tuple((name, {key: float(v) for key, v in values.items()}) for name, values in effects if name in names)


def _listed(effects: Effects) -> dict[str, dict[str, float]]:
    return {name: {key: float(f"{value:.5g}") for key, value in values.items()} for name, values in effects}
