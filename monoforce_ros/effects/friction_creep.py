"""Creep of a robot that friction holds: the slip at which dry friction is mobilised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.sentences import percent_change
from monoforce_ros.effects.setup import Setup


class FrictionCreep(Effect):
    """Creep of a robot that friction holds: the slip at which dry friction is mobilised.

    Friction below its limit costs slip. Rubber on asphalt and rigid contacts hold a robot that its motors cannot turn;
    loose ground and soft treads let it creep. Where a turn begins against the scrub of the tyres this decides whether
    the robot stands or moves. It is a property of robot and ground that commissioning fits, and no fault: diagnoses do
    not look for it.
    """

    name = "friction_creep"
    stage = "contact"
    summary = "Friction is mobilised at another slip: the robot creeps more or less against friction that holds it."
    formula = "f = -N diag(μ) s / sqrt(|s|² + (factor ε)²), with slip s and ε the physics' slip regularisation"
    source = "regularised Coulomb friction (paper III-D); its slip is chosen for computing, a robot has its own"
    cause = "creeping against friction"
    remedy = "nothing is to be done: it is a property of tyres and ground"
    # Down to 1 mm/s, where friction is rigid for any robot; up to 0.1 m/s, a tenth of a slow robot's speed.
    parameters = (Parameter("factor", "-", 1.0, 0.05, 5.0, 1.0, "slip at 71 % of full friction, over 0.02 m/s"),)
    commissioning_start: ClassVar = {"factor": 1.0}
    like_a_slope = False

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads = setup.loads
        return replace(setup, loads=replace(loads, friction_creep=loads.friction_creep * values["factor"]))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"Where friction holds the robot, it creeps {percent_change(values['factor'], 'less', 'more')} "
            "than assumed."
        )
