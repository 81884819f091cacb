"""Command lines: a misspelt option or name is answered with the most similar one that exists."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn, override


def most_similar(name: str, known: Iterable[str]) -> list[str]:
    """The most similar known name, as a list of at most one."""
    # 0.6 is difflib's own default: words that share most of their letters in order.
    return difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)


def nearest(name: str, known: Iterable[str]) -> str:
    """``; did you mean …?`` with the most similar known name, or nothing if none is similar."""
    found = most_similar(name, known)
    return f"; did you mean {found[0]!r}?" if found else ""


class OptionParser(argparse.ArgumentParser):
    """An argument parser that refuses abbreviations and names the most similar option for an unknown one."""

    def __init__(self, **settings: Any):
        super().__init__(**{"allow_abbrev": False, **settings})

    @override
    def error(self, message: str) -> NoReturn:
        unknown = message.removeprefix("unrecognized arguments: ").split()
        if message.startswith("unrecognized arguments: "):
            message += nearest(unknown[0].split("=")[0], self._known_options())
        super().error(message)

    def refuse_without_effect(
        self, options: argparse.Namespace, names: Sequence[str], reason: str, arguments: Sequence[str] = ()
    ) -> None:
        """End with an error if one of the options, which have no effect for a ``reason``, differs from its default.

        Of the ``arguments`` of the command line, options with the value of their default are refused, too.
        """
        words = {word.split("=")[0] for word in map(str, arguments)}
        given = {action.dest for word, action in self._option_string_actions.items() if word in words}
        for name in names:
            if name in given or getattr(options, name) != self.get_default(name):
                self.error(f"--{name.replace('_', '-')} has no effect {reason}")

    def _known_options(self) -> set[str]:
        """Options of this parser and, as it also reports those that they do not know, of its subcommands."""
        options = set(self._option_string_actions)
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                options |= {option for parser in action.choices.values() for option in parser._option_string_actions}
        return options
