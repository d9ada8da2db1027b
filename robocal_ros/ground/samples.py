# SPDX-License-Identifier: Apache-2.0
"""Typed samples, what sensors and the robot deliver, whatever brought them; joints by time stamp.

The builders accept any object with the attributes of the ROS message, so that live nodes and
bag readers make the same samples from the same bytes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array

DEFAULT_TARGET = "tool"
CORRECTED = "robocal_corrected"  # frame_id of commands that carry a joint correction
JOINTS = "joint_states"
SPHERE_CENTER = "sphere_center"
SPHERE_CLOUD = "sphere_cloud"
MEASURED_POSE = "measured_pose"
REFERENCE_SPHERE = "reference_sphere_center"  # a sphere fixed in the cell
MEASURED_POINT = "measured_point"  # the input that a point comes from where nothing else is said
MEASURING = (MEASURED_POINT, SPHERE_CENTER, SPHERE_CLOUD, MEASURED_POSE, REFERENCE_SPHERE)
JUMPS = "clock_jumps"  # beside topics in marks
RECORDED = "/recorded"  # before the names of what must not act where it is played again
UNCORRECTED = "joint_correction"  # in the name of a correction node, and so of its topics
TAUGHT = "robocal_taught"  # frame_id of joint states from which the correction was removed
TEMPERATURES = "motor_temperatures"


@dataclass(frozen=True, slots=True)
class JointSample:
    """Joint readings at one instant: ``position`` (n,) in rad (prismatic: m)."""

    stamp_ns: int
    names: tuple[str, ...]
    position: Array

    def order(self, names: tuple[str, ...]) -> NDArray[np.int64]:
        """Places (n,) of these joints among the sample's.

        Raises `InputError`, naming the joints that are not there.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            there = ", ".join(self.names)
            raise InputError(f"joint state has no position of {', '.join(missing)}; it has {there}")
        return np.array([self.names.index(name) for name in names], dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class JointBlock:
    """Readings of the same joints, one after another as they came, each as in `JointSample`.

    ``stamp_ns`` (k,) int64, ``position`` (k, n).
    """

    stamp_ns: NDArray[np.int64]
    names: tuple[str, ...]
    position: Array

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def sample(self, place: int) -> JointSample:
        """Return one of the readings."""
        return JointSample(int(self.stamp_ns[place]), self.names, self.position[place])


@dataclass(frozen=True, slots=True)
class PointSample:
    """A target's position (3,) in the measuring frame, in m, and its orientation where measured.

    ``topic``: the input that it came from. ``sigma_m``: rms standard deviation of a coordinate
    from its own measurement, 0 where that is not known. ``rotation``: R_frame_target (3, 3).
    """

    stamp_ns: int
    frame: str
    target: str
    position_m: Array
    topic: str = MEASURED_POINT
    sigma_m: float = 0.0
    rotation: Array | None = None


@dataclass(frozen=True, slots=True)
class TemperatureSample:
    """A joint's motor temperature."""

    stamp_ns: int
    joint: str
    celsius: float


@dataclass(frozen=True)
class Measurements:
    """Joint readings paired with measured positions or poses of named targets on the flange.

    ``q`` (m, n): joint readings, rad (prismatic: m). ``position`` (m, 3): target position in the
    measuring frame, m. ``target``: m names; each name is one point (or frame) fixed to the flange.
    ``sample``: m unique ids, for naming rejected samples. ``rotation`` (m, 3, 3): R_frame_target,
    or None when only positions were measured. ``sigma`` (m,): standard deviation of each position
    coordinate, m, or None when unknown. ``stamp_ns`` (m,): int64, or None. ``side`` (m, n): which
    way each joint went last, see `JointStream.side`; or None.
    """

    q: Array
    position: Array
    target: tuple[str, ...]
    sample: tuple[str, ...]
    rotation: Array | None = None
    sigma: Array | None = None
    stamp_ns: NDArray[np.int64] | None = None
    side: Array | None = None

    def __len__(self) -> int:
        return len(self.q)

    @property
    def targets(self) -> tuple[str, ...]:
        """The distinct target names, in order of first appearance."""
        return tuple(dict.fromkeys(self.target))

    def target_index(self, targets: tuple[str, ...]) -> NDArray[np.int64]:
        """Index (m,) of each sample's target in ``targets``."""
        lookup = {name: i for i, name in enumerate(targets)}
        unknown = next((name for name in self.target if name not in lookup), None)
        if unknown is not None:
            raise InputError(f"target '{unknown}' is not one of {', '.join(targets)}")
        return np.array([lookup[name] for name in self.target], dtype=np.int64)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything measured as named arrays, for keeping."""
        optional = {name: getattr(self, name) for name in OPTIONAL}
        return {
            "q": self.q,
            "position": self.position,
            "target": np.array(self.target),
            "sample": np.array(self.sample),
            **{name: value for name, value in optional.items() if value is not None},
        }

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> "Measurements":
        """Read back what ``arrays`` gave; other arrays may lie beside it."""
        return cls(
            q=arrays["q"],
            position=arrays["position"],
            target=tuple(arrays["target"].tolist()),
            sample=tuple(arrays["sample"].tolist()),
            **{name: arrays.get(name) for name in OPTIONAL},
        )

    @property
    def middle_ns(self) -> int:
        """Mean stamp; 0 without stamps."""
        if self.stamp_ns is None or not len(self.stamp_ns):
            return 0
        first = int(self.stamp_ns.min())
        return first + round(float(np.mean(self.stamp_ns - first)))

    def take(self, rows: NDArray[Any]) -> "Measurements":
        """Return the samples at ``rows`` (index or boolean mask)."""
        index = np.arange(len(self))[rows]
        return Measurements(
            q=self.q[index],
            position=self.position[index],
            target=tuple(self.target[i] for i in index),
            sample=tuple(self.sample[i] for i in index),
            **{name: None if (a := getattr(self, name)) is None else a[index] for name in OPTIONAL},
        )


OPTIONAL = "rotation", "sigma", "stamp_ns", "side"


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a ``builtin_interfaces/Time``-like object."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def joint_sample(message: Any) -> JointSample:
    """Build a sample from a ``sensor_msgs/JointState``; a sample is one already.

    Joints whose position is not finite are left out: joint_state_broadcaster names those that have
    no position, as a spindle that has a velocity alone.

    Raises `InputError` when names and positions differ in number, a name is doubled or no value is
    finite, or the readings are not the controller's own.
    """
    if isinstance(message, JointSample):
        return message
    if message.header.frame_id in (CORRECTED, TAUGHT):
        raise InputError(
            "joint states come from a joint correction: subscribe to the robot's own, or the model "
            "would be identified against itself"
        )
    names = tuple(message.name)
    position = np.array(message.position, dtype=np.float64)
    if len(names) != len(position):
        raise InputError(f"joint state has {len(names)} names but {len(position)} positions")
    if len(set(names)) != len(names):
        raise InputError(f"joint state names a joint twice: {', '.join(names)}")
    known = np.isfinite(position)
    if not known.all():
        if not known.any():
            raise InputError(f"joint state of '{names[0]}' is not finite")
        names, position = tuple(compress(names, known)), position[known]
    return JointSample(stamp_ns(message.header.stamp), names, position)


def frame_and_target(frame_id: str, default_target: str) -> tuple[str, str]:
    """Measuring frame and target of a ``frame[/target]``; ROS 1 wrote ``/frame``."""
    frame, _, target = frame_id.removeprefix("/").partition("/")
    return frame, target or default_target


def _finite(values: Array, what: str) -> Array:
    if not np.all(np.isfinite(values)):
        raise InputError(f"{what} is not finite: {values.tolist()}")
    return values


def point_sample(
    message: Any, default_target: str = DEFAULT_TARGET, topic: str = MEASURED_POINT
) -> PointSample:
    """Build a sample from a ``geometry_msgs/PointStamped`` (frame_id ``frame[/target]``).

    Of a pose (see `pose_sample`) the position is taken; a sample is one already.
    """
    if isinstance(message, PointSample):
        return message
    frame, target = _frame_and_target(message, default_target)
    p = message.point if hasattr(message, "point") else _position_and_turn(message)[0]
    position = _finite(np.array([p.x, p.y, p.z], dtype=np.float64), "measured point")
    return PointSample(stamp_ns(message.header.stamp), frame, target, position, topic)


def _frame_and_target(message: Any, default_target: str) -> tuple[str, str]:
    child = getattr(message, "child_frame_id", "").strip("/")
    return frame_and_target(message.header.frame_id, child or default_target)


def _position_and_turn(message: Any) -> tuple[Any, Any]:
    """Position and quaternion of a message that holds a pose or a transform."""
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return pose.position, pose.orientation


def temperature_sample(message: Any) -> TemperatureSample:
    """Build a sample from a ``sensor_msgs/Temperature`` whose frame_id names the joint.

    Raises `InputError` when the temperature is not finite, or the stamp is missing.
    """
    celsius = _finite(np.array([message.temperature], dtype=np.float64), "motor temperature")
    at_ns = stamp_ns(message.header.stamp)
    if at_ns <= 0:
        raise InputError("no time stamp")
    return TemperatureSample(at_ns, message.header.frame_id, float(celsius[0]))


def pose_sample(message: Any, default_target: str = DEFAULT_TARGET) -> PointSample:
    """Build a sample from a ``geometry_msgs/PoseStamped`` (frame_id ``frame[/target]``).

    So of a ``PoseWithCovarianceStamped``, and of a ``TransformStamped`` or ``nav_msgs/Odometry``,
    whose child frame is the target; a sample is one already.

    Raises `InputError` when a value is not finite or the quaternion is not of unit length
    (tolerance 1e-3).
    """
    if isinstance(message, PointSample):
        return message
    from robocal_ros.ground.frames import transform_from_quat

    frame, target = _frame_and_target(message, default_target)
    p, o = _position_and_turn(message)
    xyz = _finite(np.array([p.x, p.y, p.z], dtype=np.float64), "measured position")
    quat = _finite(np.array([o.x, o.y, o.z, o.w], dtype=np.float64), "measured orientation")
    norm = float(np.linalg.norm(quat))
    if abs(norm - 1.0) > 1e-3:
        raise InputError(f"measured orientation has a quaternion of length {norm:.6g}, not 1")
    return PointSample(
        stamp_ns(message.header.stamp),
        frame,
        target,
        xyz,
        MEASURED_POSE,
        rotation=transform_from_quat(xyz, quat)[:3, :3],
    )


# ---- points of a ``sensor_msgs/PointCloud2``, whatever brought the message ----------------------


TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's name of each ``sensor_msgs/PointField`` datatype."""
MOST_POINTS = 5_000_000


def cloud_points(message: Any) -> Array:
    """Points (n, 3), m, of the fields x, y, z; missing points stay not-a-number."""
    return cloud_columns(message, "xyz")


def cloud_columns(message: Any, names: Sequence[str]) -> Array:
    """Values (n, k) of the named fields of a cloud.

    Raises `InputError` when a field is missing or the data do not have the size that the message
    tells.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in names if name not in fields]
    if missing:
        raise InputError(
            f"the cloud has no field {', '.join(missing)}; it has {', '.join(fields) or 'none'}"
        )
    width, height = int(message.width), int(message.height)
    step, row = int(message.point_step), int(message.row_step)
    count = width * height
    if not 0 < count <= MOST_POINTS:
        raise InputError(f"the cloud has {count} points: 1 to {MOST_POINTS} are read")
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    if step <= 0 or row < width * step or len(data) < row * height:
        raise InputError(
            f"the cloud's {len(data)} bytes do not hold {height} rows of {row} bytes with "
            f"{width} points of {step} bytes"
        )
    order = ">" if message.is_bigendian else "<"
    grid = data[: row * height].reshape(height, row)[:, : width * step].reshape(count, step)
    points = np.empty((count, len(names)))
    for axis, name in enumerate(names):
        field = fields[name]
        if field.datatype not in TYPES:
            raise InputError(f"field {name} of the cloud has the unknown type {field.datatype}")
        kind = np.dtype(order + TYPES[field.datatype])
        start = int(field.offset)
        if not 0 <= start <= step - kind.itemsize:
            raise InputError(f"field {name} of the cloud lies outside its {step} bytes")
        column = np.ascontiguousarray(grid[:, start : start + kind.itemsize])
        points[:, axis] = column.view(kind)[:, 0]
    return points


# ---- pixels of a ``sensor_msgs/Image``, whatever brought the message ----------------------------


Image = NDArray[np.uint8]

CHANNELS = {"mono8": 1, "bgr8": 3, "rgb8": 3}
"""Encodings that are read, and their bytes of a pixel."""
MOST_PIXELS = 100_000_000


def image_array(message: Any) -> Image:
    """Grey image (h, w), a copy; colours are weighted as ITU-R BT.601 does.

    Raises `InputError` when it is of another encoding, or the data do not have the size that the
    message tells.
    """
    encoding = str(message.encoding)
    if encoding not in CHANNELS:
        raise InputError(
            f"images of encoding '{encoding}' are not read: have the camera publish 8 bits as "
            f"{', '.join(CHANNELS)}"
        )
    channels = CHANNELS[encoding]
    width, height, step = int(message.width), int(message.height), int(message.step)
    if not 0 < width * height <= MOST_PIXELS:
        raise InputError(f"the image has {width}x{height} px: 1 to {MOST_PIXELS} are read")
    data = np.frombuffer(message.data, dtype=np.uint8)
    if step < width * channels or len(data) < step * height:
        raise InputError(
            f"the image's {len(data)} bytes do not hold {height} rows of {step} bytes with "
            f"{width} pixels of {channels} bytes"
        )
    rows = data[: step * height].reshape(height, step)[:, : width * channels]
    if channels == 1:
        return rows.copy()
    import cv2

    colours = np.ascontiguousarray(rows).reshape(height, width, channels)
    code = cv2.COLOR_BGR2GRAY if encoding == "bgr8" else cv2.COLOR_RGB2GRAY
    return np.asarray(cv2.cvtColor(colours, code), dtype=np.uint8)


# ---- joint readings by time stamp: interpolation and the standstill check -----------------------

CLOCK_JUMP_NS = 1_000_000_000


@dataclass(frozen=True)
class StandstillRule:
    """When a robot counts as standing still around an instant.

    ``before_s``, ``after_s``: the window about the instant.
    ``tolerance_rad``: largest range of any joint in the window (prismatic: m).
    ``gap_s``: longest pause between two joint readings in the window.
    """

    before_s: float = 0.3
    after_s: float = 0.1
    tolerance_rad: float = float(np.radians(0.02))
    gap_s: float = 0.25


@dataclass(frozen=True)
class Reading:
    """Joints (n,) interpolated at an instant, and the stamp of the reading that completed it."""

    q: Array
    ready_ns: int


class Added(NamedTuple):
    """What a reading did to a stream.

    ``began_ns``: stamp at which the stream begins, or begins anew; ``lone_ns``: stamp of an
    earlier reading that no other followed and that is not used. None: it did no such thing.
    """

    began_ns: int | None = None
    lone_ns: int | None = None


class NotStillError(InputError):
    """The joints cannot be given at that instant; the message says why."""


def _goes_on(stamp_ns: int, held_ns: int, newest_ns: int | None, near_ns: int) -> bool:
    """Whether a stamp goes on from one that leapt, and not from the newest before the leap."""
    if stamp_ns <= held_ns:
        return False
    if newest_ns is None or held_ns > newest_ns:
        return True
    if stamp_ns > newest_ns:
        return False
    return stamp_ns - held_ns <= near_ns or newest_ns - stamp_ns >= CLOCK_JUMP_NS


# A joint that went so far has taken up its backlash: 17 to 118 urad on a UR10, 70 on an IRB 1600.
TAKEN_UP_RAD = 3e-4
LOOKED_AT = 4096  # readings before a standstill in which a joint must have gone that far


class JointStream:
    """The latest joint readings of one arm, in its joint order, oldest first.

    Content depends on the readings alone, not on when they arrive between other topics.
    ``count``: of all that it ever held.
    """

    def __init__(self, joint_names: tuple[str, ...], capacity: int = 16384) -> None:
        self._names = joint_names
        self._stamp = np.zeros(2 * capacity, dtype=np.int64)
        self._q = np.zeros((2 * capacity, len(joint_names)))
        self._capacity = capacity
        self._size = 0
        self._order: dict[tuple[str, ...], NDArray[np.int64]] = {}
        self._held: tuple[int, Array] | None = None  # a reading that leapt, not yet believed
        self.count = 0
        self.gap_count = 0
        self.longest_gap_ns = 0

    def count_until(self, stamp_ns: int) -> int:
        """How many it ever held, without those after a stamp."""
        later = np.searchsorted(self._stamp[: self._size], stamp_ns, side="right")
        return self.count - (self._size - int(later))

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest reading."""
        return int(self._stamp[self._size - 1]) if self._size else None

    def add(self, sample: JointSample, gap_ns: int) -> Added:
        """Append a reading; joints may come in any order and beside others.

        A leap of the stamps, back by a second or more or ahead by more than that and ``gap_ns``,
        is believed when the next reading goes on from there: one wrong stamp must not move the
        clock. So is the beginning. A leap ahead is a pause; a leap back starts the stream anew.
        Pauses longer than ``gap_ns`` are counted.

        Raises `InputError` when a joint is missing, or the stamp is not after the newest one.
        """
        order = self._order.get(sample.names)
        if order is None:
            order = self._order[sample.names] = sample.order(self._names)
        stamp_ns, near_ns = sample.stamp_ns, max(CLOCK_JUMP_NS, gap_ns)
        held, newest = self._held, self.newest_ns
        began_ns = lone_ns = None
        if held is not None and _goes_on(stamp_ns, held[0], newest, near_ns):
            if newest is None or held[0] < newest:
                self._size, began_ns = 0, held[0]
            self._append(held, gap_ns)
            newest = held[0]
        elif newest is not None and -CLOCK_JUMP_NS < stamp_ns - newest <= 0:
            raise InputError(f"joint state at {stamp_ns} ns is not after {newest} ns")
        elif held is not None:
            lone_ns = held[0]
        reading = stamp_ns, sample.position[order]
        leaps = newest is None or not 0 < stamp_ns - newest <= near_ns
        self._held = reading if leaps else None
        if not leaps:
            self._append(reading, gap_ns)
        return Added(began_ns, lone_ns)

    def extend(self, block: JointBlock, start: int, before_ns: int | None, gap_ns: int) -> int:
        """Append the readings from ``start`` on that just follow each other: how many these are.

        Each is what `add` would have done. The first one that leaps, is not after the one before
        it, or is stamped ``before_ns`` or later is left to the caller.
        """
        order, newest = self._order.get(block.names), self.newest_ns
        if order is None or newest is None or self._held is not None:
            return 0
        stamps = block.stamp_ns[start:]
        steps = stamps - np.concatenate(([newest], stamps[:-1]))
        plain = (steps > 0) & (steps <= max(CLOCK_JUMP_NS, gap_ns))
        if before_ns is not None:
            plain &= stamps < before_ns
        count = len(plain) if plain.all() else int(np.argmin(plain))
        pauses = steps[:count][steps[:count] > gap_ns]
        if len(pauses):
            self.gap_count += len(pauses)
            self.longest_gap_ns = max(self.longest_gap_ns, int(pauses.max()))
        self.count += count
        rows = slice(start, start + count)
        stamps, q = block.stamp_ns[rows], block.position[rows][:, order]
        while len(stamps):
            self._make_room()
            room = len(self._stamp) - self._size
            end = self._size + min(room, len(stamps))
            self._stamp[self._size : end], self._q[self._size : end] = stamps[:room], q[:room]
            self._size, stamps, q = end, stamps[room:], q[room:]
        return count

    def _make_room(self) -> None:
        """Forget the older half of the readings where there is no room for more."""
        if self._size == len(self._stamp):
            self._stamp[: self._capacity] = self._stamp[self._capacity :]
            self._q[: self._capacity] = self._q[self._capacity :]
            self._size = self._capacity

    def _append(self, reading: tuple[int, Array], gap_ns: int) -> None:
        """Append a reading, and count the pause before it."""
        stamp_ns, q = reading
        newest = self.newest_ns
        if newest is not None and stamp_ns - newest > gap_ns:
            self.gap_count += 1
            self.longest_gap_ns = max(self.longest_gap_ns, stamp_ns - newest)
        self._make_room()
        self._stamp[self._size], self._q[self._size] = stamp_ns, q
        self._size += 1
        self.count += 1

    def window(self, from_ns: int, to_ns: int) -> tuple[NDArray[np.int64], Array]:
        """Stamps (k,) and joints (k, n) of the readings from ``from_ns`` up to ``to_ns``."""
        stamps = self._stamp[: self._size]
        low, high = np.searchsorted(stamps, from_ns), np.searchsorted(stamps, to_ns, side="right")
        return stamps[low:high].copy(), self._q[low:high].copy()

    def at(self, stamp_ns: int, gap_s: float) -> Array:
        """Joints (n,) at an instant, on the line between the readings before and after it.

        Raises `InputError` when these are missing, or more than ``gap_s`` apart.
        """
        stamps = self._stamp[: self._size]
        after = int(np.searchsorted(stamps, stamp_ns, side="left"))
        if after == self._size or (after == 0 and stamps[0] != stamp_ns):
            raise InputError("no joint readings about the measurement")
        if stamps[after] == stamp_ns:
            return np.array(self._q[after])
        before = after - 1
        pause_ns = int(stamps[after] - stamps[before])
        if pause_ns > gap_s * 1e9:
            raise InputError(
                f"joint readings pause for {pause_ns * 1e-9:.3f} s (allowed {gap_s:.3f} s)"
            )
        share = (stamp_ns - int(stamps[before])) / pause_ns
        return np.asarray((1.0 - share) * self._q[before] + share * self._q[after])

    def standstill(self, stamp_ns: int, rule: StandstillRule) -> Reading | None:
        """Joints at an instant at which the robot stands still; None while readings are to come.

        Raises `NotStillError` when the robot moved, or readings are missing around the instant.
        """
        first_ns = stamp_ns - int(rule.before_s * 1e9)
        last_ns = stamp_ns + int(rule.after_s * 1e9)
        stamps = self._stamp[: self._size]
        if not self._size or stamps[-1] < last_ns:
            return None
        low = int(np.searchsorted(stamps, first_ns, side="right")) - 1
        high = int(np.searchsorted(stamps, last_ns, side="left"))
        if low < 0:
            raise NotStillError("no joint readings from before the measurement")
        gap = float(np.max(np.diff(stamps[low : high + 1]), initial=0)) * 1e-9
        if gap > rule.gap_s:
            raise NotStillError(
                f"joint readings pause for {gap:.3f} s (allowed {rule.gap_s:.3f} s)"
            )
        window = self._q[low : high + 1]
        spread = np.ptp(window, axis=0)
        worst = int(np.argmax(spread))
        if spread[worst] > rule.tolerance_rad:
            raise NotStillError(
                f"{self._names[worst]} moved by {np.degrees(spread[worst]):.3f} deg "
                f"(allowed {np.degrees(rule.tolerance_rad):.3f} deg)"
            )
        return Reading(self.at(stamp_ns, rule.gap_s), int(stamps[high]))

    def side(self, stamp_ns: int, gap_s: float) -> Array:
        """Which way each joint (n,) went last before an instant: +1, -1; 0: not known.

        As far back as readings follow each other by no more than ``gap_s``. A gear with backlash
        drags behind that way; ISO 9283 calls what it makes of poses reached from several
        directions the multi-directional pose accuracy variation.
        """
        last = int(np.searchsorted(self._stamp[: self._size], stamp_ns, side="right"))
        first = max(0, last - LOOKED_AT)
        pauses = np.flatnonzero(np.diff(self._stamp[first:last]) > gap_s * 1e9)
        q = self._q[first + int(pauses[-1]) + 1 if len(pauses) else first : last]
        if not len(q):
            return np.zeros(len(self._names))
        way = (q[-1] - q)[::-1]
        gone = np.abs(way) > TAKEN_UP_RAD
        newest = np.take_along_axis(way, np.argmax(gone, axis=0)[None], axis=0)[0]
        return np.where(gone.any(axis=0), np.sign(newest), 0.0)

    def resting(self, stamp_ns: int, rule: StandstillRule) -> Array | None:
        """Mean joints (n,) of the standstill about an instant. Else as `standstill`."""
        reading = self.standstill(stamp_ns, rule)
        if reading is None:
            return None
        _, q = self.window(stamp_ns - int(rule.before_s * 1e9), reading.ready_ns)
        return np.asarray(q.mean(axis=0))


# ---- how long something was not heard -----------------------------------------------------------


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
