"""`warm_up`: compiles the kernels that are not in the cache, to save time at the first start of the node."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

from ..core.common.words import counted
from ..core.runtime import compiling
from ..core.runtime.jit import CACHE
from ..core.warm_up import STEPS
from .console import run

COMMAND = 'warm_up'
DESCRIPTION = """Compile every kernel and keep the machine code on disk, where the node and the other commands find it:
one to three minutes the first time, two seconds if they are there. Run it once after an installation, as
the user who will run the node, or with NUMBA_CACHE_DIR set to a folder that this user can write."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    return argparse.ArgumentParser(COMMAND, description=DESCRIPTION, epilog='example: warm_up')


def compile_kernels(options: argparse.Namespace) -> int:
    """Run the command with its options."""
    begin = time.monotonic()
    for name, compile_all in STEPS.items():
        print(f'{name} kernels …', flush=True)
        compile_all()
    made = counted(compiling.count(), 'compilation') if compiling.count() else 'nothing to compile'
    print(f'all kernels are in {CACHE} after {time.monotonic() - begin:.1f} s, {made}')
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run(parser(), compile_kernels, arguments)
