"""From serialized bytes to message objects, by the definition in the bag or else by those ROS ships."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from .source import Channel

TF_MESSAGE = 'tf2_msgs/msg/TFMessage'
# ROS 1 has tf2_msgs, but rosbags' store of Noetic's types leaves it out.
TF_MESSAGE_ROS1 = get_types_from_msg('geometry_msgs/TransformStamped[] transforms', TF_MESSAGE)
_IDL_SEPARATOR = '=' * 80 + '\n'


class Decoder:
    """Decodes the messages of one type and definition.

    Where the bag holds no definition, those of Jazzy and Humble are tried: `sensor_msgs/Range` gained `variance` in
    between, and the length of a message shows which of the two it is.
    """

    def __init__(self, msgtype: str, encoding: str, definition_format: str, definition: str) -> None:
        self._msgtype = msgtype
        self._ros1 = encoding == 'ros1'
        embedded = _embedded_store(msgtype, definition_format, definition)
        self._stores = [embedded] if embedded else default_stores(ros1=self._ros1)

    def __call__(self, data: bytes) -> Any:
        """Return the message.

        Raises
        ------
        Exception
            Of many kinds, if the bytes do not fit the definition.
        """
        for store in self._stores[:-1]:
            try:
                return self._decode(store, data)
            except Exception:  # this definition does not fit; the last one's error is the one to report
                continue
        return self._decode(self._stores[-1], data)

    def _decode(self, store: Any, data: bytes) -> Any:
        decode = store.deserialize_ros1 if self._ros1 else store.deserialize_cdr
        return decode(data, self._msgtype)


@lru_cache(maxsize=256)
def _cached(msgtype: str, encoding: str, definition_format: str, definition: str) -> Decoder:
    return Decoder(msgtype, encoding, definition_format, definition)


def decoder_of(channel: Channel) -> Decoder:
    """Return the decoder for a channel's messages; the same for channels of one type."""
    return _cached(channel.msgtype, channel.encoding, channel.definition_format, channel.definition)


@lru_cache(maxsize=2)
def default_stores(*, ros1: bool) -> list[Any]:
    """Return rosbags type stores with the definitions that ROS ships, the newest first."""
    if not ros1:
        return [get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS2_HUMBLE)]
    noetic = get_typestore(Stores.ROS1_NOETIC)
    noetic.register(TF_MESSAGE_ROS1)
    return [noetic]


def _embedded_store(msgtype: str, definition_format: str, definition: str) -> Any:
    """Return a type store with the bag's own definition, None if there is none or it is unreadable."""
    if definition_format not in ('msg', 'idl') or not definition.strip():
        return None
    types: dict[str, Any] = {}
    try:
        if definition_format == 'msg':
            types.update(get_types_from_msg(definition, msgtype))
        else:
            parts = definition.split(_IDL_SEPARATOR)
            texts = [part.split('\n', 1)[1] for part in parts if part.startswith('IDL: ')] or [definition]
            for text in texts:
                types.update(get_types_from_idl(text))
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        return store if msgtype in store.types else None
    except Exception:  # the parser's errors are of many kinds; the default definition serves as well
        return None
