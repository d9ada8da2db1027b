"""The drift in the golden shift's ten minutes, live: what a replay gives, bit for bit."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from excerpt_live import (
    BAG,
    NS,
    ROBOT,
    THERMAL_EVENTS,
    arguments,
    commands_of,
    kept,
    said,
    told,
)
from robocal_msgs.msg import SessionEvent
from robocal_msgs.srv import BeginCycle, EndCycle
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bench.closed_loop import setting
from robocal_ros import __version__
from robocal_ros.bags import replay
from robocal_ros.bags.bag_writer import BagWriter
from robocal_ros.bags.bags import BagReader
from robocal_ros.cli.recording import BagOverview, open_recording
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL, Proposal
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.session import events
from robocal_ros.session.events import Command
from robocal_ros.thermal.session import session_as_recorded, take_message

EVERY = 5  # joint readings at 50 Hz are enough to see where the robot stands


@pytest.fixture
def bag(tmp_path: Path) -> Iterator[BagReader]:
    """The excerpt with every fifth joint reading."""
    thinned, seen = tmp_path / "thinned.mcap", 0
    with BagReader(BAG) as reader, BagWriter(thinned) as writer:
        for message in reader.messages(raw=True):
            if message.topic == "/joint_states":
                seen += 1
                if seen % EVERY:
                    continue
            msgtype = reader.info.topics[message.topic].msgtype
            writer.write(message.topic, msgtype, message.message, message.log_time_ns)
    with BagReader(thinned) as reader:
        yield reader


RATE = 120.0
HOLD_S = 1.0  # of the wall clock: the replay is to be paused at a mark
MARKS = "/cycle_done"
INPUTS = ("joint_states", "sphere_cloud", "reference_sphere_center", "motor_temperatures")
# In production, far from the measurements, s since the begin: what a call finds is the same
# wherever in between it comes, and a pause that comes 3 s late does no harm.
MARKS_S = (1.0, 200.0)
STOPS = (  # what is asked at each mark, and once all was played; accepted only where that was
    ("paused", (events.BEGIN_CYCLE,)),
    ("paused", (events.END_CYCLE, events.ACCEPT, events.BEGIN_CYCLE)),
    ("done", (events.END_CYCLE,)),
)
CALLED = {events.BEGIN_CYCLE: BeginCycle, events.END_CYCLE: EndCycle}


def test_the_thermal_node_says_what_a_replay_says(
    graph: Any, bag: BagReader, tmp_path: Path
) -> None:
    """Ten minutes through replay_node, in mid-shift, at 50 Hz; both nodes are processes.

    The calls come at other moments than the recorded ones: only their stamps differ. This test is
    the maintenance too, which accepts in the history.
    """
    recording = open_recording(bag, {replay.EVENTS: THERMAL_EVENTS})
    seed(recording, graph.state)
    live = graph.collect(SessionEvent, THERMAL_EVENTS, EVENTS)
    play_cycles(graph, recording, marked(bag, recording, tmp_path / "played.mcap"), live)
    configured = recording.configured
    assert configured is not None
    begun, recorded = arguments(live[0]), dict(configured.arguments)
    assert begun.pop("topics").items() >= recorded.pop("topics").items()
    assert begun == recorded
    replayed(recording, recording.configured, recording.commands, tmp_path / "again")
    with kept(graph.state, "K7") as found, kept(tmp_path / "again", "again") as wanted:
        assert cycles(found) == cycles(wanted)
        assert len(cycles(found)) == 2
    assert [event.command for event in commands_of(live)] == [c.name for c, _ in recording.commands]
    heard = [replay.One(THERMAL_EVENTS, event) for event in live]
    own = replayed(recording, *replay.read_events(heard, recording.start_ns), tmp_path / "own")
    assert own.differs == []
    assert [said(event) for event in commands_of(live)] == [told(o) for o in own.outcomes]


def seed(recording: BagOverview, state: Path) -> None:
    """What was in force, and where the tracker stood, as a node that was killed finds them."""
    configured = recording.configured
    assert configured is not None
    with kept(state, "K7") as history:
        session = session_as_recorded(load_robot(ROBOT), history, configured, __version__)
        follower = session.follower
        assert follower is not None
        history.propose(
            Proposal(
                kind=THERMAL,
                model_hash=session.nominal.model_hash,
                based_on=session.in_force.revision,
                cycle_id="",
                stamp_ns=0,
                created_ns=0,
                software=__version__,
                method="",
                code=Code.NO_SIGNIFICANT_GAIN,
                reason="the last cycle before the recording",
                document={},
                model=session.in_force.model or {},
                inputs=follower.state.arrays() | follower.kept(None),
            )
        )


def marked(bag: BagReader, recording: BagOverview, path: Path) -> Path:
    """The inputs, with a mark and a pause of the log time where a call is to be made."""
    names = {topic: bag.info.topics[topic].msgtype for topic in recording.inputs}
    with BagWriter(path) as writer:
        shift_ns, waiting = 0, list(MARKS_S)
        for message in bag.messages(names, raw=True):
            at_ns = message.log_time_ns
            while waiting and at_ns > recording.start_ns + waiting[0] * NS:
                here = {"data": f"{waiting.pop(0):g} s"}
                writer.write(MARKS, "std_msgs/msg/String", here, at_ns + shift_ns)
                shift_ns += round(HOLD_S * RATE * NS)
            writer.write(message.topic, names[message.topic], message.message, at_ns + shift_ns)
    return path


def play_cycles(graph: Any, recording: BagOverview, bag: Path, live: list[SessionEvent]) -> None:
    """Play the marked bag; make the calls at its marks, the decisions right after them."""
    marks = graph.collect(String, MARKS)
    heard = Heard(graph)
    lossless = {
        f"qos_overrides./{topic}.subscription.{policy}": value
        for topic in INPUTS
        for policy, value in (("reliability", "reliable"), ("history", "keep_all"))
    }
    graph.start("thermal_node", thermal_settings(recording) | lossless)
    wait = f"[{', '.join((*INPUTS, MARKS))}]"
    playing = {"bag": bag, "rate": RATE, "wait_for_subscribers": wait, "start_paused": True}
    graph.start("replay_node", playing | {"acknowledge_timeout_s": 60.0})
    names = [str(c.arguments.get("cycle_id", "")) for c, _ in recording.commands]
    accepted = events.ACCEPT in {c.name for c, _ in recording.commands}
    assert graph.call(Trigger, "/replay_node/pause", 30.0).success  # it answers at once from now on
    for state, asked in STOPS:
        assert graph.call(Trigger, "/replay_node/play", 30.0).success
        if state == "paused":
            graph.spin_until(lambda: marks, "a mark", 120.0)
            assert graph.call(Trigger, "/replay_node/pause", 30.0).success
            marks.clear()
        heard.all_of_it(state)
        for name in asked:
            if name == events.ACCEPT and not accepted:
                continue
            said_before = len(live)
            ask(graph, name, names.pop(0))
            graph.spin_until(lambda n=said_before: len(live) > n, f"the event of {name}")
    assert not marks


def ask(graph: Any, name: str, cycle_id: str) -> None:
    """A call as the maintenance node makes it; it decides in the history."""
    if name == events.ACCEPT:
        accept_newest(graph.state)
        return
    answer = graph.call(CALLED[name], f"/thermal_node/{name}", 30.0, cycle_id=cycle_id)
    assert answer.success, answer.message


def thermal_settings(recording: BagOverview) -> dict[str, Any]:
    """The live node's parameters that give the recorded settings."""
    assert recording.configured is not None
    config, recorded = setting.THERMAL, recording.configured.arguments["config"]
    work = np.round(np.degrees(config.work_poses), 9)
    return {
        "robot": ROBOT,
        "serial": "K7",
        "measuring_frame": config.measuring_frame,
        "target": config.target,
        "tolerance_mm": config.tolerance_m * 1e3,
        "work_poses_deg": [" ".join(f"{q:g}" for q in pose) for pose in work],
        "tip_mm": [value * 1e3 for value in config.tip_m],
        "command_timeout_s": 0.1,
        "cycle_timeout_s": recorded["cycle_timeout_s"],
    }


def accept_newest(state: Path) -> None:
    with kept(state, "K7") as history:
        candidate, head = history.pending(THERMAL)[0], history.head(THERMAL)
        history.accept(
            candidate.id,
            by="maintenance",
            reason="within the configured bounds",
            expected_head=head.revision,
            wall_ns=time.time_ns(),
        )


class Heard:
    """How much of what was played the thermal node has taken in."""

    def __init__(self, graph: Any) -> None:
        self._graph = graph
        self._reports = graph.collect(String, "/replay_node/status", endpoints.LATCHED)
        self._diagnostics = graph.collect(DiagnosticArray, "/diagnostics")

    def all_of_it(self, state: str) -> None:
        """Wait until the replay is in this state, and the node has heard all that was sent."""
        self._graph.spin_until(lambda: self._status()["state"] == state, state, 300.0)
        sent = self._status()["sent"]
        wanted = {topic: sent[f"/{topic}"] for topic in INPUTS}
        self._graph.spin_until(lambda: self._received() == wanted, "all of it is heard", 300.0)

    def _status(self) -> dict[str, Any]:
        return json.loads(self._reports[-1].data) if self._reports else {"state": ""}

    def _received(self) -> dict[str, int]:
        told = [s for a in self._diagnostics[-9:] for s in a.status if s.name == "thermal_node"]
        values = {v.key: v.value for v in told[-1].values} if told else {}
        return {topic: int(values.get(f"{topic} received", -1)) for topic in INPUTS}


def replayed(
    recording: BagOverview, configured: Command | None, commands: Any, state: Path
) -> replay.ReplayReport:
    """The excerpt through a session that starts so and is told this."""
    assert configured is not None
    with kept(state, "again") as history:
        session = session_as_recorded(load_robot(ROBOT), history, configured, __version__)
        return replay.replay(session, recording.blocks(), commands, recording.inputs, take_message)


def cycles(history: CalibrationHistory) -> list[str]:
    """The cycles that were measured, to the last bit, but the stamps of the calls that ended them.

    As texts: what is not a number is equal to itself there.
    """
    found = []
    for entry in history.list(10):
        if entry.kind == THERMAL and entry.cycle_id:
            document = {k: v for k, v in history.document(entry.id).items() if k != "stamp_ns"}
            inputs = {name: a.tolist() for name, a in history.inputs(entry.id).items()}
            kept_so = [entry.cycle_id, document, history.model(entry.id), inputs]
            found.append(json.dumps(kept_so, sort_keys=True))
    return found
