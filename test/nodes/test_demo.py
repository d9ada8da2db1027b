"""The whole demo: three executables and a cell controller over DDS, from the bag to the page."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from robocal_ros.core.codes import Code
from robocal_ros.storage.calibrations import CalibrationHistory
from robocal_ros.storage.robots import load_robot

ROOT = Path(__file__).parent.parent.parent
LONGEST_S = 85.0


@pytest.fixture
def demo(graph, tmp_path) -> tuple[str, Path]:
    """What the demo printed, and the folder of its report."""
    out = tmp_path / "out"
    done = subprocess.run(
        [sys.executable, str(ROOT / "bags" / "demo.py"), "--out", str(out)],
        env=os.environ | {"ROS_DOMAIN_ID": str(graph.domain), "COLUMNS": "120"},
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, out


def test_the_demo_says_in_mm_what_it_brought(demo):
    printed, out = demo
    report = json.loads((out / "report.json").read_text())
    before, after, oldest = report["errors"].values()
    # a robot of this size drifts by tenths of a millimetre; at least half of it must go
    assert 0.1 < before["mean_mm"] < 0.9
    assert after["mean_mm"] < 0.5 * before["mean_mm"]
    assert after["mean_mm"] <= oldest["mean_mm"] < before["mean_mm"]
    assert after["share_within_tolerance"] > before["share_within_tolerance"]
    for found in (before, after, oldest):
        assert f"{found['mean_mm']:.3f}" in printed
    assert "simulated" in printed
    assert report["simulated"] is True

    page = (out / "report.html").read_text()
    assert "simulated" in page
    assert page.count("<svg") == 3
    rows = list(csv.DictReader((out / "errors.csv").open()))
    assert len(rows) == 15 * 34
    shown = np.array([[float(row[f"after_{axis}_mm"]) for axis in "xyz"] for row in rows])
    assert np.linalg.norm(shown, axis=1).mean() == pytest.approx(after["mean_mm"], abs=1e-3)

    nominal = load_robot("kr150_r3100")
    with CalibrationHistory.open(
        "SIM-KR150-1", model_hash=nominal.model_hash, state_dir=out / "state"
    ) as history:
        entries = history.list(100)
        assert history.head().revision == report["cycles"][-1]["revision"]
    thermal = [entry for entry in entries if entry.kind == "thermal"]
    assert len(thermal) == 15
    by_cycle = {entry.cycle_id: entry for entry in thermal}
    for cycle in report["cycles"]:
        entry = by_cycle[cycle["cycle"]]
        assert entry.code.name == cycle["verdict"]["code"]
        assert (entry.revision > 0) == (entry.code is Code.ACCEPT)
