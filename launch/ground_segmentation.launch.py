"""Start the node, and RViz if asked for; with --show-args it prints its arguments.

ros2 launch gp_ground_seg ground_segmentation.launch.py topic:=/velodyne_points rviz:=true
"""

from pathlib import Path

import yaml
from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown, TimerAction
from launch_ros.actions import Node

SHARE = Path(get_package_share_directory('gp_ground_seg'))
NODE = 'ground_segmentation_node'
OUTPUTS = ('ground', 'obstacles')
OPTIONAL = ('labeled', 'ground_model', 'scan', 'occupancy')

ARGUMENTS = (
    ('topic', 'points', 'PointCloud2 topic of the LiDAR'),
    ('params_file', '', 'parameter file, or the name of one of config/: default, paper'),
    ('params', '{}', "more parameters, as YAML: '{sensor.height: 1.2, learning.mode: fixed}'"),
    ('namespace', '', 'namespace of the node and of its outputs'),
    ('use_sim_time', 'false', 'use the time of /clock: true or false'),
    ('rviz', 'false', 'start RViz too: true or false'),
    ('frame', 'velo_link', 'fixed frame of RViz: that of the clouds, or one that TF knows'),
    ('log_level', 'info', 'level of the log of the node: debug, info, warn, error'),
    ('required', 'true', 'end the launch when the node ends: true or false'),
)


def _boolean(values, name):
    """Read what conditions of launch take, in upper or lower case: Nav2 writes True."""
    text = values[name].strip().lower()
    if text not in ('true', '1', 'false', '0'):
        raise ValueError(f'{name}:={values[name]}: must be true or false')
    return text in ('true', '1')


def _parameters(values):
    """Files and values for the node; the last value of a name wins."""
    found = []
    if name := values['params_file']:
        preset = SHARE / 'config' / f'{name}.yaml'
        path = preset if preset.is_file() else Path(name).expanduser()
        if not path.is_file():
            raise ValueError(f'params_file:={name}: no such file')
        found.append(str(path))
    try:
        more = yaml.safe_load(values['params']) or {}
    except yaml.YAMLError:
        more = None
    if not isinstance(more, dict):
        raise ValueError(f"params:={values['params']}: must be YAML as '{{sensor.height: 1.2}}'")
    if _boolean(values, 'use_sim_time'):
        more['use_sim_time'] = True
    return [*found, more] if more else found


def _end(event, context):
    """End the launch with the node; an exception gives it exit code 1, Shutdown alone gives 0."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f'{event.process_name} ended with exit code {event.returncode}')
    return Shutdown(reason='the node has ended')


def _rviz(values, place):
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        return LogInfo(msg='rviz2 is not installed: the node runs without it')
    topics = [*OUTPUTS, *(f'{NODE}/{name}' for name in OPTIONAL)]
    file = SHARE / 'config' / 'ground_segmentation.rviz'
    return Node(
        package='rviz2',
        executable='rviz2',
        arguments=['-d', str(file), '-f', values['frame']],
        parameters=[{'use_sim_time': _boolean(values, 'use_sim_time')}],
        remappings=[(f'/{topic}', '/'.join(['', *place, topic])) for topic in topics],
    )


def _actions(context):
    values = context.launch_configurations
    # A launch file around this one may have pushed a namespace.
    parts = values.get('ros_namespace', ''), values['namespace']
    place = [part for text in parts for part in text.split('/') if part]
    actions = [
        Node(
            package='gp_ground_seg',
            executable=NODE,
            name=NODE,
            namespace=values['namespace'].strip('/') or None,
            parameters=_parameters(values),
            remappings=[('points', values['topic'])],
            # Of this node: with the level alone, its middleware would log as much.
            ros_arguments=['--log-level', f'{".".join([*place, NODE])}:={values["log_level"]}'],
            output='screen',
            on_exit=_end if _boolean(values, 'required') else None,
        ),
    ]
    if _boolean(values, 'rviz'):
        actions.append(_rviz(values, place))
    return actions


def _try_actions(context):
    """Return the actions; or one that fails, once launch knows all processes it has to end."""
    try:
        return _actions(context)
    except ValueError as error:
        reason = str(error)

    def fail(_context):
        raise RuntimeError(reason)

    return [TimerAction(period=0.0, actions=[OpaqueFunction(function=fail)])]


def generate_launch_description():
    """Return the arguments and what starts with them."""
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=description)
        for name, value, description in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_try_actions)])
