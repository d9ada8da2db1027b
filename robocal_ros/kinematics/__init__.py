"""Kinematic model of serial arms: forward kinematics, Jacobians, free parameters."""

from robocal_ros.kinematics.arm import SerialArm
from robocal_ros.kinematics.parameters import ParameterSet

__all__ = ["ParameterSet", "SerialArm"]
