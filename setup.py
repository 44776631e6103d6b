"""Installation with pip, and with colcon as an ament_python package."""

import sys
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'forward_grid_mapper'
SHARE = f'share/{NAME}'
COMMANDS = ('mapper', 'process_bag', 'explain', 'learn', 'replay_bag', 'simulate', 'experiment', 'warm_up', 'demo')

# ros2 run finds one executable for each command; pip, which puts them on everybody's PATH, installs one for all
FOR_PIP = {'sdist', 'dist_info', 'bdist_wheel', 'editable_wheel'} & set(sys.argv)
SCRIPTS = [f'{NAME} = {NAME}.__main__:main']
if not FOR_PIP:
    SCRIPTS += [f'{command} = {NAME}.__main__:{command}' for command in COMMANDS]


def shared(folder):
    """Return the data_files entry that installs a folder's files under share."""
    return f'{SHARE}/{folder}', sorted(str(path) for path in Path(folder).glob('*.*'))


setup(
    name=NAME,
    version='0.1.0',
    description='Occupancy grid maps from sonar with forward sensor models, for ROS 2',
    # colcon links this file into a folder that has no README
    long_description=Path(__file__).resolve().with_name('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    keywords=['ROS 2', 'sonar', 'ultrasonic', 'mapping', 'occupancy grid', 'EM', 'Nav2'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Developers',
        'Intended Audience :: Science/Research',
        'License :: OSI Approved :: Apache Software License',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.10',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Topic :: Scientific/Engineering',
        'Typing :: Typed',
    ],
    maintainer='The forward_grid_mapper maintainers',
    maintainer_email='maintainers@example.com',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'files/web/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (SHARE, ['package.xml']),
        shared('config'),
        shared('launch'),
        shared('rviz'),
    ],
    zip_safe=False,
    python_requires='>=3.10,<3.13',
    # the oldest and the newest that are admitted are what .ci/run tests with
    install_requires=[
        'numpy>=1.26,<2.5',
        'numba>=0.59,<0.69',
        'scipy>=1.11,<1.18',
        'PyYAML>=6,<7',
    ],
    extras_require={
        'offline': ['rosbags>=0.11.9,<0.12', 'matplotlib>=3.6,<3.12'],
        # those for Python 3.10 and numpy 1.26 are among them
        'scale': [
            'dask>=2024.8,<2027',
            'distributed>=2024.8,<2027',
            'pyarrow>=15,<27',
            'zarr>=2.18,<4',
        ],
        'ros': [
            'ros-jazzy-rclpy>=7,<8',
            'ros-jazzy-rmw-fastrtps-cpp>=8,<9',
            'ros-jazzy-sensor-msgs>=5,<6',
            'ros-jazzy-nav-msgs>=5,<6',
            'ros-jazzy-geometry-msgs>=5,<6',
            'ros-jazzy-std-srvs>=5,<6',
            'ros-jazzy-diagnostic-msgs>=5,<6',
        ],
        'test': [
            'pytest>=7.2,<10',
            'pytest-xdist>=3.7,<4',
            'pytest-timeout>=2.1,<3',
            'hypothesis>=6.80,<7',
            'pillow>=9.2,<14',
            'argcomplete>=3.1,<4',
        ],
        # the viewer and what writes for it are of one version; it takes neither an older Python nor an older numpy
        'rerun': ["rerun-sdk>=0.41,<0.42; python_version>='3.11'"],
        'completion': ['argcomplete>=3.1,<4'],
        'site': ['mkdocs>=1.6,<2', 'mkdocs-material>=9.5,<10', 'nbclient>=0.10,<1', 'ipykernel>=6.29,<8'],
        'lint': ['ruff>=0.17,<0.18', 'mypy>=1.15,<3', 'types-PyYAML>=6,<7'],
    },
    entry_points={'console_scripts': SCRIPTS},
)
