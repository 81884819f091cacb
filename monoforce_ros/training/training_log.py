"""TrainingLog: progress of a training on the terminal and in TensorBoard."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from monoforce_ros.reporting import progress_bar
from monoforce_ros.training.trainer import Trainer

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class TrainingLog:
    """Progress bar and TensorBoard log."""

    def __init__(self, out: Path, steps: int, trainer: Trainer, *, quiet: bool):
        from torch.utils.tensorboard import SummaryWriter

        self.trainer, self.logged = trainer, len(trainer.history)
        self.writer = SummaryWriter(str(out / "log"), purge_step=trainer.step + 1) if trainer.process.first else None
        self.bar = progress_bar(steps, initial=trainer.step, label="training", unit="step", quiet=quiet)
        # tqdm prints nothing without a terminal; log twenty lines instead.
        self.steps, self.lines = steps, 0 if quiet or sys.stderr.isatty() else max(1, steps // 20)
        self.smooth: float | None = None

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.close()
        if self.writer is not None:
            # The last validation follows the last step.
            self._write_validations(self.writer)
            self.writer.close()

    def __call__(self, step: int, losses: dict[str, float]) -> None:
        """Show a step and its losses, and validations since the last one."""
        total = losses["total"]
        if np.isfinite(total):
            self.smooth = total if self.smooth is None else 0.95 * self.smooth + 0.05 * total
        history = self.trainer.history
        summary = {} if self.smooth is None else {"loss": f"{self.smooth:.3f}"}
        if history:
            _, latest = history[-1]
            summary["held out"] = f"{100 * latest.geometric:.1f}, {100 * latest.supporting:.1f} cm"
        self.bar.set_postfix(summary)
        self.bar.update()
        if self.lines and (step % self.lines == 0 or step == self.steps):
            text = ", ".join(f"{name} {value}" for name, value in summary.items())
            print(f"step {step} of {self.steps}: {text}", flush=True)
        if self.writer is None:
            return
        for name, value in losses.items():
            self.writer.add_scalar(f"loss/{name}", value, step)
        self._write_validations(self.writer)

    def _write_validations(self, writer: SummaryWriter) -> None:
        history = self.trainer.history
        for step, validation in history[self.logged :]:
            for name in ("geometric", "supporting", "loss"):
                writer.add_scalar(f"held out/{name}", getattr(validation, name), step)
        self.logged = len(history)
