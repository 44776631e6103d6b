"""Reading a bag leaves no files in the temporary folder, also after errors."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from backports import zstd
from bag_samples import storage_file, write_sample

from forward_grid_mapper.bags import unpacking
from forward_grid_mapper.bags.reader import Bag
from forward_grid_mapper.bags.source import RosbagsSource
from forward_grid_mapper.core.common.errors import BagError

METADATA = """rosbag2_bagfile_information:
  relative_file_paths:
    - bag_0.mcap.zstd
    - bag_1.mcap.zstd
  compression_format: zstd
  compression_mode: FILE
"""


@pytest.fixture
def split(tmp_path: Path) -> Path:
    """A split bag of two files, each compressed as a whole."""
    packed = zstd.compress(storage_file(write_sample(tmp_path, 'mcap', name='plain')).read_bytes())
    folder = tmp_path / 'bag'
    folder.mkdir()
    for number in range(2):
        (folder / f'bag_{number}.mcap.zstd').write_bytes(packed)
    (folder / 'metadata.yaml').write_text(METADATA)
    return folder


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The temporary folder."""
    folder = tmp_path / 'temporary'
    folder.mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(folder))
    return folder


def test_unpacked_files_are_deleted_with_the_bag(split: Path, temporary: Path) -> None:
    with Bag(split) as bag:
        assert len(list(temporary.iterdir())) == 2
        assert bag.topics()
    assert not list(temporary.iterdir())


def test_file_that_cannot_be_closed_leaves_no_files(
    split: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(source: RosbagsSource) -> None:
        raise OSError('cannot be closed')

    monkeypatch.setattr(RosbagsSource, 'close', fails)
    with pytest.raises(OSError, match='cannot be closed'), Bag(split) as bag:
        assert len(list(temporary.iterdir())) == 2 and bag.topics()
    assert not list(temporary.iterdir())


@pytest.mark.parametrize('unpacked', [(0,), (1,), (0, 1)])
def test_files_unpacked_by_hand_are_read(split: Path, temporary: Path, unpacked: tuple[int, ...]) -> None:
    """As messages to the user advise; the metadata stay the same."""
    with Bag(split) as bag:
        wanted = bag.topics()
    for number in unpacked:
        file = split / f'bag_{number}.mcap.zstd'
        file.with_suffix('').write_bytes(zstd.decompress(file.read_bytes()))
        file.unlink()
    with Bag(split) as bag:
        assert bag.topics() == wanted
        assert bag.truncated is None
    assert not list(temporary.iterdir())


@pytest.mark.parametrize(
    ('problem', 'raised'), [(KeyboardInterrupt(), KeyboardInterrupt), (PermissionError(13, 'no', 'bag_1'), BagError)]
)
def test_failure_at_the_second_file_leaves_no_files(
    split: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch, problem: BaseException, raised: type[BaseException]
) -> None:
    """For example Ctrl-C while a large bag is unpacked."""
    unpack = unpacking._unpack

    def interrupted(packed: Path, unpacked: Path) -> None:
        if packed.name.startswith('bag_1'):
            raise problem
        unpack(packed, unpacked)

    monkeypatch.setattr(unpacking, '_unpack', interrupted)
    with pytest.raises(raised), Bag(split):
        pass
    assert not list(temporary.iterdir())
