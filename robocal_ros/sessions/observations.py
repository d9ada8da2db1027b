"""Measurements paired with the joints of the same instant, whatever order they arrive in."""

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


@dataclass(frozen=True, eq=False)
class Observation:
    """A measured target with the joints at that instant.

    ``ready_ns``: stamp of the joint reading that completed it; ``rotation`` None for a point.
    """

    stamp_ns: int
    ready_ns: int
    topic: str
    target: str
    q: Array
    position: Array
    rotation: Array | None


@dataclass
class ObservationDesk:
    """Pairs measurements with joint readings at standstill.

    Everything is decided by stamps: the same samples give the same observations however the
    topics interleave. ``ignored`` counts what was left out, by topic and reason.
    """

    joint_names: tuple[str, ...]
    rule: StandstillRule
    frame: str = ""
    stream: JointStream = field(init=False)
    newest_ns: dict[str, int] = field(default_factory=dict)
    received: Counter[str] = field(default_factory=Counter)
    ignored: dict[str, Counter[str]] = field(default_factory=dict)
    _pending: list[PointSample | PoseSample] = field(default_factory=list)
    _observed: list[Observation] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stream = JointStream(self.joint_names)

    def ignore(self, topic: str, reason: str) -> None:
        """Count a sample that is not used."""
        self.ignored.setdefault(topic, Counter())[reason] += 1

    def add_joints(self, sample: JointSample) -> None:
        """Take a joint reading."""
        self.received[JOINTS] += 1
        try:
            self.stream.add(sample, int(self.rule.gap_s * 1e9))
        except InputError as error:
            self.ignore(JOINTS, _reason(error))
            return
        self.newest_ns[JOINTS] = sample.stamp_ns
        if self._pending:
            self._pair()

    def add_measurement(self, sample: PointSample | PoseSample) -> None:
        """Take a measured point or pose; its joints may come before or after it."""
        topic = POINT if isinstance(sample, PointSample) else POSE
        self.received[topic] += 1
        self.frame = self.frame or sample.frame
        if sample.frame != self.frame:
            self.ignore(topic, f"frame '{sample.frame}' is not the measuring frame '{self.frame}'")
            return
        self.newest_ns[topic] = max(sample.stamp_ns, self.newest_ns.get(topic, sample.stamp_ns))
        self._pending.append(sample)
        self._pair()

    def _pair(self) -> None:
        waiting: list[PointSample | PoseSample] = []
        for sample in self._pending:
            topic = POINT if isinstance(sample, PointSample) else POSE
            try:
                reading = self.stream.standstill(sample.stamp_ns, self.rule)
            except NotStillError as error:
                self.ignore(topic, str(error))
                continue
            if reading is None:
                waiting.append(sample)
                continue
            if isinstance(sample, PointSample):
                position, rotation = sample.position_m, None
            else:
                T = sample.T_frame_target
                position, rotation = T[:3, 3], T[:3, :3]
            self._observed.append(
                Observation(
                    sample.stamp_ns, reading.ready_ns, topic, sample.target,
                    reading.q, position, rotation,
                )
            )  # fmt: skip
        self._pending = waiting

    def window(self, after_ns: int, until_ns: int, marks: Mapping[str, int]) -> list[Observation]:
        """Observations with ``after_ns < stamp <= until_ns`` made of samples up to ``marks``."""
        joints = marks.get(JOINTS, -1)
        found = [
            o
            for o in self._observed
            if after_ns < o.stamp_ns <= until_ns
            and o.ready_ns <= joints
            and o.stamp_ns <= marks.get(o.topic, -1)
        ]
        return sorted(found, key=lambda o: (o.stamp_ns, o.topic, o.target))

    def forget(self, until_ns: int) -> None:
        """Drop observations up to a stamp: they were used."""
        self._observed = [o for o in self._observed if o.stamp_ns > until_ns]


def _reason(error: InputError) -> str:
    """The message without its stamps, so that repeated ones count together."""
    return "stamp not after the newest one" if "is not after" in str(error) else str(error)


def as_measurements(observations: Sequence[Observation]) -> Measurements:
    """Arrays of observations; orientations only where all have one."""
    rotations = [o.rotation for o in observations if o.rotation is not None]
    complete = bool(observations) and len(rotations) == len(observations)
    return Measurements(
        q=np.array([o.q for o in observations]),
        position=np.array([o.position for o in observations]),
        target=tuple(o.target for o in observations),
        sample=tuple(str(o.stamp_ns) for o in observations),
        rotation=np.array(rotations) if complete else None,
        stamp_ns=np.array([o.stamp_ns for o in observations], dtype=np.int64),
    )
