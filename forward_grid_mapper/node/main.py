"""`mapper`: starts the node, and shuts it down in order."""

from __future__ import annotations

import signal

if __name__ == '__main__':
    # until `Stopper` exists, Ctrl-C ends the process at once, without a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import os
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from typing import Any

from .. import __version__
from ..core.common.errors import MapperError
from .stopping import Stopper

USAGE = """usage: mapper [--ros-args ...]

Maps sonar Range and Odometry: publishes a live map, and on ~/run_em the maximum likelihood and uncertainty maps.
Parameters: --ros-args -p NAME:=VALUE, or --params-file FILE (config/mapper.yaml lists all). Remap the topics sonar
and odom with -r sonar:=/my/sonar -r odom:=/my/odom.

example: mapper --ros-args --params-file my_robot.yaml -r sonar:=/ultrasonic"""


LOG_EVERY = 10.0
"""Seconds between two reports of callbacks that fail."""


class _Stop(Exception):
    """Raised inside the executor to stop spinning."""


def _raise_stop() -> None:
    raise _Stop


def _spin(executor: Any, node: Any) -> None:
    """Spin until `_Stop` or the shutdown of ROS; a callback that fails is logged, and the node continues."""
    logged = 0.0
    while executor.context.ok():
        try:
            executor.spin()
        except _Stop:
            raise
        except Exception:
            now = time.monotonic()
            if now > logged + LOG_EVERY:
                logged = now
                node.get_logger().error(f'a callback failed, mapping continues: {traceback.format_exc()}')
            # so that a callback that always fails does not use all processor time
            time.sleep(0.001)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped; return the exit code."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if '--version' in arguments:
        print(f'mapper of forward_grid_mapper {__version__}')
        return 0
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    if '-h' in arguments or '--help' in arguments:
        print(USAGE)
        return 0
    stopper = Stopper()
    try:
        import rclpy
        from rclpy.exceptions import NameValidationException
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.impl.implementation_singleton import rclpy_implementation
        from rclpy.signals import SignalHandlerOptions
        from rclpy.utilities import remove_ros_args
    except ImportError as error:
        print(
            f'mapper: error: ROS 2 is not installed, or not sourced ({error}): source its setup.bash, or pip install '
            "'.[ros]'",
            file=sys.stderr,
        )
        return 1
    # threads switch often, so that callbacks do not wait long for EM between two kernels
    sys.setswitchinterval(0.0005)
    from . import error_explanations

    if wrong := error_explanations.explain_domain(os.environ):
        print(f'mapper: error: {wrong}', file=sys.stderr)
        return 1
    try:
        rclpy.init(args=['mapper', *arguments], signal_handler_options=SignalHandlerOptions.NO)
        left = remove_ros_args(['mapper', *arguments])[1:]
    except rclpy_implementation.UnknownROSArgsError as error:
        print(f'mapper: error: {error_explanations.explain_ros_arguments(str(error))}', file=sys.stderr)
        return 2
    except Exception as error:  # rclpy raises classes of its C extension, for a parameter file with a fault for one
        print(f'mapper: error: {error_explanations.explain_ros_error(error)}', file=sys.stderr)
        return 1
    if left:
        print(f'mapper: error: {error_explanations.explain_arguments(left)}\n{USAGE}', file=sys.stderr)
        return 2
    # imported here, since it takes a second, and a faulty command line is reported at once; numpy starts threads when
    # it is imported, and the signals must be blocked before
    from .kernels import Kernels
    from .mapper_node import MapperNode

    node = executor = None
    try:
        node = MapperNode()
        for text in error_explanations.missing_section_warnings(arguments, node.get_fully_qualified_name()):
            node.get_logger().warning(text)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.when_failed = lambda: executor.create_task(_raise_stop)
        if node.parameters.node.autostart:
            node.start()
        else:
            node.wait_for_manager()
        stopper.call(lambda: executor.create_task(_raise_stop))
        _spin(executor, node)
    except _Stop:
        pass
    except (MapperError, NameValidationException, ValueError, rclpy_implementation.RCLError) as error:
        wrong = str(error) if isinstance(error, MapperError) else error_explanations.explain_ros_error(error)
        print(f'mapper: error: {wrong}', file=sys.stderr)
        return 1
    finally:
        if node is not None:
            node.close('the node is being stopped')
            node.destroy_node()
        if executor is not None:
            # otherwise it finds ROS shut down when it is collected, and prints a traceback
            executor.shutdown(0.0)
        rclpy.try_shutdown()
    code = 0
    if node is not None and node.failure:
        print(f'mapper: error: {node.failure}', file=sys.stderr)
        code = 1
    if Kernels.at_work:
        # the compiler must not run while its libraries are unloaded
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


if __name__ == '__main__':
    sys.exit(main())
