# SPDX-License-Identifier: Apache-2.0
"""The calls of a PLC to a maintenance node that has nothing to move: no poses, no beams."""

import itertools
import math
import os
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from history_workers import proposal
from rclpy.action import ActionClient, CancelResponse
from robocal_msgs.action import RunMaintenance
from robocal_msgs.msg import AccuracyState, GapOpen, MaintenanceStatus, SessionEvent
from robocal_msgs.srv import Acknowledge, Decide, GetMaintenance, RunMaintenanceCycle
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.node import ACCURACY, MaintenanceNode
from robocal_ros.maintenance.session import MaintenanceState
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS

HOME_DEG = [0.0, -90.0, 90.0, -90.0, -90.0, 0.0]
PERIOD_S = 0.05
NODE = "/maintenance_node"
SETTINGS = {
    "serial": "K7",
    "home_deg": str(HOME_DEG),
    "motion_silence_s": 0.5,  # nothing moves, and the machine has other work too
}
ROOT = Path(__file__).parents[2]


class Plc:
    """The probe: heartbeat, a robot that stands, and calls."""

    def __init__(self, graph: Any, start: Callable[[], Any], *, bridge: bool = True) -> None:
        self.graph = graph
        self.echo: int | None = None
        self.is_open, self.beating, self.q = True, bridge, np.radians(HOME_DEG)
        self.names = list(load_robot("ur10").joint_names)
        self.states = graph.collect(AccuracyState, "accuracy_state", endpoints.LATCHED)
        self.statuses = graph.collect(MaintenanceStatus, f"{NODE}/status", endpoints.LATCHED)
        self.events = graph.collect(SessionEvent, f"{NODE}/session_events", EVENTS)
        self.node = start()
        self.gap = graph.publisher(GapOpen, "gap_open") if bridge else None
        self.joints = graph.publisher(JointState, "joint_states")
        self.begun_ns = time.monotonic_ns()
        graph.probe.create_timer(PERIOD_S, self._beat)
        assert not self.run("").success  # discovers the call
        graph.spin_until(lambda: self.statuses and self._ready(self.statuses[-1]), "it is ready")

    def _ready(self, status: MaintenanceStatus) -> bool:
        return bool(status.at_home and not (status.doing and self.beating))

    def _beat(self) -> None:
        message = JointState(name=self.names, position=self.q.tolist())
        ns = time.monotonic_ns() - self.begun_ns
        message.header.stamp = Time(sec=1000 + ns // 10**9, nanosec=ns % 10**9)
        self.joints.publish(message)
        if self.beating:
            self.gap.publish(GapOpen(open=self.is_open, echo=self.beat))

    @property
    def beat(self) -> int:
        """The newest that was read; or what the bridge repeats."""
        if self.echo is not None:
            return self.echo
        return int(self.statuses[-1].beat) if self.statuses else 0

    def call(self, kind: type, name: str, **fields: Any) -> Any:
        return self.graph.call(kind, f"{NODE}/{name}", **fields)

    def run(self, cycle_id: str, gap_s: float = 30.0) -> Any:
        return self.call(RunMaintenanceCycle, "run", cycle_id=cycle_id, gap_s=gap_s)

    def trigger(self, name: str) -> str:
        answer = self.call(Trigger, f"{name}_trigger")
        assert answer.success == (answer.message.split()[1] == "ACCEPT")
        return str(answer.message)


def process(graph: Any, *, mortal: bool = False) -> Any:
    """The node as its own process."""
    node = graph.start("maintenance_node", SETTINGS, mortal=mortal)
    graph.spin_until(lambda: graph.probe.count_subscribers("gap_open"), "the node", 30.0)
    return node


@pytest.fixture
def plc(graph: Any) -> Plc:
    settings = SETTINGS | {"home_deg": HOME_DEG}
    return Plc(graph, lambda: graph.add(MaintenanceNode, settings))


def test_a_cycle_runs_once_however_often_it_is_called(plc, graph):
    begun = plc.run("4711")
    assert (begun.success, begun.status) == (True, Code.ACCEPT), begun.message
    graph.spin_until(lambda: plc.run("4711").result.code == Code.ACCEPT, "it ends")
    ended = plc.run("4711")
    assert (ended.success, ended.result.complete) == (True, True)
    assert (ended.before_start, ended.result.run) == (False, 1)
    assert abs(ended.result.stamp.sec - time.time()) < 60.0
    plc.node.trigger_deactivate()
    plc.node.trigger_activate()
    graph.spin_for(0.3)
    again = plc.run("4711")
    assert (again.success, again.before_start, again.result) == (True, True, ended.result)
    old = f"cycle '4711' is one of before this start of the node, run {ended.result.run}, "
    assert again.message.startswith(old)
    assert "nothing runs now; it ended so: nothing was due" in again.message
    assert plc.trigger("status").startswith(f"0 ACCEPT {old}")
    assert old in plc.call(GetMaintenance, "status", cycle_id="4711").message
    known = plc.call(GetMaintenance, "status", cycle_id="4711")
    assert known.result == ended.result
    assert known.state.state == MaintenanceStatus.IDLE
    assert plc.call(GetMaintenance, "status", cycle_id="4712").status == Code.BAD_INPUT
    names = [event.command for event in plc.events]
    assert names == ["run_maintenance", "maintenance_ended"]


def test_a_disk_that_takes_its_time_breaks_no_cycle_off(plc, graph, monkeypatch):
    fsync = os.fsync

    def slow(descriptor: int) -> None:
        time.sleep(0.35)  # file and folder: the heartbeat is older than gap_stale_s afterwards
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", slow)
    assert plc.run("4711").success
    monkeypatch.undo()
    graph.spin_until(lambda: plc.run("4711").result.code != Code.NONE, "it ends")
    ended = plc.run("4711").result
    assert (ended.code, ended.complete) == (Code.ACCEPT, True), ended.message


def test_the_action_does_the_same(plc, graph):
    client = ActionClient(graph.probe, RunMaintenance, f"{NODE}/run_maintenance")
    graph.spin_until(client.server_is_ready, "the action")
    results = []
    for gap_s in (30.0, 30.0, -1.0):
        name = "a" if gap_s > 0.0 else "b"
        goal = RunMaintenance.Goal(cycle_id=name, gap_s=gap_s)
        handle = graph.awaited(client.send_goal_async(goal), "the goal is taken")
        results.append(graph.awaited(handle.get_result_async(), "the result").result)
    assert results[0].success, results[0].message
    assert results[0] == results[1]
    assert (results[2].success, results[2].status) == (False, Code.BAD_INPUT)


def test_nothing_runs_while_the_gap_is_closed(plc, graph):
    plc.is_open = False
    graph.spin_until(lambda: plc.statuses[-1].doing == "gap_open is false", "it is told")
    refused = plc.run("4711")
    assert (refused.success, refused.status) == (False, Code.CONFLICT)
    assert "gap_open is false" in refused.message
    plc.is_open = True
    graph.spin_for(0.3)
    assert plc.run("4711").success


def test_a_robot_away_from_home_is_a_fault_until_it_is_acknowledged(plc, graph):
    plc.q = plc.q + np.radians([0.0, 0.0, 4.0, 0.0, 0.0, 0.0])
    graph.spin_for(0.3)
    refused = plc.run("4711")
    assert refused.status == Code.LIMIT_EXCEEDED
    assert "robot is not at home: elbow_joint is 4.00 deg off" in refused.message
    graph.spin_until(
        lambda: plc.states and "not at home" in plc.states[-1].reason, "the line reads it"
    )
    assert plc.states[-1].state == AccuracyState.FAULT
    plc.q = np.radians(HOME_DEG)
    graph.spin_for(0.3)
    assert plc.run("4711").status == Code.CONFLICT
    plc.node.trigger_deactivate()
    plc.node.trigger_activate()
    graph.spin_for(0.3)
    assert plc.trigger("status").startswith("0 LIMIT_EXCEEDED robot is not at home")
    answer = plc.call(Acknowledge, "acknowledge", by="me")
    assert answer.success, answer.message
    assert plc.run("4711").success


def test_twins_of_a_plc_without_arguments(plc, graph):
    assert plc.trigger("status") == "0 CONFLICT no cycle has ended yet"
    assert plc.trigger("run").startswith("0 ACCEPT cycle 'at ")
    graph.spin_until(lambda: plc.trigger("status").startswith("0 ACCEPT"), "it ends")
    assert plc.trigger("cancel") == "0 CONFLICT no cycle runs"
    assert plc.trigger("acknowledge") == "0 ACCEPT there is no fault"
    assert plc.trigger("accept").startswith("0 CONFLICT one candidate must wait")
    assert plc.trigger("reject") == "0 ACCEPT nothing waits for a decision"
    assert plc.trigger("rollback").startswith("0 BAD_INPUT nothing was accepted")
    for name in ("accept", "reject", "rollback"):
        for number in (0, 99):
            assert plc.call(Decide, name, id=number).status == Code.BAD_INPUT


def proposed(history: CalibrationHistory, based_on: int) -> int:
    """A thermal candidate that another node proposes."""
    arm = load_robot("ur10")
    told = {"model_hash": arm.model_hash, "based_on": based_on, "cycle_id": ""}
    return history.propose(proposal(**told, model=model_document(arm)))


def candidates(graph: Any, count: int, based_on: int = 0) -> list[int]:
    """Thermal candidates that other nodes proposed, all against one revision."""
    arm = load_robot("ur10")
    with CalibrationHistory.open("K7", model_hash=arm.model_hash, state_dir=graph.state) as history:
        return [proposed(history, based_on) for _ in range(count)]


def test_decisions_by_id_are_quick_and_stale_ones_are_told(plc, graph):
    first, second, third = candidates(graph, 3)
    took_s = []
    for number, status in ((second, Code.ACCEPT), (second, Code.ACCEPT), (first, Code.STALE)):
        begin = time.monotonic()
        answer = plc.call(Decide, "accept", id=number, by="plc")
        took_s.append(time.monotonic() - begin)
        assert answer.status == status, answer.message
        assert answer.revision == (1 if answer.success else 0)
    assert plc.trigger("accept").startswith("0 CONFLICT one candidate must wait, found none")
    assert plc.call(Decide, "reject", id=third, by="plc").success
    assert plc.trigger("rollback").startswith("0 ACCEPT revision 2: the nominal model in force")
    print("accept:", [f"{1e3 * took:.1f} ms" for took in took_s[1:]])
    assert max(took_s[1:]) < 0.5  # the first one has to find the service


def test_a_decision_that_comes_twice_is_made_once(plc, graph):
    first, *_ = candidates(graph, 2)
    assert plc.call(Decide, "accept", id=first).revision == 1
    second, third = candidates(graph, 2, based_on=1)
    assert plc.call(Decide, "accept", id=second).revision == 2
    for _ in range(2):
        back = plc.call(Decide, "rollback", id=first)
        assert (back.success, back.status, back.revision) == (True, Code.ACCEPT, 3), back.message
    assert plc.call(Decide, "rollback", id=third).status == Code.CONFLICT  # never accepted
    for words in (f"0 ACCEPT calibration {second} is taken back already",) * 2:
        assert plc.trigger("rollback") == words
    waiting = candidates(graph, 2, based_on=3)
    words = "; ".join(f"calibration {number} rejected" for number in reversed(waiting))
    assert plc.trigger("reject") == f"{waiting[0]} ACCEPT {words}"
    assert plc.trigger("reject") == "0 ACCEPT nothing waits for a decision"
    names = [event.command for event in plc.events]
    assert names == ["accept", "accept", "rollback", "rollback", "reject", "reject"]  # one refused


def test_a_history_that_another_process_holds_delays_nobody(plc, graph):
    (number,) = candidates(graph, 1)
    plc.call(Decide, "accept", id=0)  # discovered
    with closing(sqlite3.connect(plc.node._history.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        begin = time.monotonic()
        held = plc.call(Decide, "accept", id=number, by="plc")
        took_s = time.monotonic() - begin
        assert held.status == Code.STORAGE_FAILED, held.message
        other.execute("ROLLBACK")
    assert took_s < 0.5  # waits 0.05 s; the rest is this machine's
    assert plc.call(Decide, "accept", id=number, by="plc").success


def test_a_history_that_cannot_be_read_leaves_nobody_waiting(plc, graph):
    client = ActionClient(graph.probe, RunMaintenance, f"{NODE}/run_maintenance")
    graph.spin_until(client.server_is_ready, "the action")
    with closing(sqlite3.connect(plc.node._history.path)) as other:
        other.executescript("ALTER TABLE calibrations RENAME TO gone")
        goal = RunMaintenance.Goal(cycle_id="a", gap_s=30.0)
        handle = graph.awaited(client.send_goal_async(goal), "the goal is taken")
        ended = graph.awaited(handle.get_result_async(), "the result").result
        assert ended.status == Code.STORAGE_FAILED
        graph.spin_for(1.2)  # diagnostics and accuracy_state come meanwhile
        known = plc.call(GetMaintenance, "status", cycle_id="a")
        assert (known.success, known.status) == (False, Code.STORAGE_FAILED)
        assert known.state.state == MaintenanceStatus.IDLE
        assert known.result == ended.result
        assert plc.statuses[-1].last == known.result
        assert plc.trigger("status").startswith("0 STORAGE_FAILED")
        other.executescript("ALTER TABLE gone RENAME TO calibrations")
    assert plc.call(GetMaintenance, "status", cycle_id="a").success


def test_a_cancel_that_comes_late_leaves_the_next_cycle_alone(plc, graph):
    client = ActionClient(graph.probe, RunMaintenance, f"{NODE}/run_maintenance")
    graph.spin_until(client.server_is_ready, "the action")
    sent = client.send_goal_async(RunMaintenance.Goal(cycle_id="a", gap_s=30.0))
    session, calls = plc.node._session, plc.node._calls

    def ended() -> bool:
        known = session.result("a")
        return known is not None and known.code is not Code.NONE

    graph.spin_until(ended, "a has ended")
    (goal,) = calls._goals  # its caller is not told yet
    session.run("b", 30.0, *plc.node._clocks())
    assert calls._cancel(goal) is CancelResponse.REJECT
    graph.spin_until(lambda: session.running is None, "b has ended")
    assert session.result("b").code is Code.ACCEPT
    told = graph.awaited(sent, "a was taken").get_result_async()
    assert graph.awaited(told, "a's caller is told").result.status == session.result("a").code


def test_a_node_that_is_deactivated_says_so(plc, graph):
    call = graph.probe.create_client(RunMaintenanceCycle, f"{NODE}/run")
    graph.spin_until(call.service_is_ready, "the call")
    graph.spin_for(0.5)
    call.call_async(RunMaintenanceCycle.Request(cycle_id="a", gap_s=30.0))
    graph.spin_until(lambda: plc.node._session.running, "it runs")
    plc.node._show()
    assert plc.node._session.state is MaintenanceState.RUNNING
    plc.node.trigger_deactivate()
    graph.spin_until(lambda: plc.statuses[-1].last.cycle_id == "a", "the last word")
    assert plc.statuses[-1].state == MaintenanceStatus.IDLE
    assert plc.statuses[-1].last.code == Code.CONFLICT
    graph.spin_until(lambda: plc.states[-1].state == AccuracyState.FAULT, "the line is told")
    assert "deactivated" in plc.states[-1].reason
    for twin in ("run", "status", "cancel", "accept", "reject", "rollback", "acknowledge"):
        refused = graph.call(Trigger, f"{NODE}/{twin}_trigger")
        assert not refused.success
        assert refused.message.startswith("0 CONFLICT maintenance_node is inactive: activate it")


MINE = {"robot": "UR10", "serial": "unset"}


def test_the_accuracy_of_another_robot_does_not_count(graph):
    node = graph.add(MaintenanceNode, {"home_deg": HOME_DEG})
    drift = graph.publisher(AccuracyState, ACCURACY, endpoints.LATCHED)
    for count, others in enumerate((MINE | {"serial": "K8"}, MINE | {"robot": "bx200l"}, {}), 1):
        drift.publish(AccuracyState(state=AccuracyState.OK, **others))
        graph.spin_until(lambda n=count: node.inputs[ACCURACY].invalid == n, f"{others} is refused")
    drift.publish(AccuracyState(state=AccuracyState.OK, **MINE))
    graph.spin_until(lambda: node.inputs[ACCURACY].received == 4, "the right one comes")
    assert node.inputs[ACCURACY].invalid == 3


def test_a_hard_stop_that_nobody_serves_is_warned_of(graph):
    node = graph.add(MaintenanceNode, {"home_deg": HOME_DEG, "hard_stop_service": "/hard_stop"})
    nobody = "hard_stop_service: nobody serves /hard_stop"
    assert nobody in node.health().message
    graph.probe.create_service(Trigger, "/hard_stop", lambda request, response: response)
    graph.spin_until(lambda: nobody not in node.health().message, "it is served")


def test_a_figure_that_cannot_be_is_no_drift(graph):
    poses = [angle + 10.0 for angle in HOME_DEG]
    node = graph.add(MaintenanceNode, {"home_deg": HOME_DEG, "measuring_poses_deg": poses})
    states = graph.collect(AccuracyState, "accuracy_state", endpoints.LATCHED)
    drift = graph.publisher(AccuracyState, ACCURACY, endpoints.LATCHED)
    figures = {"predicted_error_mm": 0.1, "bound_mm": 0.2, "due_in_s": 60.0}
    known, heard = MINE | figures, node.inputs[ACCURACY]
    for name, value in itertools.product(figures, (np.nan, np.inf, -np.inf, 1e300)):
        count = heard.received + 1
        drift.publish(AccuracyState(state=AccuracyState.OK, **(known | {name: value})))
        graph.spin_until(lambda n=count: heard.received == n, "it has come")
        assert heard.invalid == count, (name, value)
    states.clear()
    graph.spin_until(lambda: states, "the line is told")
    assert states[-1].reason == "drift: the thermal node is silent"
    drift.publish(AccuracyState(state=AccuracyState.OK, **known))
    graph.spin_until(lambda: states[-1].state == AccuracyState.OK, "the next one counts")
    assert (states[-1].predicted_error_mm, states[-1].bound_mm) == pytest.approx((0.1, 0.2))


def test_a_second_publisher_of_the_heartbeat_closes_the_gap(plc, graph):
    other = graph.probe.create_publisher(GapOpen, "gap_open", 10)
    words = "gap_open has 2 publishers (probe, probe): let one alone publish it"
    graph.spin_until(lambda: plc.statuses[-1].doing == words, "it is told")
    refused = plc.run("4711")
    assert (refused.success, refused.status) == (False, Code.CONFLICT)
    assert refused.message == f"{words}: the robot is not moved"
    graph.probe.destroy_publisher(other)
    graph.spin_until(lambda: plc.statuses[-1].doing == "", "one is left")
    assert plc.run("4711").success


def test_a_heartbeat_that_cannot_be_heard_is_told(graph):
    graph.add(MaintenanceNode, {"home_deg": HOME_DEG})
    statuses = graph.collect(MaintenanceStatus, f"{NODE}/status", endpoints.LATCHED)
    graph.probe.create_publisher(GapOpen, "gap_open", endpoints.own(endpoints.SENSOR))
    words = "gap_open of probe is BEST_EFFORT and not heard: publish it RELIABLE"
    graph.spin_until(lambda: statuses and statuses[-1].doing == words, "it is told")


def test_heartbeats_that_waited_for_the_node_do_not_count(graph):
    plc = Plc(graph, lambda: process(graph))
    plc.node.process.send_signal(signal.SIGSTOP)
    graph.spin_for(1.0)  # twenty heartbeats wait
    plc.beating = False  # the PLC dies
    graph.spin_for(1.0)
    plc.node.process.send_signal(signal.SIGCONT)
    for name in ("b", "c", "d"):
        refused = plc.run(name)
        assert refused.status == Code.CONFLICT, refused.message
        assert refused.message.startswith("gap_open is silent for more than 0.5 s")
    plc.beating = True
    graph.spin_until(lambda: plc.run("e").success, "heartbeats count again")


def test_a_bridge_that_repeats_the_last_value_of_a_dead_plc_closes_the_gap(plc, graph):
    beat_s: dict[int, float] = {}
    note = plc.graph.probe.create_subscription(
        MaintenanceStatus,
        f"{NODE}/status",
        lambda message: beat_s.setdefault(int(message.beat), time.monotonic()),
        10,
    )
    graph.spin_for(1.0)
    assert plc.run("a").success
    plc.echo = plc.beat  # the program stands; its bridge goes on
    read_s = beat_s.get(plc.echo, time.monotonic())
    graph.spin_until(lambda: plc.node._session.status(plc.node._steady.now_s()).closed, "closed")
    assert time.monotonic() - read_s <= 0.7 + 0.1  # and a turn of the probe
    refused = plc.run("b")
    assert refused.status == Code.CONFLICT
    assert f"gap_open echoes {plc.echo}, which is no beat of the last 0.5 s" in refused.message
    plc.node.trigger_deactivate()
    plc.node.trigger_activate()
    graph.spin_for(1.0)
    assert plc.run("b").status == Code.CONFLICT  # an echo of before this start
    plc.echo = None
    graph.spin_until(lambda: plc.run("b").success, "the program goes on")
    graph.probe.destroy_subscription(note)


def test_a_bool_is_told_and_counts_only_where_the_parameter_says_so(graph):
    beats = graph.probe.create_publisher(Bool, "gap_open", 10)
    graph.probe.create_timer(PERIOD_S, lambda: beats.publish(Bool(data=True)))
    statuses = graph.collect(MaintenanceStatus, f"{NODE}/status", endpoints.LATCHED)
    words = "gap_open of probe is std_msgs/msg/Bool and not heard: publish robocal_msgs/msg/GapOpen"
    # Processes of their own: in one, a topic has one type.
    node = process(graph)
    graph.spin_until(lambda: statuses and statuses[-1].doing == words, "it is told", 30.0)
    node.stop()
    node = graph.start("maintenance_node", SETTINGS | {"gap_bool": True})
    graph.spin_until(lambda: statuses[-1].doing == "", "it counts", 30.0)
    assert "gap_bool: gap_open is taken as std_msgs/Bool, which bears no echo" in node.output


BRIDGE = """
import sys, threading, time
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from robocal_msgs.msg import GapOpen, MaintenanceStatus

class Plc(dict):
    read = dict.get
    write = dict.__setitem__

plc = Plc(beat=0, echo=0, gap=True)

def program():  # of the PLC; put in STOP by a line on the standard input
    while not stop.is_set():
        plc["echo"] = plc["beat"]
        time.sleep(0.02)

"""
MAIN = """
import os
stop = threading.Event()
threading.Thread(target=program, daemon=True).start()
rclpy.init()
node = GapBridge()
while rclpy.ok():
    rclpy.spin_once(node, timeout_sec=0.1)
    if os.path.exists(sys.argv[1]):
        stop.set()
"""


def test_the_bridge_of_the_page_opens_the_gap_while_the_program_runs(graph, tmp_path):
    page = (ROOT / "docs/plc.md").read_text()
    bridge = page.split("```python\n")[1].split("```")[0]
    script, stops = tmp_path / "bridge.py", tmp_path / "stop"
    script.write_text(BRIDGE + bridge + MAIN)
    plc = Plc(graph, lambda: process(graph), bridge=False)
    graph.start(script, {}, {}, str(stops))
    graph.spin_until(lambda: plc.statuses[-1].doing == "", "the gap is open", 30.0)
    assert plc.run("a").success
    stops.touch()
    words = "which is no beat of the last 0.5 s"
    graph.spin_until(lambda: words in plc.statuses[-1].doing, "the program stands")
    assert plc.run("b").status == Code.CONFLICT


def test_the_status_comes_five_times_a_second_and_counts_up(plc, graph):
    plc.statuses.clear()
    begin = time.monotonic()
    graph.spin_until(lambda: len(plc.statuses) >= 11, "ten periods")
    took_s = time.monotonic() - begin
    beats = [int(status.beat) for status in plc.statuses[:11]]
    assert beats == list(range(beats[0], beats[0] + 11))
    assert took_s > 1.8  # ten periods of 0.2 s, less one that had begun


def test_a_heartbeat_from_before_the_host_was_suspended_is_old(plc, graph, monkeypatch):
    clock = time.clock_gettime

    def woken(which: int) -> float:
        return clock(which) + 3600.0 * (which == time.CLOCK_BOOTTIME)

    plc.beating = False
    monkeypatch.setattr(time, "clock_gettime", woken)
    refused = plc.run("4711")
    assert refused.status == Code.CONFLICT, refused.message
    assert refused.message.startswith("gap_open is silent for more than 0.5 s")
    plc.beating = True
    graph.spin_until(lambda: plc.run("4711").success, "heartbeats count again")


def test_a_state_that_is_lost_is_a_fault(plc, graph):
    assert plc.run("4711").success
    graph.spin_until(lambda: plc.run("4711").result.code == Code.ACCEPT, "it ends")
    plc.node.trigger_deactivate()
    plc.node._keeper.path.unlink()
    plc.node.trigger_activate()
    graph.spin_for(0.3)
    refused = plc.run("4711")
    assert (refused.status, "state.json is gone" in refused.message) == (Code.CONFLICT, True)
    assert plc.statuses[-1].fault_code == Code.STORAGE_FAILED
    assert plc.call(Acknowledge, "acknowledge", by="me").success
    assert plc.run("4712").success


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"home_deg": [0.0]}, "home_deg has 1 numbers, UR10 has 6 joints"),
        ({"measuring_poses_deg": [1.0, 2.0, 3.0]}, "has 3 numbers: UR10 has 6 joints"),
        ({"measuring_poses_deg": [0.0] * 11 + [math.nan]}, "nan"),
        ({"laser": "/nowhere.yaml"}, "no such"),
        ({"measuring_poses_deg": [0.0] * 5 + [400.0]}, "wrist_3_joint"),
    ],
)
def test_what_cannot_be_driven_is_refused_at_the_start(graph, changes, words):
    node = graph.add(MaintenanceNode, {"home_deg": HOME_DEG} | changes)
    assert not node.is_active
    assert words in node._failure.message
