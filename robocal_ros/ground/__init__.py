# SPDX-License-Identifier: Apache-2.0
"""What all rooms stand on: errors and codes, frames, samples, streams, files."""
