"""A node with a lifecycle, which Nav2's lifecycle manager can drive, or that starts by itself."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from rosgraph_msgs.msg import Clock

from ..core.common.errors import MapperError
from .complaints import of_ros

try:
    from rclpy.lifecycle import LifecycleNode as Base
    from rclpy.lifecycle.node import TransitionCallbackReturn

    MANAGED = True
except ImportError:  # without lifecycle_msgs it is a node like any other, and starts by itself
    from rclpy.node import Node as Base

    MANAGED = False


class ManagedNode(Base):
    """Turns transitions into four methods, and destroys after the last what was created since the first.

    A subclass has `configure`, `activate`, `deactivate` and `close`. What they raise refuses the transition, and is
    logged; the node is then as it was before. What a `configure` that failed has created is destroyed here, what an
    `activate` that failed has created it destroys itself.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._created: list[tuple[Callable[[Any], Any], Any]] = []
        self._refusal: Exception | None = None
        self._starting = False
        super().__init__(name, **options)
        # what the node itself is made of stays
        self._created.clear()
        for service in self.services:
            if service.srv_name.endswith('/change_state'):
                service.callback = self._answered(service.callback)

    # for subclasses

    def configure(self) -> None:
        """Make everything but subscriptions."""

    def activate(self) -> None:
        """Begin to take messages."""

    def deactivate(self) -> None:
        """Take no messages any more."""

    def close(self) -> None:
        """End what `configure` began."""

    # starting without a manager

    def start(self) -> None:
        """Configure and activate.

        Raises
        ------
        Exception
            What either raised.
        """
        self._starting = True
        try:
            if not MANAGED:
                self.configure()
                self.activate()
                return
            for turn in (self.trigger_configure, self.trigger_activate):
                turn()
                if self._refusal is not None:
                    raise self._refusal
        finally:
            self._starting = False

    def wait_for_manager(self) -> None:
        """Say that the node waits to be configured.

        Raises
        ------
        MapperError
            If nobody could.
        """
        if not MANAGED:
            raise MapperError('autostart is false, but without lifecycle_msgs nothing else can start the node')
        self.get_logger().info('unconfigured: a lifecycle manager, or `ros2 lifecycle set`, has to configure the node')

    # transitions

    def on_configure(self, state: Any) -> Any:
        """Configure the node."""
        return self._turn(self.configure, undo=True)

    def on_activate(self, state: Any) -> Any:
        """Activate the node."""
        return self._turn(self.activate)

    def on_deactivate(self, state: Any) -> Any:
        """Deactivate the node."""
        return self._turn(self.deactivate)

    def on_cleanup(self, state: Any) -> Any:
        """Make the node unconfigured."""
        return self._turn(self._undo)

    def on_shutdown(self, state: Any) -> Any:
        """End the node's work for good; its process goes on until it is ended."""
        return self._turn(self._undo)

    def on_error(self, state: Any) -> Any:
        """Make the node unconfigured after something failed."""
        return self._turn(self._undo)

    def _turn(self, work: Callable[[], None], undo: bool = False) -> Any:
        """Do the work of a transition; return whether it succeeded."""
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
                self.get_logger().error(of_ros(error) if expected else traceback.format_exc())
            return TransitionCallbackReturn.FAILURE

    def _answered(self, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Have a transition that the state does not admit answered, which rclpy's service leaves without an answer."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except Exception as error:  # a class of rclpy's C extension
                self.get_logger().warning(f'a transition was refused: {of_ros(error)}')
                response.success = False
                return response

        return answer

    def _undo(self) -> None:
        """End the work, and destroy what was created for it."""
        self.close()
        while self._created:
            destroy, entity = self._created.pop()
            destroy(entity)

    def destroy_node(self) -> None:
        """Destroy the node; its state machine too, which would keep it in the middleware."""
        super().destroy_node()
        # rclpy has no call for that
        self.__dict__.pop('_state_machine', None)

    # what is created is noted

    def create_publisher(self, *arguments: Any, **options: Any) -> Any:
        """Create a publisher, as `Node` does."""
        return self._noted(super().create_publisher(*arguments, **options), self.destroy_publisher)

    def create_subscription(self, *arguments: Any, **options: Any) -> Any:
        """Create a subscription, as `Node` does."""
        made = super().create_subscription(*arguments, **options)
        # rclpy's own, made when use_sim_time is set: without it the clock would stand still for good
        return made if made.msg_type is Clock else self._noted(made, self.destroy_subscription)

    def destroy_subscription(self, subscription: Any) -> Any:
        """Destroy a subscription, as `Node` does, and forget it: there are others with every activation."""
        self._created = [noted for noted in self._created if noted[1] is not subscription]
        return super().destroy_subscription(subscription)

    def create_service(self, *arguments: Any, **options: Any) -> Any:
        """Create a service, as `Node` does."""
        return self._noted(super().create_service(*arguments, **options), self.destroy_service)

    def create_timer(self, *arguments: Any, **options: Any) -> Any:
        """Create a timer, as `Node` does."""
        return self._noted(super().create_timer(*arguments, **options), self.destroy_timer)

    def create_guard_condition(self, *arguments: Any, **options: Any) -> Any:
        """Create a guard condition, as `Node` does."""
        return self._noted(super().create_guard_condition(*arguments, **options), self.destroy_guard_condition)

    def _noted(self, entity: Any, destroy: Callable[[Any], Any]) -> Any:
        self._created.append((destroy, entity))
        return entity
