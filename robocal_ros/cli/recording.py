# SPDX-License-Identifier: Apache-2.0
"""A bag as the recording of a session: its inputs, commands and robot, and the truth it tells."""

import contextlib
import json
import math
from array import array
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.bags.bags import BagInfo, BagMessage, BagReader, TopicInfo
from robocal_ros.bags.replay import (
    EVENTS,
    first_configuration,
    input_topics,
    needed_inputs,
    read_events,
    topic_kind,
)
from robocal_ros.cli.main import describe_robot
from robocal_ros.fixture.session import POINT
from robocal_ros.ground.errors import InputError, WrongRobotError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import (
    JOINTS,
    MEASURED_POINT,
    MEASURED_POSE,
    MEASURING,
    REFERENCE_SPHERE,
    SPHERE_CENTER,
    SPHERE_CLOUD,
    TEMPERATURES,
    stamp_ns,
)
from robocal_ros.hand_eye.data import COMPRESSED, IMAGE, PROFILE, SHOTS, TARGET_POSE, TRACKER_POINT
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import robot_folders
from robocal_ros.session.events import Command
from robocal_ros.tool.edges import EDGES

MEASURED = (*MEASURING, EDGES, *SHOTS, POINT)
UNASKED = "while this was recorded nobody gave its node a command"
INPUTS = (JOINTS, *MEASURED, TEMPERATURES)
_POSES = (
    "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Odometry",
)  # fmt: skip
_POINTS = ("geometry_msgs/msg/PointStamped", *_POSES)
TYPES = {  # of the messages that an input is read from, where others may look like it
    JOINTS: ("sensor_msgs/msg/JointState",),
    MEASURED_POINT: _POINTS,
    SPHERE_CENTER: _POINTS,
    REFERENCE_SPHERE: _POINTS,
    MEASURED_POSE: _POSES,
    SPHERE_CLOUD: ("sensor_msgs/msg/PointCloud2",),
    TEMPERATURES: ("sensor_msgs/msg/Temperature",),
    EDGES: ("robocal_msgs/msg/BeamEvent",),
    PROFILE: ("sensor_msgs/msg/PointCloud2",),
    TARGET_POSE: ("geometry_msgs/msg/PoseStamped",),
    IMAGE: ("sensor_msgs/msg/Image",),
    COMPRESSED: ("sensor_msgs/msg/CompressedImage",),
    TRACKER_POINT: _POINTS,
    POINT: ("geometry_msgs/msg/PointStamped",),
    EVENTS: ("robocal_msgs/msg/SessionEvent",),
}


@dataclass(frozen=True)
class BagOverview:
    """What a bag says before its samples are read."""

    reader: BagReader
    events: str | None  # topic of the commands
    inputs: Mapping[str, str]  # topic of the bag to input of the session
    configured: Command | None  # as recorded
    commands: list[tuple[Command, dict[str, Any]]]  # recorded ones, each with its outcome
    start_ns: int  # stamp of the first joint reading

    @property
    def lacks_measurements(self) -> str:
        """Says that the bag has no input that is measured, and which could be one; else empty."""
        info = self.reader.info
        if set(MEASURED) & set(self.inputs.values()):
            return ""
        return (
            f"{info.path} has none of {', '.join(MEASURED)}; {_has(info.topics)}; choose with "
            f"--topic INPUT:=TOPIC{_others(MEASURED_POINT, info.topics)}"
        )

    @property
    def warnings(self) -> list[str]:
        """What is wrong with the bag, as far as it was read, and what it lacks."""
        lacks = self.lacks_measurements
        return [*self.reader.info.notes, *([lacks] if lacks else [])]

    def require_inputs(self) -> None:
        """Refuse to obey commands whose samples are not here.

        Raises `InputError` when the bag lacks an input that the session had.
        """
        held = {kind.split("/")[0] for kind in self.inputs.values()}  # image/compressed: an image
        lacking = needed_inputs(self.configured, self.commands) - held
        if not lacking:
            return
        recorded = {} if self.configured is None else self.configured.arguments.get("topics", {})
        words = " and ".join(
            f"{kind} of {recorded[kind]}" if kind in recorded else kind for kind in sorted(lacking)
        )
        given = " ".join(f"--topic {kind}:=TOPIC" for kind in sorted(lacking))
        raise InputError(
            f"the session of {self.events} had {words}, which the bag lacks: record it too; where "
            f"the bag has it by another name, 'robocal replay' takes {given}",
            file=self.reader.info.path,
        )

    def samples(self) -> Iterator[BagMessage]:
        """Messages of the inputs, as they were recorded."""
        return self.reader.messages(self.inputs)

    def blocks(self) -> Iterator[BagMessage]:
        """As `samples`, with the joint states that follow each other together."""
        joints = [topic for topic, kind in self.inputs.items() if kind == JOINTS]
        return self.reader.messages(self.inputs, blocks=joints)


def open_recording(reader: BagReader, given: Mapping[str, str]) -> BagOverview:
    """Read the events and find the inputs.

    ``given``: input (or ``session_events``) to topic, where the user named it.

    Raises `InputError` when a topic is missing or ambiguous, or an event cannot be read.
    """
    info = reader.info
    for kind, topic in given.items():
        if kind not in (*INPUTS, EVENTS):
            known = ", ".join((*INPUTS, EVENTS))
            raise InputError(f"--topic {kind}: the inputs are {known}")
        if topic not in info.topics:
            raise InputError(f"no topic {topic}; {_has(info.topics)}", file=info.path)
        if not _fits(kind, info.topics[topic].msgtype):
            raise InputError(
                f"topic {topic} is of type {info.topics[topic].msgtype}; {kind} is read from "
                f"{', '.join(TYPES[kind])}{_others(kind, info.topics)}",
                file=info.path,
            )
    told = event_topics(info)
    if EVENTS in given:
        told = [given[EVENTS]]
    elif len(told) > 1:
        raise InputError(
            f"session events of more than one node: {', '.join(told)}; choose with "
            f"--topic {EVENTS}:=TOPIC",
            file=info.path,
        )
    event_topic = told[0] if told else None
    configured = first_configuration(reader.messages(told))
    inputs = {topic: kind for kind, topic in given.items() if kind != EVENTS}
    others = [
        topic
        for topic, held in info.topics.items()
        if topic not in inputs and _fits(topic_kind(topic), held.msgtype)
    ]
    found = input_topics(others, configured)
    inputs |= {t: kind for t, kind in found.items() if kind not in given and t in info.topics}
    start_ns = _first_joint_stamp(reader, inputs)
    configured, commands = read_events(reader.messages(told), start_ns)
    return BagOverview(reader, event_topic, inputs, configured, commands, start_ns)


def event_topics(info: BagInfo) -> list[str]:
    return [
        topic
        for topic, held in info.topics.items()
        if topic_kind(topic) == EVENTS and _fits(EVENTS, held.msgtype)
    ]


def _fits(kind: str, msgtype: str) -> bool:
    return kind not in TYPES or msgtype in TYPES[kind]


def _others(kind: str, topics: Mapping[str, TopicInfo]) -> str:
    """Which topics could be an input, by their type; empty without any."""
    found = [topic for topic, held in topics.items() if held.msgtype in TYPES.get(kind, ())]
    return f"; of such a type: {', '.join(found)}" if found else ""


def _has(topics: Mapping[str, Any]) -> str:
    return f"it has {', '.join(topics)}" if topics else "it has no topics"


def begin_ns(reader: BagReader) -> int:
    """When a bag begins, by its log or by the joint states' clock, whichever is earlier.

    What is stamped before is in the bag only because its topic is latched.
    """
    topics = reader.info.topics.items()
    joints = {t: JOINTS for t, found in topics if topic_kind(t) == JOINTS and found.messages}
    begin = [reader.info.start_ns or 0]
    return min(begin + ([_first_joint_stamp(reader, joints)] if joints else []))


def _first_joint_stamp(reader: BagReader, inputs: Mapping[str, str]) -> int:
    topics = [topic for topic, kind in inputs.items() if kind == JOINTS]
    if not topics:
        raise InputError(
            f"no joint states; {_has(reader.info.topics)}; choose with --topic {JOINTS}:=TOPIC"
            f"{_others(JOINTS, reader.info.topics)}",
            file=reader.info.path,
        )
    stamps = (stamp_ns(recorded.message.header.stamp) for recorded in reader.messages(topics))
    first = next(stamps, None)
    if first is None:
        raise InputError(f"topic {topics[0]} has no messages", file=reader.info.path)
    for stamp, following in pairwise(chain([first], stamps)):
        if following > stamp:  # as the session, which believes no stamp that none goes on from
            return stamp
    return first


def find_robot(name: str | None, warnings: list[str], configured: Command | None) -> SerialArm:
    """The arm that the user named, else the shipped one that the bag was recorded with.

    Raises `InputError`: nothing says which robot it is, or its file is not as docs/files.md says;
    `WrongRobotError`: it is none of the shipped robots.
    """
    if name is not None:
        robot, notes = describe_robot(name)
        warnings += notes
        return robot.arm
    if configured is None:
        raise InputError("the bag does not say which robot it is of: name it with --robot")
    wanted = configured.arguments.get("model_hash")
    for file in (file for folder in robot_folders() for file in sorted(folder.glob("*.yaml"))):
        with contextlib.suppress(InputError):  # a broken file of another robot is no matter here
            robot, notes = describe_robot(str(file))
            if robot.arm.model_hash == wanted:
                warnings += notes
                return robot.arm
    raise WrongRobotError(
        f"recorded with robot '{configured.arguments.get('robot')}', nominal model {wanted}, which "
        "is none of the shipped robots: give its file with --robot"
    )


Transforms = list[tuple[int, Array]]
CHECK_POINTS, TOOL, HAND_EYE = "/truth/check_points", "/truth/tool", "/truth/hand_eye"
TRANSFORMS = {TOOL: "T_flange_tool", HAND_EYE: "T_flange_sensor"}
STATE = "/truth/state"  # of whichever node tells it
NEAREST_NS = 120_000_000_000  # a truth is told within two minutes of its cycle
SERIES = {  # of a state, by what it is called here, the first that is told
    "without_m": ("visited_tcp_error_rms_m", "tcp_error_rms_m"),
    "with_m": ("commanded_tcp_error_rms_m",),
    "p95_m": ("commanded_tcp_error_p95_m",),
    "lambda_without": ("visited_within_share", "within_share"),
    "lambda_with": ("commanded_within_share",),
}


@dataclass(frozen=True, eq=False)
class CheckPoints:
    """Where the tool truly was at poses that were never measured, without correction.

    ``q`` (m, n): joints commanded, rad. ``tool`` (3,): in the flange, m. ``stamp_ns`` (t,): when it
    was told. ``position``: (t, m, 3), base, m; the first is the cold robot.
    """

    q: Array
    tool: Array
    stamp_ns: NDArray[np.int64]
    position: Array

    def moved(self, at_ns: int) -> Array | None:
        """Displacement (m, 3) since the cold robot, told nearest to a stamp; None: not near it."""
        away = np.abs(self.stamp_ns - at_ns)
        nearest = int(np.argmin(away))
        if away[nearest] > NEAREST_NS:
            return None
        return np.asarray(self.position[nearest] - self.position[0])


@dataclass(frozen=True, eq=False)
class ToldStates:
    """States of a simulated cell: 48 bytes of each, however much it tells.

    ``stamp_ns`` (t,): when each was told. ``series``: the `SERIES`, (t,) each; not a number where
    it is not told. ``faults``: stamp, ns, fault and size, SI (0: it ended), as they changed.
    ``transforms``: by their names, as they changed.
    """

    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    series: "dict[str, array[float]]" = field(
        default_factory=lambda: {name: array("d") for name in SERIES}
    )
    faults: list[tuple[int, str, float]] = field(default_factory=list)
    transforms: dict[str, Transforms] = field(
        default_factory=lambda: {name: [] for name in TRANSFORMS.values()}
    )
    _sizes: dict[str, float] = field(default_factory=dict)

    def add(self, stamp_ns: int, state: dict[str, Any]) -> None:
        """Take the next state. Raises ValueError or TypeError for what is no finite number."""
        self.stamp_ns.append(stamp_ns)
        for name, keys in SERIES.items():
            key = next((key for key in keys if key in state), None)
            self.series[name].append(math.nan if key is None else finite(state[key], key))
        now = state.get("faults", {})
        for fault in sorted({*now, *self._sizes}):
            size = finite(now.get(fault, 0.0), f"faults.{fault}")
            if size != self._sizes.get(fault, 0.0):
                self.faults.append((stamp_ns, fault, size))
                self._sizes[fault] = size
        for name, told in self.transforms.items():
            if name in state:
                _add_changed(told, stamp_ns, state, name)


class BagTruth:
    """The truth that a bag tells, of each robot by its namespace; the states are read once.

    What cannot be read is an `InputError` that names its topic.
    """

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._topics = reader.info.topics

    @cached_property
    def states(self) -> dict[str, ToldStates]:
        """Those of each cell, by their topic; without a cell that tells none."""
        found = {topic: ToldStates() for topic in self._topics if topic.endswith(STATE)}
        for topic, states in found.items():
            with self.reading(topic):
                for stamp_ns, state in self._told(topic):
                    states.add(stamp_ns, state)
        return {topic: states for topic, states in found.items() if states.stamp_ns}

    def state_topic(self, namespace: str) -> str | None:
        """Topic of the states that are told in a namespace, by a node or not; None without any.

        Raises `InputError` when there are several, and nothing says which is meant.
        """
        places = {topic: topic.removesuffix(STATE) for topic in self.states}
        found = [topic for topic, place in places.items() if place == namespace]
        found = found or [topic for topic, place in places.items() if above(place) == namespace]
        if len(found) > 1:
            raise InputError(
                f"{' and '.join(found)} tell two truths of what is in namespace "
                f"'{namespace or '/'}': give each robot's topics a namespace of their own",
                file=self._reader.info.path,
            )
        return found[0] if found else None

    def transforms(self, topic: str, namespace: str) -> Transforms:
        """Stamps, ns, and transforms (4, 4) from then on, of `TRANSFORMS`; empty: none is told."""
        name, own = TRANSFORMS[topic], f"{namespace}{topic}"
        told: Transforms = []
        with self.reading(own):
            for stamp_ns, truth in self._told(own):
                _add_changed(told, stamp_ns, truth, name)
        if told:
            return told
        states = self.state_topic(namespace)
        return [] if states is None else self.states[states].transforms[name]

    def check_points(self, namespace: str) -> CheckPoints | None:
        """The true positions that a bag tells; None where it tells none."""
        topic = f"{namespace}{CHECK_POINTS}"
        stamps: list[int] = []
        positions: list[Array] = []
        with self.reading(topic):
            for stamp_ns, truth in self._told(topic):
                if not stamps:
                    q, tool = _array(truth, "q_rad"), _array(truth, "tool_in_flange_m")
                stamps.append(stamp_ns)
                positions.append(_array(truth, "position_m"))
            if not stamps:
                return None
            return CheckPoints(q, tool, np.array(stamps, dtype=np.int64), np.array(positions))

    def _told(self, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
        if topic in self._topics:
            for recorded in self._reader.messages([topic]):
                yield recorded.log_time_ns, json.loads(recorded.message.data)

    @contextmanager
    def reading(self, topic: str) -> Iterator[None]:
        """Tell what goes wrong with a topic as an `InputError` that names it."""
        try:
            yield
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            why = f"no {error}" if isinstance(error, KeyError) else error
            words = f"topic {topic} cannot be read: {why}"
            raise InputError(words, file=self._reader.info.path) from error


def is_simulated(reader: BagReader) -> bool:
    """Whether a bag tells any truth: what is measured has none."""
    return any("truth" in topic.split("/") for topic in reader.info.topics)


def above(name: str) -> str:
    """The namespace of a node or topic: empty for the root."""
    return name.rpartition("/")[0]


def finite(value: Any, name: str) -> float:
    """A number that was told. Raises ValueError, with its name, when it is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"{name} is {value}, which is no finite number")
    return float(value)


def _array(truth: dict[str, Any], name: str) -> Array:
    found = np.array(truth[name], dtype=np.float64)
    if not np.isfinite(found).all():
        raise ValueError(f"{name} holds what is no finite number: {truth[name]}")
    return found


def _add_changed(told: Transforms, stamp_ns: int, truth: dict[str, Any], name: str) -> None:
    T = _array(truth, name)
    if T.shape != (4, 4):
        raise ValueError(f"{name} has the shape {T.shape}, not (4, 4)")
    if not told or not np.array_equal(told[-1][1], T):
        told.append((stamp_ns, T))
