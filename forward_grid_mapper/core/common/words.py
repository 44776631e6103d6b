"""Counts in sentences."""

from __future__ import annotations


def counted(number: int, noun: str, spec: str = '') -> str:
    """Return a number with its noun, `1 reading` or `2 readings`; `spec` is the number's format, such as `,`."""
    return f'{number:{spec}} {noun}{"" if number == 1 else "s"}'
