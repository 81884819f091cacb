"""Hull: boxes around the shapes of the body."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from monoforce_ros.robots.urdf.geometry import Frames
from monoforce_ros.robots.urdf.parts import Parts
from monoforce_ros.robots.urdf.shapes import Shape

_LARGEST_HULL = 60
_THINNEST = 0.005
"""Smallest size of a box [m]."""


@dataclass
class Hull:
    """Boxes of the body in the base frame."""

    boxes: list[tuple[str, np.ndarray, np.ndarray]] = field(default_factory=list)
    """Name, lowest and highest corner ``[3]`` [m]."""
    guesses: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def find_hull(frames: Frames, parts: Parts) -> Hull:
    """Boxes around the shapes of all links that are neither wheel, track nor flipper; those within others left out."""
    description = frames.description
    taken = set(parts.left_out)
    for wheel in parts.wheels:
        for joint in (wheel.joint, wheel.twin):
            if joint is not None and joint.kind != "fixed":
                taken |= set(description.subtree(joint.child, ("fixed",)))
    for flipper in parts.flippers:
        taken |= set(description.subtree(flipper.link))
    used = {id(shape) for belt in parts.tracks for _, shape in belt.shapes}
    used |= {id(shape) for wheel in parts.wheels for shape in wheel.shapes}
    hull = Hull()
    _warn_of_meshes(frames, taken, hull)
    placed = []
    for name, shape in frames.shapes(link for link in description.links if link not in taken):
        if id(shape) not in used:
            points = shape.placed(frames.link(name))
            low, high = points.min(axis=0), points.max(axis=0)
            placed.append((name, shape, low, np.maximum(high, low + _THINNEST)))
    kept = _outermost(placed)
    if len(kept) > _LARGEST_HULL:
        hull.warnings.append(f"hull: {len(kept)} boxes, of which the {_LARGEST_HULL} largest are kept")
        kept = sorted(kept, key=lambda entry: -float(np.prod(entry[3] - entry[2])))[:_LARGEST_HULL]
    if not kept:
        hull.warnings.append("hull: no link of the body has a collision shape; the body cannot touch anything")
    seen = set[str]()
    for name, shape, low, high in kept:
        turn = np.abs((frames.link(name) @ shape.pose)[:3, :3])
        if shape.kind != "box" or turn.max(axis=0).min() < 0.99:
            turned = " that is turned" if shape.kind == "box" else ""
            hull.guesses.append(f"hull {name}: the box around a {shape.kind}{turned}")
        label = name if name not in seen else f"{name}_{len(seen)}"
        seen.add(label)
        hull.boxes.append((label, low, high))
    return hull


_Placed = tuple[str, Shape, np.ndarray, np.ndarray]


def _outermost(boxes: list[_Placed]) -> list[_Placed]:
    """Boxes that lie in no other one."""
    kept = []
    for index, (name, shape, low, high) in enumerate(boxes):
        inside = any(
            (low >= other_low - 1e-6).all() and (high <= other_high + 1e-6).all() and (other != index)
            and not ((high - low == other_high - other_low).all() and other > index)
            for other, (_, _, other_low, other_high) in enumerate(boxes)
        )  # fmt: skip
        if not inside:
            kept.append((name, shape, low, high))
    return kept


def _warn_of_meshes(frames: Frames, taken: Collection[str], hull: Hull) -> None:
    """Say which links of the body cannot touch anything, because their meshes are left out."""
    links = frames.description.links
    empty = [name for name in links if name not in taken and links[name].without_meshes and not links[name].shapes]
    if empty:
        more = f" and {len(empty) - 6} more" if len(empty) > 6 else ""
        hull.warnings.append(
            f"hull: meshes are left out, so that {', '.join(empty[:6])}{more} cannot touch anything; add boxes for "
            "them, or name the folder of the meshes (--package NAME=FOLDER)"
        )
