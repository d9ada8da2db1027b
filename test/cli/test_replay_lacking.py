"""Bags without what their sessions measured with: refused with what is missing, not replayed."""

from pathlib import Path

import pytest
from command import ROOT, robocal, robocal_json

from robocal_ros.bags.bags import BagReader, BagWriter
from robocal_ros.bags.replay import needed_inputs
from robocal_ros.ground.errors import Code
from robocal_ros.session.events import IDENTIFY, Command

BAGS = ROOT / "bags"
EXCERPT = BAGS / "golden_excerpt.mcap"
THERMAL = "session_events:=/thermal_node/session_events"
LACKING = {
    "hand_eye_sphere": ("/hand_eye_node/session_events", "profile", "/profile"),
    "tool_runs": ("/tcf_node/session_events", "beam_events", "/beam_events"),
}


def without(bag: Path, folder: Path, *topics: str, **renamed: str) -> Path:
    """The bag without topics, and without what it tells of the truth; others renamed."""
    path = folder / bag.name
    with BagReader(bag) as reader, BagWriter(path) as writer:
        for m in reader.messages(raw=True):
            if m.topic not in topics and "truth" not in m.topic:
                topic = renamed.get(m.topic.strip("/"), m.topic)
                writer.write(topic, m.msgtype, m.message, m.log_time_ns)
    return path


@pytest.mark.parametrize("name", LACKING)
def test_it_names_session_topic_and_remedy(name, tmp_path):
    session, kind, topic = LACKING[name]
    bag = without(BAGS / f"{name}.mcap", tmp_path, topic)
    refused = robocal_json("error.json", "replay", bag, status=2)["error"]
    assert refused["code"] == Code.BAD_INPUT.name
    for part in (str(bag), session, f"{kind} of {topic}", "record it", f"--topic {kind}:=TOPIC"):
        assert part in refused["message"]
    done = robocal("validate", bag, "--report", tmp_path / "report", "--jobs", "1")
    assert f"the session of {session} had {kind} of {topic}" in done.stderr
    assert done.returncode != 0


def test_by_another_name_it_is_replayed(tmp_path):
    bag = without(BAGS / "tool_runs.mcap", tmp_path, beam_events="/station/edges")
    robocal_json("error.json", "replay", bag, status=2)
    given = ("--topic", "beam_events:=/station/edges")
    assert robocal_json("replay.tool.json", "replay", bag, *given)["runs"]


def test_motor_temperatures_that_nothing_is_computed_from_may_be_missing(tmp_path):
    bag = without(EXCERPT, tmp_path, "/motor_temperatures")
    whole, part = (
        robocal_json("replay.json", "replay", b, "--topic", THERMAL) for b in (EXCERPT, bag)
    )
    assert part["candidates"] == whole["candidates"]
    assert part["commands"] == whole["commands"]


@pytest.mark.parametrize(("prior", "needed"), [("default", False), ("learned", True)])
def test_motor_temperatures_are_needed_with_a_learned_prior(prior, needed):
    marks = {"clock_jumps": 0, "joint_states": 5, "beam_events/x": 4, "motor_temperatures": 3}
    configured = Command("configure", {"config": {"prior": prior}})
    found = needed_inputs(configured, [(Command(IDENTIFY, marks=marks), {})])
    temperatures = {"motor_temperatures"} if needed else set()
    assert found == {"joint_states", "beam_events"} | temperatures
