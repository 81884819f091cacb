"""Bags that stay open between single reads: opening one costs many times as much as reading a message."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from monoforce_ros.bags.reader import BagReader

MAXIMUM_IDLE = 2
"""Number of bags that stay open in each thread while nobody reads them."""

_Key = tuple[object, ...]


class _Idle(threading.local):
    """Idle bags of one thread, the one that was read last at the end: SQLite refuses other threads."""

    def __init__(self) -> None:
        self.bags: dict[_Key, BagReader] = {}


_idle = _Idle()


@contextmanager
def opened(path: Path) -> Iterator[BagReader]:
    """A reader of a bag that nobody else uses until the block ends; a bag that was read lately is still open.

    A bag whose files have changed is opened anew.

    Raises:
        BagError: the bag cannot be opened.
    """
    key = _key(path)
    reader = _idle.bags.pop(key, None) or BagReader(path).__enter__()
    try:
        yield reader
    except BaseException:
        # An interrupted read may have left it anywhere.
        reader.close()
        raise
    replaced = _idle.bags.pop(key, None)
    _idle.bags[key] = reader
    if replaced is None and len(_idle.bags) > MAXIMUM_IDLE:
        replaced = _idle.bags.pop(next(iter(_idle.bags)))
    if replaced is not None:
        replaced.close()


def _key(path: Path) -> _Key:
    """What must be the same for an open bag to be read on: the process, the bag, and its files as they are."""
    files = sorted(path.iterdir()) if path.is_dir() else [path] if path.exists() else []
    states = [file.stat() for file in files]
    # A forked process shares positions in files with its parent.
    return (os.getpid(), str(path.absolute()), *((s.st_ino, s.st_size, s.st_mtime_ns) for s in states))
