"""A hook of mkdocs: adds the pages beside docs/ to the site, with README.md as its first page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

PAGES = {'README.md': 'index.md', 'CONTRIBUTING.md': 'CONTRIBUTING.md', 'CHANGELOG.md': 'CHANGELOG.md'}
FILES = ('CITATION.cff',)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages; links into docs/ become links to pages beside them."""
    from mkdocs.structure.files import File

    root = Path(config.config_file_path).parent
    for source, page in PAGES.items():
        text = (root / source).read_text(encoding='utf-8').replace('](docs/', '](')
        files.append(File.generated(config, page, content=text))
    for name in FILES:
        files.append(File.generated(config, name, abs_src_path=str(root / name)))
    return files
