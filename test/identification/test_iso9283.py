# SPDX-License-Identifier: Apache-2.0
"""AP and RP against values counted by hand and against what statistics expects."""

import numpy as np
import pytest

from robocal_ros.ground.errors import TooFewSamplesError
from robocal_ros.ground.frames import exp_rotation
from robocal_ros.identification.judged import repeated

# Barycentre 0; distances 1, 1, 2, 2 mm: mean 1.5, S = sqrt(4 * 0.5**2 / 3).
CROSS = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, -2.0, 0.0]]) * 1e-3
S = np.sqrt(1.0 / 3.0) * 1e-3


def test_a_cross_counted_by_hand():
    found = repeated(CROSS + np.array([3e-3, 4e-3, -12e-3]), np.zeros(3))
    np.testing.assert_allclose(found.barycentre, [3e-3, 4e-3, -12e-3])
    assert found.mean_distance_m == pytest.approx(1.5e-3)
    assert found.S_m == pytest.approx(S)
    assert found.RP_m == pytest.approx(1.5e-3 + 3.0 * S)
    assert found.AP_m == pytest.approx(13e-3)  # 3, 4, 12: a Pythagorean box
    np.testing.assert_allclose(found.offset, [3e-3, 4e-3, -12e-3])


def test_without_a_commanded_position_there_is_no_accuracy():
    found = repeated(CROSS)
    assert found.AP_m is None
    assert found.offset is None
    assert found.RP_m == pytest.approx(1.5e-3 + 3.0 * S)


def test_isotropic_noise_gives_what_statistics_expects():
    """Distances of a normal cloud follow Maxwell: mean s sqrt(8/pi), variance s^2 (3 - 8/pi).

    The standard deviation of RP is at most (1 + 3 sqrt((kurtosis - 1)/4)) S / sqrt(n), with the
    kurtosis 3.108 of Maxwell's distribution.
    """
    sigma_m, n = 2e-5, 40_000
    position = sigma_m * np.random.default_rng(4).standard_normal((n, 3))
    found = repeated(position, np.zeros(3))
    mean = sigma_m * np.sqrt(8.0 / np.pi)
    spread = sigma_m * np.sqrt(3.0 - 8.0 / np.pi)
    deviation = spread * (1.0 + 3.0 * np.sqrt(2.108 / 4.0)) / np.sqrt(n)
    assert found.mean_distance_m == pytest.approx(mean, abs=4.0 * spread / np.sqrt(n))
    assert found.RP_m == pytest.approx(mean + 3.0 * spread, abs=4.0 * deviation)
    assert found.AP_m < 5.0 * sigma_m / np.sqrt(n)


def test_where_the_frame_stands_does_not_matter():
    rng = np.random.default_rng(1)
    position, commanded = 1e-4 * rng.standard_normal((30, 3)), 1e-3 * rng.standard_normal(3)
    R, t = exp_rotation(np.array([0.4, -1.1, 2.0])), np.array([2.0, -1.0, 0.5])
    here = repeated(position, commanded)
    there = repeated(position @ R.T + t, R @ commanded + t)
    assert there.RP_m == pytest.approx(here.RP_m, rel=1e-9)
    assert there.AP_m == pytest.approx(here.AP_m, rel=1e-9)
    np.testing.assert_allclose(there.offset, R @ here.offset, atol=1e-14)


def test_positions_that_are_all_equal_repeat_perfectly():
    found = repeated(np.tile([1.234567, -0.7, 0.1], (5, 1)))
    assert found.RP_m < 1e-15


@pytest.mark.parametrize("n", [0, 1])
def test_one_position_shows_no_repeatability(n):
    with pytest.raises(TooFewSamplesError, match=f"{n} position"):
        repeated(np.zeros((n, 3)))
