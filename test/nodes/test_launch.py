# SPDX-License-Identifier: Apache-2.0
"""The launch file, without ros2 launch: what it names is there, and the nodes take what it gives.

It is read, not run: launch and launch_ros come with a ROS installation only.
"""

import ast
import re
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray

ROOT = Path(__file__).parents[2]
SHARE = ROOT / "install" / "robocal_ros" / "share" / "robocal_ros"
FILE = SHARE / "launch" / "thermal.launch.py"
MODEL = "/thermal_node/model"
NODES = ("thermal_node", "joint_correction_node")


@pytest.fixture(scope="module")
def text() -> str:
    return FILE.read_text()


def calls(text: str, name: str) -> list[ast.Call]:
    nodes = ast.walk(ast.parse(text))
    found = [n for n in nodes if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    return [call for call in found if call.func.id == name]


def texts(call: ast.Call) -> dict[str, Any]:
    pairs = {k.arg: k.value for k in call.keywords}
    return {name: v.value for name, v in pairs.items() if isinstance(v, ast.Constant)}


def test_it_is_installed_and_is_python(text):
    compile(text, str(FILE), "exec")
    assert text == (ROOT / "launch" / FILE.name).read_text()
    assert "def generate_launch_description()" in text


def test_it_starts_executables_that_exist_by_their_own_names(text):
    started = [texts(call) for call in calls(text, "Node")]
    assert [node["executable"] for node in started] == list(NODES)
    assert all(node["name"] == node["executable"] for node in started)
    scripts = {e.name for e in metadata.distribution("robocal-ros").entry_points}
    assert scripts >= set(NODES)
    assert all((SHARE.parents[1] / "lib" / "robocal_ros" / name).is_file() for name in NODES)


def test_each_node_has_its_own_file_by_default(text):
    declared = {c.args[0].value: c.args[1].value for c in calls(text, "params")}
    assert list(declared.values()) == [f"{name}.yaml" for name in NODES]
    assert all((SHARE / "config" / name).is_file() for name in declared.values())
    given = [call.args[0].value for call in calls(text, "LaunchConfiguration")]
    assert given == list(declared)
    assert set(re.findall(r"(\w+):=", text)) == set(declared)


def test_the_correction_takes_model_and_tool_where_they_are_published(text):
    tuples = [n.elts for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Tuple)]
    pairs = [tuple(e.value for e in elements) for elements in tuples]
    assert pairs == [("kinematic_model", MODEL), ("tool", "/tcf_node/tool")]


@pytest.mark.parametrize("name", NODES)
def test_one_file_may_hold_both_nodes(graph, tmp_path, name):
    """Started with the arguments that ros2 launch gives: its file, its name, its remapping."""
    mine = tmp_path / "mine.yaml"
    section = "/**/{}:\n  ros__parameters: {{robot: ur10, serial: R7}}\n"
    mine.write_text("".join(section.format(node) for node in NODES))
    said = graph.collect(DiagnosticArray, "/diagnostics")
    graph.start(
        name, None, {"__node": name, "kinematic_model": MODEL}, "--ros-args", "--params-file",
        str(mine),
    )  # fmt: skip

    def told() -> list[tuple[str, str]]:
        states = [s for a in said for s in a.status if s.name == name]
        return [(s.hardware_id, v.value) for s in states for v in s.values if v.key == "state"]

    graph.spin_until(lambda: ("R7", "active") in told(), "it is active, for this robot")
    infos = graph.probe.get_subscriptions_info_by_topic(MODEL)
    assert [info.node_name for info in infos] == ([name] if name == NODES[1] else [])
