"""ROS 2: the only modules that import rclpy or message packages."""
