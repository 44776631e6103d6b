"""Runs the node in a process of its own, for commands that demonstrate it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from ..core.common.errors import MapperError
from ..core.common.parameters import Parameters
from ..core.messages.message_types import Pose2
from ..files.parameter_file import NODE_NAME
from ..files.parameter_text import dump_parameters
from .domain import own_domain
from .signals import ENDS_WITH_STDIN

LONGEST_SILENCE = 180.0
"""Longest wait for the node to start or to answer while it does not compile, seconds."""

LONGEST_COMPILATION = 3600.0
"""Longest wait for an answer if the node compiles, seconds; slow computers need many minutes."""

AT_MOST = f'at most {LONGEST_COMPILATION / 60:.0f} minutes'

KILL_AFTER = 15.0
"""Seconds before a child that does not end is killed; the node ends itself after 5."""


def start_child(arguments: Sequence[str], environment: Mapping[str, str], **options: Any) -> subprocess.Popen[bytes]:
    """Start one of our commands in a process that ends with this one, even after SIGKILL.

    The child reads its standard input, which ends with this process. It has its own session, so that Ctrl-C in the
    terminal reaches only this process, which then ends the child in order.
    """
    return subprocess.Popen(
        [sys.executable, '-m', 'forward_grid_mapper', *arguments],
        env={**environment, ENDS_WITH_STDIN: '1'},
        stdin=subprocess.PIPE,
        start_new_session=True,
        **options,
    )


def end_child(process: subprocess.Popen[bytes]) -> None:
    """End a child in order, or else kill it; return after its end."""
    process.terminate()
    try:
        process.wait(KILL_AFTER)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdin is not None:
        process.stdin.close()


class Limit:
    """The end of the wait for an answer; it is moved while the node reports that it compiles kernels.

    Attributes
    ----------
    compiling : str
        What the node has to compile, in its words; '' if nothing.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        """`now` returns monotonic seconds."""
        self._now = now
        self.compiling = ''
        self.begin()

    def begin(self) -> None:
        """Begin to wait."""
        now = self._now()
        self._end, self._last = now + LONGEST_SILENCE, now + LONGEST_COMPILATION

    def hear(self, diagnostics: Any) -> None:
        """Receive a message on `/diagnostics`."""
        for status in diagnostics.status:
            for pair in status.values:
                if status.name == f'{NODE_NAME}: background' and pair.key == 'kernels':
                    # otherwise it is idle, or compilation has failed
                    self.compiling = pair.value if pair.value.endswith('to do') else ''
        if self.compiling:
            self._end = min(self._now() + LONGEST_SILENCE, self._last)

    @property
    def passed(self) -> str:
        """What is wrong if the wait must end now, with a remedy; otherwise ''."""
        if self._now() < self._end:
            return ''
        if self._end < self._last or not self.compiling:
            return f'the node has not answered for {LONGEST_SILENCE:.0f} s'
        return (
            f'the node still compiles after {LONGEST_COMPILATION / 60:.0f} minutes; compile without it, with '
            'python3 -m forward_grid_mapper warm_up, and repeat the command'
        )


class LiveNode:
    """Starts the node with given parameters in a DDS domain of its own, and calls its services.

    Used as a context manager.
    """

    def __init__(
        self,
        folder: Path,
        parameters: Parameters,
        extrinsics: Iterable[tuple[str, Pose2]],
        tell: Callable[[str], object] = lambda text: None,
    ) -> None:
        """`folder` is for the node's parameters and its log; `tell` receives what is waited for."""
        self._folder = folder
        self._log = folder / 'node.log'
        lines = [dump_parameters(parameters), '\n    # ---- Poses of the sensors on the robot\n\n']
        lines += [f'    sensors.{frame}.pose: [{p.x!r}, {p.y!r}, {p.yaw!r}]\n' for frame, p in extrinsics]
        (folder / 'parameters.yaml').write_text(''.join(lines), encoding='utf-8')
        self.environment = dict(os.environ)
        self._domain = ExitStack()
        self._client: Any = None
        self._process: subprocess.Popen[bytes] | None = None
        self._tell = tell
        self._limit = Limit()

    def __enter__(self) -> LiveNode:
        """Start the node; if anything else fails, end it."""
        try:
            self._start()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def _start(self) -> None:
        # other robots or demos must not receive these messages
        domain = str(self._domain.enter_context(own_domain()))
        self.environment.update(ROS_DOMAIN_ID=domain, ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
        with self._log.open('wb') as log:
            arguments = ['mapper', '--ros-args', '--params-file', str(self._folder / 'parameters.yaml')]
            self._process = start_child(arguments, self.environment, stdout=log, stderr=subprocess.STDOUT)
        os.environ.update(self.environment)
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        from diagnostic_msgs.msg import DiagnosticArray

        self._client = rclpy.create_node(f'{NODE_NAME}_demo')
        self._client.create_subscription(DiagnosticArray, '/diagnostics', self._limit.hear, 10)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the node."""
        import rclpy

        try:
            if self._client is not None:
                self._client.destroy_node()
            rclpy.try_shutdown()
        finally:
            with self._domain:
                if self._process is not None:
                    end_child(self._process)

    def run(self, *arguments: str) -> None:
        """Run another command while the node runs, and wait for its end.

        Raises
        ------
        MapperError
            If it fails.
        """
        process = start_child(arguments, self.environment)
        try:
            code = process.wait()
        finally:
            end_child(process)
        if code != 0:
            raise MapperError(f'{arguments[0]} failed; {self._last_words()}')

    def call(self, service: str, what: str) -> str:
        """Call a service of type Trigger; return its message. `what` describes the call.

        Raises
        ------
        MapperError
            If the node ends or does not answer, or the service reports a failure.
        """
        from std_srvs.srv import Trigger

        client = self._client.create_client(Trigger, f'/{NODE_NAME}/{service}')
        self._wait(client.service_is_ready, what)
        future = client.call_async(Trigger.Request())
        self._wait(future.done, what)
        answer = future.result()
        if not answer.success:
            raise MapperError(f'{service}: {answer.message}; {self._last_words()}')
        return str(answer.message)

    def _wait(self, done: Callable[[], bool], what: str) -> None:
        """Turn the client until something is done.

        Raises
        ------
        MapperError
            If the node ends or does not answer.
        """
        import rclpy

        self._limit.begin()
        while not done():
            if self._process is None or self._process.poll() is not None:
                raise MapperError(f'the node ended; {self._last_words()}')
            if why := self._limit.passed:
                raise MapperError(f'{what}: {why}; {self._last_words()}')
            left = self._limit.compiling
            self._tell(f'{what}: waiting until the node has compiled its kernels ({left}), {AT_MOST}' if left else what)
            rclpy.spin_once(self._client, timeout_sec=0.1)

    def _last_words(self) -> str:
        lines = self._log.read_text(errors='replace').splitlines() if self._log.exists() else []
        return 'its last words: ' + ' | '.join(lines[-3:]) if lines else 'it printed nothing'
