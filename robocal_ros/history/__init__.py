# SPDX-License-Identifier: Apache-2.0
"""The calibration history of a robot: proposed, decided, rolled back, never lost."""
