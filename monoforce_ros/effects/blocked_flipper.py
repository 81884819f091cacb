"""A flipper that does not follow its commands."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.robots import Flipper

_PLACES = ("front_left", "front_right", "rear_left", "rear_right")


class BlockedFlipper(Effect):
    """A flipper that does not follow its commands."""

    name = "blocked_flipper"
    stage = "command"
    summary = "A flipper loses a share of its commanded motion: at 1 it stays where it is."
    formula = "q ← q_0 + (1 - share) (q_cmd - q_0)"
    source = "blocked gear, slipping clutch or dead motor that its gear holds"
    cause = "a flipper that does not follow"
    remedy = "look at gear, clutch and motor of this flipper"
    joints_measure = True
    parameters = tuple(
        Parameter(
            place, "-", 0.0, 0.0, 1.0, 0.5, f"lost share of the {place.replace('_', ' ')} flipper", attainable=True
        )
        for place in _PLACES
    )
    order = 75
    needs = "flippers"
    identified = _PLACES
    manoeuvre = "each flipper moved alone while driving and turning"

    def flipper_angles(self, targets: Tensor, start: Tensor, values: Values, flippers: tuple[Flipper, ...]) -> Tensor:
        """Targets with this effect applied; see :class:`Effect`."""
        lost = torch.stack([values[flipper_place(flipper)].expand(len(targets)) for flipper in flippers], dim=-1)
        return targets - lost[:, None] * (targets - start[:, None])

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        lost = [
            f"the {place.replace('_', ' ')} one {100 * share:.0f} %" for place, share in values.items() if share > 0.0
        ]
        return f"Flippers lose a part of their commanded motion: {', '.join(lost)}."


def flipper_place(flipper: Flipper) -> str:
    """Parameter of a flipper: ``front_left`` and the like."""
    return f"{flipper.end}_{'left' if flipper.joint[1] >= 0 else 'right'}"
