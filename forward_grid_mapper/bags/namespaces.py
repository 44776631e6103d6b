"""Which of a bag's topics are of one robot, where several robots have a namespace each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Parted(NamedTuple):
    """Topics of the robot that is mapped, and those of others."""

    taken: tuple[str, ...]
    left_out: tuple[str, ...]


def ranges_of(odometry: str, others: Sequence[str], ranges: Sequence[str]) -> Parted:
    """Return which topics of ranges are of the robot whose odometry is taken.

    A robot's namespace is the nearest one around its odometry that holds ranges too: `/r1` for `/r1/odometry/filtered`.

    Parameters
    ----------
    odometry : str
        The topic that is taken.
    others : sequence of str
        All topics of such messages.
    ranges : sequence of str
        All topics of ranges. They are all taken where none is of the robot, or all odometry is of one namespace.
    """
    homes = {topic: _home(topic, ranges) for topic in {odometry, *others}}
    taken = tuple(topic for topic in ranges if _nearest(topic, homes.values()) == homes[odometry])
    if not taken or len(set(homes.values())) == 1:
        return Parted(tuple(ranges), ())
    return Parted(taken, tuple(topic for topic in ranges if topic not in taken))


def by_precedence(static_topics: Iterable[str], chosen: Sequence[str]) -> list[str]:
    """Return topics of fixed transforms, first those that say least of the robot whose topics are `chosen`.

    Those in a namespace around a chosen topic say most, the first chosen one's before all; then comes `/tf_static`.
    Those of other namespaces say something only where no chosen topic has one in its own.
    """
    topics = sorted(set(static_topics))
    around = {_parent(topic): topic for topic in topics}
    own = [around[home] for topic in chosen if (home := _nearest(topic, around))]
    common = [topic for topic in topics if not _parent(topic)]
    return list(dict.fromkeys([*own, *common, *([] if own else topics)]))[::-1]


def _home(odometry: str, ranges: Sequence[str]) -> str:
    """Return the nearest namespace around a topic that holds ranges; '' is the one around all."""
    home = _parent(odometry)
    while home and not any(_holds(home, topic) for topic in ranges):
        home = _parent(home)
    return home


def _nearest(topic: str, namespaces: Iterable[str]) -> str | None:
    return max((home for home in namespaces if _holds(home, topic)), key=len, default=None)


def _holds(namespace: str, topic: str) -> bool:
    return not namespace or _rooted(topic).startswith(f'{namespace}/')


def _parent(topic: str) -> str:
    return _rooted(topic).rpartition('/')[0]


def _rooted(topic: str) -> str:
    return '/' + topic.strip('/')
