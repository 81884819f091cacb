"""Held-out bags: further recordings on which errors without and with the found effects are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from monoforce_ros.discrepancy.clocks import compare_with_gyro
from monoforce_ros.discrepancy.comparison import FEWEST_WINDOWS, HORIZONS, GapRow, HeldOut, compare, gap_table
from monoforce_ros.discrepancy.evidence import Evidence
from monoforce_ros.discrepancy.gap import noisy_motions
from monoforce_ros.discrepancy.hypothesis import Effects, corrected_evidence
from monoforce_ros.discrepancy.left_out_stretches import LeftOut
from monoforce_ros.discrepancy.nominal import NominalModel, with_known_components
from monoforce_ros.discrepancy.sensor_findings import heading_noise
from monoforce_ros.robots import RobotModel, fingerprint

_HORIZON = 2.0
"""Of the windows that are counted [s]: that of a diagnosis."""


@dataclass(frozen=True)
class HeldOutBag:
    """A recording that is long enough for a comparison."""

    evidence: Evidence
    """Corrected for what the robot's file says of its sensors."""
    robot: RobotModel
    """The nominal model."""
    left_out: LeftOut
    """What of the recording cannot be compared."""

    @classmethod
    def of(cls, evidence: Evidence, robot: RobotModel, nominal: NominalModel | None) -> HeldOutBag:
        """A recording as it was read.

        Args:
            evidence: motion, commands and ground.
            robot: the nominal model.
            nominal: what commissioning learned.

        Raises:
            ValueError: there are too few windows for any horizon.
        """
        evidence, _ = with_known_components(corrected_evidence(evidence, robot), nominal)
        if not len(evidence.commands):
            raise ValueError("no commands; record the commands of the base controller (cmd_vel)")
        left_out = LeftOut.of(evidence, robot)
        starts = left_out.starts(evidence, HORIZONS[0])
        if len(starts) < FEWEST_WINDOWS:
            raise ValueError(
                f"{len(starts)} windows of {HORIZONS[0]:g} s, expected at least {FEWEST_WINDOWS}: give a "
                "recording of 10 s or longer, without gaps, with commands and on its map"
            )
        return cls(evidence, robot, left_out)

    def table(self, effects: Effects) -> dict[str, GapRow]:
        """Errors without and with effects that were fitted to another recording, by metric and horizon."""
        smoothed = self.evidence.smoothed
        starts = self.left_out.starts(self.evidence, _HORIZON)
        data = self.evidence.cut(starts, np.array([_HORIZON]))
        everywhere = HeldOut.everywhere(effects) if effects else None
        compared = compare(self.robot, data, self.evidence, self.left_out, everywhere, noisy_motions(smoothed))
        by_gyro = heading_noise(self.evidence, compare_with_gyro(smoothed, self.evidence.gyro))
        return gap_table(compared, heading_noise=by_gyro)


def named_bags(bags: Sequence[Path]) -> dict[str, Path]:
    """Bags by names that differ: the last part of the path, with as many parents as it takes; each bag once."""
    paths = list(dict.fromkeys(bag.resolve() for bag in bags))
    named = {}
    for path in paths:
        count = next(
            count
            for count in range(1, len(path.parts) + 1)
            if all(other == path or other.parts[-count:] != path.parts[-count:] for other in paths)
        )
        named["/".join(path.parts[-count:])] = path
    return named


def refuse_unusable(bags: Mapping[str, Path], diagnosed: Path, data: str) -> None:
    """Raise ``ValueError`` if a held-out bag does not exist or is the diagnosed one.

    Args:
        bags: by name.
        diagnosed: the diagnosed recording.
        data: its fingerprint.
    """
    for bag in bags.values():
        if not bag.exists():
            raise ValueError(f"{bag}: --held-out got a path that does not exist, expected a bag")
        if fingerprint([bag]) == data:
            raise ValueError(f"{bag}: --held-out got the diagnosed recording {diagnosed}, expected another recording")
