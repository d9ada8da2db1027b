"""``robocal replay`` of the golden tool bag."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from command import robocal, robocal_json

from robocal_ros.bags.bags import BagReader

BAGS = Path(__file__).parents[2] / "bags"
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


def test_windows_are_for_thermal_recordings():
    robocal_json("error.json", "replay", BAG, "--auto", status=2)
