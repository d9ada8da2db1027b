"""ROS 2 nodes: the only part that imports rclpy and messages; no arithmetic lives here."""
