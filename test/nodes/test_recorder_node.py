# SPDX-License-Identifier: Apache-2.0
"""The recorder, live: what is offered late, latched or best effort, a kill, a second recording."""

import errno
import json
import os
import shutil
import socket
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from robocal_msgs.msg import SessionEvent
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from tool_cell_live import written_laser
from tool_driver import noisy_cell

from robocal_ros.bags import recorder_node
from robocal_ros.bags.bag_writer import (
    KEEP,
    MB,
    BagRecording,
    BagWriter,
    Maker,
    new_folder,
    recordings,
    size_bytes,
)
from robocal_ros.bags.bags import BagReader
from robocal_ros.bags.mcap_files import encode
from robocal_ros.bags.recorder_node import LOOK_S, TOPICS, RecorderNode
from robocal_ros.cell_sim.fixture import PLATE
from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.fixture.files import fixture_document
from robocal_ros.fixture.node import FixtureNode
from robocal_ros.hand_eye.node import HandEyeNode
from robocal_ros.maintenance.node import MaintenanceNode
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.thermal.node import ThermalNode
from robocal_ros.tool.node import TcfNode

NODE = "recorder_node"
WARN, ERROR = DiagnosticStatus.WARN, DiagnosticStatus.ERROR
TEXT, ALL = "std_msgs/msg/String", 10**9
LEFT_OUT = {"/image", "/image/compressed"}  # large
WIRED = {"/kinematic_model": "/thermal_node/model", "/tool": "/tcf_node/tool"}
MOTION = {  # by what moves a robot
    "trajectory_msgs/msg/JointTrajectory",
    "std_msgs/msg/Float64MultiArray",
    "robocal_msgs/msg/ToolStep",
}


def started(graph):
    given = {"topics": "[words, model, missing]", "folder": graph.state / "rec", "flush_s": 0.1}
    return graph.start(NODE, given)


def words(folder, topic: str) -> list[str]:
    with BagReader(folder) as bag:
        return [m.message.data for m in bag.messages([topic])]


def said(graph, publisher, kind, data) -> None:
    publisher.publish(kind(data=data))
    graph.spin_for(0.02)


def test_a_killed_recorder_keeps_what_it_flushed_and_the_next_begins_anew(graph):
    recorder = started(graph)
    publisher = graph.publisher(String, "/words", endpoints.SENSOR)
    for i in range(50):
        said(graph, publisher, String, f"{i}")
    graph.spin_for(0.5)  # five times as long as between two flushes
    recorder.kill()
    first = recordings(graph.state / "rec")[0].folder
    assert words(first, "/words") == [f"{i}" for i in range(50)]
    recorder = started(graph)

    def recorded_again() -> bool:
        said(graph, publisher, String, "again")  # the killed one still counts as a subscriber
        return len(recordings(graph.state / "rec")) == 2

    graph.spin_until(recorded_again, "a second recording")
    assert recorder.stop() == 0
    second = recordings(graph.state / "rec")[-1].folder
    with BagReader(second) as bag:
        assert not bag.info.notes
    assert set(words(second, "/words")) == {"again"}


def test_each_recording_opens_with_what_is_in_force(graph):
    started(graph)
    model = graph.probe.create_publisher(String, "/model", endpoints.own(endpoints.LATCHED))
    model.publish(String(data="revision 3"))  # long before anybody listens
    publisher = graph.publisher(String, "/words")
    said(graph, publisher, String, "before")
    kept = graph.call(Trigger, f"/{NODE}/keep")
    assert kept.success, kept.message
    assert kept.message.startswith("0 ACCEPT ")
    split = graph.call(Trigger, f"/{NODE}/split")
    assert split.success, split.message
    said(graph, publisher, String, "after")
    graph.spin_until(lambda: len(recordings(graph.state / "rec")) == 2, "a second recording")
    graph.spin_for(0.5)
    first, second = (one.folder for one in recordings(graph.state / "rec"))
    assert (first / KEEP).read_text().startswith("kept at ")
    assert not (second / KEEP).exists()
    for folder, expected in ((first, "before"), (second, "after")):
        assert words(folder, "/model") == ["revision 3"]
        assert words(folder, "/words") == [expected]
    with BagReader(second) as bag:
        assert not bag.info.topics.keys() - {"/model", "/words"}


def test_what_it_cannot_write_is_told_and_the_next_recording_opens_with_what_is_in_force(
    graph, monkeypatch
):
    """And how many were lost: its diagnostics are recorded too, a dispute must find the hole."""
    monkeypatch.setattr(recorder_node, "AGAIN_S", 0.2)
    graph.state.mkdir(exist_ok=True)
    obstacle = graph.state / "rec"
    obstacle.write_text("a file where the folder should be")
    model = graph.probe.create_publisher(String, "/model", endpoints.own(endpoints.LATCHED))
    model.publish(String(data="revision 3"))
    events = graph.probe.create_publisher(SessionEvent, "/events", EVENTS)
    commands = ["configure", "identify"]
    for number, command in enumerate(commands, start=1):
        events.publish(SessionEvent(sequence=number, command=command))
    topics = ["words", "model", "events"]
    node = graph.add(RecorderNode, {"topics": topics, "folder": str(obstacle), "flush_s": 0.1})
    publisher = graph.publisher(String, "/words")
    said(graph, publisher, String, "lost")
    answer = graph.call(Trigger, f"/{NODE}/keep")
    assert not answer.success
    assert "nothing is being recorded" in answer.message
    assert node.health().level == ERROR
    assert "cannot be made" in node.health().message
    obstacle.unlink()

    def recorded_again() -> bool:
        said(graph, publisher, String, "again")
        return bool(node.health().values["messages"])

    graph.spin_until(recorded_again, "it records again")
    graph.spin_for(2 * LOOK_S)
    health = node.health()
    assert health.level == WARN
    assert f"{health.values['messages not recorded']} messages since 20" in health.message
    node.trigger_deactivate()
    (recording,) = recordings(obstacle)
    folder = recording.folder
    assert words(folder, "/model") == ["revision 3"]
    assert set(words(folder, "/words")) <= {"again"}
    with BagReader(folder) as bag:
        assert [m.message.command for m in bag.messages(["/events"])] == commands


def test_what_no_flush_brought_to_the_disk_counts_as_not_recorded(graph, monkeypatch):
    def full(writer: BagWriter) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    given = {"topics": ["words"], "folder": str(graph.state / "rec"), "flush_s": 60.0}
    node = graph.add(RecorderNode, given)
    publisher = graph.publisher(String, "/words")
    for i in range(10):
        said(graph, publisher, String, f"{i}")
    graph.spin_until(lambda: node.health().values["/words recorded"] == 10, "all came")
    monkeypatch.setattr(BagWriter, "flush", full)
    split = graph.call(Trigger, f"/{NODE}/split")
    assert not split.success
    assert "No space left on device" in split.message
    health = node.health()
    assert (health.level, health.values["messages not recorded"]) == (ERROR, 10)
    assert "10 messages since 20" in health.message


def test_a_recording_whose_folder_is_removed_is_told_and_begun_anew(graph, monkeypatch):
    """Also what was recorded before, and the room is kept meanwhile."""
    monkeypatch.setattr(recorder_node, "AGAIN_S", 0.2)
    folder = graph.state / "rec"
    node = graph.add(RecorderNode, {"topics": ["words"], "folder": str(folder)})
    publisher = graph.publisher(String, "/words")

    def told(level: int, words: str) -> bool:
        said(graph, publisher, String, "words")
        health = node.health()
        return health.level == level and words in health.message

    graph.spin_until(lambda: told(DiagnosticStatus.OK, ""), "it records")
    (removed,) = recordings(folder)
    shutil.rmtree(folder)
    graph.spin_until(lambda: told(ERROR, "removed, moved or replaced"), "it is told")
    graph.spin_until(lambda: told(WARN, f"{removed.folder}: removed"), "it records again")
    (again,) = recordings(folder)
    assert node.health().values["folder"] == again.folder
    node.trigger_deactivate()
    assert set(words(again.folder, "/words")) == {"words"}


def test_what_another_of_its_name_may_have_made_stays_while_that_one_writes(graph, monkeypatch):
    """A second robot's recorder with all defaults; one of another domain is never it."""
    monkeypatch.setattr(recorder_node, "ROOM_S", 0.1)
    folder = graph.state / "rec"

    def begun(domain: int, run: str) -> BagRecording:
        maker = Maker(f"/{NODE}", "", f"{socket.gethostname()}, domain {domain}", run)
        recording = BagRecording(new_folder(folder, maker), latched=(), file_bytes=ALL)
        for _ in range(20):
            data = bytes(encode(TEXT, {"data": os.urandom(50_000).hex()}))
            recording.write("/words", TEXT, data, 1)
        return recording

    other, earlier, rival = begun(graph.domain + 1, "0"), begun(graph.domain, "1"), None
    other.close()
    earlier.close()
    rival = begun(graph.domain, "2")
    node = graph.add(RecorderNode, {"topics": ["words"], "folder": str(folder), "keep_mb": 1.0})
    publisher = graph.publisher(String, "/words")

    def records() -> bool:
        said(graph, publisher, String, "words")
        return bool(node.health().values["messages"])

    graph.spin_until(records, "it records")
    graph.spin_until(lambda: str(rival.folder) in node.health().message, "the other is told")
    assert node.health().level == WARN
    graph.spin_for(0.5)  # five looks
    assert all(one.folder.exists() for one in (other, earlier, rival))
    rival.close()
    graph.spin_until(lambda: not earlier.folder.exists(), "room is made")
    graph.spin_until(lambda: node.health().level == DiagnosticStatus.OK, "nothing is told any more")
    assert other.folder.exists()


@pytest.mark.parametrize("less", [endpoints.SENSOR, endpoints.RELIABLE])
def test_what_comes_back_with_less_than_before_is_recorded(graph, less):
    """A driver is started anew: best effort instead of reliable, or no longer latched."""
    node = graph.add(RecorderNode, {"topics": ["words"], "folder": str(graph.state / "rec")})
    before = endpoints.RELIABLE if less is endpoints.SENSOR else endpoints.LATCHED
    first = graph.probe.create_publisher(String, "/words", endpoints.own(before))
    count: dict[str, int] = {}

    def recorded(by: Any) -> bool:
        said(graph, by, String, "words")
        return bool(node.health().values["messages"] > count.setdefault("before", 0))

    graph.spin_until(lambda: recorded(first), "the first is recorded")
    graph.probe.destroy_publisher(first)
    graph.spin_for(0.5)
    count["before"] = node.health().values["messages"]
    second = graph.probe.create_publisher(String, "/words", endpoints.own(less))
    graph.spin_until(lambda: recorded(second), "the second is recorded")


KEEP_MB = 2.0


def test_all_recordings_together_stay_in_their_room(graph, monkeypatch):
    """Two robots' recorders of one folder, each with more than it may keep: 4 MB a second."""

    def of(name: str) -> list[Any]:
        return [one.folder for one in recordings(folder) if one.maker.node == f"/{name}/{NODE}"]

    monkeypatch.setattr(recorder_node, "ROOM_S", 0.1)
    folder = graph.state / "rec"
    given = {"topics": ["words"], "folder": str(folder), "keep_mb": KEEP_MB, "file_mb": 0.1}
    names = "left", "right"
    nodes = [graph.add(RecorderNode, given | {"flush_s": 0.1}, namespace=name) for name in names]
    robots = [graph.publisher(String, f"/{name}/words") for name in names]
    largest, sent = 0.0, 0
    while sent < 60:  # three times what each may keep
        for publisher in robots:
            said(graph, publisher, String, f"{sent} {os.urandom(50_000).hex()}")
        sent += 1
        largest = max(
            largest, *(sum(size_bytes(found) for found in of(name)) / MB for name in names)
        )
    told = [f"/{name}/words recorded" for name in names]
    graph.spin_until(
        lambda: all(
            node.health().values[key] == sent for node, key in zip(nodes, told, strict=True)
        ),
        "all is recorded",
    )
    graph.spin_for(0.5)  # five times as long as between two flushes
    # what comes between two looks is beside it
    assert KEEP_MB / 2 < largest < KEEP_MB * 1.5
    last = {name: [] for name in names}
    for name in names:
        for found in of(name):
            with BagReader(found) as bag:
                for message in bag.messages():
                    assert message.topic == f"/{name}/words"
                    last[name].append(int(message.message.data.split()[0]))
    for numbers in last.values():  # nothing of the newest is missing
        assert numbers == list(range(numbers[0], sent))
        assert len(numbers) > 1


def test_what_it_did_not_make_stays_and_is_told_once(graph, tmp_path, monkeypatch, capfd):
    """A checkout and a link beside the recordings, both older than these."""
    monkeypatch.setattr(recorder_node, "ROOM_S", 0.1)
    folder = graph.state / "rec"
    checkout = folder / "robocal_ros"
    checkout.mkdir(parents=True)
    (checkout / "setup.py").write_text("work of years")
    (folder / "robocal_elsewhere").symlink_to(tmp_path)
    given = {"topics": ["words"], "folder": str(folder), "keep_mb": KEEP_MB, "file_mb": 0.1}
    node = graph.add(RecorderNode, given)
    publisher = graph.publisher(String, "/words")

    def deleted() -> bool:
        said(graph, publisher, String, os.urandom(50_000).hex())
        return bool(node.health().values["recordings deleted"])

    graph.spin_until(deleted, "room is made", 60.0)
    assert (checkout / "setup.py").read_text() == "work of years"
    left = node.health().values["left alone"]
    assert "robocal_ros has no robocal_recording.json" in left
    assert "robocal_elsewhere is a symbolic link" in left
    log = capfd.readouterr().err
    assert log.count("robocal_ros in") == log.count("robocal_elsewhere in") == 1


def test_a_disk_that_fills_up_is_relieved_and_what_others_take_is_told(
    graph, small_disk, monkeypatch
):
    """First its own recordings make the room, then there are none: it says so, and comes back."""
    for name in ("ROOM_S", "AGAIN_S"):
        monkeypatch.setattr(recorder_node, name, 0.1)
    given = {"topics": ["words"], "folder": str(small_disk), "file_mb": 0.1, "flush_s": 0.1}
    node = graph.add(RecorderNode, given | {"keep_mb": 2.0, "free_mb": 0.8})
    publisher = graph.publisher(String, "/words")

    def publish() -> None:
        said(graph, publisher, String, os.urandom(20_000).hex())

    def free_bytes() -> int:
        disk = os.statvfs(small_disk)
        return disk.f_bavail * disk.f_frsize

    def deleted() -> bool:
        publish()
        return node.health().values["recordings deleted"] >= 2

    graph.spin_until(deleted, "room is made", 60.0)
    assert node.health().level != ERROR
    theirs = small_disk / "theirs"

    def filled() -> bool:
        publish()
        with theirs.open("ab") as file:
            file.write(bytes(max(free_bytes() - 400_000, 0)))
        return node.health().level == ERROR

    graph.spin_until(filled, "it is told", 60.0)
    assert "free_mb is 0.8" in node.health().message
    assert recordings(small_disk)  # the newest is still there
    theirs.unlink()
    graph.spin_until(lambda: publish() or node.health().level == WARN, "it records again", 60.0)
    assert "are not recorded" in node.health().message  # those of meanwhile


def test_the_type_is_the_one_that_is_offered(graph):
    node = graph.add(RecorderNode, {"topics": ["words"], "folder": str(graph.state / "rec")})
    said(graph, graph.publisher(Bool, "/words"), Bool, True)
    graph.spin_until(lambda: node.health().values["messages"], "it is recorded")
    node.trigger_deactivate()
    (recording,) = recordings(graph.state / "rec")
    assert words(recording.folder, "/words") == [True]


NODES = {
    ThermalNode: {},
    TcfNode: {"motion": "trajectory"},
    HandEyeNode: {},
    FixtureNode: {"robot": "kr150_r3100"},
    JointCorrectionNode: {},
    MaintenanceNode: {"home_deg": [0.0, -90.0, 90.0, -90.0, -90.0, 0.0]},
}


@pytest.mark.parametrize("kind", NODES, ids=lambda kind: kind.NAME)
def test_what_a_node_takes_and_how_it_moves_the_robot_is_recorded(graph, tmp_path, kind):
    given = dict(NODES[kind])
    if kind is TcfNode:
        given |= {"laser": written_laser(tmp_path, noisy_cell())}
    if kind is FixtureNode:
        file = tmp_path / "plate.yaml"
        file.write_text(json.dumps(fixture_document(PLATE)))
        given |= {"fixture_file": str(file)}
    node = graph.add(kind, given)
    assert node.state == "active"
    recorded = {graph.probe.resolve_topic_name(topic) for topic in TOPICS}
    inputs = {node.resolve_topic_name(topic) for topic in node.inputs}
    assert {WIRED.get(topic, topic) for topic in inputs - LEFT_OUT} <= recorded
    offered = node.get_publisher_names_and_types_by_node(kind.NAME, "/")
    moves = {topic for topic, types in offered if MOTION & set(types)}
    targets = {topic for topic, _ in offered if topic.endswith("/joint_targets")}
    assert moves | targets <= recorded
    assert bool(moves) == (kind in (TcfNode, JointCorrectionNode, MaintenanceNode))
