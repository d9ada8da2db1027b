# SPDX-License-Identifier: Apache-2.0
"""The golden thermal bag through the live node: the replay's result, bit for bit."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command import robocal
from forked import HANGS_S
from history_content import content

from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory

ROOT = Path(__file__).parents[2]
CYCLES = 12


@pytest.fixture
def played(graph, tmp_path) -> Path:
    """Folder of a run: the node's history, and the recording with its session's events."""
    out = tmp_path / "out"
    done = subprocess.run(
        [sys.executable, str(ROOT / "bags" / "play_thermal_shift.py"), "--out", str(out)],
        env=os.environ | {"ROS_DOMAIN_ID": str(graph.domain)},
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "so the sensor did" in done.stdout.splitlines()[-2]  # the accuracy
    return out


def test_live_equals_replay_bit_for_bit(played, tmp_path):
    state = tmp_path / "again"
    done = robocal("replay", played / "recorded.mcap", "--state", state, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert (document["recorded"], document["differs"]) == (True, [])
    codes = [c["verdict"]["code"] for c in document["candidates"]]
    assert len(codes) == CYCLES
    assert codes[-3:] == [Code.SENSOR_OR_ROBOT_MOVED.name] * 3
    assert codes[0] == Code.ACCEPT.name
    with (
        CalibrationHistory.open("SIM-KR150-2", state_dir=played / "state", create=False) as live,
        CalibrationHistory.open("recorded", state_dir=tmp_path / "again", create=False) as again,
    ):
        assert content(live) == content(again)
        assert live.head().revision == again.head().revision > 0
