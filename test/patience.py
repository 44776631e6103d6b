"""Waits with a time limit, so that tests fail instead of waiting forever."""

from __future__ import annotations

import subprocess
import threading

PATIENCE = 120.0
"""Seconds; all events that tests wait for come much sooner, also on a busy machine."""


def line_of(process: subprocess.Popen[str]) -> str:
    """Return the next line that a process prints; without one, the process is killed and the line is empty."""
    assert process.stdout is not None
    killer = threading.Timer(PATIENCE, process.kill)
    killer.start()
    try:
        return process.stdout.readline()
    finally:
        killer.cancel()
