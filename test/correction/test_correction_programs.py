# SPDX-License-Identifier: Apache-2.0
"""Honest programs are corrected from the first target to the last: none is refused or ended."""

from pathlib import Path

import numpy as np
import pytest
from correction_robot import FASTEST
from long_form import more

from robocal_ros.bags.bags import BagReader
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand, OfferedModel, OfferedTool
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.ground import frames
from robocal_ros.kinematics.robots import load_description

BAGS = Path(__file__).parents[2] / "bags"
PAUSE_S = 0.5  # nothing is commanded: the robot is read at its driver's rate meanwhile
READ_S = 0.01
PERIOD_S = 0.012
LEFT_M = 2e-5  # where no direction is weak: what a good robot repeats to


def program(name: str, joints: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Times (m,) and joints (m, 6) of a recorded robot: targets as its program could send them.

    Those of a fast driver are thinned.
    """
    with BagReader(BAGS / name) as bag:
        topics = [topic for topic in bag.info.topics if topic.endswith("joint_states")]
        read = [m.message for m in bag.messages(topics)]
    stamps = np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in read])
    times, first = np.unique(stamps, return_index=True)
    fewer = max(round(PERIOD_S / np.median(np.diff(times))), 1)
    times, first = times[::fewer], first[::fewer]
    column = [list(read[0].name).index(joint) for joint in joints]
    return times - times[0], np.array([read[i].position for i in first])[:, column]


@pytest.mark.parametrize(
    ("name", "robot", "bent_m"),
    [
        ("tool_runs.mcap", "ur10", 2e-3),
        *more(("golden_excerpt.mcap", "kr150_r3100", 2e-3), ("tool_runs.mcap", "ur10", 0.0)),
    ],
)
def test_a_recorded_program_is_corrected_throughout(name: str, robot: str, bent_m: float) -> None:
    found = load_description(robot)
    arm = found.arm
    limits = found.max_velocity, found.max_acceleration
    times, q = program(name, arm.joint_names)
    config = CorrectionConfig(velocity_limits=limits[0], acceleration_limits=limits[1])
    session = CorrectionSession(arm, arm, "s1", config)
    rng = np.random.default_rng(4)
    actual = arm.with_mdh(arm.mdh + 3e-5 * rng.standard_normal(arm.mdh.shape))
    tool = arm.T_flange_tool @ frames.transform(np.eye(3), [bent_m, 0.0, 0.0])
    session.offer_model(
        OfferedModel(arm.name, "s1", arm.model_hash, 1, True, arm.joint_names, actual.mdh)
    )
    if bent_m:
        of = arm.name, "s1", arm.model_hash, 1, True
        session.offer_tool(OfferedTool(*of, "tool0", tool, "tcp"))
    session.enable(True)
    now, at = 100.0, q[0]

    def read(seconds: float) -> None:
        nonlocal now
        for _ in range(round(seconds / READ_S)):
            now += READ_S
            session.reading(JointCommand(arm.joint_names, at), now)

    read(PAUSE_S)
    before, offset = now, np.zeros(arm.n)
    for dt, target in zip(np.diff(times, prepend=times[0] - READ_S), q, strict=True):
        if dt > PAUSE_S:
            read(dt)
        else:
            now += dt
        session.reading(JointCommand(arm.joint_names, at), now)
        at = session.target(JointCommand(arm.joint_names, target), now).position
        assert np.abs(at - target - offset).max() <= FASTEST * (now - before) + 1e-9
        before, offset = now, at - target
    status = session.status()
    assert status.refused == {}
    assert (status.settled, status.lag_s) == (True, 0.0)
    wanted = (arm.fk(q[-1]) @ arm.T_flange_tool)[:3, 3]
    reached = (actual.fk(at) @ tool)[:3, 3]
    assert np.linalg.norm(reached - wanted) <= LEFT_M
