"""A short run of the fuzzer `benchmarks/fuzz.py`."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='the node is fuzzed')

FUZZ = Path(__file__).resolve().parents[2] / 'benchmarks' / 'fuzz.py'


def test_hostile_messages_are_accounted_for(domain: int) -> None:
    process = subprocess.run(
        [sys.executable, str(FUZZ), '--messages', '8000', '--dds', '1500', '--seed', '7'],
        capture_output=True,
        text=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'},
        timeout=120,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert '8000 messages' in process.stdout
    assert int(re.search(r'^accepted (\d+)', process.stdout, re.MULTILINE)[1]) > 1000
    assert process.stdout.count('unknown_extrinsics') == 1
    assert re.search(r'1500 messages over DDS.*ranges received', process.stdout)
