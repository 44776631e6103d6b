"""Bags made to use unlimited time or memory: each is read or rejected, within 20 s of processor time and 1.5 GB.

Each attempt runs in a separate process with limits of address space and processor time, and a time-out. It is a child
of a process that has already imported the package, which takes longer than most attempts.
"""

from __future__ import annotations

import bz2
import os
import signal
import socket
import sqlite3
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import lz4.frame
import pytest
from backports import zstd
from bag_samples import COUNT, START, range_of, sample_messages, storage_file, write_many_chunks, write_sample
from rosbags import rosbag2
from rosbags.typesys import Stores, get_typestore

import forward_grid_mapper
from forward_grid_mapper.bags import bounds
from forward_grid_mapper.bags.choice import Topics
from forward_grid_mapper.bags.decoder import MOST_FIELDS, Decoder
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.core.common.errors import BagError
from forward_grid_mapper.core.messages.message_types import RangeMessage

SECONDS = 20
"""Processor time; a busy machine may take longer."""

PATIENCE = 300
MEMORY = 3 << 29
READER = f"""
import os, resource, sys
from forward_grid_mapper.bags.choice import Topics
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.core.common.errors import BagError

def read(path):
    resource.setrlimit(resource.RLIMIT_AS, ({MEMORY}, {MEMORY}))
    resource.setrlimit(resource.RLIMIT_CPU, ({SECONDS}, {SECONDS}))
    try:
        with Bag(path) as bag:
            bag.topics()
            bag.static_transforms()
            messages = list(bag.messages(Topics(('/sonar',), '/odom')))
            print(len(messages), bag.truncated or '', sum(bag.undecodable.values()), sep='\\n', flush=True)
    except BagError as error:
        print(-1, error, 0, sep='\\n', flush=True)

for line in sys.stdin:
    child = os.fork()
    if not child:
        code = 1
        try:
            read(line.rstrip('\\n'))
            code = 0
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            os._exit(code)
    print('ended with', os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Reads the bag of each input line in a child with the limits, which has nothing to import."""

BOMB = 1 << 30
"""Bytes that a bomb claims to have, or unpacks to."""


class Reader:
    """The process whose children read bags. It is started on demand, and again after a time-out."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def read(self, path: Path) -> list[str]:
        """Return the lines printed by a child, which must end without error and in time."""
        if self._process is None or self._process.poll() is not None:
            self._process = self._start()
        assert self._process.stdin is not None and self._process.stdout is not None
        late = threading.Timer(PATIENCE, os.killpg, (self._process.pid, signal.SIGKILL))
        late.start()
        try:
            self._process.stdin.write(f'{path}\n')
            self._process.stdin.flush()
            lines: list[str] = []
            while not lines or not lines[-1].startswith('ended with '):
                line = self._process.stdout.readline()
                assert line, f'no end within {PATIENCE} s: {path}'
                lines.append(line.rstrip('\n'))
        finally:
            late.cancel()
        assert lines.pop() == 'ended with 0', lines
        return lines

    def close(self) -> None:
        if self._process is not None:
            self._process.communicate(timeout=PATIENCE)

    @staticmethod
    def _start() -> subprocess.Popen[str]:
        root = str(Path(forward_grid_mapper.__file__).parents[1])
        search = os.pathsep.join(filter(None, (root, os.environ.get('PYTHONPATH'))))
        return subprocess.Popen(
            [sys.executable, '-c', READER],
            # threads of the linear algebra, which is not used, reserve memory
            env={**os.environ, 'PYTHONPATH': search, 'OPENBLAS_NUM_THREADS': '1'},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )


@pytest.fixture(scope='module', autouse=True)
def reader() -> Iterator[None]:
    yield
    READ.close()


READ = Reader()


def attempt(path: Path) -> tuple[int, str, int]:
    """Read a bag; return the number of messages or -1, the message to the user, and the number of unfit messages."""
    count, message, unfit = READ.read(path)
    return int(count), message, int(unfit)


def changed(bag: Path, *statements: str) -> Path:
    """Run SQL on a bag's file; return the file."""
    file = storage_file(bag)
    database = sqlite3.connect(file)
    for statement in statements:
        database.execute(statement)
    database.commit()
    database.close()
    return file


def test_intact_bag_is_read_within_the_limits(tmp_path: Path) -> None:
    assert attempt(write_sample(tmp_path, 'mcap')) == (2 * COUNT, '', 0)


# ---- sqlite3


ENDLESS = 'WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM r)'


def test_view_named_messages_is_rejected(tmp_path: Path) -> None:
    file = changed(
        write_sample(tmp_path, 'sqlite3'),
        'DROP TABLE messages',
        f"CREATE VIEW messages AS {ENDLESS} SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM r",
    )
    count, message, _ = attempt(file)
    assert count == -1 and str(file) in message and "'messages' is a view" in message


def test_view_named_topics_is_rejected(tmp_path: Path) -> None:
    file = changed(
        write_sample(tmp_path, 'sqlite3'),
        'DROP TABLE topics',
        f"CREATE VIEW topics AS {ENDLESS} SELECT i AS id, '/t' AS name, 'a/msg/B' AS type, "
        f"'cdr' AS serialization_format, '' AS offered_qos_profiles, '' AS type_description_hash FROM r",
    )
    count, message, _ = attempt(file)
    assert count == -1 and "'topics' is a view" in message


def test_computed_column_is_rejected(tmp_path: Path) -> None:
    file = changed(
        write_sample(tmp_path, 'sqlite3'),
        'DROP TABLE messages',
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, '
        'data BLOB AS (zeroblob(900000000)))',
        'INSERT INTO messages(topic_id, timestamp) VALUES (1, 1), (1, 2)',
    )
    count, message, _ = attempt(file)
    assert count == -1 and "column 'data'" in message and 'computed' in message


def test_endless_rows_are_rejected(tmp_path: Path) -> None:
    """A page in the tree of a table refers to the page above it, so the rows never end."""
    file = storage_file(write_sample(tmp_path, 'sqlite3', count=600))
    database = sqlite3.connect(file)
    (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    (size,) = database.execute('PRAGMA page_size').fetchone()
    database.close()
    content = bytearray(file.read_bytes())
    at = (root - 1) * size
    assert content[at] == 5, 'the root is an inner page of a table'
    cells = struct.unpack_from('>H', content, at + 3)[0]
    pointers = struct.unpack_from(f'>{cells}H', content, at + 12)
    leaf = struct.unpack_from('>I', content, at + pointers[0])[0]
    # an inner page in place of a leaf; all its cells lead to the second leaf, and so on down four levels
    second = struct.unpack_from('>I', content, at + pointers[1])[0]
    fourth = [struct.unpack_from('>I', content, at + p)[0] for p in pointers[2:6]]
    below = second
    for page in (*fourth, leaf):
        number = (size - 12) // 8
        begin = (page - 1) * size
        content[begin : begin + size] = bytes(size)
        struct.pack_into('>BHHHBI', content, begin, 5, 0, number, size - 5 * number & 0xFFFF, 0, below)
        for n in range(number):
            place = size - 5 * (n + 1)
            struct.pack_into('>H', content, begin + 12 + 2 * n, place)
            struct.pack_into('>IB', content, begin + place, below, n % 128)
        below = page
    file.write_bytes(content)
    _, message, _ = attempt(file)
    assert message


def test_extra_tables_and_views_do_not_mislead_the_check(tmp_path: Path) -> None:
    file = changed(
        write_sample(tmp_path, 'sqlite3'),
        'CREATE TABLE pragma_table_xinfo(name, hidden)',
        'CREATE TABLE extra(x)',
        f'CREATE VIEW others AS {ENDLESS} SELECT i FROM r',
    )
    assert attempt(file) == (2 * COUNT, '', 0)


# ---- definitions


def with_definition(folder: Path, text: str, data: bytes) -> Path:
    """An MCAP bag of one Range whose definition is `text`."""
    writer = rosbag2.Writer(folder / 'bag', version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection('/sonar', 'sensor_msgs/msg/Range', msgdef=text, rihs01='x')
        for i in range(3):
            writer.write(connection, START + i, data)
    return folder / 'bag'


SOUND = 'float32 x\n'


@pytest.mark.parametrize(
    'definition',
    [
        'string[300000000] names\n',
        f'string[{MOST_FIELDS + 1}] names\n',
        f'Empty[300000000] x\n{"=" * 80}\nMSG: sensor_msgs/Empty\n',
        f'Empty[] x\n{"=" * 80}\nMSG: sensor_msgs/Empty\n',
        ''.join(
            f'{"" if n == 0 else "=" * 80 + chr(10) + f"MSG: sensor_msgs/A{n}" + chr(10)}'
            + (f'A{n + 1}[100] x\n' if n < 6 else 'float32 x\n')
            for n in range(7)
        ),
        f'A x\n{"=" * 80}\nMSG: sensor_msgs/A\nA x\n',
        '\n' * 400_000 + 'float32 x\n',
        '# ' + 'x' * 400_000 + '\nfloat32 x\n',
    ],
    ids=['strings', 'just too many', 'nothing', 'no end', 'nested', 'itself', 'blank lines', 'long'],
)
def test_exploding_message_definition_is_rejected_or_unfit(tmp_path: Path, definition: str) -> None:
    assert Decoder('sensor_msgs/msg/Range', 'cdr', 'msg', definition)
    data = b'\0\1\0\0' + b'\xff' * 400
    count, message, unfit = attempt(with_definition(tmp_path, definition, data))
    assert unfit == 3 or (count == -1 and message), (count, message, unfit)


def test_definition_with_40_kb_of_blank_lines_is_read(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    message = next(m for m in sample_messages() if isinstance(m, RangeMessage))
    data = bytes(store.serialize_cdr(range_of(store, message), 'sensor_msgs/msg/Range'))
    text, _ = store.generate_msgdef('sensor_msgs/msg/Range')
    assert attempt(with_definition(tmp_path, '\n' * 40_000 + text, data)) == (3, '', 0)


# ---- metadata


@pytest.mark.slow
@pytest.mark.parametrize('filling', ['\n', ' \n', 'relative_file_paths:\n', '  - x\n', '-\n'])
def test_metadata_with_40_kb_of_filling_is_read_or_rejected(tmp_path: Path, filling: str) -> None:
    bag = write_sample(tmp_path, 'mcap')
    metadata = bag / 'metadata.yaml'
    text = metadata.read_text()
    for content in (
        filling * 40_000 + text,
        text + filling * 40_000,
        text.replace('_paths:\n', '_paths:\n' + filling * 40_000),
    ):
        metadata.write_text(content)
        count, message, _ = attempt(bag)
        assert count == 2 * COUNT or message, content[:40]


def test_huge_metadata_is_rejected(tmp_path: Path) -> None:
    bag = write_sample(tmp_path, 'mcap')
    with (bag / 'metadata.yaml').open('r+b') as file:
        file.truncate(1 << 40)
    count, message, _ = attempt(bag)
    assert count == -1 and 'metadata.yaml has more than' in message


# ---- small files that unpack to very much


def mcap_with(folder: Path, compression: str, packed: bytes, size: int, times: int = 1, *, index: bool = False) -> Path:
    """A file of `times` equal chunks, which are zeros or `packed`, and which claim to have `size` bytes."""

    def text(value: str) -> bytes:
        return struct.pack('<I', len(value)) + value.encode()

    def record(opcode: int, content: bytes) -> bytes:
        return struct.pack('<BQ', opcode, len(content)) + content

    path = folder / 'bomb.mcap'
    with path.open('wb') as file:
        file.write(b'\x89MCAP0\r\n' + record(1, text('ros2') + text('')))
        file.write(record(3, struct.pack('<H', 1) + text('sensor_msgs/msg/Range') + text('ros2msg') + text('')))
        file.write(record(4, struct.pack('<HH', 1, 1) + text('/sonar') + text('cdr') + struct.pack('<I', 0)))
        chunk = struct.pack('<QQQI', 0, 1, size, 0) + text(compression) + struct.pack('<Q', len(packed)) + packed
        for _ in range(times):
            file.write(record(6, chunk))
        if index:
            summary = file.tell()
            begin = summary - times * (9 + len(chunk))
            file.write(record(3, struct.pack('<H', 1) + text('sensor_msgs/msg/Range') + text('ros2msg') + text('')))
            file.write(record(4, struct.pack('<HH', 1, 1) + text('/sonar') + text('cdr') + struct.pack('<I', 0)))
            for n in range(times):
                at = begin + n * (9 + len(chunk))
                entry = struct.pack('<QQQQ', 0, 1, at, 9 + len(chunk)) + struct.pack('<IHQ', 10, 1, at + 9 + len(chunk))
                entry += struct.pack('<Q', 31) + text(compression) + struct.pack('<QQ', len(packed), size)
                file.write(record(8, entry))
            file.write(
                record(
                    0x0B, struct.pack('<QHIIIIQQI', times, 1, 1, 0, 0, times, 0, 1, 10) + struct.pack('<HQ', 1, times)
                )
            )
            file.write(record(2, struct.pack('<QQI', summary, 0, 0)))
        else:
            file.write(record(2, struct.pack('<QQI', 0, 0, 0)))
        file.write(b'\x89MCAP0\r\n')
    return path


PACKERS: dict[str, Callable[[bytes], bytes]] = {'zstd': zstd.compress, 'lz4': lz4.frame.compress, 'bz2': bz2.compress}


@pytest.mark.parametrize('index', [False, True])
@pytest.mark.parametrize('stated', [100, 1 << 20, BOMB, 1 << 62])
@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_chunk_of_a_gigabyte_is_rejected(tmp_path: Path, compression: str, stated: int, index: bool) -> None:
    packed = 8 * PACKERS[compression](bytes(BOMB // 8))
    count, message, _ = attempt(mcap_with(tmp_path, compression, packed, stated, index=index))
    assert count in (-1, 0) and message
    assert 'bomb.mcap' in message


@pytest.mark.parametrize('index', [False, True])
def test_many_chunks_that_are_too_large_together_are_rejected(tmp_path: Path, index: bool) -> None:
    size = 1 << 26
    # one attachment, which is skipped
    packed = zstd.compress(struct.pack('<BQ', 9, size - 9) + bytes(size - 9))
    count, message, _ = attempt(mcap_with(tmp_path, 'zstd', packed, size, 300, index=index))
    assert count in (-1, 0) and 'unpack to more than' in message


@pytest.mark.parametrize('compression', ['bz2', 'lz4'])
def test_ros1_chunk_of_a_gigabyte_is_reported_and_others_read(tmp_path: Path, compression: str) -> None:
    bag = write_many_chunks(tmp_path, 'ros1', compression)
    content = bag.read_bytes()
    packed = 32 * PACKERS[compression](bytes(BOMB // 32))
    mark = {'bz2': b'BZh', 'lz4': b'\x04\x22\x4d\x18'}[compression]
    at = content.index(mark)
    (size,) = struct.unpack_from('<I', content, at - 4)
    bag.write_bytes(content[: at - 4] + struct.pack('<I', len(packed)) + packed + content[at + size :])
    count, message, _ = attempt(bag)
    assert bag.name in message and 'damaged' in message
    assert count > COUNT // 2, 'the other chunks are still worth having'


@pytest.mark.parametrize('kind', ['sqlite3', 'mcap'])
def test_compressed_file_of_a_gigabyte_is_rejected(tmp_path: Path, kind: str) -> None:
    bag = write_sample(tmp_path, kind)
    file = storage_file(bag)
    metadata = bag / 'metadata.yaml'
    packed = bag / f'{file.name}.zstd'
    packed.write_bytes(zstd.compress(file.read_bytes()))
    metadata.write_text(
        metadata.read_text()
        .replace(file.name, packed.name)
        .replace("compression_mode: ''", 'compression_mode: FILE')
        .replace("compression_format: ''", 'compression_format: zstd')
    )
    file.unlink()
    assert 'FILE' in metadata.read_text()
    assert attempt(bag) == (2 * COUNT, '', 0)
    packed.write_bytes(4 * zstd.compress(bytes(BOMB // 4)))
    count, message, _ = attempt(bag)
    assert count == -1 and str(packed) in message and 'unpacks to more than' in message


def test_compressed_message_of_a_gigabyte_is_counted_as_unfit(tmp_path: Path) -> None:
    bag = write_many_chunks(tmp_path, 'mcap', 'message')
    file = storage_file(bag)
    assert attempt(bag)[0] == COUNT
    file.unlink()
    store, packed = get_typestore(Stores.ROS2_JAZZY), zstd.compress(bytes(BOMB))
    with rosbag2.Writer(tmp_path / 'other', version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/sonar', 'sensor_msgs/msg/Range', typestore=store)
        for i in range(3):
            writer.write(connection, START + i, packed)
    storage_file(tmp_path / 'other').rename(file)
    _, _, unfit = attempt(bag)
    assert unfit == 3


def test_unpack_is_bounded_and_rejects_unknown_formats() -> None:
    data = bytes(range(256)) * 40
    for name, pack in PACKERS.items():
        assert bounds.unpack(name, pack(data) + pack(data), 2 * len(data)) == data * 2
        with pytest.raises(bounds.Damage, match='more than'):
            bounds.unpack(name, pack(data), len(data) - 1)
    assert bounds.unpack('', data, 0) == data
    with pytest.raises(bounds.Damage, match="'zip'"):
        bounds.unpack('zip', data, 1000)


# ---- paths that are no regular files


def test_pipes_sockets_and_devices_are_rejected(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'pipe')
    with socket.socket(socket.AF_UNIX) as server:
        here = Path.cwd()
        try:
            # the path of a socket must be short
            os.chdir(tmp_path)
            server.bind('socket')
        finally:
            os.chdir(here)
        (tmp_path / 'device').symlink_to('/dev/zero')
        for name in ('pipe', 'socket', 'device'):
            count, message, _ = attempt(tmp_path / name)
            assert count == -1 and name in message and 'Give a bag folder' in message
    for name in ('bag.mcap', 'metadata.yaml'):
        bag = write_sample(tmp_path, 'mcap', name=f'with a pipe for {name}')
        file = storage_file(bag) if name != 'metadata.yaml' else bag / name
        file.unlink()
        os.mkfifo(file)
        count, message, _ = attempt(bag)
        if name == 'metadata.yaml':
            assert count == 2 * COUNT, 'the only file will do'
        else:
            assert count == -1 and str(file) in message and 'not a regular file' in message


# ---- unusual but valid metadata


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3'])
@pytest.mark.parametrize(
    'name', ['a, b', "it's", 'say "so"', ' - x', '[one]', 'a: b', '#1', 'with spaces ' * 10, 'ä, ö']
)
def test_bag_in_a_folder_of_any_name_is_read(tmp_path: Path, kind: str, name: str) -> None:
    if kind == 'sqlite3' and '#' in name:
        pytest.skip('rosbags cannot write it')
    bag = write_sample(tmp_path, kind, name=name)
    with Bag(bag) as opened:
        assert list(opened.messages(opened.choose_topics())) == sample_messages()
        assert opened.truncated is None


@pytest.mark.parametrize(
    'style', ['[{0}]', "['{0}']", '["{0}", ]', '\n    - {0}', '\n  - \'{0}\'\n  - "{0}"', '[{0}, {0}]']
)
def test_file_listed_twice_is_read_once(tmp_path: Path, style: str) -> None:
    bag = write_sample(tmp_path, 'mcap')
    (bag / 'link.mcap').symlink_to('bag.mcap')
    metadata = bag / 'metadata.yaml'
    before, _, after = metadata.read_text().partition('relative_file_paths:')
    after = after[after.index('duration:') - 2 :]
    listed = style.format('bag.mcap')
    for text in (listed, style.format('./bag.mcap'), '[bag.mcap, link.mcap]'):
        metadata.write_text(f'{before}relative_file_paths: {text}\n{after}')
        with Bag(bag) as opened:
            assert list(opened.messages(opened.choose_topics())) == sample_messages()
            assert opened.truncated is None
    metadata.write_text(f'{before}relative_file_paths: [gone.mcap, bag.mcap]\n{after}')
    with Bag(bag) as opened:
        assert opened.truncated is not None and 'gone.mcap is missing' in opened.truncated


def test_single_file_of_a_compressed_bag_is_rejected_with_a_remedy(tmp_path: Path) -> None:
    bag = write_many_chunks(tmp_path, 'mcap', 'file')
    with pytest.raises(BagError, match='zstd -d'), Bag(storage_file(bag).rename(tmp_path / 'alone.mcap.zstd')):
        pass
    with Bag(write_many_chunks(tmp_path, 'mcap', 'message')) as opened:
        assert len(list(opened.messages(Topics(('/sonar',), '')))) == COUNT
