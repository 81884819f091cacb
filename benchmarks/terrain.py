"""The protocol of docs/protocol.md: errors of terrain sources in worlds that neither training nor choices have seen.

    scripts/run.sh python benchmarks/terrain.py --out FOLDER [--quick] [--checkpoint SYSTEM=FILE ...] [--seed N]
        [--docs FILE]

records randomised worlds of the reporting seeds, evaluates every system on them with the paper's physics alone and with
vegetation drag, and writes the tables, their strata, a page with the worst predictions of each system, and a log: date,
commit, digests of the checkpoints, and how often the reporting seeds were used. Recorded worlds and their results are
kept in the folder: an interrupted run continues where it stopped. Give a system one checkpoint per training seed;
without --checkpoint the shipped encoder is tested with images, with a sweep, and with both.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from terrain_tables import BOUND, DEEP, LEARNED, SHIPPED, Result, diverged, in_common, ratio_table, strata_table, table
from tqdm import tqdm

from monoforce_ros.bags import BagError, Recording
from monoforce_ros.core import MotionState, atomic_path, write_text
from monoforce_ros.evaluation import EvaluationError
from monoforce_ros.evaluation.figures import CameraPicture, prediction_figure
from monoforce_ros.evaluation.recording_evaluation import predict_at
from monoforce_ros.evaluation.tables import (
    CONSTANT,
    FLAT,
    HORIZON,
    LIDAR,
    SequenceErrors,
    System,
    evaluate_sequence,
    terrain_source,
)
from monoforce_ros.evaluation.view import PredictionView
from monoforce_ros.perception import FlatTerrain, Observation, TerrainSource, support_points
from monoforce_ros.perception.ground_alignment import align_to_ground
from monoforce_ros.prediction import Predictor
from monoforce_ros.reporting import figure_png, page, picture_card, write_between
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.synthetic import CameraSettings, LidarSettings, RecordingSettings, WorldSettings, record
from monoforce_ros.synthetic.labels import labels_file
from monoforce_ros.synthetic.recording import world_file
from monoforce_ros.terrain import Grid, TerrainDefaults, TerrainMap

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class SeedRange:
    """Generator seeds for one purpose."""

    purpose: str
    first: int
    count: int

    def __contains__(self, seed: int) -> bool:
        """Whether a seed belongs to the purpose."""
        return self.first <= seed < self.first + self.count


TRAINING = SeedRange("training", 420_000, 10_000)
CHOOSING = SeedRange("choosing", 430_000, 10_000)
REPORTING = SeedRange("reporting", 440_000, 10_000)

STRIDE = 2.0
"""Time between the starts of windows [s]: of 5 s each, they overlap by 60 %."""
WORST = 3
"""Number of worst predictions that are shown of each system."""
_LIDAR = LidarSettings(rings=32, columns=360, rate=5.0)
PUBLISHED_LOG = ROOT / "docs" / "terrain_tables.log.jsonl"
"""Uses of reporting seeds whose tables were published."""
# The robots' own physics differ: drag was fitted for the Husky only.
DRAG_ROBOT = ROOT / "models" / "husky_in_grass.yaml"


@dataclass(frozen=True)
class TrueSupport:
    """The ground that carries the robot, from a world's labels: what heights alone can achieve with this physics.

    Attributes:
        robot: the robot on it.
        labels: of :func:`monoforce_ros.synthetic.labels.world_labels`.
        grid: of the maps.
        material: of the ground, as other sources without material use it.
    """

    robot: RobotModel
    labels: Mapping[str, np.ndarray]
    grid: Grid
    material: TerrainDefaults
    sensors: ClassVar[tuple[str, ...]] = ("lidar",)

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """True heights around the robot in the terrain frame."""
        x, y = np.meshgrid(self.grid.x, self.grid.y)
        transform = motion.odometry_from_terrain
        places = np.stack([x, y], axis=-1) @ transform[:2, :2].T + transform[:2, 3]
        cells = (places - self.labels["origin"]) / float(self.labels["resolution"])

        def sampled(name: str) -> torch.Tensor:
            values = map_coordinates(self.labels[name], [cells[..., 1], cells[..., 0]], order=1, mode="nearest")
            return torch.as_tensor(values - transform[2, 3], dtype=torch.float32)

        terrain = TerrainMap.from_height(sampled("support_height"), self.grid, material=self.material)
        terrain = replace(terrain, geometric_height=sampled("visible_height"))
        # Like every other source: the robot rests as deep in the ground as its weight presses it.
        return align_to_ground(terrain, support_points(self.robot, motion, self.material.stiffness))


def strata(described: Mapping[str, object]) -> dict[str, str]:
    """Stratum of a world by each criterion, from the description beside its bag."""

    def bands(name: str, limits: Sequence[float], unit: str) -> str:
        value = described[name]
        assert isinstance(value, int | float)
        return _band(value, limits, unit)

    def of_cameras(name: str) -> list:
        values = described[name]
        assert isinstance(values, list)
        return values

    views, heights, lenses = map(of_cameras, ("field_of_view_deg", "camera_height", "distortion_model"))
    return {
        "vegetation height": bands("vegetation_height", (0.05, 0.4, 0.8), "m"),
        "slope": bands("slope_deg", (4.0, 8.0), "°"),
        "light": str(described["sky"]),
        "ground misleads": "yes" if described["misleading_ground"] else "no",
        "cameras": str(described["cameras"]),
        "camera height": "none" if not heights else _band(float(np.mean(heights)), (0.5, 1.0), "m"),
        "lens": "none" if not lenses else "fisheye" if "equidistant" in lenses else "pinhole",
        "field of view": "none" if not views else ("below 75°" if max(views) < 75.0 else "75° or more"),
        "robot": str(described["robot"]),
    }


def _band(value: float, limits: Sequence[float], unit: str) -> str:
    """Name of the band between ascending limits that a value lies in."""
    edges = [f"{limit:g}" for limit in limits]
    for index, limit in enumerate(limits):
        if value < limit:
            return f"below {edges[0]} {unit}" if index == 0 else f"{edges[index - 1]} to {edges[index]} {unit}"
    return f"{edges[-1]} {unit} or more"


def record_world(folder: Path, seed: int, settings: WorldSettings, duration: float) -> Path:
    """Record a world of the reporting set, unless it is there."""
    out = folder / f"{seed}"
    if not (labels_file(out).exists() and world_file(out).exists()):
        record(
            out,
            RecordingSettings(
                seed=seed, duration=duration, world=settings, camera=CameraSettings(), lidar=_LIDAR, labels=True,
                overwrite=True,
            ),
        )  # fmt: skip
    return out


@dataclass(frozen=True)
class _Wrapped:
    """A terrain source around another one."""

    source: TerrainSource

    @property
    def sensors(self) -> tuple[str, ...]:
        """Of the source."""
        return self.source.sensors

    @property
    def grid(self) -> Grid:
        """Of the source."""
        return self.source.grid


@dataclass(frozen=True)
class Remembered(_Wrapped):
    """A terrain source whose maps are computed once: they are the same for every kind of physics."""

    maps: dict[int, TerrainMap] = field(default_factory=dict)
    """By the stamp of the observation [ns]."""

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """The source's map at the time of an observation."""
        if observation.stamp not in self.maps:
            self.maps[observation.stamp] = self.source.terrain(observation, motion)
        return self.maps[observation.stamp]


@dataclass(frozen=True)
class DefaultMaterial(_Wrapped):
    """A terrain source of whose maps the heights alone are used: systems that are compared differ in nothing else."""

    material: TerrainDefaults = field(default_factory=TerrainDefaults)

    def terrain(self, observation: Observation, motion: MotionState) -> TerrainMap:
        """The source's map with the default material."""
        return self.source.terrain(observation, motion).with_material(self.material)


def judged_source(system: System, robot: RobotModel) -> TerrainSource:
    """The terrain source of a system as it is judged: the shipped encoder as in the node, the others' heights alone."""
    source = terrain_source(system, robot)
    return source if system.key.partition("@")[0] in SHIPPED else DefaultMaterial(source)


def evaluate_world(bag: Path, checkpoints: Mapping[str, Sequence[Path]], physics: Sequence[str]) -> list[Result]:
    """Errors of every system and checkpoint on one world, with each kind of physics."""
    described = json.loads(world_file(bag).read_text())
    robot = load_robot(described["robot"])
    systems = [LIDAR, BOUND, *learned_systems(checkpoints), FLAT, CONSTANT]
    sources: dict[str, TerrainSource] = {BOUND.key: Remembered(true_support(bag, robot))}
    for system in (LIDAR, *learned_systems(checkpoints)):
        sources[system.key] = Remembered(judged_source(system, robot))
    found_by: dict[str, dict[str, SequenceErrors]] = {
        name: evaluate_sequence(bag, with_physics(robot, name), systems, sources, stride=STRIDE) for name in physics
    }
    # Windows follow from the measurement alone, so that every kind of physics has the same.
    vegetation, overgrown = driven_vegetation(bag, robot, next(iter(found_by.values()))[LIDAR.key].stamps)
    results = []
    for name, errors in found_by.items():
        for system in systems:
            key, _, checkpoint = system.key.partition("@")
            found = errors[system.key]
            results.append(
                Result(
                    key, checkpoint, int(described["seed"]), name, found.position, found.rotation, found.windows,
                    strata(described), found.worst, found.worst_position, found.by_distance, list(found.positions),
                    list(found.rotations), vegetation, overgrown,
                )
            )  # fmt: skip
    return results


def driven_vegetation(bag: Path, robot: RobotModel, stamps: Sequence[int]) -> tuple[list[float], list[float]]:
    """Greatest depth of soft vegetation under the robot during each window, and the share of its path in deep one.

    Windows start at ``stamps`` [ns]. The greatest depth is that anywhere under the robot; in deep vegetation is a pose
    of which half the ground under the robot has it.
    """
    motion = Recording.open(bag, robot=robot).in_base_frame(robot.base_frame).motion
    with np.load(labels_file(bag)) as stored:
        # Snow and mud are deep, too, but no vegetation.
        depth = np.minimum(stored["visible_height"] - stored["support_height"], stored["vegetation_height"])
        origin, resolution = stored["origin"], float(stored["resolution"])
    corners = robot.points[:, :2].double().numpy()
    count = np.ceil(np.ptp(corners, axis=0) / resolution).astype(int) + 1
    low, high = corners.min(axis=0), corners.max(axis=0)
    sides = (np.linspace(low[axis], high[axis], count[axis]) for axis in (0, 1))
    under_robot = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    headings = Rotation.from_quat(motion.quaternions).as_euler("zyx")[:, 0]
    greatest, share = [], []
    for stamp in stamps:
        later = (motion.stamps >= stamp) & (motion.stamps <= stamp + HORIZON * 1e9)
        along = np.stack([np.cos(headings[later]), np.sin(headings[later])], axis=-1)[:, None]
        across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        places = motion.positions[later, None, :2] + under_robot[:, :1] * along + under_robot[:, 1:] * across
        cells = (places - origin) / resolution
        under = map_coordinates(depth, [cells[..., 1], cells[..., 0]], order=1, mode="nearest")
        greatest.append(float(under.max()))
        share.append(float((np.median(under, axis=1) >= DEEP).mean()))
    return greatest, share


@dataclass(frozen=True)
class WorldResults:
    """What was found on one world."""

    seed: int
    checkpoints: dict[str, list[str]]
    """Digests of the checkpoints of each system."""
    duration: float
    """Of the recording [s]."""
    commit: str
    """Of the source that computed them."""
    results: tuple[Result, ...] = ()
    skipped: str = ""
    """Why the world could not be evaluated."""

    @classmethod
    def load(cls, file: Path) -> WorldResults:
        """Read results that were saved."""
        stored = json.loads(file.read_text())
        return cls(**stored | {"results": tuple(Result(**entry) for entry in stored["results"])})


def world_results(seed: int, out: Path, checkpoints: Mapping[str, Sequence[Path]], duration: float) -> WorldResults:
    """Record and evaluate a world, unless its results with the same checkpoints are in the folder."""
    torch.set_num_threads(1)
    file = out / "results" / f"{seed}.json"
    digests = {name: [digest(path) for path in files] for name, files in checkpoints.items()}
    if file.exists():
        stored = WorldResults.load(file)
        if (stored.checkpoints, stored.duration) == (digests, duration):
            return stored
    bag = record_world(out / "worlds", seed, WorldSettings(), duration)
    found: list[Result] = []
    skipped = ""
    try:
        found = evaluate_world(bag, checkpoints, tuple(PHYSICS))
    except (BagError, EvaluationError) as error:
        skipped = str(error)
    done = WorldResults(seed, digests, duration, commit(), tuple(found), skipped)
    write_text(file, json.dumps(asdict(done), indent=1))
    return done


def learned_systems(checkpoints: Mapping[str, Sequence[Path]]) -> list[System]:
    """A system for each checkpoint."""
    return [
        System(f"{name}@{index}", *LEARNED[name], file)
        for name, files in checkpoints.items()
        for index, file in enumerate(files)
    ]


def true_support(bag: Path, robot: RobotModel) -> TrueSupport:
    """The ground of a recorded world."""
    with np.load(labels_file(bag)) as stored:
        labels = {name: stored[name] for name in ("support_height", "visible_height", "origin", "resolution")}
    return TrueSupport(robot, labels, Grid.square(), TerrainDefaults())


def worst_cases(results: Sequence[Result], physics: str, count: int = WORST) -> dict[str, list[Result]]:
    """The worst windows of each system that has a terrain, of different worlds, the worst one first."""
    found: dict[str, list[Result]] = {}
    ranked = sorted((r for r in results if r.physics == physics and r.worst), key=lambda r: -r.worst_position)
    for result in ranked:
        own = found.setdefault(result.system, [])
        if result.system != CONSTANT.key and len(own) < count and result.world not in {r.world for r in own}:
            own.append(result)
    return {system: own for system, own in found.items() if own}


def own_failures(results: Sequence[Result], physics: str) -> dict[str, list[Result]]:
    """The worst window of each system in the world where it exceeds that of the true heights by the most.

    Where all are far off by the same, friction is to blame or the physics, and no terrain.
    """
    usable = [r for r in results if r.physics == physics and r.worst]
    bound = {r.world: r.worst_position for r in usable if r.system == BOUND.key}
    found: dict[str, list[Result]] = {}
    for result in sorted((r for r in usable if r.world in bound), key=lambda r: bound[r.world] - r.worst_position):
        if result.system not in (BOUND.key, CONSTANT.key):
            found.setdefault(result.system, [result])
    return found


@dataclass(frozen=True)
class WorstCase:
    """One of a system's worst predictions as a picture: the camera's view, and the map with both paths."""

    png: bytes
    heading: str
    caption: str


def draw_cases(
    worlds: Path, cases: Mapping[str, Sequence[Result]], checkpoints: Mapping[str, Sequence[Path]], physics: str
) -> list[WorstCase]:
    """Pictures of the worst windows of results of each system."""
    drawn = []
    learned = {system.key: system for system in learned_systems(checkpoints)}
    for key, own in tqdm(cases.items(), desc="worst cases"):
        for rank, result in enumerate(own, start=1):
            bag = worlds / f"{result.world}"
            robot = with_physics(load_robot(json.loads(world_file(bag).read_text())["robot"]), physics)
            recording = Recording.open(bag, robot=robot).in_base_frame(robot.base_frame)
            system = learned.get(f"{key}@{result.checkpoint}", {LIDAR.key: LIDAR, FLAT.key: FLAT}.get(key, BOUND))
            if system is BOUND:
                source: TerrainSource = true_support(bag, robot)
            elif system is FLAT:
                source = FlatTerrain(robot, Grid.square(), TerrainDefaults())
            else:
                source = judged_source(system, robot)
            topics = tuple(recording.images) if "camera" in source.sensors else ()
            prediction = predict_at(recording, Predictor(robot, source, horizon=HORIZON), result.worst, topics)
            later = recording.motion.stamps - result.worst
            figure = prediction_figure(
                PredictionView.of_prediction(prediction, robot),
                robot,
                picture=CameraPicture.nearest(recording, robot, result.worst),
                measured=recording.motion.positions[(later >= 0) & (later <= HORIZON * 1e9)],
            )
            seconds = (result.worst - recording.motion.stamps[0]) * 1e-9
            about = ", ".join(f"{name}: {value}" for name, value in result.strata.items())
            heading = f"{system.title}: number {rank}, mean error {result.worst_position:.2f} m"
            caption = f"World {result.world}, {seconds:.0f} s into the recording. {about}."
            drawn.append(WorstCase(figure_png(figure), heading, caption))
    return drawn


def gallery(cases: Sequence[WorstCase], physics: str) -> str:
    """A page with the worst predictions of each system."""
    cards = [picture_card(case.png, alt=case.heading, heading=case.heading, caption=case.caption) for case in cases]
    lead = (
        f"The {WORST} worlds in which each system's worst prediction is farthest off, physics: {physics}. Orange: "
        "predicted path. Dashed: measured path."
    )
    return page("Worst predictions of each terrain source", "".join(cards), lead=lead)


def contact_sheet(cases: Sequence[WorstCase], columns: int = 2, width: int = 640) -> np.ndarray:
    """Pictures under the names of their systems, side by side ``[h, w, 3]`` uint8 BGR."""
    tiles = []
    for case in cases:
        image = cv2.imdecode(np.frombuffer(case.png, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        height = round(width * image.shape[0] / image.shape[1])
        tile = np.full((height + 24, width, 3), 255, np.uint8)
        tile[24:] = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        # OpenCV's fonts have no arrows and no subscripts.
        title = case.heading.replace("→", "to").replace(": number 1, mean error", ":")
        cv2.putText(tile, title, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        tiles.append(tile)
    highest = max(len(tile) for tile in tiles)
    tiles += [np.full((1, width, 3), 255, np.uint8)] * (-len(tiles) % columns)
    padded = [
        cv2.copyMakeBorder(t, 0, highest - len(t), 0, 0, cv2.BORDER_CONSTANT, value=(255, 255, 255)) for t in tiles
    ]
    return np.vstack([np.hstack(padded[i : i + columns]) for i in range(0, len(padded), columns)])


PHYSICS: dict[str, Callable[[RobotModel], RobotModel]] = {
    "paper": lambda robot: replace(robot, effects=()),
    "vegetation drag": lambda robot: replace(robot, effects=load_robot(str(DRAG_ROBOT)).effects),
}
"""Robots with the paper's physics alone, and with the drag of vegetation fitted in other worlds."""


def with_physics(robot: RobotModel, name: str) -> RobotModel:
    """The robot with one of :data:`PHYSICS`."""
    return PHYSICS[name](robot)


def digest(path: Path) -> str:
    """SHA-256 of a file, its first 16 digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def log_use(logs: Sequence[Path], entry: dict[str, object]) -> int:
    """Append an entry to the first of several logs; returns how often its seeds were used in all of them."""

    def entries(log: Path) -> list[dict]:
        return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []

    seeds = set(entry["seeds"])  # type: ignore[call-overload]
    # A use may be in several logs.
    dates = {other["date"] for log in logs for other in entries(log) if seeds & set(other["seeds"])}
    used = len(dates | {entry["date"]})
    listed = [*entries(logs[0]), entry | {"times_used": used}]
    write_text(logs[0], "".join(json.dumps(line) + "\n" for line in listed))
    return used


def described_use(seeds: Sequence[int], checkpoints: Mapping[str, Sequence[Path]]) -> dict[str, object]:
    """What a log says of every use of seeds."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "seeds": list(seeds),
        "checkpoints": {name: [digest(file) for file in files] for name, files in checkpoints.items()},
    }


def commit() -> str:
    """Commit of the source, with a mark if it was changed since."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=12"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or "unknown"


def reporting_seeds(first: int, count: int) -> list[int]:
    """Seeds of the reporting set.

    Raises:
        ValueError: a seed belongs to training or choosing.
    """
    seeds = list(range(first, first + count))
    for other in (TRAINING, CHOOSING):
        taken = [seed for seed in seeds if seed in other]
        if taken:
            raise ValueError(
                f"--seed: got {first}, whose seeds {taken[0]} to {taken[-1]} are for {other.purpose}; expected "
                f"{REPORTING.first} or any seed outside {TRAINING.first} to {CHOOSING.first + CHOOSING.count - 1}"
            )
    return seeds


def parse_checkpoints(listed: Sequence[str]) -> dict[str, list[Path]]:
    """Checkpoints by system; without any, the shipped encoder with images, a sweep, and both.

    Raises:
        ValueError: an entry is no ``SYSTEM=FILE`` of a known system and an existing file.
    """
    found: dict[str, list[Path]] = {}
    shipped = ROOT / "models" / "terrain_encoder.safetensors"
    for text in listed or [f"{name}={shipped}" for name in SHIPPED]:
        name, _, file = text.partition("=")
        if name not in LEARNED or not Path(file).is_file():
            raise ValueError(f"--checkpoint: got {text!r}, expected SYSTEM=FILE with one of {', '.join(LEARNED)}")
        found.setdefault(name, []).append(Path(file))
    return found


def main() -> int:
    """Run the benchmark; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="worlds, tables and log")
    parser.add_argument("--quick", action="store_true", help="few short worlds, for a regular check")
    parser.add_argument("--worlds", type=int, help="number of worlds (40; with --quick 6)")
    parser.add_argument("--duration", type=float, help="of a recording [s] (40; with --quick 12)")
    parser.add_argument("--seed", type=int, help=f"first seed ({REPORTING.first}; with --quick {CHOOSING.first}, of "
                        "those for choosing)")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=2, help="worlds evaluated in parallel (%(default)s)")
    parser.add_argument("--checkpoint", action="append", default=[], metavar="SYSTEM=FILE",
                        help=f"repeat for other systems and training seeds; systems: {', '.join(LEARNED)}")  # fmt: skip
    parser.add_argument("--docs", type=Path, help="write the tables between the comments of this document")
    parser.add_argument("--sheet", type=Path, metavar="FILE.jpg", help="also draw each system's failures here")
    options = parser.parse_args()
    try:
        count = options.worlds or (6 if options.quick else 40)
        if options.quick and options.seed is None:
            seeds = list(range(CHOOSING.first, CHOOSING.first + count))
        else:
            seeds = reporting_seeds(REPORTING.first if options.seed is None else options.seed, count)
        checkpoints = parse_checkpoints(options.checkpoint)
    except ValueError as error:
        print(f"terrain: {error}", file=sys.stderr)
        return 1
    duration = options.duration or (12.0 if options.quick else 40.0)
    one_world = partial(world_results, out=options.out, checkpoints=checkpoints, duration=duration)
    # Spawned, because renderers and threads do not survive a fork.
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        worlds = list(tqdm(pool.map(one_world, seeds), total=len(seeds), desc="worlds"))
    results = [result for world in worlds for result in world.results]
    skipped = {world.seed: world.skipped for world in worlds if world.skipped}
    if not results:
        print(f"terrain: no world could be evaluated: {next(iter(skipped.values()))}", file=sys.stderr)
        return 1
    failures = diverged(results)
    results = in_common(results)
    text = table(results) + (
        "\nPredictions that diverged, whose windows are left out for all: "
        + (", ".join(f"{name} {count}" for name, count in failures.items()) or "none")
        + ".\n"
    )
    by_strata = "\n\n".join(
        f"Ratios, physics: {name}\n\n{ratio_table(results, name)}\n\n"
        f"Δx [m], physics: {name}\n\n{strata_table(results, name)}"
        for name in PHYSICS
    )
    entry = described_use(seeds, checkpoints) | {
        "evaluated_by": sorted({world.commit for world in worlds}),
        "skipped": skipped,
        "duration_s": duration,
    }
    log = options.out / "terrain.log.jsonl"
    used = log_use([log, PUBLISHED_LOG], entry)
    write_text(options.out / "terrain.md", f"{text}\n{by_strata}\n")
    write_text(options.out / "terrain.json", json.dumps([asdict(result) for result in results], indent=1))
    physics = next(iter(PHYSICS))
    worlds_folder = options.out / "worlds"
    cases = draw_cases(worlds_folder, worst_cases(results, physics), checkpoints, physics)
    write_text(options.out / "worst_cases.html", gallery(cases, physics))
    failures_drawn = draw_cases(worlds_folder, own_failures(results, physics), checkpoints, physics)
    sheet = cv2.imencode(".jpg", contact_sheet(failures_drawn), [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
    for file in filter(None, [options.out / "worst_cases.jpg", options.sheet]):
        with atomic_path(file) as unfinished:
            unfinished.write_bytes(sheet)
    if options.docs is not None:
        write_between(options.docs, "terrain", f"{text}\n{by_strata}")
        log_use([PUBLISHED_LOG, log], entry | {"docs": options.docs.name})
    print(text)
    print(f"{options.out / 'terrain.md'}, {options.out / 'worst_cases.html'}; seeds used {used} time(s), see {log}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
