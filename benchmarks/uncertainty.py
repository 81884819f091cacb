"""Coverage of the predicted 90 % band at 1, 2 and 5 s: share of measured positions inside the band.

    scripts/run.sh python benchmarks/uncertainty.py BAG... [--terrain NAME] [--json FILE]

Predictions start every second and use the recorded commands. A calibrated band contains 90 % of the outcomes. The
benchmark also prints the factor that calibrates it on these recordings (`ensemble_scale` of the predictor).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.bags import Recording, observe
from monoforce_ros.core import StaleDataError, write_text
from monoforce_ros.evaluation import corrected_recording
from monoforce_ros.perception import SOURCES, choose_terrain_source
from monoforce_ros.prediction import COVERAGE, EnsembleSettings, Prediction, Predictor, spread
from monoforce_ros.reporting import progress
from monoforce_ros.robots import load_robot

HORIZONS = (1.0, 2.0, 5.0)


def recording_ratios(bag: Path, predictor: Predictor, settings: EnsembleSettings) -> tuple[np.ndarray, np.ndarray]:
    """Position error over band radius, and the radius [m], of each window and horizon ``[W, 3]``; NaN off the map."""
    recording = corrected_recording(Recording.open(bag), predictor.robot)
    sensors = predictor.source.sensors
    topics = tuple(recording.images) if "camera" in sensors else ()
    first, last = int(recording.motion.stamps[0]), int(recording.motion.stamps[-1])
    ratios, radii = [], []
    for stamp in range(first + 10**9, last - round(1e9 * HORIZONS[0]), 10**9):
        try:
            motion = recording.motion.at(stamp, maximum_gap=0.3)
            terrain = predictor.source.terrain(observe(recording, predictor.robot, stamp, sensors, topics), motion)
        except ValueError:
            continue
        twists = recording.commands.sample(predictor.command_stamps(stamp))
        prediction = Prediction(motion, terrain, predictor.roll_out(terrain, [motion], twists[None]))
        found = spread(predictor, prediction, twists, settings)
        positions, inside = prediction.positions(), prediction.rollout.inside[0].numpy()
        row, sizes = [], []
        for horizon in HORIZONS:
            step = round(horizon / predictor.options.time_step)
            try:
                state = recording.motion.at(stamp + round(1e9 * horizon), maximum_gap=0.3)
                error = float(np.hypot(*(positions[step, :2] - state.position[:2])))
            except StaleDataError:
                error = np.nan
            row.append(error / max(found.radius[step], 1e-6) if inside[: step + 1].all() else np.nan)
            sizes.append(found.radius[step])
        ratios.append(row)
        radii.append(sizes)
    return np.array(ratios).reshape(-1, len(HORIZONS)), np.array(radii).reshape(-1, len(HORIZONS))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bags", nargs="+", type=Path)
    parser.add_argument("--robot", default="husky", help="robot name or file (%(default)s)")
    parser.add_argument(
        "--terrain", choices=SOURCES, default="lidar_interpolation", help="terrain source (%(default)s)"
    )
    parser.add_argument("--checkpoint", default="", help="checkpoint of the terrain encoder (default: the shipped one)")
    parser.add_argument("--members", type=int, default=EnsembleSettings.members, help="ensemble size (%(default)s)")
    parser.add_argument(
        "--scale", type=float, default=EnsembleSettings.scale, help="factor on the spread (%(default)s)"
    )
    parser.add_argument("--json", type=Path, help="write the results to this file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    robot = load_robot(options.robot)
    predictor = Predictor(robot, choose_terrain_source(options.terrain, robot, checkpoint=options.checkpoint))
    settings = EnsembleSettings(members=options.members, scale=options.scale)
    rows, sizes = zip(
        *(recording_ratios(bag, predictor, settings) for bag in progress(options.bags, unit="recording")), strict=True
    )
    ratios, radii = np.concatenate(rows), np.concatenate(sizes)
    result = {"recordings": len(rows), "windows": len(ratios), "members": options.members, "scale": options.scale}
    print(f"{len(rows)} recordings, {len(ratios)} windows, {options.members} members, scale {options.scale:g}")
    for i, horizon in enumerate(HORIZONS):
        known = ratios[np.isfinite(ratios[:, i]), i]
        inside, factor = float(np.mean(known <= 1.0)), float(np.quantile(known, COVERAGE))
        radius = float(np.median(radii[:, i]))
        result[f"{horizon:g} s"] = {"windows": len(known), "inside": inside, "median_radius": radius, "factor": factor}
        print(
            f"  {horizon:g} s: {100 * inside:.0f} % of {len(known)} inside (nominal {100 * COVERAGE:.0f} %), "
            f"median radius {radius:.2f} m, factor for {100 * COVERAGE:.0f} % {factor:.2f}"
        )
    if options.json:
        write_text(options.json, json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
