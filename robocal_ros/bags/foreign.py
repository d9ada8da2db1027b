# SPDX-License-Identifier: Apache-2.0
"""Bags as others record them: ROS 1, SQLite, and what streams through them with clocks of its own.

A tracker streams: it measures while the robot moves too, its stamps are often those of its
receipt, late and in bursts, and its computer's clock may be another. `stream_timing` finds by how
much from the motion, `StreamAverage` makes single measurements of what stands still.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_typestore

from robocal_ros.bags.bags import ROS1, BagInfo, BagMessage, BagReader, TopicInfo
from robocal_ros.bags.mcap_files import register_schema
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array, nearest_rotation
from robocal_ros.ground.samples import (
    JOINTS,
    MEASURED_POINT,
    MEASURED_POSE,
    JointSample,
    PointSample,
    StandstillRule,
    joint_sample,
    point_sample,
    pose_sample,
)
from robocal_ros.kinematics import SerialArm


class ForeignBagReader(BagReader):
    """As `BagReader`, of bags of ROS 1 and of SQLite ones, which rosbags reads.

    Types of ROS 1 have their names of ROS 2 (``sensor_msgs/msg/JointState``).
    """

    def __init__(self, path: Path, files: Iterable[Path]) -> None:
        self._path, self._stack = path, ExitStack()
        self._store = get_typestore(Stores.EMPTY)
        self._readers: list[Ros1Reader | Ros2Reader] = []
        try:
            for file in files:
                reader = Ros1Reader(file) if file.suffix == ROS1 else Ros2Reader(file)
                self._stack.enter_context(reader)
                self._readers.append(reader)
        except Exception as error:  # whatever rosbags makes of damaged bytes
            self._stack.close()
            raise InputError(
                f"cannot be read as a bag: {error}; 'rosbag reindex' (ROS 1) or 'ros2 bag reindex' "
                "mends one that broke off",
                file=str(path),
            ) from error

    @property
    def info(self) -> BagInfo:
        """What the bag holds."""
        topics: dict[str, TopicInfo] = {}
        for connection in (c for reader in self._readers for c in reader.connections):
            before = topics.get(connection.topic, TopicInfo(connection.msgtype, 0))
            count = before.messages + connection.msgcount
            topics[connection.topic] = TopicInfo(connection.msgtype, count)
        held = [reader for reader in self._readers if reader.message_count]
        return BagInfo(
            path=str(self._path),
            topics=dict(sorted(topics.items())),
            start_ns=min((reader.start_time for reader in held), default=None),
            end_ns=max((reader.end_time - 1 for reader in held), default=None),
            truncated=False,
            notes=(),
        )

    def messages(
        self,
        topics: Collection[str] | None = None,
        *,
        raw: bool = False,
        blocks: Collection[str] = (),
    ) -> Iterator[BagMessage]:
        """As `BagReader.messages`; joint states come one by one."""
        read = (self._messages(reader, topics, raw) for reader in self._readers)
        yield from merge(*read, key=lambda recorded: recorded.log_time_ns)

    def _messages(
        self, reader: Ros1Reader | Ros2Reader, topics: Collection[str] | None, raw: bool
    ) -> Iterator[BagMessage]:
        wanted = [c for c in reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        for connection in wanted:
            definition = connection.msgdef
            register_schema(
                self._store, connection.msgtype, "ros2msg" if definition.data else "",
                definition.data, str(self._path),
            )  # fmt: skip
        ros1 = isinstance(reader, Ros1Reader)
        decode = self._store.deserialize_ros1 if ros1 else self._store.deserialize_cdr
        messages = reader.messages(wanted)
        while True:
            place = "a message cannot be read"
            try:
                connection, log_time_ns, data = next(messages)
                place = f"a message of {connection.topic} cannot be decoded"
                message = data if raw else decode(data, connection.msgtype)
            except StopIteration:
                return
            except Exception as error:  # whatever bytes of another's recorder make of it
                raise InputError(f"{place}: {error!r}", file=str(self._path)) from error
            yield BagMessage(connection.topic, connection.msgtype, log_time_ns, message)


# ---- streams and their clocks -------------------------------------------------------------------

STREAMS_HZ = 5.0  # what measures oftener does so while the robot moves too
MOVING_SHARE = 0.1  # of a stream's measurements come while the robot moves
HALF_NS = 200_000_000  # about a measurement, in which the robot moves or not
FORESEEN_S = 900.0  # of a recording is looked at for its clocks
GRID_S = 0.02
WINDOW = 10  # of the grid, from which a speed is taken: receipt in bursts makes speeds of its own
LATEST_S = 1.5  # a stream lags behind the joints, or they behind it, by no more
OTHER_CLOCK_S = 1.0  # stamps further from their receipt than the joints' are of another clock
BLOCK_S = 1.0  # of a standstill become one measurement
SILENCE_S = 2.0  # after which a stream has ended, for now
LIKENESS = 0.6  # six sigma: two motions that are not one scatter by 0.1 in a hundred windows
SAME_MOTION_S = 20.0  # of motion that a delay is found from, at a time


@dataclass(frozen=True)
class StreamTiming:
    """When a stream was measured, by the joints' clock: ``stamp - later_ns``.

    ``rate_hz``: of its messages. ``clock_ns``: its clock ahead of the joints' clock, 0 where both
    are one. ``latency_s``, ``latency_sigma_s``: how late it is behind the joints by that clock,
    with its standard deviation; None: too little motion shows it, or it is another. ``burst``:
    most messages that came within a hundredth of a second.
    """

    rate_hz: float
    clock_ns: int = 0
    latency_s: float | None = None
    latency_sigma_s: float | None = None
    burst: int = 1

    @property
    def later_ns(self) -> int:
        """What a stamp is later than the joints' stamp of the same instant."""
        return self.clock_ns + round((self.latency_s or 0.0) * 1e9)

    def words(self, topic: str) -> str:
        """What is known of a topic's clock, for people."""
        parts = [f"{topic} streams at {self.rate_hz:.0f} Hz"]
        if self.clock_ns:
            parts.append(f"its clock is {self.clock_ns * 1e-9:+.3f} s from the joints', taken out")
        if self.latency_s is None:
            parts.append(
                f"no delay of less than {LATEST_S:g} s makes its motion that of the joints, so 0 "
                "is taken: too little motion, or it follows something else"
            )
        else:
            parts.append(
                f"measured {self.latency_s:.3f} s before its stamps say "
                f"(sigma {self.latency_sigma_s:.3f} s), taken out"
            )
        if self.burst > 2:
            parts.append(f"its messages come in bursts of up to {self.burst}")
        return "; ".join(parts)


def stream_timing(
    reader: BagReader, inputs: Mapping[str, str], arm: SerialArm
) -> dict[str, StreamTiming]:
    """Find how each stream of measurements stands to the joints' clock, by topic.

    The speed of the flange, from the joints, and that of the target are one motion: the shift that
    makes them alike is the delay. Turning speeds are alike in every frame and serve where poses
    are measured; of points the speed is compared, from which the target's lever differs little.

    A stream comes at more than 5 Hz, and while the robot moves too. The first 15 minutes are looked
    at.
    """
    seen = _Seen.of(reader, inputs, arm)
    return {
        topic: timing
        for topic in seen.stamp_ns
        if topic != seen.joints and (timing := _timing(seen, topic)) is not None
    }


@dataclass
class _Seen:
    """Stamps, receipt and motion of the joints and of each stream, of the recording's beginning."""

    arm: SerialArm
    joints: str
    stamp_ns: dict[str, list[int]] = field(default_factory=dict)
    log_ns: dict[str, list[int]] = field(default_factory=dict)
    values: dict[str, list[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, reader: BagReader, inputs: Mapping[str, str], arm: SerialArm) -> "_Seen":
        measured = {MEASURED_POINT, MEASURED_POSE, JOINTS}
        topics = {topic: kind for topic, kind in inputs.items() if kind in measured}
        joints = next((topic for topic, kind in topics.items() if kind == JOINTS), "")
        seen = cls(arm, joints)
        until_ns = (reader.info.start_ns or 0) + int(FORESEEN_S * 1e9)
        for recorded in reader.messages(topics):
            if recorded.log_time_ns > until_ns:
                break
            try:
                sample = _sample(topics[recorded.topic], recorded.message)
            except InputError:
                continue  # counted by the session, with its reason
            if isinstance(sample, JointSample):
                if not set(arm.joint_names) <= set(sample.names):
                    continue
                value: Any = sample.position[sample.order(arm.joint_names)]
            else:
                value = sample
            seen.stamp_ns.setdefault(recorded.topic, []).append(sample.stamp_ns)
            seen.log_ns.setdefault(recorded.topic, []).append(recorded.log_time_ns)
            seen.values.setdefault(recorded.topic, []).append(value)
        return seen


def _sample(kind: str, message: Any) -> Any:
    if kind == JOINTS:
        return joint_sample(message)
    return point_sample(message) if kind == MEASURED_POINT else pose_sample(message)


def _rate_hz(log_ns: NDArray[np.int64]) -> float:
    """Messages per second while they come: pauses, as of one that is switched off, do not count."""
    if len(log_ns) < 20:
        return 0.0
    steps = np.diff(log_ns) * 1e-9
    following = steps[steps < SILENCE_S]
    return len(following) / float(following.sum()) if 2 * len(following) > len(steps) else 0.0


def _timing(seen: _Seen, topic: str) -> StreamTiming | None:
    """The timing of what streams; None of what comes seldom, or is measured at standstill alone."""
    log_ns = np.array(seen.log_ns[topic])
    rate_hz = _rate_hz(log_ns)
    if rate_hz <= STREAMS_HZ or seen.joints not in seen.stamp_ns:
        return None
    lead_ns, joints_lead_ns = (
        float(np.median(np.array(seen.stamp_ns[name]) - np.array(seen.log_ns[name])))
        for name in (topic, seen.joints)
    )
    apart_ns = round(lead_ns - joints_lead_ns)
    clock_ns = apart_ns if abs(apart_ns) > OTHER_CLOCK_S * 1e9 else 0
    ends = np.searchsorted(log_ns, log_ns + 10_000_000, side="right")
    timing = StreamTiming(rate_hz, clock_ns, burst=int(np.max(ends - np.arange(len(log_ns)))))
    samples: list[PointSample] = seen.values[topic]
    joint_ns, q = np.array(seen.stamp_ns[seen.joints]), np.array(seen.values[seen.joints])
    measured_ns = np.array(seen.stamp_ns[topic]) - clock_ns
    about = (np.stack([measured_ns - HALF_NS, measured_ns + HALF_NS]) - joint_ns[0]) * 1e-9
    turned = [np.diff(np.interp(about, *_since(joint_ns, column)), axis=0) for column in q.T]
    moving = np.max(np.abs(turned), axis=0) > StandstillRule().tolerance_rad
    if np.mean(moving) < MOVING_SHARE:
        return None
    flange = seen.arm.fk(q)
    moved, measured = flange[:, :3, 3], np.array([sample.position_m for sample in samples])
    if all(sample.rotation is not None for sample in samples):
        moved = flange[:, :3, :3].reshape(-1, 9)
        measured = np.array([sample.rotation for sample in samples]).reshape(-1, 9)
    delay = delay_between(joint_ns, moved, measured_ns, measured)
    return (
        timing if delay is None else replace(timing, latency_s=delay[0], latency_sigma_s=delay[1])
    )


def delay_between(
    first_ns: NDArray[np.int64], first: Array, other_ns: NDArray[np.int64], other: Array
) -> tuple[float, float] | None:
    """How much later than ``first`` the stamps of ``other`` are, s, with its standard deviation.

    None where too little motion shows it, or the two are not one motion.

    ``first``, ``other`` (n, 3): positions, or (n, 9) rotation matrices row by row, in whatever
    frames: speeds are compared. ``first_ns`` (n,), ``other_ns`` (m,): their stamps.
    """
    at = [_rising(first_ns, first), _rising(other_ns, other)]
    start_ns = max(int(stamps[0]) for stamps, _ in at)
    end_ns = min(int(stamps[-1]) for stamps, _ in at)
    grid = np.arange(0.0, max((end_ns - start_ns) * 1e-9, 0.0), GRID_S)
    if len(grid) <= WINDOW:
        return None
    speeds = []
    for stamps, values in at:
        since = (stamps - start_ns) * 1e-9
        x = np.column_stack([np.interp(grid, since, column) for column in values.T])
        speeds.append(np.linalg.norm(x[WINDOW:] - x[:-WINDOW], axis=1))
    busy = np.cumsum(speeds[1] > 0.1 * np.quantile(speeds[1], 0.99)) * GRID_S
    pieces = max(int(busy[-1] // SAME_MOTION_S), 1)
    ends = np.searchsorted(busy, np.linspace(0.0, busy[-1], pieces + 1)[1:])
    delays = [
        delay
        for start, end in zip(np.concatenate(([0], ends[:-1])), ends + 1, strict=True)
        if (delay := _delay_s(speeds[0][start:end], speeds[1][start:end])) is not None
    ]
    if 2 * len(delays) <= pieces:
        return None
    found = np.array(delays)
    scatter = 1.4826 * np.median(np.abs(found - np.median(found)))
    sigma_s = float(np.hypot(scatter, GRID_S / np.sqrt(12.0)) / np.sqrt(len(found)))
    return float(np.median(found)), sigma_s


def _since(stamps: NDArray[np.int64], values: Array) -> tuple[Array, Array]:
    """Times, s, and values in the order of rising stamps."""
    later, kept = _rising(stamps, values)
    return (later - stamps[0]) * 1e-9, kept


def _rising(stamps: NDArray[np.int64], values: Array) -> tuple[NDArray[np.int64], Array]:
    """Those that are stamped after all before them."""
    newest = np.maximum.accumulate(stamps)
    later = np.concatenate(([True], stamps[1:] > newest[:-1]))
    return stamps[later], values[later]


def _delay_s(flange: Array, target: Array) -> float | None:
    """How much later (n,) ``target`` is than ``flange``; None where they are not one motion."""
    most = round(LATEST_S / GRID_S)
    if len(flange) < 4 * most:
        return None
    middle = flange[most:-most]
    with np.errstate(divide="ignore", invalid="ignore"):  # what stands still is like nothing
        likeness = [
            float(np.corrcoef(middle, target[most + lag : len(target) - most + lag])[0, 1])
            for lag in range(-most, most + 1)
        ]
    best = int(np.argmax(likeness))
    if not likeness[best] >= LIKENESS or best in (0, 2 * most):
        return None
    before, at, after = likeness[best - 1 : best + 2]
    return float(best - most + 0.5 * (before - after) / (before - 2.0 * at + after)) * GRID_S


@dataclass(frozen=True)
class StreamAverage:
    """Streams of a recording as single measurements by the joints' clock: one for each second.

    ``inputs``: topic to input. ``timing``: of each stream, see `stream_timing`.
    """

    inputs: Mapping[str, str]
    timing: Mapping[str, StreamTiming]

    @staticmethod
    def standstill(rule: StandstillRule) -> StandstillRule:
        """The rule, for measurements that are of a whole second about their stamp."""
        half = BLOCK_S / 2.0
        return replace(rule, before_s=rule.before_s + half, after_s=rule.after_s + half)

    def of(self, messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
        """Messages with each stream averaged; what is no stream comes as it was recorded.

        What cannot be read comes too, so that it is counted where it would have been used.
        """
        blocks: dict[tuple[str, str, str], list[PointSample]] = {}
        came_ns: dict[tuple[str, str, str], int] = {}
        for recorded in messages:
            # Of what ended, before its joints are forgotten.
            ended_ns = recorded.log_time_ns - round(SILENCE_S * 1e9)
            for key in [key for key, log_ns in came_ns.items() if log_ns < ended_ns]:
                del came_ns[key]
                yield _single(key[0], recorded.log_time_ns, blocks.pop(key))
            if (timing := self.timing.get(recorded.topic)) is None:
                yield recorded
                continue
            try:
                sample: PointSample = _sample(self.inputs[recorded.topic], recorded.message)
            except InputError:
                yield recorded
                continue
            sample = replace(sample, stamp_ns=sample.stamp_ns - timing.later_ns)
            key = recorded.topic, sample.frame, sample.target
            block = blocks.setdefault(key, [])
            if block and not 0 <= sample.stamp_ns - block[0].stamp_ns < BLOCK_S * 1e9:
                yield _single(key[0], recorded.log_time_ns, block)
                block.clear()
            block.append(sample)
            came_ns[key] = recorded.log_time_ns
        for key, block in blocks.items():
            yield _single(key[0], came_ns[key], block)


def _single(topic: str, log_time_ns: int, block: list[PointSample]) -> BagMessage:
    return BagMessage(topic, "", log_time_ns, _mean(block))


def _mean(block: list[PointSample]) -> PointSample:
    """Mean of what was measured in a row, without what lies far from the others."""
    position = np.array([sample.position_m for sample in block])
    away = np.abs(position - np.median(position, axis=0))
    scale = 1.4826 * np.median(away, axis=0) + 1e-6
    kept = np.flatnonzero((away <= 5.0 * scale).all(axis=1))
    kept = kept if len(kept) else np.arange(len(block))
    variance = position[kept].var(axis=0, ddof=1).mean() if len(kept) > 1 else 0.0
    stamps = np.array([block[i].stamp_ns for i in kept])
    turns = [R for i in kept if (R := block[i].rotation) is not None]
    return replace(
        block[-1],
        stamp_ns=int(stamps[0]) + round(float(np.mean(stamps - stamps[0]))),
        position_m=position[kept].mean(axis=0),
        sigma_m=float(np.sqrt(variance / len(kept))),
        rotation=nearest_rotation(np.mean(turns, axis=0)) if len(turns) == len(kept) else None,
    )
