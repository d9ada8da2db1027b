# SPDX-License-Identifier: Apache-2.0
"""The launch files, loaded and visited by launch itself: what starts, its names, its parameters.

launch and launch_ros come with a ROS installation only; without them test_cell_launch.py reads the
files. Names of foreign nodes are held to the table of docs/drivers.md, which has their sources.
"""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytest
import yaml
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters
from test_config_files import NODES, settings
from test_shared_gap import ASKS, ROBOTS

pytest.importorskip("launch_ros", reason="launch_ros comes with a ROS installation only")

from launch.actions import DeclareLaunchArgument
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.utilities import perform_substitutions
from launch_ros.actions import Node

from bench.closed_loop import setting
from launch import LaunchContext, LaunchDescription, LaunchService
from robocal_ros.cell_sim.cell import SimulatedCell, kr150_cell
from robocal_ros.cell_sim.node import CellSimNode
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.laser_frame import read_laser_for

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
SETTINGS = {node.NAME: {s.name: s for s in settings(node)} for node in NODES}
ASKED_FOR = {"plc_bridge_node", "panel_node", "fixture_node", "cell_sim_node"}
OTHERS = {"replay_node", "adapter_node", "sharing_node"} | ASKED_FOR
CELL = {n.NAME for n in NODES} - OTHERS
DRIVERS = (ROOT / "docs" / "drivers.md").read_text()
FACTS = set(re.findall(r"^\| `([\w/]+)` \|", DRIVERS, re.MULTILINE))
TAUGHT = ("joint_states", "/joint_correction_node/joint_states")
KEPT: list[LaunchDescription] = []  # launch deletes the files of a description that is dropped


@dataclass(frozen=True)
class Started:
    """A node as launch starts it."""

    executable: str
    command: list[str]

    def given(self, option: str) -> list[str]:
        pairs = zip(self.command, self.command[1:], strict=False)
        return [value for name, value in pairs if name == option]

    @property
    def rules(self) -> dict[str, str]:
        return dict(rule.split(":=") for rule in self.given("-r"))

    @property
    def remaps(self) -> dict[str, str]:
        return {old: new for old, new in self.rules.items() if not old.startswith("__")}

    @property
    def parameters(self) -> dict[str, Any]:
        """Those of the files, the last one wins; of the sections that rcl matches for the node."""
        found: dict[str, Any] = {}
        for file in self.given("--params-file"):
            for section, content in yaml.full_load(Path(file).read_text()).items():
                if fnmatchcase(f"/{self.executable}", section.replace("/**", "*")):
                    found |= content["ros__parameters"]
        # of a list in the launch file launch writes a tuple
        return {name: list(v) if isinstance(v, tuple) else v for name, v in found.items()}


def visit(entities: Any, context: LaunchContext) -> Iterator[Started]:
    for entity in entities:
        if not isinstance(entity, Node):
            yield from visit(entity.visit(context) or [], context)
        elif entity.condition is None or entity.condition.evaluate(context):
            entity._perform_substitutions(context)
            name = str(entity.node_name).rpartition("/")[2]
            space = entity.expanded_node_namespace
            words = {"name": f"__node:={name}", "ns": f"__ns:={space}"}
            context.extend_locals({"ros_specific_arguments": words})
            command = [perform_substitutions(context, part) for part in entity.cmd]
            yield Started(Path(command[0]).name, command[1:])


def described(name: str, **given: str) -> tuple[LaunchDescription, LaunchContext]:
    context = LaunchContext(argv=[])
    context.launch_configurations.update(given)
    source = PythonLaunchDescriptionSource(str(ROOT / "launch" / f"{name}.launch.py"))
    description = source.get_launch_description(context)
    KEPT.append(description)
    return description, context


def started(name: str, **given: str) -> dict[str, Started]:
    description, context = described(name, **given)
    return {node.executable: node for node in visit(description.entities, context)}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name.split(".")[0])
def test_arguments_have_descriptions_and_those_of_its_text_exist(file):
    description, _ = described(file.name.split(".")[0])
    own = [e for e in description.entities if isinstance(e, DeclareLaunchArgument)]
    assert all(argument.description != "no description given" for argument in own)
    text = file.read_text().split('"""')[1]
    ours = re.findall(rf"ros2 launch robocal_ros {file.name}((?:.|\\\n)*)", text)
    foreign = {"ur_type"}
    names = {argument.name for argument in own} | foreign
    if "cell.launch.py" in file.read_text():
        cell = described("cell")[0].entities
        names |= {e.name for e in cell if isinstance(e, DeclareLaunchArgument)}
    assert {name for shown in ours for name in re.findall(r"(\w+):=", shown)} <= names


def test_the_page_of_a_cell_shows_every_argument():
    description, _ = described("cell")
    own = {e.name for e in description.entities if isinstance(e, DeclareLaunchArgument)}
    (_, page) = (ROOT / "docs" / "cell_launch.md").read_text().split("| argument | default")
    assert set(re.findall(r"^\| `(\w+)` \|", page.split("\n\n")[0], re.MULTILINE)) == own


@pytest.mark.parametrize(
    ("file", "given", "nodes"),
    [
        ("cell", {}, CELL),
        ("cell", {"simulated": "true", "use_sim_time": "true"}, CELL | {"cell_sim_node"}),
        ("ur", {"beams": "true"}, CELL | {"adapter_node"}),
        ("ur", {}, CELL),
        ("thermal", {}, {"thermal_node", "joint_correction_node"}),
        ("replay", {"bag": "x"}, {"thermal_node", "tcf_node", "replay_node"}),
        ("demo", {}, {"demo"}),
    ],
)
def test_nodes_take_the_parameters_that_it_gives(file, given, nodes):
    found = started(file, **given)
    assert set(found) == nodes
    shared = {name for table in SETTINGS.values() for name in table}
    for name, node in found.items():
        for parameter, value in node.parameters.items():
            if parameter == "use_sim_time":
                assert value is (file == "replay" or given.get(parameter) == "true")
            elif parameter != "qos_overrides" and parameter in SETTINGS[name]:
                assert SETTINGS[name][parameter].accept(value) == value
            else:  # below /**, for others
                assert parameter == "qos_overrides" or parameter in shared


def of_two(**given: str) -> dict[str, Started]:
    """What two_robots.launch.py starts, by namespace and name."""
    mine = {f"{robot}_params": str(ROOT / "config/cells" / f"{robot}.yaml") for robot in ROBOTS}
    description, context = described("two_robots", **mine, **given)
    nodes = visit(description.entities, context)
    spaces = ((node.rules.get("__ns", ""), node) for node in nodes)
    return {f"{space.strip('/')}/{node.executable}": node for space, node in spaces}


def test_two_robots_have_serials_and_ports_of_their_own_and_ask_for_the_one_gap():
    found = of_two(simulated="true", plc="true", panel="true", shared="true")
    names = CELL | {"cell_sim_node", "plc_bridge_node", "panel_node"}
    of_each = {f"{robot}/{name}" for robot in ROBOTS for name in names}
    assert set(found) == of_each | {"/sharing_node"}
    own = {"plc_bridge_node": "port", "panel_node": "page_port", "thermal_node": "serial"}
    for executable, parameter in own.items():
        one, other = (found[f"{robot}/{executable}"].parameters for robot in ROBOTS)
        assert {name for name in one if one[name] != other[name]} == {parameter, "serial"}
    assert list(found["/sharing_node"].parameters["robots"]) == list(ROBOTS)
    for name, node in found.items():
        is_bridge = name.endswith("/plc_bridge_node")
        assert {k: v for k, v in node.remaps.items() if k in ASKS} == (ASKS if is_bridge else {})


def test_a_gap_that_is_not_shared_goes_straight_to_the_robot():
    for bridge in (
        started("cell", plc="true")["plc_bridge_node"],
        of_two(plc="true")["left/plc_bridge_node"],
    ):
        assert bridge.remaps["gap_open"] == "gap_open"
    shared = started("cell", plc="true", shared="true")["plc_bridge_node"].remaps
    assert shared["gap_open"] == ASKS["gap_open"]


@pytest.mark.parametrize("controller", ["", "joint_trajectory_controller"])
def test_a_universal_robot_is_met_by_the_names_of_its_driver(controller):
    given = {"ur_controller": controller} if controller else {}
    found = started("ur", beams="true", **given)
    name = f"/{controller or 'scaled_joint_trajectory_controller'}"
    for mover in ("joint_correction_node", "tcf_node", "maintenance_node"):
        node = found[mover]
        assert node.remaps["~/joint_trajectory"] == f"{name}/joint_trajectory"
        assert node.remaps["controller_state"] == f"{name}/controller_state"
        assert node.parameters["follow_joint_trajectory"] == f"{name}/follow_joint_trajectory"
    foreign = {
        target
        for node in found.values()
        for target in node.remaps.values()
        if target.startswith("/") and not target.startswith("/joint_trajectory_controller/")
    }
    assert foreign <= FACTS
    adapter = found["adapter_node"]
    assert (adapter.parameters["input"], adapter.parameters["sources"]) == ("ur_io", ["0", "1"])
    assert adapter.remaps["io_states"] in foreign


def test_names_of_the_default_controller_are_facts():
    remaps = started("cell")["joint_correction_node"].remaps
    assert {remaps["~/joint_trajectory"], remaps["controller_state"]} <= FACTS
    assert TAUGHT[0] in FACTS


def test_the_adapter_has_the_inputs_as_texts(graph):
    """As launch writes them; without ur_msgs it stays unconfigured, and says its parameters."""
    graph.start("adapter_node", None, None, *started("ur", beams="true")["adapter_node"].command)
    asked = graph.call(GetParameters, "/adapter_node/get_parameters", names=["sources"])
    assert list(asked.values[0].string_array_value) == ["0", "1"]


def test_inputs_of_the_adapter_may_be_given_in_the_file_of_the_cell(tmp_path):
    mine = tmp_path / "mine.yaml"
    (shown,) = re.findall(r"```yaml\n(.*?)```", DRIVERS.replace("\n  ", "\n"), re.DOTALL)
    mine.write_text(shown)
    given = started("ur", beams="true", params=str(mine))["adapter_node"].parameters
    assert (given["input"], given["sources"], given["period_ms"]) == ("ur_io", ["8", "9"], 8.0)


def test_log_level_and_respawn_reach_every_node():
    description, context = described("cell", log_level="debug", use_respawn="true")
    nodes = list(visit(description.entities, context))
    assert all(node.given("--log-level") == ["debug"] for node in nodes)
    actions = [entity for entity in description.entities if isinstance(entity, Node)]
    assert len(actions) == len(CELL | ASKED_FOR)
    assert all(
        perform_substitutions(context, action._ExecuteLocal__respawn) == "true"
        for action in actions
    )


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Makes a package whose launch folder has a file of this text; nodes write how they began."""

    def made(name: str, file: str, text: str) -> Path:
        prefix, log = tmp_path / "prefix", tmp_path / "commands"
        (prefix / "share" / name / "launch").mkdir(parents=True)
        index = prefix / "share" / "ament_index" / "resource_index" / "packages"
        index.mkdir(parents=True)
        (index / name).touch()
        script = tmp_path / "node"
        script.write_text(f"#!/bin/sh\necho $@ >> {log}\n")
        script.chmod(0o755)
        (prefix / "share" / name / "launch" / file).write_text(
            "from launch import LaunchDescription\n"
            "from launch.actions import RegisterEventHandler\n"
            "from launch.event_handlers import OnProcessExit\n"
            "from launch_ros.actions import Node\n"
            f"def node(name): return Node(executable={str(script)!r}, name=name)\n"
            f"def generate_launch_description():\n    {text}\n"
        )
        path = f"{prefix}:{os.environ['AMENT_PREFIX_PATH']}"
        monkeypatch.setenv("AMENT_PREFIX_PATH", path)
        return log

    return made


def ran(description: LaunchDescription, context: LaunchContext, log: Path) -> dict[str, str]:
    """What launch has started, when all has ended: by node its arguments."""
    service = LaunchService()
    service.context.launch_configurations.update(context.launch_configurations)
    service.include_launch_description(description)
    assert service.run() == 0
    lines = log.read_text().splitlines()
    return {re.search(r"__node:=(\w+)", line)[1]: line for line in lines}


def test_nodes_that_a_planner_starts_on_an_event_see_the_taught_robot_too(package):
    """As ur_moveit.launch.py starts move_group, when the description has come."""
    log = package(
        "my_moveit_config",
        "moveit.launch.py",
        "first = node('first'); late = OnProcessExit(target_action=first, on_exit=[node('late')])\n"
        "    return LaunchDescription([first, RegisterEventHandler(late)])",
    )
    given = {"package": "my_moveit_config", "file": "moveit.launch.py"}
    found = ran(*described("taught", **given), log)
    assert set(found) == {"first", "late"}
    assert all(":=".join(TAUGHT) in line for line in found.values())


def test_the_driver_of_a_universal_robot_keeps_its_joint_states(package):
    log = package(
        "ur_robot_driver",
        "ur_rsp.launch.py",
        "return LaunchDescription([node('robot_state_publisher')])",
    )
    description, context = described("ur_description")
    command = str(log.parent / "node")
    after = Node(executable=command, name="ros2_control_node")
    found = ran(LaunchDescription([*description.entities, after]), context, log)
    assert ":=".join(TAUGHT) in found["robot_state_publisher"]
    assert "joint_states" not in found["ros2_control_node"]


def test_the_beams_of_the_simulated_cell_are_those_that_it_has():
    seed = {s.name: s.default for s in CellSimNode.SETTINGS}["seed"]
    nominal = load_robot("kr150_r3100")
    placed = read_laser_for(ROOT / "config" / "cells" / "kr150_laser.yaml", nominal)
    laser = setting.laser_of(SimulatedCell(kr150_cell(nominal, seed)).plan)
    assert placed.laser.points == pytest.approx(laser.points, abs=1e-12)  # the file has 1e-15 m
    assert placed.serial == setting.SERIAL


@pytest.mark.cell
def test_the_simulated_cell_starts_whole(graph):
    """Each node by the command line that launch has made, until all of them are active."""
    found = started("cell", simulated="true")
    for name, node in found.items():
        graph.start(name, None, None, *node.command)

    def active(name: str) -> bool:
        told = graph.call(GetState, f"/{name}/get_state", 60.0)
        return told.current_state.label == "active"

    for name in found:
        graph.spin_until(lambda name=name: active(name), f"{name} is active", 60.0)
