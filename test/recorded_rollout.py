"""A rollout as a recording of exact poses."""

import numpy as np
from scipy.spatial.transform import Rotation

from monoforce_ros.core import MotionTrack
from monoforce_ros.physics import Rollout


def recorded(result: Rollout, first: int = 0) -> MotionTrack:
    """Motion of the first trajectory of a rollout in steps of 10 ms, at 20 Hz.

    Args:
        result: the rollout.
        first: stamp of its first state [ns].
    """
    rotations = Rotation.from_matrix(result.rotation[0, ::5].double().numpy())
    return MotionTrack(
        stamps=first + np.arange(len(rotations), dtype=np.int64) * 50_000_000,
        positions=result.position[0, ::5].double().numpy(),
        quaternions=rotations.as_quat(),
        linear_velocities=rotations.inv().apply(result.velocity[0, ::5].double().numpy()),
        angular_velocities=rotations.inv().apply(result.angular_velocity[0, ::5].double().numpy()),
    )
