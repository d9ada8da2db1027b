"""A bag as a recording of a session: its inputs, its commands, its beginning."""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any

from robocal_ros.bags.bags import BagMessage, BagReader
from robocal_ros.bags.replay import (
    EVENTS,
    first_configuration,
    input_topics,
    needed_inputs,
    read_events,
    topic_kind,
)
from robocal_ros.cli.arguments import describe_robot
from robocal_ros.ground.errors import InputError, WrongRobotError
from robocal_ros.ground.samples import JOINTS, MEASURING, TEMPERATURES, stamp_ns
from robocal_ros.hand_eye.shots import SHOTS
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import robot_folders
from robocal_ros.session.events import Command
from robocal_ros.tool.edges import EDGES

MEASURED = (*MEASURING, EDGES, *SHOTS)
UNASKED = "while this was recorded nobody gave its node a command"
INPUTS = (JOINTS, *MEASURED, TEMPERATURES)


@dataclass(frozen=True)
class BagOverview:
    """What a bag says before its samples are read.

    Attributes
    ----------
    events : topic of the commands, or None.
    inputs : topic of the bag to input of the session.
    configured : the recorded configuration, or None.
    commands : recorded commands, each with its recorded outcome.
    start_ns : stamp of the first joint reading.
    """

    reader: BagReader
    events: str | None
    inputs: Mapping[str, str]
    configured: Command | None
    commands: list[tuple[Command, dict[str, Any]]]
    start_ns: int

    @property
    def warnings(self) -> list[str]:
        """What is wrong with the bag, as far as it was read, and what it lacks."""
        info = self.reader.info
        lacking = not set(MEASURED) & set(self.inputs.values())
        words = f"{info.path} has none of {', '.join(MEASURED)}; {_has(info.topics)}"
        return [*info.notes, words] if lacking else list(info.notes)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time."""
        info = self.reader.info
        return info.start_ns or 0, info.end_ns or 0

    def require_inputs(self) -> None:
        """Refuse to obey commands whose samples are not here.

        Raises
        ------
        InputError
            When the bag lacks an input that the session had.
        """
        lacking = needed_inputs(self.configured, self.commands) - set(self.inputs.values())
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

    Raises
    ------
    InputError
        When a topic is missing or ambiguous, or an event cannot be read.
    """
    info = reader.info
    _require_topics(given, info.topics, info.path)
    event_topic = given.get(EVENTS) or _event_topic(info.topics, info.path)
    told = [] if event_topic is None else [event_topic]
    configured = first_configuration(reader.messages(told))
    inputs = {topic: kind for kind, topic in given.items() if kind != EVENTS}
    others = [topic for topic in info.topics if topic not in inputs]
    found = input_topics(others, configured)
    inputs |= {t: kind for t, kind in found.items() if kind not in given and t in info.topics}
    start_ns = _first_joint_stamp(reader, inputs)
    configured, commands = read_events(reader.messages(told), start_ns)
    return BagOverview(reader, event_topic, inputs, configured, commands, start_ns)


def _has(topics: Mapping[str, Any]) -> str:
    return f"it has {', '.join(topics)}" if topics else "it has no topics"


def _require_topics(given: Mapping[str, str], topics: Mapping[str, Any], path: str) -> None:
    for kind, topic in given.items():
        if kind not in (*INPUTS, EVENTS):
            known = ", ".join((*INPUTS, EVENTS))
            raise InputError(f"--topic {kind}: the inputs are {known}")
        if topic not in topics:
            raise InputError(f"no topic {topic}; {_has(topics)}", file=path)


def _event_topic(topics: Mapping[str, Any], path: str) -> str | None:
    found = [topic for topic in topics if topic_kind(topic) == EVENTS]
    if len(found) > 1:
        raise InputError(
            f"session events of more than one node: {', '.join(found)}; choose with "
            f"--topic {EVENTS}:=TOPIC",
            file=path,
        )
    return found[0] if found else None


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
            f"no joint states; {_has(reader.info.topics)}; choose with --topic {JOINTS}:=TOPIC",
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


# ---- which robot a bag is of --------------------------------------------------------------------


def find_robot(name: str | None, warnings: list[str], configured: Command | None) -> SerialArm:
    """The arm that the user named, else the shipped one that the bag was recorded with.

    Raises
    ------
    InputError
        Nothing says which robot it is, or its file is not as docs/files.md says.
    WrongRobotError
        It is none of the shipped robots.
    """
    if name is not None:
        return describe_robot(name, warnings).arm
    if configured is None:
        raise InputError("the bag does not say which robot it is of: name it with --robot")
    wanted = configured.arguments.get("model_hash")
    for file in (file for folder in robot_folders() for file in sorted(folder.glob("*.yaml"))):
        notes: list[str] = []
        with contextlib.suppress(InputError):  # a broken file of another robot is no matter here
            arm = describe_robot(str(file), notes).arm
            if arm.model_hash == wanted:
                warnings += notes
                return arm
    raise WrongRobotError(
        f"recorded with robot '{configured.arguments.get('robot')}', nominal model {wanted}, which "
        "is none of the shipped robots: give its file with --robot"
    )
