# SPDX-License-Identifier: Apache-2.0
"""Cold again, or as warm as a drift: the share that a visit shows, and when it is told."""

from dataclasses import replace

import numpy as np
import pytest
from drift_cell import SIGMA, cell_of, drifted, postures, visit
from long_form import amount, more

from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.identification import drift_prior
from robocal_ros.thermal.reference import DriftShare, capture_reference, drift_share

POSES, ROUNDS, TRIALS = 10, 3, amount(40, 100)
KNOCK = frames.transform(frames.exp_rotation([0.0, 0.02, 0.01]), [6e-3, 0.0, -3e-3])


def shares(arm: SerialArm, truth: float, T_knock: np.ndarray) -> list[DriftShare]:
    """Of visits that show so much of a drift, each of another robot."""
    found = []
    for seed in range(TRIALS):
        rng = np.random.default_rng(seed)
        root = np.linalg.cholesky(drift_prior(arm) + 1e-18 * np.eye(len(arm.parameters.names)))
        drift = root @ rng.standard_normal(len(root))
        own = 10.0 * root @ rng.standard_normal(len(root))  # as built
        cold, q = drifted(cell_of(arm), own), np.tile(postures(POSES, seed), (ROUNDS, 1))
        reference = capture_reference(arm, visit(cold, q, rng))
        moved = replace(cold, T_frame_base=T_knock @ cold.T_frame_base)
        again = capture_reference(arm, visit(drifted(moved, truth * drift), q, rng))
        warm = arm.with_mdh(arm.parameters.add(arm.mdh, drift))
        found.append(drift_share(reference, again, warm, SIGMA))
    return found


@pytest.mark.parametrize("T_knock", [KNOCK, *more(np.eye(4))], ids=["knocked", *more("still")])
@pytest.mark.parametrize("truth", [0.0, 1.0])
def test_the_share_is_as_uncertain_as_it_says(arm, truth, T_knock):
    """A standard normal over the trials, within three of its own standard deviations."""
    found = shares(arm, truth, T_knock)
    z = np.array([(one.share - truth) / one.sigma for one in found])
    assert abs(z.mean()) < 3.0 / np.sqrt(TRIALS)
    assert z.std() < 1.0 + 3.0 / np.sqrt(2.0 * TRIALS)
    told = [one for one in found if one.told]
    assert len(told) > 0.5 * TRIALS
    assert all(one.warm == bool(truth) for one in told)


def test_other_poses_tell_nothing(arm):
    cell = cell_of(arm)
    reference, again = (
        capture_reference(arm, visit(cell, postures(POSES, seed))) for seed in (1, 2)
    )
    warm = arm.with_mdh(arm.parameters.add(arm.mdh, np.full(len(arm.parameters.names), 1e-4)))
    assert not drift_share(reference, again, warm, SIGMA).told
    assert not drift_share(reference, reference, arm, SIGMA).told  # nor does no drift


def test_another_target_tells_nothing(arm):
    cell = cell_of(arm)
    data = visit(cell, postures(POSES))
    other = replace(data, target=("other",) * len(data))
    reference, again = capture_reference(arm, data), capture_reference(arm, other)
    warm = arm.with_mdh(arm.parameters.add(arm.mdh, np.full(len(arm.parameters.names), 1e-4)))
    assert not drift_share(reference, again, warm, SIGMA).told
