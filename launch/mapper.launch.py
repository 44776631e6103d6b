"""Starts the mapper and, on request, RViz with its three maps."""

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
# Nav2 takes a cell for an obstacle from lethal_cost_threshold on, 100 by default, which a probability hardly ever is.
OF_PROBABILITIES = (
    'the map on topic map has probabilities: without lethal_cost_threshold: 65 Nav2 takes most walls for free space; '
    'map:=ml_map needs no such setting'
)
# Parameters of the mapper that are launch arguments as well; one that is not given is as the parameter file has it.
PARAMETERS = {
    'range_topics': ('Topics of sensor_msgs/Range, separated by commas, where there are several', None),
    'range_reliability': ('Quality of service of the Range subscriptions', RELIABILITY),
    'odom_reliability': ('Quality of service of the odometry subscription', RELIABILITY),
    'map_frame': ('Frame of the maps where it is not the odometry frame, for example map when AMCL runs', None),
    'refine_poses': ('Whether run_em takes the drift out of odometry, in frame map', SWITCH),
    'online': ('Whether the maximum likelihood map and the uncertainty map follow every reading', SWITCH),
    'autostart': ('Whether the mapper starts by itself; if not, a lifecycle manager has to start it', SWITCH),
    'journal': ('Folder of the journal, which gives accepted readings back after a restart', None),
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
            '(empty: as in params_file, or as SetParameter has it)',
        ),
        DeclareLaunchArgument(
            'sonar',
            default_value='sonar',
            description='Topic of sensor_msgs/Range; for several give range_topics, and then this says nothing',
        ),
        DeclareLaunchArgument(
            'odom',
            default_value='odom',
            description='Topic of nav_msgs/Odometry; where params_file has another odom_topic, this says nothing',
        ),
        *(
            DeclareLaunchArgument(
                name,
                default_value='',
                description=f'{text} (empty: as in params_file)',
                **({'choices': choices} if choices else {}),
            )
            for name, (text, choices) in PARAMETERS.items()
        ),
        DeclareLaunchArgument(
            'map',
            default_value='',
            choices=['', *MAPS],
            description='Publish this map on topic map, for Nav2, instead of on the topic of its own name',
        ),
        DeclareLaunchArgument(
            'use_respawn',
            default_value='false',
            choices=ON_OFF,
            description='Whether to start the mapper again when it ends; give it a journal, so that it goes on',
        ),
        DeclareLaunchArgument(
            'log_level',
            default_value='info',
            choices=['debug', 'info', 'warn', 'error', 'fatal'],
            description='Least severity of what the mapper logs',
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
    namespace = LaunchConfiguration('namespace')
    clock = [{'use_sim_time': is_on(given['use_sim_time'])}] if given['use_sim_time'] else []
    chosen = {name: parameter_value(name, given[name]) for name in PARAMETERS if given[name]}
    mapper = Node(
        package=PACKAGE,
        executable='mapper',
        name=PACKAGE,
        namespace=namespace,
        output='screen',
        emulate_tty=True,
        respawn=is_on(given['use_respawn']),
        respawn_delay=2.0,
        parameters=[LaunchConfiguration('params_file'), *clock, *([chosen] if chosen else [])],
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
        arguments=['-d', LaunchConfiguration('rviz_config')],
    )
    # RViz first: where it is not installed, launch ends before it has started a mapper that nothing would stop
    return [*([LogInfo(msg=OF_PROBABILITIES)] if given['map'] not in ('', 'ml_map') else []), rviz, mapper]


def generate_launch_description():
    """Return what `ros2 launch forward_grid_mapper mapper.launch.py` starts."""
    return LaunchDescription([*declared_arguments(), OpaqueFunction(function=start)])
