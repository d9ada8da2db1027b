"""Bent tool or knocked station? Wrong as often as is said, and never by more than is said."""

import numpy as np
import pytest

from robocal_ros.ground.errors import InputError
from robocal_ros.tool.judging import SMALL_M, BendRule, Witness, bend_or_station

RULE = BendRule(nearest_m=0.055, farthest_m=0.15)
TIP_M, TILT_RAD = 3.5e-5, np.radians(0.06)  # scatter in each direction of the change of two runs
COVARIANCE = np.diag(np.square([TIP_M, TIP_M, TIP_M, TILT_RAD, TILT_RAD]))
TRIALS = 4000


def directions(rng: np.random.Generator, dimensions: int) -> np.ndarray:
    drawn = rng.standard_normal((TRIALS, dimensions))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1)[:, None])


def told(changes: np.ndarray, seed: int) -> list[Witness]:
    noise = np.random.default_rng(seed).standard_normal(changes.shape) @ np.sqrt(COVARIANCE)
    return [
        bend_or_station(change, COVARIANCE, RULE, float(np.linalg.norm(change[:3])))
        for change in changes + noise
    ]


@pytest.mark.parametrize("shift_mm", [0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0])
def test_what_a_knocked_station_shows_is_not_accepted_as_a_bend(shift_mm):
    """In all directions; what is accepted as too small to matter is no larger than is said."""
    rng = np.random.default_rng(1)
    changes = np.hstack([1e-3 * shift_mm * directions(rng, 3), np.zeros((TRIALS, 2))])
    accepted = [one.tip_m for one in told(changes, 2) if one.cause == "tool"]
    beyond = sum(tip_m > SMALL_M for tip_m in accepted)
    allowed = 1e-3 * TRIALS
    assert beyond <= allowed + 3.0 * np.sqrt(allowed)


@pytest.mark.parametrize("shift_mm", [0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 2.0])
@pytest.mark.parametrize("lever_m", [0.055, 0.1, 0.15])
def test_a_true_bend_is_rarely_the_stations(shift_mm, lever_m):
    way = directions(np.random.default_rng(3), 2)
    sideways = 1e-3 * shift_mm * way
    changes = np.hstack([sideways, np.zeros((TRIALS, 1)), sideways / lever_m])
    causes = [one.cause for one in told(changes, 4)]
    assert causes.count("station") <= 0.01 * TRIALS + 3.0 * np.sqrt(0.01 * TRIALS)
    if shift_mm >= 0.8:
        assert causes.count("tool") >= 0.9 * TRIALS  # that some of them wait is the price


def test_a_large_knock_sideways_is_the_stations():
    way = directions(np.random.default_rng(5), 2)
    changes = np.hstack([1.2e-3 * way, np.zeros((TRIALS, 3))])
    assert [one.cause for one in told(changes, 6)].count("station") >= 0.99 * TRIALS


@pytest.mark.parametrize(
    ("change_mm", "tilt_mrad", "cause"),
    [
        ([0.08, 0.0, 0.0], [0.0, 0.0], "tool"),  # too small to matter
        ([0.0, 0.0, 0.8], [0.0, 0.0], "doubt"),  # along the axis: pushed in, or a lower station
        ([0.8, 0.0, 0.0], [8.0, 0.0], "tool"),
        ([0.8, 0.0, 0.0], [-8.0, 0.0], "station"),  # tilted the other way
        ([0.8, 0.0, 0.0], [0.0, 8.0], "station"),
        ([0.8, 0.0, 0.9], [8.0, 0.0], "doubt"),
        ([0.3, 0.0, 0.0], [2.0, 0.0], "doubt"),
    ],
)
def test_what_each_change_says(change_mm, tilt_mrad, cause):
    change = np.append(1e-3 * np.array(change_mm), 1e-3 * np.array(tilt_mrad))
    small_m = float(np.linalg.norm(change[:3]))
    found = bend_or_station(change, COVARIANCE, RULE, small_m)
    assert found.cause == cause, found.reason


def test_small_changes_do_not_add_up():
    change = np.array([8e-5, 0.0, 0.0, 0.0, 0.0])
    assert bend_or_station(change, COVARIANCE, RULE, 8e-5).cause == "tool"
    assert bend_or_station(change, COVARIANCE, RULE, 1.6e-4).cause == "doubt"


def test_a_lever_below_the_upper_circle_is_refused():
    with pytest.raises(InputError, match="cannot bend between 55 and 30 mm"):
        BendRule(0.055, 0.03)
