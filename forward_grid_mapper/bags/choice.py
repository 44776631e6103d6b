"""Which of a bag's topics to map from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from ..core.common.errors import BagError

RANGE = 'sensor_msgs/msg/Range'
ODOMETRY = 'nav_msgs/msg/Odometry'
Contents = Mapping[str, tuple[str, int]]


class Topics(NamedTuple):
    """The topics to map from, named as the bag names them."""

    range_topics: tuple[str, ...]
    odom_topic: str


def choose_topics(
    contents: Contents,
    range_topics: Sequence[str] | None,
    odom_topic: str | None,
    frames_of: Callable[[str], str],
) -> Topics:
    """Return the named topics, or where none is named those found by type.

    Parameters
    ----------
    contents : mapping
        (type, number of messages) by topic.
    range_topics, odom_topic
        The user's choice; a leading slash makes no difference.
    frames_of : callable
        Describes the frames of an odometry topic, for the user to choose by.

    Raises
    ------
    BagError
        If a named topic is not there, or none or too many are found.
    """
    ranges = _of_type(contents, RANGE)
    if range_topics is not None:
        ranges = list(dict.fromkeys(_named(contents, topic, RANGE, '--range-topics') for topic in range_topics))
    if not ranges:
        raise BagError(f'The bag has no sensor_msgs/Range messages to map from. {_listing(contents)}')
    if odom_topic is not None:
        return Topics(tuple(ranges), _named(contents, odom_topic, ODOMETRY, '--odom-topic'))
    odometry = _of_type(contents, ODOMETRY)
    if not odometry:
        raise BagError(
            f'The bag has no nav_msgs/Odometry messages, which give the poses of the robot. {_listing(contents)}'
        )
    if len(odometry) > 1:
        lines = (f'\n  {topic}: {contents[topic][1]} messages, {frames_of(topic)}' for topic in odometry)
        raise BagError('The bag has several odometry topics; choose one with `--odom-topic`:' + ''.join(lines))
    return Topics(tuple(ranges), odometry[0])


def _of_type(contents: Contents, msgtype: str) -> list[str]:
    return sorted(topic for topic, (kind, count) in contents.items() if kind == msgtype and count)


def _named(contents: Contents, name: str, msgtype: str, option: str) -> str:
    topic = next((t for t in contents if t.strip('/') == name.strip('/')), None)
    if topic is None:
        problem = f'The bag has no topic {name!r}'
    elif contents[topic][0] != msgtype:
        problem = f'Topic {name!r} has the type {contents[topic][0]}, not {msgtype}'
    elif not contents[topic][1]:
        problem = f'Topic {name!r} has no messages in this bag'
    else:
        return topic
    candidates = ', '.join(_of_type(contents, msgtype))
    if candidates:
        raise BagError(f'{problem}; `{option}` can be: {candidates}.')
    raise BagError(f'{problem}, nor any other {msgtype}. {_listing(contents)}')


def _listing(contents: Contents) -> str:
    if not contents:
        return 'It has no topics at all.'
    lines = (f'\n  {topic}: {count} {kind}' for topic, (kind, count) in sorted(contents.items()))
    return 'It has:' + ''.join(lines)
