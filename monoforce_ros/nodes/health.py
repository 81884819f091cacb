"""Health: the current state of each part of a node, as diagnostics and as log lines that are not repeated."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import ROSClock
from rclpy.node import Node

from monoforce_ros.nodes.clocks import STEADY

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)
_REPEATED = 2.0
"""A state that returns within this time [s] is logged only if it lasts: a part that keeps changing between two states
would fill the log."""
_CLOCK_STANDS = 2.0
"""Time without a change of ``/clock`` [s] from which on it is said to stand: bag players and simulators publish it at
10 Hz or more."""


@dataclass
class _Part:
    level: bytes = STALE
    message: str = "nothing received yet"
    reason: str = ""
    values: dict[str, str] = field(default_factory=dict)
    logged: dict[tuple[bytes, str], float] = field(default_factory=dict)
    """When states were logged last [s], by level and reason."""
    shown: tuple[bytes, str] | None = None
    """State of the last line in the log."""

    @property
    def key(self) -> tuple[bytes, str]:
        return self.level, self.reason

    def due(self, now: float) -> bool:
        """Whether the present state has to be logged, which counts as done."""
        self.logged = {key: when for key, when in self.logged.items() if now - when < _REPEATED}
        if self.key == self.shown or self.key in self.logged:
            return False
        self.shown, self.logged[self.key] = self.key, now
        return True


class Health:
    """The state of a node's parts. Changes are logged once and published at once; everything is published every second.

    A state that comes back within two seconds is logged when it has lasted, not each time.

    Thread-safe.
    """

    def __init__(self, node: Node, parts: list[str]):
        self._node = node
        self._lock = threading.Lock()
        self._parts = {name: _Part() for name in parts}
        self._clock_time, self._clock_changed = -1, time.monotonic()
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = node.create_timer(1.0, self._tick, clock=STEADY)

    def report(self, part: str, level: bytes, message: str, *, reason: str = "", **values: object) -> None:
        """Set a part's state.

        Args:
            part: part of the node.
            level: OK, WARN, ERROR or STALE.
            message: the state in words.
            reason: short key of the state; while it stays the same, a message with other numbers is not logged again.
                Defaults to the message.
            values: values to add to the diagnostics.
        """
        self._set(part, level, message, reason, {name.replace("_", " "): str(value) for name, value in values.items()})

    def report_anew(
        self, part: str, level: bytes, message: str, values: Mapping[str, str], *, reason: str = ""
    ) -> None:
        """As :meth:`report`, with all values in the diagnostics, so that none remains of what no longer holds."""
        self._set(part, level, message, reason, values, anew=True)

    def _set(
        self, part: str, level: bytes, message: str, reason: str, values: Mapping[str, str], *, anew: bool = False
    ) -> None:
        reason = reason or message
        with self._lock:
            state = self._parts.setdefault(part, _Part())
            changed = state.key != (level, reason)
            started = state.level == STALE and level == OK
            state.level, state.message, state.reason = level, message, reason
            # A change is published at once, with the values that belong to it.
            state.values = {**({} if anew else state.values), **values}
            due = changed and state.due(time.monotonic())
        if due and not started:
            self._log(part, level, message)
        if changed:
            self.publish()

    def _watch_clock(self, now: float) -> None:
        """Report under ``use_sim_time`` whether time passes."""
        clock = self._node.get_clock()
        if not (isinstance(clock, ROSClock) and clock.ros_time_is_active):
            return
        simulated = clock.now().nanoseconds
        if simulated != self._clock_time:
            self._clock_time, self._clock_changed = simulated, now
        still = now - self._clock_changed
        if simulated and still < _CLOCK_STANDS:
            self.report("clock", OK, "receiving /clock")
        elif still >= _CLOCK_STANDS:
            state = "time on /clock stands still" if simulated else "there are no messages on /clock"
            advice = "start what publishes it (bag_player --clock, a simulator), or set use_sim_time to false"
            self.report("clock", WARN, f"use_sim_time is true, but {state}: {advice}", reason=state)

    def _tick(self) -> None:
        now = time.monotonic()
        self._watch_clock(now)
        with self._lock:
            # Parts that nobody reported yet have no line either.
            due = [
                (name, state.level, state.message)
                for name, state in self._parts.items()
                if state.shown is not None and state.due(now)
            ]
        for line in due:
            self._log(*line)
        self.publish()

    def _log(self, part: str, level: bytes, message: str) -> None:
        logger = self._node.get_logger()
        text = f"{part}: {message}"
        # Each severity needs a call of its own: rclpy allows only one severity per line of code.
        if level == ERROR:
            logger.error(text)
        elif level in (WARN, STALE):
            logger.warning(text)
        else:
            logger.info(text)

    def report_values(self, part: str, values: dict[str, str]) -> None:
        """Attach values to a part without changing its state."""
        with self._lock:
            self._parts[part].values.update(values)

    def level(self, part: str) -> bytes:
        """The level last reported for a part."""
        with self._lock:
            return self._parts[part].level

    def publish(self) -> None:
        """Publish all parts on ``/diagnostics``."""
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        name = self._node.get_fully_qualified_name().lstrip("/")
        with self._lock:
            for part, state in self._parts.items():
                array.status.append(
                    DiagnosticStatus(
                        level=state.level,
                        name=f"{name}: {part}",
                        message=state.message,
                        hardware_id=name,
                        values=[KeyValue(key=key, value=value) for key, value in state.values.items()],
                    )
                )
        if self._node.context.ok():
            self._publisher.publish(array)
