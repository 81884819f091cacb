"""BackgroundWorker: work on the newest of what comes, in a thread of its own."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from typing import Any

import torch


class BackgroundWorker:
    """Runs ``work`` on one job after the other; one that waits is replaced by a newer one, so that nothing piles up.

    Args:
        name: of the thread.
        work: what to do with a job; it must not raise.
        niceness: how far the thread, and threads that it starts, step back for others where cores are scarce, 0 to 19
            as ``nice(1)`` counts. Linux only; elsewhere all threads are equal.
    """

    def __init__(self, name: str, work: Callable[[Any], None], niceness: int = 0):
        self._work = work
        self._niceness = niceness
        self._changed = threading.Condition()
        self._job: Any = None
        self._running = True
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def give(self, job: Any) -> None:
        """Hand over a job."""
        with self._changed:
            self.dropped += self._job is not None
            self._job = job
            self._changed.notify()

    def stop(self) -> None:
        """End after the job in hand."""
        with self._changed:
            self._running = False
            self._changed.notify()
        self._thread.join(timeout=10.0)

    def _run(self) -> None:
        # Each thread has a setting of its own.
        torch.set_num_threads(1)
        if self._niceness and sys.platform == "linux":
            # There it is the thread's own; elsewhere it would be the whole process's.
            os.nice(self._niceness)
        while True:
            with self._changed:
                while self._running and self._job is None:
                    self._changed.wait()
                if not self._running:
                    return
                job, self._job = self._job, None
            self._work(job)
