# SPDX-License-Identifier: Apache-2.0
"""A recording that follows another: replayed by itself, it gives what the live nodes said."""

import json
from pathlib import Path
from typing import Any

from cell import Cell, outcomes
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import SessionEvent
from robocal_msgs.srv import Decide
from shift import Shift, built, postures, warmed
from std_srvs.srv import Trigger
from tool_cell_live import LiveCell
from tool_driver import TRUTH

from robocal_ros.bags.bag_writer import recordings
from robocal_ros.bags.recorder_node import LOOK_S
from robocal_ros.cli.main import main
from robocal_ros.ground.errors import Code
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros.session_node import EVENTS

RECORDER = "recorder_node"
MANY = EVENTS.depth + EVENTS.depth // 4  # more than a recording gets of what was before it
UNKNOWN_ID = 10_000
FULL, QUICK = MeasureTool.Goal.FULL, MeasureTool.Goal.QUICK


def begun_anew(graph: Any, refuse: Any, live: list[SessionEvent]) -> None:
    """Many events, and a recording that begins after them."""
    for _ in range(MANY):
        assert not refuse(id=UNKNOWN_ID).success
    split = graph.call(Trigger, f"/{RECORDER}/split")
    assert split.success, split.message
    graph.spin_for(1.0)  # the recorder asks for what is latched
    live.clear()


def judged(
    graph: Any, recorder: Any, live: list[SessionEvent], tmp_path: Path, capsys: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The second recording replayed, and its row of a report; both equal what was live."""
    graph.spin_for(1.0)
    assert recorder.stop() == 0, recorder.output
    folder = recordings(graph.state / "rec")[1].folder
    capsys.readouterr()
    assert main(["replay", str(folder), "--json"]) == 0
    replayed = json.loads(capsys.readouterr().out)
    assert replayed["differs"] == []
    said = [(name, Code(told["status"]).name, told["samples"]) for name, told in outcomes(live)]
    assert said
    assert [(c["command"], c["code"], c["samples"]) for c in replayed["commands"]] == said
    report = tmp_path / "report"
    assert main(["validate", str(folder), "--report", str(report), "--json", "--jobs", "1"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["bags"]
    assert (row["as_recorded"], row["differs"]) == (True, 0)
    return replayed, row


def recorded(graph: Any, inputs: Any, *topics: str) -> Any:
    """A recorder of these topics, once it hears ``inputs``, a publisher of one."""
    given = {"topics": f"[{', '.join(topics)}]", "folder": graph.state / "rec"}
    recorder = graph.start(RECORDER, given)
    graph.spin_until(lambda: inputs.get_subscription_count() == 2, "it is recorded")
    graph.spin_for(2 * LOOK_S)  # the other topics too
    return recorder


def test_a_thermal_session(graph, tmp_path, capsys):
    nominal = load_robot("kr150_r3100")
    cold, q = built(nominal), postures(nominal, 8)
    shift = Shift(nominal.joint_names)
    visits = [list(shift.visit(warmed(cold, k), q, after_h=k / 7.5)) for k in (0.0, 15.0, 20.0)]
    cell = Cell(graph)
    topics = "joint_states", "measured_point", "thermal_node/session_events"
    recorder = recorded(graph, cell.joints, *topics)
    cell.play(visits[0])
    assert cell.call("capture_reference").success
    cell.play(visits[1])
    found = cell.call("identify", cycle_id="one")
    assert cell.call("accept", id=found.candidate_id).success
    begun_anew(graph, lambda **given: cell.call("reject", **given), cell.events)
    cell.play(visits[2])
    assert cell.call("identify", cycle_id="two").success
    replayed, row = judged(graph, recorder, cell.events, tmp_path, capsys)
    (candidate,) = replayed["candidates"]
    assert candidate["verdict"]["code"] == "ACCEPT"
    assert (row["kind"], row["cycles"]) == ("thermal", 1)


def test_a_tool_session(graph, tmp_path, capsys):
    cell = LiveCell(graph, tmp_path, TRUTH)
    live = graph.collect(SessionEvent, "/tcf_node/session_events", EVENTS)
    topics = "joint_states", "beam_events", "tcf_node/session_events"
    recorder = recorded(graph, cell.joints, *topics)
    full = cell.measure()
    accepted = graph.call(Decide, "/tcf_node/accept", id=full.candidate_id, by="me")
    assert accepted.success, accepted.message
    begun_anew(graph, lambda **given: graph.call(Decide, "/tcf_node/reject", **given), live)
    assert cell.measure(QUICK).answer == MeasureTool.Result.PASS
    assert cell.measure(FULL).success
    replayed, row = judged(graph, recorder, live, tmp_path, capsys)
    assert [run["run"] for run in replayed["runs"]] == [2, 3]
    assert (row["kind"], row["runs"]) == ("tool", 2)
