"""Attitude: how a robot leans, and the tilt of the plane that it drives on.

Angles are those of the vertical in the base frame, ``(sin pitch, sin roll)`` for small ones: no order of rotations, and
the same on every heading. What the robot keeps in its own axes (a tilted sensor, a load on one side) and what keeps to
the odometry frame (a plane that slopes, a localisation whose z axis is not against gravity) are separated by the
headings of the recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionTrack

_UP = np.array([0.0, 0.0, 1.0])
"""The vertical in the odometry frame."""
_MOST = 4000
"""Rotations that a fit takes from a recording at most."""
_PARTS = 16
"""Parts of a recording between which a lean varies: a few seconds of a minute, as the ground does."""
REPEATABILITY = np.radians(0.3)
"""Of a lean between drives [rad]: an accelerometer's bias of 5 mg, which an industrial IMU has after switching it on
again, tilts what it takes for the vertical by so much."""
_CERTAIN = 3.0
"""Standard deviations beyond which a change of the lean is reported."""
_PRIOR = 0.02
"""Weight of a prior against a lean in the robot's own axes, as a share of the data: where the robot hardly turns, all
of it is the plane's."""


@dataclass(frozen=True)
class Lean:
    """The lean of a recording, as the vertical in the base frame, forward and left."""

    own: np.ndarray
    """That it keeps in its own axes, ``[2]``."""
    plane: np.ndarray
    """Slope of the plane along x and y of the odometry frame, ``[2]``."""
    error: np.ndarray
    """Standard error of ``own``, as it varies over the recording, ``[2]``."""

    @classmethod
    def of(cls, rotations: np.ndarray) -> Lean:
        """Fit to rotation matrices ``[N, 3, 3]``, odometry ← base."""
        some = _some(rotations)
        up = vertical(some)
        rows = np.zeros((len(up), 2, 4))
        rows[:, 0, 0] = rows[:, 1, 1] = 1.0
        rows[:, :, 2:] = _heading_rows(some)
        matrix = rows.reshape(-1, 4)
        prior = np.diag([1.0, 1.0, 0.0, 0.0]) * _PRIOR * len(up) + 1e-9 * np.eye(4)
        normal, right = matrix.T @ matrix, matrix.T @ up.ravel()
        solution = np.linalg.solve(normal + prior, right)
        # Iterated Tikhonov regularisation: without the second step the prior keeps its share of a lean that is certain.
        solution += np.linalg.solve(normal + prior, right - normal @ solution)
        parts = np.array_split(up - rows[:, :, 2:] @ solution[2:], min(_PARTS, len(up)))
        means = np.array([part.mean(axis=0) for part in parts])
        error = means.std(axis=0, ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.full(2, np.inf)
        return cls(solution[:2], solution[2:], error)

    def of_plane(self, rotations: np.ndarray) -> np.ndarray:
        """The plane's part of the lean at each of the rotations ``[..., 3, 3]``, ``[..., 2]``."""
        return _heading_rows(rotations) @ self.plane

    @property
    def onto_plane(self) -> np.ndarray:
        """Rotation that makes the plane level, ``[3, 3]``."""
        normal = np.r_[-self.plane, 1.0]
        return _shortest(normal / np.linalg.norm(normal), _UP)

    @property
    def upright(self) -> np.ndarray:
        """Rotation from a base frame that stands upright to the one that is measured, ``[3, 3]``."""
        return _shortest(_UP, np.r_[self.own, np.sqrt(max(1.0 - float(self.own @ self.own), 0.0))])


def lean_of(motion: MotionTrack) -> Lean:
    """The lean of a motion."""
    return Lean.of(Rotation.from_quat(_some(motion.quaternions)).as_matrix())


def changed_lean(lean: Lean, commissioned: np.ndarray | None) -> str:
    """That a robot leans otherwise than when it was commissioned, in one sentence; empty where that is not certain.

    Args:
        lean: of a recording.
        commissioned: what it kept in its own axes then, ``[2]``; None if unknown.
    """
    if commissioned is None:
        return ""
    change = lean.own - commissioned
    # The error of one drive for each of both.
    certain = np.abs(change) > _CERTAIN * np.sqrt(2.0 * (lean.error**2 + REPEATABILITY**2))
    sides = []
    # In the base frame the vertical points backward where the nose is down, and to the right where the left side is.
    for axis, (positive, negative) in enumerate((("nose down", "nose up"), ("to the left", "to the right"))):
        if certain[axis]:
            sides.append(f"{np.degrees(abs(change[axis])):.1f}° {positive if change[axis] < 0 else negative}")
    if not sides:
        return ""
    return (
        f"compared with its commissioning the robot leans {' and '.join(sides)}: look for a load, a flat tyre, or a "
        "localisation sensor that was moved"
    )


def vertical(rotations: np.ndarray) -> np.ndarray:
    """The vertical in the base frame, forward and left, of rotations ``[..., 3, 3]``: minus pitch, and roll."""
    return rotations[..., 2, :2]


def _some(rotations: np.ndarray) -> np.ndarray:
    """Rotations of a recording at equal intervals, as many as a fit takes."""
    return rotations[:: max(1, len(rotations) // _MOST)]


def _shortest(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The smallest rotation ``[3, 3]`` between two unit vectors at an acute angle."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, float(start @ end))).as_matrix()


def _heading_rows(rotations: np.ndarray) -> np.ndarray:
    """Matrices ``[..., 2, 2]`` that turn a vector of the odometry frame into the headings of rotations."""
    heading = np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0])
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)], axis=-2)
