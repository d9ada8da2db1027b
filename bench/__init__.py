# SPDX-License-Identifier: Apache-2.0
"""Benchmarks: accuracy on real measurements, speed beside other libraries."""
