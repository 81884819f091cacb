"""Samples: what several sensors saw at one time, and how the robot moved then."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from monoforce_ros.bags.recording import Frame, Recording
from monoforce_ros.core import MotionState, StaleDataError, nearest_stamp


@dataclass(frozen=True)
class Sample:
    """Frames of several topics that belong together."""

    stamp: int
    """Of the first topic's frame [ns]."""
    frames: dict[str, Frame]
    """One frame of each topic."""
    motion: MotionState
    """At ``stamp``."""


def nearest_frame(frames: Sequence[Frame], stamp: int, *, limit: float = np.inf) -> Frame | None:
    """The frame nearest to a stamp [ns], within ``limit`` [s]; None where there is none."""
    index = nearest_stamp(np.array([frame.stamp for frame in frames], np.int64), stamp, limit=limit)
    return None if index is None else frames[index]


def synchronise(
    recording: Recording, topics: Sequence[str], *, limit: float = 0.05, maximum_gap: float = 0.3
) -> tuple[list[Sample], Counter[str]]:
    """Samples of a drive: for each frame of the first topic, the nearest one of each other topic, and the motion.

    Nothing beyond the limits is ever taken: where a topic has no frame near enough, there is no sample.

    Args:
        recording: the drive.
        topics: image topics, or that of the clouds; the first one sets the times.
        limit: largest distance in time between frames of a sample [s].
        maximum_gap: largest distance in time to the odometry around a sample [s].

    Returns:
        the samples in order of time, and how many frames of the first topic were left out for want of what.

    Raises:
        ValueError: a topic carries neither clouds nor images.
    """
    frames: dict[str, tuple[Frame, ...]] = {}
    for topic in topics:
        if topic == recording.topics.get("cloud"):
            frames[topic] = recording.clouds
        elif topic in recording.images:
            frames[topic] = recording.images[topic]
        else:
            known = [*recording.images, *([recording.topics["cloud"]] if "cloud" in recording.topics else [])]
            raise ValueError(f"{recording.path}: got topic {topic}, expected one of {sorted(known)}")
    stamps = {topic: np.array([frame.stamp for frame in listed], np.int64) for topic, listed in frames.items()}
    samples, missing = [], Counter()
    for frame in frames[topics[0]]:
        chosen = {topics[0]: frame}
        for topic in topics[1:]:
            nearest = nearest_stamp(stamps[topic], frame.stamp, limit=limit)
            if nearest is None:
                missing[topic] += 1
                break
            chosen[topic] = frames[topic][nearest]
        else:
            try:
                motion = recording.motion.at(frame.stamp, maximum_gap=maximum_gap)
            except StaleDataError:
                missing["odometry"] += 1
                continue
            samples.append(Sample(frame.stamp, chosen, motion))
    return samples, missing
