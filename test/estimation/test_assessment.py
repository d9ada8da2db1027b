# SPDX-License-Identifier: Apache-2.0
"""The decision: groups, splits, codes, and a significance level that is what it says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from long_form import more

from robocal_ros.estimation.assessment import (
    FEWEST_GROUPS,
    LARGEST_RMS_M,
    SIGNIFICANCE,
    gross,
    hold_out,
    judge,
    pose_groups,
    summarise,
    too_narrow,
)
from robocal_ros.ground.errors import Code, TooFewSamplesError


def apart(count: int) -> np.ndarray:
    """One group per sample."""
    return np.arange(count)


def test_summary_by_hand():
    found = summarise(np.array([1.0, 2.0, 3.0, 4.0, 0.0]))
    assert (found.mean_m, found.max_m, found.n) == (2.0, 4.0, 5)
    assert found.rms_m == pytest.approx(np.sqrt(6.0))
    assert found.p95_m == pytest.approx(3.8)
    vectors = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
    assert summarise(vectors) == summarise(np.array([5.0, 1.0]))


def test_visits_of_one_pose_share_a_group():
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (10, 6))
    visits = np.vstack([q, q + 5e-4, q[:3] - 9e-4])
    groups = pose_groups(visits)
    assert len(set(groups)) == 10
    assert np.array_equal(groups[:10], groups[10:20])
    assert np.array_equal(groups[:3], groups[20:])
    assert len(set(pose_groups(np.vstack([q, q + 2e-3])))) == 20


@given(st.integers(0, 1000), st.floats(0.05, 0.95), st.integers(2, 40))
@settings(max_examples=60, deadline=None)
def test_split_keeps_equal_poses_together(seed, share, poses):
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2.0, 2.0, (poses, 6))[rng.integers(0, poses, 3 * poses)]
    groups = pose_groups(q)
    if groups.max() == 0:
        return
    held = hold_out(groups, share, seed)
    assert not set(groups[held]) & set(groups[~held])
    count = groups.max() + 1
    assert len(set(groups[held])) == np.clip(round(share * count), 1, count - 1)
    assert np.array_equal(held, hold_out(groups, share, seed))


def test_seeds_split_differently():
    groups = apart(50)
    assert not np.array_equal(hold_out(groups, 0.5, 0), hold_out(groups, 0.5, 1))


@pytest.mark.parametrize("groups", [np.zeros(7, dtype=np.int64), np.empty(0, dtype=np.int64)])
def test_one_pose_cannot_be_split(groups):
    with pytest.raises(TooFewSamplesError, match="cannot be split: measure more poses"):
        hold_out(groups, 0.5, 0)


@pytest.mark.parametrize(
    ("before_mm", "after_mm", "code"),
    [
        (1.0, 0.5, Code.ACCEPT),
        (0.5, 1.0, Code.WORSE_THAN_CURRENT),
        (1.0, 1.0, Code.NO_SIGNIFICANT_GAIN),
        (0.5, 8.0, Code.WORSE_THAN_CURRENT),
        (20.0, 8.0, Code.RESIDUAL_TOO_LARGE),
        (8.0, 20.0, Code.RESIDUAL_TOO_LARGE),
        (20.0, 0.5, Code.ACCEPT),
    ],
)
def test_codes(before_mm, after_mm, code):
    rng = np.random.default_rng(1)
    spread = rng.uniform(0.8, 1.2, (2, 30)) * 1e-3
    verdict = judge(before_mm * spread[0], after_mm * spread[0], apart(30))
    assert verdict.code is code
    assert verdict.accept is (code is Code.ACCEPT)
    assert "held-out rms" in verdict.reason
    assert " mm" in verdict.reason


def test_a_better_rms_with_a_worse_mean_is_no_improvement():
    """One outlier less does not make up for all the others being worse."""
    before = np.append(np.full(29, 1e-4), 2e-3)
    after = np.append(np.full(29, 2e-4), 1e-3)
    assert summarise(after).rms_m < summarise(before).rms_m
    assert judge(before, after, apart(30)).code is Code.NO_SIGNIFICANT_GAIN


def test_chance_alone_is_called_worse_in_one_of_twenty_sets():
    """Equal models: 400 sets give at most 34 at 5 % (99.9 % bound of the binomial)."""
    rng = np.random.default_rng(3)
    codes = [judge(*rng.chisquare(3, (2, 20)) ** 0.5 * 1e-4, apart(20)).code for _ in range(400)]
    assert codes.count(Code.WORSE_THAN_CURRENT) <= 34
    assert codes.count(Code.NO_SIGNIFICANT_GAIN) >= 320


def test_gross_is_what_no_model_fits():
    before = np.full(20, 3e-4)
    after = np.full(20, 5e-5)
    before[4], after[4] = 2e-2, 2e-2
    assert np.flatnonzero(gross(before, after)).tolist() == [4]


def test_a_bad_model_cannot_hide_its_errors():
    before = np.full(20, 5e-5)
    after = before.copy()
    after[:6] = 2e-2
    assert not np.any(gross(before, after))


def test_doubt_about_the_poses_is_a_refusal_only_of_what_seemed_good():
    good, bad = np.full(30, 1e-4), np.full(30, 1e-3)
    refused = judge(bad, good, apart(30), "the wrist never turned")
    assert refused.code is Code.POSES_NOT_INFORMATIVE
    assert "the wrist never turned" in refused.reason
    assert judge(good, bad, apart(30), "the wrist never turned").code is Code.WORSE_THAN_CURRENT


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
@pytest.mark.parametrize("which", ["current", "candidate", "both"])
@pytest.mark.parametrize("where", [slice(1), slice(None)])
def test_what_is_no_number_is_refused(which, wrong, where):
    current, candidate = np.linspace(0.9e-3, 1.1e-3, 20), np.linspace(0.1e-3, 0.2e-3, 20)
    for name, errors in (("current", current), ("candidate", candidate)):
        if which in (name, "both"):
            errors[where] = wrong
    with np.errstate(invalid="ignore"):
        assert not judge(current, candidate, apart(20)).accept


def test_too_few_poses_to_judge():
    before, after = np.full(40, 1e-3), np.full(40, 1e-4)
    groups = np.arange(40) % (FEWEST_GROUPS - 1)
    assert judge(before, after, groups).code is Code.TOO_FEW_SAMPLES
    assert judge(before, after, np.arange(40) % FEWEST_GROUPS).accept


def test_visits_of_one_pose_count_once():
    """A gain at one pose out of six, visited forty times, is no evidence for the others."""
    before, after = np.full(46, 1.00e-3), np.full(46, 0.99e-3)
    before[:6] = [1.0e-3, 1.1e-3, 0.9e-3, 1.05e-3, 0.95e-3, 1.0e-3]
    after[:6] = [1.1e-3, 0.95e-3, 1.0e-3, 1.0e-3, 1.05e-3, 0.9e-3]
    after[6:] = 0.5e-3
    groups = np.append(np.arange(6), np.zeros(40, dtype=np.int64))
    assert judge(before, after, apart(46)).code is Code.ACCEPT
    assert judge(before, after, groups).code is Code.NO_SIGNIFICANT_GAIN


def test_limit_of_the_residual():
    just = np.full(10, LARGEST_RMS_M)
    assert judge(2.0 * just, just, apart(10)).accept
    over = judge(2.0 * just, 1.001 * just, apart(10))
    assert over.code is Code.RESIDUAL_TOO_LARGE
    assert "check the robot file" in over.reason


@pytest.mark.parametrize("poses", [8, *more(30, 200)])
def test_chance_alone_is_accepted_as_rarely_as_promised(poses):
    """Two models that are equally good, 4000 comparisons: at most 5 %, with four sigmas."""
    rng, accepted = np.random.default_rng(poses), 0
    for _ in range(4000):
        before, after = np.linalg.norm(1e-4 * rng.normal(size=(2, poses, 3)), axis=2)
        accepted += judge(before, after, apart(poses)).accept
    bound = SIGNIFICANCE * 4000
    assert accepted <= bound + 4.0 * np.sqrt(bound * (1.0 - SIGNIFICANCE))


def test_a_real_gain_is_found():
    """A tenth less error at 300 poses is seen nearly always."""
    rng, accepted = np.random.default_rng(2), 0
    for _ in range(200):
        noise = 1e-4 * rng.normal(size=(2, 300, 3))
        before, after = np.linalg.norm(noise * [[[1.0]], [[0.9]]], axis=2)
        accepted += judge(before, after, apart(300)).accept
    assert accepted > 180


def test_poses_carry_over_where_the_rest_is_known_well_enough():
    """An error of 0.3 mm: against twice the present one, and against a change of sqrt(3) times."""
    assert not too_narrow(3e-4, 0.0, 1.6e-4, "turn")
    assert not too_narrow(3e-4, 5.3e-4, 0.0, "turn")
    words = too_narrow(3e-4, 5.1e-4, 1.4e-4, "turn")
    assert words.endswith("an error of 0.300 mm rms, for a change of 0.510 mm: turn")
