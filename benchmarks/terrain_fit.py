"""The ground that was driven over: fitted through the physics (paper III-F) against traced from the poses.

    scripts/run.sh python benchmarks/terrain_fit.py --out FOLDER [--worlds N] [--seed N] [--jobs N] [--docs FILE]

records randomised worlds with perfect odometry and with that of a localisation (:meth:`OdometrySettings.slam`: 1 cm,
0.5°, drift), makes maps of the driven ground from each, and compares them with the simulator's ground on cells that
wheels touched: heights, and slopes over 0.6 m. Each map then predicts the drive with perfect odometry in windows of
5 s. It was made from the same drive: figures of paths favour what was fitted to them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from terrain import CHOOSING, TrueSupport
from tqdm import tqdm

from monoforce_ros.bags import BagError, Recording, smooth
from monoforce_ros.core import MotionState, write_text
from monoforce_ros.evaluation import EvaluationError
from monoforce_ros.evaluation.tables import FLAT, System, evaluate_sequence, mean_over, ratio_over
from monoforce_ros.perception import FlatTerrain, Observation, TerrainSource
from monoforce_ros.reporting import write_between
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.synthetic import RecordingSettings, WorldSettings, record
from monoforce_ros.synthetic.labels import labels_file
from monoforce_ros.synthetic.odometry import OdometrySettings
from monoforce_ros.synthetic.recording import world_file
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap
from monoforce_ros.training import FitSettings, TerrainFit, fit_terrain

METHODS = {
    "traced": FitSettings(iterations=0),
    "fitted": FitSettings(),
    "fitted, with friction": FitSettings(friction=True),
    "traced, friction fitted": FitSettings(heights=False, friction=True),
    "traced, friction and stiffness fitted": FitSettings(heights=False, friction=True, stiffness=True),
}
ODOMETRY = {"perfect": OdometrySettings(), "localisation": OdometrySettings.slam()}
BOUND = "true ground"
SLIPPERY = 0.6
"""Friction relative to ordinary ground below which the driven ground is slippery on average: wet grass and worse."""
SOFT = 0.02
"""Mean depth of mud, sand or snow above which it is soft [m]."""
_MEASURES = (("height", 1e3, 1), ("slope", 1.0, 2), ("position", 1.0, 3), ("rotation", 1.0, 2))
"""Name, factor and digits of each column of the table."""
_SLOPE_BASELINE = 0.6
"""Distance over which slopes are compared [m]: about the wheelbase and track width of a robot."""


@dataclass(frozen=True)
class Row:
    """Errors of one kind of map on one world."""

    world: int
    ground: str
    odometry: str
    method: str
    height: float = float("nan")
    """Median error of touched cells, without the common offset [m]."""
    slope: float = float("nan")
    """Median error of slopes between touched cells 0.6 m apart [deg]."""
    friction: float = float("nan")
    """Mean of the map's friction on touched cells."""
    true_friction: float = float("nan")
    """Of the simulator's, as a factor on ordinary ground."""
    softness: float = float("nan")
    """Mean depth of the layer of mud, sand or snow on touched cells [m]."""
    position: float = float("nan")
    """Δx of predicted paths [m]."""
    rotation: float = float("nan")
    """ΔR [deg]."""


@dataclass(frozen=True)
class FittedGround:
    """Map of a whole drive as a terrain source."""

    fit: TerrainFit
    grid: Grid
    sensors: ClassVar[tuple[str, ...]] = ()

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """The map around the robot."""
        source = self.fit.terrain
        placed = np.linalg.inv(self.fit.odometry_from_terrain) @ motion.odometry_from_terrain
        x, y = np.meshgrid(self.grid.x, self.grid.y)
        places = np.stack([x, y, 0.0 * x], axis=-1) @ placed[:3, :3].T + placed[:3, 3]
        origin, resolution = np.array(source.grid.origin), source.grid.resolution
        column, row = np.moveaxis((places[..., :2] - origin) / resolution, -1, 0)

        def sampled(values: torch.Tensor) -> torch.Tensor:
            found = map_coordinates(values.numpy(), [row, column], order=1, mode="nearest")
            return torch.as_tensor(found, dtype=torch.float32)

        terrain = TerrainMap.from_height(sampled(source.height) - placed[2, 3], self.grid)
        return replace(terrain, friction=sampled(source.friction), stiffness=sampled(source.stiffness))


class TrueGround(TrueSupport):
    """The simulator's ground at any time."""

    sensors: ClassVar[tuple[str, ...]] = ()


def truth(name: str, bag: Path, fit: TerrainFit) -> np.ndarray:
    """A label of the world on the cells of a map in the same odometry frame."""
    grid, pose = fit.terrain.grid, fit.odometry_from_terrain
    x, y = np.meshgrid(grid.x, grid.y)
    places = np.stack([x, y, 0.0 * x], axis=-1) @ pose[:3, :3].T + pose[:3, 3]
    with np.load(labels_file(bag)) as labels:
        cells = (places[..., :2] - labels["origin"]) / float(labels["resolution"])
        return map_coordinates(labels[name], [cells[..., 1], cells[..., 0]], order=1, mode="nearest")


def map_errors(bag: Path, fit: TerrainFit) -> dict[str, float]:
    """Errors of a map on touched cells."""
    touched, grid = fit.contact_mask, fit.terrain.grid
    support, visible, plants = (
        truth(name, bag, fit) for name in ("support_height", "visible_height", "vegetation_height")
    )
    error = fit.terrain.height.numpy() + fit.odometry_from_terrain[2, 3] - support
    apart = round(_SLOPE_BASELINE / grid.resolution)
    slopes = []
    for axis in (0, 1):
        first, second = (np.take(touched, range(s, s + touched.shape[axis] - apart), axis) for s in (0, apart))
        change = np.take(error, range(apart, error.shape[axis]), axis) - np.take(
            error, range(error.shape[axis] - apart), axis
        )
        slopes.append(np.abs(change[first & second]))
    away = error[touched]
    return {
        "height": float(np.median(np.abs(away - np.median(away)))),
        "slope": float(np.degrees(np.arctan(np.median(np.concatenate(slopes)) / (apart * grid.resolution)))),
        "friction": float(fit.terrain.friction.numpy()[touched].mean()),
        "true_friction": float(truth("friction", bag, fit)[touched].mean()),
        "softness": float((visible - plants - support)[touched].clip(0.0).mean()),
    }


def driven_ground(bag: Path, robot: RobotModel, settings: FitSettings) -> TerrainFit:
    """Map of the whole drive of a bag."""
    recording = Recording.open(bag, robot=robot)
    motion = smooth(recording.motion).motion
    start = int(motion.stamps[0])
    length = (int(motion.stamps[-1]) - start) * 1e-9
    return fit_terrain(motion, recording.commands, robot, start=start, length=length, settings=settings)


def world_rows(seed: int, out: Path, duration: float) -> list[Row]:
    """Record and evaluate a world, unless its results are in the folder."""
    torch.set_num_threads(1)
    file = out / f"{seed}.json"
    if file.exists():
        return [Row(**entry) for entry in json.loads(file.read_text())]
    bags = {name: out / f"{seed}_{name}" for name in ODOMETRY}
    for name, noise in ODOMETRY.items():
        record(
            bags[name],
            RecordingSettings(
                seed=seed, duration=duration, world=WorldSettings(), camera=None, lidar=None, odometry=noise,
                labels=True, overwrite=True,
            ),
        )  # fmt: skip
    described = json.loads(world_file(bags["perfect"]).read_text())
    robot = load_robot(described["robot"])
    rows: list[Row] = []
    sources: dict[str, TerrainSource] = {}
    for odometry, bag in bags.items():
        for method, settings in METHODS.items():
            try:
                fit = driven_ground(bag, robot, settings)
            except (BagError, ValueError) as error:
                tqdm.write(f"world {seed}: {error}")
                return []
            rows.append(Row(seed, str(described["ground"]), odometry, method, **map_errors(bag, fit)))
            sources[f"{odometry}, {method}"] = FittedGround(fit, Grid.square())
    with np.load(labels_file(bags["perfect"])) as stored:
        labels = {name: stored[name] for name in ("support_height", "visible_height", "origin", "resolution")}
    grid, material = Grid.square(), TerrainDefaults()
    known: dict[str, TerrainSource] = {
        **sources,
        BOUND: TrueGround(robot, labels, grid, material),
        FLAT.title: FlatTerrain(robot, grid, material),
    }
    systems = [System(key, key, "") for key in known]
    try:
        paths = evaluate_sequence(bags["perfect"], robot, systems, known)
    except (BagError, EvaluationError) as error:
        tqdm.write(f"world {seed}: {error}")
        return []
    rows = [
        replace(r, position=paths[f"{r.odometry}, {r.method}"].position,
                rotation=paths[f"{r.odometry}, {r.method}"].rotation) for r in rows
    ]  # fmt: skip
    ground = str(described["ground"])
    rows += [
        Row(seed, ground, "–", key, position=paths[key].position, rotation=paths[key].rotation)
        for key in (BOUND, FLAT.title)
    ]
    write_text(file, json.dumps([asdict(row) for row in rows], indent=1))
    return rows


def table(rows: Sequence[Row]) -> str:
    """Markdown table of means over worlds, and of ratios to tracing."""
    by = {(row.odometry, row.method): [r for r in rows if (r.odometry, r.method) == (row.odometry, row.method)]
          for row in rows}  # fmt: skip
    lines = [
        f"{len({row.world for row in rows})} worlds; means over worlds of medians over touched cells, brackets: 95 %",
        "",
        "| odometry | map | height [mm] | slope over 0.6 m [deg] | Δx [m] | ΔR [deg] | Δx / traced |",
        "|---|---|---|---|---|---|---|",
    ]
    for (odometry, method), own in by.items():
        cells = []
        for measure, scale, digits in _MEASURES:
            mean = mean_over([scale * getattr(row, measure) for row in own])
            known = np.isfinite(mean.value)
            cells.append(f"{mean.value:.{digits}f} ({mean.low:.{digits}f} – {mean.high:.{digits}f})" if known else "–")
        traced = by.get((odometry, "traced"))
        ratio = "–"
        if traced and method != "traced":
            found = ratio_over([row.position for row in own], [row.position for row in traced])
            ratio = f"{found.value:.2f} ({found.low:.2f} – {found.high:.2f})"
        lines.append(f"| {odometry} | {method} | {' | '.join(cells)} | {ratio} |")
    for odometry in ODOMETRY:
        own = by[odometry, "traced, friction fitted"]
        pairs = np.array([[row.friction, row.true_friction] for row in own])
        correlation = np.corrcoef(np.log(pairs.T))[0, 1] if len(pairs) > 2 else np.nan
        lines += ["", f"Correlation of fitted with true friction over worlds, odometry {odometry}: {correlation:.2f}."]
    return "\n".join(lines) + "\n\n" + by_ground(rows)


def by_ground(rows: Sequence[Row]) -> str:
    """Markdown table of Δx relative to tracing by the ground driven over, with the odometry of a localisation."""
    kinds: dict[str, Callable[[Row], bool]] = {
        "all": lambda row: True,
        "slippery": lambda row: row.true_friction < SLIPPERY,
        "soft": lambda row: row.softness > SOFT,
        "neither": lambda row: row.true_friction >= SLIPPERY and row.softness <= SOFT,
    }
    chosen = [row for row in rows if row.odometry == "localisation"]
    methods = [method for method in METHODS if method != "traced"]
    lines = [f"| ground driven over | worlds | Δx traced [m] | {' | '.join(f'{m} / traced' for m in methods)} |",
             "|---" * (3 + len(methods)) + "|"]  # fmt: skip
    for name, among in kinds.items():
        own = {m: [r.position for r in chosen if r.method == m and among(r)] for m in METHODS}
        if not own["traced"]:
            continue
        found = [ratio_over(own[method], own["traced"]) for method in methods]
        cells = [f"{ratio.value:.2f} ({ratio.low:.2f} – {ratio.high:.2f})" for ratio in found]
        traced = mean_over(own["traced"]).value
        lines.append(f"| {name} | {len(own['traced'])} | {traced:.3f} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="worlds and results")
    parser.add_argument("--worlds", type=int, default=24, help="number of worlds (%(default)s)")
    parser.add_argument("--duration", type=float, default=30.0, help="of a recording [s] (%(default)s)")
    parser.add_argument("--seed", type=int, default=CHOOSING.first + 5000, help="first seed, by default of those for "
                        "choosing: the default of `train` was chosen by this (%(default)s)")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=2, help="worlds in parallel (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument("--docs", type=Path, help="write the table between the comments of this document")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = range(options.seed, options.seed + options.worlds)
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        found = pool.map(partial(world_rows, out=options.out, duration=options.duration), seeds)
        rows = [row for world in tqdm(found, total=len(seeds), desc="worlds") for row in world]
    text = table(rows)
    print(text)
    if options.json:
        write_text(options.json, json.dumps([asdict(row) for row in rows], indent=1))
    if options.docs:
        write_between(options.docs, "terrain fit", text)


if __name__ == "__main__":
    main()
