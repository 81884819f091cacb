"""A flipper that does not follow its commands."""

from __future__ import annotations

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


def flipper_place(flipper: Flipper) -> str:
    """Parameter of a flipper: ``front_left`` and the like."""
    return f"{flipper.end}_{'left' if flipper.joint[1] >= 0 else 'right'}"
