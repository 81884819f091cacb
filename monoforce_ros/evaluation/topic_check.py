"""TopicCheck: counts, rates, gaps and clock of one topic of a bag."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from monoforce_ros.bags import CAMERA_INFO, CLOUD, COMMANDS, IMAGES, ODOMETRY, BagError, BagMessage
from monoforce_ros.core import NANOSECOND
from monoforce_ros.evaluation.findings import Finding, note, warning
from monoforce_ros.messages import decoding

IMU, JOINTS = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState"
KNOWN_TYPES = frozenset({ODOMETRY, *COMMANDS, CLOUD, *IMAGES, CAMERA_INFO, IMU, JOINTS})
"""Message types that are decoded and checked; of the others messages are only counted."""
LONG_GAP = 0.5
"""Shortest gap in a topic that is needed throughout that is reported [s]."""
CLOCK_TOLERANCE = 0.5
"""Smallest difference between header stamp and time of reception that is reported [s]."""
_DECODERS: dict[str, Callable[[Any], object]] = {
    ODOMETRY: decoding.decode_odometry,
    CLOUD: decoding.decode_cloud,
    CAMERA_INFO: decoding.decode_camera_info,
    **dict.fromkeys(COMMANDS, decoding.decode_command),
    **dict.fromkeys(IMAGES, decoding.decode_image),
}


@dataclass
class TopicCheck:
    """Statistics of a topic, updated message by message."""

    topic: str
    message_type: str
    count: int = 0
    bad: int = 0
    """Messages that cannot be decoded."""
    unordered: int = 0
    """Messages with a stamp before that of their predecessor."""
    unstamped: int = 0
    frames: set[str] = field(default_factory=set)
    error: str = ""
    """Of the first bad message."""
    stamps: list[int] = field(default_factory=list)
    """Header stamps, or times of reception without one [ns]."""
    offsets: list[float] = field(default_factory=list)
    """Time of reception minus header stamp [s]."""

    @property
    def rate(self) -> float:
        """Median rate [Hz], or NaN."""
        if len(self.stamps) < 2:
            return float("nan")
        step = float(np.median(np.diff(np.sort(self.stamps)))) * NANOSECOND
        return 1.0 / step if step > 0 else float("nan")

    @property
    def longest_gap(self) -> float:
        """Longest time between consecutive messages [s]."""
        return float(np.diff(np.sort(self.stamps)).max()) * NANOSECOND if len(self.stamps) > 1 else 0.0

    @property
    def clock_offset(self) -> float:
        """Median time of reception minus header stamp [s], or NaN without stamps."""
        return float(np.median(self.offsets)) if self.offsets else float("nan")

    def add(self, message: BagMessage, *, is_ros2: bool) -> None:
        """Count a message; decode it if its type is known."""
        self.count += 1
        stamp = 0
        if message.message_type in KNOWN_TYPES:
            try:
                if message.message_type in (*IMAGES, CLOUD) and is_ros2 and self.count > 1:
                    # Images and clouds are large: only the first one is decoded, of the others the header suffices.
                    stamp = decoding.stamp_of_cdr(message.data)
                else:
                    decoded = message.decode()
                    stamp = decoding.stamp_of(decoded)
                    if message.message_type in _DECODERS:
                        _DECODERS[message.message_type](decoded)
                    header = getattr(decoded, "header", None)
                    if header is not None:
                        self.frames.add(header.frame_id)
            except (ValueError, BagError) as error:
                self.bad += 1
                self.error = self.error or str(error)
        if stamp:
            if not self.offsets and self.unstamped:
                # Times of reception may be those of another clock.
                self.stamps.clear()
            self.offsets.append((message.received - stamp) * NANOSECOND)
        elif message.message_type in KNOWN_TYPES and message.message_type != "geometry_msgs/msg/Twist":
            self.unstamped += 1
            if self.offsets:
                return
        time = stamp or message.received
        if self.stamps and time < self.stamps[-1]:
            self.unordered += 1
        self.stamps.append(time)

    def findings(self) -> Iterable[Finding]:
        """Faults of the topic."""
        if self.message_type not in KNOWN_TYPES:
            return
        if self.bad:
            yield warning(f"{self.topic}: {self.bad} of {self.count} messages cannot be used: {self.error}")
        if self.unstamped and self.message_type != CAMERA_INFO:
            instead = "these are left out" if self.offsets else "the time of reception is used instead"
            yield warning(f"{self.topic}: {self.unstamped} headers have no stamp; {instead}")
        if self.unordered:
            yield note(f"{self.topic}: {self.unordered} messages are out of order; they are sorted when read")
        if abs(self.clock_offset) > CLOCK_TOLERANCE:
            yield warning(
                f"{self.topic}: messages were received {self.clock_offset:+.2f} s after their stamps: another clock? "
                "Synchronise the computers (chrony, PTP), or let the driver stamp with ROS time"
            )
        throughout = self.message_type in (ODOMETRY, CLOUD, *IMAGES)
        if throughout and self.longest_gap > max(LONG_GAP, 3.0 / max(self.rate, 1e-3)):
            yield warning(f"{self.topic}: no messages for {self.longest_gap:.1f} s; predictions skip this gap")
