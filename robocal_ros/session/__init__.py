# SPDX-License-Identifier: Apache-2.0
"""Stateful, clock-free objects: samples and commands in, estimates and events out."""
