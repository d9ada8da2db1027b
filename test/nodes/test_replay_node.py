# SPDX-License-Identifier: Apache-2.0
"""A bag through the replay node, over real DDS."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cell import KEEP_ALL, Cell, message_of
from forked import HANGS_S
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from shift import Shift, built, postures
from std_msgs.msg import String
from std_srvs.srv import Trigger

from robocal_ros.bags.bags import BagWriter
from robocal_ros.bags.mcap_files import message_class, recorded_name
from robocal_ros.bags.replay_node import ReplayNode, chosen_topics
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import JointSample
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import time_message

ROOT = Path(__file__).parents[2]
NS = 1_000_000_000
START_NS = 100 * NS
NEW = {"/gap_open", "/lease", "/joint_commands"}  # under the names of our recorder; others: older
HELD_BACK = {
    "/robot/gap_open": ("std_msgs/msg/Bool", "may move now"),
    "/gap_open": ("robocal_msgs/msg/GapOpen", "may move now"),
    "/lease": ("robocal_msgs/msg/MotionLease", "may move now"),
    "/joint_commands": ("sensor_msgs/msg/JointState", "move a robot"),
    "/arm_controller/joint_trajectory": ("trajectory_msgs/msg/JointTrajectory", "move a robot"),
    "/forward/commands": ("std_msgs/msg/Float64MultiArray", "move a robot"),
    "/joint_targets": ("sensor_msgs/msg/JointState", "move a robot"),
    "/tcf_node/next_step": ("robocal_msgs/msg/ToolStep", "move a robot"),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", "makes its own"),
}
DEAF = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("deaf")
node.create_subscription(String, "/note", lambda note: print("hears", flush=True), 10)
rclpy.spin(node)
"""
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


def write_bag(path: Path, count: int, period_ns: int) -> Path:
    with BagWriter(path) as bag:
        for i in range(count):
            ns = START_NS + i * period_ns
            joints = JointState(name=["a"], position=[float(i)])
            joints.header.stamp = time_message(ns)
            bag.write("/joint_states", "sensor_msgs/msg/JointState", joints, ns)
            if i % 10 == 0:
                bag.write("/note", "std_msgs/msg/String", {"data": str(i)}, ns)
        event = {"command": "configure", "arguments": "{}", "outcome": "{}"}
        bag.write("/n/session_events", "robocal_msgs/msg/SessionEvent", event, ns)
        bag.write("/odd", "std_msgs/msg/String", {"data": "odd"}, ns)
        for topic, (msgtype, _) in HELD_BACK.items():
            name = recorded_name(topic, msgtype) if topic in NEW else topic
            bag.write(name, msgtype, message_class(msgtype)(), ns)
    return path


class Listener:
    """The replay node's status, and what the probe got of the bag."""

    def __init__(self, graph: Any, profile: QoSProfile = KEEP_ALL) -> None:
        self.graph = graph
        self.joints = graph.collect(JointState, "/joint_states", profile)
        self.notes = graph.collect(String, "/note", KEEP_ALL)
        self.events = graph.collect(String, "/n/session_events", KEEP_ALL)
        self.clock = graph.collect(Clock, "/clock", BEST_EFFORT)
        self.reports = graph.collect(String, "/replay_node/status", endpoints.LATCHED)

    @property
    def status(self) -> dict[str, Any]:
        return json.loads(self.reports[-1].data) if self.reports else {"state": ""}

    def until(self, state: str) -> None:
        self.graph.spin_until(lambda: self.status["state"] == state, f"state {state}")


WAIT = {"wait_for_subscribers": "[/joint_states,/note]"}


def test_everything_arrives_as_fast_as_it_is_acknowledged(graph, tmp_path):
    count = 4000
    bag = write_bag(tmp_path / "shift.mcap", count, 1_000_000)
    listener = Listener(graph)
    process = graph.start("replay_node", {"bag": bag, "rate": 0.0, "exit_at_end": True} | WAIT)
    listener.until("done")
    graph.spin_until(lambda: len(listener.joints) == count, "all joint states")
    assert [m.position[0] for m in listener.joints] == list(range(count))
    assert len(listener.notes) == count // 10
    assert process.process.wait(HANGS_S) == 0
    status = listener.status
    assert status["sent"]["/joint_states"] == count
    assert status["unacknowledged"] == 0
    assert (status["best_effort"], status["lost"]) == ({}, [])
    assert "/n/session_events" in status["skipped"]
    assert listener.events == []


def test_what_may_move_a_robot_is_played_only_where_it_is_named(graph, tmp_path):
    bag = write_bag(tmp_path / "shift.mcap", 10, 1_000_000)
    listener = Listener(graph)
    process = graph.start("replay_node", {"bag": bag, "rate": 0.0} | WAIT)
    listener.until("done")
    told = listener.status
    for topic, (_, why) in HELD_BACK.items():
        assert why in told["skipped"][topic]
        assert "name it in 'topics'" in told["skipped"][topic]
    own = {"/diagnostics"}
    assert {topic for topic in HELD_BACK if graph.probe.count_publishers(topic)} == own
    assert process.stop() == 0
    named = [*HELD_BACK, "/joint_states", "/note"]
    graph.start("replay_node", {"bag": bag, "rate": 0.0, "topics": str(named)} | WAIT)

    def played() -> bool:  # the last word of the first may come late
        status = listener.status
        return status["state"] == "done" and status["sent"].keys() == set(named)

    graph.spin_until(played, "what is named is played")


def test_recorded_time_goes_at_its_rate_and_is_the_clock(graph, tmp_path):
    bag = write_bag(tmp_path / "shift.mcap", 100, 10_000_000)  # one second
    listener = Listener(graph)
    begin = graph.probe.get_clock().now().nanoseconds
    graph.start("replay_node", {"bag": bag, "rate": 2.0} | WAIT)
    listener.until("done")
    took_s = (graph.probe.get_clock().now().nanoseconds - begin) * 1e-9
    assert took_s >= 0.99 / 2.0  # a second at twice its rate, whatever else the machine does
    end = START_NS + 99 * 10_000_000

    def times() -> list[int]:
        return [m.clock.sec * NS + m.clock.nanosec for m in listener.clock]

    graph.spin_until(lambda: times() and times()[-1] == end, "the clock's last stamp")
    assert np.all(np.diff(times()) >= 0)
    assert times()[0] >= START_NS


def test_a_best_effort_subscriber_is_named(graph, tmp_path):
    bag = write_bag(tmp_path / "shift.mcap", 100, 1_000_000)
    listener = Listener(graph, BEST_EFFORT)
    process = graph.start("replay_node", {"bag": bag, "rate": 0.0} | WAIT)
    listener.until("done")
    named = {"/joint_states": ["/probe"]}  # a name may come after its endpoint
    graph.spin_until(lambda: listener.status["best_effort"] == named, "the subscriber's name")
    assert "/odd" in listener.status["unheard"]
    words = "messages of /joint_states to best-effort subscribers (/probe)"
    (told,) = listener.status["lost"]
    assert told == f"perhaps lost: {words}: make them reliable"
    assert process.stop() == 0


def test_topics_are_chosen_and_renamed(graph, tmp_path):
    bag = write_bag(tmp_path / "shift.mcap", 10, 1_000_000)
    listener = Listener(graph)
    graph.start(
        "replay_node",
        {
            "bag": bag,
            "rate": 0.0,
            "topics": "[/odd]",
            "remap": "['/odd:=/note']",
            "wait_for_subscribers": "[/note]",
        },
    )
    listener.until("done")
    graph.spin_until(lambda: listener.notes, "the renamed topic")
    assert [m.data for m in listener.notes] == ["odd"]
    assert listener.joints == []


def test_it_pauses_and_goes_on(graph, tmp_path):
    bag = write_bag(tmp_path / "shift.mcap", 200, 10_000_000)
    listener = Listener(graph)
    graph.start("replay_node", {"bag": bag, "rate": 4.0, "start_paused": True} | WAIT)
    listener.until("paused")
    graph.spin_for(0.2)
    assert listener.joints == []
    assert graph.call(Trigger, "/replay_node/play").message == "playing"
    graph.spin_until(lambda: len(listener.joints) > 20, "it plays")
    assert graph.call(Trigger, "/replay_node/pause").message == "paused"
    graph.spin_for(0.1)
    count = len(listener.joints)
    graph.spin_for(0.3)
    assert len(listener.joints) == count < 200
    graph.call(Trigger, "/replay_node/play")
    listener.until("done")
    graph.spin_until(lambda: len(listener.joints) == 200, "the rest")
    refused = graph.call(Trigger, "/replay_node/play")
    assert not refused.success
    assert "done" in refused.message


def test_a_thermal_node_takes_all_of_a_fast_replay(graph, tmp_path):
    nominal = load_robot("kr150_r3100")
    shift = Shift(nominal.joint_names)
    samples = list(shift.visit(built(nominal), postures(nominal, 20)))
    with BagWriter(tmp_path / "visit.mcap") as bag:
        for sample in samples:
            joints = isinstance(sample, JointSample)
            topic = "/joint_states" if joints else "/measured_point"
            kind = "sensor_msgs/msg/JointState" if joints else "geometry_msgs/msg/PointStamped"
            bag.write(topic, kind, message_of(sample), sample.stamp_ns)
    cell = Cell(graph, apart=True)
    bag, wait = tmp_path / "visit.mcap", "[/joint_states,/measured_point]"
    player = graph.start(
        "replay_node",
        {"bag": bag, "rate": 0.0, "wait_for_subscribers": wait, "exit_at_end": True},
    )
    sent = str(sum(isinstance(sample, JointSample) for sample in samples))
    graph.spin_until(lambda: cell.value("joint_states received") == sent, "all arrived")
    assert player.process.wait(HANGS_S) == 0
    answer = cell.call("capture_reference")
    assert (answer.success, answer.samples) == (True, 20)


def test_what_cannot_be_played_or_is_awaited_in_vain_is_said(graph, tmp_path):
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"not a bag")
    bag = write_bag(tmp_path / "shift.mcap", 10, 1_000_000)
    for given, words in (
        ({"bag": str(broken)}, "broken.mcap"),
        ({"bag": str(bag), "wait_for_subscribers": ["/nothing"]}, "/nothing, which is not played"),
    ):
        node = graph.add(ReplayNode, given)
        assert node.state == "unconfigured"
        assert words in node._failure.message


@pytest.mark.parametrize("settings", [{}, {"bag": "/there/is/none.mcap"}])
def test_who_waits_for_an_end_is_not_left_waiting_where_nothing_can_be_played(graph, settings):
    process = graph.start("replay_node", settings | {"exit_at_end": True})
    assert process.process.wait(HANGS_S) == 2


def test_wrong_choices_are_named():
    recorded = {"/a": "std_msgs/msg/String"}
    with pytest.raises(InputError, match=r"no topic /b; it has /a"):
        chosen_topics(recorded, ["/b"], [])
    with pytest.raises(InputError, match="recorded:=played"):
        chosen_topics(recorded, [], ["/a=/b"])


def test_without_a_bag_it_is_there_and_says_what_it_needs(graph):
    process = graph.start("replay_node", {})
    reports = graph.collect(String, "/replay_node/status", endpoints.LATCHED)
    graph.spin_until(lambda: reports, "it is active")
    assert json.loads(reports[-1].data)["state"] == "no bag"
    answer = graph.call(Trigger, "/replay_node/play")
    assert not answer.success
    assert "parameter 'bag'" in answer.message
    assert process.process.poll() is None


def test_play_waits_for_its_subscribers_and_says_for_which(graph, tmp_path):
    bag = write_bag(tmp_path / "shift.mcap", 20, 1_000_000)
    reports = graph.collect(String, "/replay_node/status", endpoints.LATCHED)
    settings = {"bag": bag, "rate": 0.0, "start_paused": True, "wait_for_subscribers": "[note]"}
    process = graph.start("replay_node", settings)
    graph.spin_until(lambda: reports, "it is active")
    assert graph.call(Trigger, "/replay_node/play").message == "waiting"
    graph.spin_until(lambda: "subscribers of note" in process.output, "it says so")
    notes = graph.collect(String, "/note", KEEP_ALL)
    graph.spin_until(lambda: json.loads(reports[-1].data)["state"] == "done", "it plays")
    graph.spin_until(lambda: len(notes) == 2, "nothing was sent before")
    status = json.loads(reports[-1].data)
    assert status["unheard"] == {"/joint_states": 20, "/odd": 1}
    told = "nothing was lost; nobody listened to 20 of /joint_states, 1 of /odd"
    graph.spin_until(lambda: told in process.output, "the end says so")


def test_the_commands_of_the_page_run_as_typed(graph):
    """In the repository's root; those with exit_at_end tell by their status how it went."""
    page = (ROOT / "docs" / "bags.md").read_text().replace("\\\n", " ")
    blocks = re.findall(r"```bash\n(.*?)```", page, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    typed = [shlex.split(line, comments=True) for line in lines if "exit_at_end" in line]
    assert typed
    environment = os.environ | {"ROS_DOMAIN_ID": str(graph.domain)}
    for words in typed:
        done = subprocess.run(words, cwd=ROOT, env=environment, timeout=HANGS_S, check=False)
        assert done.returncode == 0, words


@pytest.mark.long
def test_what_is_damaged_in_the_bag_counts_as_lost(graph, tmp_path):
    bag = write_bag(tmp_path / "shift.mcap", 20_000, 1_000_000)
    content = bytearray(bag.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 100] = bytes(100)
    bag.write_bytes(content)
    listener = Listener(graph)
    process = graph.start("replay_node", {"bag": bag, "rate": 0.0, "exit_at_end": True} | WAIT)
    listener.until("done")
    assert process.process.wait(HANGS_S) == 3
    assert len(listener.joints) < 20_000
    assert "damaged" in " ".join(listener.status["notes"])
    (told,) = listener.status["lost"]
    assert re.fullmatch(r"lost: damaged chunks of the bag: \d+", told)
    assert f"done: {told}" in process.output


def test_a_bag_that_is_played_again_has_counts_of_its_own(graph, tmp_path):
    bag = write_bag(tmp_path / "shift.mcap", 100, 1_000_000)
    listener = Listener(graph)
    node = graph.add(ReplayNode, {"bag": str(bag), "rate": 0.0})
    listener.until("done")
    node._topics.unacknowledged = 3  # as of a subscriber that was stopped
    node.trigger_deactivate()
    graph.spin_until(lambda: listener.status["lost"], "it is told what was lost")
    assert listener.status["state"] == "done"
    node.trigger_activate()
    graph.spin_until(lambda: not listener.status["lost"], "it is played again")
    listener.until("done")
    assert listener.status["sent"]["/joint_states"] == 100
    assert (listener.status["unacknowledged"], listener.status["lost"]) == (0, [])


def test_what_may_be_lost_is_said_in_the_same_way_and_ends_alike(graph, tmp_path):
    """A reader that confirms nothing, and one that is stopped before it can."""
    bag = write_bag(tmp_path / "shift.mcap", 100, 20_000_000)
    listener = Listener(graph, BEST_EFFORT)
    deaf = graph.run("deaf", [sys.executable, "-c", DEAF])
    graph.spin_until(lambda: graph.probe.count_subscribers("/note") == 2, "it listens")
    settings = {"bag": bag, "start_paused": True, "acknowledge_timeout_s": 0.5}
    process = graph.start("replay_node", settings | {"exit_at_end": True})
    listener.until("paused")
    graph.call(Trigger, "/replay_node/play")
    graph.spin_until(lambda: "hears" in deaf.output, "they have found each other")
    deaf.process.send_signal(signal.SIGSTOP)
    listener.until("done")
    assert process.process.wait(HANGS_S) == 3
    late, unconfirmed = listener.status["lost"]
    assert re.fullmatch(r"perhaps lost: \d+ messages that were not acknowledged", late)
    assert unconfirmed.startswith("perhaps lost: messages of /joint_states to best-effort ")
    assert f"done: {late}; {unconfirmed}" in process.output
