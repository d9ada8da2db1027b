# SPDX-License-Identifier: Apache-2.0
"""Whoever is killed and started anew, in whatever order: the robot's commands go on without a step.

All three nodes are processes; planner and robot are played by the test. The robot does exactly
what it is told; the planner waits while nothing comes back.
"""

import itertools
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from joint_correction_live import HOME, NAMES, NODE, NOMINAL, drifted, joints
from jumps import no_jump
from long_form import amount
from robocal_msgs.msg import CorrectionStatus
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from tool_driver import noisy_cell

from robocal_ros.correction.bounds import CorrectionConfig, correction_between
from robocal_ros.correction.joint_correction import pack_model
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL, TOOL
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document
from robocal_ros.ros import endpoints
from robocal_ros.session.events import bring_into_force
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.laser_frame import LaserFile, write_laser

PERIOD_S = 0.02
SPEED_RAD_S, SWING_RAD = 0.05, 0.1
OFFSET_RAD_S = np.radians(2.0)  # by default, besides what the posture changes
START_RAD = np.radians(0.02)  # how far from where it stands a command may begin
LONGEST_S = 0.1  # what a pause counts for at most, in a stream that goes on
TAUGHT_M = [0.01, 0.0, 0.25]
BENT_M = 0.005


def with_tool(arm: SerialArm, shift_m: float) -> SerialArm:
    """The arm with the taught tool, or with one that is bent along the flange's x."""
    tool = np.eye(4)
    tool[:3, 3] = [TAUGHT_M[0] + shift_m, *TAUGHT_M[1:]]
    return replace(arm, T_flange_tool=tool)


class Cell:
    """Planner, robot, and the three nodes as processes."""

    def __init__(self, graph: Any, folder: Path) -> None:
        self.graph = graph
        self._laser = folder / "laser.yaml"
        laser = LaserFile(noisy_cell().laser, "north", NOMINAL.name, NOMINAL.model_hash)
        write_laser(self._laser, laser)
        self._seed()
        self.robot = HOME.copy()
        self.taught: dict[int, tuple[float, np.ndarray]] = {}
        self.sent: list[tuple[float, np.ndarray, np.ndarray]] = []
        self._phase, self._answered, self._heard, self._pauses = 0.0, 0.0, 0.0, False
        self.status: list[CorrectionStatus] = graph.collect(
            CorrectionStatus, f"{NODE}/status", endpoints.LATCHED
        )
        probe = graph.probe
        probe.create_subscription(
            JointState, f"{NODE}/joint_targets", self._obey, endpoints.own(endpoints.RELIABLE)
        )
        self._targets = probe.create_publisher(JointState, "joint_targets", 10)
        self._states = probe.create_publisher(JointState, "joint_states", 10)
        self.nodes: dict[str, Any] = {}
        for name in ("thermal_node", "tcf_node", "joint_correction_node"):
            self.start(name)
        probe.create_timer(PERIOD_S, self._tick)

    def _seed(self) -> None:
        found = KnownTool(with_tool(NOMINAL, BENT_M).T_flange_tool).document() | {
            "thermal_revision": 0
        }
        with CalibrationHistory.open(
            "s1", model_hash=NOMINAL.model_hash, state_dir=self.graph.state
        ) as history:
            bring_into_force(history, THERMAL, NOMINAL, model_document(drifted()), "test")
            bring_into_force(history, TOOL, NOMINAL, found, "test")

    def start(self, name: str) -> None:
        """Start a node, or start it anew."""
        tool = {"taught_xyz_mm": [1e3 * x for x in TAUGHT_M]}
        parameters: dict[str, Any] = {"serial": "s1", "robot": "kr150_r3100"}
        parameters |= {
            "thermal_node": {},
            "tcf_node": tool | {"laser": self._laser},
            "joint_correction_node": tool,
        }[name]
        remap = {"kinematic_model": "/thermal_node/model", "tool": "/tcf_node/tool"}
        mine = remap if name == "joint_correction_node" else None
        self.nodes[name] = self.graph.start(name, parameters, mine, mortal=True)
        if mine is not None:
            self.status.clear()  # a killed node still seems to be there for a while
            self.graph.spin_until(lambda: self.status, "the status of a new node", 30.0)

    def kill(self, name: str) -> None:
        """As a power cut would."""
        self.nodes[name].kill()

    def _tick(self) -> None:
        """The robot tells where it is; the planner goes on where it is answered."""
        now = time.time_ns()
        state = joints(self.robot)
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(now, 10**9)
        self._states.publish(state)
        if self._pauses:
            return
        if time.monotonic() - self._heard < 3 * PERIOD_S:
            self._phase += PERIOD_S * SPEED_RAD_S / SWING_RAD
        else:
            self._phase = self._answered  # where the robot stands
        q = HOME + SWING_RAD * np.sin(self._phase)
        target = joints(q)
        target.header.stamp.sec, target.header.stamp.nanosec = divmod(now, 10**9)
        self.taught[now] = self._phase, q
        self._targets.publish(target)

    def _obey(self, message: JointState, info: Any) -> None:
        stamp = message.header.stamp
        assert list(message.name) == NAMES
        out, sent_s = np.array(message.position), 1e-9 * info["source_timestamp"]
        answer = self.taught.get(stamp.sec * 10**9 + stamp.nanosec)
        if answer is None:  # the node slows down what it hears no more of: the planner is there
            _, before, out_before = self.sent[-1]
            taught = before + out - out_before
            self._answered += np.mean(taught - before) / (SWING_RAD * np.cos(self._answered))
        else:
            self._answered, taught = answer
        self.sent.append((sent_s, taught, out))
        self.robot, self._heard = out, time.monotonic()

    def goes_on(self) -> None:
        """Commands come again, once model and tool do; after a mismatch the planner asks for it."""
        self.graph.spin_until(self._knows, "the model and the tool", 30.0)
        count = len(self.sent)
        for _ in range(10):
            self.graph.spin_for(0.5)
            if len(self.sent) > count + 10:
                return
            if self.status[-1].state == CorrectionStatus.MISMATCH:
                assert self.graph.call(Trigger, f"{NODE}/acknowledge").success
        logs = "".join(f"\n--- {name}:\n{e.output}" for name, e in self.nodes.items())
        pytest.fail(f"no commands come any more: {self.status[-1]}{logs}")

    def _knows(self) -> bool:
        """Whether it knows the calibrations, with which it tells where the robot may stand."""
        if not self.status:
            return False
        told = self.status[-1]
        model = max(told.model_revision, told.waiting_model_revision)
        return bool(model == 1 and max(told.tool_revision, told.waiting_tool_revision) == 1)

    def enable(self) -> None:
        """Ask for the correction and wait until all of it is made.

        A tool is taken over at a standstill only, so the planner makes a pause.
        """
        self._pauses = True
        self.graph.spin_for(0.5)
        self.graph.call(SetBool, f"{NODE}/enable", data=True)
        self._pauses = False
        self.status.clear()
        self.graph.spin_until(self._is_on, "the correction is on", 20.0)

    def _is_on(self) -> bool:
        told = self.status[-1] if self.status else CorrectionStatus()
        revisions = told.model_revision, told.tool_revision
        return bool(told.state == CorrectionStatus.ON and revisions == (1, 1))

    def largest_step(self) -> float:
        """How much more the commands moved than the path, the limiter and a new begin allow."""
        over = []
        for (t0, taught0, out0), (t1, taught1, out1) in itertools.pairwise(self.sent):
            dt = min(t1 - t0, LONGEST_S) + PERIOD_S  # and from computing to sending
            step = np.abs(out1 - out0).max()
            over.append(step - np.abs(taught1 - taught0).max() - OFFSET_RAD_S * dt)
        return float(np.max(over))


NODES = ("thermal_node", "tcf_node", "joint_correction_node")
TOGETHER = amount(1, 6)  # of the orders of all together


def test_no_step_whoever_is_killed(graph: Any, tmp_path: Path) -> None:
    cell = Cell(graph, tmp_path)
    cell.goes_on()
    cell.enable()
    offset = cell.sent[-1][2] - cell.sent[-1][1]
    assert np.abs(offset).max() > 10.0 * START_RAD  # so a step would show
    for name in NODES:  # each alone
        cell.kill(name)
        graph.spin_for(0.3)
        cell.start(name)
        cell.goes_on()
        if name == NODES[2]:  # it comes back off
            cell.enable()
    for order in list(itertools.permutations(NODES))[:TOGETHER]:  # all together, in turn
        for name in order:
            cell.kill(name)
        for name in order:
            graph.spin_for(0.2)
            cell.start(name)
        cell.goes_on()
        cell.enable()
    over_rad = cell.largest_step()
    no_jump(over_rad < START_RAD, f"{1e3 * over_rad:.2f} mrad too far, whoever is killed")
    models = (pack_model(with_tool(arm, m)) for arm, m in ((NOMINAL, 0.0), (drifted(), BENT_M)))
    whole = correction_between(*models, NOMINAL, CorrectionConfig())

    def is_whole() -> bool:
        """Where the planner is heard, so that what was taught is known and not derived."""
        _, taught, out = cell.sent[-1]
        return np.allclose(out, whole.correct(taught[None]).q[0], rtol=0.0, atol=1e-9)

    graph.spin_until(is_whole, "what was, is again", 10.0)
