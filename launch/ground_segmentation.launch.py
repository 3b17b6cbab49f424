"""Start the node, and RViz if asked for; with --show-args it prints its arguments.

ros2 launch gp_ground_seg ground_segmentation.launch.py topic:=/velodyne_points rviz:=true
"""

from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

SHARE = Path(get_package_share_directory('gp_ground_seg'))
OUTPUTS = ('ground', 'obstacles')
OPTIONAL = ('labeled', 'ground_model', 'markers')

ARGUMENTS = (
    ('topic', 'points', 'PointCloud2 topic of the LiDAR'),
    ('params_file', '', 'parameter file, or the name of one of config/: default, paper'),
    ('params', '{}', "more parameters, as YAML: '{sensor.height: 1.2, learning.mode: fixed}'"),
    ('namespace', '', 'namespace of the node and of its outputs'),
    ('use_sim_time', 'false', 'use the time of /clock: true or false'),
    ('rviz', 'false', 'start RViz beside it: true or false'),
    (
        'frame',
        'velo_link',
        'fixed frame of RViz: that of the clouds, or one that TF connects to it',
    ),
)


def _boolean(name, text):
    if text not in ('true', 'false'):
        raise RuntimeError(f'{name}:={text}: must be true or false')
    return text == 'true'


def _parameters(values):
    """Files and values for the node; of several values of a name the last one holds."""
    found = []
    if name := values['params_file']:
        preset = SHARE / 'config' / f'{name}.yaml'
        path = preset if preset.is_file() else Path(name).expanduser()
        if not path.is_file():
            raise RuntimeError(f'params_file:={name}: no such file')
        found.append(str(path))
    try:
        more = yaml.safe_load(values['params']) or {}
    except yaml.YAMLError:
        more = None
    if not isinstance(more, dict):
        raise RuntimeError(f"params:={values['params']}: must be YAML as '{{sensor.height: 1.2}}'")
    if _boolean('use_sim_time', values['use_sim_time']):
        more['use_sim_time'] = True
    return [*found, more] if more else found


def _nodes(context):
    values = {name: context.launch_configurations[name] for name, _, _ in ARGUMENTS}
    namespace = values['namespace'].strip('/')
    nodes = [
        Node(
            package='gp_ground_seg',
            executable='ground_segmentation_node',
            namespace=namespace or None,
            parameters=_parameters(values),
            remappings=[('points', values['topic'])],
            output='screen',
        )
    ]
    if _boolean('rviz', values['rviz']):
        shown = [f'/{name}' for name in OUTPUTS]
        shown += [f'/ground_segmentation_node/{name}' for name in OPTIONAL]
        nodes.append(
            Node(
                package='rviz2',
                executable='rviz2',
                arguments=[
                    '-d', str(SHARE / 'config' / 'ground_segmentation.rviz'), '-f', values['frame']
                ],
                remappings=[(name, f'/{namespace}{name}') for name in shown if namespace],
            )
        )  # fmt: skip
    return nodes


def generate_launch_description():
    """Return the arguments and what starts with them."""
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=description)
        for name, value, description in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])
