"""Measurements paired with the joints of the same instant, whatever order they arrive in."""

from bisect import bisect_right, insort
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import ConflictError, InputError, TooFewSamplesError
from robocal_ros.ground.proposals import THERMAL, Entry
from robocal_ros.ground.samples import (
    JOINTS,
    JUMPS,
    MEASURED_POSE,
    MEASURING,
    REFERENCE_SPHERE,
    JointBlock,
    JointSample,
    Measurements,
    PointSample,
    PoseSample,
    TemperatureSample,
)
from robocal_ros.ground.streams import JointStream, NotStillError, StandstillRule
from robocal_ros.session import events
from robocal_ros.session.base import Ignored
from robocal_ros.session.events import Command, History
from robocal_ros.thermal.drift_following import InForce, ThermalConfig

Array = NDArray[np.float64]


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
    source: PointSample | PoseSample

    @property
    def sigma_m(self) -> float:
        """Standard deviation of a coordinate from the measurement itself; 0 where not known."""
        return self.source.sigma_m if isinstance(self.source, PointSample) else 0.0


def one_per_visit(observations: Sequence[Observation], same_rad: float) -> list[Observation]:
    """Average what was measured of a target while the robot stood at one posture.

    However often it was measured there, a visit shows the robot's repeatability once.
    ``observations`` in order of their stamps; ``same_rad``: joints that move less stand still.
    """
    visits: list[dict[str, list[Observation]]] = []
    first: Observation | None = None
    for one in observations:
        if first is None or np.max(np.abs(one.q - first.q)) > same_rad:
            first = one
            visits.append({})
        visits[-1].setdefault(one.target, []).append(one)
    return [_averaged(several) for visit in visits for several in visit.values()]


def _averaged(several: Sequence[Observation]) -> Observation:
    last = several[-1]
    if len(several) == 1:
        return last
    position = np.mean([o.position for o in several], axis=0)
    sigma_m = float(np.sqrt(np.mean([o.sigma_m**2 for o in several]) / len(several)))
    return replace(
        last,
        q=np.mean([o.q for o in several], axis=0),
        position=position,
        source=PointSample(last.stamp_ns, last.frame, last.target, position, last.topic, sigma_m),
    )


def as_measurements(
    observations: Sequence[Observation], sigma_m: float | None = None
) -> Measurements:
    """Arrays of observations; orientations only where all have one.

    ``sigma_m``: standard deviation of a coordinate of one visit, to which each measurement's own
    is added; None where the noise is to be found.
    """
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
        sigma=None if sigma_m is None else np.hypot(sigma_m, [o.sigma_m for o in observations]),
        stamp_ns=np.array([o.stamp_ns for o in observations], dtype=np.int64),
    )


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


TIME_OUT = "time-out"
REMEMBERED = 200  # calibrations back to which a cycle's id is known


@dataclass
class OpenCycle:
    """The open cycle.

    Attributes
    ----------
    id : its name; empty while none is open.
    begun_ns : stamp at which it began.
    postponed_ns : stamp at which it could not be kept; its time-out begins anew there.
    """

    id: str = ""
    begun_ns: int = 0
    postponed_ns: int = 0

    def begin(self, cycle_id: str, stamp_ns: int, history: History) -> str:
        """Open a cycle and say so; one that is open already goes on, another one is broken off.

        Raises
        ------
        ConflictError
            When a cycle of this id has ended.
        """
        if self.id == cycle_id:
            return f"cycle '{cycle_id}' is open already"
        if ended(cycle_id, history) is not None:
            raise ConflictError(
                f"cycle '{cycle_id}' has ended already: give each cycle an id of its own"
            )
        broken = f"; cycle '{self.id}' is broken off" if self.id else ""
        self.id, self.begun_ns = cycle_id, stamp_ns
        return f"cycle '{cycle_id}' is open{broken}"

    def close(self) -> None:
        """No cycle is open any more."""
        self.id = ""


def ended(cycle_id: str, history: History) -> Entry | None:
    """The calibration that a cycle of this id gave, the latest of them; None without."""
    entries = (e for e in history.list(REMEMBERED) if e.kind == THERMAL and e.cycle_id == cycle_id)
    return next(entries, None)


OTHER_POSE = "measured at a pose that the cold reference lacks"


@dataclass(frozen=True, eq=False)
class Beside:
    """What was measured beside the targets.

    ``fixed`` (n, 3): centres of a sphere fixed in the cell, m; ``temperatures``: stamps and
    temperatures (n,) of all motors since the last cycle, degrees Celsius; ``temperature`` (n,):
    those of that time, None where they are not known.
    """

    fixed: Array
    temperatures: Sequence[tuple[int, Array]]
    temperature: Array | None


class Windows:
    """Takes the observations of a command from the desk."""

    def __init__(
        self, desk: ObservationDesk, cycle: OpenCycle, current: InForce, config: ThermalConfig
    ) -> None:
        self._desk, self._cycle, self._current, self._config = desk, cycle, current, config
        self._pause_ns = int(config.cycle_timeout_s * 1e9)

    def from_ns(self, command: Command) -> int:
        """Stamp of the first measurement that counts: a cycle holds no pause of its time-out."""
        calibrates = self._current.reference is None or command.name in events.SET_UP
        if calibrates or self._cycle.id:
            return self._desk.from_ns
        return self._desk.last_run_ns(self._pause_ns)

    def of(self, command: Command) -> tuple[Measurements, Array]:
        """Targets on the flange, and centres (n, 3) of a sphere fixed in the cell.

        Raises
        ------
        TooFewSamplesError
            When nothing was measured.
        InputError
            When a cycle holds no pose of the cold reference.
        """
        desk, sets_up = self._desk, command.name in events.SET_UP
        desk.drop_far_ahead()
        after = int(command.arguments.get("from_ns", desk.from_ns)) - 1
        observed = desk.window(after, command.stamp_ns or 0, command.marks or {})
        fixed = [o.position for o in observed if o.topic == REFERENCE_SPHERE]
        found = [o for o in observed if o.topic != REFERENCE_SPHERE]
        if not found:
            raise TooFewSamplesError(desk.why_nothing())
        drift = self._current.reference is not None and not sets_up
        if drift or sets_up:
            found = one_per_visit(found, self._config.standstill.tolerance_rad)
        if drift:
            found = self._at_cold_poses(found)
        last = int(command.arguments.get("samples", 0))
        sigma_m = self._config.sigma_m if drift else None  # a calibration finds its noise itself
        data = as_measurements(found[-last:] if last else found, sigma_m)
        return data, np.array(fixed).reshape(-1, 3)

    def overdue(self) -> Command | None:
        """The command that ends a cycle in which nothing came for its time-out, or None.

        Without ``begin_cycle`` a cycle is what follows each other without such a pause, at half
        of the cold reference's poses or more.
        """
        desk, cycle = self._desk, self._cycle
        last_ns = max(desk.latest_ns, cycle.begun_ns if cycle.id else 0)
        due_ns = max(last_ns, cycle.postponed_ns) + self._pause_ns
        if not last_ns or desk.newest_ns.get(JOINTS, 0) <= due_ns:
            return None
        if not cycle.id and not self._half_visited():
            return None
        return Command(events.END_CYCLE, {"by": TIME_OUT}, due_ns)

    def progress(self) -> tuple[int, int]:
        """How many poses of the cold reference were visited in this cycle, and of how many."""
        reference, desk = self._current.reference, self._desk
        if reference is None:
            return 0, 0
        start = desk.from_ns if self._cycle.id else desk.last_run_ns(self._pause_ns)
        q = [o.q for o in desk.unused(start)]
        return len(reference.spots.visited(np.array(q))), reference.spots.poses

    def _half_visited(self) -> bool:
        visited, poses = self.progress()
        return poses > 0 and 2 * visited >= poses

    def _at_cold_poses(self, found: list[Observation]) -> list[Observation]:
        """Those at a pose of the cold reference; that of another pose shows no drift."""
        if self._current.reference is None:
            return found
        known = self._current.reference.spots.knows(np.array([o.q for o in found]))
        for other in (o for o, at_one in zip(found, known, strict=True) if not at_one):
            self._desk.ignored.add(other.topic, OTHER_POSE)
        if not np.any(known):
            raise InputError(
                f"none of the {len(found)} measured poses was measured in the cold reference: "
                "visit the reference poses, or capture a new reference"
            )
        return [o for o, at_one in zip(found, known, strict=True) if at_one]


EVERY_NS = 10_000_000_000  # of a joint's samples within ten seconds the first one counts
SILENT_NS = 900_000_000_000  # a temperature says nothing any more after a quarter of an hour
MOST_INTERVALS = 20_000  # of those ten seconds: more than two days


class MotorTemperatures:
    """All joints' temperatures, whatever order they arrive in.

    Attributes
    ----------
    newest_ns : newest stamp; None before the first.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._place = {name: i for i, name in enumerate(names)}
        self._kept: dict[int, dict[int, TemperatureSample]] = {}
        self.newest_ns: int | None = None

    def add(self, sample: TemperatureSample) -> None:
        """Take a joint's temperature.

        Raises
        ------
        InputError
            When the robot has no such joint.
        """
        if sample.joint not in self._place:
            raise InputError(
                f"temperature of '{sample.joint}': frame_id must be a joint's name, one of "
                f"{', '.join(self._place)}"
            )
        joint, ten = self._place[sample.joint], sample.stamp_ns // EVERY_NS
        first = self._kept.setdefault(ten, {}).setdefault(joint, sample)
        if sample.stamp_ns < first.stamp_ns:
            self._kept[ten][joint] = sample
        self.newest_ns = max(sample.stamp_ns, self.newest_ns or sample.stamp_ns)
        if len(self._kept) > MOST_INTERVALS:
            for old in sorted(self._kept)[: MOST_INTERVALS // 2]:
                del self._kept[old]

    def between(self, after_ns: int, until_ns: int) -> list[tuple[int, Array]]:
        """Stamps and temperatures (n,), degrees Celsius, after one stamp and up to another.

        None where a joint has been silent for a quarter of an hour.
        """
        stamp = np.full(len(self._place), -SILENT_NS, dtype=np.int64)
        celsius = np.full(len(self._place), np.nan)
        first, last = (after_ns - SILENT_NS) // EVERY_NS, until_ns // EVERY_NS
        found = []
        for ten in sorted(t for t in self._kept if first <= t <= last):
            known = {j: s for j, s in self._kept[ten].items() if s.stamp_ns <= until_ns}
            for joint, sample in known.items():
                stamp[joint], celsius[joint] = sample.stamp_ns, sample.celsius
            now_ns = max((s.stamp_ns for s in known.values()), default=after_ns)
            if now_ns > after_ns and now_ns - int(stamp.min()) < SILENT_NS:
                found.append((now_ns, celsius.copy()))
        return found

    def at(self, stamp_ns: int) -> Array | None:
        """Temperatures (n,) at a stamp; None where they are not known."""
        found = self.between(stamp_ns - SILENT_NS, stamp_ns)
        return found[-1][1] if found else None
