"""Sensors: frames of cameras, lidars and IMUs, by their names."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.robots.sensor_names import CAMERA, IMU, LIDAR, OPTICAL
from monoforce_ros.robots.urdf.geometry import Frames

_KINDS = {"camera": OPTICAL, "lidar": LIDAR, "imu": IMU}


def find_sensors(frames: Frames) -> tuple[dict[str, dict], list[str]]:
    """Sensor entries of the robot file by frame, and what was guessed.

    A frame counts if no frame below it is of the same kind: ``velodyne`` rather than ``velodyne_base_link``.
    """
    description = frames.description
    entries: dict[str, dict] = {}
    notes: list[str] = []
    for kind, pattern in _KINDS.items():
        for name in description.links:
            if not pattern.search(name):
                continue
            below = list(description.subtree(name))[1:]
            if any(pattern.search(other) for other in below):
                continue
            entries[name] = _entry(frames.link(name))
            notes.append(f"{kind} {name}: by its name")
    for name in description.links:
        below = list(description.subtree(name))
        if CAMERA.search(name) and not any(_KINDS["camera"].search(other) for other in below):
            parent = description.parent_joint(name)
            if parent is None or not CAMERA.search(parent.parent):
                notes.append(
                    f"camera {name}: left out, it has no optical frame (z forward, y down); add one to `sensors`"
                )
    if not any(_KINDS[kind].search(name) for kind in ("camera", "lidar") for name in entries):
        notes.append("no camera or lidar: no frame has the name of one; add them to `sensors`")
    return entries, notes


def _entry(pose: np.ndarray) -> dict:
    rotation = Rotation.from_matrix(pose[:3, :3])
    quaternion = rotation.as_quat()
    return {
        "translation": [round(float(value), 5) + 0.0 for value in pose[:3, 3]],
        "quaternion": [round(float(value), 7) + 0.0 for value in quaternion],
    }
