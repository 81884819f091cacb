"""Trust in predicted terrain: what an encoder said of a place, compared with the ground that the wheels found there."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy import stats

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.perception.trace import continues
from monoforce_ros.perception.trust_blocks import (
    BLOCK,
    FEWEST_BLOCKS,
    LENGTH,
    Blocks,
    Comparison,
    effective_number,
    mean_comparison,
    telling_blocks,
)
from monoforce_ros.terrain import Grid, TerrainMap

ERROR_RATE = 0.01
"""Rate at which an encoder as good as level ground is taken for a worse one, for each test; there are two per metre."""
TOLERANCE = 0.01
"""Difference between two mean errors that does not matter [m]: wheels sink in by as much (8 mm on firm soil)."""
_STEP = 0.01
"""Distance between two comparisons [m]: a robot that stands still finds nothing new."""
_SMALLEST_SQUARE = 1e-9
"""Of differences of heights: where there are none the share is what was expected [m²]."""
_NEAREST, _FARTHEST = 0.8, 5.0
"""Distances from the robot between which predictions are compared [m]: nearer cells are fitted to the wheels."""
DISTANCES = (0.8, 2.0, 3.5, 5.0)
"""Limits of the distance classes of the report [m]."""
START_TOLERANCE = 0.15
"""Largest median difference between predicted and actual ground under the wheels [m]."""


@dataclass(frozen=True)
class TrustReport:
    """How well predictions agreed with the ground that the robot then drove over."""

    trusted: bool
    """Whether predictions are not worse than the fallback's."""
    share: float
    """Share of the predicted difference to the fallback's heights that the ground has confirmed, 0 to 1."""
    travelled: float
    """Distance over which predictions were compared [m]."""
    error: float
    """Mean error of the predicted ground [m]; NaN before any comparison."""
    level_error: float
    """Mean error of level ground at the height of the wheels, at the same places [m]."""
    start_error: float
    """Median difference between the predicted and the actual ground under the wheels now [m]."""
    worst_camera: str = ""
    """Camera that looked at the places with the largest mean error; empty before any comparison."""
    by_distance: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Mean error of prediction and of level ground [m], by the distance from which a place was predicted."""
    by_camera: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """The same by the camera that looked at a place."""
    by_lidar: tuple[float, float] | None = None
    """The same of the visible surface where a lidar measured it then or later; None without any."""
    spread_factor: float = 1.0
    """How much larger errors of predicted heights were than the predicted spreads; at least 1."""
    fallback_error: float = float("nan")
    """Mean error of the fallback's heights at the same places [m]."""
    remedy: str = "adapt the encoder to this robot (train --adapt BAG)"
    """What to do if the encoder is not trusted."""
    sensors: tuple[str, ...] = ()
    """Sensors from which the predictions were made, of ``lidar`` and ``camera``."""
    missing: tuple[str, ...] = ()
    """Sensors of the source that the observation lacks: what was found out with them does not count."""

    @property
    def explanation(self) -> str:
        """The report in words."""
        alone = {"lidar": "from images alone: ", "camera": "from the sweep alone: "}
        return (alone[self.missing[0]] if self.missing else "") + self._findings

    @property
    def _findings(self) -> str:
        if not self.start_error <= START_TOLERANCE:
            return (
                f"the encoder's ground under the wheels is off by {100 * self.start_error:.0f} cm, expected at most"
                f" {100 * START_TOLERANCE:.0f} cm: check the sensors' poses, or {self.remedy}"
            )
        if not np.isfinite(self.error):
            if self.share > 0.0:
                return "nothing compared yet: until the robot reaches ground that was predicted, the prediction is used"
            return "nothing compared yet: until the robot reaches ground that was predicted, the fallback is used"
        compared = (
            f"ground predicted {_NEAREST:g} to {_FARTHEST:g} m ahead was off by {100 * self.error:.0f} cm over the last"
            f" {self.travelled:.1f} m, level ground by {100 * self.level_error:.0f} cm"
        )
        if self.trusted:
            return f"{compared}; {100 * self.share:.0f} % of what it adds to the fallback's heights are used"
        camera = f", worst from {self.worst_camera}" if self.worst_camera else ""
        return f"{compared}{camera}: {self.remedy}"


@dataclass(frozen=True)
class _Said:
    """A prediction made earlier."""

    motion: MotionState
    height: np.ndarray
    """``[rows, columns]`` in its terrain frame [m]."""
    surface: np.ndarray
    """Heights of the visible surface ``[rows, columns]`` [m]."""
    observed: np.ndarray
    level: float
    """Height of level ground in that frame [m]."""
    fallback: np.ndarray
    """Heights of the fallback's map ``[rows, columns]`` [m]."""
    spread: np.ndarray | None
    """Expected errors of the predicted heights ``[rows, columns]`` [m]."""
    cameras: Mapping[str, float]
    """Direction of each camera's optical axis in that frame [rad]."""


def _comparison(said: _Said, ground: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> Comparison:
    """A prediction and ground ``[m, 3]`` in its terrain frame [m], in cells of ``rows`` and ``columns`` ``[m]``."""
    x, y = ground[:, :2].mean(axis=0)
    towards = float(np.arctan2(y, x))
    away = {name: abs((axis - towards + np.pi) % (2 * np.pi) - np.pi) for name, axis in said.cameras.items()}
    height, other = said.height[rows, columns], said.fallback[rows, columns]
    error = np.abs(height - ground[:, 2])
    ratio = float("nan")
    if said.spread is not None:
        ratio = float((error / np.maximum(said.spread[rows, columns], TOLERANCE)).mean())
    said_more, was_more = height - other, ground[:, 2] - other
    return Comparison(
        error=float(error.mean()),
        level=float(np.abs(said.level - ground[:, 2]).mean()),
        product=float((said_more * was_more).mean()),
        square=float((said_more**2).mean()),
        ground=float((was_more**2).mean()),
        off=float(np.abs(was_more).mean()),
        ratio=ratio,
        distance=float(np.hypot(ground[:, 0], ground[:, 1]).mean()),
        camera=min(away, key=lambda name: away[name]) if away else "",
    )


class TerrainTrust:
    """Compares predictions with the ground found later.

    Level ground at the height of the wheels is the rival: an encoder that loses against it over the last metres harms.
    Errors are averaged over blocks of half a metre of travel; a paired t-test over the blocks decides. A place counts
    in the block whose wheels found it first: that the wheels behind find the same is no further evidence.

    The share w of a prediction's difference d to the fallback's heights that is used is the regression of the ground's
    difference g on d, g = w d + noise, with the prior w ~ N(w0, 1). The posterior mean is (Σ d g + w0 σ²) / (Σ d² + σ²)
    over blocks; for σ², the variance of the noise, stands that of g - w0 d, which it is if w is w0. The share stays w0
    until three blocks tell something of it, for one place may differ by chance, and level ground of which both maps
    say the same tells nothing: the effective number of blocks, (Σ d²)² / Σ d⁴, has to be three.

    What images say has to be earned, w0 = 0: they may be of another place, or of a world that looks different. One
    standard deviation less is used, because two hills may be alike by chance. The share is 0 at the start, 3/4 after
    three blocks of perfect predictions, and near 0 for pictures of another place. σ² is that of as many blocks as the
    effective number: level ground between two hills makes their agreement no less likely to be chance. A sweep
    measures, and from one the encoder is right on average wherever robots drove in simulation (docs/training.md):
    w0 = 1 until the ground says otherwise. After three blocks of ground that it put as far off as it differs from the
    fallback, 1/4 is left.

    Whether errors are as large as the predicted spreads say follows from the same comparisons: errors are Laplace
    distributed with the spreads times s as their scales. With the conjugate prior that weighs as much as three blocks,
    s is about (3 + Σ mean |error| / spread) / (3 + blocks). It only widens spreads: robots drive where ground is
    easiest to predict.

    Args:
        grid: cells of the maps.
        expected: prior mean w0 of the share, 0 to 1.
    """

    def __init__(self, grid: Grid, expected: float = 0.0):
        self._grid, self._expected = grid, expected
        self._start_over()

    def _start_over(self) -> None:
        self._said: deque[_Said] = deque(maxlen=round((LENGTH + _FARTHEST) / BLOCK))
        self._comparisons = Blocks()
        self._blocks: list[Comparison] = []
        """Means over the comparisons of each block."""
        self._compared: deque[Comparison] = deque(maxlen=2000)
        self._measured: deque[tuple[float, float]] = deque(maxlen=round(LENGTH / BLOCK))
        """Mean errors of the visible surface, and of level ground, where a lidar measured it [m]."""
        self._travelled = self._uncompared = 0.0
        self._due = False
        """Whether the next prediction is to be remembered."""
        self._previous: MotionState | None = None
        self._trusted = True

    def follow(self, motion: MotionState, support: np.ndarray, measured: np.ndarray | None = None) -> None:
        """Compare earlier predictions with the ground under the wheels, and with what a lidar measures.

        Args:
            motion: the robot's motion now.
            support: points of the ground under its wheels ``[m, 3]`` in its terrain frame [m].
            measured: points of the visible surface ``[n, 3]`` in that frame [m]. They are reported and decide nothing:
                beside a sweep an encoder repeats what was measured.
        """
        if self._previous is None or not continues(motion, self._previous):
            self._start_over()
            moved = BLOCK
        else:
            moved = float(np.linalg.norm(motion.position[:2] - self._previous.position[:2]))
        self._previous = motion
        self._travelled += moved
        self._uncompared += moved
        # A slow robot moves by less between two predictions, and yet arrives.
        if self._uncompared > _STEP:
            self._uncompared = 0.0
            self._compare(transform_points(motion.odometry_from_terrain, support))
        if measured is not None and len(measured):
            self._compare_surface(transform_points(motion.odometry_from_terrain, measured))
        if self._travelled >= BLOCK:
            self._travelled, self._due = 0.0, True
            self._comparisons.close()
            self._blocks = self._comparisons.means
            self._judge()

    def update(
        self,
        motion: MotionState,
        support: np.ndarray,
        predicted: TerrainMap,
        cameras: Mapping[str, float],
        start_error: float,
        fallback: TerrainMap | None = None,
        measured: np.ndarray | None = None,
    ) -> TrustReport:
        """As :meth:`follow`, and remember the newest prediction.

        Args:
            motion, support, measured: see :meth:`follow`.
            predicted: predicted map.
            cameras: direction of each camera's optical axis in the terrain frame [rad].
            start_error: median difference between predicted and actual ground under the wheels [m].
            fallback: map that is used in place of the predicted one; level ground by default.
        """
        self.follow(motion, support, measured)
        if self._due:
            self._due = False
            level = float(support[:, 2].mean())
            height = predicted.height.numpy().copy()
            other = np.full_like(height, level) if fallback is None else fallback.height.numpy().copy()
            spread = None if predicted.height_spread is None else predicted.height_spread.numpy().copy()
            observed = predicted.observed.numpy().copy()
            surface = predicted.geometric_height.numpy().copy()
            self._said.append(_Said(motion, height, surface, observed, level, other, spread, dict(cameras)))
        return self._report(start_error)

    def _compare(self, points: np.ndarray) -> None:
        """Compare ground ``[m, 3]`` in the odometry frame with what was said of it."""
        block_of = self._comparisons.of_places(points)
        for said in self._said:
            local = transform_points(np.linalg.inv(said.motion.odometry_from_terrain), points)
            distance = np.hypot(local[:, 0], local[:, 1])
            rows, columns, inside = self._grid.cells(local[:, :2])
            usable = inside & (distance > _NEAREST) & (distance < _FARTHEST) & said.observed[rows, columns]
            for block in np.unique(block_of[usable]).tolist():
                at = usable & (block_of == block)
                found = _comparison(said, local[at], rows[at], columns[at])
                self._comparisons.add(block, found)
                self._compared.append(found)

    def _compare_surface(self, points: np.ndarray) -> None:
        """Compare the visible surface ``[n, 3]`` in the odometry frame with what was said of it."""
        errors = []
        for said in self._said:
            local = transform_points(np.linalg.inv(said.motion.odometry_from_terrain), points)
            distance = np.hypot(local[:, 0], local[:, 1])
            rows, columns, inside = self._grid.cells(local[:, :2])
            usable = inside & (distance > _NEAREST) & (distance < _FARTHEST) & said.observed[rows, columns]
            if usable.any():
                height = local[usable, 2]
                own = float(np.abs(said.surface[rows, columns][usable] - height).mean())
                errors.append((own, float(np.abs(said.level - height).mean())))
        if errors:
            own, level = np.mean(errors, axis=0).tolist()
            self._measured.append((own, level))

    def _judge(self) -> None:
        if len(self._blocks) < FEWEST_BLOCKS:
            return
        difference = np.array([block.error - block.level for block in self._blocks])
        if self._trusted:
            # Without any variation the test has no answer.
            spread = max(float(difference.std(ddof=1)), 1e-6)
            statistic = (difference.mean() - TOLERANCE) / (spread / np.sqrt(len(difference)))
            self._trusted = bool(stats.t.sf(statistic, len(difference) - 1) >= ERROR_RATE)
        else:
            self._trusted = bool(difference.mean() <= TOLERANCE)

    def _share(self) -> float:
        """The posterior mean of the share w, less its standard deviation where nothing is expected of it."""
        expected, count = self._expected, len(self._blocks)
        if count < FEWEST_BLOCKS:
            return expected
        # Where prediction and fallback agree the ground tells nothing.
        squares = np.array([block.square for block in self._blocks])
        telling = telling_blocks(squares)
        if telling is None:
            return expected
        if expected > 0.0:
            return self._regression(telling, count)
        # A block that would decide alone neither earns trust nor hides that it was wrong.
        return min(self._regression(kept, effective_number(kept * squares)) for kept in (telling, np.ones(count)))

    def _regression(self, weights: np.ndarray, count: float) -> float:
        """The share from blocks with weights ``[n]`` that count as much as ``count`` independent ones."""
        expected = self._expected
        product, square, ground = weights @ np.array([(b.product, b.square, b.ground) for b in self._blocks])

        def noise(share: float) -> float:
            return max(ground - 2.0 * share * product + share**2 * square, _SMALLEST_SQUARE) / count

        precision = square + noise(expected)
        share = (product + expected * noise(expected)) / precision
        doubt = (1.0 - expected) * np.sqrt(noise(share) / precision)
        return float(np.clip(share - doubt, 0.0, 1.0))

    def _spread_factor(self) -> float:
        ratios = [block.ratio for block in self._blocks if not math.isnan(block.ratio)]
        return max(1.0, (FEWEST_BLOCKS + sum(ratios)) / (FEWEST_BLOCKS + len(ratios)))

    def _report(self, start_error: float) -> TrustReport:
        last = mean_comparison(self._blocks) if self._blocks else None
        nothing = float("nan")
        entries = list(self._compared)
        by_distance = {
            f"{low:g} to {high:g} m": _errors(within)
            for low, high in pairwise(DISTANCES)
            if (within := [entry for entry in entries if low <= entry.distance < high])
        }
        by_camera = {
            name: _errors([entry for entry in entries if entry.camera == name])
            for name in sorted({entry.camera for entry in entries} - {""})
        }
        measured = np.mean(self._measured, axis=0).tolist() if self._measured else None
        trusted = self._trusted and start_error <= START_TOLERANCE
        return TrustReport(
            trusted=trusted,
            share=self._share() if trusted else 0.0,
            travelled=BLOCK * len(self._blocks),
            error=nothing if last is None else last.error,
            level_error=nothing if last is None else last.level,
            start_error=start_error,
            worst_camera=max(by_camera, key=lambda name: by_camera[name][0], default=""),
            by_distance=by_distance,
            by_camera=by_camera,
            by_lidar=(measured[0], measured[1]) if measured else None,
            spread_factor=self._spread_factor(),
            fallback_error=nothing if last is None else last.off,
        )


def _errors(comparisons: Sequence[Comparison]) -> tuple[float, float]:
    """Mean error of the prediction and of level ground [m]."""
    return float(np.mean([entry.error for entry in comparisons])), float(np.mean([e.level for e in comparisons]))
