"""Start the node, and RViz and a bag if asked for; with --show-args it prints its arguments.

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
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    Shutdown,
    TimerAction,
)
from launch_ros.actions import Node

SHARE = Path(get_package_share_directory('gp_ground_seg'))
OUTPUTS = ('ground', 'obstacles')
OPTIONAL = ('labeled', 'ground_model', 'scan', 'occupancy')

ARGUMENTS = (
    ('topic', 'points', 'PointCloud2 topic of the LiDAR'),
    ('ground', 'ground', 'topic of the ground'),
    ('obstacles', 'obstacles', 'topic of the obstacles'),
    ('params_file', '', 'parameter file, or the name of one of config/: default, paper'),
    ('params', '{}', "more parameters, as YAML: '{sensor.height: 1.2, learning.mode: fixed}'"),
    ('name', 'ground_segmentation_node', 'name of the node'),
    ('namespace', '', 'namespace of the node and of its outputs'),
    ('log_level', 'info', 'level of its log: debug, info, warn, error'),
    ('respawn', 'false', 'start the node again when it ends; else the launch ends with it'),
    ('respawn_delay', '1.0', 'seconds before that'),
    ('use_sim_time', 'false', 'use the time of /clock: true or false'),
    ('bag', '', 'bag to play with ros2 bag, 3 s after the start, and to take the time of'),
    ('rviz', 'false', 'start RViz beside it: true or false'),
    (
        'frame',
        'velo_link',
        'fixed frame of RViz: that of the clouds, or one that TF connects to it',
    ),
)


def _boolean(values, name):
    """Read what conditions of launch take, in upper or lower case: Nav2 writes True."""
    text = values[name].strip().lower()
    if text not in ('true', '1', 'false', '0'):
        raise ValueError(f'{name}:={values[name]}: must be true or false')
    return text in ('true', '1')


def _number(values, name):
    try:
        return float(values[name])
    except ValueError:
        raise ValueError(f'{name}:={values[name]}: must be a number') from None


def _parameters(values):
    """Files and values for the node; of several values of a name the last one holds."""
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
    if _is_simulated(values):
        more['use_sim_time'] = True
    return [*found, more] if more else found


def _end(event, context):
    """End the launch with the node; an exception gives it exit code 1, Shutdown alone gives 0."""
    if event.returncode and not context.is_shutdown:
        raise RuntimeError(f'{event.process_name} ended with exit code {event.returncode}')
    return Shutdown(reason='the node has ended')


def _is_simulated(values):
    return _boolean(values, 'use_sim_time') or bool(values['bag'])


def _rviz(values, namespace):
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        return LogInfo(msg='rviz2 is not installed: the node runs without it')
    # The topics of the displays, and where they are now.
    shown = {f'/{name}': values[name] for name in OUTPUTS}
    for name in OPTIONAL:
        shown[f'/ground_segmentation_node/{name}'] = f'{values["name"]}/{name}'
    file = SHARE / 'config' / 'ground_segmentation.rviz'
    return Node(
        package='rviz2',
        executable='rviz2',
        arguments=['-d', str(file), '-f', values['frame']],
        parameters=[{'use_sim_time': _is_simulated(values)}],
        remappings=[
            (topic, now if now.startswith('/') else f'{namespace}/{now}')
            for topic, now in shown.items()
        ],
    )


def _actions(context):
    values = {name: context.launch_configurations[name] for name, _, _ in ARGUMENTS}
    is_respawned = _boolean(values, 'respawn')
    namespace = values['namespace'].strip('/')
    actions = [
        Node(
            package='gp_ground_seg',
            executable='ground_segmentation_node',
            name=values['name'],
            namespace=namespace or None,
            parameters=_parameters(values),
            remappings=[('points', values['topic']), *((name, values[name]) for name in OUTPUTS)],
            ros_arguments=['--log-level', values['log_level']],
            output='screen',
            respawn=is_respawned,
            respawn_delay=_number(values, 'respawn_delay'),
            on_exit=None if is_respawned else _end,
        )
    ]
    if _boolean(values, 'rviz'):
        # A launch file around this one may have pushed a namespace.
        parts = context.launch_configurations.get('ros_namespace', '').strip('/'), namespace
        actions.append(_rviz(values, ''.join(f'/{part}' for part in parts if part)))
    if bag := values['bag']:
        command = ['ros2', 'bag', 'play', bag, '--clock', '--delay', '3']
        actions.append(ExecuteProcess(cmd=command, output='screen'))
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
