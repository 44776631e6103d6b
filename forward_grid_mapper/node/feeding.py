"""The live map and the online map of the node: new readings go to their threads, and snapshots to the publishers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..core.common.parameters import Parameters
from ..core.maps.log_odds_map import LogOddsMap
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.reading_buffer import bounded
from .background import Inbox
from .kernels import Kernels
from .live import LiveMap, LiveSnapshot
from .map_publishers import MapPublishers
from .online import OnlineSnapshot, OnlineWorker
from .trajectory import Trajectory


class Feed:
    """Gives the accepted readings to both maps, placed by the trajectory. The executor owns it.

    Attributes
    ----------
    live : LiveMap
    online : OnlineWorker or None
        None if the parameter `online` is false.
    shows_online : callable
        Returns whether the online map is published.
    """

    def __init__(
        self,
        parameters: Callable[[], Parameters],
        associator: PoseAssociator,
        trajectory: Trajectory,
        publishers: MapPublishers,
        inbox: Inbox,
        kernels: Kernels,
        log: Any,
    ) -> None:
        self.shows_online: Callable[[], bool] = lambda: True
        self._parameters, self._associator, self._trajectory = parameters, associator, trajectory
        self._publishers, self._inbox = publishers, inbox
        self._live_fed = self._online_fed = 0
        p = parameters()
        self.live = LiveMap(p, self.show_live, log.error, lambda: kernels.wait('live map'))
        self.online: OnlineWorker | None = None
        if p.node.online:
            self.online = OnlineWorker(p, self._publish_online, log.error, lambda: kernels.wait('online map'))

    def feed(self) -> None:
        """Give new readings to the maps; their threads add them."""
        buffer, online = self._associator.buffer, self.online
        if len(buffer) > self._live_fed:
            self.live.offer(buffer.snapshot(self._live_fed), self._trajectory.place)
            self._live_fed = len(buffer)
        if online is None:
            return
        if len(buffer) > self._online_fed:
            if buffer.bound and online.kept > buffer.bound + buffer.bound // 4:
                self.restart_online()
            else:
                online.offer(buffer.snapshot(self._online_fed), self._trajectory.place)
                self._online_fed = len(buffer)
        online.tick()

    def publish(self) -> None:
        """Have the live map published if it has changed."""
        self.feed()
        self.live.publish()

    def when_up_to_date(self, answer: Callable[[], None], failed: Callable[[str], object]) -> None:
        """Call `answer` once the live map contains all readings and is published, or `failed` with a reason."""
        self.feed()
        self.live.publish(now=True)
        self.live.when_added(answer, failed)

    def replace(self, live: LogOddsMap | None, count: int) -> None:
        """Continue with another trajectory: with the live map of the first `count` readings, and a new online map.

        Without a live map only the name of the frame has changed.
        """
        if live is None:
            self.live.touch()
        else:
            self.live.replace(live)
            self._live_fed = count
            self.restart_online()
            self.feed()
        # together with the transform
        self.live.publish(now=True)

    def restart_online(self) -> None:
        """Begin the online map again, from the readings that are kept."""
        if self.online:
            buffer = self._associator.buffer
            self._online_fed = len(buffer)
            held, bound, place = buffer.snapshot(), buffer.bound, self._trajectory.place or (lambda readings: readings)
            self.online.restart(self._parameters(), (lambda: place(bounded(held, bound))) if len(held) else None)

    def reset(self) -> None:
        """Begin both maps again without readings."""
        self.live.restart(self._parameters(), self._publishers.generation)
        self._live_fed = 0
        self.restart_online()

    def close(self) -> None:
        """Cancel the work, and wait a moment for the end of the threads."""
        if self.online:
            self.online.close(2.0)
        self.live.worker.close(0.5)

    def show_live(self, snapshot: LiveSnapshot) -> None:
        """Publish the live map; called in its thread."""
        self._publishers.publish('live_map', snapshot.generation, snapshot.grid, snapshot.probability)

    def _publish_online(self, snapshot: OnlineSnapshot) -> None:
        generation = self._publishers.generation
        self._inbox.put(lambda: self._show_online(snapshot, generation))

    def _show_online(self, snapshot: OnlineSnapshot, generation: int) -> None:
        if self.online and snapshot.epoch == self.online.epoch and self.shows_online():
            self._publishers.publish('ml_map', generation, snapshot.grid, snapshot.ml)
            self._publishers.publish('uncertainty_map', generation, snapshot.grid, snapshot.uncertainty)
