# SPDX-License-Identifier: Apache-2.0
"""The sensor's own linearity is found from profiles, taken out, and told in um."""

import json
from dataclasses import replace

import numpy as np
import pytest
from long_form import amount, more
from scipy.stats import chi2

from bench.hand_eye_cell import HandEyeCell, PoseRobot
from bench.hand_eye_worlds import (
    RADIUS_M,
    SETTINGS,
    X,
    edge_set,
    sphere_set,
    squared_error,
    step_world,
)
from robocal_ros.cell_sim.sensors import ProfileSensor
from robocal_ros.ground import frames
from robocal_ros.hand_eye.linearity import SeenLine, SensorLinearity, fit_linearity
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.result import increment
from robocal_ros.hand_eye.solve import solve_joint, solve_task, verify
from robocal_ros.hand_eye.targets import SphereTarget
from robocal_ros.hand_eye.tasks import SphereTask

BENT_M = (3e-5, -2e-5, 4e-5)  # as real sensors: 20 to 100 um over the field
RUNS = amount(3, 6)
SPHERE = SphereTarget(RADIUS_M)


def bent(linearity_m=BENT_M):
    return ProfileSensor(noise_m=7e-6, linearity_m=linearity_m)


def shot_with(sensor, seed, make=sphere_set):
    # A robot that errs by less than the sensor, so that this one is what is seen.
    cell = HandEyeCell(sensor=sensor, robot=PoseRobot(5e-6, 0.0))
    return make(cell, np.random.default_rng([33, seed]))


@pytest.fixture(scope="module")
def runs():
    found = []
    for seed in range(RUNS):
        data = shot_with(bent(), seed).data
        tasks = [SphereTask(SPHERE, True, plain=plain) for plain in (False, True)]
        found.append((data, *(solve_task(task, data, "best", SETTINGS) for task in tasks)))
    return found


@pytest.fixture(scope="module")
def edges():
    """Of which both surfaces beside the edge are seen, straight as they are."""
    made = [shot_with(bent(), seed, edge_set) for seed in range(RUNS)]
    return [(one.data, one.solve(), one) for one in made]


@pytest.mark.parametrize("shown_by", ["runs", "edges"])
def test_the_field_is_recovered_within_what_is_told_of_it(shown_by, request):
    left, whole = [], []
    for data, result, _ in request.getfixturevalue(shown_by):
        own = result.linearity
        points = shown(data, own)
        distance = points * [1.0, -1.0] + [0.0, 0.2]
        truth = -bent()._nonlinear(distance)  # a height errs the other way
        affine = np.column_stack([np.ones(len(points)), points])  # the mount's and the maker's
        off, field = (
            error - affine @ np.linalg.lstsq(affine, error, rcond=None)[0]
            for error in (points[:, 1] - own.corrected(points)[:, 1] - truth, truth)
        )
        left.append(np.mean(off**2))
        whole.append(np.mean(field**2))
        # Of k numbers with this covariance, but for the scale, which is the mount's; 1e-3 is the
        # chance of a miss, in all runs.
        sigma_m = np.sqrt(np.trace(own.covariance[:-1, :-1]))
        assert np.sqrt(left[-1]) < sigma_m * np.sqrt(chi2.ppf(1.0 - 1e-3 / RUNS, 1))
        assert own.left_out_m < own.residual_m
    assert np.mean(left) < 0.5 * np.mean(whole)  # what a wrong field would not leave


def shown(data, own):
    """Points (n, 2) of all profiles, within the field in which the error was found."""
    points = np.concatenate([p.points for p in data.profiles if isinstance(p, Profile)])
    return points[np.all((points >= own.low) & (points <= own.high), axis=1)]


def landed_m(result, points):
    """Rms distance of points, corrected where that is known, from where they truly are."""
    true = points.copy()
    true[:, 1] += bent()._nonlinear(points * [1.0, -1.0] + [0.0, 0.2])
    told = points if result.linearity is None else result.linearity.corrected(points)
    there, found = (
        frames.apply(T, np.insert(p, 1, 0.0, axis=1))
        for T, p in ((X, true), (result.T_flange_sensor, told))
    )
    return np.sqrt(np.mean(np.sum((there - found) ** 2, axis=1)))


def test_points_land_where_they_are_and_better_than_without(runs):
    squares = []
    for data, best, plain in runs:
        points = shown(data, best.linearity)
        told_m2 = best.working_error_m**2 - best.linearity.rms_m**2  # of corrected points
        squares.append([landed_m(best, points) ** 2, landed_m(plain, points) ** 2, told_m2])
    with_it, without, told = np.mean(squares, axis=0)
    assert with_it < without
    # A mean square of six runs, most of each of one direction at worst: chi^2 of 6.
    assert with_it < told * chi2.ppf(1.0 - 1e-3, RUNS) / RUNS


@pytest.mark.parametrize("make", [sphere_set, *more(edge_set)])
def test_of_a_straight_sensor_nothing_is_found(make):
    """At most one in three: three degrees, each with a chance of some 0.2 %."""
    straight = bent((0.0, 0.0, 0.0))
    found = [shot_with(straight, seed, make).solve().linearity is not None for seed in range(3)]
    assert sum(found) <= 1


def test_what_is_in_force_is_taken_not_found_anew(runs):
    """Of other shots, too few to show it, by the document that a result has."""
    mount, known = runs[0][1].T_flange_sensor, runs[0][1].linearity
    told = SensorLinearity.of_document(json.loads(json.dumps(known.document())))
    data, task = runs[1][0], SphereTask(SPHERE, True)
    points = data.profiles[0].points
    assert told.corrected(points) == pytest.approx(known.corrected(points), abs=1e-15)
    few = replace(
        data, names=data.names[:7], T_base_flange=data.T_base_flange[:7], profiles=data.profiles[:7]
    )
    assert task.read(few).linearity.assumed
    with_it, without = (verify(task, few, mount, SETTINGS, one) for one in (told, None))
    assert np.sqrt(np.mean(with_it.distance_m**2)) < np.sqrt(np.mean(without.distance_m**2))


def test_targets_together_have_one(runs, edges):
    """What the sphere shows is taken out of the edge's profiles too."""
    parts = [(SphereTask(SPHERE, True), runs[0][0]), (edges[0][2].task(), edges[0][0])]
    found = solve_joint(parts, SETTINGS)
    assert found.linearity is not None
    assert found.working_error_m < runs[0][1].working_error_m
    step = increment(found.T_flange_sensor, X, found.pivot)
    assert step @ np.linalg.solve(found.covariance, step) < chi2.ppf(1.0 - 1e-3, 6)


def test_what_few_poses_of_stairs_do_not_show_of_it_is_in_the_covariance():
    """Without it the squared errors are 2.2 times what is told (60 sets); it is of 0.02 mm."""
    squared = []
    for seed in range(amount(4, 10)):
        rng = np.random.default_rng([71, seed])
        result = step_world(rng).shot(rng).solve()
        assert result.linearity is None
        squared.append(squared_error(result))
    assert sum(squared) < chi2.ppf(0.999, 6 * len(squared))


@pytest.mark.parametrize("poses", [1, 5, 12])
def test_profiles_of_one_height_show_none_of_it_and_allow_for_none(poses):
    flat = SeenLine(np.column_stack([np.linspace(-0.01, 0.01, 50), np.full(50, 0.1)]))
    assert fit_linearity([flat] * poses, np.arange(poses), towards=True) is None
    assert fit_linearity([], np.arange(0), towards=True) is None
