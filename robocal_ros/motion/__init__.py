"""Measuring motions: ways, timing, stops, watching the robot, the gap."""
