"""Damaged, forged, endless and huge journals: reading must not hang, use much memory or return wrong readings."""

from __future__ import annotations

import json
import os
import random
import shutil
import sqlite3
import struct
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from journal_samples import FRAMES, Previous, database, made, numbers, opened, rows, until, written
from patience import PATIENCE, line_of

from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.files.journal import drive_file
from forward_grid_mapper.files.journal_format import ROW, Contents
from forward_grid_mapper.files.journal_opening import log_of
from forward_grid_mapper.files.journal_reader import read

FORGE = 'import sqlite3, sys; d = sqlite3.connect(sys.argv[1]); d.execute(sys.argv[2]); d.commit(); d.close()'

PROGRAM = [sys.executable, str(Path(__file__).parent / 'examine_journal.py')]
MOST_MB = 150.0
"""Largest memory of a reader for any file; a chunk of readings takes about 20."""


def examined(path: Path, seconds: float = 300.0) -> dict[str, Any]:
    """Read a file in another process, which must end in time, without a traceback, and with little memory."""
    done = subprocess.run([*PROGRAM, str(path)], capture_output=True, text=True, timeout=seconds, check=False)
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    assert result['memory'] < MOST_MB
    return result


def quickly(path: Path) -> dict[str, Any]:
    """Read a file in this process."""
    try:
        found, contents = numbers(path)
    except BagError as error:
        return {'count': 0, 'error': str(error), 'harm': ''}
    return {'count': len(found), 'error': '', 'harm': contents.harm}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / 'drive_0001.journal'


@pytest.mark.parametrize(
    ('column', 'value', 'message'),
    [
        ('x', np.nan, 'pose'),
        ('y', -np.inf, 'pose'),
        ('x', 2.1e7, 'pose'),
        ('yaw', np.nan, 'pose'),
        ('z', np.nan, 'range'),
        ('z', 0.0, 'range'),
        ('z', -1.0, 'range'),
        ('z', 9.5, 'range'),
        ('z_max', np.inf, 'range'),
        ('z_max', np.nan, 'range'),
        ('half_angle', 0.0, 'field of view'),
        ('half_angle', 1.6, 'field of view'),
        ('half_angle', np.nan, 'field of view'),
        ('sigma', -0.1, 'deviation'),
        ('sigma', np.inf, 'deviation'),
        ('sigma', np.nan, 'deviation'),
        ('stamp', 1 << 62, 'stamp'),
        ('stamp', -(1 << 63), 'stamp'),
        ('sensor', 2, 'sensor'),
        ('sensor', (1 << 32) - 1, 'sensor'),
    ],
)
@pytest.mark.parametrize('format', ['present', 'previous'])
def test_invalid_readings_are_left_out_and_reported(
    path: Path, format: str, column: str, value: float, message: str
) -> None:
    content = rows(made(1, 10))
    content[column][3] = value
    if format == 'previous':
        names = b''.join((Previous.frames(), Previous.name(0, 'left'), Previous.name(1, 'right')))
        path.write_bytes(Previous.MAGIC + names + Previous.readings(content))
        if column == 'sensor':
            # an unknown name is replaced
            assert len(numbers(path)[0]) == 10
            return
    else:
        database(path, [content.tobytes()]).close()
    found, contents = numbers(path)
    assert len(found) == 9
    assert set(found) <= set(range(1, 11))
    assert contents.harm.startswith('1 reading is left out, since its ')
    assert message in contents.harm


ENDLESS = 'WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n)'
BLOCK = made(0, 10)


@pytest.mark.parametrize(
    'sql',
    [
        ['DROP TABLE readings', f'CREATE VIEW readings AS {ENDLESS} SELECT i AS number, zeroblob(68) AS rows FROM n'],
        ['DROP TABLE sensors', f"CREATE VIEW sensors AS {ENDLESS} SELECT i AS number, x'61' AS name FROM n"],
        [f'CREATE VIEW more AS {ENDLESS} SELECT i FROM n'],
        ['CREATE TABLE more (number INTEGER PRIMARY KEY, rows BLOB)'],
        ['CREATE TRIGGER t AFTER INSERT ON readings BEGIN DELETE FROM readings; END'],
        ['CREATE INDEX i ON readings (rows)'],
        ['ALTER TABLE readings ADD COLUMN more'],
        [
            'DROP TABLE readings',
            'CREATE TABLE readings (number INTEGER PRIMARY KEY, rows BLOB AS (zeroblob(1000000000)))',
        ],
        ['DROP TABLE readings', 'CREATE VIRTUAL TABLE readings USING fts5(rows)'],
        ['DROP TABLE readings'],
        ['DROP TABLE drive'],
        ['ANALYZE'],
        [f"CREATE TABLE more (t TEXT DEFAULT '{'a' * 900_000}')"],
    ],
)
def test_database_with_other_tables_is_rejected(path: Path, tmp_path: Path, sql: list[str]) -> None:
    forged = database(path, [rows(BLOCK).tobytes()])
    try:
        for statement in sql:
            forged.execute(statement)
    except sqlite3.OperationalError as error:
        pytest.skip(f'this SQLite cannot make it: {error}')
    finally:
        forged.close()
    result = examined(path) if ENDLESS in sql[-1] else quickly(path)
    assert 'has other tables than a journal' in result['error'] or 'too big' in result['error']
    # the node does not change it and continues to map
    before = path.read_bytes()
    warnings: list[str] = []
    journal, found = opened(tmp_path, warnings)
    assert found == []
    written(journal, made(0, 10))
    journal.close()
    assert journal.path.name == 'drive_0002.journal'
    assert path.read_bytes() == before
    assert 'the journal continues in drive_0002.journal' in warnings[0]
    assert numbers(journal.path)[0] == list(range(10))


@pytest.mark.parametrize(
    ('sql', 'message', 'count'),
    [
        ("UPDATE readings SET rows = 'text'", 'contain no readings', 0),
        ('UPDATE readings SET rows = NULL', 'contain no readings', 0),
        ('UPDATE readings SET rows = 1.5', 'contain no readings', 0),
        ("UPDATE readings SET rows = x''", 'contain no readings', 0),
        ('UPDATE readings SET rows = zeroblob(67)', 'contain no readings', 0),
        ('UPDATE readings SET rows = zeroblob(6800)', '100 readings are left out', 0),
        ('UPDATE readings SET rows = zeroblob(68000000)', 'contain no readings', 0),
        ("UPDATE readings SET rows = replace(hex(zeroblob(50000000)), '0', 'a')", 'contain no readings', 0),
        ('UPDATE readings SET number = number - 1 WHERE number = 10', 'are duplicates', 10),
        ('UPDATE readings SET number = -5 WHERE number = 0', 'out of order', 0),
        ('UPDATE readings SET number = 9223372036854775807 WHERE number = 10', 'out of order', 10),
        ('UPDATE readings SET number = 1000 WHERE number = 10', '', 20),
        ('DELETE FROM sensors', 'their sensor has no name', 0),
        ("UPDATE sensors SET name = 'text'", 'name of a sensor is damaged', 0),
        ("UPDATE sensors SET name = x'ff'", 'name of a sensor is damaged', 0),
        ('UPDATE sensors SET name = zeroblob(50000000)', 'name of a sensor is damaged', 0),
        ('UPDATE sensors SET number = -1 WHERE number = 0', 'other than readings cannot be read', 0),
        ('UPDATE sensors SET number = 4294967296 WHERE number = 0', 'name of a sensor is damaged', 10),
        ("UPDATE drive SET parameters = x'5b5d'", 'parameters of the node are damaged', 20),
        ("UPDATE drive SET parameters = x'ff'", 'parameters of the node are damaged', 20),
        ("UPDATE drive SET parameters = CAST(replace(hex(zeroblob(90000)), '0', '[') AS BLOB)", 'parameters', 20),
        ('UPDATE drive SET map_frame = 7', 'frames of the drive are damaged', 20),
        ("INSERT INTO path VALUES (0, x'00')", 'points of the path are damaged', 20),
        ("INSERT INTO path VALUES (0, 'text')", 'points of the path are damaged', 20),
        ("INSERT INTO path VALUES (0, x'000000000000f87f000000000000f87f')", 'points of the path are not finite', 20),
        (f"{ENDLESS} INSERT INTO sensors SELECT i + 2, x'61' FROM n LIMIT 20000", 'more than 10000 sensors', 20),
        ('PRAGMA user_version=2', 'another version', 0),
        ('PRAGMA user_version=0', 'not a journal', 0),
        ('PRAGMA application_id=0', 'not a journal', 0),
    ],
)
def test_forged_values_are_skipped_or_reported(path: Path, sql: str, message: str, count: int) -> None:
    database(path, [rows(made(0, 10)).tobytes(), rows(made(10, 10)).tobytes()]).close()
    # in a separate process: with Python 3.10, a limit on SQLite's memory applies to the whole process
    subprocess.run([sys.executable, '-c', FORGE, str(path), sql], check=True, timeout=60)
    # those with a long value also take little memory
    result = examined(path) if path.stat().st_size > 10_000_000 else quickly(path)
    # newer SQLite does not even load a value that is too long
    assert message in result['error'] + result['harm'] or 'too big' in result['error'] + result['harm']
    assert bool(result['error'] + result['harm']) == bool(message)
    assert result['count'] == count


@pytest.mark.parametrize('value', ['1' + 400 * '0', '-1' + 400 * '0', '1e999', 'NaN', '"0.5"', '[0.5]', 'null'])
def test_invalid_parameter_does_not_hide_the_others(value: str) -> None:
    contents = Contents()
    contents.set_parameters(f'{{"p_hit": {value}, "max_iterations": {value}, "p_rand": 0.25}}'.encode())
    assert contents.parameters == {'p_rand': 0.25}
    assert not contents.harm


PAGE = 4096


def varint(value: int) -> bytes:
    out = [value & 127]
    while value := value >> 7:
        out.append(value & 127 | 128)
    return bytes(reversed(out))


def page(kind: int, cells: list[bytes], right: int = 0, head: bytes = b'') -> bytes:
    """Make a page of the tree of a table: a leaf (13), or a branch (5) whose last child is `right`."""
    at, pointers, content = PAGE, b'', b''
    for cell in cells:
        at -= len(cell)
        pointers += struct.pack('>H', at)
        content = cell + content
    start = head + struct.pack('>BHHHB', kind, 0, len(cells), at, 0) + (struct.pack('>I', right) if kind == 5 else b'')
    return (start + pointers).ljust(at, b'\0') + content


def branch(children: list[int], head: bytes = b'') -> bytes:
    cells = [struct.pack('>I', child) + varint(1000 + key) for key, child in enumerate(children[:-1])]
    return page(5, cells, children[-1], head)


def root(path: Path, table: str) -> int:
    made = sqlite3.connect(path)
    number = made.execute('SELECT rootpage FROM sqlite_master WHERE name = ?', (table,)).fetchone()[0]
    made.close()
    return int(number)


def replaced(path: Path, pages: dict[int, bytes]) -> None:
    """Replace pages of a database, or append pages."""
    content = bytearray(path.read_bytes())
    count = max(len(content) // PAGE, *pages)
    content += bytes(count * PAGE - len(content))
    for number, new in pages.items():
        assert len(new) == PAGE
        content[(number - 1) * PAGE : number * PAGE] = new
    content[28:32] = struct.pack('>I', count)
    path.write_bytes(content)


@pytest.mark.parametrize('leaf', ['rows', 'empty'])
def test_reading_of_an_endless_tree_is_stopped(path: Path, leaf: str) -> None:
    """Fifteen levels of branches, each with the next one as its child 400 times."""
    database(path, [rows(made(0, 10)).tobytes()]).close()
    at = root(path, 'readings')
    content = path.read_bytes()[(at - 1) * PAGE : at * PAGE] if leaf == 'rows' else page(13, [])
    first = len(path.read_bytes()) // PAGE + 1
    storeys = {first + k: branch([first + k + 1] * 400) for k in range(15)}
    replaced(path, {at: branch([first] * 2), **storeys, first + 15: content})
    result = examined(path)
    assert 'it cannot be read to its end' in result['harm']
    assert result['count'] == (10 if leaf == 'rows' else 0)


def test_reading_of_an_endless_schema_is_stopped(path: Path) -> None:
    """SQLite reads the schema before any check of ours."""
    forged = database(path)
    forged.execute('CREATE TABLE more (t TEXT UNIQUE)')
    forged.close()
    content = path.read_bytes()
    first = len(content) // PAGE + 1
    begins = struct.unpack_from(f'>{struct.unpack_from(">H", content, 103)[0]}H', content, 108)
    kept, repeated = [], []
    for begin in begins:
        end = min((other for other in begins if other > begin), default=PAGE)
        (repeated if b'sqlite_autoindex' in content[begin:end] else kept).append(content[begin:end])
    assert len(repeated) == 1
    storeys = {first + k: branch([first + k + 1] * 400) for k in range(15)}
    replaced(
        path,
        {
            1: branch([first + 16, first], content[:100]),
            **storeys,
            first + 15: page(13, repeated),
            first + 16: page(13, kept),
        },
    )
    result = examined(path)
    assert 'reading it takes more steps than it has bytes' in result['error']
    assert result['count'] == 0


def test_rows_that_share_their_bytes_are_bounded(path: Path) -> None:
    """Small cells that all continue in the same 680 kB: 50 000 of them would be 34 GB."""
    block = rows(made(0, 10_000)).tobytes()
    database(path, [block]).close()
    at = root(path, 'readings')
    content = path.read_bytes()[(at - 1) * PAGE : at * PAGE]
    cell = content[struct.unpack_from('>H', content, 8)[0] :]
    key = len(varint(len(block) + 10))
    assert cell[key] == 0
    each = (PAGE - 8) // (len(cell) + 4)
    first = len(path.read_bytes()) // PAGE + 1
    leaves = {}
    for k in range(400):
        numbers = [(each * k + n) * 10_000 for n in range(each)]
        leaves[first + k] = page(13, [cell[:key] + varint(number) + cell[key + 1 :] for number in numbers])
    cells = [struct.pack('>I', number) + varint((each * (k + 1) - 1) * 10_000) for k, number in enumerate(leaves)]
    replaced(path, {at: page(5, cells[:-1], first + 399), **leaves})
    result = examined(path)
    assert 'contain more than the file' in result['harm']
    assert 10_000 <= result['count'] < 2 * path.stat().st_size // ROW.itemsize


def test_truncated_journal_gives_the_remaining_readings(path: Path, tmp_path: Path) -> None:
    database(path, [rows(made(10 * k, 10)).tobytes() for k in range(60)]).close()
    whole = path.read_bytes()
    lengths = {*range(0, len(whole), 1013), *range(len(whole) - 3, len(whole)), PAGE, 3 * PAGE}
    for length in sorted(lengths):
        path.write_bytes(whole[:length])
        try:
            found, contents = numbers(path)
        except BagError as error:
            assert str(path) in str(error)
            assert length < 8 * PAGE
            continue
        # missing parts of a page count as zeros, which are no readings
        assert found == sorted(set(found) & set(range(600)))
        assert len(found) > 600 * length / len(whole) - 200
        # the end of the last page may be empty
        assert contents.harm or len(found) == 600


def test_changed_bytes_give_valid_readings_or_a_message(path: Path) -> None:
    """Any result is allowed, but all readings must be valid, and lost ones must be reported."""
    database(path, [rows(made(10 * k, 10)).tobytes() for k in range(30)]).close()
    whole = path.read_bytes()
    rng = random.Random(1)
    for _ in range(400):
        damaged = bytearray(whole)
        for _ in range(rng.choice((1, 1, 30))):
            damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            found, contents = numbers(path)
        except BagError:
            continue
        assert len(found) <= 300
        assert all(abs(x) < 2e7 for x in found)
        assert len(found) == 300 or contents.harm


def test_random_bytes_are_rejected(path: Path) -> None:
    database(path, [rows(made(0, 10)).tobytes()]).close()
    head = path.read_bytes()[:100]
    rng = random.Random(2)
    for k in range(300):
        path.write_bytes((head if k % 2 else b'') + rng.randbytes(rng.randrange(10_000)))
        with pytest.raises(BagError, match=r'drive_0001\.journal'):
            numbers(path)


def test_pipes_folders_and_other_databases_are_no_journals(path: Path, tmp_path: Path) -> None:
    os.mkfifo(path)
    with pytest.raises(BagError, match='not a regular file'):
        numbers(path)
    assert drive_file(path) is None
    path.unlink()
    path.mkdir()
    with pytest.raises(BagError):
        numbers(path)
    path.rmdir()
    database(path, [rows(made(0, 10)).tobytes()]).close()
    os.mkfifo(log_of(path))
    with pytest.raises(BagError, match='not a regular file'):
        numbers(path)
    warnings: list[str] = []
    journal, found = opened(tmp_path, warnings)
    assert found == []
    assert journal.path.name == 'drive_0002.journal'
    journal.close()
    for name in ('lock', 'nothing', 'bag.db3'):
        other = sqlite3.connect(tmp_path / 'bag.db3')
        other.execute('CREATE TABLE IF NOT EXISTS topics (id)')
        other.close()
        assert drive_file(tmp_path / name) is None


def test_journal_with_a_hole_of_a_terabyte_is_read(path: Path) -> None:
    database(path, [rows(made(0, 10)).tobytes()]).close()
    with path.open('r+b') as file:
        file.truncate(1 << 40)
    assert examined(path)['count'] == 10
    # with a log it is copied, without the hole
    with log_of(path).open('wb') as log:
        log.truncate(1 << 40)
    assert examined(path)['count'] in (0, 10)


def killed(tmp_path: Path, blocks: int) -> Path:
    """Return a file whose log was not yet moved into it, as after a kill."""
    journal, _ = opened(tmp_path / 'alive')
    for k in range(blocks):
        written(journal, made(10 * k, 10))
    folder = tmp_path / 'killed'
    folder.mkdir()
    for path in (journal.path, log_of(journal.path)):
        shutil.copy(path, folder)
    journal.close()
    return folder / 'drive_0001.journal'


def test_truncated_log_gives_complete_blocks(tmp_path: Path) -> None:
    path = killed(tmp_path, 12)
    whole = log_of(path).read_bytes()
    rng = random.Random(3)
    last = 0
    for length in (*range(0, len(whole), 2500), len(whole)):
        log_of(path).write_bytes(whole[:length])
        found, contents = numbers(path)
        assert found == list(range(len(found)))
        assert len(found) % 10 == 0
        assert len(found) >= last
        assert not contents.harm
        last = len(found)
    assert last == 120
    assert sorted(p.name for p in path.parent.iterdir()) == ['drive_0001.journal', 'drive_0001.journal-wal']
    for _ in range(100):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        log_of(path).write_bytes(damaged)
        found, _ = numbers(path)
        assert found == list(range(len(found)))


def test_journal_is_read_while_it_is_written(tmp_path: Path) -> None:
    """The log is moved into the file at times, and a new one begins."""
    journal, _ = opened(tmp_path)
    stop = threading.Event()
    count = [0]

    def write() -> None:
        while not stop.is_set():
            journal.put(made(count[0], 2000), FRAMES)
            count[0] += 2000
            until(lambda: not journal.unwritten)

    thread = threading.Thread(target=write)
    thread.start()
    begun, last = set(), 0
    try:
        while len(begun) < 3:
            before = count[0] - 2000
            found, contents = numbers(journal.path)
            assert found == list(range(len(found)))
            assert len(found) >= max(before, last)
            assert not contents.harm
            last = len(found)
            begun.add(log_of(journal.path).read_bytes()[:32])
    finally:
        stop.set()
        thread.join(PATIENCE)
        journal.close()
    assert len(numbers(journal.path)[0]) == count[0]


@pytest.mark.parametrize('format', ['present', 'with a log', 'previous'])
def test_journal_truncated_while_it_is_read_is_reported(tmp_path: Path, format: str) -> None:
    """If the file was mapped into memory, the reader would be killed by a signal."""
    path = tmp_path / 'drive_0001.journal'
    if format == 'previous':
        path.write_bytes(Previous.file(200_000, 1000))
    else:
        database(path, [rows(made(1000 * k, 1000)).tobytes() for k in range(200)]).close()
    if format == 'with a log':
        made_log = sqlite3.connect(path, isolation_level=None)
        made_log.execute('PRAGMA journal_mode=WAL')
        made_log.execute('UPDATE readings SET number = number')
        content = log_of(path).read_bytes()
        made_log.close()
        log_of(path).write_bytes(content)
    reader = subprocess.Popen([*PROGRAM, str(path), 'pause'], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert line_of(reader) == 'some\n'
    for file in path.parent.iterdir():
        os.truncate(file, 5000)
    answer, _ = reader.communicate('\n', timeout=60)
    assert reader.returncode == 0
    result = json.loads(answer)
    if format == 'with a log':
        assert result['count'] == 200_000
    else:
        assert 0 < result['count'] < 200_000
        assert result['error'] or result['harm']


def test_journal_changed_while_it_is_read_is_reported(path: Path) -> None:
    """Also if its size stays the same, as when another program writes into it."""
    database(path, [rows(made(1000 * k, 1000)).tobytes() for k in range(100)]).close()
    found = read(path, Contents())
    next(found)
    os.utime(path, ns=(0, 0))
    with pytest.raises(BagError, match='was written while it was read; read it again'):
        list(found)
