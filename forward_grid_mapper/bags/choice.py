"""Selects the topics of a bag to map from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from ..core.common.errors import BagError
from ..core.common.shell import quoted
from ..core.common.words import counted
from .decoder import TF_MESSAGE
from .namespaces import Assigned, ranges_of
from .poses import BASE_FRAMES, ODOMETRY, POSES

__all__ = ['ODOMETRY', 'RANGE', 'Topics', 'choose_topics']

RANGE = 'sensor_msgs/msg/Range'

GOALS = ('goal', 'initialpose', 'initial_pose')
"""Parts of names of topics whose poses are goals, or initial estimates."""

Contents = Mapping[str, tuple[str, int]]


class Topics(NamedTuple):
    """The topics to map from, with their names in the bag; `odom_type` is one of `POSES`.

    `left_out` are topics of ranges that seem to belong to other robots.
    """

    range_topics: tuple[str, ...]
    odom_topic: str
    odom_type: str = ODOMETRY
    left_out: tuple[str, ...] = ()

    def notes(self) -> list[str]:
        """Return notes on the choice for the user."""
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
    """Return the named topics, or else those found by type.

    If each robot has a namespace, the topics of ranges are those in the namespace of the odometry.

    Parameters
    ----------
    contents : mapping
        (type, number of messages) by topic.
    range_topics, odom_topic
        The user's choice; a leading slash makes no difference.
    frames_of : callable
        Describes the frames of an odometry topic for the user.
    any_poses : bool
        Whether other messages with poses of the robot are allowed, `POSES`: stamped poses if there is no Odometry, and
        transforms if their topic is named.

    Raises
    ------
    BagError
        If a named topic is missing, or none or too many are found.
    """
    ranges = choose_range_topics(contents, range_topics)
    kinds = tuple(POSES) if any_poses else (ODOMETRY,)
    if odom_topic is not None:
        topic = _named(contents, odom_topic, kinds, '--odom-topic')
        kind = contents[topic][0]
        mine = Assigned(ranges, ()) if range_topics is not None else ranges_of(topic, _of_type(contents, kind), ranges)
        return Topics(mine.own, topic, kind, mine.left_out)
    # stamped poses only without odometry, since they may be goals; transforms only if named
    found = _of_type(contents, ODOMETRY) or [
        t for kind in kinds if kind != TF_MESSAGE for t in _of_type(contents, kind) if not _is_goal(t)
    ]
    if not found:
        raise BagError(
            'The bag has no nav_msgs/Odometry messages, which contain the poses of the '
            f'robot.{_moving(contents, kinds)}{_from_file(kinds)} {_listing(contents)}'
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
    """Return the named topics of ranges, or else all; the parameters are as above.

    Raises
    ------
    BagError
        If a named topic is missing, or there is none.
    """
    if range_topics is None:
        ranges = tuple(_of_type(contents, RANGE))
    else:
        ranges = tuple(dict.fromkeys(_named(contents, topic, (RANGE,), '--range-topics') for topic in range_topics))
    if not ranges:
        raise BagError(f'The bag has no sensor_msgs/Range messages. {_without_ranges(contents)} {_listing(contents)}')
    return ranges


def _without_ranges(contents: Contents) -> str:
    """Return the remedy for a bag without ranges."""
    empty = sum(kind == RANGE for kind, _ in contents.values())
    if empty:
        return (
            f'{counted(empty, "topic")} of this type {"was" if empty == 1 else "were"} recorded, but nothing was '
            'published there: did the drivers of the sonars run, and do the QoS settings of the recorder match theirs?'
        )
    return 'LaserScan, PointCloud and other types are not read: publish each reading of a sonar as a Range.'


def _choosing(odometry: str, found: Sequence[str], ranges: Sequence[str]) -> str:
    """Return the options that select an odometry topic, and the ranges of its robot if there are others."""
    mine = ranges_of(odometry, found, ranges)
    words = ['--odom-topic', odometry, *(['--range-topics', *mine.own] if mine.left_out else [])]
    return ' '.join(map(quoted, words))


def _is_goal(topic: str) -> bool:
    return any(word in topic.lower() for word in GOALS)


def _moving(contents: Contents, kinds: Sequence[str]) -> str:
    """Return a remedy if transforms may have the poses; otherwise ''."""
    topics = _of_type(contents, TF_MESSAGE)
    if not topics or TF_MESSAGE not in kinds:
        return ''
    return f' `--odom-topic {topics[0]}` uses the poses of {BASE_FRAMES[0]} from the transforms of the bag.'


def _from_file(kinds: Sequence[str]) -> str:
    """Return the remedy for a bag without poses, if these types of poses are wanted; otherwise ''."""
    # commands that take only Odometry have no such option
    if TF_MESSAGE not in kinds:
        return ''
    return ' `--poses FILE` takes them from a TUM or CSV file, as SLAM and tracking systems write it (see --help).'


def _of_type(contents: Contents, msgtype: str) -> list[str]:
    # topics with only static transforms have no poses of a robot
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
    raise BagError(f'{problem}, nor any other {kinds[0]}.{_from_file(kinds)} {_listing(contents)}')


def _listing(contents: Contents) -> str:
    if not contents:
        return 'It has no topics at all.'
    lines = (f'\n  {topic}: {count} {kind}' for topic, (kind, count) in sorted(contents.items()))
    return 'It has:' + ''.join(lines)
