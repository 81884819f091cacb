"""Atomic file writes: write to a temporary file in the target's folder, then rename it; numbers that JSON has."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def unfinished_path(path: str | Path) -> Path:
    """Temporary path of a file or folder being written: hidden, in the target's folder, unique to this process."""
    path = Path(path)
    return path.with_name(f".{path.name}.unfinished-{os.getpid()}")


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path to write to; at the end of the block that file replaces ``path``.

    Readers never see an incomplete file. After an error, such as a full disk, the old file remains and the temporary
    one is removed.
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
    """Write a UTF-8 text file atomically."""
    with atomic_path(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a binary file atomically."""
    with atomic_path(path) as unfinished:
        unfinished.write_bytes(data)


def without_nan(value: Any) -> Any:
    """The same content with None in place of numbers that are not finite, which JSON does not have."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: without_nan(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(entry) for entry in value]
    return value
