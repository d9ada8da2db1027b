"""Algorithms: numpy, scipy and numba only, importable without ROS."""
