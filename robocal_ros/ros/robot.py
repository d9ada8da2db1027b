# SPDX-License-Identifier: Apache-2.0
"""The robot of a node: a robot file's, or that of the description on the graph.

``robot_description`` (std_msgs/String, reliable, transient local, depth 1) is a URDF, as
robot_state_publisher publishes its parameter: at its start, and again whenever that is changed
(docs/robot_description.md has what else reads it, and the sources).
"""

from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import JOINTS, joint_sample
from robocal_ros.kinematics.robots import RobotDescription, load_description
from robocal_ros.kinematics.urdf import Chain, arm_of, chain, model_difference, read_urdf
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import AwaitedError, HouseNode
from robocal_ros.ros.endpoints import ERROR, WARN, Health
from robocal_ros.ros.parameters import BASE_FRAME, FLANGE_FRAME, ROBOT

DESCRIPTION = "robot_description"


class RobotNode(HouseNode):
    """A node of one robot; it waits for the robot where no file is named, and then starts itself.

    ``SETTINGS`` have `ROBOT_SETTINGS`. ``robot``: from `configure` on, which a node calls first.
    ``robot_fault``: why the robot in use is another than the one described on the graph; empty:
    nothing tells so.
    """

    robot: RobotDescription
    robot_fault = ""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._described = self._doubt = ""
        self._texts: set[int] = set()  # that were described
        self._awaits = False
        self._present: Any = None  # subscription, until it has told where the robot stands
        # Not of `add_input`: it is heard while nothing is configured.
        self.create_subscription(
            String, DESCRIPTION, self._take_description, endpoints.own(endpoints.LATCHED)
        )

    def robot_compared(self) -> None:
        """Take notice of ``robot_fault`` as it is found later than by `configure`."""

    def configure(self) -> None:
        """Find the robot. Raises `AwaitedError` while it is not known."""
        self._awaits = True
        if self.settings[ROBOT.name]:
            self.robot = load_description(self.settings[ROBOT.name])
        elif self._described:
            self.robot = arm_of(self._links())
        else:
            raise AwaitedError(
                f"waits for the robot: nobody publishes {self.resolve_topic_name(DESCRIPTION)} "
                f"(robot_state_publisher does), and the parameter {ROBOT.name} names no file"
            )
        self._awaits = False
        self._release.append(self._forget)
        for note in self.robot.notes:
            self.get_logger().warning(f"{self.robot.path}: {note}")
        if self._described:
            self._compare()

    def _links(self) -> Chain:
        urdf = read_urdf(self._described, self.resolve_topic_name(DESCRIPTION))
        names = (self.settings[frame.name] for frame in (BASE_FRAME, FLANGE_FRAME))
        known = (
            name if name in urdf.links or name != frame.default else ""
            for name, frame in zip(names, (BASE_FRAME, FLANGE_FRAME), strict=True)
        )
        return chain(urdf, *known)

    def _take_description(self, message: Any) -> None:
        if message.data == self._described:
            return
        self._described = message.data
        self._texts.add(hash(message.data))
        if self._awaits and self.state == "unconfigured":
            self.autostart()
        elif self.state in ("inactive", "active"):
            self._compare()
            self.robot_compared()

    def _take_present(self, message: Any) -> None:
        try:
            sample = joint_sample(message)
            present = sample.position[sample.order(self.robot.arm.joint_names)]
        except RobocalError:  # of other joints
            return
        self._end_present()
        self._compare(present)
        self.robot_compared()

    def _compare(self, present: Array | None = None) -> None:
        """Hold the robot in use against the description; joints (n,) where the robot stands."""
        self.robot_fault = self._doubt = ""
        topic = self.resolve_topic_name(DESCRIPTION)
        try:
            links = self._links()
            found = model_difference(links, self.robot.arm, present)
            beyond = limits_beyond(links, self.robot) if found is None else ""
        except Exception as error:  # whatever a stranger publishes, the node lives on
            self._doubt = f"{topic} cannot be compared with {self._source()}: {error}"
            self._log(DESCRIPTION, error)
        else:
            if found is not None:
                self.robot_fault = f"{topic} is another robot than {self._source()}: {found}"
            if beyond:
                self._doubt = f"{self._source()} allows more than {topic}: {beyond}"
                self.get_logger().warning(self._doubt)
        if self.robot_fault:
            self.get_logger().error(self.robot_fault)
        if self.robot_fault and present is None and self._present is None:
            self._present = self.create_subscription(
                JointState, JOINTS, self._take_present, endpoints.own(endpoints.NEWEST)
            )

    def _forget(self) -> None:
        self.robot_fault = self._doubt = ""
        self._end_present()

    def _end_present(self) -> None:
        if self._present is not None:
            self.destroy_subscription(self._present)
            self._present = None

    def _source(self) -> str:
        return str(self.settings[ROBOT.name] or "the one that was described at the start")

    def identity(self) -> list[str]:
        """Name of the robot and where it is from, and its serial."""
        source = self.settings[ROBOT.name] or self.resolve_topic_name(DESCRIPTION)
        return [f"robot {self.robot.arm.name} of {source}", *super().identity()]

    def _full_health(self) -> Health:
        health = super()._full_health()
        if self.robot_fault:
            health.worsen(ERROR, self.robot_fault)
        if self._doubt:
            health.worsen(WARN, self._doubt)
        if len(self._texts) > 1:  # else it does not matter who said it
            topic = self.resolve_topic_name(DESCRIPTION)
            infos = self.get_publishers_info_by_topic(topic)
            if len(infos) > 1:
                who = sorted(f"{i.node_namespace.rstrip('/')}/{i.node_name}" for i in infos)
                health.worsen(
                    WARN,
                    f"{' and '.join(who)} describe different robots on {topic}: the last counts",
                )
        return health


_LIMIT = 1e-4  # relative; a description's numbers are rounded


def limits_beyond(links: Chain, robot: RobotDescription) -> str:
    """Joints that ``robot`` lets go further, or faster, than the description does; empty: none.

    A file that allows less is somebody's choice; what the description leaves open is no limit.
    """
    words = []
    rows = zip(links.moving, robot.arm.lower, robot.arm.upper, robot.max_velocity, strict=True)
    for joint, lower, upper, velocity in rows:
        factor, unit = (1e3, "mm") if joint.kind == "prismatic" else (np.degrees(1.0), "deg")
        told = [joint.lower, joint.upper, joint.velocity]
        beyond = np.array([joint.lower - lower, upper - joint.upper, velocity - joint.velocity])
        beyond[~np.isfinite(told)] = 0.0
        if (beyond[:2] > _LIMIT * np.abs(told[:2]) + 1e-9).any():
            ours, theirs = factor * np.array([lower, upper]), factor * np.array(told[:2])
            words.append(
                f"{joint.name} may lie within {ours[0]:.4g} to {ours[1]:.4g} {unit}, "
                f"not {theirs[0]:.4g} to {theirs[1]:.4g}"
            )
        if beyond[2] > _LIMIT * joint.velocity:
            words.append(
                f"{joint.name} may turn by {factor * velocity:.4g} {unit}/s, "
                f"not {factor * joint.velocity:.4g}"
            )
    return "; ".join(words)
