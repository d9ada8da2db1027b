# SPDX-License-Identifier: Apache-2.0
"""Cycles through the tracker: figures of poses left out, steps refused with their cause."""

from dataclasses import replace

import numpy as np
import pytest
from drift_cell import SIGMA, cell_of, drifted, postures, visit

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import CellModel
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import random_postures
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.identification import (
    FixedSphere,
    drift_prior,
    fixed_sphere,
    possible_causes,
)
from robocal_ros.thermal.reference import ColdSpots
from robocal_ros.thermal.tracking import DriftProcess, DriftTracker, TrackedCycle, track_cycle

PERIOD_S = 300.0
POSES = 6


def settled(arm: SerialArm, seed: int, poses: int = POSES) -> DriftTracker:
    """A tracker after ten cycles of a robot that does not drift."""
    rng = np.random.default_rng(seed)
    cell, q = cell_of(arm), postures(poses)
    spots = ColdSpots.of(cell, visit(cell, q, rng))
    tracker = DriftTracker(spots, DriftProcess(0.1 * drift_prior(arm)), SIGMA)
    for i in range(10):
        assert tracker.take(visit(cell, q, rng), PERIOD_S * (i + 1)).applied
    return tracker


def take(tracker: DriftTracker, warm: Measurements, fixed: FixedSphere | None = None):
    time_s = tracker.state.time_s + PERIOD_S
    in_force = tracker.spots.cell.arm
    return track_cycle(tracker, warm, time_s, in_force=in_force, fixed=fixed)


def knocked(arm: SerialArm, what: str) -> Measurements:
    """A cycle after something moved by a millimetre or so."""
    cell, q, rng = cell_of(arm), postures(POSES), np.random.default_rng(77)
    if what == "sensor":
        turned = frames.transform(frames.exp_rotation([0.0, 1e-3, 5e-4]), [6e-4, 0.0, -3e-4])
        cell = replace(cell, T_frame_base=turned @ cell.T_frame_base)
    elif what == "sphere":
        tool = cell.T_flange_target.copy()
        tool[0, :3, 3] += [8e-4, -5e-4, 4e-4]
        cell = replace(cell, T_flange_target=tool)
    elif what:
        joint = arm.joint_names.index(what)
        mdh = arm.mdh.copy()
        mdh[joint, 1] += np.radians(0.05)
        cell = replace(cell, arm=arm.with_mdh(mdh))
    return visit(cell, q, rng)


@pytest.mark.parametrize("what", ["sensor", "sphere", "joint_a2", "joint_a3", "joint_a4"])
def test_a_knock_is_refused_and_the_cause_is_among_the_possible_ones(arm, what):
    tracker = settled(arm, 1)
    before = tracker.state
    found = take(tracker, knocked(arm, what))
    assert found.judged.verdict.code is Code.SENSOR_OR_ROBOT_MOVED
    assert tracker.state is before
    innovation = found.innovation
    causes = possible_causes(
        tracker.spots, found.found.warm, innovation.deviation, innovation.covariance
    )
    names = {cause.name for cause in causes}
    assert what in names
    assert len(names) < 3  # of eight


@pytest.mark.parametrize("what", ["sensor", "sphere"])
def test_the_size_of_a_knock_is_told(arm, what):
    words = take(settled(arm, 2), knocked(arm, what)).judged.verdict.reason
    size = {"sensor": "moved against each other by", "sphere": "moved on the flange by 1.0"}[what]
    assert size in words


def test_the_zero_of_a_sliding_joint_is_told_in_millimetres():
    arm = load_robot("p1r2p3")
    cell, q = cell_of(arm), random_postures(arm, POSES)
    warm = visit(cell, q)
    spots = ColdSpots.of(cell, warm)
    rows, _ = spots.rows(q, np.zeros(POSES, dtype=np.int64))
    moved = 5e-4 * rows[:, :, arm.parameters.names.index("d3_mm")]
    causes = possible_causes(spots, warm, moved.ravel(), 1e-10 * np.eye(3 * POSES))
    assert "the zero of joint3 changed by 0.5000 mm" in {cause.words for cause in causes}


def test_what_would_decide_is_said_only_where_it_would(arm):
    tracker, warm = settled(arm, 3), knocked(arm, "sensor")
    words = take(tracker, warm).judged.verdict.reason
    assert "reference_sphere_center" in words
    still = FixedSphere(np.zeros(3), moved=False)
    words = take(tracker, warm, still).judged.verdict.reason
    assert "stands where it was, so the sensor too" in words
    assert "reference_sphere_center" not in words
    words = take(tracker, knocked(arm, "sphere")).judged.verdict.reason
    assert "reference_sphere_center" not in words


def test_a_fixed_sphere_that_moved_refuses_even_a_plausible_cycle(arm):
    tracker = settled(arm, 4)
    warm = visit(cell_of(arm), postures(POSES), np.random.default_rng(6))
    before = tracker.state
    found = take(tracker, warm, FixedSphere(np.array([0.0, 4e-4, 0.0]), moved=True))
    assert found.innovation.applied
    assert found.judged.verdict.code is Code.SENSOR_OR_ROBOT_MOVED
    assert "the sensor did" in found.judged.verdict.reason
    assert "0.40 mm" in found.judged.verdict.reason
    assert tracker.state is before


def test_a_fixed_sphere_is_still_within_its_noise():
    """One alarm in a thousand: of 4000 visits four, at most fourteen (Poisson, 1e-4)."""
    rng = np.random.default_rng(0)
    alarms = 0
    for _ in range(4000):
        cold, now = (2e-5 * rng.standard_normal((n, 3)) for n in (3, 2))
        now = now + 1e-5 * rng.standard_normal(3)
        alarms += fixed_sphere(cold, now, 2e-5).moved
    assert alarms <= 14
    assert fixed_sphere(np.zeros((3, 3)), np.full((2, 3), 2e-4), 2e-5).moved


def test_one_wrong_reading_of_a_fixed_sphere_does_no_harm():
    rng = np.random.default_rng(1)
    cold, now = (2e-5 * rng.standard_normal((6, 3)) for _ in range(2))
    now[2] += [5e-4, 0.0, 0.0]
    assert not fixed_sphere(cold, now, 2e-5).moved


def test_a_sound_cycle_is_hardly_ever_taken_for_a_knock(arm):
    """Ten settled cycles of 30 runs: 0.3 alarms expected at one in a thousand; at most four."""
    alarms = 0
    for seed in range(30):
        rng = np.random.default_rng([9, seed])
        cell, q = cell_of(arm), postures(POSES)
        tracker = DriftTracker(
            ColdSpots.of(cell, visit(cell, q, rng)), DriftProcess(0.1 * drift_prior(arm)), SIGMA
        )
        alarms += sum(
            not tracker.take(visit(cell, q, rng), PERIOD_S * (i + 1)).applied for i in range(10)
        )
    assert alarms <= 4


def left_out(arm: SerialArm, seed: int) -> TrackedCycle:
    rng = np.random.default_rng(seed)
    cell, q = cell_of(arm), postures(POSES)
    prior = drift_prior(arm)
    tracker = DriftTracker(ColdSpots.of(cell, visit(cell, q, rng)), DriftProcess(prior), SIGMA)
    tracker.take(visit(cell, q, rng), PERIOD_S)
    return track_cycle(tracker, visit(cell, q, rng), 2 * PERIOD_S, in_force=arm)


def test_errors_at_poses_left_out_are_as_large_as_predicted(arm):
    """Their mean square over 60 runs against the predicted: 360 poses tell 15 % apart."""
    runs = [left_out(arm, seed) for seed in range(60)]
    miss = np.concatenate([np.sum(run.found.left_out**2, axis=1) for run in runs])
    told = np.concatenate([run.found.left_out_sigma**2 for run in runs])
    assert np.mean(miss / told) == pytest.approx(1.0, abs=4.0 * np.std(miss / told) / np.sqrt(360))


def test_leaving_a_pose_out_is_taking_the_cycle_without_it(arm):
    rng = np.random.default_rng(8)
    cell, q = cell_of(arm), postures(POSES)
    spots = ColdSpots.of(cell, visit(cell, q, rng))
    drift = 0.3 * np.sqrt(np.diag(drift_prior(arm)))
    warm = visit(drifted(cell, drift), q, rng)
    process = DriftProcess(drift_prior(arm))
    whole = track_cycle(DriftTracker(spots, process, SIGMA), warm, 7200.0, in_force=arm)
    for i in range(POSES):
        part = DriftTracker(spots, process, SIGMA)
        part.take(warm.take(np.arange(POSES) != i), 7200.0)
        y, H, _ = part.observation(warm.take(np.array([i])), 7200.0)
        assert whole.found.left_out[spots.match(warm)[i]] == pytest.approx(
            y - H @ part.state.mean, abs=1e-12
        )


def test_leaving_a_pose_out_leaves_out_all_that_was_seen_there(arm):
    """Two targets on the flange, measured at each pose: they share its repeatability."""
    rng, q = np.random.default_rng(8), np.repeat(postures(POSES), 2, axis=0)
    cell, names, target = cell_of(arm), ("ball", "tip"), np.tile([0, 1], POSES)
    places = np.repeat(cell.T_flange_target, 2, axis=0)
    places[1, 0, 3] += 0.1
    cell = replace(cell, targets=names, T_flange_target=places)

    def both(seen: CellModel) -> Measurements:
        p = seen.predict(q, target)[:, :3, 3]
        p = p + SIGMA * rng.standard_normal(p.shape)
        return Measurements(q, p, names * POSES, tuple(map(str, range(len(q)))))

    spots, process = ColdSpots.of(cell, both(cell)), DriftProcess(drift_prior(arm))
    warm = both(drifted(cell, 0.3 * np.sqrt(np.diag(drift_prior(arm)))))
    whole = track_cycle(DriftTracker(spots, process, SIGMA), warm, 7200.0, in_force=arm)
    for i in range(POSES):
        own, part = np.arange(len(q)) // 2 == i, DriftTracker(spots, process, SIGMA)
        part.take(warm.take(~own), 7200.0)
        y, H, _ = part.observation(warm.take(own), 7200.0)
        miss = (y - H @ part.state.mean).reshape(2, 3)
        assert whole.found.left_out[spots.match(warm)[own]] == pytest.approx(miss, abs=1e-12)


def test_the_model_in_force_is_judged_at_the_same_poses_by_its_drift_alone(arm):
    """The true drift in force: nothing is gained. None in force: the drift is the error."""
    rng = np.random.default_rng(10)
    cell, q = cell_of(arm), postures(POSES)
    drift = 0.5 * np.sqrt(np.diag(drift_prior(arm)))
    true = drifted(cell, drift)
    spots = ColdSpots.of(cell, visit(cell, q, rng))
    cycles = [visit(true, q, rng) for _ in range(4)]
    verdicts = {}
    for name, in_force in (("nominal", arm), ("true", true.arm)):
        tracker = DriftTracker(spots, DriftProcess(drift_prior(arm)), SIGMA)
        for i, cycle in enumerate(cycles):
            found = track_cycle(tracker, cycle, 7200.0 + PERIOD_S * i, in_force=in_force)
        verdicts[name] = found.judged
    assert verdicts["nominal"].verdict.code is Code.ACCEPT
    displaced = np.linalg.norm(spots.drift(cycles[-1]), axis=1)
    assert verdicts["nominal"].current.rms_m == pytest.approx(
        np.sqrt(np.mean(displaced**2)), abs=4.0 * SIGMA
    )
    assert verdicts["true"].verdict.code in (Code.NO_SIGNIFICANT_GAIN, Code.WORSE_THAN_CURRENT)
    assert verdicts["true"].current.rms_m < 3.0 * SIGMA * np.sqrt(3.0)


def test_one_pose_is_refused(arm):
    tracker = settled(arm, 5)
    with pytest.raises(TooFewSamplesError, match="one pose"):
        take(tracker, visit(cell_of(arm), postures(POSES)).take(np.array([0])))
