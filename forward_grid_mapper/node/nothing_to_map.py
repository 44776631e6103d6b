"""The reason why EM has no reading to map, in words."""

from __future__ import annotations

from collections.abc import Sequence

from ..core.messages.pose_association import PoseAssociator
from ..core.messages.rep117 import ODOMETRY_REASONS, REASONS


def nothing_to_map(associator: PoseAssociator, range_topics: Sequence[str], odom_topic: str, no_map_frame: str) -> str:
    """Return the reason why no reading was accepted.

    Topics are full names; `no_map_frame` is the fault that keeps odometry out of the map frame, or ''.
    """
    return f'there is nothing to map: {_why(associator, range_topics, odom_topic, no_map_frame)}'


def _why(associator: PoseAssociator, range_topics: Sequence[str], odom_topic: str, no_map_frame: str) -> str:
    received, rejected = associator.received, associator.rejected
    if not received:
        return f'no Range message has been received on {", ".join(range_topics)} since the start or reset'
    came, refused = associator.odometry_received, associator.odometry_rejected
    # odometry that waits for TF has not reached the associator
    if no_map_frame and not came and set(rejected) <= {'no_odometry'}:
        return no_map_frame
    # readings that wait may come to lack odometry
    reason, count = max(rejected.items(), key=lambda row: row[1], default=('no_odometry', 0))
    if reason == 'no_odometry' and not came:
        return f'no Odometry message has been received on {odom_topic} since the start or reset'
    if reason == 'no_odometry' and came == refused.total():
        reason = max(refused, key=lambda key: refused[key])
        return f'all {came} odometry messages were rejected as {reason}: {ODOMETRY_REASONS[reason]}'
    if not rejected:
        has = (
            'reading has been received, and waits for its pose'
            if received == 1
            else 'readings have been received, and wait for their poses'
        )
        return f'{received} {has}'
    return f'{count} of {received} readings were rejected as {reason}: {REASONS[reason]}'
