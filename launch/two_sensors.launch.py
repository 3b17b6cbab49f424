"""Two LiDARs, each with a node in a namespace: an example to copy and edit.

The outputs are /front/ground, /front/obstacles, /rear/ground and /rear/obstacles. A Nav2 costmap
takes all of them as sources; docs/node.md says when one node on merged clouds is the better way.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

NODE = Path(__file__).with_name('ground_segmentation.launch.py')

SENSORS = {
    'front': {'topic': '/lidar_front/points', 'params': '{sensor.height: 1.2}'},
    'rear': {'topic': '/lidar_rear/points', 'params': '{sensor.height: 0.6}'},
}


def generate_launch_description():
    """Return one group per sensor, so that the arguments of one are not those of the other."""
    return LaunchDescription(
        [
            GroupAction(
                [
                    IncludeLaunchDescription(
                        PythonLaunchDescriptionSource(str(NODE)),
                        launch_arguments={'namespace': name, **arguments}.items(),
                    )
                ]
            )
            for name, arguments in SENSORS.items()
        ]
    )
