"""Findings: statements about a bag, each with a severity."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    """Severity of a finding, the most severe first."""

    MISSING = "missing"
    """Needed data does not exist; the bag cannot be evaluated."""
    WARNING = "warning"
    NOTE = "note"
    OK = "ok"

    @property
    def rank(self) -> int:
        """Position in a report: 0 for the most severe."""
        return list(Level).index(self)


@dataclass(frozen=True)
class Finding:
    """One statement about a bag."""

    level: Level
    text: str
    """One sentence; for a problem, with its remedy."""


def missing(text: str) -> Finding:
    """A finding that makes the bag unusable."""
    return Finding(Level.MISSING, text)


def warning(text: str) -> Finding:
    """A finding that probably spoils results."""
    return Finding(Level.WARNING, text)


def note(text: str) -> Finding:
    """A finding worth knowing."""
    return Finding(Level.NOTE, text)


def ok(text: str) -> Finding:
    """A finding without a problem."""
    return Finding(Level.OK, text)
