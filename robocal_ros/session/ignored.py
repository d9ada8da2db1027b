"""What a session did not use, by topic and reason."""

import re
from collections import Counter

MOST_REASONS = 30
_NUMBER = re.compile(r"(?<![\w.])-?\d[\d.]*(e[+-]?\d+)?")


def kind_of(reason: str) -> str:
    """The reason with '#' for its numbers, which do not tell reasons apart."""
    return _NUMBER.sub("#", reason)


class Ignored(dict[str, Counter[str]]):
    """Counts by topic and reason; numbers (put as '#') do not tell reasons apart."""

    def __init__(self) -> None:
        super().__init__()
        self._last: dict[tuple[str, str], str] = {}

    def add(self, topic: str, reason: str, count: int = 1) -> None:
        """Count samples that are not used."""
        counter = self.setdefault(topic, Counter())
        key = kind_of(reason)
        key = key if key in counter or len(counter) < MOST_REASONS else "other"
        counter[key] += count
        self._last[topic, key] = reason

    def listed(self) -> dict[str, str]:
        """All reasons with their counts and the latest words, as nodes show them."""
        return {
            f"{topic} ignored: {key}": f"{count}, last: {self._last[topic, key]}"
            for topic, counter in self.items()
            for key, count in counter.items()
        }

    def words(self) -> str:
        """Tell the most frequent reason of each topic; empty when nothing was ignored."""
        parts = [
            f"{counter.total()} of {topic} ({self._last[topic, counter.most_common(1)[0][0]]})"
            for topic, counter in self.items()
        ]
        return f"ignored: {', '.join(parts)}" if parts else ""
