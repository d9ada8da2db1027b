"""Measurements paired with the joints of the same instant, whatever order they arrive in."""

import re
from bisect import insort
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.errors import InputError
from robocal_ros.core.samples import JointSample, Measurements, PointSample, PoseSample
from robocal_ros.core.streams import JointStream, NotStillError, StandstillRule

Array = NDArray[np.float64]

JOINTS = "joint_states"
POINT = "measured_point"
POSE = "measured_pose"
JUMPS = "clock_jumps"

MOST_WAITING = 5000  # measurements that wait for joints: more means that no joints come
MOST_KEPT = 20000  # observations that no command has used
MOST_REASONS = 30
_NUMBER = re.compile(r"(?<![\w.])-?\d[\d.]*(e[+-]?\d+)?")


@dataclass(frozen=True, eq=False)
class Observation:
    """A measured target with the joints at that instant.

    ``ready_ns``: stamp of the joint reading that completed it; ``rotation`` None for a point.
    """

    stamp_ns: int
    ready_ns: int
    topic: str
    frame: str
    target: str
    q: Array
    position: Array
    rotation: Array | None


def _topic(sample: PointSample | PoseSample) -> str:
    return POINT if isinstance(sample, PointSample) else POSE


@dataclass
class ObservationDesk:
    """Pairs measurements with joint readings at standstill.

    Everything is decided by stamps: the same samples give the same observations however the
    topics interleave. ``ignored`` counts what was left out, by topic and reason.

    Attributes
    ----------
    frame : the measuring frame; None until the first observation that is used gives it.
    newest_ns : newest stamp of each topic.
    used_ns : observations up to this stamp were used.
    jumps : how often the clock jumped back.
    """

    joint_names: tuple[str, ...]
    rule: StandstillRule
    frame: str | None = None
    stream: JointStream = field(init=False)
    newest_ns: dict[str, int] = field(default_factory=dict)
    used_ns: int = -1
    jumps: int = 0
    received: Counter[str] = field(default_factory=Counter)
    ignored: dict[str, Counter[str]] = field(default_factory=dict)
    _complete_ns: int | None = None
    _pending: list[PointSample | PoseSample] = field(default_factory=list)
    _observed: list[Observation] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stream = JointStream(self.joint_names)

    @property
    def from_ns(self) -> int:
        """Stamp from which observations are complete and not yet used."""
        return max(self.used_ns + 1, self._complete_ns or 0)

    @property
    def marks(self) -> dict[str, int]:
        """How far the samples have come: newest stamp of each topic, and jumps of the clock."""
        return self.newest_ns | {JUMPS: self.jumps}

    def ignore(self, topic: str, reason: str, count: int = 1) -> None:
        """Count samples that are not used; numbers in the reason do not tell reasons apart."""
        counter = self.ignored.setdefault(topic, Counter())
        reason = _NUMBER.sub("#", reason)
        counter[reason if reason in counter or len(counter) < MOST_REASONS else "other"] += count

    def add_joints(self, sample: JointSample) -> None:
        """Take a joint reading; a clock that jumps back begins everything anew."""
        self.received[JOINTS] += 1
        if sample.stamp_ns <= 0:
            self.ignore(JOINTS, "no time stamp")
            return
        newest = self.stream.newest_ns
        try:
            self.stream.add(sample, int(self.rule.gap_s * 1e9))
        except InputError as error:
            self.ignore(JOINTS, str(error))
            return
        if newest is None or sample.stamp_ns < newest:
            self._begin(sample.stamp_ns)
        self.newest_ns[JOINTS] = sample.stamp_ns
        if self._pending:
            ready = next(
                (i for i, waiting in enumerate(self._pending) if not self._pair(waiting)),
                len(self._pending),
            )
            del self._pending[:ready]

    def _begin(self, first_ns: int) -> None:
        """Start at the first joint reading; what an earlier clock stamped means nothing now."""
        if self._complete_ns is not None:
            for topic, count in Counter(o.topic for o in self._observed).items():
                self.ignore(topic, "the clock jumped back", count)
            self._observed.clear()
            self._pending.clear()
            self.newest_ns.clear()
            self.jumps += 1
            self.used_ns = -1
        self._complete_ns = first_ns + int(self.rule.before_s * 1e9)

    def add_measurement(self, sample: PointSample | PoseSample) -> None:
        """Take a measured point or pose; its joints may come before or after it."""
        topic = _topic(sample)
        self.received[topic] += 1
        if sample.stamp_ns <= 0:
            self.ignore(topic, "no time stamp")
            return
        if self.frame is not None and sample.frame != self.frame:
            self._ignore_frame(topic, sample.frame)
            return
        self.newest_ns[topic] = max(sample.stamp_ns, self.newest_ns.get(topic, sample.stamp_ns))
        if not self._pair(sample):
            insort(self._pending, sample, key=lambda waiting: waiting.stamp_ns)
        if len(self._pending) > MOST_WAITING:
            # The latest: one stamped far ahead must not displace those whose joints come next.
            self.ignore(_topic(self._pending.pop()), "no joint readings came")

    def _ignore_frame(self, topic: str, frame: str) -> None:
        self.ignore(topic, f"frame '{frame}' is not the measuring frame '{self.frame}'")

    def _pair(self, sample: PointSample | PoseSample) -> bool:
        """Settle a measurement; False while its joints are to come."""
        topic = _topic(sample)
        try:
            reading = self.stream.standstill(sample.stamp_ns, self.rule)
        except NotStillError as error:
            self.ignore(topic, str(error))
            return True
        if reading is None:
            return False
        if isinstance(sample, PointSample):
            position, rotation = sample.position_m, None
        else:
            T = sample.T_frame_target
            position, rotation = T[:3, 3], T[:3, :3]
        self._observed.append(
            Observation(
                sample.stamp_ns, reading.ready_ns, topic, sample.frame, sample.target,
                reading.q, position, rotation,
            )
        )  # fmt: skip
        if len(self._observed) > MOST_KEPT:
            self.ignore(self._observed.pop(0).topic, "no command used it")
        return True

    def window(self, after_ns: int, until_ns: int, marks: Mapping[str, int]) -> list[Observation]:
        """Observations with ``after_ns < stamp <= until_ns`` made of samples up to ``marks``.

        Ordered by stamp and target. Of a target measured twice at one stamp the pose counts,
        else the first; the first observation gives the measuring frame where none is set.
        """
        joints = marks.get(JOINTS, -1)
        found = [
            o
            for o in self._observed
            if after_ns < o.stamp_ns <= until_ns
            and o.ready_ns <= joints
            and o.stamp_ns <= marks.get(o.topic, -1)
        ]
        found.sort(key=lambda o: (o.stamp_ns, o.target, o.topic != POSE))
        if found and self.frame is None:
            self.frame = found[0].frame
            for other in [o for o in self._observed if o.frame != self.frame]:
                self._ignore_frame(other.topic, other.frame)
            self._observed = [o for o in self._observed if o.frame == self.frame]
        once: dict[tuple[int, str], Observation] = {}
        for observation in found:
            if observation.frame == self.frame:
                once.setdefault((observation.stamp_ns, observation.target), observation)
        return list(once.values())

    def use(self, until_ns: int) -> None:
        """Drop observations up to a stamp: they were used."""
        self.used_ns = max(self.used_ns, until_ns)
        self._observed = [o for o in self._observed if o.stamp_ns > until_ns]


def as_measurements(observations: Sequence[Observation]) -> Measurements:
    """Arrays of observations; orientations only where all have one."""
    rotations = [o.rotation for o in observations if o.rotation is not None]
    complete = bool(observations) and len(rotations) == len(observations)
    several = len({o.target for o in observations}) > 1
    return Measurements(
        q=np.array([o.q for o in observations]),
        position=np.array([o.position for o in observations]),
        target=tuple(o.target for o in observations),
        sample=tuple(
            f"{o.stamp_ns}/{o.target}" if several else str(o.stamp_ns) for o in observations
        ),
        rotation=np.array(rotations) if complete else None,
        stamp_ns=np.array([o.stamp_ns for o in observations], dtype=np.int64),
    )
