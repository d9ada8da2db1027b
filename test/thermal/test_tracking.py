# SPDX-License-Identifier: Apache-2.0
"""The tracker: exact where it must be, honest where it cannot be, on simulated drift."""

import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from drift_cell import SIGMA, cell_of, drifted, postures, visit

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, StaleError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import CellModel
from robocal_ros.thermal.identification import drift_prior
from robocal_ros.thermal.reference import ColdSpots
from robocal_ros.thermal.tracking import (
    DriftProcess,
    DriftTracker,
    Heat,
    HeatGains,
    joints_of,
    track_cycle,
)

PERIOD_S = 300.0


def sample_path(process: DriftProcess, count: int, rng: np.random.Generator) -> np.ndarray:
    """Drifts (count, k) drawn from the process, from a cold start, every five minutes."""
    k = len(process.covariance)
    root = np.linalg.cholesky(process.covariance)
    state = np.stack([np.zeros(k), root @ rng.standard_normal(k)])
    F, noise = process.transition(PERIOD_S)
    step = np.linalg.cholesky(noise)
    path = []
    for _ in range(count):
        state = F @ state + step @ rng.standard_normal((2, k)) @ root.T
        path.append(state[0])
    return np.array(path)


def test_the_process_approaches_what_it_should():
    """Stepping twice is stepping once; small steps follow the differential equation."""
    process = DriftProcess(np.eye(1), 1800.0, 9000.0)
    F1, Q1 = process.transition(100.0)
    F2, Q2 = process.transition(200.0)
    assert pytest.approx(F2, rel=1e-12, abs=1e-12) == F1 @ F1
    assert pytest.approx(Q2, rel=1e-9) == F1 @ Q1 @ F1.T + Q1
    far, all_noise = process.transition(1e6)
    assert np.abs(far).max() < 1e-12
    assert all_noise[1, 1] == pytest.approx(1.0)
    # var x = cov(x, u) = steady / (steady + approach): d/dt E[x u] = 0 and d/dt E[x^2] = 0
    assert all_noise[0] == pytest.approx([9000.0 / 10800.0] * 2)
    step, noise = process.transition(0.1)
    assert (step - np.eye(2)) / 0.1 == pytest.approx(
        np.array([[-1.0 / 1800.0, 1.0 / 1800.0], [0.0, -1.0 / 9000.0]]), rel=1e-3, abs=1e-9
    )
    assert noise[1, 1] / 0.1 == pytest.approx(2.0 / 9000.0, rel=1e-3)


def test_errors_and_innovations_are_what_the_filter_says(arm):
    """Drifts drawn from the process itself: normalised squares are chi-square."""
    cell, q = cell_of(arm), postures(6)
    process = replace(DriftProcess(0.1 * drift_prior(arm)), setup_sigma_m=1e-9)
    error2, innovation2, freedom, lag = 0.0, 0.0, 0, []
    runs, cycles, k = 40, 12, len(arm.parameters)
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        tracker = DriftTracker(ColdSpots.of(cell, visit(cell, q, rng)), process, SIGMA)
        before = None
        for i, drift in enumerate(sample_path(process, cycles, rng)):
            warm = visit(drifted(cell, drift), q, rng)
            found = tracker.take(warm, PERIOD_S * (i + 1))
            assert found.applied
            innovation2 += found.squared
            freedom += found.freedom
            lag += [] if before is None else [before * (found.squared - found.freedom)]
            before = found.squared - found.freedom
        mean, covariance = tracker.drift(PERIOD_S * cycles)
        miss = mean - drift
        error2 += float(miss @ np.linalg.solve(covariance, miss))
    assert error2 == pytest.approx(runs * k, abs=4.0 * np.sqrt(2.0 * runs * k))
    assert innovation2 == pytest.approx(freedom, abs=4.0 * np.sqrt(2.0 * freedom))
    assert abs(np.mean(lag)) < 4.0 * np.std(lag) / np.sqrt(len(lag))


def test_a_constant_drift_is_found_and_kept(arm):
    """Fifty cycles of the same drift: the answer converges and does not ratchet."""
    cell, q = cell_of(arm), postures(10)
    process = DriftProcess(drift_prior(arm))
    drift = np.random.default_rng(3).standard_normal(len(arm.parameters)) * np.sqrt(
        np.diag(drift_prior(arm))
    )
    tracker = DriftTracker(ColdSpots.of(cell, visit(cell, q)), process, SIGMA)
    warm = visit(drifted(cell, drift), q)
    check = postures(30, 9)
    true = visit(drifted(cell, drift), check).position
    errors = []
    for i in range(50):
        tracker.take(warm, PERIOD_S * (i + 1))
        mean, _ = tracker.drift(PERIOD_S * (i + 1))
        there = visit(drifted(cell, mean), check).position
        errors.append(np.sqrt(np.mean((there - true) ** 2)))
    assert errors[-1] < SIGMA
    assert max(errors[5:]) <= 1.05 * errors[5]


def test_one_wrong_sample_is_left_out_and_named(arm):
    cell, q, rng = cell_of(arm), postures(8), np.random.default_rng(1)
    tracker = DriftTracker(
        ColdSpots.of(cell, visit(cell, q, rng)), DriftProcess(drift_prior(arm)), SIGMA
    )
    clean = DriftTracker(tracker.spots, tracker.process, SIGMA)
    warm = visit(cell, q, rng)
    clean.take(warm.take(np.arange(8) != 5), PERIOD_S)
    warm.position[5, 0] += 1e-3
    found = tracker.take(warm, PERIOD_S)
    assert found.applied
    assert np.flatnonzero(~found.kept).tolist() == [5]
    assert tracker.state.mean == pytest.approx(clean.state.mean, abs=1e-12)


def test_a_knocked_sensor_is_not_taken_for_drift(arm):
    cell, q, rng = cell_of(arm), postures(8), np.random.default_rng(2)
    tracker = DriftTracker(
        ColdSpots.of(cell, visit(cell, q, rng)), DriftProcess(0.1 * drift_prior(arm)), SIGMA
    )
    for i in range(5):
        assert tracker.take(visit(cell, q, rng), PERIOD_S * (i + 1)).applied
    before = tracker.state
    turned = frames.transform(frames.exp_rotation([0.0, 2e-3, 0.0]), [5e-4, 0.0, 0.0])
    knocked = replace(cell, T_frame_base=turned @ cell.T_frame_base)
    found = tracker.take(visit(knocked, q, rng), PERIOD_S * 6)
    assert not found.applied
    assert tracker.state is before


def three_rounds(cell: CellModel, q: np.ndarray) -> Measurements:
    rng = np.random.default_rng(4)
    rounds = [visit(cell, q, rng) for _ in range(3)]
    return Measurements(
        q=np.vstack([data.q for data in rounds]),
        position=np.vstack([data.position for data in rounds]),
        target=("ball",) * 3 * len(q),
        sample=tuple(str(i) for i in range(3 * len(q))),
    )


def test_cold_visits_that_all_contradict_each_other_are_still_visits(arm):
    """Of a pose that scatters by a millimetre no round lies at the median in all axes."""
    cell, q = cell_of(arm), postures(6)
    cold = three_rounds(cell, q)
    cold.position[2::6] += 1e-3 * np.array([[0, 1, -1], [1, -1, 0], [-1, 0, 1]])
    spots = ColdSpots.of(cell, cold)
    assert np.delete(spots.visits, spots.match(cold)[2]).tolist() == [3] * 5
    assert spots.visits.min() >= 2
    assert spots.q[spots.match(cold)] == pytest.approx(cold.q)


def test_wrong_cold_visits_are_outvoted(arm):
    cell = cell_of(arm)
    cold = three_rounds(cell, postures(6))
    cold.position[7] += [1e-3, 0.0, 0.0]
    spots = ColdSpots.of(cell, cold)
    assert spots.rejected == ("7",)
    assert sorted(spots.visits.tolist()) == [2, 3, 3, 3, 3, 3]
    assert np.abs(spots.error).max() < 4.0 * SIGMA


def test_cycles_come_in_order_and_from_known_poses(arm):
    cell, q = cell_of(arm), postures(6)
    tracker = DriftTracker(
        ColdSpots.of(cell, visit(cell, q)), DriftProcess(drift_prior(arm)), SIGMA
    )
    tracker.take(visit(cell, q), 600.0)
    with pytest.raises(StaleError, match="300 s before the last cycle"):
        tracker.take(visit(cell, q), 300.0)
    with pytest.raises(InputError, match="not measured in the cold reference"):
        tracker.take(visit(cell, postures(6, 5)), 900.0)


def test_moving_the_sensor_changes_nothing(arm):
    """The same robot seen from elsewhere drifts the same."""
    q, rng = postures(6), np.random.default_rng(5)
    here = cell_of(arm)
    move = frames.transform(frames.exp_rotation([0.4, -0.2, 1.0]), [0.3, 2.0, -1.0])
    there = replace(here, T_frame_base=move @ here.T_frame_base)
    process, answers = DriftProcess(drift_prior(arm)), []
    warm = drifted(here, 1e-5 * np.ones(len(arm.parameters)))
    cold, late = visit(here, q, rng), visit(warm, q, rng)
    for cell, M in ((here, np.eye(4)), (there, move)):
        moved = [replace(d, position=d.position @ M[:3, :3].T + M[:3, 3]) for d in (cold, late)]
        tracker = DriftTracker(ColdSpots.of(cell, moved[0]), process, SIGMA)
        tracker.take(moved[1], PERIOD_S)
        answers.append(tracker.drift(PERIOD_S)[0])
    assert answers[1] == pytest.approx(answers[0], abs=1e-9)


def lagged(motor: np.ndarray, lag_s: float, parts: int = 500) -> np.ndarray:
    """First-order lag (t, n) of temperatures read every five minutes, in many small steps."""
    course = np.vstack([np.zeros(motor.shape[1]), motor])
    value, found = np.zeros(motor.shape[1]), []
    for before, after in pairwise(course):
        for part in range(parts):
            now = before + (after - before) * (part + 0.5) / parts
            value = value + (now - value) * PERIOD_S / parts / lag_s
        found.append(value)
    return np.array(found)


def test_lagged_temperatures_follow_the_straight_course_between_readings():
    motor = 20.0 * np.random.default_rng(6).uniform(size=(5, 6))
    heat = Heat.cold(6, 1200.0)
    for i, (row, expected) in enumerate(zip(motor, lagged(motor, 1200.0), strict=True)):
        heat = heat.read(row, PERIOD_S * (i + 1))
        # midpoint steps of 0.6 s: (0.6/1200)^2 / 24 of 20 K and less
        assert heat.lagged == pytest.approx(expected, abs=1e-2)
    assert heat.held(1e6).lagged == pytest.approx(motor[-1])
    assert heat.held(0.0) is heat


def test_with_temperatures_errors_are_what_the_filter_says(arm):
    """Gains drawn from their prior, every parameter moved by its own joint's motors."""
    cell, q, k = cell_of(arm), postures(6), len(arm.parameters)
    process = DriftProcess(1e-4 * drift_prior(arm), setup_sigma_m=1e-9)
    gains = HeatGains.expected(arm, 3600.0, 1.0, 0.5)
    motor = 25.0 * (1.0 - np.exp(-np.arange(1, 9)[:, None] / np.linspace(4.0, 9.0, 6)))
    behind = lagged(motor, 3600.0)
    joint = np.array([index for index, _ in arm.parameters.index])
    following = np.column_stack([behind[:, 1:], np.zeros(len(behind))])
    runs, error2, innovation2, freedom, sums = 40, 0.0, 0.0, 0, np.zeros(2)
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        own = (np.sqrt(np.diag(gains.covariance)) * rng.standard_normal(3 * k)).reshape(k, 3)
        spots = ColdSpots.of(cell, visit(cell, q, rng))
        tracker = DriftTracker(spots, process, SIGMA, gains=gains)
        plain = DriftTracker(spots, DriftProcess(drift_prior(arm)), SIGMA)
        rest = sample_path(process, len(motor), rng)
        for i in range(len(motor)):
            at_s = PERIOD_S * (i + 1)
            sources = np.column_stack([motor[i], behind[i], following[i]])[joint]
            drift = np.sum(own * sources, axis=1) + rest[i]
            warm = visit(drifted(cell, drift), q, rng)
            tracker.read_temperatures(motor[i], at_s)
            found = tracker.take(warm, at_s)
            plain.take(warm, at_s)
            innovation2, freedom = innovation2 + found.squared, freedom + found.freedom
        mean, covariance = tracker.drift(at_s)
        error2 += float((mean - drift) @ np.linalg.solve(covariance, mean - drift))
        scale = np.diag(drift_prior(arm))
        sums += [np.sum((x - drift) ** 2 / scale) for x in (mean, plain.drift(at_s)[0])]
    assert error2 == pytest.approx(runs * k, abs=4.0 * np.sqrt(2.0 * runs * k))
    assert innovation2 == pytest.approx(freedom, abs=4.0 * np.sqrt(2.0 * freedom))
    assert sums[0] < sums[1]


def test_temperatures_that_cannot_be_used_are_refused(arm):
    cell, q = cell_of(arm), postures(6)
    spots, process = ColdSpots.of(cell, visit(cell, q)), DriftProcess(drift_prior(arm))
    with pytest.raises(InputError, match="no gains"):
        DriftTracker(spots, process, SIGMA).read_temperatures(np.zeros(6), 60.0)
    gains = HeatGains.expected(arm, 3600.0, 1.0, 1.0)
    tracker = DriftTracker(spots, process, SIGMA, gains=gains)
    for wrong in (np.zeros(5), np.full(6, np.nan)):
        with pytest.raises(InputError, match="6 numbers, one per joint"):
            tracker.read_temperatures(wrong, 60.0)
    tracker.read_temperatures(np.ones(6), 60.0)
    with pytest.raises(InputError, match="older than the last"):
        tracker.read_temperatures(np.ones(6), 30.0)


def test_temperatures_no_longer_read_are_held_with_a_growing_doubt(arm):
    """Known gains, hardly any process: what is in doubt is the motors' 20 K, times the gain."""
    cell, q, k = cell_of(arm), postures(6), len(arm.parameters)
    known = np.zeros((k, 3))
    known[:, 0] = np.sqrt(np.diag(drift_prior(arm))) / 20.0
    gains = HeatGains(known.ravel(), 1e-30 * np.eye(3 * k), 3600.0)
    process = DriftProcess(1e-12 * drift_prior(arm))
    spots = ColdSpots.of(cell, visit(cell, q))
    tracker = DriftTracker(spots, process, SIGMA, gains=gains)
    tracker.read_temperatures(np.full(6, 10.0), 60.0)
    for silent_s, doubt_k in ((0.0, 0.0), (3600.0, 20.0 * (1.0 - np.exp(-1.0))), (1e6, 20.0)):
        mean, covariance = tracker.drift(60.0 + silent_s)
        assert mean == pytest.approx(10.0 * known[:, 0])
        sigma = np.sqrt(np.diag(covariance))
        assert sigma == pytest.approx(doubt_k * known[:, 0], rel=1e-3, abs=1e-8)


def ten_kelvin(arm):
    """A tracker that knows what motors do, and a visit after they warmed by so much."""
    cell, q, k = cell_of(arm), postures(6), len(arm.parameters)
    known = np.zeros((k, 3))
    known[:, 0] = np.sqrt(np.diag(drift_prior(arm))) / 20.0
    gains = HeatGains(known.ravel(), 1e-30 * np.eye(3 * k), 3600.0)
    process = DriftProcess(1e-6 * drift_prior(arm))
    tracker = DriftTracker(ColdSpots.of(cell, visit(cell, q)), process, SIGMA, gains=gains)
    return tracker, visit(drifted(cell, 10.0 * known[:, 0]), q)


def test_a_warming_that_nobody_read_is_no_step(arm):
    """Ten kelvin unread for an hour: taken; read as none: refused."""
    for silent in (True, False):
        tracker, warm = ten_kelvin(arm)
        tracker.read_temperatures(np.zeros(6), 60.0 if silent else 3660.0)
        assert tracker.take(warm, 3660.0).applied == silent
        assert np.trace(tracker.expected_drift()) > 1e-4 * np.trace(drift_prior(arm))


def test_a_warming_that_nobody_read_is_in_the_figures(arm):
    """No model follows it: at poses left out both are off by it, as they are everywhere."""
    tracker, warm = ten_kelvin(arm)
    tracker.read_temperatures(np.zeros(6), 60.0)
    found = track_cycle(tracker, warm, 3660.0, in_force=arm)
    moved = np.sqrt(np.mean(np.sum(tracker.spots.drift(warm) ** 2, axis=1)))
    assert moved > 5.0 * SIGMA
    for error in (found.judged.current, found.judged.candidate):
        assert error.rms_m == pytest.approx(moved, rel=0.2)
    told = np.sqrt(np.mean(found.found.left_out_sigma**2))
    assert 0.5 * moved < told < 4.0 * moved  # of twice as many kelvin, in each motor alone


@pytest.mark.parametrize("silent_h", [0.25, 2.0, 6.0])
def test_links_that_lag_stay_within_the_bound_while_motors_are_silent(arm, silent_h):
    """Motors warm or cool unread, links follow them and their next motors with the lag.

    The courses are drawn as the doubt has them: towards a normal 20 K, within an hour. 95 % of the
    parameters' errors lie in 1.96 sigmas, less four standard errors of 200 runs of six motors; a
    cycle afterwards is no step.
    """
    cell, k, n = cell_of(arm), len(arm.parameters), 6
    rng = np.random.default_rng(8)
    size = np.where(arm.parameters.is_length, 12e-6, 1e-5)[:, None]
    known = size * rng.uniform(0.2, 1.0, (k, 3))  # all follow motors: directly, and with the lag
    gains = HeatGains(known.ravel(), 1e-30 * np.eye(3 * k), 3600.0)
    spots = ColdSpots.of(cell, visit(cell, postures(6)))
    process = DriftProcess(1e-18 * np.eye(k))
    tracker = DriftTracker(spots, process, SIGMA, gains=gains)
    joint = joints_of(arm)
    warm = Heat.cold(n, 3600.0)
    for time_s in np.arange(PERIOD_S, 7200.0 + PERIOD_S, PERIOD_S):
        warm = warm.read(np.full(n, 15.0), time_s)
        tracker.read_temperatures(warm.motor, time_s)
    end_s = 7200.0 + 3600.0 * silent_h
    expected, covariance = tracker.drift(end_s)
    inside, applied = [], 0
    for _ in range(200):
        swing, heat = 20.0 * rng.standard_normal(n), warm
        for time_s in np.linspace(7200.0, end_s, 100)[1:]:
            gone = 1.0 - np.exp(-(time_s - 7200.0) / 3600.0)
            heat = heat.read(warm.motor + gone * swing, time_s)
        true = heat.rows(joint) @ known.ravel()
        inside.append(np.abs(true - expected) < 1.96 * np.sqrt(np.diag(covariance)))
        found = tracker._examine(visit(drifted(cell, true), postures(6), rng), end_s)[0]
        applied += found.applied
    assert np.mean(inside) > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / (200 * n))
    assert np.mean(inside) < 0.99  # and the bound is no wider than it need be
    assert applied >= 198


def test_a_process_that_forgets_too_soon_is_refused(arm):
    with pytest.raises(InputError, match="shorter than"):
        DriftProcess(drift_prior(arm), approach_s=3600.0, steady_s=3600.0)


@pytest.mark.long
def test_a_week_of_cycles_takes_no_more_room_than_one(arm):
    """Every three minutes for a week: the state keeps its size, and stays a covariance."""
    cell, q, rng = cell_of(arm), postures(6), np.random.default_rng(7)
    gains = HeatGains.expected(arm, 3600.0, 1.0, 1.0)
    spots = ColdSpots.of(cell, visit(cell, q, rng))
    tracker = DriftTracker(spots, DriftProcess(drift_prior(arm)), SIGMA, gains=gains)
    rounds = [visit(cell, q, rng) for _ in range(20)]

    def week(first: int, last: int) -> int:
        for i in range(first, last):
            tracker.read_temperatures(rng.normal(20.0, 1.0, 6), 180.0 * i)
            assert tracker.take(rounds[i % 20], 180.0 * i).applied
        return len(pickle.dumps(tracker))

    after_one = week(1, 2)
    assert week(2, 7 * 24 * 20 + 1) <= after_one + 64  # larger integers
    assert after_one < 400_000
    assert np.linalg.eigvalsh(tracker.state.covariance).min() > -1e-18
