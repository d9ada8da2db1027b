"""The period of a stream of messages, and when a pause in it is more than that."""

from collections import deque

INTERVALS = 9
ARRIVALS = 128  # more than the messages that a stall holds up, which then come in a burst
ENOUGH = 3
# Messages that are further apart are single ones: the robot may have been moved in between.
LONGEST_PERIOD_S = 1.0
LONGEST_GAP_S = 2.0 * LONGEST_PERIOD_S  # after which no stream goes on


class StreamPeriod:
    """Follows a stream by the steady clock; a pause begins after ``least_gap_s`` at the earliest.

    Attributes
    ----------
    last_s : when the last message came; None before the first, and after the stream's end.
    period_s : median of the last intervals; None while too few are known.
    """

    def __init__(self, least_gap_s: float) -> None:
        self._least_gap_s = least_gap_s
        self._intervals: deque[float] = deque(maxlen=INTERVALS)
        self._arrivals: deque[float] = deque(maxlen=ARRIVALS)
        self.last_s: float | None = None
        self.period_s: float | None = None

    def note(self, now_s: float) -> None:
        """A message has come."""
        interval = 0.0 if self.last_s is None else now_s - self.last_s
        self.last_s = now_s
        if interval > LONGEST_PERIOD_S:
            self._intervals.clear()
            self._arrivals.clear()
            self.period_s = None
        elif interval > 0.0:
            self._intervals.append(interval)
            if len(self._intervals) >= ENOUGH:
                self.period_s = sorted(self._intervals)[len(self._intervals) // 2]
        self._arrivals.append(now_s)

    @property
    def mean_s(self) -> float | None:
        """Mean of many intervals, which a stall and its burst leave as it is; None as above."""
        count = len(self._arrivals) - 1
        return None if count < ENOUGH else (self._arrivals[-1] - self._arrivals[0]) / count

    def end(self) -> None:
        """The stream is over."""
        self._intervals.clear()
        self._arrivals.clear()
        self.last_s = self.period_s = None

    def goes_on(self, now_s: float) -> bool:
        """Whether a message now belongs to the stream: not after more than two periods."""
        gap = max(self._least_gap_s, 2.0 * (self.period_s or 0.0))
        return self.last_s is not None and now_s - self.last_s <= gap
