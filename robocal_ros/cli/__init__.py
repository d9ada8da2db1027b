# SPDX-License-Identifier: Apache-2.0
"""The ``robocal`` command: works on files and bags, needs no ROS graph."""
