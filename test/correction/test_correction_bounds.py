# SPDX-License-Identifier: Apache-2.0
"""A clamped correction: within its bounds everywhere, continuous, and to be undone."""

from dataclasses import replace

import numpy as np
import pytest
from correction_robot import HOME, NOMINAL, drifted

from robocal_ros.correction.bounds import (
    FADES_WITHIN,
    ClampedCorrection,
    CorrectionConfig,
    Policy,
    correction_between,
)
from robocal_ros.correction.interface import Reason
from robocal_ros.correction.joint_correction import StagedCorrection, pack_model
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm

CONFIG = CorrectionConfig(policy=Policy.CLAMP)


def bent(arm: SerialArm, shift_m: float = 3e-3, turn_deg: float = 1.0) -> SerialArm:
    turn = frames.exp_rotation([0.0, np.radians(turn_deg), 0.0])
    change = frames.transform(turn, [shift_m, 0.0, 0.0])
    return replace(arm, T_flange_tool=arm.T_flange_tool @ change)


def clamped(arm: SerialArm) -> ClampedCorrection:
    reference, actual = pack_model(NOMINAL), pack_model(arm)
    stage = correction_between(reference, actual, NOMINAL, CONFIG)
    assert isinstance(stage, ClampedCorrection)
    return stage


def path_through(middle: np.ndarray, reach: float = 0.4, m: int = 2001) -> np.ndarray:
    along = np.random.default_rng(2).uniform(-1.0, 1.0, 6)
    return middle + np.linspace(-reach, reach, m)[:, None] * along / np.abs(along).max()


def near_limits() -> np.ndarray:
    """Up to the upper limit of joint 2 and back, while the others move on."""
    q = path_through(HOME)
    q[:, 1] = NOMINAL.upper[1] - np.abs(np.linspace(-0.05, 0.05, len(q)))
    return q


def through_the_wrist() -> np.ndarray:
    q = path_through(HOME)
    q[:, 4] = np.linspace(-0.05, 0.05, len(q))
    return q


PATHS = {"free": path_through(HOME), "limit": near_limits(), "wrist": through_the_wrist()}
ARMS = {
    "small": drifted(1.0),
    "large": drifted(15.0, seed=3),
    "small, bent": bent(drifted(1.0)),
    "large, bent": bent(drifted(15.0, seed=3)),
}


@pytest.fixture(params=PATHS)
def q(request: pytest.FixtureRequest) -> np.ndarray:
    return PATHS[request.param]


@pytest.fixture(params=ARMS)
def arm(request: pytest.FixtureRequest) -> SerialArm:
    return ARMS[request.param]


def test_no_bound_is_exceeded(q: np.ndarray, arm: SerialArm) -> None:
    result = clamped(arm).correct(q)
    shift = np.abs(result.q - q)
    assert np.all(shift <= CONFIG.thermal.joint_rad + CONFIG.tool.joint_rad)
    # beyond a limit by rounding only, and at the limit not at all
    assert np.all(result.q <= NOMINAL.upper + 1e-12)
    assert np.all(result.q >= NOMINAL.lower - 1e-12)
    if result.tool is None:
        assert np.all(shift <= CONFIG.thermal.joint_rad + 1e-12)
        moved = arm.fk(result.q) @ arm.T_flange_tool
        stood = arm.fk(q) @ arm.T_flange_tool
        step = np.linalg.norm((moved - stood)[:, :3, 3], axis=1)
        # a share of the joints' shift moves the tool by it up to the second order: 0.3 deg / 2
        assert step.max() <= CONFIG.thermal.tcp_m * (1.0 + np.radians(0.15))


def test_it_is_continuous(q: np.ndarray, arm: SerialArm) -> None:
    """Ten times as near, ten times as small a step: a jump would stay as large."""
    stage = clamped(arm)
    fine = np.linspace(q[:-1], q[1:], 10, endpoint=False).swapaxes(0, 1).reshape(-1, 6)
    largest = []
    for points in (q, fine):
        shift = stage.correct(points).q - points
        largest.append(np.abs(np.diff(shift, axis=0)).max())
    assert largest[1] < 0.2 * largest[0]


def test_taught_joints_follow_from_corrected_ones(q: np.ndarray, arm: SerialArm) -> None:
    stage = clamped(arm)
    result = stage.correct(q[::20])
    taught = stage.uncorrect(result.q)
    again = stage.correct(taught).q
    assert np.abs(again - result.q).max() < 1e-9


def test_what_bounds_it_is_named() -> None:
    assert clamped(drifted(1.0)).correct(HOME[None]).reason is None
    assert clamped(drifted(15.0, seed=3)).correct(HOME[None]).reason is Reason.TCP_BOUND
    at_limit = HOME.copy()
    at_limit[1] = NOMINAL.upper[1]
    result = clamped(drifted(1.0)).correct(at_limit[None])
    assert result.reason is Reason.JOINT_LIMIT
    assert np.array_equal(result.q[0], at_limit)
    assert not result.whole[0]
    assert result.remaining_m[0] >= 0.99 * result.arm.tcp_shift_m[0]


def test_where_no_bound_is_near_it_is_the_whole_correction() -> None:
    q = path_through(HOME, m=50)
    arm = bent(drifted(1.0), 0.5e-3, 0.1)
    config = replace(CONFIG, policy=Policy.REFUSE)
    packed = pack_model(arm)
    plain = correction_between(pack_model(NOMINAL), packed, NOMINAL, config)
    assert type(plain) is StagedCorrection
    result = clamped(arm).correct(q)
    assert np.array_equal(result.q, plain.correct(q).q)
    assert np.all(result.whole)


def test_towards_a_limit_it_fades_within_a_few_times_its_size() -> None:
    stage, q = clamped(drifted(1.0)), np.tile(HOME, (2, 1))
    size = np.abs(stage.correct(HOME[None]).q - HOME).max()
    q[:, 1] = NOMINAL.upper[1] - np.array([1.5, 0.5]) * FADES_WITHIN * size
    kept = stage.correct(q).kept
    assert kept[0] == 1.0
    assert kept[1] == pytest.approx(0.5, abs=0.2)
