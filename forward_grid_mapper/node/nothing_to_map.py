"""Why EM has no reading to map, in words."""

from __future__ import annotations

from collections.abc import Sequence

from ..core.messages.pose_association import PoseAssociator
from ..core.messages.rep117 import ODOMETRY_REASONS, REASONS


def nothing_to_map(associator: PoseAssociator, range_topics: Sequence[str], odom_topic: str) -> str:
    """Return why no reading was accepted; the topics have their full names."""
    return f'there is nothing to map: {_why(associator, range_topics, odom_topic)}'


def _why(associator: PoseAssociator, range_topics: Sequence[str], odom_topic: str) -> str:
    received, rejected = associator.received, associator.rejected
    if not received:
        return f'no Range message has come on {", ".join(range_topics)} since the start or reset'
    if not rejected:
        return f'{received} readings have come, and wait for their poses'
    reason, count = max(rejected.items(), key=lambda row: row[1])
    came, refused = associator.odometry_received, associator.odometry_rejected
    if reason == 'no_odometry' and not came:
        return f'no Odometry message has come on {odom_topic} since the start or reset'
    if reason == 'no_odometry' and came == refused.total():
        reason = max(refused, key=lambda key: refused[key])
        return f'all {came} odometry messages were rejected as {reason}: {ODOMETRY_REASONS[reason]}'
    return f'{count} of {received} readings were rejected as {reason}: {REASONS[reason]}'
