# SPDX-License-Identifier: Apache-2.0
"""The golden tool bags: replayed, and played through the live node, with the same results."""

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from command import robocal_json
from long_form import more
from rclpy.serialization import deserialize_message
from recordings import with_events
from robocal_msgs.msg import BeamEvent, SessionEvent
from sensor_msgs.msg import JointState
from tool_cell_live import STREAM

from robocal_ros.bags.bags import BagReader
from robocal_ros.ground.errors import Code
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.session.events import (
    ACCEPT,
    CONFIGURE,
    MEASURE_TOOL,
    SOLVE_SWEEPS,
    SWEEP,
    TOOL_STEP,
    Command,
)
from robocal_ros.tool.laser_frame import LaserFile, write_laser
from robocal_ros.tool.node import TcfNode
from robocal_ros.tool.run import ToolConfig

BAGS = Path(__file__).parents[2] / "bags"
EVENT_TOPIC = "/tcf_node/session_events"
INPUTS = {"/joint_states": JointState, "/beam_events": BeamEvent}
CALLED = (MEASURE_TOOL, SWEEP, SOLVE_SWEEPS, ACCEPT)


@pytest.fixture(scope="module", params=["tool_runs", *more("sweeps")])
def bag(request: Any, tmp_path_factory: Any) -> Path:
    """A bag made anew: only on the machine that made it are results equal to the last bit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BAGS))
        path = tmp_path_factory.mktemp("bag") / f"{request.param}.mcap"
        import_module(f"make_{request.param}").record(path)
    return path


def recorded(bag: Path) -> list[SessionEvent]:
    with BagReader(bag) as reader:
        return [m.message for m in reader.messages([EVENT_TOPIC])]


@pytest.fixture
def node(graph: Any, tmp_path: Path, bag: Path) -> TcfNode:
    """The live node with the recorded settings."""
    document = json.loads(recorded(bag)[0].arguments)["arguments"]["config"]
    config, arm = ToolConfig.of_document(document), load_robot("ur10")
    path = tmp_path / "laser.yaml"
    write_laser(path, LaserFile(config.laser, config.station, arm.name, arm.model_hash))
    taught_mm = (config.T_flange_taught[:3, 3] * 1e3).tolist()
    settings = {"laser": str(path), "input_period_ms": 2.0, "taught_xyz_mm": taught_mm}
    if (beams := config.parallel) is not None:
        settings |= {
            f"parallel_{k}_mm": 1e3 * getattr(beams, f"{k}_m") for k in ("up", "down", "x")
        }
    return graph.add(TcfNode, settings | {"joint_silence_s": 10.0})


def test_live_equals_replay_bit_for_bit(
    graph: Any, node: TcfNode, bag: Path, tmp_path: Path
) -> None:
    """Every sample over DDS; the calls where they were made; every outcome as it was recorded."""
    live = graph.collect(SessionEvent, EVENT_TOPIC, EVENTS)
    publishers = {topic: graph.publisher(kind, topic, STREAM) for topic, kind in INPUTS.items()}
    sent = 0
    with BagReader(bag) as reader:
        for m in reader.messages([*INPUTS, EVENT_TOPIC], raw=True):
            if m.topic in INPUTS:
                publishers[m.topic].publish(deserialize_message(m.message, INPUTS[m.topic]))
                sent += 1
                _wait(graph, node, sent, 4)
                continue
            event = deserialize_message(m.message, SessionEvent)
            if event.command in CALLED:
                _wait(graph, node, sent, 0)
                graph.executor.spin_once(timeout_sec=0.0)
                arguments = json.loads(event.arguments)["arguments"]
                node._desk.ask(Command(event.command, arguments))
    wanted = [_told(e) for e in recorded(bag)]
    graph.spin_until(lambda: len(live) >= len(wanted), "all events")
    assert [_told(e) for e in live] == wanted
    again = with_events(bag, live, tmp_path / "live.mcap", EVENT_TOPIC, INPUTS)
    document = robocal_json("replay.tool.json", "replay", again)
    assert document["differs"] == []
    taken = [c for c in document["commands"] if c["command"] in (TOOL_STEP, SWEEP)]
    assert len(taken) == {"tool_runs": 17, "sweeps": 6}[bag.stem]


def _told(event: SessionEvent) -> Any:
    """A command with the bounds of its samples, and its status."""
    arguments = json.loads(event.arguments)
    if event.command == CONFIGURE:
        arguments = {}
    status = json.loads(event.outcome).get("status")
    return event.command, event.stamp.sec, event.stamp.nanosec, arguments, status


def _wait(graph: Any, node: TcfNode, sent: int, behind: int) -> None:
    """Topics stay in step: an edge must not overtake the readings around it by much."""
    inputs = [node.inputs[topic.lstrip("/")] for topic in INPUTS]
    graph.spin_until(lambda: sum(i.received for i in inputs) >= sent - behind, "the samples")


def test_the_recording_holds_each_ending(bag: Path) -> None:
    ends = [json.loads(e.outcome) for e in recorded(bag) if e.command in (TOOL_STEP, SWEEP)]
    codes = {Code(end["status"]) for end in ends}
    beyond = {Code.LIMIT_EXCEEDED} if bag.stem == "tool_runs" else set()  # no sweep judges a tool
    assert codes == {Code.ACCEPT, Code.BEAM_EDGES_WRONG} | beyond
