"""Classification of odometry stamps: continued, jumped back, or an earlier one was ahead."""

from __future__ import annotations

import random

import pytest

from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2
from forward_grid_mapper.core.messages.pose_association import PoseAssociator
from forward_grid_mapper.core.messages.stamp_order import GOES_ON, JUMP, JUMPED_BACK, WAS_AHEAD, StampOrder

FAR = 10 * JUMP


@pytest.mark.parametrize(
    ('stamps', 'last'),
    [
        ([5], GOES_ON),
        ([5, 6], GOES_ON),
        ([FAR, FAR - JUMP], GOES_ON),
        ([FAR, FAR - JUMP - 1], JUMPED_BACK),
        ([5, FAR, 6], WAS_AHEAD),
        ([5, FAR, 5], JUMPED_BACK),
        ([5, FAR, 4], JUMPED_BACK),
        ([5, FAR, FAR, 6], WAS_AHEAD),
        ([5, FAR, FAR + 1, 6], JUMPED_BACK),
        ([5, FAR, 6, FAR, 7], WAS_AHEAD),
        ([5, FAR, 6, 5, FAR, 7], WAS_AHEAD),
        ([FAR, 5, FAR, 6], WAS_AHEAD),
        ([5, 7, 6, FAR, 6], JUMPED_BACK),
    ],
)
def test_last_stamp_is_classified_by_those_before(stamps: list[int], last: str) -> None:
    order = StampOrder()
    assert [order.take(stamp) for stamp in stamps][-1] == last


def test_associator_counts_jumps_as_stamp_order_does() -> None:
    rng = random.Random(3)
    for _ in range(50):
        order, associator = StampOrder(), PoseAssociator(lambda base, frame, stamp: None)
        found = []
        for _ in range(60):
            stamp = rng.randrange(0, 8) * JUMP // 2
            found.append(order.take(stamp))
            associator.add_odometry(OdometryMessage(stamp, 'odom', 'base', Pose2(0.0, 0.0, 0.0)))
        assert associator.time_jumps == found.count(JUMPED_BACK)
        assert associator.odometry_rejected['ahead_of_others'] == found.count(WAS_AHEAD)
