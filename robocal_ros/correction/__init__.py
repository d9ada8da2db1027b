# SPDX-License-Identifier: Apache-2.0
"""Taught joints in, corrected ones out: on-line joint correction before the controller."""
