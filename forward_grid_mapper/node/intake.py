"""From subscriptions to the associator, in portions, with counts of lost messages."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from nav_msgs.msg import Odometry
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Range

from ..core.common.parameters import Parameters
from ..core.messages.message_types import OdometryMessage, RangeMessage, odometry_message, range_message, stamp_of
from ..core.messages.pose_association import MOST_WAITING, PoseAssociator
from ..core.messages.rep117 import corrected
from ..core.messages.repeated_topics import RepeatedTopics
from ..core.messages.sensor_records import has_room
from .clocks import Arrivals, OdometryClock, SensorClocks
from .draining import Draining
from .frames import MapFrame
from .losses import LOSS_WARNING, Losses
from .sensor_silence import SensorSilence

QUEUE = 2000
"""Most messages that may wait for the node in the middleware, so that none is lost in a pause of a second."""

AT_ONCE = 200
"""Messages, or readings, of one portion: about 2 ms of the executor's time."""


class _InMapFrame(NamedTuple):
    """Odometry whose pose is in the map frame."""

    message: OdometryMessage


class _Pending(NamedTuple):
    """A message that waits for the associator.

    Attributes
    ----------
    message : RangeMessage, OdometryMessage or _InMapFrame
    sent : int
        When it was published, nanoseconds of the system's clock, 0 if unknown.
    paused : bool
        Whether mapping was paused when it arrived.
    """

    message: RangeMessage | OdometryMessage | _InMapFrame
    sent: int
    paused: bool


class Intake:
    """Receives messages, and holds them back while the associator is not ready.

    Attributes
    ----------
    paused : bool
    reliable : bool
        Whether QoS of ranges is reliable, so that lost messages are a fault.
    range_losses : list of Losses
        Of each Range topic.
    silence : SensorSilence
        The time of each sensor's last message.
    odometry_arrived : int
        Odometry messages received, including waiting ones and those before a reset.
    """

    def __init__(
        self,
        node: Any,
        parameters: Parameters,
        associator: PoseAssociator,
        map_frame: MapFrame,
        on_taken: Callable[[int], object],
    ) -> None:
        """Prepare for `subscribe`; messages are held back until `begin`.

        Parameters
        ----------
        node : Node
        parameters : Parameters
        associator : PoseAssociator
        map_frame : MapFrame
        on_taken : callable
            Receives the time at which each Range was published, nanoseconds of the system's clock.
        """
        own = parameters.node
        self._node, self._associator, self._map_frame, self._on_taken = node, associator, map_frame, on_taken
        self.paused = self._ready = False
        self.reliable = own.range_reliability == 'reliable'
        self.silence = SensorSilence()
        self._repeated = RepeatedTopics()
        self._repeated_logged: set[str] = set()
        self._odometry_clock = OdometryClock(associator, node.get_logger().warning)
        self._sensor_clocks = SensorClocks(node.get_logger().warning)
        self._arrivals, self._odometry_arrivals = Arrivals(), Arrivals()
        # in the order of arrival
        self._pending: deque[_Pending] = deque()
        self._pending_ranges = self._losses_logged = self.odometry_arrived = 0
        # those refused before `begin`, by frame: the last one, and their number
        self._refused: dict[str, tuple[RangeMessage, int]] = {}
        self._next_warning = 0.0
        self._more = node.create_guard_condition(self.work)
        self._own = own
        # two names may resolve to the same topic
        self._topics = list({node.resolve_topic_name(topic): topic for topic in own.range_topics}.values())
        self._subscribed: list[Any] = []
        self.subscriptions: dict[str, QoSProfile] = {}
        self.range_losses = [self._losses(topic) for topic in self._topics]
        self._odometry_losses = self._losses(own.odom_topic)

    @property
    def listening(self) -> bool:
        """Whether the node is subscribed."""
        return bool(self._subscribed)

    def subscribe(self) -> None:
        """Subscribe to all topics, or to none if one fails."""
        own = self._own
        try:
            for topic, losses in zip(self._topics, self.range_losses, strict=True):
                receive = partial(self._on_range_of, topic, losses)
                self._subscribe(Range, topic, own.range_reliability, receive, losses)
            self._subscribe(Odometry, own.odom_topic, own.odom_reliability, self.on_odometry, self._odometry_losses)
        except BaseException:
            # otherwise the next call would subscribe twice
            self.unsubscribe()
            raise

    def unsubscribe(self) -> None:
        """Unsubscribe; messages until the next `subscribe` do not count as lost."""
        for subscription in self._subscribed:
            self._node.destroy_subscription(subscription)
        self._subscribed.clear()
        self.subscriptions.clear()
        self._forget_senders()
        for losses in (*self.range_losses, self._odometry_losses):
            losses.begin_anew()

    def _forget_senders(self) -> None:
        self.silence.clear()
        self._odometry_clock.forget()
        self._sensor_clocks.clear()
        self._arrivals.clear()
        self._odometry_arrivals.clear()

    def _losses(self, topic: str) -> Losses:
        return Losses(lambda: int(self._node.count_publishers(self._node.resolve_topic_name(topic))))

    def _subscribe(self, kind: Any, topic: str, reliability: str, callback: Any, losses: Losses) -> None:
        quality = QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy[reliability.upper()])
        draining = Draining(callback)
        subscribe = partial(self._node.create_subscription, kind, topic, draining, quality)
        try:
            made = subscribe(event_callbacks=SubscriptionEventCallbacks(message_lost=losses.reported))
        except UnsupportedEventTypeError:
            # a middleware need not report losses; those that `Losses` finds in the messages remain
            made = subscribe()
        draining.subscription = made
        self._subscribed.append(made)
        self.subscriptions[self._node.resolve_topic_name(topic)] = quality

    # counts

    @property
    def received(self) -> int:
        """Number of Range messages received: accepted + waiting + rejected."""
        refused = sum(count for _, count in self._refused.values())
        return self._associator.received + self._pending_ranges + refused

    @property
    def waiting(self) -> int:
        """Number of readings that wait, for a pose or for the associator."""
        return self._associator.waiting + self._pending_ranges

    @property
    def lost(self) -> int:
        """Number of Range messages lost in the middleware, estimated."""
        return sum(losses.lost for losses in self.range_losses)

    @property
    def odometry_lost(self) -> int:
        """Number of Odometry messages lost in the middleware, estimated."""
        return self._odometry_losses.lost

    @property
    def clock_jumped(self) -> bool:
        """Whether the stamps of odometry jumped in the last seconds."""
        return self._odometry_clock.jumped

    def faults(self) -> list[str]:
        """Return the faults, in words; losses and clocks are logged as well, at most every few seconds."""
        clocks = [*self._odometry_clock.faults(), *self._sensor_clocks.faults()]
        return [*self._loss_faults(), *clocks, *self.repeated()]

    def _loss_faults(self) -> list[str]:
        now = time.monotonic()
        recent = max(losses.recent for losses in (*self.range_losses, self._odometry_losses))
        if now > recent + LOSS_WARNING:
            return []
        remedy = (
            'this node was stopped or its machine is overloaded: reduce the rate of messages, or the load of the '
            'machine'
            if self.reliable
            else (
                'the network or this machine is too slow for them; with range_reliability and odom_reliability: '
                'reliable, lost messages are sent again'
            )
        )
        text = (
            f'{self.lost} Range and {self.odometry_lost} odometry messages so far were lost before this node received '
            f'them (estimated): {remedy}'
        )
        if now > self._next_warning and self.lost + self.odometry_lost > self._losses_logged:
            self._next_warning, self._losses_logged = now + LOSS_WARNING, self.lost + self.odometry_lost
            self._node.get_logger().warning(text)
        return [text]

    def loss_note(self) -> list[str]:
        """Return a warning about lost messages for the report, or none."""
        if not self.lost + self.odometry_lost:
            return []
        return [
            f'{self.lost} Range and {self.odometry_lost} odometry messages were lost before the node received them '
            '(estimated); they are missing in the maps'
        ]

    def clock_notes(self) -> list[str]:
        """Return warnings about sensors with wrong stamps for the report, also if these have ended, or none."""
        return self._sensor_clocks.notes()

    def repeated(self) -> list[str]:
        """Return warnings about topics with the same readings; each is logged once."""
        found = self._repeated.notes(
            self._topics, lambda topics: f'To use one, set range_topics to {", ".join(topics)}'
        )
        for text in found:
            if text not in self._repeated_logged:
                self._repeated_logged.add(text)
                self._node.get_logger().warning(text)
        return found

    # messages

    def _on_range_of(self, topic: str, losses: Losses, message: Range, info: dict[str, Any]) -> None:
        if len(self._topics) > 1:
            header = message.header
            self._repeated.add(topic, header.frame_id, stamp_of(header), message.range)
        self.on_range(losses, message, info)

    def on_range(self, losses: Losses, message: Range, info: dict[str, Any]) -> None:
        """Receive a Range."""
        made, sent = range_message(message), info['source_timestamp']
        losses.taken(info, made.frame_id, made.stamp)
        self.silence.note(made.frame_id)
        self._on_taken(sent)
        stamp = corrected(made.stamp, self._associator.parameters)
        self._sensor_clocks.note(made.frame_id, stamp, self._arrivals.of(made.frame_id, info))
        if self._ready and not self._pending and not self._associator.behind:
            self._process(_Pending(made, sent, self.paused))
        elif self._pending_ranges >= MOST_WAITING:
            self._refuse(made)
        else:
            self._pending_ranges += 1
            self._hold(made, sent)
        self._wake()

    def on_odometry(self, message: Odometry, info: dict[str, Any]) -> None:
        """Receive an Odometry."""
        made, sent = odometry_message(message), info['source_timestamp']
        self.odometry_arrived += 1
        self._odometry_losses.taken(info, made.frame_id, made.stamp)
        self._sensor_clocks.note_odometry(made.stamp, self._odometry_arrivals.of('odometry', info))
        if self._ready and not self._pending and not self._associator.behind:
            self._process(_Pending(made, sent, self.paused))
        elif len(self._pending) - self._pending_ranges < MOST_WAITING:
            self._hold(made, sent)
        else:
            self._odometry_losses.dropped()
        self._wake()

    def begin(self) -> None:
        """Give the associator the messages held back, and later ones as they arrive."""
        self._ready = True
        for message, count in self._refused.values():
            self._associator.reject(message, 'too_many_waiting', count)
        self._refused.clear()
        self._wake()

    def work(self) -> None:
        """Process a portion of the remaining work; called by the executor."""
        if not self._ready:
            return
        done = self._associator.settled + AT_ONCE
        for _ in range(AT_ONCE):
            if self._associator.settled >= done or not self.busy:
                break
            if self._associator.behind:
                self._associator.settle()
                continue
            pending = self._pending.popleft()
            self._pending_ranges -= isinstance(pending.message, RangeMessage)
            self._process(pending)
        self._wake()

    def forget(self) -> None:
        """Forget the messages held back, and all counts."""
        self._pending.clear()
        self._pending_ranges = 0
        self._map_frame.forget()
        for losses in (*self.range_losses, self._odometry_losses):
            losses.clear()
        self._losses_logged = 0
        self._repeated = RepeatedTopics()
        self._repeated_logged.clear()
        self._forget_senders()
        self._sensor_clocks.forget()

    @property
    def busy(self) -> bool:
        """Whether work remains before the next message."""
        return bool(self._pending) or self._associator.behind

    def _hold(self, message: RangeMessage | OdometryMessage, sent: int) -> None:
        self._pending.append(_Pending(message, sent, self.paused))

    def _refuse(self, message: RangeMessage) -> None:
        if self._ready:
            self._associator.reject(message, 'too_many_waiting')
        else:
            # another thread uses the associator
            frame = message.frame_id if has_room(self._refused, message.frame_id) else ''
            _, count = self._refused.get(frame, (message, 0))
            self._refused[frame] = message, count + 1

    def _process(self, pending: _Pending) -> None:
        """Give a message to the associator; odometry may first have to wait for the transform to the map frame."""
        message, sent, paused = pending
        if isinstance(message, OdometryMessage):
            converted = self._map_frame.convert(message)
            # the others are processed in turn with the waiting messages
            self._pending.extendleft(_Pending(_InMapFrame(other), sent, False) for other in reversed(converted[1:]))
            if converted:
                self._add_odometry(converted[0], sent)
        elif isinstance(message, _InMapFrame):
            self._add_odometry(message.message, sent)
        elif paused:
            self._associator.reject(message, 'paused')
        else:
            self._associator.add_range(message, sent)

    def _add_odometry(self, message: OdometryMessage, sent: int) -> None:
        self._associator.add_odometry(message, sent)
        self._odometry_clock.check()

    def _wake(self) -> None:
        if self._ready and self.busy:
            self._more.trigger()
