"""Differentiable robot–terrain physics (paper III-B to III-E)."""

from monoforce_ros.physics.identity_cache import IdentityCache
from monoforce_ros.physics.lookup import TerrainLookup
from monoforce_ros.physics.neural_ode import OdeOptions
from monoforce_ros.physics.options import PhysicsOptions
from monoforce_ros.physics.rest import rest_depth
from monoforce_ros.physics.rollout import rollout
from monoforce_ros.physics.soil import SOILS, Soil, SoilError, read_soil
from monoforce_ros.physics.state import Rollout, State

__all__ = [
    "SOILS",
    "IdentityCache",
    "OdeOptions",
    "PhysicsOptions",
    "Rollout",
    "Soil",
    "SoilError",
    "State",
    "TerrainLookup",
    "read_soil",
    "rest_depth",
    "rollout",
]
