"""Draws one camera image from each of many randomised worlds: scripts/run.sh python scripts/draw_worlds.py [--out FILE]

Each robot stands at a random place of its track. Look at the result: two worlds should differ at a glance.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from monoforce_ros.core import atomic_path
from monoforce_ros.synthetic import WorldSettings, draw_world, random_stream
from monoforce_ros.synthetic.sensors import Camera
from monoforce_ros.synthetic.simulation import Simulation
from monoforce_ros.synthetic.world import build_model

TILE = (240, 180)
"""Width and height of an image on the sheet [pixels]."""
_SETTLING_STEPS = 400
_QUALITY = 82


def frame(settings: WorldSettings, seed: int) -> np.ndarray:
    """The first camera's image ``[h, w, 3]`` uint8 in the world of a seed, from a random place of the track."""
    world = draw_world(settings, seed)
    robot = world.robot()
    camera = world.rig(robot)[0]
    robot = replace(robot, sensors={camera.frame: camera.pose})
    field_of_view = camera.settings.vertical_field_of_view
    model = build_model(world.scenery, robot, seed, {camera.frame: field_of_view})
    simulation = Simulation(model, world.scenery, robot)
    random = random_stream(seed, "contact sheet")
    position, heading = world.scenery.route.at(random.uniform(0.0, world.scenery.route.length))
    simulation.data.qpos[:2] = position
    simulation.data.qpos[2] = world.scenery.surface.height_at(position) + robot.clearance + 0.1
    simulation.data.qpos[3:7] = [np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)]
    simulation.data.qvel[:] = 0.0
    for _ in range(_SETTLING_STEPS):
        simulation.step()
    simulation.update_kinematics()
    drawn = Camera(model, camera.frame, camera.settings, camera.imaging)
    try:
        return drawn.capture(simulation.data).copy()
    finally:
        drawn.close()


def sheet(images: list[np.ndarray], columns: int) -> np.ndarray:
    """Images in rows, each fitted into a tile of one size."""
    width, height = TILE
    rows = -(-len(images) // columns)
    page = np.full((rows * (height + 4), columns * (width + 4), 3), 255, np.uint8)
    for index, image in enumerate(images):
        scale = min(width / image.shape[1], height / image.shape[0])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        top = (index // columns) * (height + 4) + (height - small.shape[0]) // 2
        left = (index % columns) * (width + 4) + (width - small.shape[1]) // 2
        page[top : top + small.shape[0], left : left + small.shape[1]] = small
    return page


def main() -> None:
    """Draw the contact sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--style", choices=("varied", "textures"), default="varied", help="(%(default)s)")
    parser.add_argument("--seed", type=int, default=400_000, help="of the first world (%(default)s)")
    parser.add_argument("--count", type=int, default=40, help="number of worlds (%(default)s)")
    parser.add_argument("--columns", type=int, default=8, help="(%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("docs/worlds.jpg"), help="(%(default)s)")
    options = parser.parse_args()
    settings = WorldSettings.of_style(options.style)
    images = [frame(settings, options.seed + index) for index in tqdm(range(options.count), desc="worlds")]
    done, data = cv2.imencode(".jpg", sheet(images, options.columns)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise SystemExit(f"{options.out}: the image could not be encoded")
    with atomic_path(options.out) as unfinished:
        unfinished.write_bytes(data.tobytes())
    print(f"{options.out}: {len(images)} worlds, {len(data) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
