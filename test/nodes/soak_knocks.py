# SPDX-License-Identifier: Apache-2.0
"""What was knocked or moved, in a whole cell over DDS: a thermal cycle tells it. All is simulated.

Not of ``make test``, as it takes minutes: a part of ``make soak``, or

    tools/with_ros python -m pytest -s test/nodes/soak_knocks.py
"""

from pathlib import Path

import pytest
from domains import free_domain

from bench.closed_loop.faults import RIGHT, WELL
from bench.live.cell import set_fault
from bench.live.plc import GAP_S, Plc
from bench.live.running import live_cell
from robocal_ros.ground.errors import Code

KNOCKS = [fault for fault, code in RIGHT.items() if code is Code.SENSOR_OR_ROBOT_MOVED]


def told(plc: Plc, name: str) -> Code:
    """The thermal code of a gap that runs as planned."""
    result = plc.gap(name, GAP_S).result
    print(f"{name}: {result.message}")
    assert result.code == Code.ACCEPT, result.message
    return Code(result.thermal_code)


def test_what_was_knocked_is_told_in_the_next_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with free_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with live_cell(tmp_path, tmp_path / "recordings", print) as (controller, plc):
            plc.produce()
            codes = {}
            for fault in KNOCKS:
                assert told(plc, f"before {fault}") in WELL
                set_fault(controller.call, fault)
                codes[fault] = told(plc, fault)
                set_fault(controller.call, "none")
    assert codes == dict.fromkeys(KNOCKS, Code.SENSOR_OR_ROBOT_MOVED)
