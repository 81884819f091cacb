"""Interruption: Ctrl-C ends a command and the processes that it started at once, without their tracebacks."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED_STATUS = 130
"""Exit status after Ctrl-C, as of a shell: 128 + SIGINT."""


@contextmanager
def interruptible() -> Iterator[None]:
    """In the block, Ctrl-C ends the processes that this one started, and raises ``KeyboardInterrupt``.

    A terminal sends it to all of them, and a pool waits for its processes to finish their tasks, which takes minutes.
    Processes that are started in :func:`uninterrupted` neither see it nor print a traceback.
    """

    def ended(number: int, frame: FrameType | None) -> None:
        for process in multiprocessing.active_children():
            process.terminate()
        raise KeyboardInterrupt

    with _handled_by(ended):
        yield


@contextmanager
def uninterrupted() -> Iterator[None]:
    """In the block, Ctrl-C is ignored; processes that are started in it ignore it for good."""
    with _handled_by(signal.SIG_IGN):
        yield


@contextmanager
def _handled_by(handler: object) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        # Python lets no other thread handle signals.
        yield
        return
    before = signal.getsignal(signal.SIGINT)
    if before in (None, signal.SIG_IGN):
        # Of a job in the background, or of a program in another language around this one.
        yield
        return
    signal.signal(signal.SIGINT, handler)  # type: ignore[arg-type]
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
