"""Files that are whole or absent: written beside their target and renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def unfinished_path(path: str | Path) -> Path:
    """Where a file or folder is written until it is whole: hidden, beside its target, one for each process."""
    path = Path(path)
    return path.with_name(f".{path.name}.unfinished-{os.getpid()}")


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A path to write to; at the end of the block what was written there replaces ``path``.

    A reader never meets half of a file. After an error, such as a full disk, the old file stays and the unfinished one
    is removed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = unfinished_path(path)
    try:
        yield unfinished
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def write_text(path: str | Path, text: str) -> None:
    """Write a text file as a whole, UTF-8."""
    with atomic_path(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a binary file as a whole."""
    with atomic_path(path) as unfinished:
        unfinished.write_bytes(data)
