"""Why a robot has to stand: for now, or for this goal."""

from __future__ import annotations


class Stop(Exception):  # noqa: N818  (no error: the robot has to stand)
    """The robot has to stop; the message says why, ``reason`` is a short key of it."""

    def __init__(self, message: str, reason: str):
        super().__init__(message)
        self.reason = reason


class Refusal(Exception):  # noqa: N818  (as Stop)
    """The goal or plan cannot be driven to and is dropped; the message says why."""


class Unfollowed(Refusal):
    """The robot does not carry out its commands, or comes no nearer: a planner that sends the same plan again and again
    must not set it in motion once more."""
