"""``robocal replay`` of a hand-eye session's bag."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import robocal, robocal_json
from hand_eye_bag import hand_eye_bag
from hand_eye_driver import FRAME, sphere_set

from robocal_ros.bags.bags import BagReader
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code

SCHEMA = "replay.hand_eye.json"


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "hand_eye.mcap"
    hand_eye_bag(path)
    return path


@pytest.fixture(scope="module")
def document(bag) -> dict[str, Any]:
    return dict(robocal_json(SCHEMA, "replay", bag))


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


def test_windows_are_for_thermal_recordings(bag):
    refused = robocal_json("error.json", "replay", bag, "--auto", status=2)
    assert "hand-eye node" in refused["error"]["message"]


def test_the_history_of_the_replay_can_be_kept(bag, tmp_path):
    found = robocal_json(SCHEMA, "replay", bag, "--state", tmp_path)["final_sensor"]["xyz_mm"]
    listed = robocal_json("history.list.json", "history", "list", "--state", tmp_path)
    kinds = {entry["kind"] for entry in listed["calibrations"]}
    assert kinds == {f"hand_eye/{FRAME}"}
    back = robocal("history", "rollback", "--kind", f"hand_eye/{FRAME}", "--to", "nominal",
                   "--state", tmp_path, "--by", "me", "--reason", "another sensor")  # fmt: skip
    assert back.returncode == 0, back.stderr
    assert f"nothing is in force again, as hand_eye/{FRAME} revision 2" in back.stdout.lower()
    # What the history shows is exported to a robot description.
    shown = robocal("history", "show", "1", "--state", tmp_path, "--json")
    file = tmp_path / "laser.json"
    file.write_text(shown.stdout)
    export = robocal("hand-eye", "export", "--result", file, "--format", "urdf", "--child", FRAME)
    x, y, z = (float(v) for v in export.stdout.partition('xyz="')[2].partition('"')[0].split())
    assert 1e3 * np.array([x, y, z]) == pytest.approx(found, abs=1e-4)
    unknown = robocal("history", "rollback", "--kind", "hand_eye/", "--state", tmp_path)
    assert unknown.returncode == 2
    assert "none of thermal, reference" in unknown.stderr


@pytest.mark.parametrize("kind", ["sphere", "step", "line"])
def test_the_golden_bags_give_what_they_recorded(kind):
    """On another machine not to the last bit, but to a hundredth of a millimetre."""
    file = Path(__file__).parents[2] / "bags" / f"hand_eye_{kind}.mcap"
    with BagReader(file) as reader:
        events = [m.message for m in reader.messages(["/hand_eye_node/session_events"])]
    recorded = [json.loads(e.outcome).get("status") for e in events if e.command != "configure"]
    in_force = json.loads(events[-1].arguments)["arguments"]["sensor"]
    document = robocal_json(SCHEMA, "replay", file)
    assert [Code[c["code"]] for c in document["commands"]] == recorded
    final = document["final_sensor"]
    T = np.array(in_force["T_parent_sensor"])
    assert (final["parent"], final["child"]) == (in_force["parent"], in_force["child"])
    found = frames.transform_from_quat(1e-3 * np.array(final["xyz_mm"]), final["quat_xyzw"])
    assert np.linalg.norm((found - T) @ [0.0, 0.0, 0.2, 1.0]) < 1e-5
