"""Thermal drift of the kinematic model."""
