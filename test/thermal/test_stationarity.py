"""Stationarity: white noise alarms as often as stated, a drift is found."""

import numpy as np
import pytest

from robocal_ros.ground.errors import TooFewSamplesError
from robocal_ros.thermal.screening import LAGS, autocorrelation, stationarity

CYCLES, SERIES = 90, 20_000


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(1).standard_normal((CYCLES, SERIES))


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
    time = np.arange(CYCLES) * 180.0
    warm_up = 4.0 * (1.0 - np.exp(-time / 3600.0))
    found = stationarity(white[:, :2000] + warm_up[:, None])
    assert np.mean(~found.by_count) > 0.95
    assert np.mean(~found.by_ljung_box) > 0.95


def test_level_and_unit_do_not_matter(white):
    part = white[:, :50]
    assert autocorrelation(1e-6 * part + 3.0) == pytest.approx(autocorrelation(part), abs=1e-8)


def test_autocorrelation_as_defined(white):
    x = white[:, 0] - white[:, 0].mean()
    whole = np.correlate(x, x, mode="full")[CYCLES - 1 :]
    expected = whole[1 : LAGS + 1] / whole[0]
    assert autocorrelation(white[:, :1])[:, 0] == pytest.approx(expected, abs=1e-12)


def test_a_constant_series_is_stationary():
    found = stationarity(np.full((CYCLES, 1), 4e-5))
    assert found.by_count.all()
    assert found.by_ljung_box.all()


def test_too_short_a_series_is_refused():
    with pytest.raises(TooFewSamplesError, match="at least 21"):
        stationarity(np.zeros((20, 3)))
