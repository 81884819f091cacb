"""BackgroundWorker: processes the newest job in a thread of its own, at lower priority if asked to."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable

import torch


class BackgroundWorker[Job]:
    """Processes jobs one at a time; a newer job replaces a waiting one, so that no queue builds up.

    Args:
        name: name of the thread.
        work: processes a job; must not raise.
        niceness: niceness of the thread and its child threads, 0 to 19, added to that of the process as ``nice(1)``
            does. Linux only; elsewhere all threads have the same priority.
    """

    def __init__(self, name: str, work: Callable[[Job], None], niceness: int = 0):
        self._work = work
        self._niceness = niceness
        self._changed = threading.Condition()
        self._job: Job | None = None
        self._running = True
        self.dropped = 0
        """Jobs that were replaced by newer ones before they were processed."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> None:
        """Hand over a job."""
        with self._changed:
            self.dropped += self._job is not None
            self._job = job
            self._changed.notify()

    def stop(self) -> None:
        """Stop after the current job."""
        with self._changed:
            self._running = False
            self._changed.notify()
        self._thread.join(timeout=10.0)

    def _run(self) -> None:
        # PyTorch keeps its thread count per thread; small operations are fastest on one.
        torch.set_num_threads(1)
        if self._niceness and sys.platform == "linux":
            # On Linux the niceness is that of the calling thread, elsewhere that of the process.
            os.nice(self._niceness)
        while True:
            with self._changed:
                while self._running and self._job is None:
                    self._changed.wait()
                if not self._running or self._job is None:
                    return
                job, self._job = self._job, None
            self._work(job)
