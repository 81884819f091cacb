"""Drives that lose speed under their load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.effects.effect import Effect, Parameter, Values
from monoforce_ros.effects.setup import Setup


class DriveCompliance(Effect):
    """Drives that lose speed under their load.

    A speed controller without integral action, or motors that are driven by their voltage, lose speed in proportion to
    their torque. Between command and ground this loss is in series with the slip of the tyre.
    """

    name = "drive_compliance"
    stage = "contact"
    summary = "Each drive loses speed in proportion to its traction."
    formula = "u ← u - c f / N, with traction f, and load N of the wheel on the robot of the file"
    source = "speed-torque line of a motor without integral control"
    cause = "drives that give way under load"
    remedy = "give the motor controllers an integral part, or a larger gain"
    # Typical: a drive that loses 0.1 m/s at the limit of friction on average ground.
    parameters = (
        Parameter(
            "speed_loss",
            "m/s",
            0.0,
            0.0,
            2.0,
            0.2,
            "speed lost when a wheel pulls with as much as its load, of the robot without payload",
        ),
    )
    identified = ("speed_loss",)
    manoeuvre = "turns on the spot, hard starts, and slow and fast stretches straight ahead"
    separated_by: ClassVar = {
        "turning_scrub": "slow and fast turns on the spot, with measured wheel speeds",
        "drive_gain": "slow and fast stretches straight ahead",
    }
    commissioning_start: ClassVar = {"speed_loss": 0.05}

    def setup(self, setup: Setup, values: Values) -> Setup:
        """The setup with this effect applied."""
        loads, loss = setup.loads, values["speed_loss"]
        found = loss if loads.drive_compliance is None else loads.drive_compliance + loss
        return replace(setup, loads=replace(loads, drive_compliance=found))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return (
            "The drives give way: a wheel that pulls with as much as its load runs "
            f"{values['speed_loss']:.2f} m/s slower."
        )
