# SPDX-License-Identifier: Apache-2.0
"""Measuring motions: ways, timing, stops, watching the robot, the gap."""
