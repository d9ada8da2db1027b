# SPDX-License-Identifier: Apache-2.0
"""A recording that follows another: replayed by itself, it gives what the live nodes said."""

import json
from pathlib import Path
from typing import Any

import pytest
from cell import Cell, outcomes
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import SessionEvent
from robocal_msgs.srv import Decide
from shift import Shift, built, postures, warmed
from std_srvs.srv import Trigger
from tool_cell_live import LiveCell
from tool_driver import TRUTH

from robocal_ros.bags.bag_writer import recordings
from robocal_ros.bags.recorder_node import RecorderNode
from robocal_ros.cli.main import main
from robocal_ros.ground.errors import Code
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros.session_node import EVENTS

MANY = EVENTS.depth + EVENTS.depth // 4  # more than a recording gets of what was before it
UNKNOWN_ID = 10_000
FULL, QUICK = MeasureTool.Goal.FULL, MeasureTool.Goal.QUICK


class Recorder:
    """Records a node's session; in this process, where it is known what it has taken.

    ``inputs``: the publisher of each of its topics.
    """

    def __init__(self, graph: Any, session: str, **inputs: Any) -> None:
        self.graph, self.events = graph, f"/{session}/session_events"
        self.live = graph.collect(SessionEvent, self.events, EVENTS)
        self._inputs = [f"/{topic}" for topic in inputs]
        topics = [*self._inputs, self.events]
        self.node = graph.add(RecorderNode, {"topics": topics, "folder": str(graph.state / "rec")})
        graph.spin_until(
            lambda: (
                not self.node.health().values["not there"]
                and all(publisher.get_subscription_count() == 2 for publisher in inputs.values())
            ),
            "all topics are recorded",
        )

    def taken(self, *topics: str) -> int:
        """How many messages came of topics."""
        values = self.node.health().values
        return sum(values.get(f"{topic} recorded", 0) for topic in topics)

    def begin_anew(self, refuse: Any) -> None:
        """Many events, and a recording that begins after them."""
        for _ in range(MANY):
            assert not refuse(id=UNKNOWN_ID).success
        split = self.graph.call(Trigger, f"/{self.node.get_name()}/split")
        assert split.success, split.message
        self.graph.spin_until(
            lambda: (
                sum(event.command == "reject" for event in self.live) == MANY
                and self.taken(self.events) == EVENTS.depth
            ),
            "what is latched is recorded anew",
        )
        self.live.clear()

    def judged(
        self, sent: int, last_id: int, tmp_path: Path, capsys: Any
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """The second recording replayed, and its row of a report; both equal what was live.

        ``sent``: messages of the inputs in both; ``last_id``: of the last candidate.
        """
        live = self.live
        self.graph.spin_until(
            lambda: (
                last_id in (told["id"] for _, told in outcomes(live))
                and self.taken(self.events) == EVENTS.depth + len(live)
                and self.taken(*self._inputs) == sent
            ),
            "all is recorded",
        )
        self.node.trigger_deactivate()
        folder = recordings(self.graph.state / "rec")[1].folder
        capsys.readouterr()
        assert main(["replay", str(folder), "--json"]) == 0
        replayed = json.loads(capsys.readouterr().out)
        assert replayed["differs"] == []
        said = [(name, Code(told["status"]).name, told["samples"]) for name, told in outcomes(live)]
        assert said
        assert [(c["command"], c["code"], c["samples"]) for c in replayed["commands"]] == said
        report = tmp_path / "report"
        words = ["validate", str(folder), "--report", str(report), "--json", "--jobs", "1"]
        assert main(words) == 0
        (row,) = json.loads(capsys.readouterr().out)["bags"]
        assert (row["as_recorded"], row["differs"]) == (True, 0)
        return replayed, row


@pytest.mark.long
def test_a_thermal_session(graph, tmp_path, capsys):
    nominal = load_robot("kr150_r3100")
    cold, q = built(nominal), postures(nominal, 8)
    shift = Shift(nominal.joint_names)
    visits = [list(shift.visit(warmed(cold, k), q, after_h=k / 7.5)) for k in (0.0, 15.0, 20.0)]
    cell = Cell(graph)
    inputs = {"joint_states": cell.joints, "measured_point": cell.points}
    recorder = Recorder(graph, "thermal_node", **inputs)
    cell.play(visits[0])
    assert cell.call("capture_reference").success
    cell.play(visits[1])
    found = cell.call("identify", cycle_id="one")
    assert cell.call("accept", id=found.candidate_id).success
    recorder.begin_anew(lambda **given: cell.call("reject", **given))
    cell.play(visits[2])
    found = cell.call("identify", cycle_id="two")
    assert found.success
    sent = sum(cell.sent[topic] for topic in inputs)
    replayed, row = recorder.judged(sent, found.candidate_id, tmp_path, capsys)
    (candidate,) = replayed["candidates"]
    assert candidate["verdict"]["code"] == "ACCEPT"
    assert (row["kind"], row["cycles"]) == ("thermal", 1)


def test_a_tool_session(graph, tmp_path, capsys):
    cell = LiveCell(graph, tmp_path, TRUTH)
    recorder = Recorder(graph, "tcf_node", joint_states=cell.joints, beam_events=cell.edges)
    full = cell.measure()
    accepted = graph.call(Decide, "/tcf_node/accept", id=full.candidate_id, by="me")
    assert accepted.success, accepted.message
    recorder.begin_anew(lambda **given: graph.call(Decide, "/tcf_node/reject", **given))
    assert cell.measure(QUICK).answer == MeasureTool.Result.PASS
    full = cell.measure(FULL)
    assert full.success
    replayed, row = recorder.judged(cell.published, full.candidate_id, tmp_path, capsys)
    assert [run["run"] for run in replayed["runs"]] == [2, 3]
    assert (row["kind"], row["runs"]) == ("tool", 2)
