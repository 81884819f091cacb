"""Warp kernels of the rollout, one per file: motion, forces on each point, and their sums over the body."""

from monoforce_ros.physics.warp_kernels.contact import COULOMB, NO_FRICTION, SIGMOID
from monoforce_ros.physics.warp_kernels.forces import forces_kernel
from monoforce_ros.physics.warp_kernels.forces_joints import forces_joints_kernel
from monoforce_ros.physics.warp_kernels.integrate import integrate_kernel
from monoforce_ros.physics.warp_kernels.integrate_joints import integrate_joints_kernel
from monoforce_ros.physics.warp_kernels.joints import joint_functions
from monoforce_ros.physics.warp_kernels.loads import external_loads
from monoforce_ros.physics.warp_kernels.structs import Types, types
from monoforce_ros.physics.warp_kernels.summarise import summarise_kernel

__all__ = [
    "COULOMB",
    "NO_FRICTION",
    "SIGMOID",
    "Types",
    "external_loads",
    "forces_joints_kernel",
    "forces_kernel",
    "integrate_joints_kernel",
    "integrate_kernel",
    "joint_functions",
    "summarise_kernel",
    "types",
]
