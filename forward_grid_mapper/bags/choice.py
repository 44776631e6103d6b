"""Which of a bag's topics to map from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from ..core.common.errors import BagError
from ..core.common.shell import quoted
from ..core.common.words import counted
from .decoder import TF_MESSAGE
from .namespaces import Parted, ranges_of
from .poses import BASE_FRAMES, ODOMETRY, POSES

__all__ = ['ODOMETRY', 'RANGE', 'Topics', 'choose_topics']

RANGE = 'sensor_msgs/msg/Range'

WISHES = ('goal', 'initialpose', 'initial_pose')
"""Parts of the names of topics whose poses say where the robot should be, or is believed to be once."""

Contents = Mapping[str, tuple[str, int]]


class Topics(NamedTuple):
    """The topics to map from, named as the bag names them; `odom_type` is one of `POSES`.

    `left_out` are topics of ranges that are taken for those of other robots.
    """

    range_topics: tuple[str, ...]
    odom_topic: str
    odom_type: str = ODOMETRY
    left_out: tuple[str, ...] = ()

    def notes(self) -> list[str]:
        """Return what the user should know of the choice."""
        if not self.left_out:
            return []
        every = ' '.join(map(quoted, (*self.range_topics, *self.left_out)))
        return [
            f'the ranges of {", ".join(self.left_out)} are left out because {self.odom_topic} is in another '
            f'namespace; if all of them belong to one robot, add `--range-topics {every}`'
        ]


def choose_topics(
    contents: Contents,
    range_topics: Sequence[str] | None,
    odom_topic: str | None,
    frames_of: Callable[[str], str],
    any_poses: bool = False,
) -> Topics:
    """Return the named topics, or where none is named those found by type.

    Where robots have a namespace each, the ranges found are those of the namespace of the odometry.

    Parameters
    ----------
    contents : mapping
        (type, number of messages) by topic.
    range_topics, odom_topic
        The user's choice; a leading slash makes no difference.
    frames_of : callable
        Describes the frames of an odometry topic, for the user to choose by.
    any_poses : bool
        Whether other messages with poses of the robot will do, `POSES`: stamped poses where there is no Odometry, and
        transforms where their topic is named.

    Raises
    ------
    BagError
        If a named topic is not there, or none or too many are found.
    """
    ranges = choose_range_topics(contents, range_topics)
    kinds = tuple(POSES) if any_poses else (ODOMETRY,)
    if odom_topic is not None:
        topic = _named(contents, odom_topic, kinds, '--odom-topic')
        kind = contents[topic][0]
        mine = Parted(ranges, ()) if range_topics is not None else ranges_of(topic, _of_type(contents, kind), ranges)
        return Topics(mine.taken, topic, kind, mine.left_out)
    # stamped poses only where there is no odometry, since they may be goals; transforms only if asked for
    found = _of_type(contents, ODOMETRY) or [
        t for kind in kinds if kind != TF_MESSAGE for t in _of_type(contents, kind) if not _is_wish(t)
    ]
    if not found:
        raise BagError(
            'The bag has no nav_msgs/Odometry messages, which contain the poses of the '
            f'robot.{_moving(contents, kinds)} {_listing(contents)}'
        )
    if len(found) > 1:
        lines = (
            f'\n  {topic}: {counted(contents[topic][1], "message")}, {frames_of(topic)}: '
            f'`{_choosing(topic, found, ranges)}`'
            for topic in found
        )
        raise BagError('The bag has several odometry topics; choose one with `--odom-topic`:' + ''.join(lines))
    return Topics(ranges, found[0], contents[found[0]][0])


def choose_range_topics(contents: Contents, range_topics: Sequence[str] | None) -> tuple[str, ...]:
    """Return the named topics of ranges, or where none is named all there are; the parameters are as above.

    Raises
    ------
    BagError
        If a named topic is not there, or there is none.
    """
    if range_topics is None:
        ranges = tuple(_of_type(contents, RANGE))
    else:
        ranges = tuple(dict.fromkeys(_named(contents, topic, (RANGE,), '--range-topics') for topic in range_topics))
    if not ranges:
        raise BagError(
            'The bag has no sensor_msgs/Range messages. LaserScan, PointCloud and other types are not read: publish '
            f'each reading of a sonar as a Range. {_listing(contents)}'
        )
    return ranges


def _choosing(odometry: str, found: Sequence[str], ranges: Sequence[str]) -> str:
    """Return the options that choose an odometry topic, and the ranges of its robot where there are others."""
    mine = ranges_of(odometry, found, ranges)
    words = ['--odom-topic', odometry, *(['--range-topics', *mine.taken] if mine.left_out else [])]
    return ' '.join(map(quoted, words))


def _is_wish(topic: str) -> bool:
    return any(word in topic.lower() for word in WISHES)


def _moving(contents: Contents, kinds: Sequence[str]) -> str:
    """Return what to do where transforms may have the poses; empty where they have none."""
    topics = _of_type(contents, TF_MESSAGE)
    if not topics or TF_MESSAGE not in kinds:
        return ''
    return f' `--odom-topic {topics[0]}` uses the poses of {BASE_FRAMES[0]} from the transforms of the bag.'


def _of_type(contents: Contents, msgtype: str) -> list[str]:
    # transforms that stand still are no poses of a robot
    return sorted(
        topic
        for topic, (kind, count) in contents.items()
        if kind == msgtype and count and not (kind == TF_MESSAGE and topic.endswith('tf_static'))
    )


def _named(contents: Contents, name: str, kinds: tuple[str, ...], option: str) -> str:
    topic = next((t for t in contents if t.strip('/') == name.strip('/')), None)
    if topic is None:
        problem = f'The bag has no topic {name!r}'
    elif contents[topic][0] not in kinds:
        problem = f'Topic {name!r} has the type {contents[topic][0]}, not {kinds[0]}'
    elif not contents[topic][1]:
        problem = f'Topic {name!r} has no messages in this bag'
    else:
        return topic
    candidates = ', '.join(topic for kind in kinds for topic in _of_type(contents, kind))
    if candidates:
        raise BagError(f'{problem}; `{option}` can be: {candidates}.')
    raise BagError(f'{problem}, nor any other {kinds[0]}. {_listing(contents)}')


def _listing(contents: Contents) -> str:
    if not contents:
        return 'It has no topics at all.'
    lines = (f'\n  {topic}: {count} {kind}' for topic, (kind, count) in sorted(contents.items()))
    return 'It has:' + ''.join(lines)
