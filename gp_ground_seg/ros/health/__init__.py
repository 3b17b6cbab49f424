"""How the node is: counts, judgements, statuses. Plain numbers and given times, no rclpy."""
