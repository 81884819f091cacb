"""Nominal model: what commissioning learned of the healthy robot, and how much of its motion stays unexplained."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from monoforce_ros.discrepancy.command_changes import uncovered_residual
from monoforce_ros.discrepancy.evidence import COMPONENTS, MOTION, Evidence, EvidenceWindows
from monoforce_ros.discrepancy.healthy_wheels import HealthyWheels
from monoforce_ros.discrepancy.moderation import VariancePrior
from monoforce_ros.discrepancy.motor_efforts import HealthyEfforts
from monoforce_ros.discrepancy.residual_model import TERMS, motion_terms
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotFileError, read_commissioning, read_nominal_residual, robot_file

SEGMENT = 16.0
"""Length of the segments between which the healthy robot varies [s]: two blocks of cross-validation, so that most kinds
of motion occur in each."""
_SMALLEST = np.array([0.01, 0.01, *np.radians([0.3, 0.3, 0.3]), 0.01, *np.radians([0.6, 0.6]), 0.02])
"""Errors below which nothing is worth a name [m, m, rad, rad, rad, m, rad/s, rad/s, m/s]: a centimetre, and the 0.3° by
which a vertical repeats between drives (``attitude.REPEATABILITY``). Of the rates those by which attitude and height
change as much within the first half second. The centimetre is a choice, not calibrated: a simulated robot without noise
must not be blamed for errors of its integration."""
_CHANGES = ("speed_m_s", "yaw_rate_rad_s")


@dataclass(frozen=True)
class NominalModel:
    """The healthy robot's residual, and how much each effect's influence varies between its segments."""

    residual: np.ndarray
    """RMS residual beyond noise and terrain, ``[K, C]`` at the times of the windows."""
    variation: Mapping[str, float] = field(default_factory=dict)
    """By effect: RMS change of the residual by the effect's variation between segments, in units of
    :meth:`scale_in`."""
    segments: int = 0
    """Number of segments."""
    loss: float = 0.5
    """Mean robust loss of the healthy robot; 0.5 if its residuals are normal and of the motion alone."""
    motion_loss: float | None = None
    """The same without roll, pitch, height and their rates; None where they are no part of ``residual``."""
    loss_spread: float = 0.0
    """Standard deviation of the logarithm of a segment's mean loss."""
    terms: np.ndarray | None = None
    """Coefficients of the residual's variance, ``[C, len(TERMS)]`` (:mod:`residual_model`); None: the same residual in
    all windows."""
    slope: float | None = None
    """Root mean square slope of the ground on which the robot was commissioned [rad]; None if unknown."""
    changes: np.ndarray | None = None
    """Changes of speed [m/s] and of yaw rate [rad/s] that commissioning covered, ``[2]`` (:mod:`command_changes`);
    None: all."""
    lean: np.ndarray | None = None
    """The vertical in the base frame, forward and left, that the robot kept on known ground, ``[2]`` [rad]; None if
    unknown."""
    wheels: HealthyWheels | None = None
    """How the drives followed commands; None without wheel speeds."""
    efforts: HealthyEfforts | None = None
    """How hard the drives' motors worked; None without their currents or torques."""

    @property
    def with_attitude(self) -> bool:
        """Whether roll, pitch and height of the healthy robot are known, and their rates unless an earlier release
        commissioned it."""
        return self.residual.shape[-1] > len(MOTION)

    def summary(self, horizon: float) -> str:
        """One sentence on the residual at the last sample of a window, which is after ``horizon`` [s]."""
        along, across, heading, *attitude = self.residual[-1]
        text = f"nominal residual RMS of the healthy robot after {horizon:g} s: {100 * along:.1f} cm along, "
        text += f"{100 * across:.1f} cm across, {np.degrees(heading):.2f}° in heading"
        if not attitude:
            return text
        # Their rates follow, unless an earlier release commissioned the robot.
        roll, pitch, height = attitude[:3]
        text += f", {np.degrees(roll):.2f}° in roll, {np.degrees(pitch):.2f}° in pitch"
        return f"{text}, {100 * height:.1f} cm in height"

    def of_motion(self) -> NominalModel:
        """The model of the motion alone, without roll, pitch, height and their rates."""
        if not self.with_attitude:
            return self
        count = len(MOTION)
        return replace(
            self,
            residual=self.residual[:, :count],
            terms=None if self.terms is None else self.terms[:count],
            loss=self.loss if self.motion_loss is None else self.motion_loss,
            motion_loss=None,
        )

    def residual_in(self, data: EvidenceWindows) -> np.ndarray:
        """RMS residual of the healthy robot in each window, ``[W, K, C]``."""
        residual = np.broadcast_to(self.residual, (len(data.starts), *self.residual.shape))
        if self.terms is not None:
            residual = np.sqrt(np.einsum("wkj,cj->wkc", motion_terms(data), self.terms))
        return residual if self.changes is None else np.hypot(residual, uncovered_residual(data, self.changes))

    def scale_in(self, data: EvidenceWindows) -> np.ndarray:
        """Unit of ``variation`` in each window, ``[W, K, C]``."""
        residual = self.residual_in(data)
        return np.sqrt(residual**2 + smallest_of(residual) ** 2)

    @cached_property
    def prior(self) -> VariancePrior:
        """What the variations of all directions have in common: of one coefficient, in squared nominal units."""
        squares = [value**2 / _coefficients(name) for name, value in self.variation.items()]
        return VariancePrior.of(squares, max(self.segments - 1, 1))

    def variation_of(self, name: str, drive_share: float) -> tuple[float, float]:
        """Variation of an effect on a healthy recording, in nominal units, and its degrees of freedom.

        It comes from the robot file, which is a mean over its segments, and from what differs between recordings. What
        varies within the recording shows there.

        Args:
            name: of an effect or of a term of a formula.
            drive_share: variance between recordings, as a share of that between segments.
        """
        if not self.variation or not self.segments:
            return 0.0, 0.0
        variance, degrees = self.between_segments(name)
        return float(np.sqrt((drive_share + 1.0 / self.segments) * _coefficients(name) * variance)), degrees

    def between_segments(self, name: str) -> tuple[float, float]:
        """Moderated variance of the change by one coefficient between segments, and its degrees of freedom."""
        own = self.variation.get(name)
        square = None if own is None else own**2 / _coefficients(name)
        return self.prior.moderated(square, max(self.segments - 1, 1))

    def entry(self, samples: tuple[float, ...]) -> dict[str, Any]:
        """The entry ``commissioning`` of a robot file."""
        return {
            "samples_s": list(samples),
            "residual_rms": [[float(f"{value:.4g}") for value in row] for row in self.residual],
            "variation": {name: float(f"{value:.4g}") for name, value in self.variation.items()},
            "segments": self.segments,
            "loss": float(f"{self.loss:.4g}"),
            "loss_spread": float(f"{self.loss_spread:.4g}"),
        } | (
            {} if self.motion_loss is None else {"motion_loss": float(f"{self.motion_loss:.4g}")}
        ) | ({} if self.terms is None else {"residual_terms": self._named_terms()}) | (
            {} if self.slope is None else {"slope_rad": float(f"{self.slope:.3g}")}
        ) | (
            {} if self.lean is None else {"lean_rad": [float(f"{value:.3g}") for value in self.lean]}
        ) | (
            {} if self.wheels is None else {"wheels": self.wheels.entry()}
        ) | (
            {} if self.efforts is None else {"efforts": self.efforts.entry()}
        ) | (
            {} if self.changes is None else
            {"command_changes": {key: float(f"{value:.3g}") for key, value in zip(_CHANGES, self.changes, strict=True)}}
        )  # fmt: skip

    def _named_terms(self) -> dict[str, dict[str, float]]:
        assert self.terms is not None
        return {
            component: {term: float(f"{value:.4g}") for term, value in zip(TERMS, row, strict=True)}
            for component, row in zip(COMPONENTS[: self.residual.shape[-1]], self.terms, strict=True)
        }

    @classmethod
    def read(cls, robot: str | Path, samples: tuple[float, ...]) -> NominalModel | None:
        """The nominal model in a robot file; None without commissioning.

        A file that an earlier release commissioned holds the residual only; then variations are unknown.

        Raises:
            RobotFileError: the entry is invalid or for other times.
        """
        residual = read_nominal_residual(robot, samples)
        entry = read_commissioning(robot)
        if residual is None or entry is None:
            return None
        try:
            variation = {str(name): float(value) for name, value in dict(entry.get("variation") or {}).items()}
            numbers = [float(entry.get(key, value)) for key, value in (("loss", 0.5), ("loss_spread", 0.0))]
            segments = int(entry.get("segments", 0))
            slope = None if entry.get("slope_rad") is None else float(entry["slope_rad"])
            named = entry.get("residual_terms")
            terms = None
            if named is not None:
                components = COMPONENTS[: residual.shape[-1]]
                terms = np.array([[float(named[component][term]) for term in TERMS] for component in components])
            motion_loss = None if entry.get("motion_loss") is None else float(entry["motion_loss"])
            covered = entry.get("command_changes")
            changes = None if covered is None else np.array([float(covered[key]) for key in _CHANGES])
            leaned = entry.get("lean_rad")
            lean = None if leaned is None else np.array([float(leaned[0]), float(leaned[1])])
            wheels = None if entry.get("wheels") is None else HealthyWheels.read(entry["wheels"])
            efforts = None if entry.get("efforts") is None else HealthyEfforts.read(entry["efforts"])
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise RobotFileError(f"{robot_file(robot)}: commissioning: expected numbers, got {error!r}") from error
        values = [*variation.values(), *numbers, *([] if motion_loss is None else [motion_loss])]
        if segments < 0 or not all(np.isfinite(value) and value >= 0 for value in values) or numbers[0] <= 0:
            raise RobotFileError(
                f"{robot_file(robot)}: commissioning: variation, loss and loss_spread: expected finite numbers of 0 or "
                "more; commission the robot again"
            )
        if slope is not None and not 0.0 <= slope <= np.pi / 2:
            raise RobotFileError(
                f"{robot_file(robot)}: commissioning.slope_rad: got {slope}, expected 0 to 1.57; commission the robot "
                "again"
            )
        if lean is not None and not (np.abs(lean) < 1.0).all():
            raise RobotFileError(
                f"{robot_file(robot)}: commissioning.lean_rad: got {lean.tolist()}, expected two numbers between -1 "
                "and 1; commission the robot again"
            )
        if terms is not None and not (np.isfinite(terms).all() and (terms >= 0).all()):
            raise RobotFileError(
                f"{robot_file(robot)}: commissioning.residual_terms: expected finite numbers of 0 or more; commission "
                "the robot again"
            )
        if changes is not None and not (np.isfinite(changes).all() and (changes >= 0).all()):
            raise RobotFileError(
                f"{robot_file(robot)}: commissioning.command_changes: expected finite numbers of 0 or more; commission "
                "the robot again"
            )
        return cls(
            residual, variation, segments, loss=numbers[0], motion_loss=motion_loss, loss_spread=numbers[1],
            terms=terms, slope=slope, changes=changes, lean=lean, wheels=wheels, efforts=efforts,
        )  # fmt: skip


def with_known_components(evidence: Evidence, nominal: NominalModel | None) -> tuple[Evidence, NominalModel | None]:
    """A recording and the healthy robot with the components of residuals that both know.

    How a healthy robot leans, and how fast that changes, is known from commissioning only.
    """
    count = len(MOTION) if nominal is None else min(len(evidence.components), nominal.residual.shape[-1])
    evidence = replace(evidence, components=COMPONENTS[:count])
    return evidence, nominal if nominal is None or evidence.with_attitude else nominal.of_motion()


def smallest_of(residuals: np.ndarray) -> np.ndarray:
    """Residuals below this are insignificant even on noise-free data [m, m, rad, rad, rad, m, rad/s, rad/s, m/s], for
    ``[..., C]``."""
    return _SMALLEST[: residuals.shape[-1]]


def _coefficients(name: str) -> int:
    """Number of coefficients of a direction: parameters of an effect, one of a term of a formula."""
    effect = CATALOGUE.get(name)
    return 1 if effect is None else max(len(effect.identified), 1)
