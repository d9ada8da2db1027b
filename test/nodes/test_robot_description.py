# SPDX-License-Identifier: Apache-2.0
"""The robot of the description on the graph, over DDS: waited for, taken, compared with a file."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.srv import ChangeState
from long_form import more
from rclpy.node import Node
from robocal_msgs.msg import AccuracyState, CorrectionStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from tool_cell_live import written_laser
from tool_driver import noisy_cell

from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.hand_eye.node import HandEyeNode
from robocal_ros.kinematics.robots import RobotDescription, find_robot, load_description
from robocal_ros.kinematics.urdf import arm_of, chain, read_urdf, urdf_of
from robocal_ros.maintenance.node import MaintenanceNode
from robocal_ros.ros import endpoints
from robocal_ros.thermal.node import ThermalNode
from robocal_ros.tool.node import TcfNode

UR10 = load_description("ur10")
TEXT = urdf_of(UR10.arm, UR10.max_velocity)
# The same arm by parameters of its own: where axes are parallel there is more than one choice.
TAKEN = arm_of(chain(read_urdf(TEXT, "")))
HOME_DEG = [0.0, -100.0, 110.0, 0.0, 70.0, 0.0]
STANDS = np.radians([10.0, -80.0, 100.0, -110.0, -90.0, 20.0])
ON_WITHOUT_A_MODEL = "on, but there is no model and no tool yet: nothing is corrected"
WAITS = "waits for the robot: nobody publishes /robot_description"
NODES = {
    "thermal_node": (ThermalNode, {}),
    "tcf_node": (TcfNode, {}),
    "hand_eye_node": (HandEyeNode, {}),
    "joint_correction_node": (JointCorrectionNode, {}),
    "maintenance_node": (MaintenanceNode, {"home_deg": HOME_DEG}),
}
SOME_NODES = ["joint_correction_node", "thermal_node", *more(*list(NODES)[1:3], "maintenance_node")]


def edited(edit: Callable[[ElementTree.Element], object], text: str = TEXT) -> str:
    top = ElementTree.fromstring(text)
    edit(top)
    return ElementTree.tostring(top, encoding="unicode")


def laser_of(folder: Path, robot: RobotDescription) -> str:
    """A station that was placed with this robot."""
    path = Path(written_laser(folder, noisy_cell()))
    text = path.read_text()
    assert UR10.arm.model_hash in text
    path.write_text(text.replace(UR10.arm.model_hash, robot.arm.model_hash))
    return str(path)


def longer(name: str, by_m: float) -> str:
    """The same robot with the origin of a joint further along the link before it."""

    def edit(top: ElementTree.Element) -> None:
        origin = top.find(f"joint[@name='{name}']/origin")
        assert origin is not None
        x, y, z = map(float, origin.get("xyz", "").split())
        origin.set("xyz", f"{x + math.copysign(by_m, x)!r} {y!r} {z!r}")

    return edited(edit)


class Described:
    """The graph with who publishes the description, as robot_state_publisher does."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.said: list[Any] = graph.collect(DiagnosticArray, "/diagnostics")
        self.statuses: list[Any] = graph.collect(
            CorrectionStatus, "/joint_correction_node/status", endpoints.LATCHED
        )
        self._publisher: Any = None

    def describe(self, text: str) -> None:
        if self._publisher is None:
            profile = endpoints.own(endpoints.LATCHED)
            self._publisher = self.graph.probe.create_publisher(
                String, "robot_description", profile
            )
        self._publisher.publish(String(data=text))

    def status(self, node: str) -> Any:
        told = [s for array in self.said for s in array.status if s.name == node]
        if not told:
            return SimpleNamespace(level=None, message="", state="")
        last = told[-1]
        state = {v.key: v.value for v in last.values}["state"]
        state = "active" if node == "maintenance_node" and state != "unconfigured" else state
        return SimpleNamespace(level=last.level, message=last.message, state=state)

    def becomes(self, node: str, state: str, words: str = "", level: Any = None) -> None:
        def so() -> bool:
            told = self.status(node)
            return told.state == state and words in told.message and level in (None, told.level)

        self.graph.spin_until(so, f"{node} {state} '{words}', not {self.status(node)}")


@pytest.fixture
def described(graph: Any) -> Described:
    return Described(graph)


@pytest.mark.parametrize("name", SOME_NODES)
def test_a_node_alone_waits_for_the_robot_and_goes_on_by_itself(
    graph: Any, described: Described, tmp_path: Path, name: str
) -> None:
    """Each executable as `ros2 run` starts it: no robot named, no description there yet."""
    more = {key: str(value) for key, value in NODES[name][1].items()}
    more |= {"laser": laser_of(tmp_path, TAKEN)} if name == "tcf_node" else {}
    process = graph.start(name, {"robot": "''"} | more)
    described.becomes(name, "unconfigured", WAITS, DiagnosticStatus.WARN)
    lines = [line for line in process.output.splitlines() if "waits for the robot" in line]
    assert len(lines) == 1
    assert "[INFO]" in lines[0]
    assert "[ERROR]" not in process.output
    described.describe(TEXT)
    described.becomes(name, "active")
    assert "active: robot UR10 of /robot_description" in process.output
    assert [line for line in process.output.splitlines() if "waits for" in line] == lines


def test_in_a_namespace_it_is_that_namespaces_robot(graph: Any, described: Described) -> None:
    node = graph.add(ThermalNode, {"robot": ""}, namespace="/left")
    described.describe(TEXT)
    graph.spin_for(0.5)
    assert node.state == "unconfigured"
    publisher = graph.publisher(String, "/left/robot_description", endpoints.LATCHED)
    publisher.publish(String(data=TEXT))
    graph.spin_until(lambda: node.state == "active", "its own robot has come")
    assert node.robot.arm.model_hash == TAKEN.arm.model_hash
    assert np.array_equal(node.robot.max_velocity, UR10.max_velocity)


def test_the_robot_of_a_description_can_be_corrected(graph: Any, described: Described) -> None:
    """It has the limits of its joints' speeds, and others are told which arm it is."""
    node = graph.add(JointCorrectionNode, {"robot": "", "serial": "s1"})
    described.describe(TEXT)
    graph.spin_until(lambda: described.statuses, "its status")
    told = described.statuses[-1]
    assert (told.robot, told.model_hash) == ("UR10", TAKEN.arm.model_hash)
    q = np.random.default_rng(1).uniform(-3.0, 3.0, (100, 6))
    assert np.abs(node.robot.arm.fk(q) - UR10.arm.fk(q)).max() < 1e-9  # m; of a URDF's digits
    answer = graph.call(SetBool, "/joint_correction_node/enable", data=True)
    assert answer.message == ON_WITHOUT_A_MODEL


def test_links_are_named_by_the_frames(graph: Any, described: Described) -> None:
    """Two robots in one description: nothing but the names tells which is meant."""
    both = "".join(
        ElementTree.tostring(part, encoding="unicode").replace('link="', f'link="{side}_')
        if part.tag == "joint"
        else f'<link name="{side}_{part.get("name")}"/>'
        for side in ("left", "right")
        for part in ElementTree.fromstring(TEXT)
    )
    both = both.replace('joint name="', 'joint name="left_', 7)
    sides = "".join(
        f'<joint name="{side}_mount" type="fixed"><parent link="world"/>'
        f'<child link="{side}_base"/></joint>'
        for side in ("left", "right")
    )
    text = f'<robot name="two"><link name="world"/>{both}{sides}</robot>'
    node = graph.add(ThermalNode, {"robot": ""})
    described.describe(text)
    words = "nothing tells which link is the flange"
    described.becomes("thermal_node", "unconfigured", words, DiagnosticStatus.ERROR)
    named = {"robot": "", "base_frame": "right_base", "flange_frame": "right_flange"}
    second = graph.add(HandEyeNode, named)
    graph.spin_until(lambda: second.state == "active", "it has its robot")
    assert second.robot.arm.joint_names == UR10.arm.joint_names
    assert node.state == "unconfigured"


def test_a_description_that_is_none_is_named_and_the_next_one_taken(
    graph: Any, described: Described
) -> None:
    graph.add(ThermalNode, {"robot": ""})
    described.describe("<robot")
    described.becomes("thermal_node", "unconfigured", "is no XML", DiagnosticStatus.ERROR)
    described.describe(TEXT)
    described.becomes("thermal_node", "active")


def test_a_lifecycle_manager_is_told_why_it_cannot_be_configured_yet(
    graph: Any, described: Described
) -> None:
    node = graph.add(ThermalNode, {"robot": "", "autostart": False})
    request = ChangeState.Request()
    request.transition.id = 1  # configure
    fields = {"transition": request.transition}
    assert not graph.call(ChangeState, "/thermal_node/change_state", **fields).success
    described.becomes("thermal_node", "unconfigured", WAITS)
    described.describe(TEXT)
    graph.spin_until(
        lambda: graph.call(ChangeState, "/thermal_node/change_state", **fields).success,
        "configured",
    )
    assert node.state == "inactive"


@pytest.mark.parametrize("name", SOME_NODES)
def test_a_file_of_another_robot_is_told_in_mm_and_where_it_begins(
    graph: Any, described: Described, tmp_path: Path, name: str
) -> None:
    kind, more = NODES[name]
    laser = {"laser": laser_of(tmp_path, UR10)} if name == "tcf_node" else {}
    graph.add(kind, {"robot": "ur10"} | more | laser)
    described.describe(longer("wrist_1_joint", 0.012))
    words = "behind 'elbow_joint': the axis of 'wrist_1_joint' is 12.000 mm and 0.0000 deg off"
    described.becomes(name, "active", words, DiagnosticStatus.ERROR)
    # Every pose moves the flange with the longer link alone: 12 mm, wherever the robot stands.
    assert "off by 12.000 mm and 0.0000 deg at most" in described.status(name).message
    stands = graph.publisher(JointState, "joint_states", endpoints.SENSOR)
    reading = JointState(name=list(UR10.arm.joint_names), position=STANDS.tolist())

    there = "12.000 mm and 0.0000 deg at the present joints"

    def told() -> bool:
        stands.publish(reading)
        graph.spin_for(0.05)
        return there in described.status(name).message

    graph.spin_until(told, "where the robot stands")
    described.describe(TEXT)
    graph.spin_until(lambda: words not in described.status(name).message, "it is mended")


def test_a_right_angle_of_five_digits_is_no_other_robot(graph: Any, described: Described) -> None:
    def rounded(top: ElementTree.Element) -> None:
        for origin in top.iter("origin"):
            turn = [f"{float(x):.4f}" for x in origin.get("rpy", "").split()]
            origin.set("rpy", " ".join(turn))

    node = graph.add(ThermalNode, {"robot": "ur10"})
    described.describe(edited(rounded))
    graph.spin_until(lambda: node._described, "it has come")
    assert not node.robot_fault


def test_another_robot_cannot_be_corrected(graph: Any, described: Described) -> None:
    """Neither before nor while it is: the offset goes to zero, and the message says why."""
    node = graph.add(
        JointCorrectionNode, {"robot": "ur10", "serial": "s1", "enable_on_start": True}
    )
    name = "/joint_correction_node/enable"
    graph.spin_until(lambda: described.statuses and described.statuses[-1].enabled, "it corrects")
    described.describe(longer("elbow_joint", 0.001))
    graph.spin_until(lambda: not described.statuses[-1].enabled, "it is off")
    answer = graph.call(SetBool, name, data=True)
    assert not answer.success
    assert "the description on the graph is another robot" in answer.message
    assert "the axis of 'elbow_joint' is 1.000 mm" in answer.message
    described.describe(TEXT)
    graph.spin_until(lambda: not node.robot_fault, "the right one")
    assert graph.call(SetBool, name, data=True).message == ON_WITHOUT_A_MODEL


def test_what_is_described_later_is_compared_with_what_was_taken(
    graph: Any, described: Described
) -> None:
    node = graph.add(ThermalNode, {"robot": ""})
    described.describe(TEXT)
    described.becomes("thermal_node", "active")
    described.describe(longer("elbow_joint", 0.001))
    words = "/robot_description is another robot than the one that was described at the start"
    described.becomes("thermal_node", "active", words, DiagnosticStatus.ERROR)
    assert node.robot.arm.model_hash == TAKEN.arm.model_hash


def test_nothing_is_moved_with_a_file_of_another_robot(
    graph: Any, described: Described, tmp_path: Path
) -> None:
    laser = laser_of(tmp_path, UR10)
    moving = {"motion": "trajectory", "gap_stale_s": 0.0, "tool_length_mm": 100.0}
    node = graph.add(TcfNode, {"robot": "ur10", "laser": laser} | moving)
    described.describe(longer("elbow_joint", 0.001))
    graph.spin_until(lambda: node.robot_fault, "it is told")
    answer = graph.call(SetBool, "/tcf_node/arm", data=True)
    assert not answer.success
    assert "is another robot than ur10" in answer.message


def test_the_line_hears_that_it_is_another_robot(graph: Any, described: Described) -> None:
    """What is known of its accuracy is of that in the file."""
    states = graph.collect(AccuracyState, "/accuracy_state", endpoints.LATCHED)
    graph.add(MaintenanceNode, {"robot": "ur10", "home_deg": HOME_DEG})
    described.describe(longer("elbow_joint", 0.001))
    graph.spin_until(lambda: states and "another robot" in states[-1].reason, "the line is told")
    assert states[-1].state == AccuracyState.FAULT
    described.describe(TEXT)
    graph.spin_until(lambda: "another robot" not in states[-1].reason, "and that it is right")


def test_a_description_without_the_robot_is_a_doubt_alone(graph: Any, described: Described) -> None:
    graph.add(ThermalNode, {"robot": str(find_robot("ur10")), "flange_frame": "my_flange"})
    described.describe(TEXT)
    words = "cannot be compared with"
    described.becomes("thermal_node", "active", words, DiagnosticStatus.WARN)


def test_limits_beyond_those_of_the_description_are_told(graph: Any, described: Described) -> None:
    """A UR whose elbow the cell's description keeps within half a turn, and slower."""

    def edit(top: ElementTree.Element) -> None:
        limit = top.find("joint[@name='elbow_joint']/limit")
        assert limit is not None
        limit.set("lower", "-3.14159265")
        limit.set("upper", "3.14159265")
        limit.set("velocity", "1.0")

    node = graph.add(ThermalNode, {"robot": "ur10"})
    described.describe(edited(edit))
    words = "elbow_joint may lie within -360 to 360 deg, not -180 to 180; elbow_joint may turn by"
    described.becomes(
        "thermal_node", "active", f"ur10 allows more than /robot_description: {words}"
    )
    assert described.status("thermal_node").level == DiagnosticStatus.WARN
    assert node.robot_fault == ""


def test_a_file_that_allows_less_is_somebodys_choice(graph: Any, described: Described) -> None:
    def edit(top: ElementTree.Element) -> None:
        for limit in top.iter("limit"):
            limit.set("velocity", "10.0")

    node = graph.add(ThermalNode, {"robot": "ur10"})
    described.describe(edited(edit))
    graph.spin_until(lambda: node._described, "it has been described")
    graph.spin_for(1.2)  # one round of diagnostics
    assert "allows more" not in described.status("thermal_node").message


def test_two_who_describe_different_robots_are_named(graph: Any, described: Described) -> None:
    node = graph.add(ThermalNode, {"robot": ""})
    described.describe(TEXT)
    graph.spin_until(lambda: node.state == "active", "its robot has come")
    other = Node("other_publisher", context=graph.context, start_parameter_services=False)
    try:
        profile = endpoints.own(endpoints.LATCHED)
        publisher = other.create_publisher(String, "robot_description", profile)
        graph.spin_until(
            lambda: len(node.get_publishers_info_by_topic("/robot_description")) == 2, "two"
        )
        publisher.publish(String(data=TEXT))
        graph.spin_for(1.2)
        assert "different" not in described.status("thermal_node").message  # the same text
        publisher.publish(String(data=TEXT + "<!-- edited -->"))
        words = "/other_publisher and /probe describe different robots on /robot_description"
        described.becomes("thermal_node", "active", words)
    finally:
        other.destroy_node()
