# SPDX-License-Identifier: Apache-2.0
"""Real measurements through the live nodes: the results of ``robocal replay``, bit for bit."""

import json
from pathlib import Path
from typing import Any

import pytest
from command import robocal
from diagnostic_msgs.msg import DiagnosticArray
from history_content import content
from long_form import more
from recordings import with_events
from robocal_msgs.msg import SessionEvent
from robocal_msgs.srv import Decide, Identify
from std_msgs.msg import String

from robocal_ros.bags import ur10_campaigns
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS

pytestmark = pytest.mark.data

CONFIG = Path(__file__).parents[2] / "config" / "replay.yaml"
INPUTS = ("joint_states", "measured_pose")
EVENT_TOPIC = "/thermal_node/session_events"
CYCLE = "window-1"  # as --auto names it


def played(graph: Any, bag: Path, serial: str, poses: int) -> list[SessionEvent]:
    """Play the bag into a thermal node; it has taken all of it in. Returns its events."""
    sent = {"/joint_states": poses * len(ur10_campaigns.AROUND_NS), "/measured_pose": poses}
    events = graph.collect(SessionEvent, EVENT_TOPIC, EVENTS)
    reports = graph.collect(String, "/replay_node/status", endpoints.LATCHED)
    diagnostics = graph.collect(DiagnosticArray, "/diagnostics")
    settings = {"robot": "ur10", "serial": serial}
    graph.start("thermal_node", settings, None, "--ros-args", "--params-file", str(CONFIG))
    wait = f"[{', '.join(INPUTS)}]"
    graph.start("replay_node", {"bag": bag, "rate": 0.0, "wait_for_subscribers": wait})

    def status() -> dict[str, Any]:
        return json.loads(reports[-1].data) if reports else {"state": ""}

    def counts(what: str) -> dict[str, int]:
        told = [s for a in diagnostics for s in a.status if s.name == "thermal_node"]
        values = {v.key: v.value for v in told[-1].values} if told else {}
        return {f"/{topic}": int(values.get(f"{topic} {what}", -1)) for topic in INPUTS}

    graph.spin_until(lambda: status()["state"] == "done", "the bag is played", 60.0)
    assert status()["sent"] == sent
    assert (status()["unheard"], status()["best_effort"]) == ({}, {})
    graph.spin_until(lambda: counts("received") == sent, "all sent is received", 60.0)
    assert set(counts("lost").values()) == {0}
    return events


def replayed(bag: Path, state: Path, *options: str) -> dict[str, Any]:
    done = robocal("replay", bag, "--robot", "ur10", "--state", state, "--json", *options)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def kept(serial: str, state: Path) -> dict[str, Any]:
    with CalibrationHistory.open(serial, state_dir=state, create=False) as history:
        entries, decisions = json.loads(content(history))
    return {"entries": entries, "decisions": decisions}


def stamps_taken_out(side: dict[str, Any]) -> set[int]:
    """When the one command was given: the only thing in which the two ways may differ."""
    (entry,) = side["entries"]
    return {entry.pop("stamp"), entry["document"].pop("stamp_ns")}


@pytest.mark.parametrize("series", ["D", *more("B")])
def test_live_equals_replay(graph, data_dir: Path, tmp_path: Path, series: str) -> None:
    arm, data = load_robot("ur10"), ur10_campaigns.load_campaign(series, data_dir / "ur10_tmac")
    bag = tmp_path / f"{series}.mcap"
    ur10_campaigns.write_bag(bag, data, arm.joint_names)
    events = played(graph, bag, series, len(data))
    answer = graph.call(Identify, "/thermal_node/identify", 60.0, cycle_id=CYCLE)
    assert (answer.success, answer.status) == (True, Code.ACCEPT), answer.message

    (candidate,) = replayed(bag, tmp_path / "auto", "--auto")["candidates"]
    live, auto = kept(series, graph.state), kept(series, tmp_path / "auto")
    # Called at the end of the recording; --auto ends its window with the last measurement.
    last_ns = int(data.stamp_ns[-1])
    assert stamps_taken_out(live) == {last_ns + ur10_campaigns.AROUND_NS[-1]}
    assert stamps_taken_out(auto) == {last_ns}
    assert live == auto
    assert len(live["entries"][0]["inputs"]["q"][1]) == len(data)
    assert candidate["verdict"]["reason"] == answer.message

    accepted = graph.call(
        Decide, "/thermal_node/accept", id=answer.candidate_id, by="me", reason="better"
    )
    assert accepted.revision == 1, accepted.message
    graph.spin_until(lambda: len(events) == 4, "the commands and what they changed")
    recorded = with_events(bag, events, tmp_path / f"{series}_recorded.mcap", EVENT_TOPIC)
    document = replayed(recorded, tmp_path / "again")
    assert (document["recorded"], document["differs"]) == (True, [])
    assert kept(recorded.stem, tmp_path / "again") == kept(series, graph.state)
