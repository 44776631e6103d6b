"""Starts the mapper and, on request, RViz with its three maps."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'forward_grid_mapper'
MAPS = ('live_map', 'ml_map', 'uncertainty_map')
# Each robot has its transforms in its namespace, as with Nav2; without a namespace this changes nothing.
TRANSFORMS = [('/tf', 'tf'), ('/tf_static', 'tf_static')]
RELIABILITY = ['', 'best_effort', 'reliable']
SWITCH = ['', 'true', 'false', 'True', 'False']
ON_OFF = SWITCH[1:]
# For Nav2 a cell is an obstacle from lethal_cost_threshold on, 100 by default; a probability hardly ever reaches it.
OF_PROBABILITIES = (
    'the map on topic map has probabilities: without lethal_cost_threshold: 65 Nav2 treats most walls as free space; '
    'map:=ml_map does not need this setting'
)
# Parameters of the mapper that are launch arguments as well; if one is not given, the parameter file decides.
PARAMETERS = {
    'range_topics': ('Topics of sensor_msgs/Range, separated by commas, if there are several', None),
    'range_reliability': ('Quality of service of the Range subscriptions', RELIABILITY),
    'odom_reliability': ('Quality of service of the odometry subscription', RELIABILITY),
    'map_frame': ('Frame of the maps if it is not the odometry frame, for example map if AMCL is running', None),
    'refine_poses': ('Whether run_em corrects the drift of odometry; the maps are then in frame map', SWITCH),
    'online': ('Whether the maximum likelihood map and the uncertainty map are updated with every reading', SWITCH),
    'autostart': ('Whether the mapper activates itself; if not, a lifecycle manager has to do it', SWITCH),
    'journal': ('Folder of the journal, which restores accepted readings after a restart', None),
}


def declared_arguments():
    """Return the launch arguments."""
    share = FindPackageShare(PACKAGE)
    return [
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
            default_value='',
            choices=SWITCH,
            description='Take the time from /clock, as in simulation or when a bag is replayed with --clock '
            '(empty: from params_file or SetParameter)',
        ),
        DeclareLaunchArgument(
            'sonar',
            default_value='sonar',
            description='Topic of sensor_msgs/Range; for several topics set range_topics, then this one is ignored',
        ),
        DeclareLaunchArgument(
            'odom',
            default_value='odom',
            description='Topic of nav_msgs/Odometry; ignored if params_file has another odom_topic',
        ),
        *(
            DeclareLaunchArgument(
                name,
                default_value='',
                description=f'{text} (empty: from params_file)',
                **({'choices': choices} if choices else {}),
            )
            for name, (text, choices) in PARAMETERS.items()
        ),
        DeclareLaunchArgument(
            'map',
            default_value='',
            choices=['', *MAPS],
            description='Publish this map on topic map, for Nav2, instead of its own topic',
        ),
        DeclareLaunchArgument(
            'use_respawn',
            default_value='false',
            choices=ON_OFF,
            description='Whether to restart the mapper when it ends; set journal to keep its readings',
        ),
        DeclareLaunchArgument(
            'log_level',
            default_value='info',
            choices=['debug', 'info', 'warn', 'error', 'fatal'],
            description='Lowest severity of the log messages of the mapper',
        ),
        DeclareLaunchArgument(
            'rviz', default_value='false', choices=ON_OFF, description='Whether to start RViz (rviz2)'
        ),
        DeclareLaunchArgument(
            'rviz_config',
            default_value=PathJoinSubstitution([share, 'rviz', f'{PACKAGE}.rviz']),
            description='Full path to the RViz configuration',
        ),
    ]


def parameter_value(name, text):
    """Return the value of a launch argument with the type that the parameter has."""
    if name == 'range_topics':
        return [topic.strip() for topic in text.split(',') if topic.strip()]
    if PARAMETERS[name][1] is SWITCH:
        return is_on(text)
    # a text that looks like a number or like nothing in YAML is a text all the same
    return ParameterValue(text, value_type=str)


def is_on(text):
    """Return whether a switch is on; Python launch files write True, others true."""
    return text.lower() == 'true'


def start(context):
    """Return the nodes that the arguments ask for."""
    given = {
        name: LaunchConfiguration(name).perform(context) for name in (*PARAMETERS, 'map', 'use_sim_time', 'use_respawn')
    }
    # shells leave ~ in name:=~/file; and launch would only warn, and start a mapper without the poses of its sensors
    params_file = Path(LaunchConfiguration('params_file').perform(context)).expanduser()
    if not params_file.is_file():
        raise RuntimeError(f'params_file: there is no file {params_file}')
    namespace = LaunchConfiguration('namespace')
    clock = [{'use_sim_time': is_on(given['use_sim_time'])}] if given['use_sim_time'] else []
    chosen = {name: parameter_value(name, given[name]) for name in PARAMETERS if given[name]}
    # RViz shows a map in another frame only if it knows the transform at the map's stamp, which one that starts later
    # does not
    frame = given['map_frame'].lstrip('/') or ('map' if is_on(given['refine_poses']) else '')
    mapper = Node(
        package=PACKAGE,
        executable='mapper',
        name=PACKAGE,
        namespace=namespace,
        output='screen',
        emulate_tty=True,
        respawn=is_on(given['use_respawn']),
        respawn_delay=2.0,
        parameters=[str(params_file), *clock, *([chosen] if chosen else [])],
        remappings=[
            *TRANSFORMS,
            ('sonar', LaunchConfiguration('sonar')),
            ('odom', LaunchConfiguration('odom')),
            *([(f'~/{given["map"]}', 'map')] if given['map'] else []),
        ],
        arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')],
    )
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        namespace=namespace,
        output='screen',
        condition=IfCondition(LaunchConfiguration('rviz')),
        parameters=clock,
        # the configuration names topics from the root, which a namespace moves
        remappings=[
            *TRANSFORMS,
            *(
                (f'/{PACKAGE}/{name}{ending}', ('map' if name == given['map'] else f'{PACKAGE}/{name}') + ending)
                for name in MAPS
                for ending in ('', '_updates')
            ),
            (f'/{PACKAGE}/path', f'{PACKAGE}/path'),
            ('/odom', LaunchConfiguration('odom')),
        ],
        arguments=['-d', LaunchConfiguration('rviz_config'), *(['-f', frame] if frame else [])],
    )
    # RViz first: where it is not installed, launch ends before it has started a mapper that nothing would stop
    return [*([LogInfo(msg=OF_PROBABILITIES)] if given['map'] not in ('', 'ml_map') else []), rviz, mapper]


def generate_launch_description():
    """Return what `ros2 launch forward_grid_mapper mapper.launch.py` starts."""
    return LaunchDescription([*declared_arguments(), OpaqueFunction(function=start)])
