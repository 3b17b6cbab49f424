"""Start the node, and RViz if asked for; with --show-args it prints its arguments.

ros2 launch gp_ground_seg ground_segmentation.launch.py topic:=/velodyne_points rviz:=true
"""

import re
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

CONFIG = Path(get_package_share_directory('gp_ground_seg')) / 'config'
NODE = 'ground_segmentation_node'
RVIZ = CONFIG / 'ground_segmentation.rviz'

ARGUMENTS = (
    ('topic', 'points', 'PointCloud2 topic of the LiDAR'),
    ('params_file', str(CONFIG / 'default.yaml'), 'parameter file'),
    ('namespace', '', 'namespace of the node and of its outputs'),
    ('use_sim_time', 'false', 'use the time of /clock: true or false'),
    ('rviz', 'false', 'start RViz too: true or false'),
    ('frame', 'velo_link', 'fixed frame of RViz: that of the clouds, or one that TF knows'),
)


def generate_launch_description():
    """Return the arguments and what starts with them."""
    given = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    of_both = {
        'namespace': given['namespace'],
        'parameters': [{'use_sim_time': given['use_sim_time']}],
    }
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=description)
        for name, value, description in ARGUMENTS
    ]
    topics = dict.fromkeys(re.findall(r'Value: /(\w+\S*)', RVIZ.read_text(encoding='utf-8')))
    # First: where it is not installed, launch stops here, and leaves no node behind.
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        arguments=['-d', str(RVIZ), '-f', given['frame']],
        # A relative name is one in the namespace.
        remappings=[(f'/{topic}', topic) for topic in topics],
        condition=IfCondition(given['rviz']),
        **of_both,
    )
    node = Node(
        package='gp_ground_seg',
        executable=NODE,
        name=NODE,
        # A file that does not exist is an error of the node; launch would start it without.
        ros_arguments=['--params-file', given['params_file']],
        remappings=[('points', given['topic'])],
        output='screen',
        on_exit=Shutdown(reason='the node has ended'),
        **of_both,
    )
    return LaunchDescription([*declared, rviz, node])
