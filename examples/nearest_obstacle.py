"""Print the nearest obstacle of each cloud that the node publishes.

While `gp-ground-seg node --ros-args -r points:=YOUR_TOPIC -p output.min_height:=0.2`
runs, start this; with --ros-args -r obstacles:=/NAMESPACE/obstacles if the node has a namespace.
"""

import signal
import threading

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.data.point_cloud2 import read_xyz


class NearestObstacle(Node):
    """Subscribes to ``obstacles``."""

    def __init__(self):
        super().__init__('nearest_obstacle')
        self.create_subscription(PointCloud2, 'obstacles', self.on_cloud, 5)

    def on_cloud(self, cloud):
        """Log range and bearing of the nearest point."""
        x, y, _ = read_xyz(cloud).T
        if len(x):
            nearest = np.argmin(np.hypot(x, y))
            reach, bearing = np.hypot(x, y)[nearest], np.degrees(np.arctan2(y, x)[nearest])
            self.get_logger().info(f'{reach:.2f} m away, {bearing:.0f} degrees to the left')


def main():
    """Run until Ctrl-C."""
    # A handler that raises, or that shuts rclpy down, does so within a call of rclpy.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stop = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    node = NearestObstacle()
    while not stop.is_set():
        rclpy.spin_once(node, timeout_sec=0.25)
    rclpy.shutdown()


if __name__ == '__main__':
    main()
