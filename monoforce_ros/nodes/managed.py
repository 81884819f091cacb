"""ManagedNode: a lifecycle node that starts by itself unless told to wait for its manager."""

from __future__ import annotations

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn


class ManagedNode(LifecycleNode):
    """Base of nodes whose work can be set up, started, paused and taken down from outside.

    A child sets up in :meth:`set_up` (publishers, subscriptions, timers, models), works between :meth:`begin` and
    :meth:`pause`; whatever it created on the node since set-up is destroyed when it is taken down.
    """

    def __init__(self, name: str):
        super().__init__(name)
        self._failure: Exception | None = None
        self._before: set[int] = set()
        self._active = self._starting = False

    def set_up(self) -> None:
        """Make ready to work.

        Raises:
            ValueError, OSError: it cannot; the message says why.
        """

    def begin(self) -> None:
        """Start to work."""

    def pause(self) -> None:
        """Stop to work, ready to begin again."""

    def autostart(self) -> None:
        """Configure and activate at once, as nodes without a manager do.

        Raises:
            ValueError, OSError: what :meth:`set_up` raised.
        """
        self._starting = True
        configured = self.trigger_configure()
        self._starting = False
        if configured != TransitionCallbackReturn.SUCCESS:
            raise self._failure or ValueError(f"{self.get_name()} could not be configured")
        if self.trigger_activate() != TransitionCallbackReturn.SUCCESS:
            raise self._failure or ValueError(f"{self.get_name()} could not be activated")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Set up; back to unconfigured where that fails."""
        self._before = {id(entity) for entity in self._entities()}
        try:
            self.set_up()
        except (ValueError, OSError) as error:
            self._failure = error
            if not self._starting:
                self.get_logger().error(f"not configured: {error}")
            self._take_down()
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin."""
        self._active = True
        self.begin()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pause."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down what set-up made."""
        self._take_down()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pause and take down, from whatever state."""
        self._stop()
        self._take_down()
        return TransitionCallbackReturn.SUCCESS

    def destroy_node(self) -> None:
        """Stop to work, then end the node."""
        self._stop()
        super().destroy_node()

    def _stop(self) -> None:
        if self._active:
            self._active = False
            self.pause()

    def _entities(self) -> list:
        return [*self.publishers, *self.subscriptions, *self.timers]

    def _take_down(self) -> None:
        made = [entity for entity in self._entities() if id(entity) not in self._before]
        timers, subscriptions = set(self.timers), set(self.subscriptions)
        for entity in made:
            if entity in timers:
                self.destroy_timer(entity)
            elif entity in subscriptions:
                self.destroy_subscription(entity)
            else:
                self.destroy_publisher(entity)
