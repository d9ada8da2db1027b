# SPDX-License-Identifier: Apache-2.0
"""The launch files, without ros2 launch: what they name is there, and nodes take it.

They are read, not run: launch and launch_ros come with a ROS installation only, and
test_launch_files.py has them there.
"""

import ast
import re
from importlib import metadata
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from trajectory_msgs.msg import JointTrajectory

ROOT = Path(__file__).parents[2]
SHARE = ROOT / "install" / "robocal_ros" / "share" / "robocal_ros"
FILES = sorted(path.name.split(".")[0] for path in (ROOT / "launch").glob("*.launch.py"))
DEFAULT = "joint_trajectory_controller/joint_trajectory"
CONTROLLER = "/robot_1/arm_controller/joint_trajectory"


def tree(name: str) -> ast.Module:
    return ast.parse((ROOT / "launch" / f"{name}.launch.py").read_text())


def words(module: ast.Module) -> set[str]:
    nodes = (n.value for n in ast.walk(module) if isinstance(n, ast.Constant))
    return {value for value in nodes if isinstance(value, str)}


@pytest.mark.parametrize("name", FILES)
def test_it_is_installed_and_names_what_exists(name):
    file = SHARE / "launch" / f"{name}.launch.py"
    assert file.read_text() == (ROOT / "launch" / file.name).read_text()
    compile(file.read_text(), str(file), "exec")
    found = words(tree(name))
    scripts = {e.name for e in metadata.distribution("robocal-ros").entry_points}
    executables = {word for word in found if re.fullmatch(r"\w+_node", word)}
    assert executables <= scripts
    assert all((SHARE.parents[1] / "lib" / "robocal_ros" / node).is_file() for node in executables)
    files = {word for word in found if re.fullmatch(r"\w+\.yaml", word)}
    files |= {f"{node}.yaml" for node in executables}
    assert files <= {path.name for path in (SHARE / "config").rglob("*.yaml")}


def test_each_of_two_robots_must_be_given_its_own_file():
    """What they had in common by default, the serial, would give them one history."""
    calls = [n for n in ast.walk(tree("two_robots")) if isinstance(n, ast.Call)]
    declared = [c for c in calls if getattr(c.func, "id", "") == "DeclareLaunchArgument"]
    of_a_robot = [c for c in declared if ast.unparse(c.args[0]) == "params"]
    assert of_a_robot
    assert not any(k.arg == "default_value" for c in of_a_robot for k in c.keywords)


def test_a_replay_has_its_own_serial_after_the_parameters_of_the_cell():
    """test_config_files.py shows what it does there."""
    (given,) = (
        n.value
        for n in ast.walk(tree("replay"))
        if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "params"
    )
    shown = ast.unparse(given)
    assert shown.index("LaunchConfiguration('params')") < shown.index("apart")
    assert "apart = in_share('config', 'replay_history.yaml')" in ast.unparse(tree("replay"))


def test_the_two_nodes_of_one_robot_have_files_of_their_own_and_are_wired():
    calls = [n for n in ast.walk(tree("thermal")) if isinstance(n, ast.Call)]

    def texts(of: str) -> list[list[str]]:
        named = [c for c in calls if getattr(c.func, "id", "") == of]
        given = [(*c.args, *(k.value for k in c.keywords)) for c in named]
        return [[a.value for a in one if isinstance(a, ast.Constant)] for one in given]

    declared = texts("params")
    assert [shown[0] for shown in texts("LaunchConfiguration")] == [name for name, _ in declared]
    started = [shown[:2] for shown in texts("Node")]  # executable and name
    assert started == [[file.removesuffix(".yaml")] * 2 for _, file in declared]
    usage = re.findall(r"(\w+):=", ast.get_docstring(tree("thermal")))
    assert usage == [name for name, _ in declared]
    pairs = [n.elts for n in ast.walk(tree("thermal")) if isinstance(n, ast.Tuple)]
    wired = {old.value: new.value for old, new in pairs}
    assert wired == {"kinematic_model": "/thermal_node/model", "tool": "/tcf_node/tool"}


def test_all_nodes_of_a_cell_are_started():
    scripts = {e.name for e in metadata.distribution("robocal-ros").entry_points}
    nodes = {name for name in scripts if name.endswith("_node")}
    # for a recording; for drivers that need one; of several cells
    nodes -= {"replay_node", "adapter_node", "sharing_node"}
    assert nodes <= words(tree("cell"))


def test_a_cell_of_one_robot_in_its_namespace(graph, tmp_path):
    """Started as the launch file does: its file, then that of the cell, names and remappings.

    That of the cell has a section for all, and one for each node.
    """
    nodes = sorted(w for w in words(tree("cell")) if w.endswith("_node"))
    mine = tmp_path / "mine.yaml"
    text = (ROOT / "config" / "cell.yaml").read_text().replace('serial: ""', "")
    own = (f"/**/{name}:\n  ros__parameters: {{serial: R7}}\n" for name in nodes)
    mine.write_text(text + "".join(own))
    said = graph.collect(DiagnosticArray, "/diagnostics")
    for name in nodes:
        trajectories = "joint_trajectory" if name == "cell_sim_node" else "~/joint_trajectory"
        graph.start(
            name,
            None,
            {
                "__node": name,
                "__ns": "/robot_1",
                trajectories: CONTROLLER.removeprefix("/robot_1/"),
                DEFAULT: CONTROLLER.removeprefix("/robot_1/"),
                "kinematic_model": "thermal_node/model",
                "tool": "tcf_node/tool",
            },
            "--ros-args", "--params-file", str(ROOT / "config" / f"{name}.yaml"),
            "--params-file", str(mine),
        )  # fmt: skip

    def active() -> set[str]:
        statuses = [s for a in said for s in a.status if s.hardware_id == "R7"]
        told = {s.name: v.value for s in statuses for v in s.values if v.key == "state"}
        return {name for name, state in told.items() if state == "active"}

    # Without a laser file, measuring poses or a hand-eye target some wait for their set-up.
    ready = {f"robot_1/{n}" for n in ("thermal_node", "joint_correction_node", "recorder_node")}
    graph.spin_until(lambda: active() >= ready, "they are active, for this robot", 30.0)

    def senders(topic: str) -> set[str]:
        return {info.node_name for info in graph.probe.get_publishers_info_by_topic(topic)}

    def takers(topic: str) -> set[str]:
        return {info.node_name for info in graph.probe.get_subscriptions_info_by_topic(topic)}

    movers = {"joint_correction_node"}
    graph.spin_until(lambda: senders(CONTROLLER) >= movers, "who moves the robot", 30.0)
    followers = {"cell_sim_node", "recorder_node"}
    graph.spin_until(lambda: takers(CONTROLLER) == followers, "robot and recorder", 30.0)
    users = {"joint_correction_node", "recorder_node"}
    graph.spin_until(lambda: takers("/robot_1/thermal_node/model") >= users, "users of the model")
    types = dict(graph.probe.get_topic_names_and_types())
    assert types[CONTROLLER] == [f"trajectory_msgs/msg/{JointTrajectory.__name__}"]
