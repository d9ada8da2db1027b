"""Messages of many blocks in one order: by log time, ties as they were recorded."""

import heapq
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from robocal_ros.bags.mcap_files import Block
from robocal_ros.bags.messages import Messages


class Stretch(NamedTuple):
    """Messages ``start`` to ``stop`` of a block of a file: none of another block lies between."""

    file: int
    messages: Messages
    start: int
    stop: int


# time of the next message, file, block's offset, place in the block, the block's messages
_Entry = tuple[int, int, int, int, Messages]


def in_order(
    blocks: Iterable[tuple[int, Block]], read: Callable[[int, Block], Messages | None]
) -> Iterator[Stretch]:
    """Merge blocks, each with the number of its file; one is in memory only while it is needed.

    ``read`` gives a block's messages in order of log time.
    """
    heap: list[_Entry] = []
    for start_ns, index, block in sorted((block.start_ns, index, block) for index, block in blocks):
        yield from _earlier(heap, start_ns)
        messages = read(index, block)
        if messages is not None and len(messages.log_time_ns):
            first_ns = int(messages.log_time_ns[0])
            heapq.heappush(heap, (first_ns, index, block.offset, 0, messages))
    yield from _earlier(heap, None)


def _earlier(heap: list[_Entry], before_ns: int | None) -> Iterator[Stretch]:
    """Take the messages before ``before_ns`` (None: all) off the heap, in order."""
    while heap and (before_ns is None or heap[0][0] < before_ns):
        _, index, offset, start, messages = heapq.heappop(heap)
        times = messages.log_time_ns
        stop = len(times)
        if before_ns is not None:
            stop = int(np.searchsorted(times, before_ns))
        if heap:
            other_ns, *other = heap[0][:3]
            ours_first = [index, offset] < other  # of equal times
            stop = min(stop, int(np.searchsorted(times, other_ns + ours_first)))
        if stop < len(times):
            heapq.heappush(heap, (int(times[stop]), index, offset, stop, messages))
        yield Stretch(index, messages, start, stop)
