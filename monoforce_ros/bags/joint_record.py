"""JointRecord: measured angles of a robot's joints and commands to its flippers, as a bag contains them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monoforce_ros.core import JointTrack

_MAXIMUM_GAP = 0.3
"""Largest time between the start of a window and a measured angle [s]."""


@dataclass(frozen=True)
class JointRecord:
    """Joints of a recording, in the order of the robot's joints, of which the last ones are its flippers."""

    measured: JointTrack | None
    commanded: JointTrack | None
    """Commanded angles; other joints than flippers are not used."""
    flippers: int
    """Number of flippers."""

    def start(self, stamps: np.ndarray) -> np.ndarray | None:
        """Measured angles at stamps ``[W]`` [ns], ``[W, J]`` [rad], NaN where unknown; None if none were measured."""
        return None if self.measured is None else self.measured.at(stamps, maximum_gap=_MAXIMUM_GAP)

    def flipper_angles(self, stamps: np.ndarray) -> np.ndarray | None:
        """Angles that the flippers were commanded ``[..., F]`` [rad], NaN where unknown, at stamps ``[...]`` [ns].

        Without recorded commands the measured angles take their place. None for a robot without flippers, and where
        nothing was recorded.
        """
        if not self.flippers:
            return None
        if self.commanded is not None:
            return self.commanded.held(stamps)[..., -self.flippers :]
        if self.measured is not None:
            return self.measured.at(stamps, maximum_gap=_MAXIMUM_GAP)[..., -self.flippers :]
        return None
