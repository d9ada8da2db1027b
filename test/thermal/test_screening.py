# SPDX-License-Identifier: Apache-2.0
"""Which parameters a drift needs; stationarity: white noise alarms as often as stated."""

import json
import time
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from drift_cell import postures

from robocal_ros.cell_sim import kr150
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.identification import entangled, subset_drift
from robocal_ros.thermal.reference import ColdSpots
from robocal_ros.thermal.screening import (
    LAGS,
    DriftHistory,
    Screening,
    autocorrelation,
    best_subset,
    screen,
    share_within,
    stationarity,
)

LENGTH, SERIES = 90, 20_000


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(1).standard_normal((LENGTH, SERIES))


def test_white_noise_passes_for_a_drift_once_in_twenty(white):
    """The count is whole (4.4 % at most by chance), and a short series' lags vary a little less.

    Ljung-Box is chi-square for long series; at 90 it alarms a little too often. The standard
    error of a rate of 5 % in 20 000 series is 0.15 %.
    """
    found = stationarity(white)
    assert 0.03 < np.mean(~found.by_count) < 0.05
    assert 0.045 < np.mean(~found.by_ljung_box) < 0.065
    outside = np.mean(np.abs(found.autocorrelation) > found.bound)
    assert 0.04 < outside < 0.05


def test_a_long_series_alarms_at_its_nominal_rate():
    series = np.random.default_rng(2).standard_normal((1000, 10_000))
    found = stationarity(series)
    assert np.mean(~found.by_count) == pytest.approx(0.0444, abs=0.008)
    assert np.mean(~found.by_ljung_box) == pytest.approx(0.05, abs=0.008)


def test_a_drift_is_found(white):
    """A warm-up of four sigma in an hour, a cycle every three minutes."""
    time = np.arange(LENGTH) * 180.0
    warm_up = 4.0 * (1.0 - np.exp(-time / 3600.0))
    found = stationarity(white[:, :2000] + warm_up[:, None])
    assert np.mean(~found.by_count) > 0.95
    assert np.mean(~found.by_ljung_box) > 0.95


def test_level_and_unit_do_not_matter(white):
    part = white[:, :50]
    assert autocorrelation(1e-6 * part + 3.0) == pytest.approx(autocorrelation(part), abs=1e-8)


def test_autocorrelation_as_defined(white):
    x = white[:, 0] - white[:, 0].mean()
    whole = np.correlate(x, x, mode="full")[LENGTH - 1 :]
    expected = whole[1 : LAGS + 1] / whole[0]
    assert autocorrelation(white[:, :1])[:, 0] == pytest.approx(expected, abs=1e-12)


def test_a_constant_series_is_stationary():
    found = stationarity(np.full((LENGTH, 1), 4e-5))
    assert found.by_count.all()
    assert found.by_ljung_box.all()


def test_too_short_a_series_is_refused():
    with pytest.raises(TooFewSamplesError, match="at least 21"):
        stationarity(np.zeros((20, 3)))


ARM = load_robot("kr150_r3100")
NAMES = ARM.parameters.names
LAST = {"d6_mm", "theta6_deg", "a6_mm", "alpha6_deg"}
TRUE = ("a2_mm", "d4_mm", "beta2_deg")
CYCLES, SIGMA = 90, 2e-5


def columns(names) -> tuple[int, ...]:
    return tuple(NAMES.index(name) for name in names)


def rows(q: np.ndarray, point: np.ndarray) -> np.ndarray:
    return ARM.parameter_jacobian(q, point)[:, :3].reshape(3 * len(q), -1)


def warm_up(size: dict[str, float]) -> np.ndarray:
    """Drifts (t, k) that approach their final size with a time constant of a third of the shift."""
    drift = np.zeros((CYCLES, len(NAMES)))
    rise = 1.0 - np.exp(-np.arange(CYCLES) / 30.0)
    for name, value in size.items():
        drift[:, NAMES.index(name)] = value * rise
    return drift


def history_of(drift: np.ndarray, seed: int = 0, sigma: float = SIGMA) -> DriftHistory:
    """Twenty measuring poses; the check points are told without noise."""
    rng = np.random.default_rng(seed)
    A = rows(postures(20, seed), kr150.BALL)
    q = np.array([0.0, -1.2, 1.5, 0.0, 0.0, 0.0]) + rng.uniform(-1.2, 1.2, (34, 6))
    J = rows(q, kr150.TOOL)
    noise = sigma * rng.standard_normal((len(drift), len(A)))
    return DriftHistory(NAMES, drift @ A.T + noise, A, drift @ J.T, J)


@pytest.fixture(scope="module")
def history() -> DriftHistory:
    return history_of(warm_up({"a2_mm": 3e-4, "d4_mm": 3e-4, "beta2_deg": 2e-4}))


@pytest.fixture(scope="module")
def screening(history) -> Screening:
    return screen(history, wanted=1)


def test_a_subset_without_noise_is_exact():
    drift = warm_up({name: 2e-4 for name in TRUE})
    history = history_of(drift, sigma=0.0)
    found = subset_drift(history.displacement, history.rows, columns(TRUE), NAMES)
    assert found.drift == pytest.approx(drift[:, columns(TRUE)], abs=1e-12)
    assert np.abs(history.residual(columns(TRUE))).max() < 1e-11


def test_a_subset_spreads_as_its_gain_says(history):
    """Sample deviations of 4000 cycles have a relative standard error of 1.1 %."""
    noise = SIGMA * np.random.default_rng(3).standard_normal((4000, len(history.rows)))
    found = subset_drift(noise, history.rows, range(8), NAMES)
    assert np.std(found.drift, axis=0) == pytest.approx(SIGMA * found.gain, rel=0.05)
    assert found.size == pytest.approx(np.full(8, SIGMA), rel=0.05)


def test_the_last_joint_is_refused_by_name(history):
    with pytest.raises(RankDeficientError, match="not determined") as caught:
        subset_drift(history.displacement, history.rows, range(24), NAMES)
    assert any(name in caught.value.directions[0] for name in LAST)
    members = {NAMES[c] for c in entangled(history.rows, range(24))}
    assert len(members) >= 2
    assert members <= LAST
    with pytest.raises(TooFewSamplesError, match="2 poses give 6 equations for 8"):
        subset_drift(history.displacement[:, :6], history.rows[:6], range(8), NAMES)


@pytest.mark.parametrize("removal", ["best", "classic"])
@pytest.mark.parametrize("test", ["autocorrelation", "ljung-box"])
def test_what_drifts_much_stays(history, removal, test):
    """Each of the three drifts by tens of its sigma, and alone reaches beyond 0.1 mm."""
    found = screen(history, wanted=3, removal=removal, test=test)
    assert set(found.chosen.names) == set(TRUE)
    assert found.chosen.share == 1.0
    assert found.uncompensated < 0.8


def test_every_round_is_told(screening):
    assert [len(r.names) for r in screening.rounds] == list(range(24, 0, -1))
    for now, then in zip(screening.rounds, screening.rounds[1:], strict=False):
        assert now.removed in now.candidates
        assert set(now.names) - {now.removed} == set(then.names)
        assert set(now.stationary) <= set(now.names)
    assert screening.chosen.removed is None
    table = json.loads(json.dumps(screening.rows()))
    assert table[0]["share"] is None
    assert [row["parameters"] for row in table] == list(range(24, 0, -1))


def test_the_first_round_is_not_a_guess(screening):
    """All 24 cannot be told apart: no share, and the four of the last joint are candidates."""
    first, second = screening.rounds[:2]
    assert first.share is None
    assert set(first.candidates) <= LAST
    assert "not determined" in first.note
    assert second.share is not None
    assert not second.undetermined


def test_the_highest_share_has_the_fewest_parameters(screening):
    top = max(r.share for r in screening.rounds if r.share is not None)
    assert screening.highest.share == top
    assert len(screening.highest.names) == min(
        len(r.names) for r in screening.rounds if r.share == top
    )


def test_shares_are_those_of_fresh_fits(history, screening):
    for r in screening.rounds[1:]:
        own = columns(r.names)
        X = np.linalg.lstsq(history.rows[:, own], history.displacement.T, rcond=None)[0]
        left = history.check - (history.check_rows[:, own] @ X).T
        assert r.share == pytest.approx(np.mean(np.abs(left) < 1e-4), abs=1e-12)


def test_best_removes_what_leaves_the_highest_share(history):
    found = screen(history, wanted=20)
    for r, then in zip(found.rounds, found.rounds[1:], strict=False):
        others = [columns(set(r.names) - {name}) for name in r.candidates]
        shares = [share_within(history.residual(c)) for c in others if not entangled_in(history, c)]
        assert then.share == max(shares)


def entangled_in(history: DriftHistory, chosen: tuple[int, ...]) -> bool:
    return bool(entangled(history.rows, chosen))


def test_classic_takes_the_first_that_does_not_lower_the_share(history):
    found = screen(history, wanted=12, removal="classic")
    assert found.rounds[0].removed == "theta6_deg"  # the angles come first, as in the source
    kinds = ("theta", "alpha", "d", "a", "beta")
    for r in found.rounds[1:-1]:
        order = sorted(
            r.candidates, key=lambda n: (kinds.index(n.split("_")[0][:-1]), columns([n]))
        )
        shares = [share_within(history.residual(columns(set(r.names) - {n}))) for n in order]
        good = [n for n, share in zip(order, shares, strict=True) if share >= r.share]
        assert r.removed == (good[0] if good else order[int(np.argmax(shares))])


def test_without_a_stationary_series_all_are_candidates():
    """Every parameter drifts by many sigma; one of the last joint's is given up for the others."""
    rng = np.random.default_rng(4)
    size = {n: float(v) for n, v in zip(NAMES, 3e-3 * rng.uniform(0.5, 1.0, 24), strict=True)}
    found = screen(history_of(warm_up(size), sigma=1e-7), wanted=21)
    assert [r.stationary for r in found.rounds] == [()] * 4
    assert all(set(r.candidates) == set(r.names) for r in found.rounds[1:])
    assert found.rounds[1].note == "no parameter is stationary: all are candidates"


def test_a_round_takes_the_smaller_drift_where_shares_are_equal(history):
    """Beyond any threshold all shares are 1, and only the sizes decide."""
    found = screen(history, wanted=22, threshold_m=1.0)
    r = found.rounds[1]
    fit = subset_drift(history.displacement, history.rows, columns(r.names), NAMES)
    size = dict(zip(r.names, fit.size, strict=True))
    assert r.removed == min(r.candidates, key=lambda name: size[name])


def test_ninety_cycles_of_twenty_poses_are_screened_in_a_second(history):
    start = time.perf_counter()
    screen(history, wanted=1)
    assert time.perf_counter() - start < 2.0  # 0.05 s alone on a desktop


def test_a_share_counts_each_axis_of_each_cycle():
    residual = np.array([[0.99e-4, -0.99e-4, 1.01e-4], [-1.01e-4, 0.0, 0.0]])
    assert share_within(residual) == pytest.approx(4.0 / 6.0)


def test_units_of_check_frames_do_not_matter(history):
    """Turned check axes leave the fits alone; the sum of squares at the check points too."""
    R = np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))[0]
    turn = np.kron(np.eye(34), R)
    turned = replace(history, check=history.check @ turn.T, check_rows=turn @ history.check_rows)
    before, after = (np.sum(h.residual(columns(TRUE[:2])) ** 2) for h in (history, turned))
    assert after == pytest.approx(before)


def test_too_few_poses_and_cycles_are_refused(history):
    few = replace(history, displacement=history.displacement[:, :21], rows=history.rows[:21])
    with pytest.raises(TooFewSamplesError, match="7 poses give 21 equations for 24"):
        screen(few)
    short = replace(history, displacement=history.displacement[:9], check=history.check[:9])
    with pytest.raises(TooFewSamplesError, match="at least 21"):
        screen(short)
    with pytest.raises(ValueError, match="wanted must be 1 to 24"):
        screen(history, wanted=0)


def test_mallows_best_subset_is_the_best_of_all(history):
    """Against a plain search through all of three out of eleven, two of them entangled."""
    some = columns([*TRUE, *sorted(LAST), "a1_mm", "theta1_deg", "d5_mm", "a4_mm"])
    part = replace(
        history,
        names=tuple(NAMES[c] for c in some),
        rows=history.rows[:, some],
        check_rows=history.check_rows[:, some],
    )
    for size in (2, 5):
        found = best_subset(part, size)
        rss = {}
        for chosen in combinations(range(11), size):
            X = np.linalg.lstsq(part.rows[:, chosen], part.displacement.T, rcond=None)[0]
            rss[chosen] = np.sum((part.displacement.T - part.rows[:, chosen] @ X) ** 2)
        # entangled ones can be the same to the last bits: then either is the best
        named = {tuple(part.names[c] for c in chosen): value for chosen, value in rss.items()}
        assert named[found.names] <= min(rss.values()) * (1.0 + 1e-9)


def test_mallows_cp_of_an_unbiased_subset_is_its_size(history):
    """C_p - p has a standard error of about sqrt(2 * 20 * 90) / 90 = 0.7 per cycle."""
    found = best_subset(history, 3)
    assert set(found.names) == set(TRUE)
    assert abs(found.cp - 3.0) < 2.5
    assert best_subset(history, 2).cp > 20.0
    assert best_subset(history, 23).cp == pytest.approx(23.0)
    with pytest.raises(ValueError, match="size must be 1 to the 23"):
        best_subset(history, 24)


def test_a_history_is_collected_from_recorded_cycles(make_cell):
    """Spots and check poses seen by the same sensor; an incomplete cycle is left out."""
    rng, robot, q = np.random.default_rng(6), make_cell(), postures(24, 2)
    drift = warm_up({"a2_mm": 3e-4, "beta2_deg": 1e-4})[::4]
    spots = ColdSpots.of(robot.truth, robot.measure(q, rng))
    arm, cycles = robot.truth.arm, []
    for x in drift:
        warm = replace(robot.truth, arm=arm.with_mdh(arm.parameters.add(arm.mdh, x)))
        cycles.append(replace(robot, truth=warm).measure(q, rng, noise_m=SIGMA))
    seen, told = np.arange(18), np.arange(18, 24)
    history = DriftHistory.of(
        spots,
        [c.take(rng.permutation(seen)) for c in cycles[:-1]] + [cycles[-1].take(seen[1:])],
        [c.take(told) for c in cycles],
    )
    assert history.displacement.shape == (len(cycles) - 1, 54)
    exact = drift[:-1] @ history.check_rows.T
    assert np.std(history.check - exact) == pytest.approx(SIGMA, rel=0.1)
    assert np.std(history.displacement - drift[:-1] @ history.rows.T) == pytest.approx(
        SIGMA, rel=0.1
    )
    with pytest.raises(InputError, match="cannot judge"):
        DriftHistory.of(spots, cycles, cycles)
    with pytest.raises(TooFewSamplesError, match="5 of 5 cycles"):
        DriftHistory.of(
            spots, [c.take(seen) for c in cycles[:5]], [c.take(told) for c in cycles[:5]]
        )
