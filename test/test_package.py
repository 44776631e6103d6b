"""Installation files and data files: they agree with each other and with the code."""

from __future__ import annotations

import importlib
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import setuptools
import yaml

import forward_grid_mapper
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.files.parameter_file import load_parameters
from forward_grid_mapper.files.parameter_text import dump_parameters, parameters_markdown
from forward_grid_mapper.simulation.sonar import SonarArray, front_array, sonar_ring

ROOT = Path(__file__).resolve().parents[1]
NAME = 'forward_grid_mapper'
DEPENDENCIES = {
    'exec_depend': {
        *('diagnostic_msgs', 'geometry_msgs', 'launch', 'launch_ros', 'nav_msgs', 'rclpy'),
        *('map_msgs', 'rosgraph_msgs', 'sensor_msgs', 'std_srvs', 'tf2_msgs', 'tf2_ros_py'),
        *('builtin_interfaces', 'lifecycle_msgs', 'rcl_interfaces', 'rviz2'),
        *('python3-matplotlib', 'python3-numba', 'python3-numpy', 'python3-rosbags-pip', 'python3-scipy'),
        'python3-yaml',
    },
    'test_depend': {
        *('python3-argcomplete', 'python3-hypothesis', 'python3-pil'),
        *('python3-pytest', 'python3-pytest-timeout', 'python3-pytest-xdist'),
    },
}
"""Names of ROS packages, and keys of rosdep for other packages."""

IMPORTS = {'python3-yaml': 'PyYAML', 'python3-rosbags-pip': 'rosbags', 'python3-pil': 'pillow'}
"""Python names of these keys, if they differ by more than the prefix."""

MAPS = [f'/{NAME}/{name}' for name in ('live_map', 'ml_map', 'uncertainty_map')]


@pytest.fixture(scope='module')
def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / 'package.xml').getroot()


def given_to_setuptools(*arguments: str) -> dict[str, Any]:
    """The arguments of setup.py for setuptools when it is called with these arguments."""
    given: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr(setuptools, 'setup', lambda **options: given.update(options))
        patch.setattr(sys, 'argv', ['setup.py', *arguments])
        runpy.run_path('setup.py')
    return given


@pytest.fixture(scope='module')
def setup() -> dict[str, Any]:
    """The arguments of setup.py for setuptools when colcon builds."""
    return given_to_setuptools('install', '--prefix', 'install')


def text_of(manifest: ElementTree.Element, tag: str) -> str:
    return (manifest.findtext(tag) or '').strip()


def test_manifest_is_valid() -> None:
    package = pytest.importorskip('catkin_pkg.package', reason='catkin_pkg is not installed')
    assert package.parse_package(str(ROOT / 'package.xml'), warnings=[]).validate() is None


def test_manifest_has_the_entries_of_colcon_and_rosdep(manifest: ElementTree.Element) -> None:
    assert (manifest.tag, manifest.get('format')) == ('package', '3')
    assert manifest.findtext('export/build_type') == 'ament_python'
    assert text_of(manifest, 'license') == 'Apache-2.0'
    assert (ROOT / 'LICENSE').read_text().lstrip().startswith('Apache License')
    for tag, names in DEPENDENCIES.items():
        found = [element.text for element in manifest.findall(tag)]
        assert sorted(found) == sorted(names)


def test_manifest_bounds_no_version_that_debian_counts_otherwise(manifest: ElementTree.Element) -> None:
    """A Debian package has these bounds; python3-numpy is 1:1.26.4 there, and so above any bound without an epoch."""
    (numpy,) = (element for element in manifest.findall('exec_depend') if element.text == 'python3-numpy')
    assert set(numpy.attrib) == {'version_gte'}


def test_manifest_names_a_maintainer(manifest: ElementTree.Element, setup: dict[str, Any]) -> None:
    maintainer = manifest.find('maintainer')
    assert maintainer is not None
    assert re.fullmatch(r'[\w.+-]+@[\w-]+(\.[\w-]+)+', maintainer.get('email', ''))
    assert (maintainer.text, maintainer.get('email')) == (setup['maintainer'], setup['maintainer_email'])


def test_name_version_and_licence_agree(manifest: ElementTree.Element, setup: dict[str, Any]) -> None:
    assert text_of(manifest, 'name') == setup['name'] == NAME
    assert text_of(manifest, 'version') == setup['version'] == forward_grid_mapper.__version__
    assert text_of(manifest, 'license') == setup['license']


def test_pip_installs_what_rosdep_installs(setup: dict[str, Any]) -> None:
    extras = setup['extras_require']
    required = [*setup['install_requires'], *extras['offline'], *extras['test']]
    by_pip = {re.split(r'[<>=\[ ]', line)[0] for line in required}
    keys = {key for names in DEPENDENCIES.values() for key in names if key.startswith('python3-')}
    assert {IMPORTS.get(key, key.removeprefix('python3-')) for key in keys} == by_pip
    for line in extras['ros']:
        assert line.startswith('ros-jazzy-')


def test_data_files_of_the_package_are_installed(setup: dict[str, Any]) -> None:
    package = ROOT / NAME
    installed = {path for pattern in setup['package_data'][NAME] for path in package.glob(pattern)}
    others = {path for path in package.rglob('*') if path.is_file() and path.suffix not in ('.py', '.pyc')}
    assert {path for path in others if '__pycache__' not in path.parts} == installed


def test_all_commands_can_be_started(setup: dict[str, Any]) -> None:
    from forward_grid_mapper.__main__ import COMMANDS

    scripts = dict(line.split(' = ') for line in setup['entry_points']['console_scripts'])
    assert scripts == {NAME: f'{NAME}.__main__:main', **{name: f'{NAME}.__main__:{name}' for name in COMMANDS}}
    for target in scripts.values():
        module, function = target.split(':')
        assert callable(getattr(importlib.import_module(module), function))
    for module, _ in COMMANDS.values():
        assert callable(importlib.import_module(f'{NAME}.{module}').main)


def test_citation_and_changelog_have_the_current_version() -> None:
    version = forward_grid_mapper.__version__
    assert yaml.safe_load((ROOT / 'CITATION.cff').read_text())['version'] == version
    assert re.search(rf'^## {re.escape(version)}\b', (ROOT / 'CHANGELOG.md').read_text(), re.MULTILINE)


@pytest.mark.parametrize('build', ['dist_info', 'bdist_wheel', 'editable_wheel'])
def test_pip_installs_one_command(build: str) -> None:
    made = given_to_setuptools(build)['entry_points']['console_scripts']
    assert made == [f'{NAME} = {NAME}.__main__:main']


@pytest.mark.parametrize('folder', ['config', 'launch', 'rviz'])
def test_all_files_of_a_folder_are_installed(setup: dict[str, Any], folder: str) -> None:
    installed = dict(setup['data_files'])
    present = sorted(str(path.relative_to(ROOT)) for path in (ROOT / folder).rglob('*') if path.suffix != '.pyc')
    present = [name for name in present if (ROOT / name).is_file()]
    assert present
    assert installed[f'share/{NAME}/{folder}'] == present


def test_package_is_in_the_ament_index(setup: dict[str, Any]) -> None:
    installed = dict(setup['data_files'])
    assert installed['share/ament_index/resource_index/packages'] == [f'resource/{NAME}']
    assert installed[f'share/{NAME}'] == ['package.xml']
    assert (ROOT / 'resource' / NAME).is_file()
    assert f'$base/lib/{NAME}' in (ROOT / 'setup.cfg').read_text()


def test_all_packages_with_code_are_installed(setup: dict[str, Any]) -> None:
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / NAME).rglob('*.py')}
    assert sorted(setup['packages']) == sorted('.'.join(folder.parts) for folder in folders)


def test_lists_of_parameters_are_up_to_date() -> None:
    advice = 'run scripts/update_docs'
    assert (ROOT / 'config/mapper.yaml').read_text('utf-8') == dump_parameters(Parameters()), advice
    assert (ROOT / 'docs/parameters.md').read_text('utf-8') == parameters_markdown(), advice


@pytest.mark.parametrize(('name', 'sonars'), [('ring_24', sonar_ring()), ('front_8', front_array())])
def test_examples_have_the_poses_of_the_simulated_sonars(name: str, sonars: SonarArray) -> None:
    values, extrinsics, node = load_parameters(ROOT / 'config' / f'{name}.yaml')
    assert Parameters.from_flat(values).node.range_topics == ('sonar',)
    assert not node
    assert list(extrinsics) == list(sonars.names)
    np.testing.assert_allclose(list(extrinsics.values()), [pose for _, pose in sonars.extrinsics], atol=1e-4)


@pytest.mark.parametrize('name', ['mapper', 'ring_24', 'front_8'])
def test_ros_loads_the_parameter_files(name: str) -> None:
    rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed (the extra ros, or a sourced ROS 2)')
    path = ROOT / 'config' / f'{name}.yaml'
    values, extrinsics, _ = load_parameters(path)
    context = rclpy.Context()
    rclpy.init(args=['--ros-args', '--params-file', str(path)], context=context)
    try:
        node = rclpy.create_node(NAME, context=context, automatically_declare_parameters_from_overrides=True)
        for row, value in values.items():
            loaded = node.get_parameter(row).value
            assert type(loaded) is type(value) or isinstance(value, tuple)
            assert loaded == (list(value) if isinstance(value, tuple) else value)
        for frame, pose in extrinsics.items():
            assert list(node.get_parameter(f'sensors.{frame}.pose').value) == list(pose)
        node.destroy_node()
    finally:
        context.try_shutdown()


def test_rviz_shows_the_three_maps() -> None:
    document = yaml.safe_load((ROOT / 'rviz' / f'{NAME}.rviz').read_text())
    manager = document['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == 'odom'
    displays = {display['Name']: display for display in manager['Displays']}
    maps = [display for display in displays.values() if display['Class'] == 'rviz_default_plugins/Map']
    assert [display['Topic']['Value'] for display in maps] == MAPS
    for display in maps:
        assert display['Topic']['Durability Policy'] == 'Transient Local'
        assert display['Topic']['Reliability Policy'] == 'Reliable'
    assert {display['Name']: display['Alpha'] for display in maps if display['Enabled'] and display['Alpha'] == 1} == {
        'Maximum likelihood map': 1
    }
    assert displays['Odometry path']['Topic']['Value'] == '/odom'
    assert displays['TF']['Enabled']


def tracked_files() -> list[Path]:
    try:
        listed = subprocess.run(['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip('this is not a git checkout')
    return [path for name in listed.decode().split('\0') if name and (path := ROOT / name).is_file()]


def test_no_file_names_the_host_of_a_registry() -> None:
    # in parts, since this file is searched as well
    parts = [('pypi', 'org'), ('pythonhosted', 'org'), ('npmjs', 'org'), ('npmjs', 'com'), ('deb', 'debian', 'org')]
    parts += [('packages', 'ros', 'org'), ('archive', 'ubuntu', 'com'), ('proxy', 'golang', 'org'), ('crates', 'io')]
    hosts = re.compile('|'.join(re.escape('.'.join(names)) for names in parts), re.IGNORECASE)
    for path in tracked_files():
        found = hosts.search(path.read_text('utf-8', errors='replace'))
        assert not found, f'{path.relative_to(ROOT)} names {found[0]}'
