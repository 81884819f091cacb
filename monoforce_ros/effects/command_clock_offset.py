"""Commands stamped too late or too early."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from monoforce_ros.core import CommandTrack
from monoforce_ros.effects.effect import Effect, Parameter
from monoforce_ros.effects.sentences import clock_sentence
from monoforce_ros.robots import RobotModel


class CommandClockOffset(Effect):
    """Commands stamped too late or too early."""

    name = "command_clock_offset"
    stage = "measurement"
    summary = "The clock that stamps commands is ahead by the offset."
    formula = "stamp ← stamp + offset"
    source = "unsynchronised clocks"
    cause = "a wrong command clock"
    remedy = "synchronise the clocks of planner and base"
    # Commands are held between stamps: an offset of less than some steps of a rollout may change nothing.
    parameters = (Parameter("offset", "s", 0.0, -2.0, 2.0, 0.2, "recorded minus true time", resolution=0.03),)
    identified = ("offset",)
    manoeuvre = "stops and starts"
    shifts = "offset"
    shifts_cycle = True
    separated_by_sensor: ClassVar = {
        "pose_clock_offset": "record an IMU: its gyro shows whether the poses or the base are late"
    }

    def first_values(self, robot: RobotModel) -> list[dict[str, float]]:
        """Early and late commands: a late base is a delay as well, an early one only this."""
        return [{"offset": value} for value in (-0.2, 0.1, 0.3)]

    def commands(self, commands: CommandTrack, values: Mapping[str, float]) -> CommandTrack:
        """Commands as recorded under this effect."""
        return replace(commands, stamps=commands.stamps + round(values["offset"] * 1e9))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return clock_sentence("The commands", values["offset"])
