"""Planning: candidate commands, their costs and feasibility, occupancy, cost-to-go, and selection."""

from typing import TYPE_CHECKING

from monoforce_ros.core import lazy_exports

if TYPE_CHECKING:
    from monoforce_ros.planning.candidates import CandidateSettings, fan_of_arcs, over_horizon
    from monoforce_ros.planning.costs import TERMS, Assessment, CostWeights, Limits, assess, force_every
    from monoforce_ros.planning.goal_planner import CostToGo, cost_to_go
    from monoforce_ros.planning.occupancy_grid import AlignedGrid, Occupancy, occupancy, speed_mask
    from monoforce_ros.planning.plan_follower import plan_target
    from monoforce_ros.planning.refinement import Refinement, refine
    from monoforce_ros.planning.selection import COMMAND_FIELDS, WAYPOINTS, SelectionWeights, select_candidate
else:
    __getattr__ = lazy_exports(
        __name__,
        {
            "candidates": (
                "CandidateSettings",
                "fan_of_arcs",
                "over_horizon",
            ),
            "costs": (
                "Assessment",
                "CostWeights",
                "Limits",
                "TERMS",
                "assess",
                "force_every",
            ),
            "goal_planner": (
                "CostToGo",
                "cost_to_go",
            ),
            "occupancy_grid": (
                "AlignedGrid",
                "speed_mask",
                "Occupancy",
                "occupancy",
            ),
            "plan_follower": ("plan_target",),
            "refinement": (
                "Refinement",
                "refine",
            ),
            "selection": (
                "COMMAND_FIELDS",
                "SelectionWeights",
                "WAYPOINTS",
                "select_candidate",
            ),
        },
    )

__all__ = [
    "COMMAND_FIELDS",
    "TERMS",
    "WAYPOINTS",
    "AlignedGrid",
    "Assessment",
    "CandidateSettings",
    "CostToGo",
    "CostWeights",
    "Limits",
    "Occupancy",
    "Refinement",
    "SelectionWeights",
    "assess",
    "cost_to_go",
    "fan_of_arcs",
    "force_every",
    "occupancy",
    "over_horizon",
    "plan_target",
    "refine",
    "select_candidate",
    "speed_mask",
]
