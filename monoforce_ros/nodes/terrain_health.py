"""Terrain on /diagnostics: how an encoder's predictions agreed with the ground that the robot then drove over."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

from monoforce_ros.nodes.health import OK, STALE, WARN, Health
from monoforce_ros.perception import TerrainSource, TrustedTerrain, TrustReport

PART, SWEEP_PART = "terrain", "terrain from the sweep alone"
"""Of the source, and of what ``lidar_camera`` uses as far as images are not trusted."""

_ADAPTED = Path("adapted/encoder.safetensors")
"""Where the encoder is after the command that adapts it."""


class TerrainHealth:
    """Reports the trust in a terrain source's encoder, where it has one and falls back.

    Args:
        health: receives the reports.
        source: of the predictions.
        robot: the robot as the user named it.
        checkpoint: the encoder as the user named it; empty for the shipped one.
    """

    def __init__(self, health: Health, source: TerrainSource, robot: str, checkpoint: str):
        self._health, self._robot, self._checkpoint = health, robot, checkpoint
        self._source = source if isinstance(source, TrustedTerrain) else None
        self._swept = False

    def report(self) -> None:
        """Report the comparisons up to the last map."""
        if self._source is None or self._source.report is None:
            return
        report = self._source.report
        if "camera" in report.sensors:
            remedy = f"adapt the encoder to this robot and start with checkpoint:={_ADAPTED}: {self.adaptation}"
            report = replace(report, remedy=remedy)
        self._report(PART, report)
        below = self._source.fallback_report
        if below is not None:
            self._report(SWEEP_PART, below)
            self._swept = True
        elif self._swept:
            self._health.report_anew(SWEEP_PART, STALE, "no usable sweep in the last map", {}, reason="no sweep")

    @property
    def adaptation(self) -> str:
        """The command that adapts the encoder to this robot, as a shell takes it."""
        start = ["--start-from", self._checkpoint] if self._checkpoint else []
        robot = ["--robot", self._robot]
        out = ["--out", str(_ADAPTED.parent)]
        return shlex.join(["ros2", "run", "monoforce_ros", "train", "--adapt", "BAG", *robot, *start, *out])

    def _report(self, part: str, report: TrustReport) -> None:
        values = _values(report)
        if report.trusted:
            self._health.report_anew(part, OK, report.explanation, values, reason="trusted")
        else:
            text = f"falling back, the encoder is not used: {report.explanation}"
            self._health.report_anew(part, WARN, text, values, reason="not trusted")


def _values(report: TrustReport) -> dict[str, str]:
    """Figures of a report; errors are means, with those of level ground at the same places in parentheses."""

    def errors(own: float, level: float) -> str:
        return f"{100 * own:.1f} ({100 * level:.1f})"

    compared = {"": (report.error, report.level_error)} if report.travelled else {}
    if report.by_lidar is not None:
        compared[" of the visible surface, lidar"] = report.by_lidar
    compared |= {f", {name}": pair for name, pair in (*report.by_distance.items(), *report.by_camera.items())}
    return {
        "sensors": ", ".join(report.sensors),
        "used of what the encoder adds [%]": f"{100 * report.share:.0f}",
        "compared over [m]": f"{report.travelled:.1f}",
        "error under the wheels [cm]": f"{100 * report.start_error:.1f}",
        **{f"error{name} [cm] (level ground)": errors(*pair) for name, pair in compared.items()},
    }
