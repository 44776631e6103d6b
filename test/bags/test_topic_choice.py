"""The choice of topics, and the messages if it is not clear."""

from __future__ import annotations

from pathlib import Path

import pytest
from bag_samples import START, write_sample

from forward_grid_mapper.bags.choice import Topics, choose_range_topics
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.core.messages.message_types import OdometryMessage, Pose2, RangeMessage

ODOMETRY = OdometryMessage(START, 'odom', 'base_link', Pose2(0.0, 0.0, 0.0))
RANGE = RangeMessage(START, 'sonar_0', 1.0, 0.125, 5.0, 0.25)


def test_topics_are_chosen_by_name_or_rejected_with_reason(tmp_path: Path) -> None:
    with Bag(write_sample(tmp_path, 'mcap', shared_topic=False)) as bag:
        assert bag.choose_topics(['sonar_1', '/sonar_1'], 'odom') == Topics(('/sonar_1',), '/odom')
        with pytest.raises(BagError, match=r"no topic 'sonar_9'; `--range-topics` can be: /sonar_0, /sonar_1"):
            bag.choose_topics(['sonar_9'])
        with pytest.raises(BagError, match=r'type nav_msgs/msg/Odometry, not sensor_msgs/msg/Range.*/sonar_0'):
            bag.choose_topics(['/odom'])
        with pytest.raises(BagError, match=r"no topic '/o'; `--odom-topic` can be: /odom"):
            bag.choose_topics(odom_topic='/o')


def test_several_odometry_topics_require_a_choice(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_range('/sonar', RANGE)
        writer.write_odometry('/odom', ODOMETRY)
        writer.write_odometry('/odom', ODOMETRY)
        writer.write_odometry('/corrected', ODOMETRY._replace(frame_id='map'))
    with Bag(tmp_path / 'bag') as bag:
        with pytest.raises(BagError) as caught:
            bag.choose_topics()
        assert bag.choose_topics(odom_topic='corrected').odom_topic == '/corrected'
    text = str(caught.value)
    assert '--odom-topic' in text
    assert '/odom: 2 messages, odom → base_link' in text
    assert '/corrected: 1 message, map → base_link' in text


def test_bag_without_ranges_or_odometry_is_rejected(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'a') as writer:
        writer.write_odometry('/odom', ODOMETRY)
    with BagWriter(tmp_path / 'b') as writer:
        writer.write_range('/sonar', RANGE)
    with BagWriter(tmp_path / 'c'):
        pass
    with Bag(tmp_path / 'a') as bag, pytest.raises(BagError, match=r'no sensor_msgs/Range.*\n  /odom: 1 nav_msgs'):
        bag.choose_topics()
    with Bag(tmp_path / 'b') as bag:
        with pytest.raises(BagError, match=r'no nav_msgs/Odometry.*\n  /sonar: 1 sensor_msgs'):
            bag.choose_topics()
        with pytest.raises(BagError, match=r"no topic 'odom', nor any other nav_msgs"):
            bag.choose_topics(odom_topic='odom')
        for named in (None, 'odom'):
            # only commands that take other poses than Odometry take them from a file
            with pytest.raises(BagError, match=r'`--poses FILE` takes them from a TUM or CSV file'):
                bag.choose_topics(odom_topic=named, any_poses=True)
            with pytest.raises(BagError) as caught:
                bag.choose_topics(odom_topic=named)
            assert '--poses' not in str(caught.value)
    with Bag(tmp_path / 'c') as bag, pytest.raises(BagError, match='no topics at all'):
        bag.choose_topics()


@pytest.mark.parametrize(
    ('counts', 'remedy'),
    [
        ((), 'LaserScan, PointCloud and other types are not read'),
        ((0,), '1 topic of this type was recorded, but nothing was published there'),
        ((0, 0), '2 topics of this type were recorded, but nothing was published there'),
    ],
)
def test_bag_without_ranges_is_told_from_one_whose_sonars_were_silent(counts: tuple[int, ...], remedy: str) -> None:
    contents = {f'/sonar_{k}': ('sensor_msgs/msg/Range', count) for k, count in enumerate(counts)}
    with pytest.raises(BagError, match=f'no sensor_msgs/Range messages. {remedy}'):
        choose_range_topics({**contents, '/odom': ('nav_msgs/msg/Odometry', 3)}, None)
