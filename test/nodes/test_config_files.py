# SPDX-License-Identifier: Apache-2.0
"""The parameter files show every parameter with its default, and a node starts with them."""

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from histories import BY
from history_workers import proposal
from lifecycle_msgs.srv import GetState
from rclpy.context import Context
from rclpy.qos import ReliabilityPolicy
from tool_cell_live import written_laser
from tool_driver import noisy_cell

from robocal_ros.adapter.node import AdapterNode
from robocal_ros.bags.recorder_node import RecorderNode
from robocal_ros.bags.replay_node import ReplayNode
from robocal_ros.cell_sim.node import CellSimNode
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.fixture.node import FixtureNode
from robocal_ros.hand_eye.node import HandEyeNode
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.node import MaintenanceNode
from robocal_ros.maintenance.sharing_node import SharingNode
from robocal_ros.motion.driver import MOTION
from robocal_ros.panel.node import PanelNode
from robocal_ros.plc.node import PlcBridgeNode
from robocal_ros.ros.base import AUTOSTART, SERIAL
from robocal_ros.ros.parameters import SHARED, Setting
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.node import INPUTS, ThermalNode
from robocal_ros.tool.judging import ToolLimits
from robocal_ros.tool.node import INPUTS as TCF_INPUTS
from robocal_ros.tool.node import TcfNode

CONFIG = Path(__file__).parents[2] / "config"
NODES = (
    ThermalNode,
    TcfNode,
    HandEyeNode,
    ReplayNode,
    RecorderNode,
    CellSimNode,
    MaintenanceNode,
    JointCorrectionNode,
    AdapterNode,
    PlcBridgeNode,
    PanelNode,
    FixtureNode,
    SharingNode,
)
PAGES = {
    ThermalNode: "thermal_node",
    TcfNode: "tcf_node",
    HandEyeNode: "hand_eye_node",
    MaintenanceNode: "maintenance_node",
    JointCorrectionNode: "joint_correction",
    RecorderNode: "bags",
    FixtureNode: "fixture",
}


def shipped(node: type) -> dict[str, Any]:
    """A node's parameters as its file has them."""
    content = yaml.safe_load((CONFIG / f"{node.NAME}.yaml").read_text())
    return content[f"/**/{node.NAME}"]["ros__parameters"]


def settings(node: Any) -> tuple[Setting, ...]:
    return (AUTOSTART, SERIAL, *node.SETTINGS)


@pytest.mark.parametrize("node", NODES, ids=lambda node: node.NAME)
def test_the_file_shows_every_parameter_with_its_default(node):
    assert shipped(node) == {s.name: s.default for s in settings(node) if not s.advanced}


@pytest.mark.parametrize("file", [*CONFIG.glob("*.yaml"), *CONFIG.glob("cells/kr150_shift.yaml")])
def test_ros_reads_the_file_as_we_do(file):
    """Its parser has YAML 1.1: a bare ``y`` is true there, and text for PyYAML."""
    context = Context()
    rclpy.init(args=["--ros-args", "--params-file", str(file)], context=context)
    context.try_shutdown()


def test_the_aggregator_has_each_node_once():
    """A GenericAnalyzer takes the items whose names contain one of its words."""
    file = yaml.safe_load((CONFIG / "diagnostics_aggregator.yaml").read_text())
    analyzers = file["analyzers"]["ros__parameters"]
    assert analyzers.pop("path") == "robocal"
    for node in NODES:
        taking = [
            name
            for name, analyzer in analyzers.items()
            if any(word in f"robot_1/{node.NAME}" for word in analyzer["contains"])
        ]
        assert len(taking) == 1, (node.NAME, taking)


@pytest.mark.parametrize("node", PAGES, ids=lambda node: node.NAME)
def test_the_page_shows_every_advanced_parameter(node):
    rows = [
        f"| `{s.name}` | {s.default} {s.unit}".rstrip() + f" | {s.description} |\n"
        for s in settings(node)
        if s.advanced
    ]
    table = "| parameter | default | meaning |\n| --- | --- | --- |\n" + "".join(rows)
    page = (CONFIG.parent / "docs" / f"{PAGES[node]}.md").read_text()
    assert page.endswith(table), f"\n{table}"
    file = (CONFIG / f"{node.NAME}.yaml").read_text()
    assert f'docs/{PAGES[node]}.md, "Advanced parameters"' in file


def test_only_nodes_with_a_page_have_advanced_parameters():
    assert {node for node in NODES if any(s.advanced for s in settings(node))} == set(PAGES)


def test_what_several_nodes_have_may_be_given_to_all():
    tables = [{s.name for s in settings(node)} for node in NODES]
    counts = Counter(name for table in tables for name in table)
    assert {name for name, count in counts.items() if count > 1} == SHARED
    shared = yaml.safe_load((CONFIG / "cell.yaml").read_text())["/**"]["ros__parameters"]
    assert shared.keys() <= SHARED


def test_each_node_takes_over_what_another_one_gives_as_all_is_set():
    """A tool that may be accepted is corrected with; a cycle that is resumed is still open."""
    tcf, correction, maintenance = (
        {s.name: s.default for s in settings(node)}
        for node in (TcfNode, JointCorrectionNode, MaintenanceNode)
    )
    assert tcf["change_limit_mm"] <= correction["tool_tcp_mm"]
    assert tcf["tilt_limit_deg"] <= correction["tool_tcp_deg"] <= correction["tool_joint_deg"]
    assert maintenance["accept_tool_mm"] <= tcf["change_limit_mm"]
    assert maintenance["accept_tool_deg"] <= tcf["tilt_limit_deg"]
    assert maintenance["accept_thermal_mm"] <= correction["thermal_tcp_mm"]
    assert maintenance["resume_within_s"] + 60.0 <= ThermalConfig().cycle_timeout_s
    assert maintenance["cycle_within_s"] < ThermalConfig().cycle_span_s
    assert maintenance["correction_silent_s"] > 0.0  # cell.launch.py and the demo have one


def test_what_is_judged_without_a_file_is_judged_as_with_it():
    tcf, correction = map(shipped, (TcfNode, JointCorrectionNode))
    limits, tool = ToolLimits(), CorrectionConfig().tool
    assert 1e3 * limits.change_m == pytest.approx(tcf["change_limit_mm"])
    assert np.degrees(limits.tilt_rad) == pytest.approx(tcf["tilt_limit_deg"])
    assert 1e3 * tool.tcp_m == pytest.approx(correction["tool_tcp_mm"])
    assert np.degrees(tool.tcp_rad) == pytest.approx(correction["tool_tcp_deg"])
    defaults = {s.name: s.default for s in ThermalNode.SETTINGS}
    for name in ("cycle_timeout_s", "cycle_span_s"):
        assert defaults[name] == getattr(ThermalConfig(), name)


def test_the_page_of_motions_names_them_as_the_parameters_do():
    (_, page) = (CONFIG.parent / "docs" / "tool.md").read_text().split("## Motions that measure")
    known = {s.name for s in TcfNode.SETTINGS}
    assert {s.name for s in MOTION} <= set(re.findall(r"\w+", page))
    assert set(re.findall(r"`(\w+_(?:mm|deg|m|s|s2|acceleration|deceleration))`", page)) <= known


def test_a_node_takes_the_file(graph, tmp_path):
    content = (CONFIG / "thermal_node.yaml").read_text()
    file = tmp_path / "mine.yaml"
    file.write_text(content.replace('serial: ""', "serial: R7").replace('robot: ""', "robot: ur10"))
    process = graph.start("thermal_node", None, None, "--ros-args", "--params-file", str(file))
    state = graph.call(GetState, "/thermal_node/get_state")
    assert state.current_state.label == "active", process.output
    graph.spin_until((graph.state / "R7.sqlite").exists, "the history of this serial")
    for became in ("configured", "active"):
        words = f"{became}: robot UR10 of ur10, serial R7, nothing measured is in force"
        assert process.output.count(words) == 1


def test_the_log_says_what_is_in_force(graph):
    """At the start, of all kinds that the robot's history has."""
    arm = load_robot("ur10")
    made = proposal(model_hash=arm.model_hash, model=model_document(arm))
    with CalibrationHistory.open("R7", model_hash=arm.model_hash, state_dir=graph.state) as history:
        history.accept(history.propose(made), **BY)
    process = graph.start("thermal_node", {"robot": "ur10", "serial": "R7"})
    words = "active: robot UR10 of ur10, serial R7, thermal revision 1 in force"
    graph.spin_until(lambda: words in process.output, words)


@pytest.mark.parametrize("node", [ThermalNode, TcfNode], ids=lambda node: node.NAME)
def test_with_the_file_for_replays_no_input_loses_anything(graph, tmp_path, node):
    path = CONFIG / "replay.yaml"
    given = yaml.safe_load(path.read_text())[f"/**/{node.NAME}"]["ros__parameters"]
    inputs = {f"/{name}" for name in (INPUTS if node is ThermalNode else TCF_INPUTS)}
    assert set(given.pop("qos_overrides")) == inputs
    assert given.pop("use_sim_time")
    assert set(given) <= {s.name for s in node.SETTINGS}
    settings = {"laser": written_laser(tmp_path, noisy_cell())} if node is TcfNode else None
    graph.add(node, settings, cli_args=["--ros-args", "--params-file", str(path)])

    def reliability(topic: str) -> list[ReliabilityPolicy]:
        infos = graph.probe.get_subscriptions_info_by_topic(topic)
        return [info.qos_profile.reliability for info in infos]

    graph.spin_until(
        lambda: all(reliability(t) == [ReliabilityPolicy.RELIABLE] for t in inputs),
        "all inputs are reliable",
        30.0,
    )
    graph.spin_until(lambda: reliability("/clock"), "it follows the clock")


@pytest.mark.parametrize(
    ("node", "sections"),
    [
        *((ThermalNode, sections) for sections in ("/**", "/** /**/{}", "/** /{}", "/{} /**")),
        (TcfNode, "/** /{}"),
    ],
)
def test_a_replay_never_opens_the_history_of_the_robot(graph, tmp_path, node, sections):
    """Files in the order of replay.launch.py; sections of the cell's own as one may write them."""
    given = {"serial": "R7", "robot": "ur10"}
    if node is TcfNode:
        given |= {"laser": written_laser(tmp_path, noisy_cell())}
    names = [section.format(node.NAME) for section in sections.split()]
    mine = tmp_path / "mine.yaml"
    mine.write_text(
        yaml.safe_dump({name: {"ros__parameters": dict(given)} for name in names}, sort_keys=False)
    )
    parts = [
        CONFIG / f"{node.NAME}.yaml",
        CONFIG / "replay.yaml",
        mine,
        CONFIG / "replay_history.yaml",
    ]
    words = [word for part in parts for word in ("--params-file", str(part))]
    graph.add(node, cli_args=["--ros-args", *words])
    assert {path.stem for path in graph.state.glob("*.sqlite")} == {"REPLAY"}
