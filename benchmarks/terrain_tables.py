"""Tables of the protocol of docs/protocol.md: means, ratios and strata over worlds and training seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from monoforce_ros.evaluation.tables import CONSTANT, FLAT, LIDAR, System, mean_over, ratio_over

BOUND = System("true_support", "true support height (bound)", "ground truth")
LEARNED = {
    "shipped": ("shipped encoder, images → H_t", "images"),
    "shipped_lidar": ("shipped encoder, lidar → H_t", "point cloud"),
    "shipped_both": ("shipped encoder, both → H_t", "images, point cloud"),
    "lidar_hg": ("lidar → H_g [22]", "point cloud"),
    "lidar_ht": ("lidar → H_t", "point cloud"),
    "lidar_ht_traced": ("lidar → H_t, H_t* traced instead of fitted", "point cloud"),
    "lss": ("images → H_g, LSS [9]", "images"),
    "monoforce": ("images → H_t, MonoForce", "images"),
    "both": ("both → H_t", "images, point cloud"),
    "no_geometric": ("MonoForce without geometric loss", "images"),
    "no_terrain": ("MonoForce without terrain loss", "images"),
}
"""Title and input of each learned system, by its name."""
FEWEST_WORLDS = 5
"""Strata with fewer worlds say more of these than of the stratum."""
DEEP = 0.2
"""Depth of soft vegetation that counts as tall where the robot drives through it [m]."""
SHIPPED = tuple(name for name in LEARNED if name.startswith("shipped"))
RATIOS = (
    ("monoforce", "lss"), ("monoforce", "lidar"), ("monoforce", "no_geometric"), ("monoforce", "no_terrain"),
    ("lss", "lidar"), ("lidar_hg", "lidar"), ("lidar_ht", "lidar_hg"), ("lidar_ht", "lidar"),
    ("lidar_ht_traced", "lidar_ht"), ("both", "monoforce"), ("both", "lidar_ht"),
    ("shipped", "lidar"), ("shipped", "flat"), ("shipped_lidar", "lidar"), ("shipped_both", "shipped"),
    ("shipped_both", "shipped_lidar"), ("shipped_both", "lidar"), ("lidar", "true_support"),
)  # fmt: skip
"""Systems whose errors are compared."""
PAPER = {
    "lidar": ((0.14, 4.06), (0.13, 4.74)),
    "lidar_hg": ((0.20, 4.63), (0.13, 4.32)),
    "lss": ((0.12, 4.59), (0.11, 5.80)),
    "monoforce": ((0.13, 4.53), (0.07, 2.62)),
    "no_geometric": (None, (0.09, 2.56)),
}
"""Δx [m] and ΔR [deg] of the paper: on RELLIS-3D (Table I), which is rigid, and on RobinGas (Tables II and III)."""


@dataclass(frozen=True)
class Result:
    """Errors of a system with one of its checkpoints on one world."""

    system: str
    checkpoint: str
    world: int
    physics: str
    position: float
    """Δx [m]."""
    rotation: float
    """ΔR [deg]."""
    windows: int
    strata: dict[str, str]
    worst: int = 0
    """Start of the window with the largest position error [ns]; 0 without any."""
    worst_position: float = float("nan")
    """Its error [m]."""
    by_distance: dict[str, float] = field(default_factory=dict)
    """Δx [m] of poses by the distance from the start."""
    positions: list[float] = field(default_factory=list)
    """Δx of each window [m]; NaN where the prediction diverged."""
    rotations: list[float] = field(default_factory=list)
    """ΔR of each window [deg]."""
    vegetation: list[float] = field(default_factory=list)
    """Greatest depth of soft vegetation under the driven path of each window [m]."""
    overgrown: list[float] = field(default_factory=list)
    """Share of each window's path with at least :data:`DEEP` of it."""


def _rigid(result: Result) -> np.ndarray:
    """Windows without vegetation under the path, as the paper's Table I."""
    return np.asarray(result.vegetation) < 0.05


def _tall(result: Result) -> np.ndarray:
    """Windows of which the robot drives a quarter through deep vegetation, as its Tables II and III."""
    return np.asarray(result.overgrown) >= 0.25


def _between(result: Result) -> np.ndarray:
    return ~(_rigid(result) | _tall(result))


GROUNDS: dict[str, Callable[[Result], np.ndarray]] = {
    "rigid": _rigid, "some vegetation": _between, "tall vegetation": _tall,
}  # fmt: skip
"""Windows by the vegetation under the driven path."""


def in_common(results: Sequence[Result]) -> list[Result]:
    """The results without windows in which a prediction of any system diverged."""
    usable: dict[tuple[int, str], np.ndarray] = {}
    for result in results:
        if result.positions:
            finite = np.isfinite(result.positions) & np.isfinite(result.rotations)
            key = (result.world, result.physics)
            usable[key] = usable.get(key, np.ones(len(finite), bool)) & finite
    return over_windows(results, lambda result: usable.get((result.world, result.physics), np.zeros(0, bool)))


def over_windows(results: Sequence[Result], chosen: Callable[[Result], np.ndarray]) -> list[Result]:
    """Results over some of their windows; those without any of these are left out."""
    found = []
    for result in results:
        keep = np.flatnonzero(chosen(result))
        if not len(keep):
            continue
        listed = {
            name: [getattr(result, name)[i] for i in keep]
            for name in ("positions", "rotations", "vegetation", "overgrown")
        }
        means = {"position": np.mean(listed["positions"]), "rotation": np.mean(listed["rotations"])}
        found.append(replace(result, windows=len(keep), **{n: float(v) for n, v in means.items()}, **listed))
    return found


def diverged(results: Sequence[Result]) -> dict[str, int]:
    """Number of predictions of each system that diverged."""
    found: dict[str, int] = {}
    for result in results:
        count = int(np.sum(~np.isfinite(result.positions)))
        if count:
            found[result.system] = found.get(result.system, 0) + count
    return found


def interval(results: Sequence[Result], measure: str) -> tuple[float, float, float]:
    """Mean over worlds and training seeds, with a 95 % interval: see :func:`monoforce_ros.evaluation.tables.mean_over`.

    Worlds and training seeds are independent; windows of one world are not.
    """
    found = mean_over(_by_world_and_run(results, sorted({result.world for result in results}), measure))
    return found.value, found.low, found.high


def ratio(results: Sequence[Result], others: Sequence[Result], measure: str) -> tuple[float, float, float]:
    """Ratio of two systems' means over the same worlds, with a 95 % interval: see
    :func:`monoforce_ros.evaluation.tables.ratio_over`.
    """
    common = sorted({result.world for result in results} & {result.world for result in others})
    found = ratio_over(*(_by_world_and_run(listed, common, measure) for listed in (results, others)))
    return found.value, found.low, found.high


def _by_world_and_run(results: Sequence[Result], worlds: Sequence[int], measure: str) -> np.ndarray:
    """Errors ``[worlds, training seeds]``; NaN where there is none."""
    runs = sorted({result.checkpoint for result in results})
    values = np.full((len(worlds), len(runs)), np.nan)
    for result in results:
        if result.world in worlds:
            values[worlds.index(result.world), runs.index(result.checkpoint)] = getattr(result, measure)
    return values


def table(results: Sequence[Result]) -> str:
    """Markdown table of all systems, for each kind of physics."""
    titles = {LIDAR.key: LIDAR, FLAT.key: FLAT, CONSTANT.key: CONSTANT, BOUND.key: BOUND} | {
        key: System(key, *listed) for key, listed in LEARNED.items()
    }
    lines = []
    for physics in dict.fromkeys(result.physics for result in results):
        chosen = [result for result in results if result.physics == physics]
        worlds = {result.world for result in chosen}
        windows = sum(result.windows for result in chosen if result.system == LIDAR.key)
        lines += [f"**Physics: {physics}**: {len(worlds)} worlds, {windows} windows of up to 5 s", ""]
        lines += [
            "| input | terrain | training seeds | Δx [m] | ΔR [deg] | paper, Table I | paper, Tables II, III |",
            "|---" * 7 + "|",
        ]
        for key in dict.fromkeys(result.system for result in chosen):
            own = [result for result in chosen if result.system == key]
            seeds = len({result.checkpoint for result in own if result.checkpoint}) or "–"
            cells = []
            for measure, digits in (("position", 3), ("rotation", 2)):
                mean, low, high = interval(own, measure)
                cells.append(f"{mean:.{digits}f} ({low:.{digits}f} – {high:.{digits}f})")
            cells += ["–" if listed is None else f"{listed[0]:.2f} m, {listed[1]:.2f}°"
                      for listed in PAPER.get(key, (None, None))]  # fmt: skip
            lines.append(f"| {titles[key].input} | {titles[key].title} | {seeds} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def ratio_table(results: Sequence[Result], physics: str) -> str:
    """Markdown table of the ratios of :data:`RATIOS` for which both systems were evaluated; empty without any.

    Those of the paper stand beside the windows that are like its own: without vegetation, and in tall vegetation.
    """
    chosen = [result for result in results if result.physics == physics]
    rigid, tall = (over_windows(chosen, GROUNDS[name]) for name in ("rigid", "tall vegetation"))
    lines = [
        f"| ratio | Δx | ΔR | rigid ({_extent(rigid)}): Δx | ΔR | paper's Table I | tall vegetation "
        f"({_extent(tall)}): Δx | ΔR | paper's Tables II, III |",
        "|---" * 9 + "|",
    ]
    known = {result.system for result in chosen}
    for first, second in RATIOS:
        if first not in known or second not in known:
            continue
        cells = []
        for table_number, among in enumerate((chosen, rigid, tall), start=-1):
            own, others = ([result for result in among if result.system == key] for key in (first, second))
            for measure in ("position", "rotation"):
                value, low, high = ratio(own, others, measure)
                cells.append(f"{value:.2f} ({low:.2f} – {high:.2f})" if np.isfinite(value) else "–")
            if table_number >= 0:
                cells.append(_paper_ratio(first, second, table_number))
        lines.append(f"| {first} / {second} | {' | '.join(cells)} |")
    return "\n".join(lines) if len(lines) > 2 else ""


def _extent(results: Sequence[Result]) -> str:
    """Number of windows and worlds, which every system has in common."""
    windows = {result.world: result.windows for result in results}
    return f"{sum(windows.values())} windows of {len(windows)} worlds"


def _paper_ratio(first: str, second: str, table_number: int) -> str:
    """Ratios of Δx and ΔR in the paper; ``table_number`` 0 for Table I, 1 for Tables II and III."""
    own, others = (PAPER.get(name, (None, None))[table_number] for name in (first, second))
    if own is None or others is None:
        return "–"
    return ", ".join(f"{mine / other:.2f}" for mine, other in zip(own, others, strict=True))


def strata_table(results: Sequence[Result], physics: str) -> str:
    """Markdown table of Δx by stratum of at least :data:`FEWEST_WORLDS` worlds, with their number."""
    chosen = [result for result in results if result.physics == physics]
    systems = list(dict.fromkeys(result.system for result in chosen))
    lines = [f"| criterion | stratum | worlds | {' | '.join(systems)} |", "|---" * (3 + len(systems)) + "|"]
    for criterion in chosen[0].strata:
        for stratum in sorted({result.strata[criterion] for result in chosen}):
            own = [result for result in chosen if result.strata[criterion] == stratum]
            cells = [f"{interval([r for r in own if r.system == key], 'position')[0]:.3f}" for key in systems]
            count = len({result.world for result in own})
            if count >= FEWEST_WORLDS:
                lines.append(f"| {criterion} | {stratum} | {count} | {' | '.join(cells)} |")
    for ground, among in GROUNDS.items():
        own = over_windows(chosen, among)
        cells = [f"{interval([r for r in own if r.system == key], 'position')[0]:.3f}" for key in systems]
        lines.append(f"| under the path | {ground} | {len({r.world for r in own})} | {' | '.join(cells)} |")
    for distance in dict.fromkeys(name for result in chosen for name in result.by_distance):
        own = [result for result in chosen if np.isfinite(result.by_distance.get(distance, np.nan))]
        means = [np.mean([r.by_distance[distance] for r in own if r.system == key] or [np.nan]) for key in systems]
        count = len({result.world for result in own})
        lines.append(f"| distance | {distance} | {count} | {' | '.join(f'{mean:.3f}' for mean in means)} |")
    return "\n".join(lines)
