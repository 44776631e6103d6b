"""Waits that end: what never comes fails a test instead of keeping it for ever."""

from __future__ import annotations

import subprocess
import threading

PATIENCE = 120.0
"""Seconds; whatever a test waits for comes much sooner, also on a machine that has other work."""


def line_of(process: subprocess.Popen[str]) -> str:
    """Return the next line that a process prints; it is killed if none comes, which gives an empty one."""
    assert process.stdout is not None
    killer = threading.Timer(PATIENCE, process.kill)
    killer.start()
    try:
        return process.stdout.readline()
    finally:
        killer.cancel()
