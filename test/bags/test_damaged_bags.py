"""Truncated bags and bags with flipped bits give the intact messages or a BagError."""

from __future__ import annotations

import errno
import random
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from backports import zstd
from bag_samples import COUNT, SUFFIXES, sample_messages, storage_file, write_many_chunks, write_sample

from forward_grid_mapper.bags.choice import Topics
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.writer import BagWriter
from forward_grid_mapper.core.common.errors import BagError, MapperError
from forward_grid_mapper.core.messages.message_types import RangeMessage

KINDS = sorted(SUFFIXES)
TOPICS = Topics(('/sonar',), '/odom')


def read(path: Path) -> tuple[list[object], str | None]:
    with Bag(path) as bag:
        bag.topics()
        bag.static_transforms()
        return list(bag.messages(TOPICS)), bag.truncated


@pytest.mark.parametrize('kind', KINDS)
def test_truncated_bag_gives_the_intact_messages(tmp_path: Path, kind: str) -> None:
    bag = write_sample(tmp_path, kind)
    file = storage_file(bag)
    content, whole = file.read_bytes(), sample_messages()
    most = 0
    for percent in (0, 1, 5, 10, 25, 50, 75, 90, 95, 99, 99.9):
        file.write_bytes(content[: int(len(content) * percent / 100)])
        for path in {bag, file}:
            try:
                messages, truncated = read(path)
            except BagError as error:
                assert '\n' not in str(error)
                assert percent < 30, f'nothing was read of {percent} %'
                continue
            assert truncated is not None and '\n' not in truncated and 'repair it with' in truncated
            if kind == 'sqlite3':  # a page that was cut in two keeps its later rows
                assert messages == [m for m in whole if m in set(messages)]
            else:
                assert messages == whole[: len(messages)]
            most = max(most, len(messages))
    assert most > COUNT


@pytest.mark.parametrize('kind', KINDS)
def test_bag_truncated_near_its_ends_is_reported(tmp_path: Path, kind: str) -> None:
    file = storage_file(write_sample(tmp_path, kind, count=3))
    content = file.read_bytes()
    for size in (*range(1, 200), *range(len(content) - 200, len(content))):
        file.write_bytes(content[:size])
        try:
            _, truncated = read(file)
        except BagError:
            continue
        assert truncated is not None


@pytest.mark.parametrize('kind', KINDS)
def test_bag_with_flipped_bits_is_read_or_rejected_in_time(tmp_path: Path, kind: str) -> None:
    bag = write_sample(tmp_path, kind, count=20)
    file = storage_file(bag)
    content = file.read_bytes()
    for seed in range(60):
        rng = random.Random(seed)
        damaged = bytearray(content)
        for _ in range(rng.choice((1, 1, 20))):
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        file.write_bytes(damaged)
        begin = time.process_time()
        try:
            read(rng.choice((bag, file)))
        except MapperError as error:
            assert str(error)
        assert time.process_time() - begin < 5.0


def test_metadata_with_flipped_bits_is_read_or_rejected(tmp_path: Path) -> None:
    bag = write_sample(tmp_path, 'mcap', count=20)
    metadata = bag / 'metadata.yaml'
    content = metadata.read_bytes()
    for seed in range(60):
        rng = random.Random(seed)
        damaged = bytearray(content)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        metadata.write_bytes(damaged)
        assert read(bag)[0] == sample_messages(20)


@pytest.mark.parametrize(
    ('kind', 'compression'), [('mcap', None), ('mcap', 'storage'), ('ros1', None), ('ros1', 'bz2'), ('ros1', 'lz4')]
)
def test_damaged_chunk_loses_only_its_own_messages(tmp_path: Path, kind: str, compression: str | None) -> None:
    bag = write_many_chunks(tmp_path, kind, compression)
    file = storage_file(bag)
    content = bytearray(file.read_bytes())
    mark = {'storage': b'\x28\xb5\x2f\xfd', 'bz2': b'BZh', 'lz4': b'\x04\x22\x4d\x18', None: b'sonar_1'}[compression]
    at = -1
    for _ in range(6):
        at = content.index(mark, at + 1)
    content[at : at + 60] = bytes(60)  # more than a message: the next message must be found again
    file.write_bytes(content)
    expected = [m for m in sample_messages() if isinstance(m, RangeMessage)]
    with Bag(file) as opened:
        messages = list(opened.messages(TOPICS))
        damaged = opened.truncated is not None or sum(opened.undecodable.values()) > 0
    intact = set(messages) & set(expected)
    assert len(intact) < COUNT
    assert damaged
    assert len(intact) > COUNT * 0.8


def test_damaged_page_loses_only_its_own_messages(tmp_path: Path) -> None:
    file = storage_file(write_sample(tmp_path, 'sqlite3'))
    content = bytearray(file.read_bytes())
    at = len(content) // 2 // 4096 * 4096
    content[at : at + 4096] = b'\xff' * 4096
    file.write_bytes(content)
    messages, truncated = read(file)
    whole = sample_messages()
    assert truncated is not None and 'malformed' in truncated
    assert 0.8 * len(whole) < len(messages) < len(whole)
    assert messages == [m for m in whole if m in set(messages)] and messages[-1] == whole[-1]


@pytest.mark.parametrize(('kind', 'compression'), [('mcap', None), ('mcap', 'storage'), ('ros1', 'bz2')])
def test_bag_without_index_after_a_kill_is_read(tmp_path: Path, kind: str, compression: str | None) -> None:
    file = storage_file(write_many_chunks(tmp_path, kind, compression))
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 7 // 10])
    with Bag(file) as bag:
        messages = list(bag.messages(TOPICS))
        assert bag.topics()['/sonar'][1] == len(messages)
        assert bag.truncated is not None
    assert bag.truncated is not None, 'it must outlive the with block, for a report'
    expected = [m for m in sample_messages() if isinstance(m, RangeMessage)]
    assert len(messages) > COUNT // 3
    assert messages == expected[: len(messages)]


def test_damaged_file_of_a_split_bag_loses_only_its_messages(tmp_path: Path) -> None:
    bag = write_sample(tmp_path, 'mcap')
    (bag / 'second.mcap').write_bytes(b'\x89MCAP0\r\n')
    metadata = bag / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('- bag.mcap', '- bag.mcap\n  - second.mcap', 1))
    messages, truncated = read(bag)
    assert messages == sample_messages()
    assert truncated is not None and 'second.mcap' in truncated


def test_file_missing_in_the_metadata_is_reported(tmp_path: Path) -> None:
    bag = write_sample(tmp_path, 'mcap')
    shutil.copy(bag / 'bag.mcap', bag / 'bag_1.mcap')
    messages, truncated = read(bag)
    assert messages == sample_messages()
    assert truncated is not None and 'bag_1.mcap is not listed in metadata.yaml and was left out' in truncated
    assert 'ros2 bag reindex' in truncated


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3'])
def test_unpacked_file_with_metadata_of_a_compressed_one_is_read(tmp_path: Path, kind: str) -> None:
    bag = write_sample(tmp_path, kind)
    metadata = bag / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace("compression_mode: ''", 'compression_mode: FILE'))
    assert 'FILE' in metadata.read_text()
    assert read(bag) == (sample_messages(), None)
    # unpacked next to the packed file, which stays listed or not
    file = storage_file(bag)
    (bag / f'{file.name}.zstd').write_bytes(zstd.compress(file.read_bytes()))
    assert read(bag) == (sample_messages(), None)
    metadata.unlink()
    assert read(bag) == (sample_messages(), None)


def split_in_two(folder: Path) -> tuple[Path, Path, Path]:
    """Write a bag with the same messages in two files; return the folder and its files."""
    bag = write_sample(folder, 'mcap')
    file = storage_file(bag)
    second = shutil.copy(file, bag / 'bag_1.mcap')
    metadata = bag / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('- bag.mcap', '- bag.mcap\n  - bag_1.mcap', 1))
    return bag, file, second


def test_remedy_fits_the_damage(tmp_path: Path) -> None:
    bag, _, second = split_in_two(tmp_path)
    content = second.read_bytes()
    second.write_bytes(content[: len(content) // 2])
    _, truncated = read(bag)
    # an index made again would not change the file
    assert truncated is not None and f'mcap recover {second} -o' in truncated and 'reindex' not in truncated
    assert 'bag_1.mcap: the file is cut off' in truncated
    second.write_bytes(b'')
    _, truncated = read(bag)
    assert truncated is not None and 'bag_1.mcap is empty' in truncated
    assert 'reindex' not in truncated and 'recover' not in truncated
    second.unlink()
    _, truncated = read(bag)
    assert (
        truncated is not None
        and 'bag_1.mcap is missing' in truncated
        and f'copy what is missing into {bag}' in truncated
    )
    assert 'reindex' not in truncated and 'recover' not in truncated


@pytest.mark.skipif(not shutil.which('sqlite3'), reason='needs sqlite3')
def test_remedy_for_a_sqlite3_file_repairs_it(tmp_path: Path) -> None:
    file = storage_file(write_sample(tmp_path, 'sqlite3'))
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 7 // 10])
    kept, truncated = read(file)
    assert truncated is not None
    command = truncated.split('`')[1]
    subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, check=True)
    repaired, truncated = read(tmp_path / 'repaired.db3')
    assert truncated is None and len(kept) > COUNT // 2 and set(kept) <= set(repaired)


def test_remedy_for_a_compressed_file_unpacks_it_first(tmp_path: Path) -> None:
    bag = packed_and_split(tmp_path)
    file, plain = bag / 'bag_0.mcap.zstd', bag / 'bag_0.mcap'
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    messages, truncated = read(bag)
    assert messages == sample_messages() and truncated is not None
    # without -c, zstd deletes what it could unpack
    assert f'`zstd -dc {file} > {plain}`, and repair it with `mcap recover {plain} -o repaired.mcap`' in truncated
    assert 'reindex' not in truncated


def in_blocks(content: bytes) -> bytes:
    """Compress as zstd does with a large file, in which each block can be decompressed by itself."""
    packer = zstd.ZstdCompressor()
    blocks = [packer.compress(content[at : at + 1000], packer.FLUSH_BLOCK) for at in range(0, len(content), 1000)]
    return b''.join([*blocks, packer.flush()])


@pytest.mark.parametrize(('kind', 'damage'), [('mcap', 'cut off'), ('mcap', 'overwritten'), ('sqlite3', 'cut off')])
def test_intact_part_of_a_compressed_file_is_read(tmp_path: Path, kind: str, damage: str) -> None:
    # of more than the bytes that are decompressed at once
    bag = write_sample(tmp_path, kind, count=3000)
    file, whole = storage_file(bag), sample_messages(3000)
    packed, half = in_blocks(file.read_bytes()), file.with_name(f'{file.name}.zstd')
    middle = len(packed) * 9 // 10
    half.write_bytes(packed[:middle] if damage == 'cut off' else packed[:middle] + b'\xff' * (len(packed) - middle))
    file.unlink()
    metadata = bag / 'metadata.yaml'
    text = metadata.read_text().replace(f'- {file.name}', f'- {half.name}', 1)
    metadata.write_text(text.replace("compression_mode: ''", 'compression_mode: FILE'))
    messages, truncated = read(bag)
    kept = set(messages)
    assert len(messages) > 3000 and messages == [message for message in whole if message in kept]
    assert truncated is not None and f'zstd -dc {half}' in truncated


def test_missing_topic_is_reported_with_the_damage(tmp_path: Path) -> None:
    bag, first, second = split_in_two(tmp_path)
    first.unlink()
    with BagWriter(tmp_path / 'other', 'mcap') as writer:
        writer.write_range('/sonar', next(m for m in sample_messages() if isinstance(m, RangeMessage)))
    storage_file(tmp_path / 'other').replace(second)
    with Bag(bag) as opened:
        with pytest.raises(
            BagError, match=r'(?s)no nav_msgs/Odometry.*bag\.mcap is missing.*copy what is missing into'
        ):
            opened.choose_topics()
        with pytest.raises(BagError, match=r"(?s)no topic '/left'.*bag\.mcap is missing"):
            opened.choose_range_topics(['/left'])


def test_compressed_file_without_metadata_is_rejected_with_a_remedy(tmp_path: Path) -> None:
    bag = write_sample(tmp_path, 'mcap')
    (bag / 'metadata.yaml').unlink()
    (bag / 'bag_1.mcap.zstd').write_bytes(zstd.compress((bag / 'bag.mcap').read_bytes()))
    with pytest.raises(BagError, match=r'several bag files.*bag_1\.mcap\.zstd\) or unpack.*zstd -d.*reindex'), Bag(bag):
        pass
    (bag / 'bag.mcap').unlink()
    with pytest.raises(BagError, match=r'bag_1\.mcap\.zstd is compressed; unpack it with `zstd -d'), Bag(bag):
        pass


def packed_and_split(folder: Path) -> Path:
    bag = write_sample(folder, 'mcap')
    file = storage_file(bag)
    for number in range(2):
        (bag / f'bag_{number}.mcap.zstd').write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()
    metadata = bag / 'metadata.yaml'
    text = metadata.read_text().replace('- bag.mcap', '- bag_0.mcap.zstd\n  - bag_1.mcap.zstd', 1)
    metadata.write_text(text.replace("compression_mode: ''", 'compression_mode: FILE'))
    return bag


@pytest.mark.parametrize('full', ['before', 'while it is written', 'no folder'])
def test_lack_of_disk_space_is_not_reported_as_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full: str
) -> None:
    bag = packed_and_split(tmp_path)
    assert read(bag) == ([message for message in sample_messages() for _ in range(2)], None)
    size = len(zstd.decompress((bag / 'bag_0.mcap.zstd').read_bytes()))
    temporary = tmp_path / 'temporary'
    temporary.mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(temporary))
    real = Path.open

    def opened(path: Path, *arguments: object) -> object:
        if path.suffix == '.mcap' and arguments == ('wb',) and '_1' in path.name:
            raise OSError(errno.ENOSPC, 'No space left on device')
        return real(path, *arguments)

    if full == 'before':
        monkeypatch.setattr(shutil, 'disk_usage', lambda _: SimpleNamespace(free=size - 1))
    elif full == 'no folder':
        temporary.rmdir()
    else:
        monkeypatch.setattr(Path, 'open', opened)
    with pytest.raises(BagError, match='set TMPDIR') as caught, Bag(bag):
        pass
    assert 'damaged' not in str(caught.value) and str(bag) in str(caught.value)
    assert full == 'no folder' or list(temporary.iterdir()) == []
