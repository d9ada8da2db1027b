"""Least squares, observability, significance, and fits of shapes: once for all rooms."""
