# SPDX-License-Identifier: Apache-2.0
"""Measurements paired with the joints of the same instant, whatever order they arrive in.

On its way to the model a measurement is a `PointSample` as it was read, an `Observation` with the
joints of its instant, and a row of the `Measurements` that an estimator takes.
"""

from bisect import bisect_right, insort
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from robocal_ros.estimation.assessment import pose_groups
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RobocalError, TooFewSamplesError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import (
    JOINTS,
    JUMPS,
    MEASURED_POSE,
    MEASURING,
    REFERENCE_SPHERE,
    JointBlock,
    JointSample,
    JointStream,
    Measurements,
    NotStillError,
    PointSample,
    StandstillRule,
    TemperatureSample,
    cloud_points,
    stamp_ns,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.session import events
from robocal_ros.session.events import Command
from robocal_ros.session.inputs import Ignored
from robocal_ros.thermal.drift_following import InForce
from robocal_ros.thermal.reference import SAME_VISIT_RAD

MOST_WAITING = 5000  # measurements that wait for joints: more means that no joints come
MOST_KEPT = 20000  # observations that no command has used
LEAD_NS = 1_000_000_000  # a topic is at most so far ahead of another where the clock jumps
FAR_AHEAD_NS = 60_000_000_000  # a measurement stamped so much after the joints is an error
EVERY_NS = 10_000_000_000  # of a motor's temperatures within ten seconds the first one counts
SILENT_NS = 900_000_000_000  # a temperature says nothing any more after a quarter of an hour
MOST_INTERVALS = 20_000  # of those ten seconds: more than two days
TIME_OUT = "time-out"
OTHER_POSE = "measured at a pose where the cold reference lacks it"


@dataclass(frozen=True, eq=False)
class Observation:
    """A measured target with the joints ``q`` (n,) at that instant.

    ``ready_ns``: stamp of the joint reading that completed it.
    ``side`` (n,): which way each joint went last, see `JointStream.side`.
    """

    sample: PointSample
    q: Array
    ready_ns: int
    side: Array


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
        visits[-1].setdefault(one.sample.target, []).append(one)
    found = []
    for several in (several for visit in visits for several in visit.values()):
        last = several[-1]
        if len(several) > 1:
            samples = [o.sample for o in several]
            sigma_m = float(np.sqrt(np.mean([s.sigma_m**2 for s in samples]) / len(samples)))
            position_m = np.mean([s.position_m for s in samples], axis=0)
            sample = replace(last.sample, position_m=position_m, sigma_m=sigma_m)
            last = replace(last, q=np.mean([o.q for o in several], axis=0), sample=sample)
        found.append(last)
    return found


def as_measurements(
    observations: Sequence[Observation], sigma_m: float | None = None
) -> Measurements:
    """Arrays of observations; orientations only where all have one.

    ``sigma_m``: standard deviation of a coordinate of one visit, to which each measurement's own
    is added; None where the noise is to be found.
    """
    samples = [o.sample for o in observations]
    rotations = [s.rotation for s in samples if s.rotation is not None]
    complete = bool(samples) and len(rotations) == len(samples)
    several = len({s.target for s in samples}) > 1
    return Measurements(
        q=np.array([o.q for o in observations]),
        position=np.array([s.position_m for s in samples]),
        target=tuple(s.target for s in samples),
        sample=tuple(f"{s.stamp_ns}/{s.target}" if several else str(s.stamp_ns) for s in samples),
        rotation=np.array(rotations) if complete else None,
        sigma=None if sigma_m is None else np.hypot(sigma_m, [s.sigma_m for s in samples]),
        stamp_ns=np.array([s.stamp_ns for s in samples], dtype=np.int64),
        side=np.array([o.side for o in observations]),
    )


@dataclass
class ObservationDesk:
    """Pairs measurements with joint readings at standstill.

    Everything is decided by stamps: the same samples give the same observations however the
    topics interleave. ``ignored`` counts what was left out, by topic and reason.

    ``frame``: the measuring frame; None until the first observation that is used gives it.
    ``newest_ns``: newest stamp of each topic, of a measurement once its joints are complete: one
    stamped in the future says nothing about how far its topic has come. ``used_ns``: observations
    up to this stamp were used. ``jumps``: how often the clock jumped back.
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
    _behind: deque[tuple[int, PointSample]] = field(
        default_factory=lambda: deque(maxlen=MOST_WAITING)
    )
    _pending: list[PointSample] = field(default_factory=list)
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
            waiting = enumerate(self._pending)
            ready = next((i for i, s in waiting if not self._pair(s)), len(self._pending))
            del self._pending[:ready]

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

    def _begin(self, first_ns: int, left_ns: int | None) -> None:
        """Start at the first joint reading; what an earlier clock stamped means nothing now.

        Measurements of the new clock may have come a little before its joint readings.
        """
        self._complete_ns, self._left_ns = first_ns + int(self.rule.before_s * 1e9), left_ns
        if left_ns is None:
            return
        early = [sample for at_ns, sample in self._behind if at_ns > left_ns - LEAD_NS]
        known = {id(sample) for sample in early}
        lost = [o.sample for o in self._observed if id(o.sample) not in known] + self._pending
        for topic, count in Counter(sample.topic for sample in lost).items():
            self.ignored.add(topic, "the clock jumped back", count)
        self._observed.clear()
        self._behind.clear()
        self.newest_ns.clear()
        self.jumps += 1
        self.used_ns = -1
        self._pending = sorted(early, key=lambda sample: sample.stamp_ns)

    def add_measurement(self, sample: PointSample) -> None:
        """Take a measured point or pose; its joints may come before or after it."""
        topic, stamp_ns = sample.topic, sample.stamp_ns
        self.received[topic] += 1
        if stamp_ns <= 0:
            self.ignored.add(topic, "no time stamp")
            return
        if self.frame is not None and sample.frame != self.frame:
            self._ignore_frame(sample)
            return
        newest, left = self.newest_ns.get(JOINTS), self._left_ns
        jumped = newest is not None and left is not None and newest <= left - 2 * LEAD_NS
        if jumped and left is not None and abs(stamp_ns - left) <= LEAD_NS:
            self.ignored.add(topic, "the clock jumped back")  # late, from just before that
            return
        if newest is not None and stamp_ns < newest - LEAD_NS:
            self._behind.append((newest, sample))
        if not self._pair(sample):
            insort(self._pending, sample, key=lambda waiting: waiting.stamp_ns)
        if len(self._pending) > MOST_WAITING:
            # The latest: one stamped far ahead must not displace those whose joints come next.
            self.ignored.add(self._pending.pop().topic, "no joint readings came")

    def _ignore_frame(self, sample: PointSample) -> None:
        words = f"frame '{sample.frame}' is not the measuring frame '{self.frame}'"
        self.ignored.add(sample.topic, words)

    def _pair(self, sample: PointSample) -> bool:
        """Settle a measurement; False while its joints are to come."""
        topic, stamp_ns = sample.topic, sample.stamp_ns
        refused = ""
        try:
            reading = self.stream.standstill(stamp_ns, self.rule)
        except NotStillError as error:
            reading, refused = None, str(error)
        if reading is None and not refused:
            return False
        self.newest_ns[topic] = max(stamp_ns, self.newest_ns.get(topic, stamp_ns))
        if reading is None:
            self.ignored.add(topic, refused)
            return True
        self._observed.append(
            Observation(
                sample, reading.q, reading.ready_ns, self.stream.side(stamp_ns, self.rule.gap_s)
            )
        )
        if len(self._observed) > MOST_KEPT:
            self.ignored.add(self._observed.pop(0).sample.topic, "no command used it")
        return True

    def drop_far_ahead(self) -> None:
        """Give up waiting measurements stamped a minute or more after the newest joints."""
        newest = self.newest_ns.get(JOINTS)
        while newest is not None and self._pending:
            ahead_ns = self._pending[-1].stamp_ns - newest
            if ahead_ns < FAR_AHEAD_NS:
                return
            words = f"stamped {ahead_ns * 1e-9:.0f} s after the newest joint reading"
            self.ignored.add(self._pending.pop().topic, words)

    def window(self, after_ns: int, until_ns: int, marks: Mapping[str, int]) -> list[Observation]:
        """Observations with ``after_ns < stamp <= until_ns`` made of samples up to ``marks``.

        Ordered by stamp and target. Of a target measured twice at one stamp the pose counts,
        else the first; a sphere that is fixed in the cell is no such target, whatever its name.
        The first observation gives the measuring frame where none is set.
        """
        joints = marks.get(JOINTS, -1)
        found = [
            o
            for o in self._observed
            if after_ns < o.sample.stamp_ns <= until_ns
            and o.ready_ns <= joints
            and o.sample.stamp_ns <= marks.get(o.sample.topic, -1)
        ]
        found.sort(
            key=lambda o: (o.sample.stamp_ns, o.sample.target, o.sample.topic != MEASURED_POSE)
        )
        if found and self.frame is None:
            self.frame = found[0].sample.frame
            for other in [o.sample for o in self._observed if o.sample.frame != self.frame]:
                self._ignore_frame(other)
            self._observed = [o for o in self._observed if o.sample.frame == self.frame]
        once: dict[tuple[int, str, bool], Observation] = {}
        for observation in found:
            sample = observation.sample
            if sample.frame == self.frame:
                fixed = sample.topic == REFERENCE_SPHERE
                once.setdefault((sample.stamp_ns, sample.target, fixed), observation)
        return list(once.values())

    def unused(self, from_ns: int) -> list[Observation]:
        """Observations of targets on the flange, from a stamp on, that no command has used."""
        return [
            o
            for o in self._observed
            if o.sample.stamp_ns >= from_ns and o.sample.topic != REFERENCE_SPHERE
        ]

    def last_run_ns(self, pause_ns: int) -> int:
        """Stamp from which the unused observations follow each other without so long a pause."""
        stamps = sorted(o.sample.stamp_ns for o in self.unused(self.from_ns))
        pauses = [i for i in range(1, len(stamps)) if stamps[i] - stamps[i - 1] > pause_ns]
        return stamps[pauses[-1]] if pauses else self.from_ns

    def use(self, until_ns: int) -> None:
        """Drop observations up to a stamp: they were used."""
        self.used_ns = max(self.used_ns, until_ns)
        self._observed = [o for o in self._observed if o.sample.stamp_ns > until_ns]


@dataclass
class OpenCycle:
    """The measuring cycle that is open; ``id`` is empty while none is.

    ``begun_ns``: stamp at which it began; ``postponed_ns``: at which it could not be kept, and its
    time-out begins anew.
    """

    id: str = ""
    begun_ns: int = 0
    postponed_ns: int = 0


@dataclass(frozen=True, eq=False)
class Beside:
    """What was measured beside the targets.

    ``fixed`` (n, 3): centres of a sphere fixed in the cell, m; ``temperatures``: stamps and
    temperatures (n,) of all motors since the last cycle, degrees Celsius; ``temperature`` (n,):
    those of that time, None where they are not known; ``silent``: joints of which none is.
    """

    fixed: Array
    temperatures: Sequence[tuple[int, Array]]
    temperature: Array | None
    silent: tuple[str, ...]


class Windows:
    """Which observations belong to a command, and when a cycle ends by itself."""

    def __init__(self, desk: ObservationDesk, cycle: OpenCycle, current: InForce) -> None:
        self._desk, self._cycle, self._current = desk, cycle, current
        self._config = config = current.config
        self._pause_ns = int(config.cycle_timeout_s * 1e9)
        self._span_ns = int(config.cycle_span_s * 1e9)

    def _cycle_ns(self) -> int:
        """Stamp from which measurements belong to a cycle: it holds no pause of its time-out."""
        return self._desk.from_ns if self._cycle.id else self._desk.last_run_ns(self._pause_ns)

    def from_ns(self, command: Command) -> int:
        """Stamp of the first measurement that counts.

        A calibration takes all that no command has used; a cold visit is one, as a cycle is: what
        was measured before a pause may be of a warm robot.
        """
        calibrates = command.name == events.CALIBRATE_SENSOR or (
            self._current.reference is None and command.name != events.CAPTURE_REFERENCE
        )
        return self._desk.from_ns if calibrates else self._cycle_ns()

    def left_out(self, from_ns: int) -> str:
        """Say what of the unused was measured before the pause that ended at a stamp; or nothing.

        Named are poses not visited since: a run that a stop has parted is no whole cold visit.
        """
        from scipy.spatial import cKDTree

        unused = self._desk.unused(self._desk.from_ns)
        before = [o for o in unused if o.sample.stamp_ns < from_ns]
        if not before:
            return ""
        pause = f"a pause of over {self._config.cycle_timeout_s:g} s"
        words = f"; left out: {len(before)} measurements before {pause}"
        visits = one_per_visit(before, self._config.standstill.tolerance_rad)
        early = np.array([o.q for o in visits])
        since = cKDTree([o.q for o in unused if o.sample.stamp_ns >= from_ns])
        lost = early[since.query(early, p=np.inf)[0] >= SAME_VISIT_RAD]
        if len(lost):
            words += (
                f", poses among them not visited since: {pose_groups(lost).max() + 1} (to have "
                "these count, visit all without such a pause or with a longer cycle_timeout_s, "
                "and capture again)"
            )
        return words

    def of(self, command: Command) -> tuple[Measurements, Array]:
        """Targets on the flange, and centres (n, 3) of a sphere fixed in the cell.

        Raises `TooFewSamplesError` when nothing was measured; `InputError` when a cycle holds no
        pose of the cold reference.
        """
        desk, reference = self._desk, self._current.reference
        desk.drop_far_ahead()
        after = int(command.arguments.get("from_ns", desk.from_ns)) - 1
        observed = desk.window(after, command.stamp_ns or 0, command.marks or {})
        fixed = [o.sample.position_m for o in observed if o.sample.topic == REFERENCE_SPHERE]
        found = [o for o in observed if o.sample.topic != REFERENCE_SPHERE]
        if not found:
            raise TooFewSamplesError(desk.why_nothing())
        sets_up = command.name in events.SET_UP
        found = one_per_visit(found, self._config.standstill.tolerance_rad)
        sigma_m = None  # a calibration finds its noise itself
        if reference is not None and not sets_up:
            sigma_m = self._config.sigma_m
            targets = [o.sample.target for o in found]
            known = reference.knows(np.array([o.q for o in found]), targets)
            for other in (o for o, at_one in zip(found, known, strict=True) if not at_one):
                desk.ignored.add(other.sample.topic, OTHER_POSE)
            if not np.any(known):
                raise InputError(
                    f"none of the {len(found)} measured poses of {', '.join(sorted(set(targets)))} "
                    "was measured in the cold reference: visit the reference poses, or capture a "
                    "new reference"
                )
            found = [o for o, at_one in zip(found, known, strict=True) if at_one]
        last = int(command.arguments.get("samples", 0))
        data = as_measurements(found[-last:] if last else found, sigma_m)
        return data, np.array(fixed).reshape(-1, 3)

    def overdue(self) -> Command | None:
        """The command that ends a cycle in which nothing came for its time-out, or that is too old.

        The robot drifts on: what was measured at its end is not of the robot of its beginning.
        Without ``begin_cycle`` a cycle is what follows each other without such a pause, at half
        of the cold reference's poses or more.
        """
        desk, cycle = self._desk, self._cycle
        stamps = [o.sample.stamp_ns for o in desk.unused(self._cycle_ns())]
        last_ns = max([*stamps, cycle.begun_ns if cycle.id else 0])
        due_ns = max(last_ns, cycle.postponed_ns) + self._pause_ns
        why = f"nothing was measured for {self._config.cycle_timeout_s:g} s"
        if stamps and cycle.postponed_ns < last_ns and min(stamps) + self._span_ns < due_ns:
            due_ns = min(stamps) + self._span_ns
            why = f"its first measurement is {self._config.cycle_span_s:g} s old"
        if not last_ns or desk.newest_ns.get(JOINTS, 0) <= due_ns:
            return None
        if not cycle.id:
            visited, poses = self.progress()
            if poses == 0 or 2 * visited < poses:
                return None
        return Command(events.END_CYCLE, {"by": TIME_OUT, "reason": why}, due_ns)

    def progress(self) -> tuple[int, int]:
        """How many poses of the cold reference were visited in this cycle, and of how many."""
        reference = self._current.reference
        if reference is None:
            return 0, 0
        q = [o.q for o in self._desk.unused(self._cycle_ns())]
        return len(reference.spots.visited(np.array(q))), reference.spots.poses


class MotorTemperatures:
    """All joints' temperatures, whatever order they arrive in.

    ``newest_ns``: newest stamp; None before the first.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._place = {name: i for i, name in enumerate(names)}
        self._kept: dict[int, dict[int, TemperatureSample]] = {}
        self.newest_ns: int | None = None

    def add(self, sample: TemperatureSample) -> None:
        """Take a joint's temperature.

        Raises `InputError` when the robot has no such joint.
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

    def at(self, stamp_ns: int, until_ns: int | None = None) -> Array | None:
        """Temperatures (n,) at a stamp, as read up to another one; None where not known."""
        if self.silent(stamp_ns, until_ns):
            return None
        found = self.between(stamp_ns - SILENT_NS, stamp_ns if until_ns is None else until_ns)
        return found[-1][1] if found else None

    def silent(self, stamp_ns: int, until_ns: int | None = None) -> tuple[str, ...]:
        """Joints of which no temperature is known at a stamp, as read up to another one."""
        after_ns, last_ns = stamp_ns - SILENT_NS, stamp_ns if until_ns is None else until_ns
        read = {
            joint
            for ten in range(after_ns // EVERY_NS, last_ns // EVERY_NS + 1)
            for joint, sample in self._kept.get(ten, {}).items()
            if after_ns < sample.stamp_ns <= last_ns
        }
        return tuple(name for name, joint in self._place.items() if joint not in read)


# ---- what the sensor of a measuring robot sees, in base: by the model in force -------------------
# A point has the joints of its own instant, in motion too; live it waits for the joint reading
# after its stamp, so that the place does not depend on which topic came first.

LONGEST_GAP_S = 0.05  # between two joint readings; at 10 rad/s^2 the line misses by 3 mrad
MOST_SHOTS = 200  # shots that wait for joints: more means that none come
AHEAD_NS = 1_000_000_000  # of a shot before the newest joints: more is another clock


@dataclass(frozen=True, eq=False)
class SensorShot:
    """Points (m, 3), m, of one instant in the sensor; ``name`` says to the caller what it is."""

    stamp_ns: int
    frame: str
    points: Array
    name: str = ""

    def require_usable(self) -> None:
        """Raise `InputError` when it has no stamp, or holds what is not finite."""
        if self.stamp_ns <= 0:
            raise InputError("no time stamp")
        if not len(self.points) or not np.all(np.isfinite(self.points)):
            raise InputError("points must be finite, one at least")


def shot_of(message: Any, name: str) -> SensorShot:
    """The shot of a ``PointStamped`` or a ``PointCloud2``, without points that are missing."""
    if hasattr(message, "point"):
        p = message.point
        points = np.array([[p.x, p.y, p.z]])
    else:
        points = cloud_points(message)
        points = points[np.all(np.isfinite(points), axis=1)]
    frame = message.header.frame_id.lstrip("/")
    return SensorShot(stamp_ns(message.header.stamp), frame, points, name)


@dataclass(frozen=True, eq=False)
class PlacedShot:
    """A shot with the joints (n,), the flange T_base_flange (4, 4) and points (m, 3) in base, m."""

    shot: SensorShot
    q: Array
    T_base_flange: Array
    points: Array


def placed_shot(
    shot: SensorShot, stream: JointStream, arm: SerialArm, T_flange_sensor: Array
) -> PlacedShot:
    """A shot with the joints of its instant."""
    q = stream.at(shot.stamp_ns, LONGEST_GAP_S)
    T = arm.fk(q)
    return PlacedShot(shot, q, T, frames.apply(T @ T_flange_sensor, shot.points))


@dataclass
class PointQueue:
    """Shots that wait for the joints of their instant, in the order in which they came."""

    stream: JointStream
    _waiting: deque[SensorShot] = field(default_factory=deque)

    def add(self, shot: SensorShot) -> None:
        """Take a shot.

        Raises `InputError` when it has no stamp, is stamped far ahead of the joints, holds what is
        not finite, or too many wait already.
        """
        shot.require_usable()
        newest = self.stream.newest_ns
        if newest is not None and shot.stamp_ns > newest + AHEAD_NS:
            raise _ahead(shot.stamp_ns - newest)
        if len(self._waiting) >= MOST_SHOTS:
            raise InputError(f"{MOST_SHOTS} wait for joint states: does the driver publish them?")
        self._waiting.append(shot)

    def ready(
        self, arm: SerialArm, T_flange_sensor: Array
    ) -> Iterator[tuple[SensorShot, PlacedShot | RobocalError]]:
        """Shots whose joints are complete, with their places or why there are none.

        One that came before any joints may be stamped far ahead of them: the others do not wait
        for it.
        """
        newest = self.stream.newest_ns
        while newest is not None and self._waiting:
            ahead_ns = self._waiting[0].stamp_ns - newest
            if 0 < ahead_ns <= AHEAD_NS:
                return
            shot = self._waiting.popleft()
            if ahead_ns > 0:
                yield shot, _ahead(ahead_ns)
                continue
            try:
                yield shot, placed_shot(shot, self.stream, arm, T_flange_sensor)
            except RobocalError as error:
                yield shot, error

    def end(self) -> Iterator[tuple[SensorShot, RobocalError]]:
        """Shots that still wait, when no more joints will come."""
        while self._waiting:
            yield self._waiting.popleft(), InputError("no joint readings after the measurement")


def _ahead(ahead_ns: int) -> InputError:
    return InputError(
        f"stamped {1e-9 * ahead_ns:.1f} s ahead of the joint states: stamp both on one clock"
    )
