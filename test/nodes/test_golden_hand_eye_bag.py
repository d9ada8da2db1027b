# SPDX-License-Identifier: Apache-2.0
"""The golden hand-eye bags: replayed, and played through the live node, with the same results."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from command import robocal_json
from hand_eye_live import STREAM, TYPES
from long_form import more
from rclpy.serialization import deserialize_message
from recordings import with_events
from robocal_msgs.msg import SessionEvent

from robocal_ros.bags.bags import BagReader
from robocal_ros.ground.samples import JOINTS
from robocal_ros.hand_eye.data import PROFILE, TRACKER_POINT
from robocal_ros.hand_eye.node import HandEyeNode
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.session.events import (
    ACCEPT,
    BREAK_OFF,
    CALIBRATE,
    CAPTURE,
    CONFIGURE,
    REMOVE,
    SAMPLE,
    START,
    Command,
)

BAGS = Path(__file__).parents[2] / "bags"
EVENT_TOPIC = "/hand_eye_node/session_events"
INPUTS = {f"/{kind}": kind for kind in (JOINTS, PROFILE, TRACKER_POINT)}
CALLED = (START, CAPTURE, REMOVE, CALIBRATE, ACCEPT)
SETTINGS = {"sensor_frame": "laser", "capture_timeout_s": 1.0}
Z_GROWS = {"step": "towards", "tracker": "away"}


@pytest.fixture(
    scope="module", params=["tracker", *more("step")]
)  # with marks; others replay elsewhere
def bag(request: Any, tmp_path_factory: Any) -> Path:
    """The bag made anew: only on the machine that made it are results equal to the last bit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BAGS))
        import make_hand_eye
        import make_tracker

        path = tmp_path_factory.mktemp("bag") / f"{request.param}.mcap"
        if request.param == "tracker":
            make_tracker.record(path)
        else:
            make_hand_eye.write_bag(make_hand_eye.build(request.param), path)
        for name in (
            "make_tracker",
            "make_hand_eye",
            "hand_eye_program",
            "hand_eye_recorder",
            "session_events",
        ):
            sys.modules.pop(name, None)
    return path


def test_it_replays_bit_for_bit(bag: Path) -> None:
    document = robocal_json("replay.hand_eye.json", "replay", bag)
    assert document["differs"] == []
    assert document["warnings"] == []
    (found,) = document["calibrations"]
    assert document["final_sensor"]["xyz_mm"] == found["T_flange_sensor"]["xyz_mm"]


def test_live_equals_replay_bit_for_bit(graph: Any, bag: Path, tmp_path: Path) -> None:
    """Every message over DDS; the calls where they were made; every outcome as it was recorded."""
    live = graph.collect(SessionEvent, EVENT_TOPIC, EVENTS)
    target = {"target": bag.stem, "target_file": str(bag.with_suffix(".yaml"))}
    target |= {"z_grows": Z_GROWS[bag.stem]}
    node = graph.add(HandEyeNode, SETTINGS | target)
    publishers = {t: graph.publisher(TYPES[kind], t, STREAM) for t, kind in INPUTS.items()}
    wanted, sent = [], 0
    with BagReader(bag) as reader:
        for m in reader.messages([*INPUTS, EVENT_TOPIC], raw=True):
            if m.topic != EVENT_TOPIC:
                publishers[m.topic].publish(deserialize_message(m.message, TYPES[INPUTS[m.topic]]))
                sent += 1
                _wait(graph, node, sent)
                continue
            event = deserialize_message(m.message, SessionEvent)
            wanted.append(event)
            if event.command in CALLED:
                arguments = json.loads(event.arguments)["arguments"]
                node._desk.ask(Command(event.command, arguments))
    recorded = _changes(wanted)
    graph.spin_until(lambda: len(_changes(live)) >= len(recorded), "all events")
    assert _changes(live) == recorded
    assert [e.sequence for e in live] == list(range(1, len(live) + 1))
    never = {REMOVE} if bag.stem == "tracker" else set()
    assert {SAMPLE, BREAK_OFF, *CALLED} - never <= {e.command for e in live}
    again = with_events(bag, live, tmp_path / "live.mcap", EVENT_TOPIC, INPUTS)
    document = robocal_json("replay.hand_eye.json", "replay", again)
    assert document["differs"] == []
    made = robocal_json("replay.hand_eye.json", "replay", bag)
    assert document["calibrations"] == made["calibrations"]


def _changes(events: list[SessionEvent]) -> list[Any]:
    """Each command, its samples, and what came of it; revisions and ids too, of an empty history.

    Without configurations that say again, to late listeners, what the last one did.
    """
    told: list[Any] = []
    configured = None
    for event in events:
        arguments, outcome = json.loads(event.arguments), json.loads(event.outcome)
        if event.command == CONFIGURE:
            again, configured = arguments["arguments"] == configured, arguments["arguments"]
            if again:
                continue
        stamp = event.stamp.sec, event.stamp.nanosec
        told.append((event.command, stamp, arguments, outcome))
    return told


def _wait(graph: Any, node: HandEyeNode, sent: int) -> None:
    """One message at a time, so that the topics stay in order."""
    inputs = node.inputs
    graph.spin_until(lambda: sum(i.received for i in inputs.values()) >= sent, "the message")
