"""Typed samples: what sensors and the robot deliver, whatever brought them.

The builders accept any object with the attributes of the ROS message, so that live nodes and
bag readers make the same samples from the same bytes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError

Array = NDArray[np.float64]

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

        Raises
        ------
        InputError
            Naming the joints that are not there.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            there = ", ".join(self.names)
            raise InputError(f"joint state lacks {', '.join(missing)}; it has {there}")
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

    Attributes
    ----------
    q : (m, n) joint readings, rad (prismatic: m).
    position : (m, 3) target position in the measuring frame, m.
    target : m names; each name is one point (or frame) fixed to the flange.
    sample : m unique ids, for naming rejected samples.
    rotation : (m, 3, 3) R_frame_target, or None when only positions were measured.
    sigma : (m,) standard deviation of each position coordinate, m, or None when unknown.
    stamp_ns : (m,) int64, or None.
    """

    q: Array
    position: Array
    target: tuple[str, ...]
    sample: tuple[str, ...]
    rotation: Array | None = None
    sigma: Array | None = None
    stamp_ns: NDArray[np.int64] | None = None

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
        optional = {"rotation": self.rotation, "sigma": self.sigma, "stamp_ns": self.stamp_ns}
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
            **{name: arrays.get(name) for name in ("rotation", "sigma", "stamp_ns")},
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
            rotation=None if self.rotation is None else self.rotation[index],
            sigma=None if self.sigma is None else self.sigma[index],
            stamp_ns=None if self.stamp_ns is None else self.stamp_ns[index],
        )


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a ``builtin_interfaces/Time``-like object."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def joint_sample(message: Any) -> JointSample:
    """Build a sample from a ``sensor_msgs/JointState``; a sample is one already.

    Raises
    ------
    InputError
        When names and positions differ in number, a name is doubled or a value is not finite,
        or the readings are not the controller's own.
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
    if not np.all(np.isfinite(position)):
        bad = names[int(np.flatnonzero(~np.isfinite(position))[0])]
        raise InputError(f"joint state of '{bad}' is not finite")
    return JointSample(stamp_ns(message.header.stamp), names, position)


def frame_and_target(frame_id: str, default_target: str) -> tuple[str, str]:
    """Measuring frame and target of a ``frame[/target]``."""
    frame, _, target = frame_id.partition("/")
    return frame, target or default_target


def _finite(values: Array, what: str) -> Array:
    if not np.all(np.isfinite(values)):
        raise InputError(f"{what} is not finite: {values.tolist()}")
    return values


def point_sample(
    message: Any, default_target: str = DEFAULT_TARGET, topic: str = MEASURED_POINT
) -> PointSample:
    """Build a sample from a ``geometry_msgs/PointStamped`` (frame_id ``frame[/target]``)."""
    frame, target = frame_and_target(message.header.frame_id, default_target)
    p = message.point
    position = _finite(np.array([p.x, p.y, p.z], dtype=np.float64), "measured point")
    return PointSample(stamp_ns(message.header.stamp), frame, target, position, topic)


def temperature_sample(message: Any) -> TemperatureSample:
    """Build a sample from a ``sensor_msgs/Temperature`` whose frame_id names the joint.

    Raises
    ------
    InputError
        When the temperature is not finite, or the stamp is missing.
    """
    celsius = _finite(np.array([message.temperature], dtype=np.float64), "motor temperature")
    at_ns = stamp_ns(message.header.stamp)
    if at_ns <= 0:
        raise InputError("no time stamp")
    return TemperatureSample(at_ns, message.header.frame_id, float(celsius[0]))


def pose_sample(message: Any, default_target: str = DEFAULT_TARGET) -> PointSample:
    """Build a sample from a ``geometry_msgs/PoseStamped`` (frame_id ``frame[/target]``).

    Raises
    ------
    InputError
        When a value is not finite or the quaternion is not of unit length (tolerance 1e-3).
    """
    from robocal_ros.ground.frames import transform_from_quat

    frame, target = frame_and_target(message.header.frame_id, default_target)
    p, o = message.pose.position, message.pose.orientation
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
    """Points (n, 3), m, of the fields x, y, z; missing points stay not-a-number.

    Raises
    ------
    InputError
        When a field is missing or the data do not have the size that the message tells.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
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
    points = np.empty((count, 3))
    for axis, name in enumerate("xyz"):
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

    Raises
    ------
    InputError
        When it is of another encoding, or the data do not have the size that the message tells.
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
