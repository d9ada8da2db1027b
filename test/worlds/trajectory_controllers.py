# SPDX-License-Identifier: Apache-2.0
"""A trajectory controller on the graph, real or simulated, for six joints that start at home.

Real: ros2_control's node with mock hardware; simulated: `cell_sim_node`. Both under the same names.
"""

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from action_msgs.msg import GoalStatusArray
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from builtin_interfaces.msg import Duration, Time
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState, SpeedScalingFactor
from rclpy.action import ActionClient
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.kinematics.robots import load_description, load_robot
from robocal_ros.kinematics.urdf import urdf_of
from robocal_ros.ros import endpoints

ARM = load_robot("ur10")
NAMES = list(ARM.joint_names)
HOME = np.radians([2.3, -124.4, -70.9, 107.7, -91.1, 91.8])
PERIOD_S = 0.004
NODE = "arm_controller"
PACKAGES = (
    "controller_manager",
    "controller_manager_msgs",
    "hardware_interface",
    "joint_state_broadcaster",
    "joint_trajectory_controller",
)
DEEP = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.RELIABLE)

Point = tuple[float, Any] | tuple[float, Any, Any] | tuple[float, Any, Any, Any]


def missing_packages() -> list[str]:
    """What of ros2_control is not installed."""
    missing = []
    for package in PACKAGES:
        try:
            get_package_prefix(package)
        except PackageNotFoundError:
            missing.append(package)
    return missing


def trajectory(
    points: Iterable[Point], names: Sequence[str] = NAMES, stamp_s: float = 0.0
) -> JointTrajectory:
    """Points of time from start, positions, velocities and accelerations as far as given."""
    message = JointTrajectory(joint_names=list(names))
    for time_s, *rows in points:
        point = JointTrajectoryPoint(time_from_start=Duration(**_parts(time_s)))
        for field, row in zip(("positions", "velocities", "accelerations"), rows, strict=False):
            if row is not None:
                setattr(point, field, [float(x) for x in row])
        message.points.append(point)
    message.header.stamp = Time(**_parts(stamp_s))
    return message


def _parts(time_s: float) -> dict[str, int]:
    sec, nanosec = divmod(round(time_s * 1e9), 10**9)
    return {"sec": sec, "nanosec": nanosec}


def seconds(stamp: Any) -> float:
    """Of a time or a duration."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def accepted_goals(graph: Any, action: str) -> list[bytes]:
    """Goals that a controller's action accepted from now on, whoever sent them; it grows."""
    goals: list[bytes] = []

    def take(message: GoalStatusArray) -> None:
        told = [bytes(status.goal_info.goal_id.uuid) for status in message.status_list]
        goals.extend(goal for goal in told if goal not in goals)

    graph.probe.create_subscription(
        GoalStatusArray, f"{action}/_action/status", take, endpoints.LATCHED
    )
    return goals


class Controlled:
    """The controller, what it tells, and a client of its action."""

    def __init__(self, graph: Any) -> None:
        self.graph, node = graph, graph.probe
        self.states: list[JointTrajectoryControllerState] = graph.collect(
            JointTrajectoryControllerState, f"{NODE}/controller_state", DEEP
        )
        self.readings: list[JointState] = graph.collect(JointState, "joint_states", DEEP)
        self.action = ActionClient(node, FollowJointTrajectory, f"{NODE}/follow_joint_trajectory")

    def wait(self) -> None:
        """Until it works and is discovered."""
        graph = self.graph
        graph.spin_until(lambda: self.states and self.readings, "its state", 30.0)
        graph.spin_until(self.action.server_is_ready, "its action")
        self.topic = graph.publisher(JointTrajectory, f"{NODE}/joint_trajectory")
        self.scaling = graph.publisher(
            SpeedScalingFactor, f"{NODE}/speed_scaling_input", endpoints.LATCHED
        )
        graph.spin_for(0.3)

    # ---- commands -------------------------------------------------------------------------------

    def send(self, message: JointTrajectory) -> None:
        """Publish a trajectory until it is taken: the real controller subscribes as best effort.

        Seen by its time, which begins anew, or by a robot that stood and moves.
        """
        for attempt in range(3):
            sent, before = len(self.states), self.states[-2:]
            stood = before[0].output.positions == before[1].output.positions
            if attempt and message.header.stamp != Time():
                at_s = seconds(message.header.stamp) + 1.0
                message.header.stamp = Time(**_parts(at_s))
            self.topic.publish(message)
            until_s = time.monotonic() + 1.0
            while time.monotonic() < until_s:
                self.graph.spin_for(0.01)
                new = self.states[sent - 1 :]
                times = [seconds(m.reference.time_from_start) for m in new]
                if np.min(np.diff(times), initial=0.0) < 0.0:
                    return
                if stood and new[-1].output.positions != new[0].output.positions:
                    return
        pytest.fail(f"not taken: {message}")

    def goal(self, message: JointTrajectory, **fields: Any) -> Any:
        """Send a goal; its handle once it is accepted or rejected."""
        goal = FollowJointTrajectory.Goal(trajectory=message, **fields)
        return self.graph.awaited(self.action.send_goal_async(goal), "the goal is answered")

    def end(self, handle: Any, within_s: float = 10.0) -> tuple[int, int]:
        """Status and error code of a goal."""
        ended = self.graph.awaited(handle.get_result_async(), "the goal ends", within_s)
        return ended.status, ended.result.error_code

    def scale(self, factor: float) -> None:
        """Set its speed, and wait until it says so."""
        self.scaling.publish(SpeedScalingFactor(factor=factor))
        self.graph.spin_until(
            lambda: self.states[-1].speed_scaling_factor == factor, f"scaled to {factor}"
        )

    # ---- what it tells --------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        """Its stamp."""
        return seconds(self.states[-1].header.stamp)

    @property
    def q(self) -> np.ndarray:
        """Where the joints are."""
        return np.array(self.states[-1].feedback.positions)

    def moved(self, away: float = 0.05, start: Any = HOME) -> None:
        """Wait until the first joint is so far from ``start``."""
        self.graph.spin_until(lambda: abs(self.q[0] - start[0]) > away, "it moves")

    def stands(self) -> np.ndarray:
        """Wait until the command has not changed for 0.15 s; where the joints are then."""

        def quiet() -> bool:
            stamps, sent = self.sent(self.now_s - 0.2)
            return stamps[-1] - stamps[0] > 0.15 and float(np.ptp(sent, axis=0).max()) < 1e-9

        self.graph.spin_for(0.05)
        self.graph.spin_until(quiet, "it stands")
        return self.q

    def sent(self, since_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (k,) and commands (k, 6)."""
        states = [m for m in self.states if seconds(m.header.stamp) >= since_s]
        stamps = np.array([seconds(m.header.stamp) for m in states])
        return stamps, np.array([m.output.positions for m in states])

    def speeds(self, since_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (k,) and speeds (k, 6) of the command, between two of its states."""
        stamps, sent = self.sent(since_s)
        return stamps[1:], np.diff(sent, axis=0) / np.diff(stamps)[:, None]


# ---- simulated -----------------------------------------------------------------------------------


def simulated(graph: Any, folder: Path, velocities: bool, **parameters: Any) -> Controlled:
    """The cell's robot, without a lag, as mock hardware has none."""
    given = {"velocities": str(velocities).lower(), "lag_ms": 0.0} | parameters
    controlled = Controlled(graph)
    remap = {"__node": NODE, "joint_trajectory": f"{NODE}/joint_trajectory"}
    graph.start("cell_sim_node", given, remap)
    return controlled


# ---- real ----------------------------------------------------------------------------------------


def real(graph: Any, folder: Path, velocities: bool, **parameters: Any) -> Controlled:
    """joint_trajectory_controller on mock_components/GenericSystem, see `missing_packages`."""
    from controller_manager_msgs.srv import ConfigureController, LoadController, SwitchController

    states = ["position", "velocity"] if velocities else ["position"]
    controllers = {
        "joint_state_broadcaster": "joint_state_broadcaster/JointStateBroadcaster",
        NODE: "joint_trajectory_controller/JointTrajectoryController",
    }
    settings = {
        "controller_manager": {"update_rate": round(1.0 / PERIOD_S)}
        | {name: {"type": kind} for name, kind in controllers.items()},
        NODE: {"joints": NAMES, "command_interfaces": ["position"], "state_interfaces": states}
        | parameters,
    }
    file = folder / "controllers.yaml"
    file.write_text(yaml.dump({name: {"ros__parameters": of} for name, of in settings.items()}))
    controlled = Controlled(graph)
    description = graph.probe.create_publisher(
        String, "robot_description", endpoints.own(endpoints.LATCHED)
    )
    description.publish(String(data=_urdf(velocities)))
    node = Path(
        get_package_prefix("controller_manager"), "lib/controller_manager/ros2_control_node"
    )
    command = [str(node), "--ros-args", "--params-file", str(file)]
    graph.run("ros2_control_node", command)
    for name in controllers:
        for kind, service in (
            (LoadController, "load_controller"),
            (ConfigureController, "configure_controller"),
        ):
            _ask(graph, service, kind, kind.Request(name=name))
    request = SwitchController.Request(activate_controllers=list(controllers), strictness=2)
    _ask(graph, "switch_controller", SwitchController, request)
    return controlled


def _ask(graph: Any, service: str, kind: Any, request: Any) -> None:
    """Call a service of the controller manager."""
    client = graph.probe.create_client(kind, f"controller_manager/{service}")
    graph.spin_until(client.service_is_ready, f"{service} appears", 30.0)
    answer = graph.awaited(client.call_async(request), f"{service} answers")
    assert answer.ok, f"{service}: {request}"
    graph.probe.destroy_client(client)


def _urdf(velocities: bool) -> str:
    """The arm on mock hardware, at home; nodes refuse a description of another robot."""
    speed = '<state_interface name="velocity"/>' * velocities
    joints = [
        f'<joint name="{name}"><command_interface name="position"/>'
        f'<state_interface name="position"><param name="initial_value">{start}</param>'
        f"</state_interface>{speed}</joint>"
        for name, start in zip(NAMES, HOME.tolist(), strict=True)
    ]
    dynamics = '<param name="calculate_dynamics">true</param>' * velocities
    hardware = (
        '<ros2_control name="hardware" type="system"><hardware>'
        f"<plugin>mock_components/GenericSystem</plugin>{dynamics}</hardware>"
        f"{''.join(joints)}</ros2_control></robot>"
    )
    return urdf_of(ARM, load_description("ur10").max_velocity).replace("</robot>", hardware)


CONTROLLERS = {"simulated": simulated, "real": real}
