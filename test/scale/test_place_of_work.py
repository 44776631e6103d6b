"""The work folder of a job with results in a folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from forward_grid_mapper.commands import process_bag
from forward_grid_mapper.commands.many_workers import beside, check_apart
from forward_grid_mapper.core.common.errors import OutputError
from forward_grid_mapper.scale import extra, work_folder


@pytest.mark.parametrize(
    ('output', 'work'),
    [
        ('maps', 'here/maps.work'),
        ('.', 'here.work'),
        ('a.b/', 'here/a.b.work'),
        ('../x', 'x.work'),
        ('..', '../{0}.work'),
    ],
)
def test_work_folder_is_beside_the_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str, work: str
) -> None:
    """In the folder of the results, files of an interrupted job would prevent it from continuing."""
    (tmp_path / 'here').mkdir()
    monkeypatch.chdir(tmp_path / 'here')
    assert beside(Path(output)) == (tmp_path / work.format(tmp_path.name)).resolve()
    assert Path(output).resolve() not in beside(Path(output)).resolve().parents


@pytest.mark.parametrize(
    ('output', 'work'),
    [
        ('maps', 'maps'),
        ('maps', 'maps/'),
        ('maps', 'maps/work'),
        ('maps', 'other/../maps/a/b'),
        ('maps', '../here/maps/work'),
        ('.', 'work'),
        ('..', 'work'),
        ('link', 'real/work'),
        ('real', 'link/work'),
        ('real/maps', 'link'),
        ('work/maps', 'work'),
        ('maps/', '.'),
        # the results are outside the folder that the link names
        ('link/../maps', 'maps/work'),
    ],
)
def test_work_and_results_inside_each_other_are_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], output: str, work: str
) -> None:
    """The results could not be written at the end, or would be deleted with the work."""
    monkeypatch.setattr(extra, 'need', lambda: None)
    here = tmp_path / 'here'
    for folder in ('real', 'other'):
        (here / folder).mkdir(parents=True)
    (here / 'link').symlink_to('real')
    monkeypatch.chdir(here)
    before = sorted(tmp_path.rglob('*'))
    assert process_bag.main(['no_bag', '--workers', '1', '-o', output, '--work', work]) == 1
    error = capsys.readouterr().err
    assert '--work ' in error and 'choose one outside the results, or leave out --work' in error
    assert sorted(tmp_path.rglob('*')) == before


@pytest.mark.parametrize(
    ('output', 'work'), [('maps', 'maps.work'), ('maps', 'map'), ('a/maps', 'a/work'), ('link/maps', 'work')]
)
def test_work_next_to_the_results_is_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str, work: str
) -> None:
    (tmp_path / 'real').mkdir()
    (tmp_path / 'link').symlink_to('real')
    monkeypatch.chdir(tmp_path)
    check_apart(Path(output), Path(work))


def test_file_of_a_job_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / 'drives' / '0001.json'
    for text in ('first', 'second'):
        with work_folder.whole(path) as partial:
            partial.write_text(text)
        assert path.read_text() == text
    with pytest.raises(KeyboardInterrupt), work_folder.whole(path) as partial:
        partial.write_text('third')
        raise KeyboardInterrupt
    assert path.read_text() == 'second' and [*path.parent.iterdir()] == [path]


def test_job_begins_in_a_folder_with_only_the_remains_of_a_killed_one(tmp_path: Path) -> None:
    folder = work_folder.WorkFolder(str(tmp_path / 'work'))
    (tmp_path / 'work').mkdir()
    (tmp_path / 'work' / f'.manifest.json.0a1b2c3d{work_folder.PARTIAL}').write_text('{')
    assert not folder.begin({'bags': ['a']})
    assert folder.begin({'bags': ['a']})
    (tmp_path / 'other').mkdir()
    (tmp_path / 'other' / 'letter.txt').write_text('')
    with pytest.raises(OutputError, match='is not empty, and contains no job'):
        work_folder.WorkFolder(str(tmp_path / 'other')).begin({'bags': ['a']})
