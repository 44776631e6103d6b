"""Commands started without standard streams, as some daemons do."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from drive_samples import tape, write_tape

PLACES = """
import os, sys
from forward_grid_mapper import __main__
__main__._open_streams()
print(*(os.readlink(f'/proc/self/fd/{number}') for number in (0, 1, 2)), file=open(sys.argv[1], 'w'))
"""


def started(closed: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Run Python in a shell that closes some streams."""
    command = ' '.join(['exec "$@"', closed])
    return subprocess.run(
        ['/bin/sh', '-c', command, 'sh', sys.executable, *map(str, words)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize('closed', ['>&-', '2>&-', '<&- >&- 2>&-'])
def test_command_works_with_closed_streams(tmp_path: Path, closed: str) -> None:
    folder = tmp_path / 'drive'
    done = started(closed, '-m', 'forward_grid_mapper', 'simulate', 'door', '--seen', 1, '-o', folder)
    # a slow machine also shows progress
    assert (done.returncode, re.sub(r' *\d+ s  \w+\n', '', done.stderr)) == (0, '')
    assert (folder / 'bag' / 'metadata.yaml').is_file()
    assert ('readings' in done.stdout) == ('>&-' not in closed.split())


def test_error_has_its_exit_code_with_closed_streams(tmp_path: Path) -> None:
    done = started('>&-', '-m', 'forward_grid_mapper', 'process_bag', tmp_path / 'absent', '-o', tmp_path / 'maps')
    assert done.returncode == 1
    assert done.stderr.startswith('process_bag: error: ') and done.stderr.count('\n') == 1
    for word in ('--help', '--version', '--list-parameters'):
        done = started('>&-', '-m', 'forward_grid_mapper', 'process_bag', word)
        assert (done.returncode, done.stderr) == (0, '')


def test_closed_streams_are_replaced_by_dev_null(tmp_path: Path) -> None:
    """Otherwise the first file that the command opens would receive what libraries print."""
    report = tmp_path / 'report'
    started('<&- >&- 2>&-', '-c', PLACES, report)
    assert report.read_text().split() == ['/dev/null'] * 3


def test_json_with_closed_output_succeeds(tmp_path: Path) -> None:
    bag = write_tape(tmp_path / 'bag', tape())
    done = started('>&-', '-m', 'forward_grid_mapper', 'process_bag', bag, '-o', tmp_path / 'maps', '--json', '-q')
    assert done.returncode == 0 and 'Traceback' not in done.stderr
    assert (tmp_path / 'maps' / 'report.json').is_file()
