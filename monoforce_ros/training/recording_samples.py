"""RecordingSamples: the training samples of a recording (images, target maps, motion), and the files with them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from monoforce_ros.core import CameraModel, atomic_path
from monoforce_ros.terrain import Grid

CHUNK = 1.0
"""Length of the chunks of motion in the trajectory loss [s]."""
SAMPLES_VERSION = 2
MAXIMUM_BYTES = 20_000_000_000
_SEGMENT_ARRAYS = ("odometry_from_map", "geometric", "observed", "supporting", "contact_mask", "friction")
_SAMPLE_ARRAYS = (
    "stamps", "odometry_from_base", "odometry_from_cameras", "support", "sweeps", "sweep_ends", "traces", "trace_ends",
    "segment_of",
)  # fmt: skip
_OLD_NAMES = {"felt": "contact_mask"}
"""Names of arrays in files of earlier releases, which can still be read."""


class SamplesError(ValueError):
    """A recording yields no samples, or a sample file is unusable; the message gives the reason."""


@dataclass(frozen=True)
class Segment:
    """Visible and supporting terrain along a trajectory of ten seconds."""

    grid: Grid
    odometry_from_map: np.ndarray
    """Pose ``[4, 4]`` of the maps."""
    geometric: np.ndarray
    """H_g* ``[rows, columns]`` [m]."""
    observed: np.ndarray
    """Cells measured by the lidar (bool)."""
    supporting: np.ndarray
    """H_t* [m]."""
    contact_mask: np.ndarray
    """Cells that wheels or tracks touched (bool), where H_t* is known."""
    friction: np.ndarray
    """Friction relative to ordinary ground [-], where it is known; NaN elsewhere."""


@dataclass(frozen=True)
class Chunks:
    """Chunks of motion of one second in the odometry frame."""

    stamps: np.ndarray
    """Of the starts ``[W]`` [ns]."""
    times: np.ndarray
    """Of the poses, relative to the start ``[K]`` [s]."""
    positions: np.ndarray
    """``[W, K, 3]`` [m]."""
    rotations: np.ndarray
    """``[W, K, 3, 3]``."""
    velocities: np.ndarray
    """At the start, in base axes ``[W, 3]`` [m/s]."""
    angular_velocities: np.ndarray
    """At the start, in base axes ``[W, 3]`` [rad/s]."""
    twists: np.ndarray
    """Commands ``[W, history + T, 2]`` [m/s, rad/s]."""
    history: int
    """Number of commands before the start."""


@dataclass(frozen=True)
class RecordingSamples:
    """The samples of one recording."""

    name: str
    cameras: tuple[CameraModel, ...]
    images: torch.Tensor
    """RGB uint8 ``[N, cameras, height, width, 3]`` at the network's size."""
    stamps: np.ndarray
    """``[N]`` [ns]."""
    odometry_from_base: np.ndarray
    """``[N, 4, 4]``."""
    odometry_from_cameras: np.ndarray
    """Camera poses at the stamps of their images ``[N, cameras, 4, 4]``; NaN where a sample lacks a camera's image."""
    support: np.ndarray
    """Contact points of the wheels in the odometry frame ``[N, m, 3]`` [m]."""
    sweeps: np.ndarray
    """Concatenated points of the lidar sweep nearest to each image, in the odometry frame ``[p, 3]`` [m]."""
    sweep_ends: np.ndarray
    """End of each sample's points in ``sweeps`` ``[N]``."""
    traces: np.ndarray
    """Concatenated points of the ground that the robot drove over before each image, in the odometry frame ``[q, 3]``
    [m]."""
    trace_ends: np.ndarray
    """End of each sample's points in ``traces`` ``[N]``."""
    segment_of: np.ndarray
    """Index of each sample's segment ``[N]``."""
    segments: tuple[Segment, ...]
    chunks: Chunks
    file: Path | None = None
    """File from which they were read."""

    def __len__(self) -> int:
        return len(self.stamps)

    def sweep(self, index: int) -> np.ndarray:
        """Points ``[n, 3]`` of a sample's sweep in the odometry frame [m]; empty without a lidar."""
        return _part(self.sweeps, self.sweep_ends, index)

    def trace(self, index: int) -> np.ndarray:
        """Ground that the robot drove over before a sample ``[n, 3]``, in the odometry frame [m]."""
        return _part(self.traces, self.trace_ends, index)

    def subset(self, indices: Sequence[int]) -> RecordingSamples:
        """Some of the samples; segments and motion stay."""
        chosen = np.asarray(indices, np.int64)
        sweeps, traces = ([own(int(i)) for i in chosen] for own in (self.sweep, self.trace))
        return replace(
            self,
            file=None,
            images=self.images[chosen],
            **{name: getattr(self, name)[chosen] for name in _OF_EACH},
            sweeps=np.concatenate(sweeps) if sweeps else self.sweeps[:0],
            sweep_ends=np.cumsum([len(points) for points in sweeps], dtype=np.int64),
            traces=np.concatenate(traces) if traces else self.traces[:0],
            trace_ends=np.cumsum([len(points) for points in traces], dtype=np.int64),
        )


_OF_EACH = ("stamps", "odometry_from_base", "odometry_from_cameras", "support", "segment_of")


def _part(points: np.ndarray, ends: np.ndarray, index: int) -> np.ndarray:
    return points[ends[index - 1] if index else 0 : ends[index]]


def save_samples(samples: RecordingSamples, file: Path) -> None:
    """Write a file of samples; it appears complete or not at all."""
    arrays = {name: getattr(samples, name) for name in _SAMPLE_ARRAYS}
    arrays |= {f"chunks.{f.name}": getattr(samples.chunks, f.name) for f in fields(Chunks) if f.name != "history"}
    for i, segment in enumerate(samples.segments):
        arrays |= {f"segment{i}.{name}": getattr(segment, name) for name in _SEGMENT_ARRAYS}
    tensors = {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}
    description = {
        "version": SAMPLES_VERSION,
        "name": samples.name,
        "history": samples.chunks.history,
        "grids": [asdict(segment.grid) for segment in samples.segments],
        "cameras": [
            {
                "width": camera.width, "height": camera.height, "matrix": camera.matrix.tolist(),
                "distortion": camera.distortion.tolist(), "distortion_model": camera.distortion_model,
            }
            for camera in samples.cameras
        ],
    }  # fmt: skip
    with atomic_path(file) as unfinished:
        save_file({**tensors, "images": samples.images}, str(unfinished), metadata={"samples": json.dumps(description)})


def read_samples(file: Path) -> RecordingSamples:
    """Read a file of samples.

    Raises:
        SamplesError: the file is damaged, too large or of another version.
    """
    if file.stat().st_size > MAXIMUM_BYTES:
        raise SamplesError(f"{file}: got {file.stat().st_size} bytes, expected at most {MAXIMUM_BYTES}")
    try:
        with safe_open(str(file), framework="pt") as content:
            description = json.loads((content.metadata() or {}).get("samples", "{}"))
            if description.get("version") != SAMPLES_VERSION:
                raise SamplesError(
                    f"{file}: not a file of samples of version {SAMPLES_VERSION}; delete it to recreate it"
                )
            tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118  (not a dict)
        values = _renamed({name: tensor.numpy() for name, tensor in tensors.items()}, file)
        segments = tuple(
            Segment(
                Grid(**{**entry, "origin": tuple(entry["origin"])}),
                *(values[f"segment{i}.{name}"] for name in _SEGMENT_ARRAYS),
            )
            for i, entry in enumerate(description["grids"])
        )
        chunks = {name.partition(".")[2]: value for name, value in values.items() if name.startswith("chunks.")}
        return RecordingSamples(
            name=description["name"],
            cameras=tuple(
                CameraModel(
                    entry["width"],
                    entry["height"],
                    np.array(entry["matrix"]),
                    np.array(entry["distortion"]),
                    entry["distortion_model"],
                )
                for entry in description["cameras"]
            ),
            images=tensors["images"],
            segments=segments,
            chunks=Chunks(**chunks, history=description["history"]),
            file=file,
            **{name: values[name] for name in _SAMPLE_ARRAYS},
        )
    except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        if isinstance(error, SamplesError):
            raise
        raise SamplesError(f"{file}: damaged ({error}); delete it to recreate it") from error


def _renamed(values: dict[str, np.ndarray], file: Path) -> dict[str, np.ndarray]:
    """Arrays of a file under their present names, with one warning if the file has old ones."""
    renamed, found = {}, set()
    for name, value in values.items():
        prefix, dot, last = name.rpartition(".")
        if last in _OLD_NAMES:
            found.add(last)
        renamed[f"{prefix}{dot}{_OLD_NAMES.get(last, last)}"] = value
    if found:
        text = ", ".join(f"{old!r} is now {_OLD_NAMES[old]!r}" for old in sorted(found))
        warnings.warn(f"{file}: {text}; delete the file to recreate it", FutureWarning, stacklevel=3)
    return renamed
