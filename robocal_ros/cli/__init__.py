"""The ``robocal`` command: works on files and bags, needs no ROS graph."""
