"""How long something was not heard."""

MOST_S = 0.05  # counted from one look to the next: more is a pause of the own process
CREDIT_S = 0.2  # at most so much is believed to be one


class Silence:
    """Counts what passes between looks; pauses of the own process are nobody's silence."""

    def __init__(self) -> None:
        self._looked_s: float | None = None
        self._heard_s = 0.0
        self._newest_ns = 0
        self.lasts_s = 0.0

    def heard_if_new(self, stamp_ns: int, now_s: float) -> None:
        """The newest reading has this stamp; one whose clock stands is no new reading."""
        if stamp_ns != self._newest_ns:
            self._newest_ns = stamp_ns
            self.heard(now_s)

    def heard(self, now_s: float) -> None:
        """It was heard now (steady clock)."""
        self._looked_s = self._heard_s = now_s
        self.lasts_s = 0.0

    def look(self, now_s: float) -> float:
        """How long it has not been heard."""
        if self._looked_s is not None:
            self.lasts_s += min(max(now_s - self._looked_s, 0.0), MOST_S)
            self.lasts_s = max(self.lasts_s, now_s - self._heard_s - CREDIT_S)
        self._looked_s = now_s
        return self.lasts_s
