# SPDX-License-Identifier: Apache-2.0
"""What all nodes are made of: base, parameters, endpoints, QoS, diagnostics."""
