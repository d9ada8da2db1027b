# SPDX-License-Identifier: Apache-2.0
"""``robocal replay`` of bags of tools and sensors, by blocks, and of bags that lack something."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import ROOT, robocal, robocal_json
from hand_eye_bag import hand_eye_bag
from hand_eye_driver import FRAME, sphere_set

from robocal_ros.bags.bags import BagReader, BagWriter
from robocal_ros.bags.replay import needed_inputs
from robocal_ros.cli.recording import BagOverview
from robocal_ros.cli.replay import ReplayRequest, replay_bag
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session.events import IDENTIFY, Command

BAGS = ROOT / "bags"
BAG = BAGS / "tool_runs.mcap"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """The bag made anew: only on the machine that made it are results equal to the last bit."""
    sys.path.insert(0, str(BAGS))
    from make_tool_runs import record

    path = tmp_path_factory.mktemp("bag") / "made.mcap"
    record(path)
    return path


def test_the_bag_in_the_repository_gives_the_recorded_verdicts():
    document = robocal_json("replay.tool.json", "replay", BAG)
    runs = document["runs"]
    assert [r.get("answer", "") for r in runs] == ["", "pass", "recalibrate", "", "pass"]
    assert document["warnings"] == []
    refused = [c for c in document["commands"] if c["code"] == "BEAM_EDGES_WRONG"]
    assert [c["message"].split(":")[0] for c in refused] == ["high"]
    with BagReader(BAG) as reader:
        truth = [json.loads(m.message.data) for m in reader.messages(["/truth/tool"])][-1]
    (bent,) = [r for r in runs if "answer" not in r and not r["change"]["tip_mm"] < 1.0]
    away = 1e-3 * np.array(bent["tcp_mm"]) - np.array(truth["T_flange_tool"])[:3, 3]
    covariance = np.array(bent["covariance"])[:3, :3]
    assert away @ np.linalg.solve(covariance, away) < 16.3  # chi-square of 3, 1e-3
    assert document["final_tool"]["xyz_mm"] == bent["tcp_mm"]
    assert document["final_tool"]["revision"] == 1


def test_replay_equals_the_recording_and_its_tool_is_exported_from_the_history(made, tmp_path):
    state = tmp_path / "state"
    document = robocal_json("replay.tool.json", "replay", made, "--state", state)
    assert document["differs"] == []
    steps = 5 + 2 + 1 + 2 + 5 + 2  # of the six runs; the bumped tool need not plunge
    assert len(document["commands"]) == 6 + steps + 1
    assert "Every recorded result comes out equal" in robocal("replay", made).stdout
    final = document["final_tool"]
    shown = robocal("history", "show", 2, "--state", state, "--json").stdout
    file = tmp_path / "shown.json"
    file.write_text(shown)
    text = robocal("tool", "export", "--tool", file, "--format", "ur").stdout
    xyz = [float(n) for n in re.findall(r"-?\d+\.\d+", text)[:3]]
    assert xyz == pytest.approx(1e-3 * np.array(final["xyz_mm"]), abs=1e-6)
    done = robocal("history", "rollback", "--to", "nominal", "--kind", "tool", "--state", state,
                   "--by", "me", "--reason", "the old torch is back")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "The taught tool is in force again, as tool revision 2" in done.stdout


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


def replayed(bag: Path, robot: str, state: Path, *, blocks: bool):
    """The document, all that the history keeps, and how many messages or blocks were read."""
    taken = []

    def watch(what: str, recording: BagOverview):
        for message in recording.blocks() if blocks else recording.samples():
            taken.append(message)
            yield message

    arm = load_robot(robot)
    request = ReplayRequest(bag, lambda configured: arm, state=state, auto="shift" in bag.name)
    document = replay_bag(request, watch)
    with CalibrationHistory.open(bag.stem, state_dir=state) as history:
        kept = [
            (
                entry,
                history.document(entry.id),
                history.model(entry.id),
                {name: array.tobytes() for name, array in history.inputs(entry.id).items()},
            )
            for entry in history.list(1000)
        ]
    return document, kept, len(taken)


@pytest.mark.parametrize(
    ("name", "robot"),
    [
        ("thermal_shift", "kr150_r3100"),
        ("tool_runs", "ur10"),
        ("hand_eye_sphere", "ur10"),
    ],
)
def test_the_golden_bags(name, robot, tmp_path):
    bag = BAGS / f"{name}.mcap"
    one_by_one, kept, messages = replayed(bag, robot, tmp_path / "a", blocks=False)
    in_blocks, kept_too, blocks = replayed(bag, robot, tmp_path / "b", blocks=True)
    assert in_blocks == one_by_one
    assert kept_too == kept
    assert len(kept) > 0
    assert blocks < messages


SENSOR = "replay.hand_eye.json"


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "hand_eye.mcap"
    hand_eye_bag(path)
    return path


@pytest.fixture(scope="module")
def document(bag) -> dict[str, Any]:
    return dict(robocal_json(SENSOR, "replay", bag))


def test_replay_equals_the_recording_bit_for_bit(bag, document):
    assert document["differs"] == []
    assert document["warnings"] == []
    names = [c["command"] for c in document["commands"]]
    assert names == [
        "start", *["capture", "sample"] * 10, "capture", "break_off", "calibrate", "accept", "load",
        "calibrate",
    ]  # fmt: skip
    assert "Every recorded result comes out equal" in robocal("replay", bag).stdout


def test_the_document_tells_the_calibrations_and_what_is_in_force(document):
    whole, part = document["calibrations"]
    assert len(whole["residual_mm"]["per_sample"]) == 10
    assert len(part["residual_mm"]["per_sample"]) == 8
    final = document["final_sensor"]
    assert (final["parent"], final["child"], final["revision"]) == ("tool0", FRAME, 1)
    assert final["xyz_mm"] == whole["T_flange_sensor"]["xyz_mm"]
    truth_mm = 1e3 * sphere_set()[0].T_flange_sensor[:3, 3]
    assert np.linalg.norm(np.array(final["xyz_mm"]) - truth_mm) < 1.0  # at 0.2 m less
    (failed,) = [c for c in document["commands"] if c["command"] == "break_off"]
    assert failed["code"] == "TOO_FEW_SAMPLES"
    assert "within 1 s" in failed["message"]


@pytest.mark.parametrize(("name", "node"), [("tool_runs", "tool"), ("hand_eye_sphere", "hand-eye")])
def test_windows_are_for_thermal_recordings(name, node):
    refused = robocal_json("error.json", "replay", BAGS / f"{name}.mcap", "--auto", status=2)
    assert f"{node} node" in refused["error"]["message"]


def test_the_history_of_the_replay_can_be_kept(bag, tmp_path):
    found = robocal_json(SENSOR, "replay", bag, "--state", tmp_path)["final_sensor"]["xyz_mm"]
    listed = robocal_json("history.list.json", "history", "list", "--state", tmp_path)
    kinds = {entry["kind"] for entry in listed["calibrations"]}
    assert kinds == {f"hand_eye/{FRAME}"}
    # What the history shows is exported to a robot description.
    file = tmp_path / "laser.json"

    def exported():
        shown = robocal("history", "show", "1", "--state", tmp_path, "--json")
        file.write_text(shown.stdout)
        return robocal("hand-eye", "export", "--result", file, "--format", "urdf", "--child", FRAME)

    export = exported()
    x, y, z = (float(v) for v in export.stdout.partition('xyz="')[2].partition('"')[0].split())
    assert 1e3 * np.array([x, y, z]) == pytest.approx(found, abs=1e-4)
    back = robocal("history", "rollback", "--kind", f"hand_eye/{FRAME}", "--to", "nominal",
                   "--state", tmp_path, "--by", "me", "--reason", "another sensor")  # fmt: skip
    assert back.returncode == 0, back.stderr
    assert f"nothing is in force again, as hand_eye/{FRAME} revision 2" in back.stdout.lower()
    assert "calibration was rolled back" in exported().stderr
    unknown = robocal("history", "rollback", "--kind", "hand_eye/", "--state", tmp_path)
    assert unknown.returncode == 2
    assert "none of thermal, reference" in unknown.stderr


RIGID = BAGS / "rigid"  # before simulated robots had gears; of thermal_node and sensors by b419956


def test_the_runs_of_an_older_recording_stay_as_they_were():
    """Every verdict, and the tool in the end to a hundredth of a millimetre."""
    file = RIGID / "tool_runs.mcap"
    with BagReader(file) as reader:
        recorded = [m.message for m in reader.messages(["/tcf_node/session_events"])]
    codes = [json.loads(e.outcome)["status"] for e in recorded if e.command != "configure"]
    configured = [e for e in recorded if e.command == "configure"]
    in_force = json.loads(configured[-1].arguments)["arguments"]["tool"]
    document = robocal_json("replay.tool.json", "replay", file)
    assert [Code[c["code"]] for c in document["commands"]] == codes
    tip_mm = 1e3 * np.array(in_force["T_flange_tool"])[:3, 3]
    assert document["final_tool"]["xyz_mm"] == pytest.approx(tip_mm.tolist(), abs=0.01)


def test_the_cycles_of_an_older_recording_stay_as_they_were():
    """What the golden shift of b419956 holds of thermal_node, by the definitions that it brings."""
    file = RIGID / "thermal_cycles.mcap"
    with BagReader(file) as reader:
        events = [m.message for m in reader.messages(["/thermal_node/session_events"])]
    document = robocal_json("replay.json", "replay", file)
    commands = document["commands"]
    outcomes = [(e.command, json.loads(e.outcome)) for e in events if e.command != "configure"]
    assert [(c["command"], Code[c["code"]]) for c in commands] == [
        (name, outcome["status"]) for name, outcome in outcomes
    ]
    judged = [c["message"] for c in commands if c["command"] == "end_cycle"]
    assert judged == [o["message"] for name, o in outcomes if name == "end_cycle"]
    assert len(judged) == 2
    assert document["warnings"] == []


@pytest.mark.parametrize(
    "file",
    [*(folder / f"hand_eye_{kind}.mcap" for folder in (BAGS, RIGID)
       for kind in ("sphere", "step", "line"))],
    ids=lambda file: f"{file.parent.name}/{file.stem}",
)  # fmt: skip
def test_the_golden_bags_give_what_they_recorded(file):
    """On another machine not to the last bit, but to a hundredth of a millimetre."""
    with BagReader(file) as reader:
        events = [m.message for m in reader.messages(["/hand_eye_node/session_events"])]
    recorded = [json.loads(e.outcome).get("status") for e in events if e.command != "configure"]
    in_force = json.loads(events[-1].arguments)["arguments"]["sensor"]
    document = robocal_json(SENSOR, "replay", file)
    assert [Code[c["code"]] for c in document["commands"]] == recorded
    final = document["final_sensor"]
    T = np.array(in_force["T_parent_sensor"])
    assert (final["parent"], final["child"]) == (in_force["parent"], in_force["child"])
    found = frames.transform_from_quat(1e-3 * np.array(final["xyz_mm"]), final["quat_xyzw"])
    assert np.linalg.norm((found - T) @ [0.0, 0.0, 0.2, 1.0]) < 1e-5
