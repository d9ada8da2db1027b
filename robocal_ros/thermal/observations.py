"""Measurements paired with the joints of the same instant, whatever order they arrive in."""

from bisect import bisect_right, insort
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import (
    JOINTS,
    JUMPS,
    MEASURED_POSE,
    MEASURING,
    REFERENCE_SPHERE,
    JointBlock,
    JointSample,
    PointSample,
    PoseSample,
)
from robocal_ros.ground.streams import JointStream, NotStillError, StandstillRule
from robocal_ros.session.ignored import Ignored
from robocal_ros.thermal.observation import Observation

Array = NDArray[np.float64]


MOST_WAITING = 5000  # measurements that wait for joints: more means that no joints come
MOST_KEPT = 20000  # observations that no command has used
LEAD_NS = 1_000_000_000  # a topic is at most so far ahead of another where the clock jumps
FAR_AHEAD_NS = 60_000_000_000  # a measurement stamped so much after the joints is an error


def _topic(sample: PointSample | PoseSample) -> str:
    return sample.topic if isinstance(sample, PointSample) else MEASURED_POSE


@dataclass
class ObservationDesk:
    """Pairs measurements with joint readings at standstill.

    Everything is decided by stamps: the same samples give the same observations however the
    topics interleave. ``ignored`` counts what was left out, by topic and reason.

    Attributes
    ----------
    frame : the measuring frame; None until the first observation that is used gives it.
    newest_ns : newest stamp of each topic, of a measurement once its joints are complete: one
        stamped in the future says nothing about how far its topic has come.
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
    ignored: Ignored = field(default_factory=Ignored)
    _complete_ns: int | None = None
    _left_ns: int | None = None
    _behind: deque[tuple[int, PointSample | PoseSample]] = field(
        default_factory=lambda: deque(maxlen=MOST_WAITING)
    )
    _pending: list[PointSample | PoseSample] = field(default_factory=list)
    _observed: list[Observation] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stream = JointStream(self.joint_names)

    @property
    def from_ns(self) -> int:
        """Stamp from which observations are complete and not yet used."""
        return max(self.used_ns + 1, self._complete_ns or 0)

    @property
    def clock_ns(self) -> int:
        """Newest stamp: of the joints, or of a measurement at most a second after them."""
        newest = self.newest_ns.get(JOINTS)
        if newest is None:
            return self._pending[-1].stamp_ns if self._pending else 0
        near = bisect_right(self._pending, newest + LEAD_NS, key=lambda sample: sample.stamp_ns)
        return max(newest, self._pending[near - 1].stamp_ns) if near else newest

    @property
    def marks(self) -> dict[str, int]:
        """How far the samples have come: newest stamp of each topic, and jumps of the clock."""
        return self.newest_ns | {JUMPS: self.jumps}

    def why_nothing(self) -> str:
        """Say why a window holds no observation."""
        had_joints = self.received[JOINTS] or JOINTS in self.ignored
        had_others = set(MEASURING) & (self.received.keys() | self.ignored.keys())
        if not had_joints:
            words = f"no joint states received: does the robot's driver publish {JOINTS}?"
        elif JOINTS not in self.newest_ns:
            words = "no joint state could be used"
        elif not had_others:
            words = f"no measurement received: does the sensor publish {' or '.join(MEASURING)}?"
        else:
            words = "no measurement with the robot at standstill since the last command"
        waiting = len(self._pending)
        parts = [words, f"{waiting} wait for later joint states" if waiting else ""]
        return "; ".join(part for part in (*parts, self.ignored.words()) if part)

    def add_joints(self, sample: JointSample) -> None:
        """Take a joint reading; a clock that jumps back begins everything anew."""
        self.received[JOINTS] += 1
        if sample.stamp_ns <= 0:
            self.ignored.add(JOINTS, "no time stamp")
            return
        left = self.stream.newest_ns
        try:
            added = self.stream.add(sample, int(self.rule.gap_s * 1e9))
        except InputError as error:
            self.ignored.add(JOINTS, str(error))
            return
        if added.lone_ns is not None:
            away = "" if left is None else f", {(added.lone_ns - left) * 1e-9:.3f} s off"
            self.ignored.add(JOINTS, f"a stamp that no reading goes on from{away}")
        if added.began_ns is not None:
            self._begin(added.began_ns, left)
        if self.stream.newest_ns is not None:
            self.newest_ns[JOINTS] = self.stream.newest_ns
            self._settle()

    def take_plain(self, block: JointBlock, start: int, before_ns: int | None) -> int:
        """Take the readings from ``start`` on with which nothing happens: how many these are.

        ``add_joints`` of each would do the same. The first one with which the clock may jump, or
        a measurement's joints are complete, or that is stamped ``before_ns`` or later, is left to
        the caller.
        """
        if self._pending:
            complete_ns = self._pending[0].stamp_ns + int(self.rule.after_s * 1e9)
            before_ns = complete_ns if before_ns is None else min(before_ns, complete_ns)
        count = self.stream.extend(block, start, before_ns, int(self.rule.gap_s * 1e9))
        if count:
            self.received[JOINTS] += count
            self.newest_ns[JOINTS] = int(block.stamp_ns[start + count - 1])
        return count

    def _settle(self) -> None:
        """Make observations of the waiting measurements whose joints are complete."""
        waiting = enumerate(self._pending)
        ready = next((i for i, sample in waiting if not self._pair(sample)), len(self._pending))
        del self._pending[:ready]

    def _begin(self, first_ns: int, left_ns: int | None) -> None:
        """Start at the first joint reading; what an earlier clock stamped means nothing now.

        Measurements of the new clock may have come a little before its joint readings.
        """
        self._complete_ns, self._left_ns = first_ns + int(self.rule.before_s * 1e9), left_ns
        if left_ns is None:
            return
        early = [sample for at_ns, sample in self._behind if at_ns > left_ns - LEAD_NS]
        known = {id(sample) for sample in early}
        lost = [o.source for o in self._observed if id(o.source) not in known] + self._pending
        for topic, count in Counter(map(_topic, lost)).items():
            self.ignored.add(topic, "the clock jumped back", count)
        self._observed.clear()
        self._behind.clear()
        self.newest_ns.clear()
        self.jumps += 1
        self.used_ns = -1
        self._pending = sorted(early, key=lambda sample: sample.stamp_ns)

    def add_measurement(self, sample: PointSample | PoseSample) -> None:
        """Take a measured point or pose; its joints may come before or after it."""
        topic = _topic(sample)
        self.received[topic] += 1
        if sample.stamp_ns <= 0:
            self.ignored.add(topic, "no time stamp")
            return
        if self.frame is not None and sample.frame != self.frame:
            self._ignore_frame(topic, sample.frame)
            return
        if self._of_the_clock_left(sample.stamp_ns):
            self.ignored.add(topic, "the clock jumped back")
            return
        newest = self.newest_ns.get(JOINTS)
        if newest is not None and sample.stamp_ns < newest - LEAD_NS:
            self._behind.append((newest, sample))
        if not self._pair(sample):
            insort(self._pending, sample, key=lambda waiting: waiting.stamp_ns)
        if len(self._pending) > MOST_WAITING:
            # The latest: one stamped far ahead must not displace those whose joints come next.
            self.ignored.add(_topic(self._pending.pop()), "no joint readings came")

    def _of_the_clock_left(self, stamp_ns: int) -> bool:
        """Whether a late stamp is from just before the clock jumped back."""
        newest, left = self.newest_ns.get(JOINTS), self._left_ns
        if newest is None or left is None or newest > left - 2 * LEAD_NS:
            return False
        return abs(stamp_ns - left) <= LEAD_NS

    def _ignore_frame(self, topic: str, frame: str) -> None:
        self.ignored.add(topic, f"frame '{frame}' is not the measuring frame '{self.frame}'")

    def _pair(self, sample: PointSample | PoseSample) -> bool:
        """Settle a measurement; False while its joints are to come."""
        topic = _topic(sample)
        try:
            reading = self.stream.standstill(sample.stamp_ns, self.rule)
        except NotStillError as error:
            self._came(topic, sample.stamp_ns)
            self.ignored.add(topic, str(error))
            return True
        if reading is None:
            return False
        self._came(topic, sample.stamp_ns)
        if isinstance(sample, PointSample):
            position, rotation = sample.position_m, None
        else:
            T = sample.T_frame_target
            position, rotation = T[:3, 3], T[:3, :3]
        self._observed.append(
            Observation(
                sample.stamp_ns, reading.ready_ns, topic, sample.frame, sample.target,
                reading.q, position, rotation, sample,
            )
        )  # fmt: skip
        if len(self._observed) > MOST_KEPT:
            self.ignored.add(self._observed.pop(0).topic, "no command used it")
        return True

    def _came(self, topic: str, stamp_ns: int) -> None:
        self.newest_ns[topic] = max(stamp_ns, self.newest_ns.get(topic, stamp_ns))

    def drop_far_ahead(self) -> None:
        """Give up waiting measurements stamped a minute or more after the newest joints."""
        newest = self.newest_ns.get(JOINTS)
        while newest is not None and self._pending:
            ahead_ns = self._pending[-1].stamp_ns - newest
            if ahead_ns < FAR_AHEAD_NS:
                return
            topic = _topic(self._pending.pop())
            self.ignored.add(
                topic, f"stamped {ahead_ns * 1e-9:.0f} s after the newest joint reading"
            )

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
        found.sort(key=lambda o: (o.stamp_ns, o.target, o.topic != MEASURED_POSE))
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

    @property
    def latest_ns(self) -> int:
        """Stamp of the latest unused observation; 0 without."""
        return max((o.stamp_ns for o in self.unused(self.from_ns)), default=0)

    def unused(self, from_ns: int) -> list[Observation]:
        """Observations of targets on the flange, from a stamp on, that no command has used."""
        return [o for o in self._observed if o.stamp_ns >= from_ns and o.topic != REFERENCE_SPHERE]

    def last_run_ns(self, pause_ns: int) -> int:
        """Stamp from which the unused observations follow each other without so long a pause."""
        stamps = sorted(o.stamp_ns for o in self.unused(self.from_ns))
        pauses = [i for i in range(1, len(stamps)) if stamps[i] - stamps[i - 1] > pause_ns]
        return stamps[pauses[-1]] if pauses else self.from_ns

    def use(self, until_ns: int) -> None:
        """Drop observations up to a stamp: they were used."""
        self.used_ns = max(self.used_ns, until_ns)
        self._observed = [o for o in self._observed if o.stamp_ns > until_ns]
