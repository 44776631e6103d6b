"""The notebook runs from the first to the last cell, and its map agrees with its text."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / 'docs' / 'first_map.ipynb'


def test_all_cells_of_the_notebook_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip('matplotlib')
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    monkeypatch.setattr('tempfile.tempdir', None)
    cells = json.loads(NOTEBOOK.read_text(encoding='utf-8'))['cells']
    names: dict[str, Any] = {}
    for cell in cells:
        if cell['cell_type'] == 'code':
            assert not cell['outputs'], 'outputs are not kept: they would grow stale'
            exec(compile(''.join(cell['source']), cell['id'], 'exec'), names)
    output = capsys.readouterr().out
    assert '600 ranges, rejected: {}' in output
    assert names['probability'](2.85, 1.0) < 0.1
    assert names['probability'](1.5, 1.0) > 0.6
    assert 'report.html' in output.splitlines()
