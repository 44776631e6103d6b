"""REP 117: from a Range message to a measurement, or the reason for its rejection."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.parameter_groups import AssociationParameters
from ..common.readings import Floats
from .message_batch import REASON, Ranges
from .message_types import NANOSECONDS, RangeMessage

SILENT_DRIVER = (
    'a driver should send +inf if there is no echo (REP 117); if it sends NaN, 0 or a negative range, set the '
    'parameter invalid_range to no_echo'
)
"""What to do about readings that stand for 'no echo'."""

REASONS = {
    'nan_range': f'the range is not a number; {SILENT_DRIVER}',
    'too_near': 'the range is -inf, or less than a millimetre: an object is too near to measure, or the sensor is '
    f'dead; {SILENT_DRIVER}. -inf always means that an object is too near: if the driver sends it without an echo, '
    'correct the driver',
    'below_min_range': f'the range is below min_range; {SILENT_DRIVER}',
    'over_range': 'no echo, and over_range is "discard"',
    'bad_limits': 'min_range or max_range is negative or not finite, or max_range is not above min_range, or below a '
    'millimetre; correct the driver, or set the parameter max_range to the range of the sensor, in metres',
    'bad_field_of_view': 'the field of view is not between 0 and pi radians; correct the driver, or set the parameter '
    'field_of_view to the full angle, such as 0.26 for 15 degrees',
    'empty_frame_id': 'the header has no frame_id; set a different one for each sensor in its driver, such as '
    'sonar_left',
    'long_frame_id': 'the frame_id has more than 255 characters',
    'unprintable_frame_id': 'the frame_id has characters that cannot be printed',
    'unknown_extrinsics': 'the pose of this frame on the robot is unknown: set sensors.<frame_id>.pose in a parameter '
    'file, or publish its transform',
    'late_transform': 'TF knows this frame, but no transform for the stamp arrived within pose_timeout; in a bag, none '
    'before or after it, or they are farther apart than that',
    'steep_sensor': 'the sensor points up or down by more than 60°, or its cone contains the vertical',
    'before_odometry': 'the stamp is before the first odometry, or minutes before the newest; if this continues, the '
    'clocks of the drivers differ',
    'zero_stamp': 'header.stamp is 0: set it in the driver',
    'after_odometry': 'the recording ended before odometry reached the stamp',
    'no_odometry': 'odometry, or its transform to map_frame, did not reach the stamp within pose_timeout: has it '
    'stopped, or do the clocks of the drivers differ?',
    'pose_gap': 'odometry has a gap longer than max_pose_gap here; if its rate is always so low, set max_pose_gap to '
    'more than the time between two messages',
    'pose_jump': 'odometry jumps here, faster than a robot can drive (are its poses in millimetres? They must be in '
    'metres)',
    'from_the_future': 'odometry continued for pose_timeout and is still before the stamp; is the clock of the sensor '
    'ahead?',
    'time_jump': 'the clock jumped back while the reading waited for its pose',
    'too_many_waiting': 'too many readings waited for odometry at once',
    'too_far_away': 'the map would have more than max_cells cells; are pose and max_range right?',
    'far_from_map': 'the reading is farther than max_jump from the mapped area; if the pose is right, begin a new map '
    '(in the node: call reset)',
    'large_cone': 'the cone has millions of cells; are range, field of view and resolution right?',
    'paused': 'the mapper was paused',
}
"""Why a reading is rejected, in words."""


REASONS_OUTSIDE_MESSAGE = {
    'unknown_extrinsics',
    'late_transform',
    'steep_sensor',
    'before_odometry',
    'zero_stamp',
    'after_odometry',
    'no_odometry',
    'pose_gap',
    'pose_jump',
    'from_the_future',
    'time_jump',
    'too_many_waiting',
    'paused',
}
"""Reasons that are not in the message itself; a running node reports them elsewhere."""


ODOMETRY_REASONS = {
    'bad_pose': 'the pose is not finite, impossibly far away, tilted too far or upside down, or its quaternion is not '
    'normalised; have the driver fill in the orientation: x, y, z, w are 0, 0, sin(yaw/2), cos(yaw/2)',
    'long_frame_id': 'the frame_id or child_frame_id has more than 255 characters',
    'unprintable_frame_id': 'the frame_id or child_frame_id has characters that cannot be printed',
    'ahead_of_others': 'the stamp is more than a second ahead of those before and after it: do two nodes publish '
    'odometry, or was a clock set?',
    'other_frame': 'the frame_id or child_frame_id is not that of the first odometry message; in the node, call reset '
    'to use the new one',
}
"""Why an odometry message is rejected, in words."""


NEAREST = 0.001
"""Smallest valid range, metres: drivers of dead sensors send less."""


LONGEST_NAME = 255
"""Most characters of the name of a frame, to limit memory; no TF tree has longer ones."""


class Measurement:
    """A valid Range message by REP 117, before it has a pose; sorted by stamp, then by arrival."""

    __slots__ = ('arrival', 'frame_id', 'half_angle', 'newest', 'number', 'sent', 'sigma', 'stamp', 'z', 'z_max')

    def __init__(self, message: RangeMessage, z: float, z_max: float, half_angle: float, sigma: float) -> None:
        self.stamp, self.frame_id = message.stamp, message.frame_id
        self.z, self.z_max, self.half_angle, self.sigma = z, z_max, half_angle, sigma
        self.number, self.arrival, self.sent = 0, 0.0, 0
        self.newest: int | None = None

    def __lt__(self, other: Measurement) -> bool:
        return (self.stamp, self.number) < (other.stamp, other.number)


def measure(message: RangeMessage, parameters: AssociationParameters) -> Measurement | str:
    """Apply REP 117 and the parameters to one Range message; return the measurement, or the reason for its rejection.

    A fixed-distance ranger (min_range = max_range) sends -inf for "an object within max_range" and +inf for "none". The
    former only means that the range is in (0, max_range). It becomes half of max_range with σ of one twelfth, so that
    ±5 σ cover most of the interval.
    """
    if wrong := _of_name(message.frame_id):
        return wrong
    angle = parameters.field_of_view or message.field_of_view
    if not 0.0 < angle < math.pi:
        return 'bad_field_of_view'
    fixed = message.min_range == message.max_range
    z_max = parameters.max_range or message.max_range
    if not (NEAREST <= z_max < math.inf and 0.0 <= message.min_range and (fixed or message.min_range < z_max)):
        return 'bad_limits'
    z, sigma = message.range, 0.0
    if 0.0 < message.variance < math.inf:
        sigma = math.sqrt(message.variance)
    if parameters.invalid_range == 'no_echo' and (math.isnan(z) or -math.inf < z < NEAREST):
        z = math.inf
    if math.isnan(z):
        return 'nan_range'
    if z == -math.inf:
        if not fixed:
            return 'too_near'
        z, sigma = z_max / 2, z_max / 12
    elif z < (0.0 if fixed else message.min_range):
        return 'below_min_range'
    elif z < NEAREST:
        return 'too_near'
    if z >= z_max:
        if parameters.over_range == 'discard':
            return 'over_range'
        z = z_max
    measurement = Measurement(message, z, z_max, angle / 2, sigma)
    measurement.stamp = corrected(message.stamp, parameters)
    return measurement


def corrected(stamp: int, parameters: AssociationParameters) -> int:
    """Return the stamp of a Range message with `range_time_offset` added, nanoseconds; zero is no stamp, and stays."""
    return stamp and stamp + _offset(parameters)


def _offset(parameters: AssociationParameters) -> int:
    return round(parameters.range_time_offset * NANOSECONDS)


class Measurements(NamedTuple):
    """Measurements of N Range messages; the columns are those of `Measurement`.

    Attributes
    ----------
    reason : str, shape (N,)
        Reason for the rejection of each message; '' if it is valid. The other columns are valid only then.
    z, z_max, half_angle, sigma : float64, shape (N,)
    """

    reason: NDArray[np.str_]
    z: Floats
    z_max: Floats
    half_angle: Floats
    sigma: Floats

    def select(self, which: NDArray[np.int64]) -> Measurements:
        """Return the measurements with these indices."""
        return Measurements._make(column[which] for column in self)


def measure_all(messages: Ranges, parameters: AssociationParameters) -> Measurements:
    """Apply `measure` to many messages."""
    size = messages.range.shape
    reason = np.array([_of_name(name) for name in messages.frames] or [''], REASON)[messages.frame]

    def reject(why: str, mask: NDArray[np.bool_]) -> None:
        reason[mask & (reason == '')] = why

    angle = np.full(size, parameters.field_of_view) if parameters.field_of_view else messages.field_of_view
    reject('bad_field_of_view', ~((angle > 0.0) & (angle < math.pi)))
    least = messages.min_range
    fixed = least == messages.max_range
    z_max = np.full(size, parameters.max_range) if parameters.max_range else messages.max_range
    reject('bad_limits', ~((z_max >= NEAREST) & (z_max < math.inf) & (least >= 0.0) & (fixed | (least < z_max))))
    z = messages.range
    stated = (messages.variance > 0.0) & (messages.variance < math.inf)
    sigma = np.sqrt(np.where(stated, messages.variance, 0.0))
    if parameters.invalid_range == 'no_echo':
        z = np.where(np.isnan(z) | ((z > -math.inf) & (z < NEAREST)), math.inf, z)
    reject('nan_range', np.isnan(z))
    near = z == -math.inf
    reject('too_near', near & ~fixed)
    z, sigma = np.where(near, z_max / 2, z), np.where(near, z_max / 12, sigma)
    reject('below_min_range', ~near & (z < np.where(fixed, 0.0, least)))
    reject('too_near', ~near & (z < NEAREST))
    over = z >= z_max
    if parameters.over_range == 'discard':
        reject('over_range', over)
    return Measurements(reason, np.where(over, z_max, z), z_max, angle / 2, sigma)


def all_corrected(messages: Ranges, parameters: AssociationParameters) -> NDArray[np.int64]:
    """Apply `corrected` to many messages; return shape (N,)."""
    return np.where(messages.stamp == 0, 0, messages.stamp + _offset(parameters))


def proper_name(frame_id: str) -> bool:
    """Return whether a frame can have this name: one that cannot be printed would change the colours of a terminal."""
    return not _of_name(frame_id)


def _of_name(frame_id: str) -> str:
    """Return why messages of a frame are rejected; '' if they are not."""
    if not frame_id:
        return 'empty_frame_id'
    if len(frame_id) > LONGEST_NAME:
        return 'long_frame_id'
    return '' if frame_id.isprintable() else 'unprintable_frame_id'
