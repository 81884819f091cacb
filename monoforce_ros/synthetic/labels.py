"""Labels: ground truth of a world, for tests and training; kept next to a bag and not in it."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path

import numpy as np

from monoforce_ros.core import atomic_path
from monoforce_ros.synthetic.scenery import Scenery
from monoforce_ros.synthetic.shapes import upper_surface
from monoforce_ros.synthetic.terrain_shape import HeightField

_GRASS_FROM = 0.05


class GroundClass(IntEnum):
    """Class of a cell of the class map."""

    GROUND = 0
    RAMP = 1
    ROCK = 2
    TREE = 3
    GRASS = 4
    PATCH = 5
    WALL = 6
    OBSTACLE = 7


# Classes of the obstacles of randomised worlds; others are OBSTACLE.
_CLASSES = {"rock": GroundClass.ROCK, "wall": GroundClass.WALL}


def world_labels(scenery: Scenery, odom_origin: np.ndarray) -> dict[str, np.ndarray]:
    """Grids of the whole world in the odom frame, indexed ``[row = y, column = x]``.

    Args:
        scenery: the world.
        odom_origin: ``[3]`` position of the odom frame's origin in the world [m].

    Returns:
        ``support_height``: surface that carries a wheel, that is ground, rocks and walls [m], float32;
        ``visible_height``: the same including grass [m], float32; neither includes crowns of trees;
        ``friction``: factor on the friction of ordinary ground [-], float32;
        ``ground_class``: a ``GroundClass`` for each cell, uint8;
        ``vegetation_height``: height of soft vegetation above the ground [m], float32;
        ``resolution`` [m], ``origin`` ``[2]`` position of cell (0, 0) [m], and ``class_names``.
    """
    ground = scenery.ground
    x, y = ground.grid()
    support = scenery.support.heights.copy()
    classes = np.zeros(support.shape, np.uint8)
    if scenery.ramp is not None:
        classes[scenery.ramp.height_at(x, y) > 0.01] = GroundClass.RAMP
    classes[scenery.grass.canopy.heights > _GRASS_FROM] = GroundClass.GRASS
    positions = np.stack([x, y], axis=-1)
    friction = np.ones(support.shape, np.float32)
    for patch in scenery.patches:
        inside = patch.contains(positions)
        friction[inside] = patch.friction
        classes[inside & (classes == GroundClass.GROUND)] = GroundClass.PATCH
    for rock in scenery.rocks:
        low = np.floor((rock.vertices[:, :2].min(axis=0) - ground.origin) / ground.resolution).astype(int)
        high = np.ceil((rock.vertices[:, :2].max(axis=0) - ground.origin) / ground.resolution).astype(int) + 1
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        top = upper_surface(rock.vertices, positions[window].reshape(-1, 2)).reshape(support[window].shape)
        higher = np.nan_to_num(top, nan=-np.inf) > support[window]
        support[window][higher] = top[higher]
        classes[window][higher] = GroundClass.ROCK
    for tree in scenery.trees:
        classes[np.hypot(x - tree.base[0], y - tree.base[1]) < tree.trunk_radius + ground.resolution] = GroundClass.TREE
    for wall in scenery.walls:
        inside = wall.contains(x, y)
        support[inside] = wall.shape.vertices[:, 2].max()
        classes[inside] = GroundClass.WALL
    if scenery.friction is not None:
        friction = scenery.friction.heights.astype(np.float32)
    for obstacle in scenery.obstacles:
        for part in obstacle.parts:
            if part.is_solid:
                _raise_to(support, classes, ground, part.shape.vertices, _CLASSES.get(obstacle.kind))
    visible = np.maximum(support, scenery.surface.heights + scenery.grass.canopy.heights)
    return {
        "support_height": (support - odom_origin[2]).astype(np.float32),
        "visible_height": (visible - odom_origin[2]).astype(np.float32),
        "friction": friction,
        "vegetation_height": scenery.grass.canopy.heights.astype(np.float32),
        "ground_class": classes,
        "resolution": np.array(ground.resolution),
        "origin": ground.origin - odom_origin[:2],
        "class_names": np.array([entry.name.lower() for entry in GroundClass]),
    }


def _raise_to(
    support: np.ndarray, classes: np.ndarray, ground: HeightField, vertices: np.ndarray, kind: GroundClass | None
) -> None:
    """Raise the supporting height to the top of a convex solid; a solid thinner than a cell fills the nearest one."""
    low = np.floor((vertices[:, :2].min(axis=0) - ground.origin) / ground.resolution).astype(int)
    high = np.ceil((vertices[:, :2].max(axis=0) - ground.origin) / ground.resolution).astype(int) + 1
    low, high = np.maximum(low, 0), np.minimum(high, support.shape[0])
    if not (low < high).all():
        return
    steps = [ground.origin[axis] + ground.resolution * np.arange(low[axis], high[axis]) for axis in range(2)]
    positions = np.stack(np.meshgrid(*steps), axis=-1)
    top = upper_surface(vertices, positions.reshape(-1, 2)).reshape(positions.shape[:2])
    if not np.isfinite(top).any():
        middle = np.linalg.norm(positions - vertices[:, :2].mean(axis=0), axis=-1)
        top[np.unravel_index(np.argmin(middle), middle.shape)] = vertices[:, 2].max()
    window = np.s_[low[1] : high[1], low[0] : high[0]]
    higher = np.nan_to_num(top, nan=-np.inf) > support[window]
    support[window][higher] = top[higher]
    classes[window][higher] = GroundClass.OBSTACLE if kind is None else kind


def labels_file(bag: Path) -> Path:
    """Path of a bag's labels, next to the bag."""
    return bag.with_name(f"{bag.name}.labels.npz")


def write_labels(bag: Path, labels: dict[str, np.ndarray]) -> Path:
    """Write labels next to a bag, atomically; returns their file."""
    target = labels_file(bag)
    with atomic_path(target) as unfinished, unfinished.open("wb") as file:
        # The stubs take every keyword for allow_pickle.
        np.savez_compressed(file, **labels)  # type: ignore[arg-type]
    return target
