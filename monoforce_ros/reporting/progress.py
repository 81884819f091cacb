"""Progress bars of the command-line tools, on standard error and only if that is a terminal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Never

from tqdm import tqdm


def progress[T](items: Iterable[T], *, label: str | None = None, unit: str = "it", quiet: bool = False) -> tqdm[T]:
    """The items, with a bar that advances as they are iterated over.

    Args:
        items: items to iterate over.
        label: text before the bar.
        unit: name of one item, in the singular.
        quiet: never show the bar.
    """
    return tqdm(items, desc=label, unit=unit, disable=_disable(quiet))


def progress_bar(
    total: float,
    *,
    label: str | None = None,
    unit: str = "it",
    quiet: bool = False,
    leave: bool = True,
    initial: float = 0,
    always: bool = False,
    bar_format: str | None = None,
) -> tqdm[Never]:
    """A bar to be advanced by its method ``update``; a context manager that closes it.

    Args:
        total: number of steps.
        label: text before the bar.
        unit: name of one step, in the singular.
        quiet: never show the bar.
        leave: keep the finished bar on the terminal.
        initial: steps that are done already.
        always: show the bar also where standard error is not a terminal, as in a log file.
        bar_format: layout, in tqdm's syntax.
    """
    return tqdm(
        total=total,
        desc=label,
        unit=unit,
        disable=quiet if always else _disable(quiet),
        leave=leave,
        initial=initial,
        bar_format=bar_format,
    )


def _disable(quiet: bool) -> bool | None:
    # With None tqdm hides the bar unless standard error is a terminal.
    return True if quiet else None
