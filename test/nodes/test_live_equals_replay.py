# SPDX-License-Identifier: Apache-2.0
"""A recording of a node that loses messages is replayed as live; what it lacks is told."""

from pathlib import Path
from typing import Any

import pytest
from command import robocal_json
from diagnostic_msgs.msg import DiagnosticArray
from robocal_msgs.msg import SessionEvent
from tool_cell_live import LiveCell
from tool_driver import TRUTH

from robocal_ros.bags.bag_writer import recordings
from robocal_ros.bags.bags import BagReader, BagWriter
from robocal_ros.bags.recorder_node import RecorderNode
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics.arm import model_document
from robocal_ros.ros.session_node import EVENTS, POLL_S
from robocal_ros.session.events import ACCEPT, CONFIGURE, Command, bring_into_force

TOPICS = ["joint_states", "beam_events", "tcf_node/session_events"]
JOINTS, EVENT_TOPIC = "/joint_states", "/tcf_node/session_events"
DEPTH, BURST, EVERY = 4, 6, 100  # of each hundred joint states two find the node's queue full
QOS = {f"qos_overrides.{JOINTS}.subscription.{key}": value for key, value in (("depth", DEPTH),)}


class Recorded(LiveCell):
    """A robot whose joint states come in bursts now and then, and a recorder that hears all."""

    def __init__(self, graph: Any, folder: Path, **parameters: Any) -> None:
        super().__init__(graph, folder, TRUTH, joint_silence_s=10.0, **parameters)
        self.folder = folder / "recordings"
        self.recorder = graph.add(RecorderNode, {"topics": TOPICS, "folder": str(self.folder)})
        found = self.recorder._topics.found
        graph.spin_until(lambda: len(found) == len(TOPICS), "all topics are recorded")
        self.rest(0.1)

    def _taken(self, waiting: int) -> None:
        """As `LiveCell._taken`, but for what is lost; a burst is not waited for."""
        self.published = getattr(self, "published", 0) + 1
        counts = self.node.inputs.values()

        def near() -> bool:
            taken = sum(count.received + count.lost for count in counts)
            return taken >= self.published - waiting

        if self.published % EVERY >= BURST:
            self.graph.spin_until(near, "the samples arrive")

    def recording(self) -> Path:
        """The complete recording."""
        wanted = self.node.inputs["joint_states"].received
        recorded = self.recorder._topics.found[JOINTS]
        self.graph.spin_until(lambda: recorded.messages >= wanted, "the recorder has them")
        self.graph.spin_for(0.2)
        self.recorder.trigger_deactivate()
        return recordings(self.folder)[-1].folder


def test_joint_states_that_the_node_lost_are_left_out_of_the_replay(
    graph: Any, tmp_path: Path
) -> None:
    said = graph.collect(DiagnosticArray, "/diagnostics")
    cell = Recorded(graph, tmp_path, **QOS)
    assert cell.measure().success
    lost = cell.node.inputs["joint_states"].lost
    assert lost > 10
    words = "messages lost on joint_states"
    graph.spin_until(lambda: any(words in s.message for m in said for s in m.status), words)
    recording = cell.recording()
    document = robocal_json("replay.tool.json", "replay", recording)
    assert document["differs"] == []
    (left_out,) = [w for w in document["warnings"] if "never came to the node" in w]
    assert 10 < int(left_out.split()[0]) <= lost


@pytest.mark.long
def test_what_the_recorder_lost_is_told(graph: Any, tmp_path: Path) -> None:
    cell = Recorded(graph, tmp_path)
    assert cell.measure().success
    whole, part = cell.recording(), tmp_path / "part.mcap"
    with BagReader(whole) as reader, BagWriter(part, latched=[EVENT_TOPIC]) as writer:
        for number, m in enumerate(reader.messages()):
            if m.topic != JOINTS or number % EVERY:
                kind = reader.info.topics[m.topic].msgtype
                writer.write(m.topic, kind, m.message, m.log_time_ns)
    assert robocal_json("replay.tool.json", "replay", whole)["differs"] == []
    document = robocal_json("replay.tool.json", "replay", part)
    assert any("joint states that the node had" in words for words in document["differs"])
    assert any("the recording lacks" in words for words in document["warnings"])


def test_a_model_that_comes_into_force_is_told_before_the_command_that_goes_by_it(
    graph: Any, tmp_path: Path
) -> None:
    """Between two looks at the history a tool of the model before is accepted."""
    state = tmp_path / "state"
    cell = Recorded(graph, tmp_path, state_dir=str(state))
    found = cell.measure()
    assert found.success
    live = graph.collect(SessionEvent, EVENT_TOPIC, EVENTS)
    arm = cell.cell.arm
    cell.node._look()  # and now it looks away
    with CalibrationHistory.open(
        "K7", model_hash=arm.model_hash, state_dir=state, owner=False
    ) as history:
        bring_into_force(history, THERMAL, arm, model_document(arm), "test")
    done = cell.node._desk.ask(Command(ACCEPT, {"id": found.candidate_id, "by": "me"}))
    assert not done.result().done
    graph.spin_for(2.0 * POLL_S)
    names = [event.command for event in live]
    assert names[-1] == ACCEPT
    assert names[-2] == CONFIGURE
    document = robocal_json("replay.tool.json", "replay", cell.recording())
    assert document["differs"] == []
