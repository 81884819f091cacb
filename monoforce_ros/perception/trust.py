"""Trust in predicted terrain: what an encoder said of a place, compared with the ground that the wheels found there."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import stats

from monoforce_ros.core import MotionState, transform_points
from monoforce_ros.perception.encoder_terrain import EncoderTerrain
from monoforce_ros.perception.ground_alignment import standing
from monoforce_ros.perception.observation import Observation, TerrainSource
from monoforce_ros.perception.temporal_memory import TemporalMemory
from monoforce_ros.perception.trace import continues
from monoforce_ros.terrain import Grid, TerrainError, TerrainMap

BLOCK = 0.5
"""Distance travelled in one block of comparisons [m], about a robot's length: errors within it are not independent."""
LENGTH = 6.0
"""Distance travelled over which predictions are judged [m]."""
ERROR_RATE = 0.01
"""Rate at which an encoder as good as level ground is taken for a worse one, for each test; there are two per metre."""
TOLERANCE = 0.01
"""Difference between two mean errors that does not matter [m]: wheels sink in by as much (8 mm on firm soil)."""
_STEP = 0.01
"""Distance between two comparisons [m]: a robot that stands still finds nothing new."""
_FEWEST_BLOCKS = 3
_SMALLEST_SQUARE = 1e-9
"""Of differences of heights: where there are none the share is what was expected [m²]."""
_LEAST_MATERIAL = 1e-6
"""Stiffness, damping and friction that count as none, in their units."""
_SMALLEST_SPREAD = 1e-4
"""Below which a spread is none [m]."""
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
    spread_factor: float = 1.0
    """How much larger errors of predicted heights were than the predicted spreads; at least 1."""
    fallback_error: float = float("nan")
    """Mean error of the fallback's heights at the same places [m]."""
    remedy: str = "adapt the encoder to this robot (train --adapt BAG)"
    """What to do if the encoder is not trusted."""

    @property
    def explanation(self) -> str:
        """The report in words."""
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


class _Comparison(NamedTuple):
    """Means over points of the ground under the wheels, of which one earlier prediction had said something."""

    error: float
    """Of the prediction [m]."""
    level: float
    """Error of level ground [m]."""
    product: float
    """d g of :class:`TerrainTrust` [m²]."""
    square: float
    """d² [m²]."""
    ground: float
    """g² [m²]."""
    off: float
    """|g|, the error of the fallback [m]."""
    ratio: float
    """Error of the prediction in units of its spread; NaN where it tells none."""
    distance: float
    """From which the prediction was made [m]."""
    camera: str
    """That looked at the place."""


@dataclass(frozen=True)
class _Said:
    """A prediction made earlier."""

    motion: MotionState
    height: np.ndarray
    """``[rows, columns]`` in its terrain frame [m]."""
    observed: np.ndarray
    level: float
    """Height of level ground in that frame [m]."""
    fallback: np.ndarray
    """Heights of the fallback's map ``[rows, columns]`` [m]."""
    spread: np.ndarray | None
    """Expected errors of the predicted heights ``[rows, columns]`` [m]."""
    cameras: Mapping[str, float]
    """Direction of each camera's optical axis in that frame [rad]."""


class TerrainTrust:
    """Compares predictions with the ground found later.

    Level ground at the height of the wheels is the rival: an encoder that loses against it over the last metres harms.
    Errors are averaged over blocks of half a metre of travel; a paired t-test over the blocks decides.

    The share w of a prediction's difference d to the fallback's heights that is used is the regression of the ground's
    difference g on d, g = w d + noise, with the prior w ~ N(w0, 1). The posterior mean is (Σ d g + w0 σ²) / (Σ d² + σ²)
    over blocks; for σ², the variance of the noise, stands that of g - w0 d, which it is if w is w0.

    What images say has to be earned, w0 = 0: they may be of another place, or of a world that looks different. One
    standard deviation less is used, because two hills may be alike by chance. The share is 0 at the start, 3/4 after
    three blocks of perfect predictions, and near 0 for pictures of another place. A sweep measures, and from one the
    encoder is right on average wherever robots drove in simulation (docs/training.md): w0 = 1 until the ground
    says otherwise. After three blocks of ground that it put as far off as it differs from the fallback, 1/4 is left.

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
        self._blocks: deque[_Comparison] = deque(maxlen=round(LENGTH / BLOCK))
        """Means over the comparisons of each block."""
        self._pending: list[_Comparison] = []
        """Comparisons of the current block."""
        self._compared: deque[_Comparison] = deque(maxlen=2000)
        self._travelled = self._uncompared = 0.0
        self._previous: MotionState | None = None
        self._trusted = True

    def update(
        self,
        motion: MotionState,
        support: np.ndarray,
        predicted: TerrainMap,
        cameras: Mapping[str, float],
        start_error: float,
        fallback: TerrainMap | None = None,
    ) -> TrustReport:
        """Compare earlier predictions with the ground under the wheels, and remember the newest one.

        Args:
            motion: the robot's motion now.
            support: points of the ground under its wheels ``[m, 3]`` in its terrain frame [m].
            predicted: predicted map.
            cameras: direction of each camera's optical axis in the terrain frame [rad].
            start_error: median difference between predicted and actual ground under the wheels [m].
            fallback: map that is used in place of the predicted one; level ground by default.
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
        if self._travelled >= BLOCK:
            self._travelled = 0.0
            if self._pending:
                self._blocks.append(_mean(self._pending))
                self._compared.extend(self._pending)
                self._pending = []
                self._judge()
            level = float(support[:, 2].mean())
            height = predicted.height.numpy().copy()
            other = np.full_like(height, level) if fallback is None else fallback.height.numpy().copy()
            spread = None if predicted.height_spread is None else predicted.height_spread.numpy().copy()
            observed = predicted.observed.numpy().copy()
            self._said.append(_Said(motion, height, observed, level, other, spread, dict(cameras)))
        return self._report(start_error)

    def _compare(self, points: np.ndarray) -> None:
        """Compare ground ``[m, 3]`` in the odometry frame with what was said of it."""
        for said in self._said:
            local = transform_points(np.linalg.inv(said.motion.odometry_from_terrain), points)
            distance = np.hypot(local[:, 0], local[:, 1])
            rows, columns, inside = self._grid.cells(local[:, :2])
            usable = inside & (distance > _NEAREST) & (distance < _FARTHEST) & said.observed[rows, columns]
            if not usable.any():
                continue
            height = said.height[rows, columns][usable]
            error = float(np.abs(height - local[usable, 2]).mean())
            level = float(np.abs(said.level - local[usable, 2]).mean())
            middle = local[usable, :2].mean(axis=0)
            towards = float(np.arctan2(middle[1], middle[0]))
            away = {name: abs((axis - towards + np.pi) % (2 * np.pi) - np.pi) for name, axis in said.cameras.items()}
            camera = min(away, key=lambda name: away[name]) if away else ""
            ratio = float("nan")
            if said.spread is not None:
                expected = np.maximum(said.spread[rows, columns][usable], TOLERANCE)
                ratio = float((np.abs(height - local[usable, 2]) / expected).mean())
            other = said.fallback[rows, columns][usable]
            said_more, was_more = height - other, local[usable, 2] - other
            self._pending.append(
                _Comparison(
                    error=error,
                    level=level,
                    product=float((said_more * was_more).mean()),
                    square=float((said_more**2).mean()),
                    ground=float((was_more**2).mean()),
                    off=float(np.abs(was_more).mean()),
                    ratio=ratio,
                    distance=float(distance[usable].mean()),
                    camera=camera,
                )
            )

    def _judge(self) -> None:
        if len(self._blocks) < _FEWEST_BLOCKS:
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
        if count < _FEWEST_BLOCKS:
            return expected
        product, square, ground = np.array([(b.product, b.square, b.ground) for b in self._blocks]).T.sum(axis=1)

        def noise(share: float) -> float:
            return max(ground - 2.0 * share * product + share**2 * square, _SMALLEST_SQUARE) / count

        precision = square + noise(expected)
        share = (product + expected * noise(expected)) / precision
        doubt = (1.0 - expected) * np.sqrt(noise(share) / precision)
        return float(np.clip(share - doubt, 0.0, 1.0))

    def _spread_factor(self) -> float:
        ratios = [block.ratio for block in self._blocks if not math.isnan(block.ratio)]
        return max(1.0, (_FEWEST_BLOCKS + sum(ratios)) / (_FEWEST_BLOCKS + len(ratios)))

    def _report(self, start_error: float) -> TrustReport:
        last = _mean(self._blocks) if self._blocks else None
        nothing = float("nan")
        entries = list(self._compared)
        by_distance = {}
        for low, high in pairwise(DISTANCES):
            within = [entry for entry in entries if low <= entry.distance < high]
            if within:
                means = float(np.mean([e.error for e in within])), float(np.mean([e.level for e in within]))
                by_distance[f"{low:g} to {high:g} m"] = means
        cameras = {entry.camera for entry in entries}
        worst = max(
            cameras, key=lambda name: float(np.mean([e.error for e in entries if e.camera == name])), default=""
        )
        trusted = self._trusted and start_error <= START_TOLERANCE
        return TrustReport(
            trusted=trusted,
            share=self._share() if trusted else 0.0,
            travelled=BLOCK * len(self._blocks),
            error=nothing if last is None else last.error,
            level_error=nothing if last is None else last.level,
            start_error=start_error,
            worst_camera=worst,
            by_distance=by_distance,
            spread_factor=self._spread_factor(),
            fallback_error=nothing if last is None else last.off,
        )


def _mean(comparisons: Iterable[_Comparison]) -> _Comparison:
    """Mean of all numbers; of the camera the last one."""
    rows = list(comparisons)
    return _Comparison._make([*np.mean([row[:-1] for row in rows], axis=0).tolist(), rows[-1].camera])


class TrustedTerrain:
    """An encoder's terrain to the degree that the ground has confirmed it, and a fallback otherwise.

    The encoder keeps predicting meanwhile, and is used again once it is no worse than level ground.

    Args:
        source: source of the encoder's maps, with or without temporal memory.
        encoder: the encoder's own source within it.
        fallbacks: sources of the maps where the encoder is not trusted; the first one whose sensors have measured
            enough.
        expected: see :class:`TerrainTrust`.
        memory: of earlier observations, which fill the map that results.
    """

    def __init__(
        self,
        source: TerrainSource,
        encoder: EncoderTerrain,
        fallbacks: Sequence[TerrainSource],
        expected: float = 0.0,
        memory: TemporalMemory | None = None,
    ):
        self.source = source
        """Source of the encoder's maps."""
        self._encoder, self._fallbacks, self._memory = encoder, tuple(fallbacks), memory
        self._trust = TerrainTrust(source.grid, expected)
        self.report: TrustReport | None = None
        """Result of the last comparison; None before the first map."""
        self.predicted: TerrainMap | None = None
        """The encoder's last map, before any of it was replaced by the fallback's."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors of the source."""
        return self.source.sensors

    @property
    def grid(self) -> Grid:
        """Grid of the source."""
        return self.source.grid

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """The encoder's map or the fallback's; raises the source's errors."""
        self.predicted = predicted = self.source.terrain(observation, motion)
        other = self._fallback(observation, motion)
        encoder = self._encoder
        _, support = standing(encoder.robot, observation.flipper_angles, motion, encoder.stiffness)
        cameras = {}
        for name, pose in observation.base_from_cameras.items():
            axis = (motion.terrain_from_base @ pose)[:3, 2]
            cameras[name] = float(np.arctan2(axis[1], axis[0]))
        report = self._trust.update(motion, support, predicted, cameras, self._encoder.start_error, other)
        # Adaptation needs images.
        without = replace(report, remedy="use terrain_source lidar_interpolation")
        self.report = report if "camera" in self.sensors else without
        used = blended(other, predicted, report.share, report.spread_factor)
        if not (report.trusted or other.spreads):
            used = _with_measured_error(used, report)
        return used if self._memory is None else self._memory.recalled(used, observation, motion)

    def _fallback(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """Map of the first fallback whose sensors have measured enough; the last one's error if there is none."""
        measured = {"lidar": observation.cloud is not None, "camera": bool(observation.images)}
        usable = [f for f in self._fallbacks if all(measured[sensor] for sensor in f.sensors)]
        for fallback in usable[:-1]:
            try:
                return fallback.terrain(observation, motion)
            except TerrainError:
                continue
        return usable[-1].terrain(observation, motion)


def blended(fallback: TerrainMap, predicted: TerrainMap, share: float, spread_factor: float = 1.0) -> TerrainMap:
    """The fallback's map with a share of its difference to a predicted one.

    Stiffness, damping and friction are interpolated in their logarithms. Cells count as observed where the predicted
    map says so; level ground alone would count as observed everywhere.

    Where the predicted map tells spreads, the result does. A fallback with spreads of its own: those of a mean of two
    heights are at most their mean. A fallback without: if the surface is Laplace distributed about the predicted
    height with scale b, 90 % of it lie within b (ln 10 + ln cosh(m / b)) of a height that is m apart from that.

    Args:
        fallback: what is used of share 0.
        predicted: what is used of share 1.
        share: 0 to 1.
        spread_factor: on the predicted spreads.
    """
    changed: dict[str, Any] = {"observed": predicted.observed}
    if share > 0.0:
        for name in ("height", "geometric_height"):
            changed[name] = torch.lerp(getattr(fallback, name), getattr(predicted, name), share)
        for name in ("stiffness", "damping", "friction"):
            # The defaults of damping and friction may be 0.
            start, end = (getattr(terrain, name).clamp_min(_LEAST_MATERIAL).log() for terrain in (fallback, predicted))
            changed[name] = torch.lerp(start, end, share).exp()
    apart = {
        "geometric_spread": predicted.geometric_height - fallback.geometric_height,
        "decrease_spread": _decrease(predicted) - _decrease(fallback),
    }
    for name, difference in apart.items():
        own, other = getattr(predicted, name), getattr(fallback, name)
        if own is None:
            changed[name] = other if share <= 0.0 else None
            continue
        own = spread_factor * own
        changed[name] = _spread_about(own, (1.0 - share) * difference) if other is None else other.lerp(own, share)
    return replace(fallback, **changed)


def _with_measured_error(terrain: TerrainMap, report: TrustReport) -> TerrainMap:
    """The fallback's map beside a prediction that is not trusted, which then says as little of the fallback's errors.

    Spreads are those that the prediction implies, weighing as much as three blocks, and the error of the supporting
    ground that the wheels measured.
    """
    blocks = report.travelled / BLOCK
    if not blocks or terrain.geometric_spread is None:
        return terrain
    weight = blocks / (blocks + _FEWEST_BLOCKS)
    own, decrease = terrain.geometric_spread, terrain.decrease_spread
    return replace(
        terrain,
        geometric_spread=own.lerp(torch.full_like(own, report.fallback_error), weight),
        decrease_spread=None if decrease is None else (1.0 - weight) * decrease,
    )


def _spread_about(spread: torch.Tensor, apart: torch.Tensor) -> torch.Tensor:
    """Scale of the Laplace distribution about a height ``apart`` from the predicted one with the same 90 % band [m]."""
    ratio = apart.abs() / spread.clamp_min(_SMALLEST_SPREAD)
    # ln cosh, which overflows.
    beyond = ratio + torch.log1p(torch.exp(-2.0 * ratio)) - math.log(2.0)
    return spread.clamp_min(_SMALLEST_SPREAD) * (1.0 + beyond / math.log(10.0))


def _decrease(terrain: TerrainMap) -> torch.Tensor:
    """Height of the visible surface above the supporting ground (H_d) [m]."""
    return terrain.geometric_height - terrain.height
