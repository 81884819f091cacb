"""What a robot needs to choose among assessed candidates: the way to a goal, and which candidate follows it best.

Nothing here needs more than NumPy and SciPy: who only chooses need not load a physics engine.
"""

from monoforce_ros.steering.choice import ChoiceWeights, choose
from monoforce_ros.steering.way_to_goal import WayToGoal, way_to_goal

__all__ = ["ChoiceWeights", "WayToGoal", "choose", "way_to_goal"]
