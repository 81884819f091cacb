"""Inputs: the newest sensor data and a short history of motion and commands, thread-safe."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from monoforce_ros.core import NANOSECOND, CommandTrack, MotionState, MotionTrack, largest_spread, quaternions

RETENTION = 10_000_000_000
"""Retention time of motion and commands [ns]."""
TIME_JUMP = 1_000_000_000
"""A stamp that is older by this than its predecessor on the same topic is a backward time jump [ns]."""

ODOMETRY_LAG = 30_000_000
"""Largest time by which sensor data may be newer than the odometry used with them [ns]."""
_OVERDUE_INTERVALS, _FREE_INTERVALS = 2.5, 0.9
"""Median intervals of the sensors without a set that belongs together, after which the newest messages are one: at
first, and while the sensors run freely."""
MOST_WAITING = 16
"""Sets of sensor messages that wait for odometry: 0.3 s of a lidar and three cameras at 10 Hz each, and some more."""


@dataclass(frozen=True)
class Received:
    """A message with its stamp [ns] and the steady time of its arrival [s]."""

    message: Any
    stamp: int
    arrival: float
    behind: float = 0.0
    """By how much the newest odometry was stamped later when it arrived [s]."""


class Inputs:
    """The data that a prediction starts from. Every method may be called from any thread.

    Args:
        sensors: topics whose newest message is kept.
        slop: largest difference between the stamps of one set of sensor messages [s].
        patience: how long a set waits for a silent sensor [s].
        command_width: numbers of a command: 2, or 3 with a lateral speed.
        on_time_jump: called after a backward time jump, when all data have been discarded, with the topic and the size
            of the jump [s].
    """

    def __init__(
        self,
        sensors: list[str],
        *,
        slop: float,
        patience: float,
        on_time_jump: Callable[[str, float], None],
        command_width: int = 2,
    ):
        self.changed = threading.Condition()
        self._sensors = sensors
        self._slop = slop
        self._patience = patience
        self._on_time_jump = on_time_jump
        self._command_width = command_width
        self._last_stamps: dict[str, int] = {}
        self.frame_id = ""
        self.child_frame_id = ""
        self.dropped = 0
        self._commands: deque[tuple[int, np.ndarray]] = deque()
        self._clear()

    def _clear(self) -> None:
        self._last_stamps.clear()
        self._states: deque[MotionState] = deque()
        self._newest: dict[str, Received] = {}
        self._intervals: dict[str, int] = {}
        self._waiting: deque[dict[str, Received]] = deque()
        self._first_sensor = 0.0
        self._last_set: int | None = None
        self._free_running = False
        self.apart: dict[str, float] = {}
        """By how much the stamps of sensors that were left out of the last set are older than its newest [s]; of one
        whose clock is ahead this is negative."""

    def forget(self) -> None:
        """Discard all data: what came before, as while the node was paused, is no longer current."""
        with self.changed:
            self._clear()

    def _admit(self, topic: str, stamp: int) -> bool:
        """Whether a message may be used: it is not older than its predecessor, or the first one after a time jump."""
        last = self._last_stamps.get(topic)
        if last is not None and stamp < last - TIME_JUMP:
            self._clear()
            # Commands of the new time may have come first.
            self._commands = deque(entry for entry in self._commands if entry[0] <= stamp + TIME_JUMP)
            self._on_time_jump(topic, (last - stamp) * NANOSECOND)
        elif last is not None and stamp < last:
            return False
        self._last_stamps[topic] = stamp
        return True

    def add_motion(self, topic: str, state: MotionState, frame_id: str, child_frame_id: str) -> None:
        """Keep measured motion."""
        with self.changed:
            if not self._admit(topic, state.stamp) or (self._states and state.stamp == self._states[-1].stamp):
                return
            if self._states and frame_id != self.frame_id:
                # Another estimator: poses in different frames do not belong to one motion.
                self._states.clear()
                self._waiting.clear()
            self.frame_id, self.child_frame_id = frame_id, child_frame_id
            self._states.append(state)
            while self._states[0].stamp < state.stamp - RETENTION:
                self._states.popleft()
            self.changed.notify_all()

    def add_command(self, stamp: int, twist: np.ndarray) -> None:
        """Keep a command; one without a stamp (0) gets the stamp of the newest odometry, the only clock available.

        One that is older than its predecessor by more than :data:`TIME_JUMP` replaces all earlier ones.
        """
        with self.changed:
            if not stamp:
                stamp = self._states[-1].stamp if self._states else 0
            if not stamp:
                return
            # Commands may come from another computer: a jump of its clock says nothing of the robot's sensors.
            if self._commands and stamp < self._commands[-1][0] - TIME_JUMP:
                self._commands.clear()
            elif self._commands and stamp < self._commands[-1][0]:
                return
            self._commands.append((stamp, twist))
            while self._commands[0][0] < stamp - RETENTION:
                self._commands.popleft()

    @property
    def motion_stamp(self) -> int:
        """Stamp of the newest odometry [ns]; 0 without any."""
        with self.changed:
            return self._states[-1].stamp if self._states else 0

    def add_sensor(self, topic: str, stamp: int, message: Any) -> None:
        """Keep a sensor's newest message; a complete set waits for odometry."""
        with self.changed:
            if not self._admit(topic, stamp):
                self.dropped += 1
                return
            now = time.monotonic()
            if topic in self._newest:
                self._intervals[topic] = stamp - self._newest[topic].stamp
            behind = (self._states[-1].stamp - stamp) * NANOSECOND if self._states else 0.0
            self._newest[topic] = Received(message, stamp, now, behind)
            # A sensor that has stopped does not delay the others.
            live = [entry for entry in self._newest.values() if now - entry.arrival <= self._patience]
            self._first_sensor = self._first_sensor or now
            if len(self._newest) < len(self._sensors) and now - self._first_sensor < self._patience:
                return  # the other sensors may still be starting
            newest = max(entry.stamp for entry in live)
            triggered = newest - min(entry.stamp for entry in live) <= 1e9 * largest_spread(
                self._slop, (1e-9 * entry for entry in self._intervals.values())
            )
            if not triggered:
                if not self._overdue(newest):
                    return
                live = self._together(live)
                newest = max(entry.stamp for entry in live)
            self._free_running, self._last_set = not triggered, newest
            self.apart = {
                name: (newest - entry.stamp) * NANOSECOND
                for name, entry in self._newest.items()
                if entry not in live and now - entry.arrival <= self._patience
            }
            self._waiting.append({name: entry for name, entry in self._newest.items() if entry in live})
            if len(self._waiting) > MOST_WAITING:
                self._waiting.popleft()
                self.dropped += 1
            self.changed.notify_all()

    def _overdue(self, newest: int) -> bool:
        """Whether the sensors' usual time between messages has passed without a set that belongs together.

        Cameras that are not triggered together, or whose clocks differ, never make one. One message that is lost leaves
        two intervals without a set: only more is overdue, until it is known that the sensors run freely.
        """
        if self._last_set is None:
            self._last_set = newest
            return False
        if not self._intervals:
            return False
        usual = float(np.median(list(self._intervals.values())))
        return newest - self._last_set > (_FREE_INTERVALS if self._free_running else _OVERDUE_INTERVALS) * usual

    def _together(self, live: list[Received]) -> list[Received]:
        """The most messages that lie within the slop, the newest of several such groups."""
        slop = round(self._slop * 1e9)
        groups = [[other for other in live if 0 <= entry.stamp - other.stamp <= slop] for entry in live]
        return max(groups, key=lambda group: (len(group), max(entry.stamp for entry in group)))

    def take(self, *, odometry_timeout: float, wait: float) -> dict[str, Received] | None:
        """The newest complete set of sensor messages with which odometry has caught up; None after ``wait`` [s].

        Over the last :data:`ODOMETRY_LAG` motion is extrapolated (:meth:`MotionTrack.at`), which beats waiting. If
        odometry has not caught up with any set for ``odometry_timeout`` [s], the newest one is given anyway. Sets older
        than the one that is given are dropped.
        """
        deadline = time.monotonic() + wait
        with self.changed:
            while True:
                now = time.monotonic()
                limit = deadline
                if self._waiting:
                    # The oldest set decides how long odometry is waited for: newer ones may arrive faster than that.
                    overdue = max(entry.arrival for entry in self._waiting[0].values()) + odometry_timeout
                    index = self._newest_with_odometry()
                    if index is None and now >= overdue:
                        index = len(self._waiting) - 1
                    if index is not None:
                        taken = self._waiting[index]
                        self.dropped += index
                        for _ in range(index + 1):
                            self._waiting.popleft()
                        return taken
                    limit = min(deadline, overdue)
                if now >= deadline:
                    return None
                self.changed.wait(max(0.0, limit - now) + 1e-3)

    def _newest_with_odometry(self) -> int | None:
        """Index of the newest waiting set with which odometry has caught up; None if there is none."""
        if not self._states:
            return None
        latest = self._states[-1].stamp + ODOMETRY_LAG
        ready = (max(entry.stamp for entry in waiting.values()) <= latest for waiting in self._waiting)
        return max((index for index, is_ready in enumerate(ready) if is_ready), default=None)

    def take_motion(self, last: int, *, wait: float) -> dict[str, Received] | None:
        """The newest odometry as the input of a prediction, unless its stamp is ``last`` [ns].

        Waits up to ``wait`` [s] for it, then returns None.
        """
        deadline = time.monotonic() + wait
        with self.changed:
            while not self._states or self._states[-1].stamp == last:
                remaining = deadline - time.monotonic()
                if remaining <= 0:
                    return None
                self.changed.wait(remaining)
            return {"odometry": Received(None, self._states[-1].stamp, time.monotonic())}

    def drop(self, received: dict[str, Received]) -> None:
        """Count a set that was removed from the inputs but not used."""
        with self.changed:
            self.dropped += received.keys() != {"odometry"}

    def motion(self) -> MotionTrack:
        """Measured motion within the retention time."""
        with self.changed:
            states = list(self._states)
            frames = self.frame_id, self.child_frame_id
        return MotionTrack(
            stamps=np.array([s.stamp for s in states], np.int64),
            positions=np.array([s.position for s in states]).reshape(-1, 3),
            quaternions=quaternions(np.array([s.rotation for s in states]).reshape(-1, 3, 3)),
            linear_velocities=np.array([s.linear_velocity for s in states]).reshape(-1, 3),
            angular_velocities=np.array([s.angular_velocity for s in states]).reshape(-1, 3),
            frame_id=frames[0],
            child_frame_id=frames[1],
        )

    def commands(self) -> CommandTrack:
        """Commands within the retention time."""
        with self.changed:
            commands = list(self._commands)
        return CommandTrack(
            stamps=np.array([stamp for stamp, _ in commands], np.int64),
            twists=np.array([twist for _, twist in commands]).reshape(-1, self._command_width),
        )
