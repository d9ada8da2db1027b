# SPDX-License-Identifier: Apache-2.0
"""Identification of a robot's kinematic model from measured points or poses."""

from robocal_ros.identification.cell_model import CellModel, Part
from robocal_ros.identification.judged import (
    JudgedIdentification,
    identify_and_hold_out,
    identify_and_judge,
)
from robocal_ros.identification.solve import Identification, Method, identify

__all__ = [
    "CellModel",
    "Identification",
    "JudgedIdentification",
    "Method",
    "Part",
    "identify",
    "identify_and_hold_out",
    "identify_and_judge",
]
