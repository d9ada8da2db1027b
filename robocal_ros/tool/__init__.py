# SPDX-License-Identifier: Apache-2.0
"""Where a tool's tip and axis are, from light barriers or from touches."""
