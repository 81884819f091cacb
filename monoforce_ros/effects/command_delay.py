"""Dead time between a command and the drives' answer."""

from __future__ import annotations

import torch
from torch import Tensor

from monoforce_ros.effects.effect import Effect, Parameter, Values


class CommandDelay(Effect):
    """Dead time between a command and the drives' answer."""

    name = "command_delay"
    stage = "command"
    summary = "The drives follow each command later by a fixed time."
    formula = "u(t) ← u(t - delay), linear between steps"
    source = "communication and controller latency"
    parameters = (Parameter("delay", "s", 0.0, 0.0, 2.0, 0.2, "dead time"),)

    def drive_speeds(self, speeds: Tensor, values: Values, time_step: float, offsets: Tensor) -> Tensor:
        """Drive speeds with this effect in them; see :class:`Effect`."""
        count = speeds.shape[1]
        # Before the first command there is none to delay: it is taken to have held.
        place = torch.arange(count, dtype=speeds.dtype, device=speeds.device) - values["delay"][..., None] / time_step
        place = place.clamp_min(0.0)
        index = place.detach().floor().long().clamp_max(count - 1)
        fraction = place - index
        following = (index + 1).clamp_max(count - 1)
        if place.ndim == 1:
            before, after = speeds[:, index], speeds[:, following]
            return before + fraction[:, None] * (after - before)
        before, after = (speeds.gather(1, i[..., None].expand_as(speeds)) for i in (index, following))
        return before + fraction[..., None] * (after - before)
