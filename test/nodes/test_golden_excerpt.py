"""The tool in the golden shift's ten minutes, live: what a replay gives, bit for bit."""

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from excerpt_live import (
    BAG,
    NS,
    ROBOT,
    TOOL_EVENTS,
    arguments,
    commands_of,
    kept,
    said,
    told,
)
from robocal_msgs.msg import SessionEvent
from tool_cell_live import STREAM

from robocal_ros import __version__
from robocal_ros.bags import replay
from robocal_ros.bags.bags import BagReader
from robocal_ros.cli.recording import BagOverview, open_recording
from robocal_ros.ground.samples import JOINTS
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.session import events
from robocal_ros.session.events import ONLY, Command
from robocal_ros.tool.laser_frame import LaserFile, write_laser
from robocal_ros.tool.node import TcfNode
from robocal_ros.tool.session import take_tool_message, tool_session_as_recorded


@pytest.fixture
def bag() -> Iterator[BagReader]:
    with BagReader(BAG) as reader:
        yield reader


def test_the_tool_node_says_what_a_replay_says(graph: Any, bag: BagReader, tmp_path: Path) -> None:
    """Check, full measurement, acceptance, verification, and the next gap's check.

    Each sample of the runs over DDS, each command at its own reading, all outcomes equal.
    """
    recording = open_recording(bag, {replay.EVENTS: TOOL_EVENTS})
    arm, configured = load_robot(ROBOT), recording.configured
    assert configured is not None
    with kept(tmp_path, "again") as history:
        session = tool_session_as_recorded(arm, history, configured, __version__)
        again = replay.replay(
            session, recording.blocks(), recording.commands, recording.inputs, take_tool_message
        )
    with kept(graph.state, "K7") as history:
        config = tool_session_as_recorded(arm, history, configured, __version__).config
    live = graph.collect(SessionEvent, TOOL_EVENTS, EVENTS)
    node = graph.add(TcfNode, tool_settings(config, tmp_path / "laser.yaml"))
    play_runs(graph, node, bag, recording)
    wanted = [told(outcome) for outcome in again.outcomes]
    graph.spin_until(lambda: len(commands_of(live)) >= len(wanted), "the last event arrives")
    assert arguments(live[0]) == dict(configured.arguments)
    assert [said(event) for event in commands_of(live)] == wanted
    modes = [arguments(e)["mode"] for e in live if e.command == events.MEASURE_TOOL]
    assert modes == ["quick", "full", "quick", "quick"]


def tool_settings(config: Any, laser: Path) -> dict[str, Any]:
    """The live node's parameters that give these settings."""
    arm = load_robot(ROBOT)
    write_laser(laser, LaserFile(config.laser, config.station, arm.name, arm.model_hash))
    return {
        "robot": ROBOT,
        "serial": "K7",
        "laser": str(laser),
        "taught_xyz_mm": (config.T_flange_taught[:3, 3] * 1e3).tolist(),
        "spin_deg": -135.0,
        "joint_silence_s": 10.0,
        "change_limit_mm": config.limits.change_m * 1e3,
        "tilt_limit_deg": round(math.degrees(config.limits.tilt_rad), 9),
    }


def play_runs(graph: Any, node: TcfNode, bag: BagReader, recording: BagOverview) -> None:
    """Joints and edges of each run, from its begin to its end; nothing else decides anything."""
    inputs = {topic: node.inputs[kind] for topic, kind in recording.inputs.items()}
    kinds = {s.topic_name: s.msg_type for s in node.subscriptions if s.topic_name in inputs}
    publishers = {topic: graph.publisher(kinds[topic], topic, STREAM) for topic in inputs}
    asked = [c for c, _ in recording.commands if c.name in ASKED]
    runs, sent = spans(recording), 0

    def taken(behind: int) -> None:
        """Topics stay in step: an edge must not overtake the readings around it by much."""
        received = sum(count.received for count in inputs.values())
        if received < sent - behind:
            graph.spin_until(
                lambda: sum(i.received for i in inputs.values()) >= sent - behind, "the samples"
            )

    for message in bag.messages(inputs, raw=True):
        stamp_ns = stamp_of(message.message)
        if not any(first <= stamp_ns <= last for first, last in runs):
            continue
        publishers[message.topic].publish(message.message)
        sent += 1
        taken(4)
        while asked and recording.inputs[message.topic] == JOINTS and stamp_ns == mark(asked[0]):
            taken(0)
            node._desk.ask(as_asked(asked.pop(0)))
    assert not asked


# Not by those who drive the robot; the session sees the end of a step by itself.
ASKED = (events.MEASURE_TOOL, events.STEP_BEGINS, events.ACCEPT)


def spans(recording: BagOverview) -> list[tuple[int, int]]:
    """Stamps of a reading somewhat before each run's begin, and of the one that ends it."""
    found: list[tuple[int, int]] = []
    for command, _ in recording.commands:
        if command.name == events.MEASURE_TOOL:
            found.append((mark(command) - NS // 2, mark(command)))
        elif command.name == events.TOOL_STEP:
            found[-1] = (found[-1][0], mark(command))
    return found


def mark(command: Command) -> int:
    return (command.marks or {})[JOINTS]


def stamp_of(cdr: bytes) -> int:
    """Of a serialized message that begins with its header."""
    seconds, nanoseconds = struct.unpack_from("<iI", cdr, 4)
    return int(seconds) * NS + int(nanoseconds)


def as_asked(command: Command) -> Command:
    """The same of a history with ids of its own."""
    given = {name: value for name, value in command.arguments.items() if name != "id"}
    if command.name == events.ACCEPT:
        given["choose"] = ONLY
    return Command(command.name, given, command.stamp_ns)
