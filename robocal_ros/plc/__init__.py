# SPDX-License-Identifier: Apache-2.0
"""The cell as a PLC sees it by OPC UA."""
