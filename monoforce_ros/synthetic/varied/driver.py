"""Driver: follows the track of a randomised world, and frees itself where something stops it."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np

from monoforce_ros.synthetic.command_profile import WanderingDriver
from monoforce_ros.synthetic.route import Route

_FASTEST = 1.2
_STUCK_TIME, _STUCK_DISTANCE = 2.5, 0.12
_SKIPPED = 2.5
_BACK_TIME = (1.2, 2.5)


class VariedDriver(WanderingDriver):
    """Follows the route with drawn speeds; after an obstacle has stopped the robot, it reverses and goes around.

    Args:
        route: path to follow.
        drawn: drawn values of :class:`monoforce_ros.synthetic.varied.settings.RouteSettings`.
        maximum_speed: of the robot [m/s].
        random: draws speeds and deviations from the route.
    """

    def __init__(self, route: Route, drawn: SimpleNamespace, maximum_speed: float, random: np.random.Generator):
        super().__init__(route, random)
        limit = min(maximum_speed, _FASTEST)
        self._SLOWEST, self._FASTEST, self._SWAY = drawn.slowest * limit, drawn.fastest * limit, drawn.sway
        self._place, self._since = np.zeros(2), 0.0
        self._until, self._turn = -math.inf, 0.0

    def command(self, time: float, position: np.ndarray, heading: float) -> tuple[float, float]:
        """The command at ``time``, continued from the previous call."""
        speed, yaw_rate = super().command(time, position, heading)
        if time < self._until:
            return -0.6 * self._FASTEST, self._turn
        moved = float(np.linalg.norm(position - self._place))
        if moved > _STUCK_DISTANCE:
            self._place, self._since = position.copy(), time
        elif time - self._since > _STUCK_TIME:
            self._until = time + self._random.uniform(*_BACK_TIME)
            self._turn = float(self._random.choice([-1.0, 1.0])) * self._random.uniform(0.2, 0.9)
            self._station += _SKIPPED
            self._place, self._since = position.copy(), self._until
        return speed, yaw_rate
