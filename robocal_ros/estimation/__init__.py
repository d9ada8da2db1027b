# SPDX-License-Identifier: Apache-2.0
"""Least squares, observability, significance, and fits of shapes: once for all rooms."""
