"""Files: a terrain map and its pose as an ``.npz`` archive of numeric arrays."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import torch

from monoforce_ros.core import atomic_path
from monoforce_ros.terrain.grid import Grid
from monoforce_ros.terrain.terrain_map import CHANNELS, TerrainMap

_LARGEST_FILE = 2_000_000_000


class TerrainFileError(ValueError):
    """The file is not a valid terrain map; the message gives the reason."""


def save_terrain(
    path: str | Path, terrain: TerrainMap, odometry_from_terrain: np.ndarray | None = None, **extra: np.ndarray
) -> Path:
    """Write a single map.

    Args:
        path: path of the file; it appears once it is complete.
        terrain: a single map, not a batch.
        odometry_from_terrain: pose ``[4, 4]`` of the map's frame; the identity unless given.
        extra: further arrays to store.
    """
    if terrain.batch_size is not None:
        raise ValueError(f"terrain: got a batch of {terrain.batch_size} maps, expected one")
    path = Path(path)
    content = {name: getattr(terrain, name).detach().cpu().numpy() for name in (*CHANNELS, "observed")}
    content["resolution"] = np.array(terrain.grid.resolution)
    content["origin"] = np.array(terrain.grid.origin)
    content["odometry_from_terrain"] = np.eye(4) if odometry_from_terrain is None else odometry_from_terrain
    with atomic_path(path) as unfinished, unfinished.open("wb") as file:
        # The stubs take every keyword for `allow_pickle`.
        np.savez_compressed(file, **content, **extra)  # type: ignore[arg-type]
    return path


def load_terrain(path: str | Path) -> tuple[TerrainMap, np.ndarray]:
    """Read a map and the pose ``[4, 4]`` of its frame in the odometry frame.

    Raises:
        TerrainFileError: the file is missing, too large, damaged, or contains no map.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _LARGEST_FILE:
            raise TerrainFileError(f"{path}: contains {size} bytes, expected at most {_LARGEST_FILE}")
        with np.load(path, allow_pickle=False) as content:
            missing = {*CHANNELS, "observed", "resolution", "origin"} - set(content.files)
            if missing:
                raise TerrainFileError(f"{path}: got no {', '.join(sorted(missing))}; was it written by fit_terrain?")
            arrays = {name: torch.from_numpy(content[name].astype(np.float32)) for name in CHANNELS}
            observed = torch.from_numpy(content["observed"].astype(bool))
            rows, columns = arrays["height"].shape
            origin = content["origin"].astype(float)
            grid = Grid(rows, columns, float(content["resolution"]), (float(origin[0]), float(origin[1])))
            pose = content["odometry_from_terrain"] if "odometry_from_terrain" in content.files else np.eye(4)
            if pose.shape != (4, 4) or not np.isfinite(pose).all():
                raise TerrainFileError(f"{path}: odometry_from_terrain: expected a finite 4 × 4 matrix")
            return TerrainMap(**arrays, observed=observed, grid=grid), pose.astype(np.float64)
    except TerrainFileError:
        raise
    except (OSError, ValueError, KeyError, IndexError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise TerrainFileError(f"{path}: not a terrain map: {error}") from error
