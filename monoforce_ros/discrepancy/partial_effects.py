"""Partial effects: those that act on a part of the ground, or from some time on, and what a robot file says of them.

A robot's file holds everywhere. What acts on one patch of ice belongs to the ground: with it in the file predictions on
all other ground get worse, and the patch's place is that of one odometry frame, which begins anew with the next drive.
What began in the middle of a drive lasted until its end, and describes the robot as it is since.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from monoforce_ros.discrepancy.diagnosis import Diagnosis
from monoforce_ros.discrepancy.estimates import EffectEstimate
from monoforce_ros.discrepancy.learned import LEARNED
from monoforce_ros.discrepancy.report import effect_entry

_ELSEWHERE = "on all other ground predictions get worse with it"
_BEFORE = "the motion before that is predicted worse with it"


def effects_for_file(diagnosis: Diagnosis, *, local: bool = False) -> tuple[EffectEstimate, ...]:
    """The effects that a robot's file gets.

    Args:
        diagnosis: the result.
        local: whether those that act on a part of the ground only are wanted, too.
    """
    if local or not diagnosis.regional:
        return diagnosis.effects
    return tuple(effect for effect in diagnosis.effects if effect.name not in diagnosis.partial)


def file_entry(diagnosis: Diagnosis, effect: EffectEstimate) -> Mapping[str, Any]:
    """An effect for :func:`monoforce_ros.robots.write_robot`, with the part in which it acts, if that is not all."""
    entry = effect_entry(effect)
    if effect.name in diagnosis.partial:
        entry["part"] = f"{diagnosis.part.rstrip('.')}: {_ELSEWHERE if diagnosis.regional else _BEFORE}."
    return entry


def with_advice(diagnosis: Diagnosis, *, local: bool = False, written: bool = True) -> Diagnosis:
    """The diagnosis with what the robot's file is good for, where effects act in a part of the recording only.

    Args:
        diagnosis: the result.
        local: whether effects of a part of the ground are written.
        written: whether a robot file is.
    """
    if not diagnosis.partial or (not written and (local or not diagnosis.regional)):
        return diagnosis
    names = " and ".join("the formula" if name == LEARNED else name for name in diagnosis.partial)
    is_, belongs, it = ("is", "it belongs", "it") if len(diagnosis.partial) == 1 else ("are", "they belong", "them")
    if not diagnosis.regional:
        text = f"the robot's new file describes the robot as it is since then: {_BEFORE}"
    elif local:
        text = f"use the robot's new file on such ground only: {_ELSEWHERE}"
    else:
        text = (
            f"{names} {is_} not written into a robot file, since {belongs} to the ground: {_ELSEWHERE} "
            f"(--local-effects writes {it} all the same)"
        )
    return replace(diagnosis, advice=(text, *diagnosis.advice))
