"""Batches of a training: samples of each step, drawn and augmented ahead of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from monoforce_ros.encoder import EncoderConfig, EncoderInput
from monoforce_ros.training.recording_samples import RecordingSamples, read_samples
from monoforce_ros.training.samples import Augmentation, Targets, sample


class Batches(Dataset):
    """Samples of each step, determined by seed and step alone, so that resuming does not change them.

    Args:
        recordings: recordings to draw from; every epoch uses each of their samples once.
        config: configuration of the encoder.
        size: samples per step and process.
        seed: of the order and of the augmentation.
        augment: whether to augment samples.
        mirror: whether augmented scenes may be mirrored; a robot that is not its own mirror image moves otherwise.
        sensor_shares: see :meth:`monoforce_ros.training.samples.Augmentation.draw`.
        rank, count: number of this process, and of processes that train together.
    """

    def __init__(
        self,
        recordings: Sequence[RecordingSamples],
        config: EncoderConfig,
        *,
        size: int,
        seed: int,
        augment: bool = True,
        mirror: bool = True,
        sensor_shares: Sequence[float] | None = None,
        rank: int = 0,
        count: int = 1,
    ):
        self.recordings, self.config = list(recordings), config
        self.size, self.seed, self.augment, self.sensor_shares = size, seed, augment, sensor_shares
        self.mirror, self.rank, self.count = mirror, rank, count
        self.index = [(r, i) for r, recording in enumerate(self.recordings) for i in range(len(recording))]

    def __getitem__(self, step: int) -> tuple[EncoderInput, Targets]:
        total, first = self.size * self.count, self.rank * self.size
        random = np.random.default_rng([self.seed, step])
        # A batch that an epoch ends in goes on with the next one: every sample is used as often as the others.
        places = [divmod(step * total + first + number, len(self.index)) for number in range(self.size)]
        orders = {
            epoch: np.random.default_rng([self.seed, 7, epoch]).permutation(len(self.index))
            for epoch in {epoch for epoch, _ in places}
        }
        chosen = [int(orders[epoch][place]) for epoch, place in places]
        drawn = [
            Augmentation.draw(random, self.sensor_shares) if self.augment else Augmentation() for _ in range(total)
        ]
        if not self.mirror:
            drawn = [replace(augmentation, mirrored=False) for augmentation in drawn]
        samples = [
            sample(self.recordings[self.index[i][0]], self.index[i][1], self.config, augmentation)
            for i, augmentation in zip(chosen, drawn[first:], strict=False)
        ]
        return EncoderInput.stack([s[0] for s in samples]), Targets.stack([s[1] for s in samples])

    def __getstate__(self) -> dict[str, Any]:
        """For another process, which maps the same files into its memory."""
        return self.__dict__ | {"recordings": [recording.file for recording in self.recordings]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state | {"recordings": [read_samples(file) for file in state["recordings"]]})

    def prepared(self, steps: range, loaders: int) -> Iterator[tuple[EncoderInput, Targets]]:
        """Batches of steps, prepared while others are used.

        Args:
            steps: whose batches are prepared, consecutive ones.
            loaders: batches that are prepared at the same time, in processes of their own: threads wait for each other
                in Python. One, or recordings without a file, are prepared in a thread.
        """
        if loaders > 1 and all(recording.file is not None for recording in self.recordings):
            # A forked process may hang in libraries that had threads before.
            yield from DataLoader(
                self, batch_size=None, sampler=steps, num_workers=loaders, multiprocessing_context="spawn",
                worker_init_fn=use_one_thread,
            )  # fmt: skip
            return
        with ThreadPoolExecutor(1) as pool:
            prepared = None
            for step in steps:
                batch = self[step] if prepared is None else prepared.result()
                prepared = pool.submit(self.__getitem__, step + 1) if step + 1 in steps else None
                yield batch


def use_one_thread(worker: int = 0) -> None:
    """Parallel processes use one thread each."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
