"""Two LiDARs, each with a node in a namespace: an example to copy and edit.

The outputs are /front/ground, /front/obstacles, /rear/ground and /rear/obstacles. A Nav2 costmap
takes all of them as sources; docs/node.md says when one node on merged clouds is the better way.
Arguments of ground_segmentation.launch.py that are not set here hold for both nodes.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

NODE = Path(__file__).with_name('ground_segmentation.launch.py')

SENSORS = {
    'front': {'topic': '/lidar_front/points', 'params': '{sensor.height: 1.2}'},
    'rear': {'topic': '/lidar_rear/points', 'params': '{sensor.height: 0.6}'},
}


def generate_launch_description():
    """Return one group per sensor, so that the arguments of one are not those of the other."""
    actions = []
    for sensor, arguments in SENSORS.items():
        # front_topic, front_params, rear_topic, rear_params
        for name, value in arguments.items():
            actions.append(DeclareLaunchArgument(f'{sensor}_{name}', default_value=value))
        # A bag is played once: beside this file.
        given = {name: LaunchConfiguration(f'{sensor}_{name}') for name in arguments}
        node = IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(NODE)),
            launch_arguments={'namespace': sensor, 'bag': '', **given}.items(),
        )
        actions.append(GroupAction([node]))
    return LaunchDescription(actions)
