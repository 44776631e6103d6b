"""Starts the mapper and, on request, RViz with its three maps."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'forward_grid_mapper'
MAPS = ('live_map', 'ml_map', 'uncertainty_map')
# Each robot has its transforms in its namespace, as with Nav2; without a namespace this changes nothing.
TRANSFORMS = [('/tf', 'tf'), ('/tf_static', 'tf_static')]


def generate_launch_description():
    """Return what `ros2 launch forward_grid_mapper mapper.launch.py` starts."""
    share = FindPackageShare(PACKAGE)
    arguments = [
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of the node, its topics, /tf and /tf_static'
        ),
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution([share, 'config', 'mapper.yaml']),
            description='Full path to the parameter YAML of the mapper',
        ),
        DeclareLaunchArgument(
            'use_sim_time',
            default_value='false',
            choices=['true', 'false'],
            description='Take the time from /clock, as in simulation or when a bag is replayed with --clock',
        ),
        DeclareLaunchArgument(
            'sonar',
            default_value='sonar',
            description='Topic of sensor_msgs/Range; for several topics set range_topics in params_file',
        ),
        DeclareLaunchArgument('odom', default_value='odom', description='Topic of nav_msgs/Odometry'),
        DeclareLaunchArgument(
            'log_level',
            default_value='info',
            choices=['debug', 'info', 'warn', 'error', 'fatal'],
            description='Least severity of what the mapper logs',
        ),
        DeclareLaunchArgument(
            'rviz', default_value='false', choices=['true', 'false'], description='Whether to start RViz (rviz2)'
        ),
        DeclareLaunchArgument(
            'rviz_config',
            default_value=PathJoinSubstitution([share, 'rviz', f'{PACKAGE}.rviz']),
            description='Full path to the RViz configuration',
        ),
    ]
    namespace = LaunchConfiguration('namespace')
    use_sim_time = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}
    mapper = Node(
        package=PACKAGE,
        executable='mapper',
        name=PACKAGE,
        namespace=namespace,
        output='screen',
        emulate_tty=True,
        parameters=[LaunchConfiguration('params_file'), use_sim_time],
        remappings=[
            *TRANSFORMS,
            ('sonar', LaunchConfiguration('sonar')),
            ('odom', LaunchConfiguration('odom')),
        ],
        arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')],
    )
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        namespace=namespace,
        output='screen',
        condition=IfCondition(LaunchConfiguration('rviz')),
        parameters=[use_sim_time],
        # the configuration names topics from the root, which a namespace moves
        remappings=[
            *TRANSFORMS,
            *((f'/{PACKAGE}/{name}', f'{PACKAGE}/{name}') for name in MAPS),
            ('/odom', LaunchConfiguration('odom')),
        ],
        arguments=['-d', LaunchConfiguration('rviz_config')],
    )
    return LaunchDescription([*arguments, mapper, rviz])
