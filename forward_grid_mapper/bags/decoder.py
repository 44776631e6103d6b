"""Deserializes messages, by the definition in the bag or else by those of ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from .source import Channel, Damage

TF_MESSAGE = 'tf2_msgs/msg/TFMessage'
# ROS 1 has tf2_msgs, but rosbags' type store of Noetic lacks it.
TF_MESSAGE_ROS1 = get_types_from_msg('geometry_msgs/TransformStamped[] transforms', TF_MESSAGE)
_IDL_SEPARATOR = '=' * 80 + '\n'

LARGEST_DEFINITION = 1 << 18
"""Most characters of a message definition; that of Odometry has 10 000 with all comments."""

MOST_FIELDS = 10_000
"""Most values in a message, including elements of arrays: rosbags generates some lines of code for each."""

LONGEST_SEQUENCE = 100_000
"""Most elements of a sequence in a message; a Range and an Odometry have none, a TFMessage some for each frame."""

Fields = Mapping[str, Any]
"""Definitions parsed by rosbags: constants and (name, descriptor) of the fields, by message type."""


class Decoder:
    """Decodes the messages of one type and definition.

    Without a definition in the bag, those of Jazzy and Humble are tried: `sensor_msgs/Range` gained `variance` between
    them, and the length of a message shows which one fits.

    Attributes
    ----------
    msgtype : str
    ros1 : bool
        Whether messages have the encoding of ROS 1.
    """

    def __init__(self, msgtype: str, encoding: str, definition_format: str, definition: str) -> None:
        self.msgtype = msgtype
        self.ros1 = encoding == 'ros1'
        embedded = _embedded_store(msgtype, definition_format, definition)
        self._stores = [embedded] if embedded else default_stores(ros1=self.ros1)

    def __call__(self, data: bytes) -> Any:
        """Return the message.

        Raises
        ------
        Exception
            Of many classes, if the bytes do not fit the definition.
        """
        for store in self._stores[:-1]:
            try:
                return self._decode(store, data)
            except Exception:  # this definition does not fit; the error of the last one is reported
                continue
        return self._decode(self._stores[-1], data)

    def fitting(self, data: bytes) -> Any:
        """Return the store whose definition decodes a message; None if none does."""
        for store in self._stores:
            try:
                self._decode(store, data)
                return store
            except Exception:  # as above
                continue
        return None

    def _decode(self, store: Any, data: bytes) -> Any:
        decode = store.deserialize_ros1 if self.ros1 else store.deserialize_cdr
        return decode(data, self.msgtype)


@lru_cache(maxsize=256)
def _cached(msgtype: str, encoding: str, definition_format: str, definition: str) -> Decoder:
    return Decoder(msgtype, encoding, definition_format, definition)


def decoder_of(channel: Channel) -> Decoder:
    """Return the decoder for a channel's messages; channels of the same type share it."""
    return _cached(channel.msgtype, channel.encoding, channel.definition_format, channel.definition)


@lru_cache(maxsize=2)
def default_stores(*, ros1: bool) -> list[Any]:
    """Return rosbags type stores with the definitions of ROS, the newest first."""
    stores = [Stores.ROS1_NOETIC] if ros1 else [Stores.ROS2_JAZZY, Stores.ROS2_HUMBLE]
    made = [get_typestore(store) for store in stores]
    for store in made:
        store.max_sequence_length = LONGEST_SEQUENCE
    if ros1:
        made[0].register(TF_MESSAGE_ROS1)
    return made


def _embedded_store(msgtype: str, definition_format: str, definition: str) -> Any:
    """Return a type store with the bag's own definition; None if that is missing, unreadable or too large."""
    if definition_format not in ('msg', 'idl') or not definition.strip() or len(definition) > LARGEST_DEFINITION:
        return None
    types: dict[str, Any] = {}
    try:
        if definition_format == 'msg':
            # rosbags needs a tenth of a millisecond for an empty line
            lines = (line for line in definition.splitlines() if line.strip())
            types.update(get_types_from_msg('\n'.join(lines) + '\n', msgtype))
        else:
            parts = definition.split(_IDL_SEPARATOR)
            texts = [part.split('\n', 1)[1] for part in parts if part.startswith('IDL: ')] or [definition]
            for text in texts:
                types.update(get_types_from_idl(text))
        needed = _needed(types, msgtype)
        if _size(types, msgtype, {})[1] > MOST_FIELDS:
            return None
        store = get_typestore(Stores.EMPTY)
        store.max_sequence_length = LONGEST_SEQUENCE
        store.register({name: types[name] for name in needed})
        return store if msgtype in store.types else None
    except Exception:  # the parser's errors are of many classes; the default definition is used instead
        return None


def _parts(types: Fields, msgtype: str) -> Iterator[tuple[str, Any, int]]:
    """Yield kind, element descriptor and length of each field of a type."""
    for _, (kind, inner) in types[msgtype][1]:
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            element, length = inner
            yield ('array' if kind == Nodetype.ARRAY else 'sequence'), element, length
        else:
            yield 'single', (kind, inner), 1


def _needed(types: Fields, msgtype: str) -> set[str]:
    """Return the types that a message of a type consists of."""
    found, new = {msgtype}, [msgtype]
    while new:
        for _, (kind, inner), _ in _parts(types, new.pop()):
            if kind == Nodetype.NAME and inner in types and inner not in found:
                found.add(inner)
                new.append(inner)
    return found


def _size(types: Fields, msgtype: str, known: dict[str, tuple[int, int] | None]) -> tuple[int, int]:
    """Return the smallest number of bytes of a message, and its number of values without elements of sequences.

    Raises
    ------
    Damage
        If a type contains itself, or an array or a sequence has elements of zero bytes, so that the length of a message
        does not bound their number.
    """
    if msgtype in known:
        result = known[msgtype]
        if result is None:
            raise Damage(f'{msgtype} contains itself')
        return result
    if msgtype not in types:
        # a time or a duration, which the store defines
        return 8, 2
    known[msgtype] = None
    least = values = 0
    for shape, (kind, inner), length in _parts(types, msgtype):
        named = kind == Nodetype.NAME
        element = _size(types, inner, known) if named else (1, 1)
        if shape != 'single' and not element[0]:
            raise Damage(f'{msgtype} has elements without a byte')
        # an array of numbers is read at once
        unrolled = named or inner[0] in ('string', 'wstring')
        count = length if shape == 'array' else 1
        least += 4 if shape == 'sequence' else element[0] * count
        values += element[1] * (count if unrolled else 1)
    known[msgtype] = least, values
    return least, values
