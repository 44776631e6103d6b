"""The readings of a recorded drive in the map frame: the offline counterpart of the node's subscriptions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path

from ..bags.choice import Topics
from ..bags.decoder import TF_MESSAGE
from ..bags.moving_transforms import MovingTransforms
from ..bags.poses import BASE_FRAMES
from ..bags.reader import Bag, skipped
from ..bags.static_transforms import StaticTransforms
from ..core.common.errors import BagError, InputError, ParameterError
from ..core.common.parameters import Parameters
from ..core.common.shell import quoted
from ..core.common.words import counted
from ..core.messages.batch_association import BatchAssociator
from ..core.messages.extrinsics import STEEP
from ..core.messages.message_batch import batch_of
from ..core.messages.message_types import NANOSECONDS, Pose2
from ..core.messages.mounts import far_mounts
from ..core.messages.pose_association import PoseAssociator
from ..core.messages.rejections import (
    odometry_rejections,
    of_dead_sensors,
    rejection_warnings,
    sensor_rejections,
)
from ..core.messages.rep117 import (
    ODOMETRY_REASONS,
    REASONS,
)
from ..files.journal import drive_file
from ..files.output_folder import readable
from .bag_extrinsics import BagExtrinsics
from .drive import WHOLE, Drive, FullLiveMap, Part, Spans, alternation_note, length_between, length_of, thinning_note
from .given_poses import GivenPoses
from .journal_drive import read_journal
from .other_bags import OtherBags

__all__ = ['Drive', 'read_drive']

POSES_MISSING = {'unknown_extrinsics', 'after_odometry'}
"""Reasons of rejection if only the poses of the sensors are missing: nearly every bag ends with a range."""


def read_drive(
    path: Path | str,
    parameters: Parameters,
    extrinsics: Mapping[str, Pose2],
    range_topics: Sequence[str] | None = None,
    odom_topic: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    part: Part = WHOLE,
    poses: GivenPoses | None = None,
    others: Sequence[Path | str] = (),
) -> Drive:
    """Read a bag and transform its readings to the map frame, or read a journal.

    Parameters
    ----------
    path : Path or str
    parameters : Parameters
    extrinsics : mapping
        Poses of sensors in the robot's base frame; they take precedence over the bag's `/tf_static`.
    range_topics, odom_topic
        Topics to use; by default those found by type.
    progress : callable, optional
        Called with (done, total) messages.
    part : Part
        The part to read, by stamps; the drive begins with its first message on these topics.
    poses : GivenPoses, optional
        They replace the bag's odometry.
    others : sequence of Path or str
        Other bags of the robot, whose `/tf_static` is used if the bag has none.

    Raises
    ------
    BagError
        If the bag cannot be read, or topics are missing or ambiguous.
    InputError
        If no reading got a pose, or none is in that part, or ranges are farther than sonars can measure; names the
        reason.
    """
    # reading a pipe would wait, and a device may have no end
    plain = Path(path).is_dir() or Path(path).is_file()
    journal = drive_file(Path(path)) if plain else None
    if journal is not None:
        if poses is not None:
            raise ParameterError(f'{path} is a journal, whose readings have their poses; leave out --poses')
        return read_journal(journal, parameters, extrinsics, range_topics, odom_topic, part)
    with Bag(path) as bag:
        if poses is None:
            topics = bag.choose_topics(range_topics, odom_topic, any_poses=True)
        else:
            topics = bag.choose_range_topics(range_topics)
        constant = partial(_constant_transforms, path, topics)
        times = parameters.association
        parents = cache(partial(_parents, path))
        joints = partial(_moving_transforms, path, topics, parents, max(times.pose_timeout, times.max_pose_gap))
        lookup = BagExtrinsics(extrinsics, bag.static_transforms(topics), constant, OtherBags(others, topics), joints)
        associator = BatchAssociator(lookup, parameters, lookup.moves)
        live = FullLiveMap(associator, parameters)
        # a reading is placed by the poses before and after it
        margin = (times.max_pose_gap + abs(times.range_time_offset)) * NANOSECONDS
        spans = Spans(part, margin)
        for batch in bag.batches(topics, progress):
            associator.add_batch(spans.select(batch))
        if poses is not None and spans.ranges:
            spans.odometry = [int(poses.stamp[0]), int(poses.stamp[-1])]
            begin, end = spans.ranges
            given = poses.between(begin - margin, end + margin, _base_frame(bag))
            associator.add_batch(batch_of(list(enumerate(given))))
        associator.finish()
        undecodable = dict(bag.undecodable)
        moving = {}
        if topics.odom_type == TF_MESSAGE and not spans.odometry:
            moving = bag.moving_frames(topics.odom_topic)
        damage = bag.truncated
        warnings = [*topics.notes(), *bag.repeated.notes(topics.range_topics, _choosing)]
        warnings += _warnings(bag, associator, lookup)
    if not len(associator.buffer):
        if not associator.received and spans.left_out:
            first, *_, last = sorted([*spans.left_out, *spans.odometry])
            why = '' if spans.stamped else f': {REASONS["zero_stamp"].replace("is 0", "of all readings is 0")}'
            raise InputError(
                f'{path} has no reading in the part {part}{why}; its messages span {(last - first) / NANOSECONDS:.1f} s'
            )
        error = _nothing_associated(associator, lookup, spans, undecodable, poses, moving)
        # the rest of the messages may be in the part that cannot be read
        raise type(error)(f'{error}. {damage}') if damage else error
    if not parameters.association.max_range and (impossible := associator.limits.impossible):
        raise InputError(f'{path}: {impossible}. If the sensors do measure so far, set the parameter max_range as well')
    first, last = associator.buffer.stamps
    source = {
        'bag': readable(path),
        'range_topics': list(topics.range_topics),
        'odom_topic': topics.odom_topic if poses is None else readable(poses.path),
        'odom_frame': associator.map_frame,
        'map_frame': associator.map_frame,
        'base_frame': associator.base_frame,
        'mounts_from': ' and '.join(sorted(set(lookup.used.values()))),
        'extrinsics': lookup.poses,
        'stamps': [first, last],
        'duration_s': (last - first) / NANOSECONDS,
        # of a part, some odometry before and after it is read as well
        'path_m': length_of(associator) if part.whole else length_between(associator, first, last),
        'counts': {
            'received': associator.received,
            'accepted': len(associator.buffer),
            'rejected': dict(associator.rejected),
            'odometry_received': associator.odometry_received,
            'odometry_rejected': dict(associator.odometry_rejected),
            'undecodable': undecodable,
        },
        'rejected_by_frame': {frame: dict(counts) for frame, counts in associator.rejected_by_frame.items()},
        'warnings': warnings + thinning_note(associator),
    }
    return Drive(associator, source, live)


def _constant_transforms(path: Path | str, topics: Topics) -> StaticTransforms:
    """Return the constant transforms of a bag, which may be open elsewhere."""
    with Bag(path) as bag:
        return bag.constant_transforms_on_tf(topics)


def _parents(path: Path | str) -> dict[str, str]:
    """Return the parents of the frames on `/tf`, in the same way."""
    with Bag(path) as bag:
        return bag.moving_frames()


def _moving_transforms(
    path: Path | str,
    topics: Topics,
    parents: Callable[[], Mapping[str, str]],
    longest_gap: float,
    base_frame: str,
    frame: str,
) -> MovingTransforms:
    """Return the transforms between a sensor and the robot, in the same way."""
    with Bag(path) as bag:
        return bag.moving_transforms(topics, parents(), base_frame, frame, longest_gap)


def _choosing(topics: Sequence[str]) -> str:
    return f'To use one of them, add `--range-topics {" ".join(map(quoted, topics))}`'


def _warnings(bag: Bag, associator: PoseAssociator, lookup: BagExtrinsics) -> list[str]:
    warnings = []
    if bag.truncated:
        warnings.append(bag.truncated)
    for topic, count in bag.undecodable.items():
        warnings.append(skipped(count, topic))
    if associator.unknown_frames:
        warnings.append(lookup.advice(associator.base_frame, sorted(associator.unknown_frames)))
    warnings += [*lookup.too_steep(associator.base_frame), *lookup.notes, *far_mounts(lookup.poses)]
    if unused := lookup.unused:
        warnings.append(
            f'poses were given for {", ".join(unused)}, but no reading has such a frame; is the name right?'
        )
    if associator.time_jumps:
        warnings.append(
            f"odometry's clock jumped back {counted(associator.time_jumps, 'time')}; readings that waited for a pose "
            'were dropped'
        )
    warnings += alternation_note(associator)
    warnings += associator.message_warnings()
    warnings += odometry_rejections(associator.odometry_rejected, associator.odometry_received)
    known = {'unknown_extrinsics', STEEP} if lookup.steep else {'unknown_extrinsics'}
    by_frame, counts = associator.rejected_by_frame, associator.buffer.counts()
    dead = of_dead_sensors(by_frame, counts)
    warnings += rejection_warnings(associator.rejected, associator.received, known=known, dead=dead)
    return warnings + sensor_rejections(by_frame, counts, known)


def _base_frame(bag: Bag) -> str:
    """Return the base frame for given poses: that of the bag's odometry, or else a usual one."""
    known = bag.static_transforms().frames
    return bag.base_frame() or next((frame for frame in BASE_FRAMES if frame in known), BASE_FRAMES[0])


def _nothing_associated(
    associator: PoseAssociator,
    lookup: BagExtrinsics,
    spans: Spans,
    undecodable: Mapping[str, int],
    poses: GivenPoses | None,
    moving: Mapping[str, str],
) -> Exception:
    """Return the error with the reason why no reading got a pose, and a remedy."""
    ranges, odometry = spans.ranges, spans.odometry
    lost = '; '.join(f'{count} on {topic} do not fit their type' for topic, count in undecodable.items())
    if not ranges or not odometry:
        if ranges and moving and not moving.keys() & set(BASE_FRAMES):
            moved = ', '.join(f'{child} in {parent}' for child, parent in sorted(moving.items())[:12])
            return BagError(
                f'the transforms contain neither {" nor ".join(BASE_FRAMES)}, but {moved}; give the poses of the '
                'robot with --poses, or record its Odometry'
            )
        kind = 'Range' if not ranges else 'Odometry'
        return BagError(f'the chosen topics contain no readable {kind} message{f" ({lost})" if lost else ""}')
    if associator.unknown_frames and set(associator.rejected) <= POSES_MISSING:
        return InputError(lookup.advice(associator.base_frame, sorted(associator.unknown_frames)))
    if set(associator.rejected) != {'zero_stamp'} and (ranges[1] < odometry[0] or ranges[0] > odometry[1]):
        a, b, c, d = (stamp / NANOSECONDS for stamp in (*ranges, *odometry))
        other = 'odometry' if poses is None else readable(poses.path)
        why = 'are the drivers set to' if poses is None else 'do the poses have'
        return InputError(
            f'the stamps do not overlap: Range has {a:.3f} … {b:.3f} s, {other} {c:.3f} … {d:.3f} s; '
            f'{why} the same clock (use_sim_time)?'
        )
    reasons = '; '.join(f'{count} {reason} ({REASONS[reason]})' for reason, count in associator.rejected.most_common())
    refused = associator.odometry_rejected
    if set(associator.rejected) == {'no_odometry'} and refused.total() == associator.odometry_received > 0:
        # clocks are not the reason
        reasons = f'none of {counted(refused.total(), "odometry message")} could be used'
    for reason, count in refused.most_common():
        reasons += f'; {count} odometry messages were rejected: {ODOMETRY_REASONS[reason]}'
    faults = *lookup.too_steep(associator.base_frame), *associator.limits.warnings()
    hints = ''.join(f'; {warning}' for warning in faults)
    if associator.unknown_frames:
        hints += f'; {lookup.advice(associator.base_frame, sorted(associator.unknown_frames))}'
    return InputError(f'all {associator.received} readings were rejected: {reasons}{hints}')
