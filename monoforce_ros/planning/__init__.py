"""What a planner needs: candidate commands, what each would cost the robot, and where it can drive at all."""

from monoforce_ros.planning.candidates import CandidateSettings, fan_of_arcs
from monoforce_ros.planning.costs import Assessment, CostWeights, Limits, assess
from monoforce_ros.planning.occupancy import Occupancy, occupancy
from monoforce_ros.planning.refine import Refinement, refine

__all__ = [
    "Assessment",
    "CandidateSettings",
    "CostWeights",
    "Limits",
    "Occupancy",
    "Refinement",
    "assess",
    "fan_of_arcs",
    "occupancy",
    "refine",
]
