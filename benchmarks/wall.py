"""Walls and posts ahead (the paper's Figure 9): which terrain sources predict the stop that occurs in the simulator.

    scripts/run.sh python benchmarks/wall.py [--quick] [--driving] [--checkpoint SYSTEM=FILE ...] [--seed N]
        [--json FILE] [--png FILE] [--docs FILE]

draws walls and posts of any texture and colour, 0.15 to 1.2 m high and 0.6 to 6 m away, and soft vegetation that looks
like a wall. The robot is commanded to drive straight ahead for eight seconds. In simulation it drives until something
stops it; each source predicts the same motion from one image or sweep. A stop is found if it is predicted within half a
metre of where it happens. The command reports precision and recall of that, and writes a log of the seeds it used.
Systems are those of benchmarks/terrain.py, each with one checkpoint per training seed, whose scenes are counted
together; without any, the shipped encoder is tested with images, with a lidar sweep and with both.

With --driving the robot has driven 1.6 m towards the obstacle when the prediction is made, with five images a second
and odometry that drifts: the shipped encoder on images is compared with and without motion stereo.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from approach import RUN_UP, Seen, driven_up
from matplotlib.figure import Figure
from terrain import CHOOSING, ROOT, described_use, judged_source, log_use, parse_checkpoints, reporting_seeds
from terrain_tables import LEARNED
from tqdm import tqdm

from monoforce_ros.core import MotionState, write_text
from monoforce_ros.evaluation.tables import LIDAR, System
from monoforce_ros.messages import decoding
from monoforce_ros.perception import Observation, TerrainSource, choose_terrain_source
from monoforce_ros.prediction import Prediction, Predictor
from monoforce_ros.reporting import write_between
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.synthetic import (
    AHEAD_KINDS,
    CameraSettings,
    LiveSettings,
    LiveWorld,
    WallAhead,
    draw_wall_ahead,
)

SPEED, HORIZON = 0.8, 8.0
STOPPED = 0.94
"""Share of the commanded distance below which a robot counts as stopped: an obstacle 6 m away stops it at 0.93."""
FOUND_WITHIN = 0.5
"""Largest distance between the predicted and the simulated stop that was found [m]: half a Husky's length."""
FIRST_SEED = 446_000
"""First reporting seed; with --quick that of those for choosing."""
FIRST_DRIVING_SEED = 452_000
"""The same with --driving."""
PUBLISHED_LOG = ROOT / "docs" / "wall_tables.log.jsonl"
BOOTSTRAPS = 2000
SCENES = {"wall": 40, "post": 20, "vegetation": 20}
DRIVING_SCENES = {"wall": 12, "post": 6, "vegetation": 6}
QUICK_SCENES = {"wall": 8, "post": 4, "vegetation": 4}


@dataclass(frozen=True)
class Scene:
    """What is ahead, the sensors' data and how far the simulated robot drove [m]."""

    ahead: WallAhead
    observation: Observation
    start: MotionState
    driven: float
    approach: tuple[Seen, ...] = ()
    """What was seen before on the way there."""

    @property
    def stops(self) -> bool:
        """Whether the obstacle stopped the simulated robot."""
        return self.driven < STOPPED * SPEED * HORIZON


@dataclass(frozen=True)
class Judged:
    """A source whose predictions are counted."""

    title: str
    source: Callable[[], TerrainSource]
    """Makes it anew."""
    approaches: bool = False
    """Whether it sees what the robot saw on its way."""


def observed(world: LiveWorld, robot: RobotModel, stamp: int = 10**9) -> tuple[Observation, MotionState]:
    """What the robot's sensors measure at the moment, and its state."""
    state, _, _ = decoding.decode_odometry(world.odometry(stamp))
    cloud = decoding.decode_cloud(world.cloud(stamp))
    frame, message, info = next(iter(world.images(stamp)))
    image, camera = decoding.decode_image(message), decoding.decode_camera_info(info)
    lidar = robot.sensors["lidar"].double().numpy()
    observation = Observation(
        stamp, cloud=(cloud @ lidar[:3, :3].T + lidar[:3, 3]).astype(np.float32), images={frame: image},
        cameras={frame: camera}, base_from_cameras={frame: robot.sensors[frame].double().numpy()},
    )  # fmt: skip
    return observation, state


def predicted(predictor: Predictor, observation: Observation, start: MotionState) -> Prediction:
    """The prediction of driving straight ahead from what was observed."""
    twists = np.zeros((predictor.history + predictor.steps, 2))
    twists[predictor.history :, 0] = SPEED
    return predictor.predict(observation, start, twists)


def distance(prediction: Prediction) -> float:
    """Distance between a prediction's first and last position [m]."""
    positions = prediction.positions()
    return float(np.linalg.norm(positions[-1, :2] - positions[0, :2]))


def draw(found: Scene, predictions: dict[str, Prediction]) -> Figure:
    """A scene's image, and heights and final position along the path for each terrain source."""
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.7])
    left.imshow(next(iter(found.observation.images.values())))
    left.set_axis_off()
    left.set_title(f"{found.ahead.kind}, {found.ahead.height:.2f} m high, {found.ahead.distance:.1f} m ahead")
    for index, (title, prediction) in enumerate(predictions.items()):
        grid, height = prediction.terrain.grid, prediction.terrain.height.numpy()
        row = int(np.argmin(np.abs(np.asarray(grid.y))))
        ahead = np.asarray(grid.x) > -0.5
        # There are ten colours.
        style, marker = (("-", "o"), ("--", "s"))[index // 10 % 2]
        right.plot(np.asarray(grid.x)[ahead], height[row, ahead], style, color=f"C{index % 10}", label=title)
        right.plot(*prediction.rollout.position[0].numpy()[-1, [0, 2]], marker, color=f"C{index % 10}", markersize=9)
    right.plot(found.driven, 0.0, "kx", markersize=10, label=f"simulated robot after {HORIZON:.0f} s")
    right.set(xlabel="ahead [m]", ylabel="supporting height H_t [m]", xlim=(-0.5, 6.4))
    right.set_title(f"predicted terrain; markers: predicted robot after {HORIZON:.0f} s")
    right.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def simulated(settings: LiveSettings, duration: float) -> tuple[Observation, MotionState, float]:
    """What is seen of a world, the robot's state, and how far it drives [m] when told to drive straight ahead."""
    world = LiveWorld(settings)
    try:
        observation, state = observed(world, load_robot("husky"))
        world.simulation.drive(SPEED, 0.0)
        world.advance(world.time + duration)
        end, _, _ = decoding.decode_odometry(world.odometry(10**9))
    finally:
        world.close()
    return observation, state, float(np.linalg.norm(end.position[:2] - state.position[:2]))


def scene(kind: str, seed: int) -> Scene:
    """Simulate one scene of a kind of :data:`monoforce_ros.synthetic.AHEAD_KINDS`."""
    robot = load_robot("husky")
    ahead = draw_wall_ahead(kind, seed, float(robot.points[:, 0].max()))
    settings = LiveSettings(seed=seed, scenery=ahead.scenery, camera=CameraSettings())
    return Scene(ahead, *simulated(settings, HORIZON))


def driving_scene(kind: str, seed: int) -> Scene:
    """As :func:`scene`, when the robot has driven :data:`approach.RUN_UP` towards it."""
    robot = load_robot("husky")
    ahead = draw_wall_ahead(kind, seed, float(robot.points[:, 0].max()) + RUN_UP)
    world = LiveWorld(LiveSettings(seed=seed, scenery=ahead.scenery, camera=CameraSettings()))
    try:
        seen, state = driven_up(world, lambda live, stamp: observed(live, robot, stamp), SPEED, seed)
        world.advance(world.time + HORIZON)
        end, _, _ = decoding.decode_odometry(world.odometry(10**9))
    finally:
        world.close()
    driven = float(np.linalg.norm(end.position[:2] - state.position[:2]))
    return Scene(ahead, seen[-1].observation, seen[-1].motion, driven, tuple(seen[:-1]))


def driving_systems(robot: RobotModel) -> list[Judged]:
    """The shipped encoder on images with and without motion stereo, as it is and as the node uses it, and lidars."""

    def images(*, fallback: bool = False, stereo: bool = False) -> Callable[[], TerrainSource]:
        return lambda: choose_terrain_source("camera", robot, fallback=fallback, motion_stereo=stereo)

    def lidar(kind: str) -> Callable[[], TerrainSource]:
        return lambda: choose_terrain_source(kind, robot)

    return [
        Judged("images, standing", images()),
        Judged("images, driving", images(), approaches=True),
        Judged("images, driving, motion stereo", images(stereo=True), approaches=True),
        Judged("images, driving, as the node uses them without motion stereo", images(fallback=True), approaches=True),
        Judged("images, driving, as the node uses them", images(fallback=True, stereo=True), approaches=True),
        Judged("lidar → H_t", lidar("lidar")),
        Judged("lidar interpolation [19]", lidar("lidar_interpolation")),
    ]


def compared_systems(checkpoints: Mapping[str, Sequence[Path]], robot: RobotModel) -> list[list[Judged]]:
    """Systems of benchmarks/terrain.py, each with its training seeds, and lidar interpolation."""

    def judged(system: System) -> Judged:
        made = judged_source(system, robot)
        return Judged(system.title, lambda: made)

    systems = [[System(name, *LEARNED[name], file) for file in files] for name, files in checkpoints.items()]
    return [[judged(system) for system in own] for own in (*systems, [LIDAR])]


def predicted_after(judged: Judged, robot: RobotModel, found: Scene) -> Prediction:
    """A scene's prediction by a source that has seen, if it does, what the robot saw on its way."""
    predictor = Predictor(robot, judged.source(), horizon=HORIZON)
    images = "lidar" not in predictor.source.sensors
    for seen in found.approach if judged.approaches else ():
        predictor.source.terrain(seen.observation, seen.motion)
    observation = replace(found.observation, cloud=None) if images else found.observation
    return predicted(predictor, observation, found.start)


def counted(title: str, scenes: Sequence[Scene], driven: np.ndarray) -> dict:
    """Precision, recall and stopping position of predicted distances ``driven`` ``[training seeds, scenes]`` [m].

    Intervals (95 %) resample scenes, which are what differs.
    """
    truth, actual = np.array([s.stops for s in scenes]), np.array([s.driven for s in scenes])
    stopping = driven < STOPPED * SPEED * HORIZON
    errors = driven - actual
    found = stopping & truth & (np.abs(errors) <= FOUND_WITHIN)
    resampled = np.random.default_rng(0).integers(0, len(scenes), (BOOTSTRAPS, len(scenes)))

    def share(part: np.ndarray, whole: np.ndarray) -> list[float] | None:
        """Ratio of the sums of counts by scene, with its interval; None where nothing is counted."""
        if not whole.any():
            return None
        counts, totals = part[resampled].sum(axis=1), whole[resampled].sum(axis=1)
        low, high = np.quantile(counts[totals > 0] / totals[totals > 0], [0.025, 0.975])
        return [float(part.sum() / whole.sum()), float(low), float(high)]

    seeds = len(driven)
    placed = errors[found]
    row: dict = {
        "system": title, "training_seeds": seeds, "stops": int(truth.sum()), "scenes": len(scenes),
        "precision": share(found.sum(axis=0), stopping.sum(axis=0)), "recall": share(found.sum(axis=0), seeds * truth),
        "recall_anywhere": share((stopping & truth).sum(axis=0), seeds * truth),
        "stop_error_m": float(np.median(placed)) if len(placed) else None,
        "stop_spread_m": float(np.median(np.abs(placed))) if len(placed) else None,
    }  # fmt: skip
    for kind in AHEAD_KINDS:
        chosen = np.array([s.ahead.kind == kind for s in scenes])
        # Means over training seeds: a scene counts once.
        row[kind] = [float(found[:, chosen].sum() / seeds), float(stopping[:, chosen].sum() / seeds),
                     int((truth & chosen).sum()), int(chosen.sum())]  # fmt: skip
    return row


def table(rows: Sequence[dict]) -> str:
    """The rows of :func:`counted` as a Markdown table."""
    lines = [
        "| terrain | precision | recall | stop anywhere | walls | posts | soft vegetation | stop error (median) |",
        "|---" * 8 + "|",
    ]

    def shown(value: list[float] | None) -> str:
        return "–" if value is None else f"{value[0]:.2f} ({value[1]:.2f} – {value[2]:.2f})"

    for row in rows:
        kinds = " | ".join(
            f"{row[kind][1]:.3g} stops" if kind == "vegetation" else f"{row[kind][0]:.3g} of {row[kind][2]} found"
            for kind in AHEAD_KINDS
        )
        error = "–" if row["stop_error_m"] is None else f"{row['stop_error_m']:.2f} m"
        anywhere = "–" if row["recall_anywhere"] is None else f"{row['recall_anywhere'][0]:.2f}"
        lines.append(
            f"| {row['system']} | {shown(row['precision'])} | {shown(row['recall'])} | {anywhere} | {kinds} | {error} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", action="append", default=[], metavar="SYSTEM=FILE", help="repeat for other "
                        f"systems and training seeds; systems: {', '.join(LEARNED)}")  # fmt: skip
    parser.add_argument("--robot", default="husky", help="name or file (default: %(default)s)")
    parser.add_argument(
        "--quick", action="store_true", help="16 scenes, of seeds for choosing, instead of 80 (24 with --driving)"
    )
    parser.add_argument("--driving", action="store_true", help="compare sources of a robot that drives there")
    parser.add_argument("--seed", type=int, help=f"seed of the first scene ({FIRST_SEED}, with --driving "
                        f"{FIRST_DRIVING_SEED}; with --quick {CHOOSING.first}, of those for choosing)")  # fmt: skip
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--png", type=Path, help="draw a stop, and what each source predicts, into this file")
    parser.add_argument("--docs", type=Path, help="write the table between the comments of this document")
    options = parser.parse_args()
    # Sources of a driving robot see many images: on a busy machine one thread is faster.
    torch.set_num_threads(1 if options.driving else 2)
    robot = load_robot(options.robot)
    counts = QUICK_SCENES if options.quick else DRIVING_SCENES if options.driving else SCENES
    usual = FIRST_DRIVING_SEED if options.driving else FIRST_SEED
    first = (CHOOSING.first if options.quick else usual) if options.seed is None else options.seed
    if options.driving and options.checkpoint:
        parser.error("--driving compares sources of the shipped encoder: leave --checkpoint out")
    try:
        checkpoints = parse_checkpoints(options.checkpoint)
        if not (options.quick and options.seed is None):
            reporting_seeds(first, 1000 * len(counts))
    except ValueError as error:
        parser.error(str(error))
    jobs = [(kind, first + 1000 * index + i) for index, kind in enumerate(counts) for i in range(counts[kind])]
    scenes = [(driving_scene if options.driving else scene)(*job) for job in tqdm(jobs, desc="scenes")]
    pictured = min(scenes, key=lambda s: (not s.stops, abs(s.ahead.distance - 2.5)))
    groups = (
        [[judged] for judged in driving_systems(robot)] if options.driving else compared_systems(checkpoints, robot)
    )
    rows, drawn = [], {}
    for own in groups:
        title = own[0].title + (f", {len(own)} training seeds" if len(own) > 1 else "")
        driven = [
            distance(predicted_after(judged, robot, found))
            for judged in own
            for found in tqdm(scenes, desc=title, leave=False)
        ]
        rows.append(counted(title, scenes, np.array(driven).reshape(len(own), len(scenes))))
        if options.png:
            drawn[own[0].title] = predicted_after(own[0], robot, pictured)
    text = table(rows)
    print(text)
    entry = described_use([seed for _, seed in jobs], checkpoints) | {"robot": options.robot}
    if options.json:
        logs = [options.json.with_name("wall.log.jsonl"), PUBLISHED_LOG]
        print(f"{logs[0]}: seeds used {log_use(logs, entry)} time(s)")
    if options.docs:
        log_use([PUBLISHED_LOG], entry | {"docs": options.docs.name})
    if options.json:
        listed = [{"kind": s.ahead.kind, "distance": s.ahead.distance, "height": s.ahead.height, "driven": s.driven}
                  for s in scenes]  # fmt: skip
        write_text(options.json, json.dumps({"seed": first, "rows": rows, "scenes": listed}, indent=1))
    if options.png:
        options.png.parent.mkdir(parents=True, exist_ok=True)
        draw(pictured, drawn).savefig(options.png, dpi=130)
    if options.docs:
        marker = "walls while driving" if options.driving else "walls of any texture"
        write_between(options.docs, marker, text)


if __name__ == "__main__":
    main()
