"""Poses stamped too late or too early."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from monoforce_ros.core import MotionTrack
from monoforce_ros.effects.effect import Effect, Parameter
from monoforce_ros.effects.sentences import clock_sentence


class PoseClockOffset(Effect):
    """Poses stamped too late or too early."""

    name = "pose_clock_offset"
    stage = "measurement"
    summary = "The clock that stamps poses is ahead by the offset."
    formula = "stamp ← stamp + offset"
    source = "unsynchronised clocks, filter delay"
    cause = "late poses"
    remedy = "correct the stamps of the localisation, or synchronise its clock"
    parameters = (Parameter("offset", "s", 0.0, -2.0, 2.0, 0.2, "recorded minus true time"),)
    identified = ("offset",)
    manoeuvre = "stops and starts"
    shifts = "offset"
    gyro_measures = "offset"

    def motion(self, motion: MotionTrack, values: Mapping[str, float]) -> MotionTrack:
        """Motion as recorded under this effect."""
        return replace(motion, stamps=motion.stamps + round(values["offset"] * 1e9))

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it means for the robot; see :class:`Effect`."""
        return clock_sentence("The poses", values["offset"])
