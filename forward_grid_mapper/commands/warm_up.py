"""`warm_up`: compiles the kernels that the cache lacks, so that the first start of the node need not."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

DESCRIPTION = """Compile every kernel and keep the machine code on disk, where the node and the other commands find it:
half a minute to two minutes the first time, some seconds if all is there. To be run once after an installation, as the
user who will run the node, or with NUMBA_CACHE_DIR set to a folder that this user can write."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    return argparse.ArgumentParser(prog='warm_up', description=DESCRIPTION)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser().parse_args(arguments)
    from ..core import warm_up
    from ..core.runtime import compiling, jit

    begin = time.monotonic()
    for name, compile_all in warm_up.STEPS.items():
        print(f'kernels of the {name} …', flush=True)
        compile_all()
    made = f'{compiling.count()} compilations' if compiling.count() else 'nothing to compile'
    print(f'all kernels are in {jit.CACHE} after {time.monotonic() - begin:.1f} s, {made}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
