"""Two LiDARs, each with a node in a namespace: an example to copy and edit.

The outputs are /front/ground, /front/obstacles, /rear/ground and /rear/obstacles. A Nav2 costmap
takes all of them as sources; docs/node.md says when one node on merged clouds is the better way.
Arguments of ground_segmentation.launch.py that are not set here hold for both nodes; a bag is
played once.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

NODE = Path(__file__).with_name('ground_segmentation.launch.py')

SENSORS = {
    'front': {'topic': '/lidar_front/points', 'params': '{sensor.height: 1.2}'},
    'rear': {'topic': '/lidar_rear/points', 'params': '{sensor.height: 0.6}'},
}


def _nodes(context):
    """Return one group per sensor, so that the arguments of one are not those of the other."""
    groups = []
    for sensor, arguments in SENSORS.items():
        given = {name: LaunchConfiguration(f'{sensor}_{name}') for name in arguments}
        if groups and context.launch_configurations.get('bag'):
            # The first plays the bag; this one has its time.
            given.update(bag='', use_sim_time='true')
        node = IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(NODE)),
            launch_arguments={'namespace': sensor, **given}.items(),
        )
        groups.append(GroupAction([node]))
    return groups


def generate_launch_description():
    """Return the arguments front_topic, front_params, rear_topic, rear_params, and the nodes."""
    declared = [
        DeclareLaunchArgument(f'{sensor}_{name}', default_value=value)
        for sensor, arguments in SENSORS.items()
        for name, value in arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])
