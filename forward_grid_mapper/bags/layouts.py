"""Positions of numbers in serialized messages, so that many messages can be read at once.

Strings and the lengths of sequences determine the position of everything after them. So a layout holds for all
messages of the same length in which these bytes are the same, such as those of one sensor. It is made from the
definition by which rosbags decodes, and is used only if it agrees with rosbags on random bytes.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from .source import Damage

Path = tuple[str | int, ...]
"""A field of a message: names of fields, and indices of elements."""

_KINDS = {
    **{f'{sign}int{bits}': f'{sign[:1] or "i"}{bits // 8}' for sign in ('', 'u') for bits in (8, 16, 32, 64)},
    **{'float32': 'f4', 'float64': 'f8', 'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1'},
}
"""Types of numpy for those of messages."""

MOST_ELEMENTS = 256
"""Most elements of a sequence in a layout, such as transforms of one message."""


class Layout:
    """Positions of the fields of a message.

    Attributes
    ----------
    fields : dict
        Position and type of each number, by its path.
    fixed : int64, shape (K,)
        The bytes that must be the same.
    """

    def __init__(self, store: Any, msgtype: str, data: bytes, ros1: bool) -> None:
        """Make the layout of a message that rosbags can decode.

        Raises
        ------
        Damage
            If such messages have no layout.
        """
        self._types, self._data, self._ros1 = store.fielddefs, data, ros1
        self._head = 0 if ros1 else 4
        self._order: Literal['<', '>'] = '<' if ros1 or data[1] else '>'
        self._at = self._head
        self.fields: dict[Path, tuple[int, np.dtype[Any]]] = {}
        self._fixed: list[int] = list(range(self._head))
        self._message(msgtype, ())
        self.fixed = np.array(self._fixed, np.int64)

    def _align(self, size: int) -> None:
        if not self._ros1:
            self._at += -(self._at - self._head) % size

    def _count(self) -> int:
        """Return the length of a string or of a sequence."""
        self._align(4)
        here = self._at
        self._fix(4)
        return int(np.frombuffer(self._data, f'{self._order}u4', 1, here)[0])

    def _fix(self, size: int) -> None:
        self._fixed += range(self._at, self._at + size)
        self._at += size

    def _message(self, msgtype: str, path: Path) -> None:
        for name, (kind, inner) in self._types[msgtype][1]:
            here = (*path, name)
            if kind == Nodetype.ARRAY:
                self._elements(inner[0], inner[1], here)
            elif kind == Nodetype.SEQUENCE:
                count = self._count()
                if inner[0][0] != Nodetype.NAME or count > MOST_ELEMENTS:
                    raise Damage('no layout')
                self._elements(inner[0], count, here)
            else:
                self._single(kind, inner, here)

    def _elements(self, element: tuple[Any, Any], count: int, path: Path) -> None:
        kind, inner = element
        if kind == Nodetype.BASE and inner[0] in _KINDS:
            size = np.dtype(_KINDS[inner[0]]).itemsize
            self._align(size)
            self._at += count * size
            return
        for number in range(count):
            self._single(kind, inner, (*path, number))

    def _single(self, kind: Any, inner: Any, path: Path) -> None:
        if kind == Nodetype.NAME:
            self._message(inner, path)
        elif inner[0] == 'string':
            self._fix(self._count())
        elif inner[0] in _KINDS:
            number = np.dtype(_KINDS[inner[0]]).newbyteorder(self._order)
            self._align(number.itemsize)
            self.fields[path] = self._at, number
            self._at += number.itemsize
        else:
            raise Damage('no layout')

    def column(self, path: Path, rows: NDArray[np.uint8]) -> NDArray[Any]:
        """Return a field of messages of this layout, whose bytes are `rows`, shape (N, length)."""
        at, kind = self.fields[path]
        return np.ascontiguousarray(rows[:, at : at + kind.itemsize]).view(kind).ravel()

    def agrees(self, decode: Any, paths: Sequence[Path]) -> bool:
        """Return whether rosbags and the layout decode these fields equally, for any values of variable bytes."""
        rng = np.random.default_rng(0)
        for _ in range(3):
            row = rng.integers(0, 256, len(self._data), np.uint8)
            row[self.fixed] = np.frombuffer(self._data, np.uint8)[self.fixed]
            for at, kind in (self.fields[path] for path in paths):
                value = rng.normal(size=1) if kind.kind == 'f' else rng.integers(0, 2**31 - 1, 1)
                row[at : at + kind.itemsize] = value.astype(kind).view(np.uint8)
            message = decode(row.tobytes())
            for path in paths:
                if attribute(message, path) != self.column(path, row[None])[0]:
                    return False
        return True


def attribute(message: Any, path: Path) -> Any:
    """Return a field of a message decoded by rosbags."""
    return functools.reduce(lambda of, name: of[name] if isinstance(name, int) else getattr(of, name), path, message)


def by_length(data: Sequence[bytes]) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """Yield, for each length, the indices of such messages and their bytes, shape (N, length)."""
    lengths = np.fromiter(map(len, data), np.int64, len(data))
    for length in np.unique(lengths).tolist():
        which = np.flatnonzero(lengths == length)
        raw = b''.join(data) if len(which) == len(data) else b''.join([data[k] for k in which.tolist()])
        yield which, np.frombuffer(raw, np.uint8).reshape(len(which), length)
