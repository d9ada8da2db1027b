# SPDX-License-Identifier: Apache-2.0
"""Samples as a bag gives them that is read in blocks."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from robocal_ros.ground.samples import JointBlock, JointSample


def in_blocks(samples: Sequence[Any], sizes: Sequence[int]) -> Iterator[Any]:
    """The same samples, those of the same joints together, at most as many as ``sizes`` say."""
    waiting: list[JointSample] = []
    turn = 0

    def together() -> Iterator[JointBlock]:
        if waiting:
            stamps = np.array([s.stamp_ns for s in waiting], dtype=np.int64)
            yield JointBlock(stamps, waiting[0].names, np.array([s.position for s in waiting]))
            waiting.clear()

    for sample in samples:
        joint = isinstance(sample, JointSample)
        if not joint or (waiting and waiting[0].names != sample.names):
            yield from together()
        if not joint:
            yield sample
            continue
        waiting.append(sample)
        if len(waiting) >= sizes[turn % len(sizes)]:
            yield from together()
            turn += 1
    yield from together()
