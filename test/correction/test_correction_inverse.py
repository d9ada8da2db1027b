"""From corrected joints back to taught ones, with a bent tool and near singularities."""

from dataclasses import replace

import numpy as np
import pytest

from robocal_ros.correction.bounds import FADES_FROM, CorrectionConfig
from robocal_ros.correction.joint_correction import StagedCorrection, pack_model
from robocal_ros.ground import frames
from robocal_ros.kinematics.robots import load_robot

ARM = load_robot("kr150_r3100")
CONFIG = CorrectionConfig()
DRIFT, TOOL = (bounds.of_joints(ARM) for bounds in (CONFIG.thermal, CONFIG.tool))
STEP = 1e-6


def bent(shift_m: float, turn_deg: float, free_axis: bool) -> StagedCorrection:
    """A drift of some tenths of a millimetre, and a tool that is shifted and turned."""
    rng, chosen = np.random.default_rng(3), ARM.parameters
    size = rng.standard_normal(len(chosen)) * np.where(chosen.is_length, 2e-4, 1e-4)
    turn = frames.exp_rotation([0.0, np.radians(turn_deg), 0.0])
    tool = ARM.T_flange_tool @ frames.transform(turn, [shift_m, 0.0, 0.0])
    actual = replace(ARM.with_mdh(chosen.add(ARM.mdh, size)), T_flange_tool=tool)
    end = pack_model(actual)
    return StagedCorrection(pack_model(ARM), end, FADES_FROM * DRIFT, TOOL, free_axis)


def acceptable(stage: StagedCorrection, q: np.ndarray) -> np.ndarray:
    """Those of the postures in which a command is corrected, and not refused."""
    found = stage.correct(q)
    tool = found.tool
    assert tool is not None
    fine = found.arm.converged & tool.converged
    fine &= np.all(np.abs(found.arm.joint_shift) <= DRIFT, axis=1)
    return q[fine & np.all(np.abs(tool.joint_shift) <= TOOL, axis=1)]


def turning(stage: StagedCorrection, q: np.ndarray) -> np.ndarray:
    """How fast the shift of a joint changes, per motion of the joints (m,)."""
    fast = np.zeros((len(q), 6))
    for nudge in STEP * np.eye(6):
        there, back = (stage.correct(q + way * nudge).q for way in (1.0, -1.0))
        fast += np.abs((there - back - 2.0 * nudge) / (2.0 * STEP))
    return np.asarray(fast.max(axis=1))


def postures(count: int) -> np.ndarray:
    return np.random.default_rng(8).uniform(ARM.lower, ARM.upper, (count, 6))


@pytest.mark.parametrize(("shift_m", "turn_deg"), [(2e-3, 0.5), (9e-3, 2.9)])
@pytest.mark.parametrize(("free_axis", "share"), [(False, 0.0), (True, 1e-3)])
def test_taught_joints_come_back_where_the_shift_turns_slower_than_the_joints(
    shift_m: float, turn_deg: float, free_axis: bool, share: float
) -> None:
    """There each corrected posture has one taught one: the shift is a contraction."""
    stage = bent(shift_m, turn_deg, free_axis)
    q = acceptable(stage, postures(6000))
    q = q[turning(stage, q) < 1.0]
    assert len(q) > 3000
    found = stage.uncorrect(stage.correct(q).q)
    lost = np.abs(found - q).max(axis=1) > 1e-8
    assert np.mean(lost) <= share


@pytest.mark.parametrize("free_axis", [False, True])
def test_readings_anywhere_give_numbers_within_bounds(free_axis: bool) -> None:
    """Also in a singularity, where no command leads."""
    stage, q = bent(9e-3, 2.9, free_axis), postures(1000)
    q[:200, 4] = 0.0
    q[200:400, 4] *= 1e-4
    found = stage.uncorrect(q)
    assert np.all(np.abs(found - q) <= 2.0 * (DRIFT + TOOL))
