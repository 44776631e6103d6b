"""Input of the library: converts a user's arrays to stamps and poses, or raises errors with a remedy."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .core.common.errors import InputError
from .core.messages.message_types import NANOSECONDS, OdometryMessage, Pose2

COARSEST = 1e-3
"""Smallest difference between neighbouring floats, seconds, from which a type is too coarse for stamps."""

POSE_TOLERANCE = (0.01, math.radians(1.0))
"""Smallest differences, metres and radians, between two different poses of one stamp."""

LEAVE_OUT = 'leave them out'

_LARGEST = 2**62 / NANOSECONDS


def column(name: str, values: ArrayLike, length: int | None = None) -> NDArray[np.float64]:
    """Return numbers as float64, shape (length,).

    Raises
    ------
    InputError
        If they are not real numbers, some are masked, or the shape is another one.
    """
    filled = 'fill those with nan: np.ma.filled(ranges.astype(float), np.nan)'
    return _shaped(name, _numbers(name, values, filled if name == 'ranges' else LEAVE_OUT), length)


def stamps(name: str, values: ArrayLike, length: int | None = None) -> NDArray[np.int64]:
    """Return stamps in nanoseconds, from seconds, or without loss from NumPy's datetime64 or timedelta64.

    Raises
    ------
    InputError
        As `column`; or if some are not finite, can only have another unit, or have a type that is too coarse for them.
    """
    given = _array(name, values, LEAVE_OUT)
    if given.dtype.kind in 'mM':
        return _shaped(name, _nanoseconds(name, given), length)
    seconds = column(name, values, length)
    if unknown := int(np.count_nonzero(~np.isfinite(seconds))):
        raise InputError(f'{name} has {unknown} stamps that are not finite; {LEAVE_OUT}')
    if (np.abs(seconds) > _LARGEST).any():
        raise InputError(
            f'{name} must be seconds: milliseconds must be divided by 1e3, microseconds by 1e6, nanoseconds by 1e9'
        )
    if given.dtype.kind == 'f' and len(seconds):
        step = float(np.spacing(np.abs(given).max()))
        if step > COARSEST:
            raise InputError(
                f'{name} has the type {given.dtype}, in which numbers of this size are {step:.3g} s apart; use '
                'float64, or subtract the first stamp before the conversion'
            )
    return np.round(seconds * NANOSECONDS).astype(np.int64)


def poses_of(stamp: NDArray[np.int64], poses: ArrayLike) -> list[OdometryMessage]:
    """Return x, y and yaw of each stamp, shape (M, 3), as messages in order of their stamps.

    Raises
    ------
    InputError
        As `column`, or if some are not finite.
    """
    array = _numbers('poses', poses, LEAVE_OUT)
    if array.shape != (len(stamp), 3):
        raise InputError(f'poses has the shape {array.shape}, not ({len(stamp)}, 3): x, y and yaw of each stamp')
    if not np.isfinite(array).all():
        raise InputError(f'{int((~np.isfinite(array)).any(axis=1).sum())} poses are not finite; leave them out')
    order = np.argsort(stamp, kind='stable')
    rows = zip(stamp[order].tolist(), array[order].tolist(), strict=True)
    return [OdometryMessage(one, 'map', 'base', Pose2(*row)) for one, row in rows]


def ambiguous_stamps(odometry: list[OdometryMessage]) -> list[str]:
    """Return a warning if poses of one stamp differ; `odometry` is in order of stamps."""
    count, far, turned = 0, 0.0, 0.0
    for before, after in pairwise(odometry):
        if before.stamp != after.stamp or before.pose is None or after.pose is None:
            continue
        distance = math.hypot(after.pose.x - before.pose.x, after.pose.y - before.pose.y)
        angle = abs(math.remainder(after.pose.yaw - before.pose.yaw, math.tau))
        if distance > POSE_TOLERANCE[0] or angle > POSE_TOLERANCE[1]:
            count, far, turned = count + 1, max(far, distance), max(turned, angle)
    if not count:
        return []
    return [
        f'{count} stamps have two different poses, which differ by up to {far:.2f} m and {math.degrees(turned):.0f}°: '
        'are they from two robots, or from two sources? Use those of one'
    ]


def _numbers(name: str, values: ArrayLike, instead: str) -> NDArray[np.float64]:
    array = _array(name, values, instead)
    if array.dtype.kind == 'c':
        raise InputError(f'{name} must be real numbers')
    if array.dtype.kind in 'mM':
        raise InputError(f'{name} must be numbers, not of the type {array.dtype}')
    try:
        return np.asarray(array, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f'{name} must be numbers: {error}') from None


def _array(name: str, values: Any, instead: str) -> NDArray[Any]:
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        count = int(np.ma.getmaskarray(values).sum())
        raise InputError(f'{name} has {count} masked values; {instead}')
    try:
        return np.asarray(values)
    except (TypeError, ValueError) as error:
        raise InputError(f'{name} must be numbers: {error}') from None


def _nanoseconds(name: str, times: NDArray[Any]) -> NDArray[np.int64]:
    if np.isnat(times).any():
        raise InputError(f'{name} has {int(np.isnat(times).sum())} times that are NaT; leave them out')
    try:
        seconds = times.astype(f'{times.dtype.kind}8[s]').astype(np.int64)
        if np.datetime_data(times.dtype)[0] == 'generic' or (np.abs(seconds) > _LARGEST).any():
            raise ValueError
        return times.astype(f'{times.dtype.kind}8[ns]').astype(np.int64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f'{name} has the type {times.dtype}, which is not a type of stamps; use seconds as float64'
        ) from None


def _shaped(name: str, array: NDArray[Any], length: int | None) -> NDArray[Any]:
    if array.ndim != 1 or (length is not None and len(array) != length):
        wanted = '(N,)' if length is None else f'({length},)'
        raise InputError(f'{name} has the shape {array.shape}, not {wanted}')
    return array
