"""Assigns a bag's topics to robots, if each of several robots has a namespace."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Assigned(NamedTuple):
    """Topics of the robot that is mapped, and those of others."""

    own: tuple[str, ...]
    left_out: tuple[str, ...]


def ranges_of(odometry: str, others: Sequence[str], ranges: Sequence[str]) -> Assigned:
    """Return the topics of ranges of the robot whose odometry is used.

    A robot's namespace is the nearest one around its odometry that contains ranges: `/r1` for `/r1/odometry/filtered`.

    Parameters
    ----------
    odometry : str
        The topic that is used.
    others : sequence of str
        All topics of odometry.
    ranges : sequence of str
        All topics of ranges. All are used if none is of the robot, or if all odometry is in one namespace.
    """
    homes = {topic: _home(topic, ranges) for topic in {odometry, *others}}
    own = tuple(topic for topic in ranges if _nearest(topic, homes.values()) == homes[odometry])
    if not own or len(set(homes.values())) == 1:
        return Assigned(tuple(ranges), ())
    return Assigned(own, tuple(topic for topic in ranges if topic not in own))


def by_precedence(static_topics: Iterable[str], chosen: Sequence[str]) -> list[str]:
    """Return topics of static transforms in ascending precedence for the robot whose topics are `chosen`.

    Those in a namespace around a chosen topic take precedence, that of the first chosen one most of all; next is
    `/tf_static`. Those of other namespaces are used only if no chosen topic has one in its own.
    """
    topics = sorted(set(static_topics))
    around = {_parent(topic): topic for topic in topics}
    own = [around[home] for topic in chosen if (home := _nearest(topic, around))]
    common = [topic for topic in topics if not _parent(topic)]
    return list(dict.fromkeys([*own, *common, *([] if own else topics)]))[::-1]


def _home(odometry: str, ranges: Sequence[str]) -> str:
    """Return the nearest namespace around a topic that contains ranges; '' is the root."""
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
