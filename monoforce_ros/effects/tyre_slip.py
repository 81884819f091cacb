"""Tyres that slip in proportion to the force they carry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup
from monoforce_ros.robots import RobotModel


class TyreSlip(Effect):
    """Tyres that slip in proportion to the force they carry.

    The tread of a rolling tyre deforms on its way through the contact, and slides only where the deformation exceeds
    what friction holds. A force below the limit of friction therefore costs slip in proportion to the rolling speed,
    along and across alike: a fast robot turns nearly as it does at walking speed. Coulomb's law alone lets it turn
    further, because tyres that scrub hold little sideways.
    """

    name = "tyre_slip"
    stage = "contact"
    summary = "Friction is mobilised in proportion to slip over rolling speed, as on pneumatic tyres."
    formula = "f = -N diag(μ) s / sqrt(|s|² + ε² + (κ u)²), with slip s and rolling speed u"
    source = "slip stiffness of rolling tyres (Pacejka 2012, brush model)"
    cause = "tyres that give way"
    remedy = "look at the tyres' pressure and tread; plan fast turns with the new robot file"
    # Cornering stiffness of off-road tyres: 2 to 10 times the load per radian, κ of 0.4 to 0.08 at a friction of 0.8.
    parameters = (Parameter("ratio", "-", 0.0, 0.0, 2.0, 0.2, "slip over rolling speed at 71 % of full friction"),)
    identified = ("ratio",)
    like_a_slope = False
    manoeuvre = "wide turns at slow and high speed"
    separated_by: ClassVar = {
        "friction_scale": "hard braking on a straight, and turns at slow and high speed",
        "friction_anisotropy": "wide turns at slow and high speed",
        "turning_scrub": "wide turns at slow and high speed",
        "drive_compliance": "wide turns at high speed, with measured wheel speeds",
    }

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """From road tyres to soft ones at low pressure; close to none its influence vanishes with its square."""
        return [{"ratio": 0.1}, {"ratio": 0.4}]

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads, ratio = setup.loads, values["ratio"]
        found = ratio if loads.tyre_slip is None else loads.tyre_slip + ratio
        return replace(setup, loads=replace(loads, tyre_slip=found))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            f"The tyres give way: rolling with {100 * values['ratio']:.0f} % of slip they have 71 % of the "
            "grip that the ground "
            "offers."
        )
