"""Export: identified effects as files for other tools, each value with its confidence interval.

What a tool has no parameter for is said in its file and returned, never dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from monoforce_ros.core import write_text
from monoforce_ros.discrepancy.credibility import complaint
from monoforce_ros.discrepancy.estimates import EffectEstimate, ParameterEstimate
from monoforce_ros.discrepancy.mujoco_export import mujoco_files
from monoforce_ros.discrepancy.ros_export import controller_text, nav2_text
from monoforce_ros.effects import CATALOGUE
from monoforce_ros.robots import RobotModel


class ExportKind(StrEnum):
    """Tools for which effects are exported."""

    MUJOCO = "mujoco"
    """MuJoCo XML to include in a model."""
    DIFF_DRIVE = "diff_drive"
    """Parameters of ros2_control's ``diff_drive_controller``; of a car, of its ``ackermann_steering_controller``."""
    NAV2 = "nav2"
    """Parameters of Nav2's MPPI controller and velocity smoother."""


@dataclass(frozen=True)
class Exported:
    """Files of one export, and what they lack."""

    kind: ExportKind
    files: tuple[Path, ...]
    not_exported: tuple[str, ...]
    """One sentence for each effect that this tool cannot express."""


_SUFFIXES = {".xml": ExportKind.MUJOCO, ".diff_drive.yaml": ExportKind.DIFF_DRIVE, ".nav2.yaml": ExportKind.NAV2}


def export_target(text: str) -> tuple[ExportKind, Path]:
    """Kind and path of an export given as ``KIND:FILE``, or as a file whose suffix says the kind.

    >>> export_target("husky.xml")[0]
    <ExportKind.MUJOCO: 'mujoco'>
    >>> export_target("nav2:parameters.yaml")
    (<ExportKind.NAV2: 'nav2'>, PosixPath('parameters.yaml'))

    Raises:
        ValueError: neither says the kind.
    """
    prefix, separator, rest = text.partition(":")
    if separator and prefix in set(ExportKind) and rest:
        return ExportKind(prefix), Path(rest)
    for suffix, kind in _SUFFIXES.items():
        if text.endswith(suffix) and text != suffix:
            return kind, Path(text)
    kinds = ", ".join(f"{kind}:FILE" for kind in ExportKind)
    raise ValueError(f"--export: got {text!r}, expected {kinds}, or a file that ends with {', '.join(_SUFFIXES)}")


def effects_to_export(robot: RobotModel, found: Sequence[EffectEstimate]) -> tuple[EffectEstimate, ...]:
    """The effects of the corrected robot: those of its file, and in their place those found that are credible."""
    chosen = {}
    intervals = dict(robot.effect_intervals)
    for name, values in robot.effects:
        units = {parameter.name: parameter.unit for parameter in CATALOGUE[name].parameters}
        own = intervals.get(name, {})
        # Without an interval in the file both ends are the value, which the exports say (`exported_value`).
        known = {
            key: ParameterEstimate(float(value), *own.get(key, (float(value), float(value))), units[key])
            for key, value in values.items()
        }
        chosen[name] = EffectEstimate(name, known)
    for effect in found:
        if not complaint(effect):
            chosen[effect.name] = effect
    return tuple(chosen.values())


def export_effects(targets: Sequence[str], robot: RobotModel, found: Sequence[EffectEstimate]) -> tuple[Exported, ...]:
    """Write the effects of a corrected robot for other tools.

    Args:
        targets: see :func:`export_target`.
        robot: the nominal model with the effects of its file.
        found: effects found by a diagnosis; those of the same name replace the file's.

    Raises:
        ValueError: a target names no kind.
    """
    chosen = [export_target(text) for text in targets]
    effects = {effect.name: effect for effect in effects_to_export(robot, found)}
    results = []
    for kind, path in chosen:
        if kind is ExportKind.MUJOCO:
            texts, missing = mujoco_files(robot, effects, path)
        else:
            text, missing = _WRITERS[kind](robot, effects)
            texts = {path: text}
        for file, content in texts.items():
            write_text(file, content)
        results.append(Exported(kind, tuple(texts), missing))
    return tuple(results)


_Writer = Callable[[RobotModel, Mapping[str, EffectEstimate]], tuple[str, tuple[str, ...]]]
_WRITERS: dict[ExportKind, _Writer] = {ExportKind.DIFF_DRIVE: controller_text, ExportKind.NAV2: nav2_text}
