# SPDX-License-Identifier: Apache-2.0
"""The files of whole cells give each node values that it takes."""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml

from bench.cell_samples import SPIN_RAD
from robocal_ros.bags.recorder_node import RecorderNode
from robocal_ros.cell_sim.cell import TAUGHT, poses
from robocal_ros.cell_sim.node import CellSimNode
from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.hand_eye.node import HandEyeNode
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.node import MaintenanceNode
from robocal_ros.panel.node import PanelNode
from robocal_ros.plc.node import PlcBridgeNode
from robocal_ros.ros.base import AUTOSTART, SERIAL
from robocal_ros.thermal.node import ThermalNode, session_config
from robocal_ros.tool.node import TcfNode

ROOT = Path(__file__).parents[2]
CELLS = ROOT / "config" / "cells"
SHIFT = CELLS / "kr150_shift.yaml"
SHARED = "/**"
NODES = {
    f"/**/{n.NAME}": n
    for n in (CellSimNode, ThermalNode, TcfNode, MaintenanceNode, JointCorrectionNode)
}
REAL = (ThermalNode, TcfNode, HandEyeNode, MaintenanceNode, JointCorrectionNode, RecorderNode)
COUNTS = Counter(s.name for n in REAL for s in n.SETTINGS)
OWN = {"target", "method"}  # another thing in each node
OFTEN = {name for name, count in COUNTS.items() if count > 1} - OWN

PAGE = (ROOT / "docs" / "cell_launch.md").read_text()
FILES = {path.name: path.read_text() for path in (ROOT / "config" / "cell.yaml", SHIFT)}
FILES["cell_launch.md"] = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[0]


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_what_several_nodes_need_is_given_once_and_is_the_same_for_all(text):
    sections = yaml.safe_load(text)
    shared = sections[SHARED]["ros__parameters"]
    known = {SERIAL.name} | {s.name for n in NODES.values() for s in n.SETTINGS}
    assert shared.keys() <= known
    simulated = {s.name for s in CellSimNode.SETTINGS}
    assert shared.keys() & simulated <= {"robot"}  # else it would change the true cell
    found = {}
    for node in REAL:
        own = sections.get(f"/**/{node.NAME}", {}).get("ros__parameters", {})
        assert own.keys().isdisjoint(OFTEN | shared.keys()), node.NAME
        given = {s.name: s.default for s in node.SETTINGS} | own | shared
        for name in OFTEN & {s.name for s in node.SETTINGS}:
            assert found.setdefault(name, given[name]) == given[name], (node.NAME, name)


@pytest.mark.parametrize(
    ("file", "nodes"), [("cell_launch.md", {f"/**/{n.NAME}": n for n in REAL}), (SHIFT.name, NODES)]
)
def test_each_node_takes_its_values(file, nodes):
    sections = yaml.safe_load(FILES[file])
    shared = sections.pop(SHARED)["ros__parameters"]
    assert set(sections) <= set(nodes)
    assert set(sections) == set(nodes) or file == SHIFT.name  # the page shows all
    for name, node in nodes.items():
        settings = {s.name: s for s in (AUTOSTART, SERIAL, *node.SETTINGS)}
        own = sections.get(name, {"ros__parameters": {}})["ros__parameters"]
        for parameter, value in (shared | own).items():
            if parameter not in shared or parameter in settings:
                assert settings[parameter].accept(value) == value


def test_files_of_two_robots_have_of_their_own_what_both_cannot_have():
    left, right = (
        yaml.safe_load((CELLS / f"{name}.yaml").read_text()) for name in ("left", "right")
    )
    assert left.keys() == right.keys()
    nodes = NODES | {f"/**/{n.NAME}": n for n in (PlcBridgeNode, PanelNode)}
    for section, mine in left.items():
        one, other = (found["ros__parameters"] for found in (mine, right[section]))
        known = (SERIAL,) if section == SHARED else nodes[section].SETTINGS
        settings = {s.name: s for s in known}
        assert one.keys() == other.keys()
        for name, value in one.items():
            assert settings[name].accept(value) == value
            assert value != other[name] or name == "security_dir"


def test_accuracy_is_judged_where_the_robot_works():
    sections = yaml.safe_load(FILES[SHIFT.name])
    given = {
        **sections[SHARED]["ros__parameters"],
        **sections["/**/thermal_node"]["ros__parameters"],
    }
    settings = {s.name: s.default for s in ThermalNode.SETTINGS} | given
    work = session_config(settings | {"drift_parameters": []}, load_robot(given["robot"])).work
    assert work.q == pytest.approx(poses("work"))
    assert work.tip == pytest.approx(TAUGHT[:3, 3])


def test_tool_and_poses_are_the_cells():
    sections = yaml.safe_load(FILES[SHIFT.name])
    given = sections[SHARED]["ros__parameters"]
    assert given["taught_xyz_mm"] == pytest.approx((1e3 * TAUGHT[:3, 3]).tolist())
    given = sections["/**/tcf_node"]["ros__parameters"]
    assert given["spin_deg"] == pytest.approx(SPIN_RAD * 57.29577951308232)
    given = sections["/**/maintenance_node"]["ros__parameters"]
    assert given["home_deg"] == pytest.approx(np.degrees(poses("home")[0]).tolist())
    taught = np.array(given["measuring_poses_deg"]).reshape(-1, 6)
    assert taught == pytest.approx(np.degrees(poses("cycle")))
