# SPDX-License-Identifier: Apache-2.0
"""A robot, its models and its tools, for the tests of the joint correction's session."""

import itertools
from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import (
    JointCommand,
    OfferedModel,
    OfferedTool,
    Reason,
    RefusedError,
    TrajectoryCommand,
)
from robocal_ros.correction.joint_correction import JointCorrection
from robocal_ros.correction.limiter import TURNING
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_description

DESCRIPTION = load_description("kr150_r3100")
NOMINAL = replace(DESCRIPTION.arm, T_flange_tool=frames.transform(np.eye(3), [0.02, 0.0, 0.2]))
NAMES = NOMINAL.joint_names
HOME = np.array([0.3, -1.2, 1.2, 0.4, 0.9, -0.3])
DT = 0.004
LIMITS = {
    "velocity_limits": DESCRIPTION.max_velocity,
    "acceleration_limits": DESCRIPTION.max_acceleration,
}
# Of the offset, as the house promises it: at rest, and never more.
REST, FASTEST = np.radians(2.0), np.radians(10.0)
REST_A, LARGEST_A = np.radians(20.0), np.radians(200.0)
START = np.radians(0.02)  # by so much the robot may stand beside where a command begins
ROUNDING = 1e-9
assert pytest.approx(astuple(TURNING)) == (REST, REST_A, FASTEST, LARGEST_A)


def drifted(size: float = 1.0, seed: int = 0) -> SerialArm:
    """A drift of about 0.12 mm times ``size`` at the tool."""
    rng = np.random.default_rng(seed)
    chosen = NOMINAL.parameters
    change = rng.standard_normal(len(chosen)) * np.where(chosen.is_length, 8e-5, 4e-5)
    mdh = NOMINAL.mdh.copy()
    for (joint, column), x in zip(chosen.index, change, strict=True):
        mdh[joint, column] += size * x
    return NOMINAL.with_mdh(mdh)


def endless() -> SerialArm:
    """The robot, whose last joint has no limits."""
    free = np.arange(6) == 5
    lower, upper = np.where(free, [[-np.inf], [np.inf]], [NOMINAL.lower, NOMINAL.upper])
    return replace(NOMINAL, lower=lower, upper=upper)


def offer(arm: SerialArm, revision: int = 1, **changes: Any) -> OfferedModel:
    model = OfferedModel(
        robot=NOMINAL.name,
        serial="s1",
        model_hash=NOMINAL.model_hash,
        revision=revision,
        accepted=True,
        joint_names=NAMES,
        mdh=arm.mdh,
        functions=arm.functions,
        load=arm.load,
    )
    return replace(model, **changes)


REVISIONS = itertools.count(1)


def bent_tool(shift_m: float = 2e-3, turn_deg: float = 0.5, **changes: Any) -> OfferedTool:
    """Each one is a revision later than the one before."""
    change = frames.transform(frames.exp_rotation([0, np.radians(turn_deg), 0]), [shift_m, 0, 0])
    tool = OfferedTool(
        parent="tool0",
        T_flange_tool=NOMINAL.T_flange_tool @ change,
        child="tcp",
        robot=NOMINAL.name,
        serial="s1",
        model_hash=NOMINAL.model_hash,
        revision=next(REVISIONS),
        accepted=True,
    )
    return replace(tool, **changes)


class Robot:
    """A session, the time in which it is used, and a robot that goes where it is sent."""

    def __init__(self, *, rested: bool = True, **config: Any) -> None:
        settings = CorrectionConfig(**(LIMITS | config))
        self.session = CorrectionSession(NOMINAL, NOMINAL, "s1", settings)
        self.now = 100.0
        self.at = HOME
        if rested:
            self.rest()

    def stream(self, q: np.ndarray = HOME, dt: float = DT, **fields: Any) -> np.ndarray:
        """Send a target, and let the robot follow it."""
        self.now += dt
        self.read(self.at)
        names = fields.pop("names", NAMES)
        out = self.session.target(JointCommand(names, np.array(q), **fields), self.now)
        self.go(out)
        return self.at

    def go(self, command: JointCommand) -> None:
        self.at = self.at.copy()
        for name, position in zip(command.names, command.position, strict=True):
            self.at[NAMES.index(name)] = position

    def settle(self, q: np.ndarray = HOME) -> np.ndarray:
        for _ in range(3000):
            out = self.stream(q)
            if self.session.status().settled:
                return out
        pytest.fail("the offset does not settle")

    def rest(self, seconds: float = 0.5) -> None:
        """Nothing is commanded, and the robot stands."""
        for _ in range(round(seconds / 0.01)):
            self.now += 0.01
            self.read(self.at)
        self.session.look(self.now, 0)

    def change_tool(self, tool: OfferedTool) -> None:
        self.session.offer_tool(tool)
        self.rest()

    def read(self, q: np.ndarray, **fields: Any) -> JointCommand:
        return self.session.reading(JointCommand(NAMES, np.array(q), **fields), self.now)


def pose(arm: SerialArm, q: np.ndarray) -> np.ndarray:
    return arm.fk(q) @ arm.T_flange_tool


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm((a - b)[..., :3, 3], axis=-1).max())


def refused(reason: Reason, act: Any, *arguments: Any, **fields: Any) -> str:
    with pytest.raises(RefusedError) as caught:
        act(*arguments, **fields)
    assert caught.value.reason is reason, caught.value
    return str(caught.value)


def still(q: np.ndarray = HOME, first_s: float = 0.0, seconds: float = 20.0) -> TrajectoryCommand:
    times = np.linspace(first_s, first_s + seconds, 41)
    return TrajectoryCommand(NAMES, np.tile(q, (41, 1)), times)


def good_here_only() -> tuple[SerialArm, np.ndarray]:
    """A drift that is within the bounds at home, and a posture where it is not."""
    far = HOME + np.array([1.0, 0.6, -0.8, 1.0, 0.6, 1.0])
    bounds = CorrectionConfig().thermal
    for seed in range(400):
        arm = drifted(6.0, seed)
        here, there = (JointCorrection.between(NOMINAL, arm).correct(q) for q in (HOME, far))
        if bounds.hold(here).all() and there.tcp_shift_m > 1.05e-3:
            return arm, far
    pytest.fail("no such drift")


def swing(m: int = 201, duration: float = 2.0, first_s: float = 0.0) -> TrajectoryCommand:
    """A move from rest to rest with its true rates."""
    t = np.linspace(0.0, duration, m)
    w = np.pi / duration
    reach = np.array([0.4, -0.2, 0.3, -0.4, 0.3, 0.5])
    shape = [0.5 * (1 - np.cos(w * t)), 0.5 * w * np.sin(w * t), 0.5 * w * w * np.cos(w * t)]
    q, v, a = (x[:, None] * reach for x in shape)
    return TrajectoryCommand(NAMES, HOME + q, first_s + t, v, a)


def large(**config: Any) -> Robot:
    """Enabled, with a drift and a bent tool, at rest at home, uncorrected: shifts of degrees."""
    robot = Robot(**config)
    robot.session.offer_model(offer(drifted()))
    robot.session.offer_tool(bent_tool())
    robot.session.enable(True)
    return robot
