"""ManagedNode: a lifecycle node that starts automatically or through a lifecycle manager."""

from __future__ import annotations

import traceback

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.timer import Timer


class ManagedNode(LifecycleNode):
    """Base class of nodes that can be configured, activated, deactivated and cleaned up from outside.

    A subclass creates publishers, subscriptions, timers and models in :meth:`set_up`, and works between :meth:`begin`
    and :meth:`pause`. Clean-up destroys whatever was created on the node since set-up.
    """

    def __init__(self, name: str):
        super().__init__(name)
        self._failure: Exception | None = None
        self._entities_before: set[int] = set()
        self._active = self._autostarting = False
        self.configured = False
        """Whether the node is set up, or being set up."""

    def set_up(self) -> None:
        """Get ready to work.

        Raises:
            ValueError, OSError: it cannot; the message says why.
        """

    def begin(self) -> None:
        """Start working."""

    def pause(self) -> None:
        """Stop working, ready to begin again."""

    def autostart(self) -> None:
        """Configure and activate at once, as nodes without a manager do.

        Raises:
            ValueError, OSError: as raised by :meth:`set_up`; other errors become a ``ValueError``, and their
                traceback is logged.
        """
        self._autostarting = True
        configured = self.trigger_configure()
        self._autostarting = False
        if configured != TransitionCallbackReturn.SUCCESS:
            raise self._reason("configured")
        if self.trigger_activate() != TransitionCallbackReturn.SUCCESS:
            raise self._reason("activated")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Set up; back to unconfigured if that fails."""
        self._entities_before = {id(entity) for entity in self._entities()}
        self.configured = True
        try:
            self.set_up()
        except (ValueError, OSError) as error:
            self._failure = error
            if not self._autostarting:
                self.get_logger().error(f"not configured: {error}")
            self._clean_up()
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self._log_unexpected("not configured", error)
            self._clean_up()
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin."""
        self._active = True
        try:
            self.begin()
        except Exception as error:
            self._active = False
            self._log_unexpected("not activated", error)
            return TransitionCallbackReturn.ERROR
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pause."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Destroy everything created since set-up."""
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pause and clean up, from any state."""
        self._stop()
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def destroy_node(self) -> None:
        """Stop working, then destroy the node."""
        self._stop()
        super().destroy_node()

    def _log_unexpected(self, outcome: str, error: Exception) -> None:
        """Log an error that no input explains; rclpy drops exceptions of transition callbacks silently."""
        self._failure = error
        self.get_logger().error(f"{outcome}: {type(error).__name__}: {error}\n{traceback.format_exc()}")

    def _reason(self, transition: str) -> Exception:
        """The error to raise after a failed transition."""
        error = self._failure
        if isinstance(error, ValueError | OSError):
            return error
        cause = "" if error is None else f": {type(error).__name__}: {error}"
        return ValueError(f"{self.get_name()} could not be {transition}{cause}")

    def _stop(self) -> None:
        if self._active:
            self._active = False
            self.pause()

    def _entities(self) -> list[Publisher | Subscription | Timer]:
        return [*self.publishers, *self.subscriptions, *self.timers]

    def _clean_up(self) -> None:
        self.configured = False
        created = [entity for entity in self._entities() if id(entity) not in self._entities_before]
        for entity in created:
            if isinstance(entity, Timer):
                self.destroy_timer(entity)
            elif isinstance(entity, Subscription):
                self.destroy_subscription(entity)
            else:
                self.destroy_publisher(entity)
