# SPDX-License-Identifier: Apache-2.0
"""The mount as an estimation problem: its Jacobian, its covariance, what it rejects."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from hand_eye_sets import (
    CELL,
    CENTRE,
    POSE_M,
    RADIUS_M,
    STAIRS,
    T_BASE_USER,
    data_of,
    stairs_target,
    step_task,
)
from long_form import amount, more
from scipy.linalg import block_diag

from bench.hand_eye_cell import step_shots
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.mount_fit import fit_mount
from robocal_ros.hand_eye.mount_problem import (
    Bend,
    LineModel,
    MountProblem,
    MountState,
    RestrictedLikelihood,
    Sightings,
    SphereModel,
    TargetView,
)
from robocal_ros.hand_eye.result import HandEyeSettings, PoseNoise, by_shot, increment
from robocal_ros.hand_eye.solve import features, judge, looked
from robocal_ros.hand_eye.stairs import StepTask

X = CELL.T_flange_sensor
FEATURE_M = 5e-6
REPEAT_M = 5e-5
NOISE = PoseNoise(POSE_M, POSE_M, 1e-4)
LINE = np.stack([T_BASE_USER[:3, 3], T_BASE_USER[:3, 0]])


def sensor_poses(rng, count, p_base, p_sensor):
    """Sensors that look down, tilted and rolled, and see a point of the base where it is wanted."""
    turns = np.radians(rng.uniform(-1.0, 1.0, (count, 3)) * [25.0, 25.0, 60.0])
    R = np.diag([1.0, -1.0, -1.0]) @ frames.exp_rotation(turns)
    return frames.transform(R, p_base - np.einsum("nij,nj->ni", R, p_sensor))


def pierced(T_base_sensor, point, direction):
    """Where a line of the base meets y = 0 of each sensor: by solving for its parameter."""
    found = []
    for T in T_base_sensor:
        y, origin = T[:3, 1], T[:3, 3]
        along = y @ (origin - point) / (y @ direction)
        found.append(frames.invert(T)[:3] @ np.append(point + along * direction, 1.0))
    return np.array(found)


def sphere_view(rng, count):
    y = RADIUS_M * rng.uniform(0.4, 0.7, count) * rng.choice([-1.0, 1.0], count)
    at = np.column_stack([rng.uniform(-5e-3, 5e-3, count), y, rng.uniform(0.19, 0.21, count)])
    T = sensor_poses(rng, count, CENTRE, at)
    value = np.column_stack([at[:, 0], at[:, 2], np.sqrt(RADIUS_M**2 - y**2)])
    return TargetView(SphereModel(RADIUS_M), sightings(rng, T, value, np.arange(count), 3)), CENTRE


def line_view(rng, count):
    at = np.column_stack([rng.uniform(-5e-3, 5e-3, (count, 1)), np.zeros((count, 1)),
                          rng.uniform(0.19, 0.21, (count, 1))])  # fmt: skip
    T = sensor_poses(rng, count, LINE[0] + rng.uniform(-0.04, 0.04, (count, 1)) * LINE[1], at)
    p = pierced(T, *LINE)
    value = np.column_stack([p[:, 0], p[:, 2], np.zeros(count)])
    return TargetView(LineModel(), sightings(rng, T, value, np.arange(count), 2)), LINE


def step_view(rng, count):
    target = stairs_target(user_sigma_m=1e-4, user_sigma_rad=1e-3)
    corners = target.corners["near"]
    middle = (T_BASE_USER @ np.append(corners.mean(axis=0), 1.0))[:3]
    T = sensor_poses(rng, count, middle, np.tile([0.0, 0.0, 0.2], (count, 1)))
    T = np.repeat(T, len(corners), axis=0)
    user = np.tile(corners, (count, 1))
    base = user @ T_BASE_USER[:3, :3].T + T_BASE_USER[:3, 3]
    p = np.array([pierced(t[None], b, LINE[1])[0] for t, b in zip(T, base, strict=True)])
    shown = (T[:, :3, :3] @ p[..., None])[..., 0] + T[:, :3, 3]
    along = (shown - base) @ LINE[1]  # the light passes the mark by so much: as if it was meant
    user = user + along[:, None] * target.edge_user
    value = np.column_stack([p[:, 0], p[:, 2], np.zeros(len(p))])
    pose = np.repeat(np.arange(count), len(corners))
    return TargetView(StepTask(target).model(user), sightings(rng, T, value, pose, 3)), T_BASE_USER


def sightings(rng, T_base_sensor, value, pose, size):
    """True features with noise, as seen by a robot whose reported poses are off."""
    C = np.diag(np.where(np.arange(3) < size, FEATURE_M**2, 1.0))
    noisy = value + FEATURE_M * rng.standard_normal(value.shape) * (np.arange(3) < size)
    off = POSE_M * rng.standard_normal((int(pose.max()) + 1, 6))[pose]
    error = frames.transform(frames.exp_rotation(off[:, 3:]), off[:, :3])
    T = T_base_sensor @ frames.invert(X) @ error
    names = tuple(f"p{i}/{k}" for k, i in enumerate(pose))
    return Sightings(names, pose, pose, T, noisy, np.tile(C, (len(pose), 1, 1)))


VIEWS = {"sphere": sphere_view, "line": line_view, "step": step_view}


@pytest.mark.parametrize("kind", VIEWS)
def test_jacobian_is_the_numeric_one(kind):
    view, place = VIEWS[kind](np.random.default_rng(1), 6)
    state = MountState(X, (place,))
    problem = MountProblem((view,), NOISE, state)
    residual, jacobian = problem.linearise(state)
    step = 1e-6
    for i in range(len(problem.names)):
        ends = [
            problem.linearise(problem.retract(state, s * np.eye(len(problem.names))[i]))[0]
            for s in (step, -step)
        ]
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        scale = np.abs(jacobian[..., i]).max() + np.abs(residual).max()
        assert np.allclose(numeric, jacobian[..., i], atol=1e-6 * scale), problem.names[i]


@pytest.mark.parametrize("kind", VIEWS)
def test_effect_of_a_pose_error_is_the_numeric_one(kind):
    view, place = VIEWS[kind](np.random.default_rng(2), 4)
    state = MountState(X, (place,))
    common = MountProblem((view,), NOISE, state).linear(state).common
    step = 1e-6
    for i in range(6):
        ends = []
        for sign in (1.0, -1.0):
            d = sign * step * np.eye(6)[i]
            moved = view.sightings.T_base_flange @ frames.transform(
                frames.exp_rotation(d[3:]), d[:3]
            )
            other = TargetView(view.model, replace(view.sightings, T_base_flange=moved))
            ends.append(MountProblem((other,), NOISE, state).linear(state).residual)
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        assert np.allclose(numeric, common[:, :, i], atol=1e-6 * (1.0 + np.abs(numeric).max()))


@pytest.mark.parametrize("kind", VIEWS)
def test_covariance_is_that_of_the_errors(kind):
    """Chi-square of 6 numbers over some runs: its mean is 6 within 4 of its standard errors."""
    rng, runs = np.random.default_rng(3), amount(25, 60)
    squared = []
    for _ in range(runs):
        view, place = VIEWS[kind](rng, 15)
        fit = fit_mount((view,), MountState(X, (place,)), NOISE)
        C = fit.covariance[:6, :6] / fit.scale**2
        off = increment(
            fit.state.T_flange_sensor, X, MountProblem(fit.views, NOISE, fit.state).pivot
        )
        squared.append(off @ np.linalg.solve(C, off))
    assert abs(np.mean(squared) - 6.0) < 4.0 * np.sqrt(12.0 / runs)


def test_noise_of_poses_is_found_from_the_profiles():
    """20 profiles leave 51 numbers over: their scale is known to 10 %, so 4 of that."""
    view, place = sphere_view(np.random.default_rng(5), 20)
    found = fit_mount((view,), MountState(X, (place,))).noise.sigma_m
    assert abs(np.log(found / POSE_M)) < 0.4


def exact_sphere(count):
    """Features without noise of their own, so that all their residuals tell of the poses'."""
    view, place = sphere_view(np.random.default_rng(10), count)
    exact = replace(view.sightings, covariance=np.tile(1e-18 * np.eye(3), (count, 1, 1)))
    return TargetView(view.model, exact), MountState(X, (place,))


def test_covariance_counts_that_few_poses_tell_their_noise_badly():
    """An error over what n numbers tell: n / (n - 2) in the mean, of 1 / chi-square."""
    view, start = exact_sphere(6)
    fit = fit_mount((view,), start)
    assert not fit.rejected
    jacobian = MountProblem(fit.views, fit.noise, fit.state).linearise(fit.state)[1]
    rows = jacobian.reshape(-1, jacobian.shape[2])
    likeliest = np.linalg.inv(rows.T @ rows)
    wider = np.diag(fit.covariance) / np.diag(likeliest)
    assert np.allclose(wider, 9.0 / 7.0, rtol=0.02)


def test_what_residuals_tell_of_the_bend_they_do_not_tell_of_the_noise():
    """Of 12 numbers to spare three tell a bend of which nothing is known: nine are left."""
    view, start = exact_sphere(7)
    pull = np.random.default_rng(3).normal(0.0, 1.0, (7, 3, 3))
    bend = Bend(dict(zip(view.sightings.names, pull, strict=True)), np.zeros(3))
    noise = fit_mount((view,), start).noise
    problem = MountProblem((view,), noise, start, bend=bend)
    likely = RestrictedLikelihood(problem, start, np.ones(7, dtype=np.bool_), None)
    assert likely.information(likely.now) == pytest.approx(2.0 * 9.0, rel=1e-3)
    without = MountProblem((view,), noise, start)
    likely = RestrictedLikelihood(without, start, np.ones(7, dtype=np.bool_), None)
    assert likely.information(likely.now) == pytest.approx(2.0 * 12.0, rel=1e-3)


def test_information_of_the_noises_is_that_of_the_whole_covariance():
    """Half the trace of P dV P dV, of matrices over all measurements at once."""
    view, place = step_view(np.random.default_rng(11), 6)
    state = MountState(X, (place,))
    likely = RestrictedLikelihood(
        MountProblem((view,), NOISE, state), state, np.ones(6, dtype=np.bool_), None
    )
    _, normal, _, white, common = likely.at(likely.now)
    J, G = white[..., 1 : -len(common)], white[..., -len(common) :]
    J = J.reshape(-1, J.shape[2])
    P = np.eye(len(J)) - J @ np.linalg.inv(normal) @ J.T
    assert likely.unknown == ["sigma_m", "aim_m"]
    grown = []
    for columns in (slice(6), slice(6, 8)):
        of_it = np.zeros_like(common)
        of_it[columns, columns] = common[columns, columns]
        grown.append(P @ block_diag(*(2.0 * own @ of_it @ own.T for own in G)))
    dense = [[0.5 * np.trace(one @ other) for other in grown] for one in grown]
    assert np.allclose(likely.information(likely.now), dense, rtol=1e-9)


def test_slope_of_the_noise_is_the_numeric_one():
    view, place = step_view(np.random.default_rng(11), 6)
    state = MountState(X, (place,))
    problem = MountProblem((view,), NOISE, state)
    likely = RestrictedLikelihood(problem, state, np.ones(6, dtype=bool), None)
    for log_sigma in (likely.now - 0.5, likely.now + 0.5):
        ends = [[likely.at(log_sigma + h)[0] for h in s * 1e-4 * np.eye(2)] for s in (1.0, -1.0)]
        numeric = np.subtract(*ends) / 2e-4
        assert np.allclose(likely.with_slope(log_sigma)[1], numeric, rtol=1e-5)


def test_noise_whose_search_breaks_off_has_not_settled(monkeypatch):
    """Given back unchanged it looks as if it had: here no step of the search lowers the cost."""
    view, place = sphere_view(np.random.default_rng(5), 20)
    calls, true = count(), RestrictedLikelihood.with_slope

    def rising(likely, log_sigma):
        cost, slope = true(likely, log_sigma)
        return cost + 100.0 * next(calls), slope

    monkeypatch.setattr(RestrictedLikelihood, "with_slope", rising)
    fit = fit_mount((view,), MountState(X, (place,)))
    found = judge(fit, 20, 0, 0.0, HandEyeSettings())
    assert found.code is Code.POSES_NOT_INFORMATIVE
    assert "noise of the poses had not settled" in found.reason


@pytest.mark.parametrize(
    ("kind", "seed", "count", "at", "off_m"),
    [("sphere", 6, 15, (4, 0), 3e-3), ("step", 7, 6, (8, 1), 3e-3)],
)
def test_one_wrong_feature_is_left_out_and_the_others_of_its_profile_stay(
    kind, seed, count, at, off_m
):
    view, place = VIEWS[kind](np.random.default_rng(seed), count)
    value = view.sightings.value.copy()
    value[at] += off_m
    wrong = TargetView(view.model, replace(view.sightings, value=value))
    fit = fit_mount((wrong,), MountState(X, (place,)))
    assert list(fit.rejected) == [view.sightings.names[at[0]]]


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("sphere/p{}", Code.RESIDUAL_TOO_LARGE),
        ("day 1/p{}", Code.RESIDUAL_TOO_LARGE),
        ("p{}/corner 2", Code.RESIDUAL_TOO_LARGE),
        ("step/p1/corner {}", Code.ACCEPT),  # a single shot may be wrong as a whole
    ],
)
def test_misfits_of_many_shots_are_refused_however_these_are_named(name, code):
    view, place = sphere_view(np.random.default_rng(12), 15)
    fit = fit_mount((view,), MountState(X, (place,)), NOISE)
    assert not fit.rejected
    misfit = {name.format(i): "does not fit the others" for i in range(5)}  # more than 4 of 20
    found = judge(replace(fit, rejected=misfit), 20, 5, 0.0, HandEyeSettings(POSE_M))
    assert found.code is code


SHIFT_M = 2e-3


@pytest.mark.parametrize("axis", [0, *more(1, 2)])  # 0: along the edges
def test_a_badly_taught_origin_shows_in_tilted_shots(axis):
    """Along the edges too: tilts about the laser line tell it from a shift of the sensor."""
    shots = step_shots(CELL, STAIRS, 12, np.random.default_rng(3))
    taught = T_BASE_USER @ frames.transform(np.eye(3), SHIFT_M * np.eye(3)[axis])
    target = stairs_target(taught, user_sigma_m=SHIFT_M, user_sigma_rad=1e-4)
    task, data = step_task(target), data_of(shots)
    read = features(task, data)
    fit = fit_mount((read.view,), looked(task, data, read)[0])
    off_m = (frames.invert(fit.state.places[0]) @ T_BASE_USER)[:3, 3]
    covariance = fit.covariance[6:9, 6:9]
    assert off_m @ np.linalg.solve(covariance, off_m) < 16.27  # chi-square of 3, once in 1000
    # At least 15 of 16 parts of what is then known of it are the poses', not the teacher's.
    assert np.sqrt(np.diag(covariance).max()) < SHIFT_M / 4.0


def test_a_single_corner_keeps_its_name():
    samples = ("a/corner 1", "a/corner 3")
    rejected = {"a/corner 2": "does not fit the others"}
    assert by_shot(rejected, samples) == rejected


def test_a_shot_without_a_corner_left_is_named_once_with_the_commonest_reason():
    swapped = "fits the pose of {}/corner 2, not its own: swapped?"
    rejected = {
        "step/b/corner 1": "does not fit the others",
        "step/b/corner 2": swapped.format("step/c"),
        "step/b/corner 10": swapped.format("step/c"),
        "empty": "profile empty has 0 points",
    }
    found = by_shot(rejected, ("step/a/corner 1",))
    assert found == {
        "step/b": "fits the pose of step/c, not its own: swapped?",
        "empty": "profile empty has 0 points",
    }


def test_folders_in_names_are_no_shots():
    rejected = {"sphere/s1": "too short", "day 1/p2": "dark"}
    assert by_shot(rejected, ()) == rejected


def test_two_visits_of_a_pose_are_no_swap():
    """What a robot errs by at a pose is common to its visits, but for its repeatability."""
    rng = np.random.default_rng(31)
    found = []
    for _ in range(amount(10, 20)):
        view, place = line_view(rng, 20)
        s = view.sightings
        rows = np.concatenate([np.arange(20), np.arange(6)])
        shift = frames.transform(np.eye(3), REPEAT_M * rng.standard_normal((len(rows), 3)))
        seen_from = s.T_base_flange[rows]
        again = replace(s.take(rows), names=tuple(map(str, rows)), shot=np.arange(len(rows)))
        moved = (
            LineModel().see(seen_from @ shift @ X, place).value
            - LineModel().see(seen_from @ X, place).value
        )
        again = replace(again, value=again.value + moved)
        fit = fit_mount((TargetView(view.model, again),), MountState(X, (place,)))
        assert not fit.rejected
        found.append(np.log(fit.noise.repeat_m / REPEAT_M))
    # 6 pairs tell 12 numbers, each run to 20 %: 10 runs to 7 %, and what the features add.
    assert abs(np.median(found)) < 0.25


def test_slope_of_the_repeatability_is_the_numeric_one():
    view, place = line_view(np.random.default_rng(32), 12)
    s = view.sightings
    view = TargetView(view.model, replace(s, pose=np.arange(12) // 2 * 2))
    state = MountState(X, (place,))
    problem = MountProblem((view,), replace(NOISE, repeat_m=2e-5), state)
    likely = RestrictedLikelihood(problem, state, np.ones(6, dtype=np.bool_), None)
    assert likely.unknown == ["sigma_m", "repeat_m"]
    slope = likely.with_slope(likely.now)[1]
    for axis, value in zip(np.eye(2), slope, strict=True):
        ends = [likely.at(likely.now + sign * 1e-5 * axis)[0] for sign in (1.0, -1.0)]
        assert np.isclose((ends[0] - ends[1]) / 2e-5, value, rtol=1e-4, atol=1e-3)
