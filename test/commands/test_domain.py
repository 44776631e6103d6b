"""A DDS domain that no other process uses."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from patience import line_of

from forward_grid_mapper.commands import domain
from forward_grid_mapper.commands.domain import own_domain
from forward_grid_mapper.core.common.errors import MapperError


def test_reserved_domains_differ_and_are_released(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domain, 'LAST', 3)
    with ExitStack() as stack:
        with own_domain() as one, own_domain() as other:
            assert one != other
            stack.enter_context(own_domain())
            with pytest.raises(MapperError, match=r'every DDS domain from 1 to 3 is in use'), own_domain():
                pass
        with own_domain() as again:
            assert again in (one, other)


def test_domain_with_a_participant_is_skipped() -> None:
    with own_domain() as found:
        pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('', 7400 + 250 * found + 10))
        with own_domain() as other:
            assert other != found


def test_port_of_a_participant_is_that_of_the_middleware(tmp_path: Path) -> None:
    pytest.importorskip('rclpy', reason='rclpy is not installed (the extra ros, or a sourced ROS 2)')
    with own_domain() as found:
        environment = {**os.environ, 'ROS_DOMAIN_ID': str(found), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
        script = tmp_path / 'participant.py'
        script.write_text(
            "import rclpy\nrclpy.init()\nnode = rclpy.create_node('a')\nprint('made', flush=True)\ninput()\n"
        )
        with subprocess.Popen(
            [sys.executable, str(script)], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            assert line_of(process) == 'made\n'
            port = 7400 + domain.PORTS * found + domain.FIRST_PARTICIPANT
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken, pytest.raises(OSError, match='in use'):
                taken.bind(('', port))
            process.communicate('\n', timeout=60.0)
