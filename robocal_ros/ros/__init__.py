"""ROS 2 nodes: the only part that imports rclpy and messages; no arithmetic lives here."""

from robocal_ros.single_thread import use_one_thread

use_one_thread()
