# SPDX-License-Identifier: Apache-2.0
"""A correction node that is killed in a stream of trajectories of one point each, and started anew.

Judged by what the controller commands, simulated or real; the real one is looked for in the
environment, without it that test is skipped.
"""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from joint_correction_live import NODE as CORRECTION
from jumps import no_jump
from robocal_msgs.msg import CorrectionStatus, KinematicModel
from std_msgs.msg import Header
from std_srvs.srv import SetBool
from trajectory_controllers import ARM, CONTROLLERS, HOME, NODE, Controlled, trajectory
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.ground.samples import CORRECTED
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.robots import load_description
from robocal_ros.ros import conversions, endpoints

PERIOD_S, AHEAD_S = 0.1, 0.3  # of the stream; of its point, from when it is sent
SPEED = np.array([0.3, 0.1, -0.1, 0.2, -0.1, 0.1])  # rad/s
FASTEST = 3.0  # of that: messages that a busy machine holds up come together
DRIFT = 1e-4, 5e-5  # m, rad: of what goes out it changes some hundredths of a degree


class Stream:
    """A planner, a correction node as a process, and a controller."""

    OUTPUT = f"{NODE}/joint_trajectory"
    PARAMETERS: ClassVar[dict[str, Any]] = {}  # of the node, besides

    def __init__(self, graph: Any, controller: Controlled) -> None:
        self.graph, self.controller = graph, controller
        probe = graph.probe
        probe.destroy_publisher(controller.topic)  # the node alone commands the controller
        controller.action.destroy()
        self.sent: list[JointTrajectory] = graph.collect(
            JointTrajectory, self.OUTPUT, endpoints.RELIABLE
        )
        self.status: list[CorrectionStatus] = graph.collect(
            CorrectionStatus, f"{CORRECTION}/status", endpoints.LATCHED
        )
        self._planner = probe.create_publisher(
            JointTrajectory, "joint_trajectory", endpoints.RELIABLE
        )
        self._models = probe.create_publisher(KinematicModel, "kinematic_model", endpoints.LATCHED)
        self._models.publish(self._model())
        self.taught, self.runs = HOME.copy(), False
        probe.create_timer(PERIOD_S, self._tick)

    def _model(self) -> KinematicModel:
        """A robot that has drifted a little."""
        chosen = ARM.parameters
        change = np.where(chosen.is_length, *DRIFT) * np.random.default_rng(0).standard_normal(
            len(chosen)
        )
        return conversions.kinematic_model(
            model_document(ARM.with_mdh(chosen.add(ARM.mdh, change))),
            serial="s1",
            model_hash=ARM.model_hash,
            robot_file_hash=load_description("ur10").file_hash,
            revision=1,
            state=KinematicModel.ACCEPTED,
            stamp=Header(frame_id="base"),
        )

    def _tick(self) -> None:
        if self.runs:
            self.taught = self.taught + PERIOD_S * SPEED
            self._planner.publish(trajectory([(AHEAD_S, self.taught)]))

    def start(self) -> Any:
        """Start the node."""
        self.status.clear()
        given = {"robot": "ur10", "serial": "s1", "joint_state_age_s": 0.5} | self.PARAMETERS
        wired = {
            "~/joint_trajectory": self.OUTPUT,
            "controller_state": f"{NODE}/controller_state",
        }
        node = self.graph.start("joint_correction_node", given, wired, mortal=True)
        self.wait(CorrectionStatus.OFF)
        return node

    def wait(self, state: int) -> None:
        """For what the node says, with nobody else about."""

        def said() -> bool:
            now = self.status[-1] if self.status else None
            return now is not None and now.state == state and not now.commanders

        self.graph.spin_until(said, f"state {state}", 30.0)

    def is_heard(self) -> None:
        """The planner stays where it is until the node, which is off, passes that on."""
        count = len(self.sent)

        def passed() -> bool:
            self._planner.publish(trajectory([(AHEAD_S, self.taught)]))
            return len(self.sent) > count

        self.graph.spin_until(passed, "the node hears its planner")

    def runs_on(self, rad: float = 0.2) -> None:
        """The planner streams until the robot has gone so far."""
        start, self.runs = self.controller.q, True
        self.controller.moved(rad, start)

    def runs_no_faster(self) -> None:
        """`runs_on`, and the command was nowhere much faster than the stream."""
        began_s = self.controller.now_s
        self.runs_on()
        self.was_no_faster(began_s)

    def was_no_faster(self, since_s: float) -> None:
        """The command, than the stream."""
        _, speeds = self.controller.speeds(since_s)
        no_jump(np.abs(speeds) < FASTEST * np.abs(SPEED), "no faster than the stream")


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_a_node_that_is_killed_leaves_the_robot_at_the_last_point(
    graph: Any, tmp_path: Path, kind: str
) -> None:
    controller = CONTROLLERS[kind](graph, tmp_path, True)
    controller.wait()
    stream = Stream(graph, controller)
    node = stream.start()
    stream.is_heard()
    graph.call(SetBool, f"{CORRECTION}/enable", data=True)
    began_s = controller.now_s
    graph.undisturbed(stream.runs_no_faster)
    stream.wait(CorrectionStatus.ON)

    killed_s = controller.now_s
    node.kill()
    stream.runs = False
    graph.spin_for(2 * PERIOD_S)  # what was on its way
    last = np.array(stream.sent[-1].points[-1].positions)
    stands = controller.stands()
    assert stream.sent[-1].header.frame_id == CORRECTED
    assert stands == pytest.approx(last, abs=1e-6)
    assert np.abs(stands - HOME)[0] > 0.2
    _, sent = controller.sent(began_s)
    no_jump(np.diff(sent[:, 0]) > -1e-6, "nothing turns back")
    stream.was_no_faster(killed_s)

    count, again_s = len(stream.sent), controller.now_s
    stream.start()
    graph.spin_for(0.5)
    assert len(stream.sent) == count  # off, and nothing goes out by itself
    assert controller.stands() == pytest.approx(stands, abs=1e-6)
    stream.is_heard()
    graph.undisturbed(stream.runs_no_faster)
    assert not stream.status[-1].mismatch
    _, sent = controller.sent(again_s)
    no_jump(np.diff(sent[:, 0]) > -1e-6, "nothing turns back")
