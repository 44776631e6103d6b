"""The work folder of a job with results in a folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from forward_grid_mapper.commands.many_workers import beside


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
