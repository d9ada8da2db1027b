# SPDX-License-Identifier: Apache-2.0
"""MCAP bags in and out, the recorder, replay."""
