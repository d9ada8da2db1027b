"""What time it is on the clock of the samples."""


class DataClock:
    """The samples' clock, read between them too: ROS time runs on where they pause."""

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._read_ns = 0

    def at(self, newest_ns: int | None, now_ns: int) -> int:
        """Time of the samples' clock at ROS time ``now_ns``; that itself before the first."""
        if newest_ns is None:
            return now_ns
        if newest_ns != self._newest_ns:
            self._newest_ns, self._read_ns = newest_ns, now_ns
        return newest_ns + max(now_ns - self._read_ns, 0)
