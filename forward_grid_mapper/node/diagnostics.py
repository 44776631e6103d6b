"""The diagnostics of the node, published once a second."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from ..core.common.grid import Grid
from ..core.messages.message_types import NANOSECONDS
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.rep117 import ODOMETRY_REASONS, REASONS
from .em import Run
from .intake import Intake

SILENCE = 3.0
"""Seconds without odometry or Range before a warning."""

RECENT = 10.0
"""Longest time, seconds, over which rejected readings are counted: if a sensor measures rarely, or many have been
rejected, so that the status does not change with each reading."""

ENOUGH_READINGS = 10
"""Readings after which the last second alone is enough."""

MANY_IN_A_SECOND, MANY_RECENTLY, FEW_RECENTLY = 0.2, 0.1, 0.05
"""Fraction of the readings whose rejection gives a warning, if that of the last `RECENT` seconds is above the second
number as well; and that of these seconds which ends it. One second may have many by chance."""

NEARLY_FULL = 0.9
"""Fraction of `max_readings` from which a warning says that readings will be removed."""

MOST_SHOWN = 20
"""Most names of frames in a message."""

STREAMS = ('odometry', 'stamp of odometry', 'range')
"""Inputs that keep changing while the robot sends."""

NO_POSE = 'no pose on the robot for '
"""Start of the message that names frames without a pose."""

MAPPING = 'mapping'
"""The message if readings arrive, are accepted, and nothing is wrong."""


class Health:
    """Watches the input and makes the diagnostics."""

    def __init__(self) -> None:
        self._begin = time.monotonic()
        self._last: dict[str, tuple[int, float]] = {}
        self._recent = _Recent()
        self._refused = 0
        self._slowest = 0

    def taken(self, sent: int) -> None:
        """Note the delay of a reading that was published at `sent`, nanoseconds of the system's clock."""
        # not every middleware gives the time of publishing
        if sent:
            self._slowest = max(self._slowest, time.time_ns() - sent)

    def statuses(
        self,
        name: str,
        intake: Intake,
        associator: PoseAssociator,
        run: Run | None,
        last_run: str,
        grid: Grid,
        extra: dict[str, Any],
        map_frame: str = '',
        absent: Callable[[str], str] = lambda kind: '',
    ) -> list[DiagnosticStatus]:
        """Return the statuses of input and of EM.

        `map_frame` is the fault of the transform to the map frame, '' if none; `absent` returns the reason why no
        message of a kind arrives, 'Range' or 'Odometry'.
        """
        level, message = self._judge(associator, intake, map_frame, absent)
        bound = associator.parameters.max_readings
        kept = min(associator.buffer.stored, bound or associator.buffer.stored)
        values = {
            'readings received': intake.received,
            'readings accepted': len(associator.buffer),
            'readings kept to map from': f'{kept} of at most {bound}' if bound else kept,
            'readings waiting for a pose': intake.waiting,
            'readings rejected': sum(associator.rejected.values()),
            'readings lost in the middleware (estimated)': intake.lost,
            **{f'rejected: {reason}': count for reason, count in sorted(dict(associator.rejected).items())},
            'longest delay of a reading (ms)': f'{self._slowest / 1e6:.1f}',
            'odometry received': associator.odometry_received,
            'odometry lost in the middleware (estimated)': intake.odometry_lost,
            **{f'odometry rejected: {reason}': count for reason, count in sorted(associator.odometry_rejected.items())},
            'clock jumps back': associator.time_jumps,
            'frames without a pose': listed(associator.unknown_frames),
            'map size': f'{grid.width} x {grid.height} cells of {grid.resolution} m',
            **extra,
        }
        self._slowest = 0
        em = {'state': str(run) if run else 'idle', 'last run': last_run}
        return [
            status(f'{name}: readings', level, message, name, values),
            status(f'{name}: EM', DiagnosticStatus.OK, em['state'], name, em),
        ]

    def _judge(
        self, associator: PoseAssociator, intake: Intake, map_frame: str, absent: Callable[[str], str]
    ) -> tuple[bytes, str]:
        received = intake.received
        # called each time, since a reset sets the counters to 0
        recent, many = self._recent.update(received, associator.rejected)
        new, by_reason, time_span = recent
        nowhere = self._silence('frames without a pose', associator.rejected['unknown_extrinsics'])
        refused = sum(associator.odometry_rejected.values())
        # also messages that the associator has not processed yet
        silent_odometry = self._silence('odometry', intake.odometry_arrived - refused)
        refused_now, self._refused = refused - self._refused, refused
        stamp = associator.odometry_stamp or 0
        stuck = self._silence('stamp of odometry', stamp)
        silent_ranges = self._silence('range', received)
        if not intake.listening:
            # an inactive node misses nothing
            now = time.monotonic()
            self._last |= {stream: (self._last[stream][0], now) for stream in STREAMS}
            return DiagnosticStatus.OK, 'inactive: nothing is received'
        if intake.paused:
            self._recent.begin_anew()
            return DiagnosticStatus.OK, 'paused'
        if silent_odometry > SILENCE and refused_now > 0:
            reason = max(associator.odometry_rejected, key=lambda key: associator.odometry_rejected[key])
            return DiagnosticStatus.WARN, f'odometry is rejected as {reason}: {ODOMETRY_REASONS[reason]}'
        if map_frame:
            return DiagnosticStatus.WARN, map_frame
        missing = []
        if silent_odometry > SILENCE:
            missing.append(f'no odometry for {silent_odometry:.0f} s{absent("Odometry")}')
        elif stuck > SILENCE and new and associator.odometry_stamp is not None:
            return DiagnosticStatus.WARN, (
                f'odometry is received, but its stamp has been {stamp / NANOSECONDS:.3f} s for {stuck:.0f} s, so that '
                'readings have no pose, or all the same; set header.stamp in its driver'
            )
        if silent_ranges > max(SILENCE, intake.silence.patience):
            missing.append(f'no Range for {silent_ranges:.0f} s{absent("Range")}')
        without_pose = f'{NO_POSE}{listed(associator.unknown_frames)}' if associator.unknown_frames else ''
        if missing:
            # this must stay the message when no readings arrive
            return DiagnosticStatus.WARN, '; '.join([*missing, *filter(None, [without_pose])])
        if without_pose and nowhere < RECENT:
            return DiagnosticStatus.WARN, without_pose
        if many:
            # readings that arrived earlier may have been rejected now
            new = max(new, by_reason.total())
            return DiagnosticStatus.WARN, (
                f'{by_reason.total()} of {new} readings were rejected in the last {time_span}{_main_reason(by_reason)}'
            )
        wrong = associator.rejected - Counter(paused=associator.rejected['paused'])
        if wrong and not len(associator.buffer):
            return DiagnosticStatus.WARN, (
                f'no reading has been accepted so far: {wrong.total()} were rejected{_main_reason(wrong)}'
            )
        if not len(associator.buffer):
            what = 'they wait for their poses' if received else 'none has been received'
            return DiagnosticStatus.OK, f'no reading has been accepted so far: {what}'
        bound = associator.parameters.max_readings
        if bound and NEARLY_FULL * bound < len(associator.buffer) <= bound:
            return DiagnosticStatus.WARN, (
                f'{len(associator.buffer)} readings, and max_readings is {bound}: beyond it, the oldest are removed '
                'where readings are densest'
            )
        return DiagnosticStatus.OK, MAPPING

    def _silence(self, stream: str, count: int) -> float:
        """Return the seconds since a count changed."""
        now = time.monotonic()
        last, since = self._last.get(stream, (0, self._begin))
        if count != last:
            last, since = count, now
        self._last[stream] = last, since
        return now - since


class _Span(NamedTuple):
    """The readings of a time: the number received, rejected readings by reason, and the time in words."""

    received: int
    rejected: Counter[str]
    time: str

    def has(self, fraction: float) -> bool:
        """Return whether more than this fraction of the readings is rejected."""
        return self.received > 0 and self.rejected.total() > fraction * self.received


class _Recent:
    """The readings of the last seconds, and whether many of them are rejected."""

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int, Counter[str]]] = deque([(time.monotonic(), 0, Counter())])
        self._many = False

    def update(self, received: int, rejected: Counter[str]) -> tuple[_Span, bool]:
        """Add the counts; return the span to report, and whether many readings are rejected.

        The span is the last second, or enough seconds to have `ENOUGH_READINGS` readings. After many rejections it is
        longer if the last second has fewer.
        """
        now, looks = time.monotonic(), self._counts
        if received < looks[-1][1]:
            # a reset
            last = looks[-1][0]
            looks.clear()
            looks.append((last, 0, Counter()))
            self._many = False
        looks.append((now, received, rejected.copy()))
        while len(looks) > 2 and now - looks[1][0] >= RECENT:
            looks.popleft()
        k = len(looks) - 2
        while k and received - looks[k][1] < ENOUGH_READINGS:
            k -= 1
        span, whole = self._since(k), self._since(0)
        at_once = span.has(MANY_IN_A_SECOND) and whole.has(MANY_RECENTLY)
        self._many = at_once or (self._many and whole.has(FEW_RECENTLY))
        return (span if at_once or not self._many else whole), self._many

    def _since(self, k: int) -> _Span:
        begin, before, counts = self._counts[k]
        now, received, rejected = self._counts[-1]
        words = 'second' if len(self._counts) - k == 2 else f'{now - begin:.0f} s'
        return _Span(received - before, rejected - counts, words)

    def begin_anew(self) -> None:
        """Ignore all readings so far."""
        self._counts = deque([self._counts[-1]])
        self._many = False


def add_faults(made: DiagnosticStatus, faults: list[str]) -> None:
    """Add faults to the message of a status, and make it a warning."""
    if faults:
        well = made.level == DiagnosticStatus.OK
        made.level = max(made.level, DiagnosticStatus.WARN)
        made.message = '; '.join(faults if well else [made.message, *faults])


def _main_reason(counts: Counter[str]) -> str:
    """Return the most frequent reason of rejection, in words."""
    reason = max(counts, key=lambda key: counts[key], default='')
    return f', most of them as {reason}: {REASONS[reason]}' if reason else ''


def listed(frames: Collection[str]) -> str:
    """Return at most `MOST_SHOWN` names, in words."""
    more = f' and {len(frames) - MOST_SHOWN} more' if len(frames) > MOST_SHOWN else ''
    return ', '.join(sorted(frames)[:MOST_SHOWN]) + more


def array(statuses: list[DiagnosticStatus], stamp: Any) -> DiagnosticArray:
    """Return the message for `/diagnostics`."""
    message = DiagnosticArray(status=statuses)
    message.header.stamp = stamp
    return message


def status(name: str, level: bytes, message: str, hardware: str, values: Mapping[str, Any]) -> DiagnosticStatus:
    """Return a status with its values as text."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(name=name, level=level, message=message, hardware_id=hardware, values=pairs)
