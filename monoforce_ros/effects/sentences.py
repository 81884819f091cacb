"""Sentences: parts that the sentences of several effects share."""

from __future__ import annotations


def percent_change(factor: float, less: str, more: str) -> str:
    """A factor as a change in percent, with the word for a smaller or larger one."""
    return f"{100 * abs(1 - factor):.0f} % {less if factor < 1 else more}"


def in_directions(x: float, y: float, unit: str) -> str:
    """A vector in the base frame (x forward, y left), without components that round to nothing beside the larger."""
    largest = max(abs(x), abs(y))
    parts = []
    if abs(x) > 0.1 * largest:
        parts.append(f"{abs(x):.3g} {unit} {'forward' if x > 0 else 'backward'}")
    if abs(y) > 0.1 * largest:
        parts.append(f"{abs(y):.3g} {unit} to the {'left' if y > 0 else 'right'}")
    return " and ".join(parts) or f"0 {unit}"


def clock_sentence(what: str, offset: float) -> str:
    """A sentence on stamps that are ``offset`` seconds after the true time."""
    return f"{what} are stamped {abs(offset):.2f} s {'late' if offset > 0 else 'early'}."
