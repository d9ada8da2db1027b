# SPDX-License-Identifier: Apache-2.0
"""Kinematic model of serial arms: forward kinematics, Jacobians, free parameters."""

from robocal_ros.kinematics.arm import ParameterSet, SerialArm

__all__ = ["ParameterSet", "SerialArm"]
