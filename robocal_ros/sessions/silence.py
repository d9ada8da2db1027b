"""How long something was not heard."""

MOST_S = 0.05  # counted from one look to the next: more is a pause of the own process


class Silence:
    """Counts what passes between looks; pauses of the own process are nobody's silence."""

    def __init__(self) -> None:
        self._looked_s: float | None = None
        self.lasts_s = 0.0

    def heard(self, now_s: float) -> None:
        """It was heard now (steady clock)."""
        self._looked_s, self.lasts_s = now_s, 0.0

    def look(self, now_s: float) -> float:
        """How long it has not been heard."""
        if self._looked_s is not None:
            self.lasts_s += min(max(now_s - self._looked_s, 0.0), MOST_S)
        self._looked_s = now_s
        return self.lasts_s
