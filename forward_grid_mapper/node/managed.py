"""A lifecycle node: started by Nav2's lifecycle manager, or by itself."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from functools import partial
from typing import Any

from rosgraph_msgs.msg import Clock

from ..core.common.errors import MapperError
from .error_explanations import explain_ros_error

try:
    from rclpy.lifecycle import LifecycleNode as Base
    from rclpy.lifecycle.node import TransitionCallbackReturn

    MANAGED = True
except ImportError:  # without lifecycle_msgs it is a node like any other, and starts by itself
    from rclpy.node import Node as Base

    MANAGED = False


CLEANED_UP = 'the node is being cleaned up'
"""The reason for which calls of services fail that wait at *clean up*."""


class ManagedNode(Base):
    """Maps transitions to four methods, and destroys at cleanup what was created since the configuration.

    A subclass has `configure`, `activate`, `deactivate` and `close`. If one of the first three raises, the transition
    fails, and the error is logged; the node keeps its state. What a failed `configure` has created is destroyed here; a
    failed `activate` destroys it itself. If `close` raises, the error is logged, and the transition succeeds, since
    nothing is left that the node could return to.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._created: list[tuple[Callable[[Any], Any], Any]] = []
        self._refusal: Exception | None = None
        self._starting = False
        super().__init__(name, **options)
        # entities of the node itself are not destroyed at cleanup
        self._created.clear()
        for service in self.services:
            if service.srv_name.endswith('/change_state'):
                service.callback = self._answered(service.callback)

    # for subclasses

    def configure(self) -> None:
        """Create everything except subscriptions."""

    def activate(self) -> None:
        """Subscribe."""

    def deactivate(self) -> None:
        """Unsubscribe."""

    def close(self, why: str = CLEANED_UP) -> None:
        """End the work that `configure` began; calls that wait are told `why`."""

    # starting without a manager

    def start(self) -> None:
        """Configure and activate.

        Raises
        ------
        Exception
            If either failed.
        """
        self._starting = True
        try:
            if not MANAGED:
                self.configure()
                self.activate()
                return
            for transition in (self.trigger_configure, self.trigger_activate):
                transition()
                if self._refusal is not None:
                    raise self._refusal
        finally:
            self._starting = False

    def wait_for_manager(self) -> None:
        """Log that the node waits for its configuration.

        Raises
        ------
        MapperError
            If there is no lifecycle service.
        """
        if not MANAGED:
            raise MapperError('autostart is false, but without lifecycle_msgs nothing else can start the node')
        self.get_logger().info('unconfigured: a lifecycle manager, or `ros2 lifecycle set`, has to configure the node')

    # transitions

    def on_configure(self, state: Any) -> Any:
        """Configure the node."""
        return self._transition(self.configure, undo=True)

    def on_activate(self, state: Any) -> Any:
        """Activate the node."""
        return self._transition(self.activate)

    def on_deactivate(self, state: Any) -> Any:
        """Deactivate the node."""
        return self._transition(self.deactivate)

    def on_cleanup(self, state: Any) -> Any:
        """Make the node unconfigured."""
        return self._transition(self._undo)

    def on_shutdown(self, state: Any) -> Any:
        """End the node's work; its process continues until it is stopped."""
        return self._transition(partial(self._undo, 'the node is being shut down'))

    def on_error(self, state: Any) -> Any:
        """Make the node unconfigured after something failed."""
        return self._transition(self._undo)

    def _transition(self, work: Callable[[], None], undo: bool = False) -> Any:
        """Do the work of a transition, and return its result."""
        try:
            self._refusal = None
            work()
            return TransitionCallbackReturn.SUCCESS
        except Exception as error:
            if undo:
                self._undo()
            self._refusal = error
            if not self._starting:
                expected = isinstance(error, (MapperError, ValueError)) or type(error).__name__ == 'RCLError'
                self.get_logger().error(explain_ros_error(error) if expected else traceback.format_exc())
            return TransitionCallbackReturn.FAILURE

    def _answered(self, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a callback that answers an invalid transition; rclpy's service would not answer."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except Exception as error:  # a class of rclpy's C extension
                self.get_logger().warning(f'a transition was refused: {explain_ros_error(error)}')
                response.success = False
                return response

        return answer

    def _undo(self, why: str = CLEANED_UP) -> None:
        """End the work, and destroy the entities created for it; what fails is logged, and the rest is done."""
        self._attempt(partial(self.close, why))
        while self._created:
            destroy, entity = self._created.pop()
            self._attempt(partial(destroy, entity))

    def _attempt(self, work: Callable[[], object]) -> None:
        """Do a part of ending the work; if it fails, log it, so that the other parts are done."""
        try:
            work()
        except Exception:
            self.get_logger().error(f'a part of the node did not end in order: {traceback.format_exc()}')

    def destroy_node(self) -> None:
        """Destroy the node, and its state machine, which would keep the node in the middleware."""
        super().destroy_node()
        # rclpy has no function for that
        self.__dict__.pop('_state_machine', None)

    # created entities are recorded

    def create_publisher(self, *arguments: Any, **options: Any) -> Any:
        """Create a publisher, as `Node` does."""
        return self._recorded(super().create_publisher(*arguments, **options), self.destroy_publisher)

    def create_subscription(self, *arguments: Any, **options: Any) -> Any:
        """Create a subscription, as `Node` does."""
        made = super().create_subscription(*arguments, **options)
        # rclpy creates it when use_sim_time is set: without it the clock would stop for ever
        return made if made.msg_type is Clock else self._recorded(made, self.destroy_subscription)

    def destroy_subscription(self, subscription: Any) -> Any:
        """Destroy a subscription, as `Node` does, and forget it, since each activation creates others."""
        self._created = [noted for noted in self._created if noted[1] is not subscription]
        return super().destroy_subscription(subscription)

    def create_service(self, *arguments: Any, **options: Any) -> Any:
        """Create a service, as `Node` does."""
        return self._recorded(super().create_service(*arguments, **options), self.destroy_service)

    def create_timer(self, *arguments: Any, **options: Any) -> Any:
        """Create a timer, as `Node` does."""
        return self._recorded(super().create_timer(*arguments, **options), self.destroy_timer)

    def create_guard_condition(self, *arguments: Any, **options: Any) -> Any:
        """Create a guard condition, as `Node` does."""
        return self._recorded(super().create_guard_condition(*arguments, **options), self.destroy_guard_condition)

    def _recorded(self, entity: Any, destroy: Callable[[Any], Any]) -> Any:
        self._created.append((destroy, entity))
        return entity
