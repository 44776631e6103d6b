"""Runs a script in a page in a headless browser and returns its result."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome')

WHEN_READY = """<script>
const timer = setInterval(async () => {
  if (!document.body.dataset.ready) return;
  clearInterval(timer);
  let found;
  try { found = await (async () => { %s })(); } catch (error) { found = {error: String(error.stack)}; }
  document.body.textContent = 'FOUND' + JSON.stringify(found) + 'END';
}, 20);
</script></body>"""


def found_in(page: Path, folder: Path, script: str, width: int = 1280, height: int = 800) -> Any:
    """Return the result of a script that runs in the page; skip the test if there is no browser."""
    browser = next(filter(None, map(shutil.which, NAMES)), None)
    if browser is None:
        pytest.skip(f'none of {", ".join(NAMES)} is installed')
    text = page.read_text(encoding='utf-8')
    asked = folder / 'asked.html'
    asked.write_text(text.replace('</body>', WHEN_READY % script), encoding='utf-8')
    command = [
        browser,
        '--headless',
        '--no-sandbox',
        '--disable-gpu',
        '--disable-dev-shm-usage',
        f'--user-data-dir={folder / "profile"}',
        f'--window-size={width},{height}',
        '--virtual-time-budget=60000',
        '--dump-dom',
        asked.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    answer = re.search('FOUND(.*)END</body>', done.stdout, re.DOTALL)
    assert answer, f'the page was never ready: {done.stdout[-500:]}'
    found = json.loads(html.unescape(answer[1]))
    assert not (isinstance(found, dict) and 'error' in found), found['error']
    return found
