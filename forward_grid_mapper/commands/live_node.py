"""The node in a process of its own, for commands that show it at work."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from ..core.common.errors import MapperError
from ..core.common.parameters import Parameters
from ..core.messages.message_types import Pose2
from ..files.parameter_text import dump_parameters

NODE = '/forward_grid_mapper'
START = 180.0
"""Seconds that a node may take to get ready: its first start compiles."""


class LiveNode:
    """Starts the node with given parameters in a DDS domain of its own, and calls its services.

    Used as a context manager.
    """

    def __init__(self, folder: Path, parameters: Parameters, extrinsics: Iterable[tuple[str, Pose2]]) -> None:
        """`folder` takes the node's parameters and its log."""
        self._folder = folder
        self._log = folder / 'node.log'
        lines = [dump_parameters(parameters), '\n    # ---- Poses of the sensors on the robot\n\n']
        lines += [f'    sensors.{frame}.pose: [{p.x!r}, {p.y!r}, {p.yaw!r}]\n' for frame, p in extrinsics]
        (folder / 'parameters.yaml').write_text(''.join(lines), encoding='utf-8')
        # neither other robots nor another demo may receive this one's messages
        domain = str(1 + os.getpid() % 100)
        self.environment = {**os.environ, 'ROS_DOMAIN_ID': domain, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
        self._client: Any = None
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> LiveNode:
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        os.environ.update(self.environment)
        with self._log.open('wb') as log:
            self._process = self._start(
                ['mapper', '--ros-args', '--params-file', str(self._folder / 'parameters.yaml')],
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._client = rclpy.create_node('forward_grid_mapper_demo')
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        import rclpy

        if self._client is not None:
            self._client.destroy_node()
            rclpy.try_shutdown()
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(15)
            except subprocess.TimeoutExpired:
                self._process.kill()

    def _start(self, arguments: Sequence[str], **options: Any) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, '-m', 'forward_grid_mapper', *arguments], env=self.environment, **options
        )

    def run(self, *arguments: str) -> None:
        """Run another of our commands beside the node, and wait for its end.

        Raises
        ------
        MapperError
            If it fails.
        """
        process = self._start(arguments)
        try:
            code = process.wait()
        finally:
            process.terminate()
        if code != 0:
            raise MapperError(f'{arguments[0]} failed; {self._last_words()}')

    def call(self, service: str) -> str:
        """Call a service of type Trigger; return its message.

        Raises
        ------
        MapperError
            If the node ends or does not answer, or the service reports a failure.
        """
        import rclpy
        from std_srvs.srv import Trigger

        client = self._client.create_client(Trigger, f'{NODE}/{service}')
        end = time.monotonic() + START
        while not client.service_is_ready():
            self._check(end)
            time.sleep(0.05)
        future = client.call_async(Trigger.Request())
        end = time.monotonic() + START
        while not future.done():
            self._check(end)
            rclpy.spin_once(self._client, timeout_sec=0.1)
        answer = future.result()
        if not answer.success:
            raise MapperError(f'{service}: {answer.message}; {self._last_words()}')
        return str(answer.message)

    def _check(self, end: float) -> None:
        if self._process is None or self._process.poll() is not None:
            raise MapperError(f'the node ended; {self._last_words()}')
        if not time.monotonic() < end < math.inf:
            raise MapperError(f'the node does not answer; {self._last_words()}')

    def _last_words(self) -> str:
        lines = self._log.read_text(errors='replace').splitlines() if self._log.exists() else []
        return 'its last words: ' + ' | '.join(lines[-3:]) if lines else 'it said nothing'
