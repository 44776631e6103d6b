"""All names in README.md and docs/ exist: files, functions, parameters, commands, tests, topics, links."""

from __future__ import annotations

import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from doc_names import DEPRECATED, PAGES, ROOT, wrong_commands, wrong_defaults, wrong_links, wrong_names
from test_layers import BELOW, CORE

ALLOWED = {
    '.venv': 'the folder that the scripts set up',
    '[ros]': 'an extra of setup.py',
    'src': 'a folder of a colcon workspace',
    '.bag': 'the ending of ROS 1 bags',
    '.tum': 'the ending of trajectories in the TUM format',
    'trajectory.tum': 'a file that process_bag writes',
    'odometry.tum': 'a file that process_bag writes',
    'trajectory_1.tum': 'a file that process_bag writes',
    'odometry_calibration.yaml': 'a file that process_bag writes',
    'maps.mcap_bag': 'a folder that process_bag --bag writes',
    'reference.tum': 'a file that simulate writes',
    'evo_ape tum': 'a command of evo',
    'mode: raw': 'a line of map_server files',
    'use_sim_time:=true': 'a parameter of every ROS node',
    'set_parameters': 'a service of every ROS node',
    '~/change_state': 'a service of every lifecycle node',
    '~/get_state': 'a service of every lifecycle node',
    'manager.yaml': 'a file of the user',
    'bond_timeout': "a parameter of Nav2's lifecycle manager",
    '~/live_map_updates': "the live map's topic and an ending",
    'map_updates': "the map's topic and an ending",
    'NUMBA_CACHE_DIR': 'an environment variable of numba',
    '~/.cache': 'a folder of the user',
    '~/.ros/log': 'a folder of the user',
    'building_a': 'a recording that is not part of the project',
    'building_b': 'a recording that is not part of the project',
    'building_c': 'a recording that is not part of the project',
    'office_a': 'a recording that is not part of the project',
    'office_b': 'a recording that is not part of the project',
    'others': 'a column of the tables that the benchmarks print',
    'ml_map.pgm': 'a name of a map and an ending',
    'maps_DATE_TIME/': 'a folder that the node makes',
    'drive_NNNN.journal': 'a file that the node makes',
    'drive_NNNN.journal-wal': 'a file that SQLite makes',
    '-wal': 'the ending of that file',
    'synchronous=NORMAL': 'a setting of SQLite',
    'TMPDIR': 'an environment variable of POSIX',
    'header.stamp': 'a field of messages',
    'header.frame_id': 'a field of messages',
    'child_frame_id': 'a field of odometry',
    'base_link': 'a usual name of a frame',
    'base_footprint': 'a usual name of a frame',
    'inf': 'a number that is not finite',
    'sonar_left': 'a name of a sensor, as an example',
    '/map': 'the topic of the map in Nav2, where a launch argument sends one of ours',
    '/tf': 'the topic of transforms',
    '--delay 3': 'an option of ros2 bag play',
    'ml_map.yaml': 'a name of a map and an ending',
    'plugins': 'a setting of Nav2',
    'subscribe_to_updates: true': 'a setting of Nav2',
    'SetParameter': 'an action of launch files',
    'PushROSNamespace': 'an action of launch files',
    'ros2 topic info -v': 'a command of ROS 2',
    'ros2 bag play': 'a command of ROS 2',
    'raw': 'a mode of map_server',
    '/robot1/forward_grid_mapper/run_em': 'a service of a node in a namespace',
    'mkdocs serve': 'a command of mkdocs',
    'tasks.csv': 'a file that process_bag writes',
    'maps.zarr': 'a folder that process_bag writes',
    'index.json': 'a file that process_bag writes',
    'levels': 'an attribute in that folder',
    '0/': 'a folder in that folder',
    'maps.work': 'a folder that process_bag makes',
    'bokeh': 'a package that Dask draws its dashboard with',
    'kill -9': 'a command of every shell',
    'python3-pip': 'a package of Ubuntu',
}
"""Words in code spans that are no names of the repository, with the reason why they are allowed."""

PAGE_OR_PROGRAM = r'\b(?:docs|benchmarks|config|scripts)/\w+\.(?:md|py|yaml|xml|png)\b'
"""A page, program or parameter file in comments and help texts."""

of_each_page = pytest.mark.parametrize('page', PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])


def test_readme_links_to_all_pages() -> None:
    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    assert [page.name for page in PAGES if page.parent.name == 'docs' and f'(docs/{page.name})' not in text] == []
    assert len(text.splitlines()) < 100, 'the rest belongs to docs/'


def test_site_links_to_all_pages() -> None:
    def pages(items: list[Any]) -> Iterator[str]:
        for item in items:
            for entry in item.values() if isinstance(item, dict) else [item]:
                yield from pages(entry) if isinstance(entry, list) else [entry]

    site = yaml.safe_load((ROOT / 'mkdocs.yml').read_text(encoding='utf-8'))
    beside = runpy.run_path(str(ROOT / 'scripts' / 'site_pages.py'))['PAGES']
    expected = [*beside.values(), *(page.name for page in PAGES if page.parent.name == 'docs')]
    assert sorted(pages(site['nav'])) == sorted(expected)
    assert all((ROOT / name).is_file() for name in beside)


@of_each_page
def test_all_names_exist(page: Path) -> None:
    assert wrong_names(page.read_text(encoding='utf-8'), page, ALLOWED) == []


@of_each_page
def test_all_command_lines_are_valid(page: Path) -> None:
    assert wrong_commands(page.read_text(encoding='utf-8'), page) == []


@of_each_page
def test_all_links_have_a_target(page: Path) -> None:
    assert wrong_links(page.read_text(encoding='utf-8'), page) == []


@of_each_page
def test_stated_defaults_are_those_of_the_table(page: Path) -> None:
    assert wrong_defaults(page.read_text(encoding='utf-8')) == []


@of_each_page
def test_pages_have_no_placeholders(page: Path) -> None:
    assert re.findall(r'@[A-Z]+@|\b(?:BYTES|TODO|TBD|FIXME|XXX)\b', page.read_text(encoding='utf-8')) == []


def test_paths_in_sources_exist() -> None:
    folders = ('forward_grid_mapper', 'benchmarks', 'test', 'config', 'launch', 'scripts')
    wrong = []
    for path in (path for folder in folders for path in sorted((ROOT / folder).rglob('*'))):
        if path.is_file() and path.suffix in ('.py', '.yaml', '.xml', '') and path.name != 'test_docs.py':
            found = re.findall(PAGE_OR_PROGRAM, path.read_text(encoding='utf-8'))
            wrong += [f'{name} in {path.relative_to(ROOT)}' for name in found if not (ROOT / name).exists()]
    assert wrong == []


def test_architecture_lists_all_packages_and_layers_in_order() -> None:
    text = (ROOT / 'docs' / 'architecture.md').read_text(encoding='utf-8')
    assert ' ← '.join(CORE) in text
    listed = dict(re.findall(r'^    (\w+)/ +\S.*?(?:← (.*))?$', text, flags=re.MULTILINE))
    below = {name: set(filter(None, listed[name].split(', '))) for name in BELOW}
    assert below == {**BELOW, 'commands': {'all of them'}}


def test_allowed_words_are_in_use() -> None:
    pages = '\n'.join(page.read_text(encoding='utf-8') for page in PAGES)
    assert [word for word in ALLOWED if f'`{word}`' not in pages] == []


# The tests above can fail: each of these texts has one wrong name

PAGE = ROOT / 'docs' / 'planted.md'
GOOD = """# A page

See `core/search/search.py`: `Search.run`, `LEAST_GAIN`; `p_hit` 0.5, `process_bag --learn`, `~/run_em`,
`search.Search`, `test_search.py::test_alpha_zero_leaves_the_prior`, `test_docs.py`,
`sensor_msgs/Range`, `pose_gap`, `--set`, `maps.npz` and [here](#a-page), ![there](door.png).

    python3 -m forward_grid_mapper process_bag MY_BAG -o maps --set p_hit=0.8
    python benchmarks/speed.py --only live
"""


def wrong(text: str) -> list[str]:
    return [*wrong_names(text, PAGE, {}), *wrong_commands(text, PAGE), *wrong_links(text, PAGE), *wrong_defaults(text)]


def test_page_of_good_names_has_no_wrong_one() -> None:
    assert wrong(GOOD) == []


@pytest.mark.parametrize(
    ('good', 'bad'),
    [
        ('core/search/search.py', 'core/search.py'),
        ('Search.run', 'Search.walk'),
        ('LEAST_GAIN', 'LEAST_LOSS'),
        ('`p_hit` 0.5', '`p_hid` 0.5'),
        ('process_bag --learn', 'process_bag --lern'),
        ('process_bag --learn', 'process_bags'),
        ('~/run_em', '~/run_me'),
        ('search.Search', 'search.Find'),
        ('test_alpha_zero_leaves_the_prior', 'test_alpha_zero_leaves_nothing'),
        ('`test_docs.py`', '`test_doc.py`'),
        ('`test_docs.py`', 'test_doc'),
        ('sensor_msgs/Range', 'sensor_msgs/Ranger'),
        ('`pose_gap`', '`pose_hole`'),
        ('`--set`', '`--sit`'),
        ('`maps.npz`', '`maps.npy`'),
        ('(#a-page)', '(#no-page)'),
        ('(door.png)', '(window.png)'),
        ('grid_mapper process_bag', 'grid_mapper process_bags'),
        (' -o maps', ' --into maps'),
        ('p_hit=0.8', 'p_hid=0.8'),
        ('benchmarks/speed.py', 'benchmarks/sped.py'),
        ('--only live', '--just live'),
        ('# A page\n', '# A page\n\n**Bold** (`p_hit` 0.123).\n'),
        ('# A page\n', '# A page\n\n| parameter | default |\n|---|---|\n| `max_iterations` | `123` |\n'),
        ('# A page\n', '# A page\n\nIn core/finishing.py it is so.\n'),
    ],
)
def test_wrong_name_is_found(good: str, bad: str) -> None:
    assert good in GOOD
    assert wrong(GOOD.replace(good, bad)) != []


@pytest.mark.skipif(not DEPRECATED, reason='no parameter has a former name')
def test_former_name_must_be_marked() -> None:
    name = sorted(DEPRECATED)[0]
    assert wrong(f'Set `{name}`.\n') == [f'{name} is deprecated']
    assert wrong(f'Set `{name}`, which is deprecated.\n') == []
