"""Walls and posts ahead (the paper's Figure 9): which terrain sources predict the stop that occurs in the simulator.

    scripts/run.sh python benchmarks/wall.py [--quick] [--checkpoint SYSTEM=FILE ...] [--seed N] [--json FILE]
        [--png FILE] [--docs FILE]

draws walls and posts of any texture and colour, 0.15 to 1.2 m high and 0.6 to 6 m away, and soft vegetation that looks
like a wall. The robot is commanded to drive straight ahead for eight seconds. In simulation it drives until something
stops it; each source predicts the same motion from one image or sweep. The command reports precision, recall and the
stopping position. Systems are those of benchmarks/terrain.py, each with one checkpoint per training seed, whose scenes
are counted together; without any, the shipped encoder is tested with images, with a lidar sweep and with both.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from terrain import parse_checkpoints
from terrain_tables import LEARNED
from tqdm import tqdm

from monoforce_ros.core import MotionState, write_text
from monoforce_ros.evaluation.tables import LIDAR, System, terrain_source
from monoforce_ros.messages import decoding
from monoforce_ros.perception import Observation
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
FIRST_SEED = 410_000
SCENES = {"wall": 40, "post": 20, "vegetation": 20}
QUICK_SCENES = {"wall": 8, "post": 4, "vegetation": 4}


@dataclass(frozen=True)
class Scene:
    """What is ahead, the sensors' data and how far the simulated robot drove [m]."""

    ahead: WallAhead
    observation: Observation
    start: MotionState
    driven: float

    @property
    def stops(self) -> bool:
        """Whether the obstacle stopped the simulated robot."""
        return self.driven < STOPPED * SPEED * HORIZON


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
        right.plot(np.asarray(grid.x)[ahead], height[row, ahead], color=f"C{index}", label=title)
        right.plot(*prediction.rollout.position[0].numpy()[-1, [0, 2]], "o", color=f"C{index}", markersize=9)
    right.plot(found.driven, 0.0, "kx", markersize=10, label=f"simulated robot after {HORIZON:.0f} s")
    right.set(xlabel="ahead [m]", ylabel="supporting height H_t [m]", xlim=(-0.5, 6.4))
    right.set_title(f"predicted terrain; dots: predicted robot after {HORIZON:.0f} s")
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


def counted(title: str, scenes: list[Scene], driven: np.ndarray) -> dict:
    """Precision, recall and stopping position of predicted distances ``driven`` ``[scenes]`` [m]."""
    truth = np.array([s.stops for s in scenes])
    predicted_stop = driven < STOPPED * SPEED * HORIZON
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


def table(rows: Sequence[dict]) -> str:
    """The rows of :func:`counted` as a Markdown table."""
    lines = ["| terrain | precision | recall | walls | posts | soft vegetation | stop error (median) |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for row in rows:
        kinds = " | ".join(f"{row[kind][0]} predicted, {row[kind][1]} true of {row[kind][2]}" for kind in AHEAD_KINDS)
        precision, recall = ("–" if row[key] is None else f"{row[key]:.2f}" for key in ("precision", "recall"))
        error = "–" if row["stop_error_m"] is None else f"{row['stop_error_m']:.2f} m"
        lines.append(f"| {row['system']} | {precision} | {recall} | {kinds} | {error} |")
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", action="append", default=[], metavar="SYSTEM=FILE", help="repeat for other "
                        f"systems and training seeds; systems: {', '.join(LEARNED)}")  # fmt: skip
    parser.add_argument("--robot", default="husky", help="name or file (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help="16 scenes instead of 80")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="seed of the first scene (default: %(default)s)")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--png", type=Path, help="draw a stop, and what each source predicts, into this file")
    parser.add_argument("--docs", type=Path, help="write the table between the comments of this document")
    options = parser.parse_args()
    torch.set_num_threads(2)
    robot = load_robot(options.robot)
    try:
        checkpoints = parse_checkpoints(options.checkpoint)
    except ValueError as error:
        parser.error(str(error))
    systems = [[System(name, *LEARNED[name], file) for file in files] for name, files in checkpoints.items()]
    counts = QUICK_SCENES if options.quick else SCENES
    jobs = [(kind, options.seed + 1000 * index + i) for index, kind in enumerate(counts) for i in range(counts[kind])]
    scenes = [scene(*job) for job in tqdm(jobs, desc="scenes")]
    pictured = min(scenes, key=lambda s: (not s.stops, abs(s.ahead.distance - 2.5)))
    rows, drawn = [], {}
    for own in (*systems, [LIDAR]):
        predictors = [Predictor(robot, terrain_source(system, robot), horizon=HORIZON) for system in own]
        title = own[0].title + (f", {len(own)} training seeds" if len(own) > 1 else "")
        driven = [
            distance(predicted(predictor, found.observation, found.start))
            for predictor in predictors
            for found in tqdm(scenes, desc=title, leave=False)
        ]
        rows.append(counted(title, scenes * len(predictors), np.array(driven)))
        if options.png:
            drawn[own[0].title] = predicted(predictors[0], pictured.observation, pictured.start)
    text = table(rows)
    print(text)
    if options.json:
        listed = [{"kind": s.ahead.kind, "distance": s.ahead.distance, "height": s.ahead.height, "driven": s.driven}
                  for s in scenes]  # fmt: skip
        write_text(options.json, json.dumps({"seed": options.seed, "rows": rows, "scenes": listed}, indent=1))
    if options.png:
        options.png.parent.mkdir(parents=True, exist_ok=True)
        draw(pictured, drawn).savefig(options.png, dpi=130)
    if options.docs:
        write_between(options.docs, "walls of any texture", text)


if __name__ == "__main__":
    main()
