"""Obstacle: an object made of meshes, each with its own material."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from monoforce_ros.synthetic.shapes import Shape


@dataclass(frozen=True)
class Part:
    """A mesh of an object, in world coordinates.

    Attributes:
        shape: convex if it is solid.
        material: name of its image; see :class:`monoforce_ros.synthetic.paint.Paint`.
        is_solid: it stops wheels and carries them.
        is_visible: cameras and the lidar see it.
    """

    shape: Shape
    material: str
    is_solid: bool = True
    is_visible: bool = True


@dataclass(frozen=True)
class Obstacle:
    """An object on the ground.

    Attributes:
        kind: what it is, such as ``wall`` or ``post``.
        parts: its meshes.
        position: ``[2]`` of its middle in the world [m].
        radius: of a circle around its footprint [m].
    """

    kind: str
    parts: tuple[Part, ...]
    position: np.ndarray
    radius: float
