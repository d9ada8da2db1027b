"""The golden shift's ten minutes through live nodes: what a replay gives, bit for bit."""

import json
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from robocal_msgs.msg import SessionEvent
from robocal_msgs.srv import BeginCycle, EndCycle
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tool_cell_live import STREAM

from bench.closed_loop import setting
from robocal_ros import __version__
from robocal_ros.cli.recording import Recording, open_recording
from robocal_ros.core.codes import Code
from robocal_ros.core.proposals import THERMAL, Proposal
from robocal_ros.nodes import qos
from robocal_ros.nodes.tcf_node import TcfNode
from robocal_ros.nodes.thermal_outputs import EVENTS
from robocal_ros.sessions import events, replay
from robocal_ros.sessions.decisions import ONLY
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.inputs import take_message
from robocal_ros.sessions.observations import JOINTS
from robocal_ros.sessions.records import digest
from robocal_ros.sessions.seeding import session_as_recorded
from robocal_ros.sessions.tool_inputs import take_tool_message
from robocal_ros.sessions.tool_recorded import tool_session_as_recorded
from robocal_ros.storage.bag_writer import BagWriter
from robocal_ros.storage.bags import BagReader
from robocal_ros.storage.calibrations import CalibrationHistory
from robocal_ros.storage.laser_files import LaserFile, write_laser
from robocal_ros.storage.robots import load_robot

BAG = Path(__file__).parents[2] / "bags" / "golden_excerpt.mcap"
ROBOT = "kr150_r3100"
THERMAL_EVENTS, TOOL_EVENTS = "/thermal_node/session_events", "/tcf_node/session_events"
NS = 1_000_000_000


@pytest.fixture
def bag() -> Iterator[BagReader]:
    with BagReader(BAG) as reader:
        yield reader


def kept(state: Path, name: str) -> CalibrationHistory:
    return CalibrationHistory.open(name, model_hash=load_robot(ROBOT).model_hash, state_dir=state)


def told(outcome: Outcome) -> tuple[Any, ...]:
    """What an event says, the document by its fingerprint."""
    command = outcome.command
    return (
        command.name, command.stamp_ns, int(outcome.status), outcome.samples,
        digest(outcome.document),
    )  # fmt: skip


def said(event: SessionEvent) -> tuple[Any, ...]:
    found = json.loads(event.outcome)
    stamp_ns = event.stamp.sec * NS + event.stamp.nanosec
    return event.command, stamp_ns, found["status"], found["samples"], found["digest"]


def commands_of(live: list[SessionEvent]) -> list[SessionEvent]:
    return [event for event in live if event.command != events.CONFIGURE]


def arguments(event: SessionEvent) -> dict[str, Any]:
    return dict(json.loads(event.arguments)["arguments"])


# ---- the tool -----------------------------------------------------------------------------------


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
    }


def play_runs(graph: Any, node: TcfNode, bag: BagReader, recording: Recording) -> None:
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


def spans(recording: Recording) -> list[tuple[int, int]]:
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


# ---- the drift ----------------------------------------------------------------------------------

RATE = 40.0
HOLD_S = 1.0  # of the wall clock: the replay is to be paused at a mark
MARKS = "/cycle_done"
INPUTS = ("joint_states", "sphere_cloud", "reference_sphere_center", "motor_temperatures")
# In production, far from the measurements, s since the begin: what a call finds is the same
# wherever in between it comes, and a pause that comes 3 s late does no harm.
MARKS_S = (1.0, 200.0)
STOPS = (  # what is asked at each mark, and once all was played
    ("paused", (events.BEGIN_CYCLE,)),
    ("paused", (events.END_CYCLE, events.ACCEPT, events.BEGIN_CYCLE)),
    ("done", (events.END_CYCLE,)),
)
CALLED = {events.BEGIN_CYCLE: BeginCycle, events.END_CYCLE: EndCycle}


def test_the_thermal_node_says_what_a_replay_says(
    graph: Any, bag: BagReader, tmp_path: Path
) -> None:
    """All ten minutes through replay_node, in mid-shift; both nodes are processes.

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


def seed(recording: Recording, state: Path) -> None:
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


def marked(bag: BagReader, recording: Recording, path: Path) -> Path:
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


def play_cycles(graph: Any, recording: Recording, bag: Path, live: list[SessionEvent]) -> None:
    """Play the marked bag; make the calls at its marks, the decisions right after them."""
    marks = graph.collect(String, MARKS)
    heard = Heard(graph)
    lossless = {
        f"qos_overrides./{topic}.subscription.{policy}": value
        for topic in INPUTS
        for policy, value in (("reliability", "reliable"), ("history", "keep_all"))
    }
    graph.start("thermal_node", thermal_settings() | lossless)
    wait = f"[{', '.join((*INPUTS, MARKS))}]"
    playing = {"bag": bag, "rate": RATE, "wait_for_subscribers": wait, "start_paused": True}
    graph.start("replay_node", playing | {"acknowledge_timeout_s": 60.0})
    names = [str(c.arguments.get("cycle_id", "")) for c, _ in recording.commands]
    assert graph.call(Trigger, "/replay_node/pause", 30.0).success  # it answers at once from now on
    for state, asked in STOPS:
        assert graph.call(Trigger, "/replay_node/play", 30.0).success
        if state == "paused":
            graph.spin_until(lambda: marks, "a mark", 120.0)
            assert graph.call(Trigger, "/replay_node/pause", 30.0).success
            marks.clear()
        heard.all_of_it(state)
        for name in asked:
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


def thermal_settings() -> dict[str, Any]:
    """The live node's parameters that give the recorded settings."""
    config = setting.THERMAL
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
        self._reports = graph.collect(String, "/replay_node/status", qos.LATCHED)
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
    recording: Recording, configured: Command | None, commands: Any, state: Path
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
