"""Counts in sentences, and names that can be shown."""

from __future__ import annotations


def counted(number: int, noun: str, spec: str = '') -> str:
    """Return a number with its noun, `1 reading` or `2 readings`; `spec` is the number's format, such as `,`."""
    return f'{number:{spec}} {noun}{"" if number == 1 else "s"}'


def printable(text: str) -> str:
    """Return a text with escapes for characters that cannot be printed, except line ends.

    Names of topics and frames in a bag may contain any characters, also those that control a terminal.
    """
    return ''.join(c if c.isprintable() or c == '\n' else c.encode('unicode_escape').decode() for c in text)
