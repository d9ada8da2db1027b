"""Message types without ROS: of Jazzy, of robocal_msgs, and of the definitions inside a bag."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import share_folders

INTERFACES = "robocal_msgs"
_DTYPES = {"char": "uint8", "octet": "uint8"}


@cache
def ros_types() -> Typestore:
    """The standard types of Jazzy, and those of robocal_msgs where they are found."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for folder in share_folders(INTERFACES, "msg", "msg_defs/msg")[:1]:
        for file in sorted(folder.glob("*.msg")):
            name = f"{INTERFACES}/msg/{file.stem}"
            store.register(get_types_from_msg(file.read_text(encoding="utf-8"), name))
    return store


def full_name(msgtype: str) -> str:
    """``package/msg/Type`` of a name that may lack its middle part."""
    package, _, name = msgtype.partition("/")
    return msgtype if "/" in name else f"{package}/msg/{name}"


def register_schema(store: Typestore, msgtype: str, encoding: str, text: str, file: str) -> None:
    """Teach ``store`` the type that a bag defines, or the known one where it defines none.

    Raises
    ------
    InputError
        When the definition cannot be read and the type is not a standard one.
    """
    if msgtype in store.types:
        return
    try:
        if encoding == "ros2msg" and text:
            types = get_types_from_msg(text, msgtype)
        elif encoding in ("ros2idl", "omgidl") and text:
            types = get_types_from_idl(text)
        else:
            types = _known_type(msgtype)
        store.register({name: found for name, found in types.items() if name not in store.types})
    except (TypesysError, KeyError) as error:
        raise InputError(
            f"the definition of {msgtype} in this bag cannot be read: {error}", file=file
        ) from error


def _known_type(msgtype: str) -> dict[str, Any]:
    """A standard type with all that it is made of."""
    known = ros_types().fielddefs
    types = {msgtype: known[msgtype]}
    for part in _parts(known[msgtype]):
        types |= _known_type(part)
    return types


def _parts(fields: Any) -> list[str]:
    """Types of the fields of a type, but for the elementary ones."""
    described = [
        detail[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, detail)
        for _, (kind, detail) in fields[1]
    ]
    return [str(detail) for kind, detail in described if kind == Nodetype.NAME]


def _learn_installed(store: Typestore, msgtype: str) -> None:
    """Teach ``store`` a type, and what it is made of, by the definitions that are installed."""
    package, _, name = msgtype.partition("/msg/")
    for folder in share_folders(package, "msg", f"{package}/msg"):
        if msgtype in store.types or not (file := folder / f"{name}.msg").is_file():
            continue
        types = get_types_from_msg(file.read_text(encoding="utf-8"), msgtype)
        for part in _parts(types[msgtype]):
            _learn_installed(store, part)
        store.register(types)


def definition(msgtype: str) -> str:
    """Text of a known type with all that it is made of, as recorders store it.

    Raises
    ------
    InputError
        When the type is not known here.
    """
    store = ros_types()
    _learn_installed(store, msgtype)
    if msgtype not in store.types:
        package = msgtype.partition("/")[0]
        raise InputError(
            f"message type {msgtype} is not known; it is not in Jazzy's common interfaces, and "
            f"no share/{package}/msg was found below AMENT_PREFIX_PATH"
        )
    return store.generate_msgdef(msgtype, ros_version=2)[0]


def encode(msgtype: str, value: Any) -> memoryview:
    """CDR of a message: any object with the type's attributes, or a mapping of its fields.

    Fields that a mapping leaves out are zero or empty, as in ROS.

    Raises
    ------
    ValueError
        When a mapping has a field that the type has not.
    """
    store = ros_types()
    message = value if isinstance(value, store.types[msgtype]) else _build(store, msgtype, value)
    return store.serialize_cdr(message, msgtype)


def _build(store: Typestore, msgtype: str, value: Any) -> Any:
    fields = store.fielddefs[msgtype][1]
    if isinstance(value, Mapping):
        unknown = set(value) - {name for name, _ in fields}
        if unknown:
            raise ValueError(f"{msgtype} has no field {sorted(unknown)[0]!r}")
        given = {name: value.get(name) for name, _ in fields}
    else:
        given = {name: getattr(value, name) for name, _ in fields}
    return store.types[msgtype](**{name: _field(store, kind, given[name]) for name, kind in fields})


def _field(store: Typestore, described: Any, value: Any) -> Any:
    """A field's value as the serialiser wants it; None stands for the default."""
    kind, detail = described
    if kind == Nodetype.NAME:
        return _build(store, detail, {} if value is None else value)
    if kind == Nodetype.BASE:
        if detail[0] in ("string", "wstring"):
            return value or ""
        return value or 0
    inner, length = detail
    size = length if kind == Nodetype.ARRAY else 0
    if inner[0] == Nodetype.BASE and inner[1][0] not in ("string", "wstring"):
        dtype = np.dtype(_DTYPES.get(inner[1][0], inner[1][0]))
        if isinstance(value, bytes | bytearray | memoryview):
            return np.frombuffer(value, dtype)
        return np.zeros(size, dtype) if value is None else np.ascontiguousarray(value, dtype)
    items = [None] * size if value is None else value
    return [_field(store, inner, item) for item in items]


# ---- names of commands in a recording: nobody listens to them, whoever plays it -----------------
#
# What moves a robot, says that it may be moved, or how its controller moves it, lies under
# `RECORDED`: ``/robot/gap_open`` as ``/recorded/robot/gap_open``. `BagReader` gives each topic the
# name that it had on the graph.


RECORDED = "/recorded"
MOVES = "it may move a robot"
VOUCHES = "it says that a robot may move now, or how it is moved"

_BY_TYPE = {
    "trajectory_msgs/msg/JointTrajectory": MOVES,
    "trajectory_msgs/msg/MultiDOFJointTrajectory": MOVES,
    "std_msgs/msg/Float64MultiArray": MOVES,  # as forward_command_controller takes them
    "control_msgs/msg/JointJog": MOVES,  # as MoveIt Servo takes them, with the next two
    "geometry_msgs/msg/Twist": MOVES,
    "geometry_msgs/msg/TwistStamped": MOVES,
    "robocal_msgs/msg/ToolStep": MOVES,
    "robocal_msgs/msg/GapOpen": VOUCHES,
    "std_msgs/msg/Bool": VOUCHES,  # a PLC's inputs, and `gap_open` where `gap_bool` is set
    "robocal_msgs/msg/MotionLease": VOUCHES,
    "robocal_msgs/msg/MaintenanceStatus": VOUCHES,  # the beat, and whether the robot is at home
    "robocal_msgs/msg/AccuracyState": VOUCHES,  # by which the line goes on
    "control_msgs/msg/JointTrajectoryControllerState": VOUCHES,  # where its reference is, how fast
    "control_msgs/msg/SpeedScalingFactor": VOUCHES,
}
_BY_NAME = {"speed_scaling": VOUCHES, "gap_open": VOUCHES}  # last parts of names
# Of these types there are readings, by the last parts of their names, and commands of any name:
# MoveIt Servo, ros2_control and simulators are given joint states and poses to go to.
_READINGS = {
    "sensor_msgs/msg/JointState": {"joint_states"},
    "geometry_msgs/msg/PoseStamped": {"measured_pose", "target_pose"},
}


def withheld(topic: str, msgtype: str) -> str:
    """Why a message of this name on the graph may do something; empty when it does nothing."""
    end = topic.rsplit("/", 1)[-1]
    if why := _BY_TYPE.get(msgtype) or _BY_NAME.get(end):
        return why
    return MOVES if end not in _READINGS.get(msgtype, {end}) else ""


def recorded_name(topic: str, msgtype: str) -> str:
    """The name under which a topic is recorded."""
    return RECORDED + topic if topic == graph_name(topic) and withheld(topic, msgtype) else topic


def graph_name(topic: str) -> str:
    """The name that a recorded topic had on the graph."""
    return topic.removeprefix(RECORDED) if topic.startswith(f"{RECORDED}/") else topic
