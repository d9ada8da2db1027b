# SPDX-License-Identifier: Apache-2.0
"""Thermal drift of the kinematic model."""
