"""Read a journal as process_bag does, in a separate process: `examine_journal.py FILE [pause]`.

Print as JSON the number of readings, the faults of the file, and the memory in MB. With `pause`, wait for a line on
standard input after the first readings.
"""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path

from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.files.journal_format import Contents
from forward_grid_mapper.files.journal_reader import read


def main(path: str, pause: bool) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    contents = Contents()
    count, error = 0, ''
    try:
        for readings in read(Path(path), contents):
            count += len(readings)
            if pause:
                print('some', flush=True)
                sys.stdin.readline()
                pause = False
    except BagError as said:
        error = str(said)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(json.dumps({'count': count, 'error': error, 'harm': contents.harm, 'memory': grown}))


if __name__ == '__main__':
    main(sys.argv[1], sys.argv[2:] == ['pause'])
