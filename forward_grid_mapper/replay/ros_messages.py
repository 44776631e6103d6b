"""Converts messages decoded by rosbags, of ROS 1 or ROS 2, to those that rclpy publishes."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache
from importlib import import_module
from typing import Any

from ..core.common.errors import MapperError

NEWER = frozenset({'variance'})
"""Fields that recordings older than Jazzy lack; they keep their defaults."""


MISFITS = (AttributeError, TypeError, ValueError, AssertionError)
"""Exceptions when a message with another definition is copied."""


@lru_cache
def message_class(msgtype: str) -> Any:
    """Return the class of a type such as 'sensor_msgs/msg/Range'.

    Raises
    ------
    MapperError
        If its package is not installed.
    """
    package, _, name = msgtype.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except ImportError as error:
        raise MapperError(f'{error}; source ROS 2, or install ros-jazzy-{package.replace("_", "-")}') from error


def filled(message: Any, source: Any) -> Any:
    """Copy every field of `message` from `source`, recursively; return `message`.

    Fields that only `source` has, such as ROS 1's `header.seq`, are ignored. Fields must be numbers, text, fixed arrays
    of numbers, messages of such, or lists of messages.

    Raises
    ------
    *MISFITS
        If `source` lacks a field, or it has another type.
    """
    for name, kind in message.get_fields_and_field_types().items():
        if name in NEWER and not hasattr(source, name):
            continue
        current, value = getattr(message, name), getattr(source, name)
        if hasattr(current, 'get_fields_and_field_types'):
            filled(current, value)
        elif listed := re.fullmatch(r'sequence<(\w+)/(\w+)>', kind):
            item = message_class(f'{listed[1]}/msg/{listed[2]}')
            setattr(message, name, [filled(item(), each) for each in value])
        elif isinstance(current, (bool, int, float, str)):
            # rosbags may decode to numpy's numbers, which rclpy refuses
            setattr(message, name, type(current)(value))
        else:
            setattr(message, name, value)
    return message


def static_transforms(messages: Iterable[Any]) -> list[Any]:
    """Return the transforms of several `tf2_msgs/TFMessage`, the last one of each child frame, as in tf2.

    Raises
    ------
    MapperError, *MISFITS
    """
    kind = message_class('geometry_msgs/msg/TransformStamped')
    latest: dict[str, Any] = {}
    for message in messages:
        for item in message.transforms:
            latest[str(item.child_frame_id).lstrip('/')] = filled(kind(), item)
    return list(latest.values())
