"""Where a sensor sits on the robot: line-laser profile sensors and cameras."""
