"""The robot of a node: a robot file's, or that of the description on the graph.

``robot_description`` (std_msgs/String, reliable, transient local, depth 1) is a URDF, as
robot_state_publisher publishes its parameter: at its start, and again whenever that is changed
(docs/robot_description.md has what else reads it, and the sources).
"""

from typing import Any

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
            found = model_difference(self._links(), self.robot.arm, present)
        except Exception as error:  # whatever a stranger publishes, the node lives on
            self._doubt = f"{topic} cannot be compared with {self._source()}: {error}"
            self._log(DESCRIPTION, error)
        else:
            if found is not None:
                self.robot_fault = f"{topic} is another robot than {self._source()}: {found}"
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
        return health
