# SPDX-License-Identifier: Apache-2.0
"""Where a sensor sits on the robot: line-laser profile sensors and cameras."""
