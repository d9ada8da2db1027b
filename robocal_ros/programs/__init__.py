# SPDX-License-Identifier: Apache-2.0
"""Programs that a robot's own controller runs: points corrected in the file, frames shifted."""
