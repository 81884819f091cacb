"""Grid: size, resolution and origin of a map's cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Grid:
    """A regular grid, indexed ``[row = y, column = x]``; the reference point of a cell is its centre."""

    rows: int
    columns: int
    resolution: float
    """Edge length of a cell [m]."""
    origin: tuple[float, float]
    """x and y of the centre of cell (0, 0) [m]."""

    def __post_init__(self):
        if self.rows < 2 or self.columns < 2:
            raise ValueError(f"grid size: got {self.rows} × {self.columns} cells, expected at least 2 × 2")
        if self.rows * self.columns > 16_000_000:
            raise ValueError(f"grid size: got {self.rows} × {self.columns} cells, expected at most 16 million")
        if not 0 < self.resolution < 100:
            raise ValueError(f"grid resolution: got {self.resolution}, expected 0 to 100 m")

    @classmethod
    def square(cls, size: float = 12.8, resolution: float = 0.1) -> Grid:
        """A square grid of ``size`` metres about the origin."""
        cells = round(size / resolution)
        start = -(cells - 1) / 2 * resolution
        return cls(cells, cells, resolution, (start, start))

    @property
    def x(self) -> np.ndarray:
        """x of the columns' centres [m], ``[columns]``."""
        return self.origin[0] + self.resolution * np.arange(self.columns)

    @property
    def y(self) -> np.ndarray:
        """y of the rows' centres [m], ``[rows]``."""
        return self.origin[1] + self.resolution * np.arange(self.rows)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Outer edges of the outermost cells: left, right, bottom, top [m] (matplotlib's order)."""
        half = self.resolution / 2
        return self.x[0] - half, self.x[-1] + half, self.y[0] - half, self.y[-1] + half

    def cells(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row and column of the cell that contains each point ``[n, 2]``, and whether it lies on the grid."""
        # Column by column: over the short last axis every operation takes ten times as long.
        xy, (x, y) = np.asarray(xy), np.array(self.origin)
        columns, rows = np.rint((xy[..., 0] - x) / self.resolution), np.rint((xy[..., 1] - y) / self.resolution)
        inside = (columns >= 0) & (columns < self.columns) & (rows >= 0) & (rows < self.rows)
        return np.where(inside, rows, 0).astype(np.int64), np.where(inside, columns, 0).astype(np.int64), inside
