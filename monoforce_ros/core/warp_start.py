"""Initialisation of Warp without its warning about a missing GPU, which is a normal configuration."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

_NO_DRIVER = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"


def start_warp() -> None:
    """Initialise Warp, which then tells of errors only; its remark that there is no CUDA driver is dropped.

    Raises:
        ImportError: Warp is not installed.
    """
    # Not above: what uses no physics does not load it.
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    with _without_lines(_NO_DRIVER):
        wp.init()


@contextmanager
def _without_lines(start: bytes) -> Iterator[None]:
    """Drop lines that native code writes to standard error and that begin with ``start``.

    Warp's library prints this warning itself: neither its log level nor ``sys.stderr`` reaches it.
    """
    try:
        sys.stderr.flush()
        kept = os.dup(2)
    except (OSError, AttributeError, ValueError):
        # A process without standard error has nothing to keep clean.
        yield
        return
    with tempfile.TemporaryFile() as captured:
        os.dup2(captured.fileno(), 2)
        try:
            yield
        finally:
            sys.stderr.flush()
            os.dup2(kept, 2)
            os.close(kept)
            captured.seek(0)
            for line in captured:
                if not line.startswith(start):
                    os.write(2, line)
