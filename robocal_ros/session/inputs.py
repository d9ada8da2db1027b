# SPDX-License-Identifier: Apache-2.0
"""What a session has of its inputs: what it did not use, what waits, what never came."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

Between = tuple[int, int]  # two stamps, ns


@dataclass(frozen=True)
class Heard:
    """What a session had of its inputs: a recorder may have heard more of them, or less.

    ``joints``: joint readings up to the command. ``lost``: by topic between which stamps nothing
    came since the command before, though something was sent.
    """

    joints: int
    lost: Mapping[str, Sequence[Between]] = field(default_factory=dict)


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

    def told(self) -> dict[str, dict[str, int]]:
        """By topic the latest words of each reason, with its count."""
        return {
            topic: {self._last[topic, key]: count for key, count in counter.items()}
            for topic, counter in self.items()
        }

    def words(self) -> str:
        """Tell the most frequent reason of each topic; empty when nothing was ignored."""
        parts = [
            f"{counter.total()} of {topic} ({self._last[topic, counter.most_common(1)[0][0]]})"
            for topic, counter in self.items()
        ]
        return f"ignored: {', '.join(parts)}" if parts else ""


AHEAD_NS = 1_000_000_000  # of the joints, when a sample arrives: more is another clock, or order


class Stamped(Protocol):
    """A sample with its time."""

    @property
    def stamp_ns(self) -> int:
        """Its stamp."""


T = TypeVar("T", bound=Stamped)


class AheadOfJoints(Generic[T]):
    """Samples stamped far ahead of the joints, which wait for these.

    None is refused for what came first: a recorder may hold topics in another order than they came
    to the session. One that another of its topic follows a second or more before it was wrong.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, list[T]] = {}

    def __bool__(self) -> bool:
        return any(self._waiting.values())

    def why(self, topic: str, sample: T, joints_ns: int, most: int) -> str:
        """Why a sample waits; empty: it does not, and is the caller's.

        ``joints_ns``: newest stamp of the joints, 0 before any. ``most``: so many wait of a topic,
        the latest.
        """
        waiting = self._waiting.setdefault(topic, [])
        while waiting and waiting[-1].stamp_ns > sample.stamp_ns + AHEAD_NS:
            waiting.pop()
        if joints_ns and sample.stamp_ns <= joints_ns + AHEAD_NS:
            return ""
        waiting.append(sample)
        del waiting[:-most]
        if not joints_ns:
            return "came before any joint states"
        ahead_s = (sample.stamp_ns - joints_ns) * 1e-9
        return f"is stamped {ahead_s:.1f} s ahead of the joint states: stamp both on one clock"

    def come(self, joints_ns: int) -> list[T]:
        """Samples that are near the joints now; they wait no more."""
        found: list[T] = []
        for waiting in self._waiting.values():
            while waiting and waiting[0].stamp_ns <= joints_ns + AHEAD_NS:
                found.append(waiting.pop(0))
        return found

    def clear(self) -> None:
        """Forget all."""
        self._waiting.clear()
