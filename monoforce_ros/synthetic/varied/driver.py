"""Driver: follows the track of a randomised world at drawn speeds."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from monoforce_ros.synthetic.command_profile import WanderingDriver
from monoforce_ros.synthetic.route import Route

_FASTEST = 1.2


class VariedDriver(WanderingDriver):
    """Follows the route with drawn speeds.

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
