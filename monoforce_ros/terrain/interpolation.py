"""Interpolation: values of a map between the centres of its cells."""

from __future__ import annotations

import cv2
import numpy as np


def interpolated(values: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Values ``[H, W]`` at fractional columns and rows ``[h, w, 2]``, bilinear; beyond the map they fade to 0."""
    columns, rows = np.moveaxis(cells.astype(np.float32), -1, 0)
    return cv2.remap(
        values.astype(np.float32), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0
    )
