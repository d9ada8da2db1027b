"""The period of a stream of messages, and when a pause in it is more than that."""

from robocal_ros.correction import memory as of
from robocal_ros.correction.memory import Memory

LONGEST_GAP_S = 2.0 * of.LONGEST_PERIOD_S  # after which no stream goes on


class StreamPeriod:
    """Follows a stream by the steady clock; a pause begins after ``least_gap_s`` at the earliest.

    What it knows lies in the session's ``memory``.
    """

    def __init__(self, memory: Memory, least_gap_s: float) -> None:
        self._least_gap_s = least_gap_s
        self._times, self._counts = memory.times, memory.counts
        self._rings = memory.intervals, memory.arrivals

    @property
    def last_s(self) -> float:
        """When the last message came; NaN before the first, and after the stream's end."""
        return float(self._times[of.LAST])

    def note(self, now_s: float) -> None:
        """A message has come."""
        of.note_arrival(self._times, self._counts, *self._rings, now_s)

    @property
    def mean_s(self) -> float:
        """Mean of many intervals, which a stall and its burst leave as it is; NaN for too few."""
        return of.mean_period(self._counts, self._rings[1])

    def end(self) -> None:
        """The stream is over."""
        of.end_stream(self._times, self._counts)

    def goes_on(self, now_s: float) -> bool:
        """Whether a message now belongs to the stream: not after more than two periods."""
        return of.goes_on(self._times, self._least_gap_s, now_s)
