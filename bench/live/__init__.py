# SPDX-License-Identifier: Apache-2.0
"""A whole simulated cell alive: its nodes as processes over DDS, in real time, and its PLC."""
