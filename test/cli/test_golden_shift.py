# SPDX-License-Identifier: Apache-2.0
"""A commissioning as the golden shift's script records it, and the shift's excerpt, replayed."""

import csv
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import beyond_rounding, robocal_json

from bench.closed_loop import setting
from bench.closed_loop.plant import equipped
from robocal_ros.bags.bags import BagReader, bag_info
from robocal_ros.cell_sim.cell import SimulatedCell, kr150_cell
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import TOOL
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.judging import KnownTool

BAGS = Path(__file__).parents[2] / "bags"
BAG = BAGS / "golden_excerpt.mcap"
SCHEMAS = {"thermal_node": "replay.json", "tcf_node": "replay.tool.json"}


@pytest.fixture(scope="module")
def script() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BAGS))
        import make_golden_shift

        yield make_golden_shift
        sys.modules.pop("make_golden_shift", None)


@pytest.fixture(scope="module")
def made(script, tmp_path_factory) -> tuple[SimulatedCell, Path]:
    """The commissioning, and its bag."""
    path = tmp_path_factory.mktemp("golden") / "made.mcap"
    nominal = load_robot("kr150_r3100")
    cell = SimulatedCell(kr150_cell(nominal, 3, points=500))
    with (
        script.recorder(path, (-np.inf, np.inf)) as recorder,
        equipped(nominal, cell, recorder.record) as (plant, _),
    ):
        recorder.watch(plant)
        plant.commission()
        assert plant.refused == []
    return cell, path


def test_the_drives_take_all_that_the_suite_sends(made):
    motion = made[0].motion
    assert motion.faults == 0
    assert 0.0 < motion.peak_share < 1.0  # counted at all, and within the drives' speed


@pytest.mark.parametrize("node", SCHEMAS)
def test_a_replay_equals_the_loop_bit_for_bit(made, node):
    """Made here: only on one machine are results equal to the last bit."""
    document = replayed(made[1], node)
    assert document["differs"] == []
    assert document["commands"]


def replayed(bag: Path, node: str, *options: object) -> dict[str, Any]:
    topic = f"session_events:=/{node}/session_events"
    return robocal_json(SCHEMAS[node], "replay", bag, "--topic", topic, *options)


# ---- the excerpt in the repository --------------------------------------------------------------


def test_the_excerpt_is_small_and_says_what_it_is():
    info = bag_info(BAG)
    assert BAG.stat().st_size < 5_000_000
    assert not info.notes
    assert info.topics["/joint_states"].messages == pytest.approx(600 * 125, rel=1e-3)
    with BagReader(BAG) as reader:
        truth = [json.loads(m.message.data) for m in reader.messages(["/truth/state"])]
    assert len(truth) == pytest.approx(600, abs=2)
    assert all(one["simulated"] for one in truth)
    assert "collision" not in truth[0]["faults"]
    assert "collision" in truth[-1]["faults"]
    assert truth[0]["commanded_tcp_error_rms_m"] < setting.TOLERANCE_M
    assert truth[-1]["commanded_tcp_error_rms_m"] < setting.TOLERANCE_M
    assert max(one["commanded_tcp_error_rms_m"] for one in truth) > 1.5e-3


@pytest.fixture(scope="module")
def again(tmp_path_factory) -> dict[str, tuple[dict[str, Any], Path]]:
    """The excerpt's replay by its node, with the folder of its history."""
    found = {}
    for node in SCHEMAS:
        state = tmp_path_factory.mktemp(node)
        found[node] = replayed(BAG, node, "--state", state), state
    return found


@pytest.mark.parametrize("node", SCHEMAS)
def test_the_excerpt_is_replayed_as_it_was_recorded(again, node):
    """Samples, codes and words; to the last bit only where the processor is that of its maker."""
    document, _ = again[node]
    assert beyond_rounding(document) == []
    assert document["commands"]
    assert document["ignored"] == {}


def test_the_excerpt_holds_two_thermal_cycles(again):
    document, _ = again["thermal_node"]
    ended = [c for c in document["commands"] if c["command"] == "end_cycle"]
    assert [c["samples"] for c in ended] == [6, 6]
    assert {c["code"] for c in ended} <= {"ACCEPT", "NO_SIGNIFICANT_GAIN"}


def test_the_excerpt_holds_the_check_that_fails_and_the_full_measurement(again):
    document, state = again["tcf_node"]
    modes = [c["message"].split(":")[0] for c in document["commands"] if c["message"][:4] == "run "]
    assert modes == ["run 1 (quick)", "run 2 (full)", "run 3 (quick)", "run 4 (quick)"]
    check, full, *verified = document["runs"]
    assert [check["answer"], *(run["answer"] for run in verified)] == [
        "recalibrate",
        "pass",
        "pass",
    ]
    assert document["final_tool"]["xyz_mm"] == full["tcp_mm"]
    with CalibrationHistory.open(BAG.stem, state_dir=state, create=False) as history:
        found = KnownTool.of_document(history.head(TOOL).model)
    with BagReader(BAG) as reader:
        truth = [json.loads(m.message.data) for m in reader.messages(["/truth/state"])][-1]
    away = found.T_flange_tool[:3, 3] - np.array(truth["T_flange_tool"])[:3, 3]
    assert away @ np.linalg.solve(found.covariance[:3, :3], away) < 16.3  # chi-square of 3, 1e-3


def test_the_excerpt_holds_every_beam_event(again):
    """Of each step of each run: a circle breaks both beams twice, a plunge each of them once."""
    document, _ = again["tcf_node"]
    steps = [c["samples"] for c in document["commands"] if c["command"] == "tool_step"]
    assert steps == [8, 8, 8, 8, 4, 4, 8, 4, 8, 4]
    assert sum(steps) == bag_info(BAG).topics["/beam_events"].messages


def test_a_customer_reads_how_accurate_the_cell_was(tmp_path):
    document = robocal_json("validate.json", "validate", BAG, "--report", tmp_path)
    assert {row["node"] for row in document["bags"]} == {
        f"/{node}/session_events" for node in SCHEMAS
    }
    (hour,) = csv.DictReader(io.StringIO((tmp_path / "hours.csv").read_text()))
    assert (hour.pop("bag"), hour.pop("topic")) == (BAG.name, "/truth/state")
    told = {name: float(value) for name, value in hour.items()}
    assert told["minutes"] == pytest.approx(10.0, abs=0.1)
    assert 0.0 < told["rms_with_mm"] < told["rms_without_mm"]
    assert 0.0 <= told["lambda_without"] < told["lambda_with"] <= 1.0
    assert told["p95_mm"] > 0.0
    assert told["bound_mm"] > 0.0
    assert 0.0 < told["time_below_bound"] < 1.0  # nobody knows of the collision before the gap
