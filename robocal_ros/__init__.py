# SPDX-License-Identifier: Apache-2.0
"""On-line accuracy maintenance for industrial robots."""

__version__ = "0.1.0"
