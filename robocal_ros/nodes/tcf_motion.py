"""Motion of the tool node: it moves the robot, once armed (docs/tool_motion.md)."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.core.errors import InputError
from robocal_ros.core.motion.housing import Housing
from robocal_ros.core.motion.limits import MotionLimits
from robocal_ros.core.motion.plan import JointPlan
from robocal_ros.core.samples import joint_sample
from robocal_ros.core.tool.edge_samples import RESTORE
from robocal_ros.nodes import qos
from robocal_ros.nodes.endpoints import EndpointNode, NotActiveError
from robocal_ros.nodes.parameters import Setting, length
from robocal_ros.sessions.driving_config import DrivingConfig
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.tool import ToolSession
from robocal_ros.sessions.tool_driving import ToolDriver

TICK_S = 0.01
NS = 1_000_000_000


def _of_joints(name: str, default: float, what: str, unit: str) -> Setting:
    words = f"{what}; one for all joints or one for each"
    return Setting(name, [default], words, unit=unit, low=1e-3, high=1e4)


SETTINGS = (
    _of_joints("joint_velocity_deg_s", 57.0, "Largest velocity", "deg/s"),
    _of_joints("joint_acceleration_deg_s2", 286.0, "Largest acceleration", "deg/s^2"),
    _of_joints("stop_deceleration_deg_s2", 573.0, "Deceleration of a stop", "deg/s^2"),
    Setting("tcp_speed_mm_s", 50.0, "Largest speed of the tip", unit="mm/s", low=1.0, high=250.0),
    Setting(
        "tcp_acceleration_mm_s2",
        1200.0,
        "Largest acceleration of the tip on its path",
        unit="mm/s^2",
        low=1.0,
        high=10000.0,
    ),
    length("plunge_limit_mm", 20.0, "No plunge is deeper", 1.0, 100.0),
    length("opening_radius_mm", 60.0, "Opening of the housing about the crossing", 5.0, 1e3),
    length("housing_top_mm", 30.0, "Height of the housing above the beams", 0.0, 1e3),
    length("housing_depth_mm", 120.0, "Depth of the opening below the beams", 1.0, 1e3),
    length("retract_mm", 50.0, "Height of the tip above the beams on its way", 1.0, 2e3),
    length("tool_length_mm", 100.0, "Length of the tool along its axis", 1.0, 2e3),
    length("tool_radius_mm", 10.0, "Its radius, with the largest bend to be found", 0.5, 500.0),
    length("flange_radius_mm", 60.0, "Of a ball about the flange", 1.0, 1e3),
    length("deviation_mm", 2.0, "The tip so far from its plan stops the robot", 0.05, 50.0),
    Setting(
        "deviation_deg",
        0.5,
        "A joint so far from its plan stops the robot; the tip, see deviation_mm",
        unit="deg",
        low=0.01,
        high=10.0,
    ),
)


def driving_config(settings: Mapping[str, Any]) -> DrivingConfig:
    """Settings of the driver, in SI.

    Raises
    ------
    InputError
        When sizes contradict each other.
    """
    return DrivingConfig(
        housing=Housing(
            clear_radius_m=settings["opening_radius_mm"] * 1e-3,
            top_m=settings["housing_top_mm"] * 1e-3,
            floor_m=-settings["housing_depth_mm"] * 1e-3,
            retract_m=settings["retract_mm"] * 1e-3,
        ),
        tool_length_m=settings["tool_length_mm"] * 1e-3,
        tool_radius_m=settings["tool_radius_mm"] * 1e-3,
        flange_radius_m=settings["flange_radius_mm"] * 1e-3,
        limits=MotionLimits(
            joint_velocity=np.radians(settings["joint_velocity_deg_s"]),
            joint_acceleration=np.radians(settings["joint_acceleration_deg_s2"]),
            stop_deceleration=np.radians(settings["stop_deceleration_deg_s2"]),
            tcp_speed_m_s=settings["tcp_speed_mm_s"] * 1e-3,
            tcp_acceleration_m_s2=settings["tcp_acceleration_mm_s2"] * 1e-3,
            plunge_speed_m_s=settings["plunge_speed_mm_s"] * 1e-3,
            plunge_depth_m=settings["plunge_limit_mm"] * 1e-3,
        ),
        deviation_m=settings["deviation_mm"] * 1e-3,
        deviation_rad=float(np.radians(settings["deviation_deg"])),
    )


class TcfMotion:
    """``~/arm`` and ``~/joint_trajectory``.

    Parameters
    ----------
    ask : gives a command to the session.
    """

    def __init__(
        self, node: EndpointNode, settings: Mapping[str, Any], ask: Callable[[Command], object]
    ) -> None:
        self._node, self._ask = node, ask
        self._config = driving_config(settings)
        self._names: tuple[str, ...] = ()
        self.driver: ToolDriver | None = None
        self._output = node.add_output(JointTrajectory, "~/joint_trajectory", qos.RELIABLE)
        node.add_service(SetBool, "~/arm", self._arm)
        node.add_timer(TICK_S, self._tick, steady=True)

    def activate(self, session: ToolSession) -> None:
        """Begin, disarmed.

        Raises
        ------
        InputError
            When a limit is given for another number of joints, or the robot has none.
        """
        arm = session.nominal
        self._config.limits.of_joints(arm)
        if not np.all(np.isfinite([arm.lower, arm.upper])):
            raise InputError(f"{arm.name} has joints without limits: add them to the robot file")
        self._names = session.nominal.joint_names
        self.driver = ToolDriver(session, self._config, self._send, self._ask)

    def deactivate(self) -> None:
        """Stop what moves."""
        if self.driver is not None:
            self.driver.disarm("the node was deactivated", time.monotonic())
        self.driver = None

    def take(self, message: Any) -> None:
        """Take a JointState before the session does: what is odd stops the robot first."""
        if self.driver is None:
            return
        try:
            sample = joint_sample(message)
            q = sample.position[sample.order(self._names)]
        except InputError:  # the session counts it; without readings the robot stops
            return
        self.driver.reading(sample.stamp_ns / NS, q, time.monotonic())

    def beam(self, message: Any) -> None:
        """Take a BeamEvent, usable or not: on its way the tool breaks no beam."""
        if self.driver is not None:
            self.driver.beam(message.edge != RESTORE)

    def require_ready(self) -> None:
        """Refuse a run while nothing may move."""
        if self.driver is None:
            raise NotActiveError("no session: activate the node")
        self.driver.require_ready()

    def words(self) -> str:
        """What the diagnostics say."""
        return "inactive" if self.driver is None else self.driver.words()

    def run_ended(self, outcome: Outcome) -> None:
        """A run without a result stops the robot."""
        if self.driver is not None and outcome.document is None:
            self.driver.run_failed(outcome.message, time.monotonic())

    def _tick(self) -> None:
        if self.driver is not None:
            self.driver.tick(time.monotonic())

    def _arm(self, request: Any, response: Any) -> Any:
        if self.driver is None:
            raise NotActiveError("no session: activate the node")
        if request.data:
            self.driver.arm(time.monotonic())
        else:
            self.driver.disarm("disarmed by a call", time.monotonic())
        response.success = True
        seconds = f"{self._config.armed_s:g} s"
        response.message = (
            f"armed: begin the measurement within {seconds}" if request.data else "disarmed"
        )
        self._node.get_logger().warning(f"arm {request.data}: {response.message}")
        return response

    def _send(self, plan: JointPlan) -> None:
        message = JointTrajectory(joint_names=list(self._names))
        for t, q, qd in zip(plan.time_s.tolist(), plan.q.tolist(), plan.qd.tolist(), strict=True):
            ns = round(t * NS)
            message.points.append(
                JointTrajectoryPoint(
                    positions=q,
                    velocities=qd,
                    time_from_start=Duration(sec=ns // NS, nanosec=ns % NS),
                )
            )
        self._output.publish(message)
