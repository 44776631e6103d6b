"""Installation with pip, and with colcon as an ament_python package."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = 'forward_grid_mapper'
SHARE = f'share/{NAME}'
COMMANDS = {
    'mapper': 'node.main',
    'process_bag': 'commands.process_bag',
    'learn': 'commands.learn',
    'replay_bag': 'commands.replay_bag',
    'simulate': 'commands.simulate',
    'experiment': 'commands.experiment',
    'demo': 'commands.demo',
}


def shared(folder):
    """Return the data_files entry that installs a folder's files under share."""
    return f'{SHARE}/{folder}', sorted(str(path) for path in Path(folder).glob('*.*'))


setup(
    name=NAME,
    version='0.1.0',
    description='Occupancy grid maps from sonar with forward sensor models, for ROS 2',
    maintainer='The forward_grid_mapper maintainers',
    maintainer_email='maintainers@example.com',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (SHARE, ['package.xml']),
        shared('config'),
        shared('launch'),
        shared('rviz'),
    ],
    zip_safe=False,
    python_requires='>=3.10',
    install_requires=[
        'numpy>=1.26,<3',
        'numba>=0.59,<1',
        'PyYAML>=6,<7',
    ],
    extras_require={
        'offline': ['rosbags>=0.11.9,<0.12', 'matplotlib>=3.6,<4'],
        'ros': [
            'ros-jazzy-rclpy',
            'ros-jazzy-rmw-fastrtps-cpp',
            'ros-jazzy-sensor-msgs',
            'ros-jazzy-nav-msgs',
            'ros-jazzy-geometry-msgs',
            'ros-jazzy-std-srvs',
            'ros-jazzy-diagnostic-msgs',
        ],
        'test': ['pytest>=7,<10', 'hypothesis>=6,<7', 'scipy>=1.11,<2', 'pillow>=9'],
        'lint': ['ruff>=0.17,<0.18', 'mypy>=1.15,<3', 'types-PyYAML>=6'],
    },
    entry_points={
        'console_scripts': [f'{command} = {NAME}.{module}:main' for command, module in COMMANDS.items()],
    },
)
