"""RecordedCamera: a camera on the robot with its frame, pose and settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from monoforce_ros.synthetic.sensors import CameraSettings


@dataclass(frozen=True)
class RecordedCamera:
    """A camera of which images are recorded.

    Attributes:
        frame: its optical frame.
        pose: ``[4, 4]``, base ← camera.
        settings: resolution, lens, rate and quality.
        imaging: what it does to a perfect image ``[height, width, 3]`` uint8; None for nothing.
    """

    frame: str
    pose: np.ndarray
    settings: CameraSettings
    imaging: Callable[[np.ndarray], np.ndarray] | None = None
