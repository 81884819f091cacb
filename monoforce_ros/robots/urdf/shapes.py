"""Shapes: collision geometry of links, as convex sets of points."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from monoforce_ros.robots.urdf.errors import UrdfError

MAXIMUM_MESH_BYTES = 100_000_000
_CIRCLE = 48
"""Points on a circle: its polygon is smaller than the circle by 0.2 % of the radius."""


@dataclass(frozen=True)
class Shape:
    """A convex shape in a link's frame."""

    kind: str
    """``box``, ``cylinder``, ``sphere`` or ``mesh``."""
    pose: np.ndarray
    """Link ← shape, ``[4, 4]``."""
    points: np.ndarray
    """Extreme points in the shape's frame [m], ``[n, 3]``."""
    radius: float = 0.0
    """Of a cylinder or sphere [m]."""
    length: float = 0.0
    """Of a cylinder, along its z axis [m]."""

    def placed(self, frame: np.ndarray) -> np.ndarray:
        """The extreme points ``[n, 3]`` [m] where the link's frame is ``frame`` ``[4, 4]``."""
        pose = frame @ self.pose
        return self.points @ pose[:3, :3].T + pose[:3, 3]


def read_shape(geometry: Any, pose: np.ndarray, where: str, files: MeshFiles) -> Shape | None:
    """A shape from a parsed ``geometry`` element; None for a mesh that :class:`MeshFiles` leaves out.

    Raises ``UrdfError`` if a size is not positive and finite, or a mesh is missing or unreadable.
    """
    kind = type(geometry).__name__.lower()
    if kind == "box":
        size = _positive(geometry.size, f"{where}: box size", 3)
        signs = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, -1).T
        return Shape("box", pose, signs * size)
    if kind == "cylinder":
        radius, length = _positive([geometry.radius, geometry.length], f"{where}: cylinder radius and length", 2)
        return Shape("cylinder", pose, _cylinder_points(radius, length), float(radius), float(length))
    if kind == "sphere":
        (radius,) = _positive([geometry.radius], f"{where}: sphere radius", 1)
        return Shape("sphere", pose, _sphere_points(radius), float(radius))
    if kind == "mesh":
        scale = np.ones(3) if geometry.scale is None else np.asarray(geometry.scale, float)
        if scale.shape != (3,) or not np.isfinite(scale).all() or (scale == 0).any():
            raise UrdfError(f"{where}: mesh scale: got {geometry.scale}, expected three numbers other than 0")
        points = files.points(str(geometry.filename), where)
        return None if points is None else Shape("mesh", pose, points * scale)
    raise UrdfError(f"{where}: geometry: got {kind}, expected box, cylinder, sphere or mesh")


@dataclass(frozen=True)
class MeshFiles:
    """Where meshes are looked for."""

    description: Path
    """The URDF file."""
    packages: Mapping[str, Path]
    """Folders of packages, which go before any that are found."""
    ignore: bool = False
    """Whether to leave out all meshes."""

    def points(self, uri: str, where: str) -> np.ndarray | None:
        """Corners of a mesh's convex hull [m], ``[n, 3]``."""
        if self.ignore:
            return None
        path = self.path(uri)
        if path is None:
            package = uri.partition("://")[2].partition("/")[0]
            place = (
                f"name its package's folder (--package {package}=FOLDER), source the workspace that has it"
                if uri.startswith(("package://", "model://"))
                else "put the file there"
            )
            raise UrdfError(f"{where}: the mesh {uri} is missing; {place}, or leave out meshes (--ignore-meshes)")
        if path.stat().st_size > MAXIMUM_MESH_BYTES:
            raise UrdfError(f"{where}: {path}: {path.stat().st_size} bytes, expected at most {MAXIMUM_MESH_BYTES}")
        return _hull_points(path, where)

    def path(self, uri: str) -> Path | None:
        """The file of a ``package://``, ``model://``, ``file://`` or relative reference, or None."""
        scheme, separator, rest = uri.partition("://")
        if not separator:
            return _existing(self.description.parent / uri)
        if scheme == "file":
            return _existing(Path(rest))
        if scheme not in ("package", "model"):
            return None
        package, _, inside = rest.partition("/")
        folders = package_folders(package, self.description, self.packages)
        return next((found for folder in folders if (found := _existing(folder / inside))), None)


def package_folders(package: str, description: Path, packages: Mapping[str, Path]) -> list[Path]:
    """Where a package may lie: as told, around the description, and in the sourced workspaces."""
    listed = [Path(packages[package])] if package in packages else []
    for parent in description.resolve().parents:
        listed += [parent] if parent.name == package else []
        listed.append(parent / package)
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return listed + [Path(prefix) / "share" / package for prefix in prefixes if prefix]


def _existing(path: Path) -> Path | None:
    return path if path.is_file() else None


def _hull_points(path: Path, where: str) -> np.ndarray:
    try:
        import trimesh
    except ImportError as error:
        raise UrdfError(f"{where}: {path.name} needs trimesh: pip install trimesh pycollada") from error
    if path.suffix.lower() == ".dae" and b"<!" in path.read_bytes().replace(b"<!--", b""):
        raise UrdfError(f"{where}: {path}: contains a document type or entity, which is refused")
    try:
        with path.open("rb") as stream:
            loaded = trimesh.load(stream, file_type=path.suffix[1:].lower(), force="mesh", skip_materials=True)
        vertices = np.asarray(loaded.vertices, float)
        if not np.isfinite(vertices).all() or len(np.unique(vertices, axis=0)) < 4:
            raise ValueError(f"{len(vertices)} finite vertices")
        return np.asarray(loaded.convex_hull.vertices, float)
    except Exception as error:  # trimesh raises whatever its loaders do
        hint = " (pip install pycollada)" if path.suffix.lower() == ".dae" else ""
        raise UrdfError(f"{where}: {path}: not readable as a mesh: {error!r}{hint}") from error


def _positive(values: Any, where: str, count: int) -> np.ndarray:
    try:
        found = np.asarray(values, float)
    except (TypeError, ValueError):
        found = np.full(count, math.nan)
    if found.shape != (count,) or not np.isfinite(found).all() or (found <= 0).any():
        raise UrdfError(f"{where}: got {values}, expected {count} positive numbers [m]")
    return found


def _cylinder_points(radius: float, length: float) -> np.ndarray:
    angles = 2 * math.pi * np.arange(_CIRCLE) / _CIRCLE
    ring = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([np.column_stack([ring, np.full(_CIRCLE, z)]) for z in (-length / 2, length / 2)])


def _sphere_points(radius: float) -> np.ndarray:
    # Great circles about the three axes hold the extremes along any axis of the frame.
    angles = 2 * math.pi * np.arange(_CIRCLE) / _CIRCLE
    ring = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(_CIRCLE)], axis=1)
    return np.concatenate([ring, ring[:, [0, 2, 1]], ring[:, [2, 0, 1]]])
