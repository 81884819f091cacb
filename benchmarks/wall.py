"""A wall ahead (the paper's Figure 9): which terrain encoders predict the crash that occurs in the simulator.

    scripts/run.sh python benchmarks/wall.py --monoforce FILE [--no-geometric FILE] [--lss FILE] [--count 12]
        [--json FILE] [--png FILE] [--docs FILE]

The robot is commanded to drive straight ahead for five seconds. In simulation it drives until the wall stops it; each
encoder predicts the same motion from one image. Randomly selected scenes have no wall, to detect encoders that always
predict a crash. Each prediction is repeated with uniform friction, because a wall blurred into a slope stops the robot
only if the predicted friction is low.

    scripts/run.sh python benchmarks/wall.py --any-texture [--quick] [--checkpoint SYSTEM=FILE ...] [--seed N]
        [--json FILE] [--docs FILE]

draws walls and posts of any texture and colour, 0.15 to 1.2 m high and 0.6 to 6 m away, and soft vegetation that looks
like a wall, and reports precision, recall and the stopping position. The robot is commanded to drive straight ahead for
eight seconds. Systems are those of benchmarks/terrain.py, each with one checkpoint per training seed, whose scenes are
counted together; without any, the shipped encoder is tested with images, with a lidar sweep and with both.

The table in docs/training.md uses seeds from 70000 on. The thresholds of encoder/edges.py and the average of encoders
were tuned on seeds 80000 to 80031; seeds 93000 to 93031 are held out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from terrain import parse_checkpoints
from terrain_tables import LEARNED
from tqdm import tqdm

from monoforce_ros.core import MotionState, write_text
from monoforce_ros.encoder import fused, load_encoder
from monoforce_ros.evaluation.tables import System, terrain_source
from monoforce_ros.messages import decoding
from monoforce_ros.perception import EncoderTerrain, LidarTerrain, Observation, TerrainSource
from monoforce_ros.prediction import Prediction, Predictor
from monoforce_ros.reporting import write_between
from monoforce_ros.robots import RobotModel, load_robot
from monoforce_ros.synthetic import (
    AHEAD_KINDS,
    CameraSettings,
    CourseSettings,
    LiveSettings,
    LiveWorld,
    WallAhead,
    draw_wall_ahead,
)
from monoforce_ros.synthetic.random_streams import random_stream
from monoforce_ros.terrain import Grid, TerrainDefaults

SPEED, HORIZON = 0.8, 5.0
STOPPED = 0.7
"""The robot has crashed if it covers less than this share of the commanded distance."""


@dataclass(frozen=True)
class Scene:
    """Sensor data of a scene, and the distance covered by the simulated robot."""

    observation: Observation
    start: MotionState
    wall: float | None
    """Distance to the wall [m]; None without a wall."""
    image: np.ndarray
    driven: float
    """Distance covered by the simulated robot [m]."""


def scene(seed: int) -> Scene:
    """Simulate one scene."""
    random = random_stream(seed, "wall ahead")
    wall = float(random.uniform(2.0, 3.2)) if random.random() < 0.6 else None
    course = replace(
        CourseSettings.draw(seed), wall=wall, grass=None, wall_width=4.0, roughness=float(random.uniform(0.1, 0.5))
    )
    world = LiveWorld(LiveSettings(seed=seed, course=course, camera=CameraSettings()))
    try:
        observation, state = observed(world, load_robot("husky"))
        world.simulation.drive(SPEED, 0.0)
        world.advance(world.time + HORIZON)
        end, _, _ = decoding.decode_odometry(world.odometry(10**9))
    finally:
        world.close()
    image = next(iter(observation.images.values()))
    return Scene(observation, state, wall, image, float(np.linalg.norm(end.position[:2] - state.position[:2])))


def observed(world: LiveWorld, robot: RobotModel) -> tuple[Observation, MotionState]:
    """What the robot's sensors measure at the moment, and its state."""
    stamp = 10**9
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


def predicted(predictor: Predictor, found: Scene | AnyScene, speed: float = SPEED) -> tuple[float, float, Prediction]:
    """Predicted distance [m], predicted distance with uniform friction [m], and the prediction."""
    twists = np.zeros((predictor.history + predictor.steps, 2))
    twists[predictor.history :, 0] = speed
    prediction = predictor.predict(found.observation, found.start, twists)
    terrain = prediction.terrain
    uniform = replace(terrain, friction=torch.full_like(terrain.friction, TerrainDefaults.friction))
    by_height = replace(prediction, rollout=predictor.roll_out(uniform, [found.start], twists[None]))
    return _driven(prediction), _driven(by_height), prediction


def _driven(prediction: Prediction) -> float:
    positions = prediction.positions()
    return float(np.linalg.norm(positions[-1, :2] - positions[0, :2]))


def draw(scenes: list[Scene], maps: dict[str, Prediction], titles: dict[str, str]) -> Figure:
    """The first scene with a wall: its image, and heights and final position along the path for each map."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.7])
    scene_with_wall = next(s for s in scenes if s.wall is not None)
    left.imshow(scene_with_wall.image)
    left.set_axis_off()
    left.set_title("camera image")
    for (key, prediction), colour in zip(maps.items(), ("#1b7f5c", "#c4531d", "#5b4bb7", "#888888"), strict=False):
        grid, height = prediction.terrain.grid, prediction.terrain.height.numpy()
        row = int(np.argmin(np.abs(np.asarray(grid.y))))
        ahead = np.asarray(grid.x) > -0.5
        right.plot(np.asarray(grid.x)[ahead], height[row, ahead], color=colour, label=titles[key])
        local = prediction.rollout.position[0].numpy()
        right.plot(*local[-1, [0, 2]], "o", color=colour, markersize=9)
    right.axvline(scene_with_wall.wall, color="black", linestyle="--", linewidth=1, label="wall")
    right.plot(scene_with_wall.driven, 0.0, "kx", markersize=10, label="simulated robot after 5 s")
    right.set(xlabel="ahead [m]", ylabel="supporting height H_t [m]", xlim=(-0.5, 5.0))
    right.set_title("predicted terrain; dots: predicted robot after 5 s")
    right.legend(fontsize=8, loc="upper left")
    return figure


ANY_SPEED, ANY_HORIZON = 0.8, 8.0
ANY_STOPPED = 0.94
"""Share of the commanded distance below which a robot counts as stopped: an obstacle 6 m away stops it at 0.93."""
ANY_SEED = 410_000
ANY_SCENES = {"wall": 40, "post": 20, "vegetation": 20}
QUICK_SCENES = {"wall": 8, "post": 4, "vegetation": 4}


@dataclass(frozen=True)
class AnyScene:
    """A scene of any texture: what is ahead, the sensors' data and how far the simulated robot drove [m]."""

    ahead: WallAhead
    observation: Observation
    start: MotionState
    driven: float

    @property
    def stops(self) -> bool:
        """Whether the obstacle stopped the simulated robot."""
        return self.driven < ANY_STOPPED * ANY_SPEED * ANY_HORIZON


def any_scene(kind: str, seed: int) -> AnyScene:
    """Simulate one scene of a kind of :data:`monoforce_ros.synthetic.AHEAD_KINDS`."""
    robot = load_robot("husky")
    ahead = draw_wall_ahead(kind, seed, float(robot.points[:, 0].max()))
    world = LiveWorld(LiveSettings(seed=seed, scenery=ahead.scenery, camera=CameraSettings()))
    try:
        observation, state = observed(world, robot)
        world.simulation.drive(ANY_SPEED, 0.0)
        world.advance(world.time + ANY_HORIZON)
        end, _, _ = decoding.decode_odometry(world.odometry(10**9))
    finally:
        world.close()
    return AnyScene(ahead, observation, state, float(np.linalg.norm(end.position[:2] - state.position[:2])))


def any_row(title: str, scenes: list[AnyScene], driven: np.ndarray) -> dict:
    """Precision, recall and stopping position of predicted distances ``driven`` ``[scenes]`` [m]."""
    truth = np.array([s.stops for s in scenes])
    predicted_stop = driven < ANY_STOPPED * ANY_SPEED * ANY_HORIZON
    found = predicted_stop & truth
    errors = (driven - np.array([s.driven for s in scenes]))[found]
    row: dict = {"system": title, "stops": int(truth.sum()), "predicted": int(predicted_stop.sum())}
    row["found"] = int(found.sum())
    row["precision"] = float(found.sum() / predicted_stop.sum()) if predicted_stop.any() else None
    row["recall"] = float(found.sum() / truth.sum()) if truth.any() else None
    row["stop_error_m"] = float(np.median(errors)) if len(errors) else None
    row["stop_spread_m"] = float(np.median(np.abs(errors))) if len(errors) else None
    for kind in AHEAD_KINDS:
        chosen = np.array([s.ahead.kind == kind for s in scenes])
        row[kind] = [int((predicted_stop & chosen).sum()), int((truth & chosen).sum()), int(chosen.sum())]
    return row


def _driven_with(
    sources: Sequence[TerrainSource], robot: RobotModel, scenes: list[AnyScene], title: str
) -> tuple[list[AnyScene], np.ndarray]:
    """The scenes, once for each source, and the distances predicted with it [m]."""
    driven = [
        predicted(Predictor(robot, source, horizon=ANY_HORIZON), scene, ANY_SPEED)[0]
        for source in sources
        for scene in tqdm(scenes, desc=title, leave=False)
    ]
    return list(scenes) * len(sources), np.array(driven)


def run_any(options: argparse.Namespace, titles: dict[str, str]) -> None:
    """Evaluate terrain sources on obstacles of any texture."""
    robot = load_robot(options.robot)
    counts = QUICK_SCENES if options.quick else ANY_SCENES
    jobs = [(kind, options.seed + 1000 * index + i) for index, kind in enumerate(counts) for i in range(counts[kind])]
    scenes = [any_scene(*job) for job in tqdm(jobs, desc="scenes")]
    rows = []
    for name, files in parse_checkpoints(options.checkpoint).items():
        systems = [System(name, *LEARNED[name], file) for file in files]
        sources = [terrain_source(system, robot) for system in systems]
        title = systems[0].title + (f", {len(files)} training seeds" if len(files) > 1 else "")
        rows.append(any_row(title, *_driven_with(sources, robot, scenes, title)))
    interpolation = [LidarTerrain(robot, Grid.square(), TerrainDefaults())]
    rows.append(any_row(titles["lidar"], *_driven_with(interpolation, robot, scenes, titles["lidar"])))
    lines = ["| terrain | precision | recall | walls | posts | soft vegetation | stop error (median) |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for row in rows:
        kinds = " | ".join(f"{row[kind][0]} predicted, {row[kind][1]} true of {row[kind][2]}" for kind in AHEAD_KINDS)
        precision, recall, error = (
            "–" if row[key] is None else f"{row[key]:.2f}" for key in ("precision", "recall", "stop_error_m")
        )
        lines.append(f"| {row['system']} | {precision} | {recall} | {kinds} | {error} m |")
    print("\n".join(lines))
    if options.json:
        listed = [{"kind": s.ahead.kind, "distance": s.ahead.distance, "height": s.ahead.height, "driven": s.driven}
                  for s in scenes]  # fmt: skip
        write_text(options.json, json.dumps({"rows": rows, "scenes": listed}, indent=1))
    if options.docs:
        write_between(options.docs, "walls of any texture", "\n".join(lines))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    titles = {
        "monoforce": "MonoForce", "no_geometric": "without geometric loss", "lss": "LSS (H_g alone)",
        "lidar": "lidar interpolation",
    }  # fmt: skip
    for key in ("monoforce", "no_geometric", "lss"):
        parser.add_argument(f"--{key.replace('_', '-')}", type=Path, metavar="FILE.safetensors")
    parser.add_argument("--checkpoint", action="append", default=[], metavar="SYSTEM=FILE", help="with --any-texture: "
                        f"repeat for other systems and training seeds; systems: {', '.join(LEARNED)}")  # fmt: skip
    parser.add_argument("--robot", default="husky", help="name or file (default: %(default)s)")
    parser.add_argument("--any-texture", action="store_true", help="walls, posts and vegetation of any texture")
    parser.add_argument("--quick", action="store_true", help="with --any-texture: 16 scenes instead of 80")
    parser.add_argument("--count", type=int, default=24, help="number of scenes (default: %(default)s)")
    parser.add_argument("--seed", type=int, help=f"seed of the first scene (70000; with --any-texture {ANY_SEED})")
    for name in ("json", "png", "docs"):
        parser.add_argument(f"--{name}", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(2)
    if options.seed is None:
        options.seed = ANY_SEED if options.any_texture else 70000
    if options.any_texture and (options.monoforce or options.no_geometric or options.lss):
        parser.error("--any-texture takes --checkpoint SYSTEM=FILE, not --monoforce, --no-geometric or --lss")
    if options.any_texture:
        try:
            run_any(options, titles)
        except ValueError as error:
            parser.error(str(error))
        return
    robot = load_robot(options.robot)
    sources = {
        key: EncoderTerrain(fused(load_encoder(getattr(options, key))), robot)
        for key in ("monoforce", "no_geometric", "lss")
        if getattr(options, key)
    }
    sources["lidar"] = LidarTerrain(robot, Grid.square(), TerrainDefaults())
    predictors = {key: Predictor(robot, source, horizon=HORIZON) for key, source in sources.items()}
    scenes = [scene(options.seed + i) for i in tqdm(range(options.count), desc="scenes")]
    truth = np.array([s.driven < STOPPED * SPEED * HORIZON for s in scenes])
    rows, drawn = [], {}
    for key, predictor in predictors.items():
        driven, by_height = np.array([predicted(predictor, s)[:2] for s in scenes]).T
        crash, by_height = driven < STOPPED * SPEED * HORIZON, by_height < STOPPED * SPEED * HORIZON
        ends = np.array([s.driven for s in scenes])
        rows.append({
            "system": titles[key], "walls": int(truth.sum()), "crashes_predicted": int((crash & truth).sum()),
            "by_height_alone": int((by_height & truth).sum()),
            "open": int((~truth).sum()), "false_crashes": int((crash & ~truth).sum()),
            "stop_error_m": float(np.median(np.abs(driven - ends)[truth])) if truth.any() else None,
        })  # fmt: skip
        first = next((s for s in scenes if s.wall is not None), None)
        if first is not None:
            drawn[key] = predicted(predictor, first)[2]
    lines = ["| terrain | crashes predicted | by heights alone | false crashes | stopping position, median error |"]
    lines += ["|---|---|---|---|---|"]
    lines += [
        f"| {r['system']} | {r['crashes_predicted']} of {r['walls']} | {r['by_height_alone']} | "
        f"{r['false_crashes']} of {r['open']} | {r['stop_error_m']:.2f} m |"
        for r in rows
    ]
    print("\n".join(lines))
    if options.json:
        write_text(options.json, json.dumps({"scenes": options.count, "rows": rows}, indent=1))
    if options.png and drawn:
        options.png.parent.mkdir(parents=True, exist_ok=True)
        draw(scenes, drawn, titles).savefig(options.png, dpi=130)
    if options.docs:
        write_between(options.docs, "wall", "\n".join(lines))


if __name__ == "__main__":
    main()
