"""The files of whole cells give each node values that it takes."""

from pathlib import Path

import pytest
import yaml

from robocal_ros.nodes.base import AUTOSTART, SERIAL
from robocal_ros.nodes.cell_sim_node import CellSimNode
from robocal_ros.nodes.joint_correction_node import JointCorrectionNode
from robocal_ros.nodes.tcf_node import TcfNode
from robocal_ros.nodes.thermal_node import ThermalNode
from robocal_ros.nodes.thermal_settings import session_config
from robocal_ros.sim.kr150_cell import SPIN_RAD, TAUGHT, poses
from robocal_ros.storage.robots import load_robot

CELLS = sorted((Path(__file__).parents[2] / "config" / "cells").glob("*.yaml"))
NODES = {f"/**/{n.NAME}": n for n in (CellSimNode, ThermalNode, TcfNode, JointCorrectionNode)}


def test_there_is_one():
    assert [path.stem for path in CELLS] == ["kr150_shift"]


@pytest.mark.parametrize("path", CELLS, ids=lambda path: path.stem)
def test_each_node_takes_its_values(path):
    for name, given in yaml.safe_load(path.read_text()).items():
        settings = {s.name: s for s in (AUTOSTART, SERIAL, *NODES[name].SETTINGS)}
        for parameter, value in given["ros__parameters"].items():
            assert settings[parameter].accept(value) == value


def test_accuracy_is_judged_where_the_robot_works():
    given = yaml.safe_load(CELLS[0].read_text())["/**/thermal_node"]["ros__parameters"]
    settings = {s.name: s.default for s in ThermalNode.SETTINGS} | given
    work = session_config(settings | {"drift_parameters": []}, load_robot(given["robot"])).work
    assert work.q == pytest.approx(poses("work"))
    assert work.tip == pytest.approx(TAUGHT[:3, 3])


def test_the_tool_is_the_cells():
    given = yaml.safe_load(CELLS[0].read_text())["/**/tcf_node"]["ros__parameters"]
    assert given["taught_xyz_mm"] == pytest.approx((1e3 * TAUGHT[:3, 3]).tolist())
    assert given["spin_deg"] == pytest.approx(SPIN_RAD * 57.29577951308232)
