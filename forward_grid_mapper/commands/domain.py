"""A DDS domain that no other process on this machine uses."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from ..core.common.errors import MapperError

LAST = 100
"""The highest domain that is used: Linux may give the ports of domains above 101 to any program."""

PORTS = 250
"""Ports of one domain, the first of which is 7400 for domain 0 (DDSI-RTPS 2.5, section 9.6.2.3)."""

FIRST_PARTICIPANT, LAST_PORT = 10, 249
"""Ports of a domain, counted from its first: that of its first participant, and one that only the 120th would use."""


def _bound(port: int) -> socket.socket | None:
    """Return a socket bound to a UDP port; None if the port is in use."""
    held = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        held.bind(('', port))
    except OSError:
        held.close()
        return None
    return held


@contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a domain, 1 to `LAST`, without participants; other processes that call this function get other domains.

    Raises
    ------
    MapperError
        If every domain is in use.
    """
    # so that processes that start together begin with different domains
    for k in range(LAST):
        domain = 1 + (os.getpid() + k) % LAST
        first = 7400 + PORTS * domain
        claim = _bound(first + LAST_PORT)
        if claim is None:
            continue
        with claim:
            participant = _bound(first + FIRST_PARTICIPANT)
            if participant is None:
                continue
            participant.close()
            yield domain
            return
    raise MapperError(f'every DDS domain from 1 to {LAST} is in use on this machine; end some of the ROS processes')
