# SPDX-License-Identifier: Apache-2.0
"""A profile sensor placed by a laser tracker: exact, as good as the bound, refusals in words."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from long_form import more

from bench.hand_eye_tracker import spread
from bench.laser_tracker import TrackerCell, prp_cell, six_axis_cell
from bench.measured_runs import Q_NEAR
from robocal_ros.cell_sim.sensors import Prism, Stem
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.hand_eye import tracker
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.tracker import (
    SENSOR,
    UNKNOWNS,
    judge_tracker,
    solve_best,
    solve_tracker,
    states_without,
)
from robocal_ros.hand_eye.tracker_data import Arc, TrackerData
from robocal_ros.hand_eye.tracker_scan import Scan, fit_caps, solve_classic
from robocal_ros.kinematics.robots import load_robot

pytestmark = pytest.mark.filterwarnings("ignore:.*joint limits not given")
RUNS = 40


@cache
def cell(kind: str) -> TrackerCell:
    if kind == "prp":
        return prp_cell(load_robot("p1r2p3"))
    return six_axis_cell(load_robot("ur10"), Q_NEAR)


def error(made: TrackerCell, T: np.ndarray) -> np.ndarray:
    """Of T_flange_sensor, (6,) in the sensor frame."""
    D = frames.invert(made.T_flange_sensor) @ T
    return np.concatenate([D[:3, 3], frames.log_rotation(D[:3, :3])])


def solve(data: TrackerData, method="best", made: TrackerCell | None = None, **target):
    made = made or cell("prp")
    told = replace(made.sizes.target, **target)
    return solve_tracker(data, told, made.sizes.noise, method)


@cache
def noisy() -> TrackerData:
    return cell("prp").measure(np.random.default_rng(0))


@cache
def clean(method: str = "best"):
    """What `noisy` gives."""
    return solve(noisy(), method)


@pytest.mark.parametrize("kind", ["ur10", *more("prp")])
def test_measurements_without_noise_give_the_truth(kind):
    """To rounding; the closed form to where its iteration stops."""
    made = cell(kind)
    best = solve(made.exact, "best", made)
    assert np.abs(error(made, best.T_flange_sensor)).max() < 1e-9
    assert best.verdict.accept
    assert best.residual_m.max() < 1e-9
    classic = solve(made.exact, "classic", made)
    away = error(made, classic.T_flange_sensor)
    assert np.abs(away).max() < 1e-6  # the iteration stops at 1e-6
    assert classic.covariance is None


@cache
def solved():
    """Problem and estimate of `noisy`, and the closed form."""
    made = cell("prp")
    first = solve_classic(noisy(), made.sizes.target, made.sizes.noise)
    return *solve_best(first), first


def left_out(data: TrackerData, row: int) -> TrackerData:
    rest = [i for i in range(len(data.profiles)) if i != row]
    return replace(data, q=data.q[rest], profiles=[data.profiles[i] for i in rest])


@pytest.mark.long
def test_leaving_a_profile_out_is_as_solving_without_it():
    """Not the first one: the motion counts from there."""
    made, (problem, estimate, _) = cell("prp"), solved()
    data = noisy()
    size = []
    for row in (1, 12, 25, 40, 53):
        (state,) = states_without(problem, estimate, [data.profiles[row].name])
        assert state is not None
        rest = left_out(data, row)
        first = solve_classic(rest, made.sizes.target, made.sizes.noise)
        _, again = solve_best(first)
        here = estimate.state.T_flange_sensor
        told, exact = (
            frames.invert(here) @ s.T_flange_sensor for s in (state, again.state)
        )  # how far each has moved
        away = told[:3, 3] - exact[:3, 3]
        size.append([np.linalg.norm(away), np.linalg.norm(exact[:3, 3])])
    away_m, moved_m = np.sqrt(np.mean(np.square(size), axis=0))
    assert away_m < 0.25 * moved_m  # the noise of the sensor is estimated anew


@pytest.mark.long
def test_leave_one_out_is_filled_by_both_methods():
    """The distance of a profile's own points hardly changes, and never to the better as a whole."""
    for method in ("best", "classic"):
        one = clean(method)
        assert one.leave_one_out_m.shape == one.residual_m.shape
        without, within = (np.sqrt(np.mean(d**2)) for d in (one.leave_one_out_m, one.residual_m))
        assert within < without < 1.2 * within


def test_a_profile_that_alone_tells_something_is_not_left_out():
    """Where all others are rejected, it is all that tells where the sensor sits."""
    problem, estimate, _ = solved()
    profiles = [n for n in problem.rows if n in {p.name for p in noisy().profiles}]
    mask = np.array([name == profiles[0] or name not in profiles for name in problem.rows])
    alone = replace(estimate, rejected=~mask)
    J = problem.linearise(estimate.state)[1][mask, 0]
    covariance = np.linalg.pinv(J.T @ J)
    names = [profiles[0], profiles[-1]]
    assert states_without(problem, replace(alone, covariance=covariance), names)[0] is None


def test_classic_is_judged_by_its_distance_from_the_best():
    best, classic = clean(), clean("classic")
    points = np.concatenate([profile.points for profile in noisy().profiles])
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    x, z = (np.ravel(g) for g in np.meshgrid(*np.stack([low, high]).T))
    x, z = np.append(x, x.mean()), np.append(z, z.mean())
    field = np.stack([x, 0.0 * x, z, np.ones(5)], axis=1)
    away = field @ (classic.T_flange_sensor - best.T_flange_sensor).T
    away_m = float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
    expected = np.hypot(away_m, best.working_error_m)
    assert classic.working_error_m == pytest.approx(expected, rel=0.01)
    assert classic.verdict.accept
    made = cell("prp")
    limit_m = 0.5 * (classic.working_error_m + best.working_error_m)
    for method, accept in (("best", True), ("classic", False)):
        told, noise = made.sizes.target, made.sizes.noise
        verdict = solve_tracker(noisy(), told, noise, method, limit_m).verdict
        assert verdict.accept is accept
    assert verdict.code is Code.POSES_NOT_INFORMATIVE
    assert "use method best" in verdict.reason


@pytest.mark.long
def test_a_fit_that_crept_on_judges_no_closed_form(monkeypatch):
    """The closed form is as far from it as it says, and what it crept towards is not known."""

    def crept(first):
        problem, estimate = solve_best(first)
        return problem, replace(estimate, converged=False)

    monkeypatch.setattr(tracker, "solve_best", crept)
    best, classic = solve(noisy()), solve(noisy(), "classic")
    assert best.verdict.code is Code.POSES_NOT_INFORMATIVE
    assert classic.verdict.code is best.verdict.code
    assert classic.verdict.reason.startswith(best.verdict.reason.partition(";")[0])


@cache
def repeated(kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (n, 6) of best and classic, covariances (n, 6, 6)."""
    made = cell(kind)
    best, classic, covariance = [], [], []
    for seed in range(RUNS):
        rng = np.random.default_rng([5, seed])
        data, target = made.measure(rng), made.told(rng)
        first = solve_classic(data, target, made.sizes.noise)
        _, estimate = solve_best(first)
        best.append(error(made, estimate.state.T_flange_sensor))
        classic.append(error(made, first.T_flange_sensor))
        covariance.append(estimate.covariance[SENSOR, SENSOR])
    return np.array(best), np.array(classic), np.array(covariance)


def test_errors_are_as_large_as_the_covariance_says():
    """Chi-square of 6 n degrees of freedom, within 4 sigma either way."""
    best, _, covariance = repeated("prp")
    chi2 = np.einsum("ni,nij,nj->", best, np.linalg.inv(covariance), best)
    assert abs(chi2 / best.size - 1.0) < 4.0 * np.sqrt(2.0 / best.size)


def test_no_component_is_biased():
    best, _, covariance = repeated("prp")
    bound = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0))
    assert np.all(np.abs(best.mean(axis=0)) < 4.0 * bound / np.sqrt(RUNS))


def test_the_best_method_beats_the_sources():
    best, classic, _ = repeated("prp")
    square = [np.mean(rows**2, axis=0) for rows in (best, classic)]
    assert square[0][:3].sum() < 0.5 * square[1][:3].sum()
    assert square[0][3:].sum() < 0.5 * square[1][3:].sum()


def test_the_jacobian_is_the_derivative():
    made = cell("ur10")
    rng = np.random.default_rng(1)
    data = made.measure(rng)
    told = replace(made.sizes.target, height_m=0.04)
    first = solve_classic(data, told, made.sizes.noise)
    problem, estimate = solve_best(first)
    state = estimate.state.moved(1e-4 * rng.standard_normal(UNKNOWNS))
    residual, jacobian = problem.linearise(state)
    assert len(problem.rows) == len(residual)
    step = 1e-6
    for k in range(UNKNOWNS):
        move = step * np.eye(UNKNOWNS)[k]
        ahead, back = (problem.linearise(state.moved(sign * move))[0] for sign in (1.0, -1.0))
        slope = (ahead - back) / (2.0 * step)
        scale = np.abs(jacobian[..., k]).max()
        assert np.abs(slope - jacobian[..., k]).max() < 1e-5 * scale


def test_noise_of_the_points_leaves_a_balls_place_unbiased():
    """The same profile of a ball 2000 times: the mean pull on its centre, chi-square."""
    m, radius, noise = 2000, 0.01905, 3.7e-5
    centre = np.array([0.0, 0.008, 0.21])
    x = np.linspace(-0.015, 0.011, 260)
    z = centre[2] - np.sqrt(radius**2 - centre[1] ** 2 - (x - centre[0]) ** 2)
    rng = np.random.default_rng(8)
    points = np.column_stack([np.tile(x, m), np.tile(z, m) + noise * rng.standard_normal(260 * m)])
    scan = Scan(points, np.repeat(np.arange(m), 260), np.broadcast_to(np.eye(4), (m, 4, 4)))
    caps = fit_caps(scan, np.tile(centre, (m, 1)), radius, noise)
    pull = np.einsum("mij,mi->mj", caps.root, caps.offset).mean(axis=0)
    information = np.einsum("mij,mik->jk", caps.root, caps.root) / m
    chi2 = m * pull @ np.linalg.solve(information, pull)
    assert chi2 < 25.0  # of 3 degrees of freedom: chance 2e-5


def test_the_adjoint_carries_twists_across_a_transform():
    rng = np.random.default_rng(2)
    T = frames.transform(frames.exp_rotation(rng.standard_normal(3)), rng.standard_normal(3))
    x = 1e-7 * rng.standard_normal(6)
    y = frames.adjoint(T) @ x
    right = T @ frames.transform(frames.exp_rotation(x[3:]), x[:3])
    left = frames.transform(frames.exp_rotation(y[3:]), y[:3]) @ T
    assert np.allclose(left, right, atol=1e-13)


@pytest.mark.long
@pytest.mark.parametrize("method", ["best", "classic"])
def test_where_the_tracker_stands_does_not_matter(method):
    data = noisy()
    T = frames.transform(frames.exp_rotation([0.4, -1.1, 0.7]), [-2.0, 1.0, 0.5])

    def seen(points: np.ndarray) -> np.ndarray:
        return points @ T[:3, :3].T + T[:3, 3]

    first, second = (replace(arc, points=seen(arc.points)) for arc in data.arcs)
    faces = (seen(data.faces[0]), seen(data.faces[1]))
    moved = replace(data, arcs=(first, second), sphere=seen(data.sphere), faces=faces)
    away = frames.invert(clean(method).T_flange_sensor) @ solve(moved, method).T_flange_sensor
    assert np.abs(away - np.eye(4)).max() < 2e-6  # closed form and descent stop at 1e-6


def test_where_x_is_counted_from_does_not_matter():
    """As of a sensor whose x begins at one end of its line: the same points, the same error."""
    aside = [replace(p, points=p.points + np.array([0.1, 0.0])) for p in noisy().profiles]
    found = solve(replace(noisy(), profiles=aside))
    assert found.working_error_m == pytest.approx(clean().working_error_m, rel=1e-3)


def test_names_of_faces_and_arcs_do_not_matter():
    data = noisy()
    swapped = replace(data, faces=(data.faces[1], data.faces[0]), arcs=(data.arcs[1], data.arcs[0]))
    away = frames.invert(clean().T_flange_sensor) @ solve(swapped).T_flange_sensor
    assert np.abs(away - np.eye(4)).max() < 2e-6


@pytest.mark.parametrize(
    "turn",
    [np.diag([-1.0, -1.0, 1.0]), frames.exp_rotation([0.12, 0.05, 0.1])],
    ids=["looks the other way: the scan runs along its -y", "tilted against the slide"],
)
def test_a_sensor_that_is_mounted_otherwise(turn):
    X = cell("prp").T_flange_sensor @ frames.transform(turn, np.zeros(3))
    made = replace(cell("prp"), T_flange_sensor=X)
    assert np.abs(error(made, solve(made.exact, "best", made).T_flange_sensor)).max() < 1e-9


def test_a_wild_tracker_point_is_named_and_left_out():
    data = noisy()
    arc = data.arcs[0]
    points = arc.points.copy()
    points[7] += [0.0, 2e-4, 1e-4]
    wild = solve(replace(data, arcs=(replace(arc, points=points), data.arcs[1])))
    assert "arc_a 8" in wild.rejected
    away = frames.invert(clean().T_flange_sensor) @ wild.T_flange_sensor
    sigma = np.sqrt(np.diag(clean().covariance))
    assert np.all(np.abs(away[:3, 3]) < sigma[:3])


@pytest.mark.long
@pytest.mark.parametrize("off_deg", [0.1, -0.05])
def test_axes_that_are_not_quite_square(off_deg):
    """Named, not rejected; the flange is midway between what either axis says."""
    nominal = load_robot("p1r2p3")
    mdh = np.array(nominal.mdh)
    mdh[1, 3] += np.radians(off_deg)
    made = prp_cell(nominal.with_mdh(mdh))
    found = solve(replace(made.measure(np.random.default_rng(7)), arm=nominal), "best", made)
    assert found.verdict.accept
    assert not found.rejected
    assert found.more["residual_over_noise"] < 1.2
    # the points scatter along the beam, and less square to what they lie on
    for distance_m in (found.residual_m, found.leave_one_out_m):
        assert np.sqrt(np.mean(distance_m**2)) < made.sensor.noise_m
    # the line's direction is known to 0.015 mm / (75 mm sqrt(16)) = 0.003 deg
    assert abs(found.more["axes_off_nominal"]["angle_deg"] - off_deg) < 4.0 * 0.003
    half = frames.exp_rotation([-0.5 * np.radians(off_deg), 0.0, 0.0])
    T = frames.transform(half, np.zeros(3)) @ found.T_flange_sensor
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(error(made, T)) < 4.0 * sigma)


def test_spikes_in_the_profiles_do_no_harm():
    made = cell("prp")
    rng = np.random.default_rng(3)
    profiles = []
    for profile in noisy().profiles:
        points = profile.points.copy()
        wild = rng.random(len(points)) < 0.05
        points[wild, 1] += rng.uniform(-2e-3, 2e-3, wild.sum())
        profiles.append(Profile(points, profile.name))
    found = solve(replace(noisy(), profiles=profiles))
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(error(made, found.T_flange_sensor)) < 4.0 * sigma)


@cache
def smoothed() -> list:
    """Four times `prp`, the noise smoothed: neighbours are alike by 0.84, 0.53, 0.21, 0.05.

    So are those of real line lasers. One point in 4.3 counts: 1 + 2 (0.84 + 0.53 + 0.21 + 0.05).
    """
    made, found = cell("prp"), []
    taps = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / np.sqrt(19.0)
    for seed in range(4):
        rng = np.random.default_rng([9, seed])
        profiles = [
            Profile(p.points + np.outer(np.convolve(rng.normal(0.0, made.sensor.noise_m,
                    len(p.points) + 4), taps, "valid"), [0.0, 1.0]), p.name)
            for p in made.exact.profiles
        ]  # fmt: skip
        data = replace(made.measure(rng), profiles=profiles)
        found.append(solve_tracker(data, made.told(rng), made.sizes.noise))
    return found


def test_noise_that_neighbours_share_is_no_misfit_of_honest_profiles():
    for one in smoothed():
        assert not one.rejected  # 0.01 each by chance
        assert one.more["residual_over_noise"] < 1.15  # of some 600 numbers: 1 +- 0.03
    off = np.array([error(cell("prp"), one.T_flange_sensor) for one in smoothed()])
    spread = np.array([one.covariance for one in smoothed()])
    chi2 = np.einsum("ni,nij,nj->", off, np.linalg.inv(spread), off)
    assert abs(chi2 / off.size - 1.0) < 4.0 * np.sqrt(2.0 / off.size)


def with_arc(which: int, arc: Arc) -> TrackerData:
    arcs = list(noisy().arcs)
    arcs[which] = arc
    return replace(noisy(), arcs=(arcs[0], arcs[1]))


@pytest.mark.long
def test_a_table_and_a_stem_in_the_field_do_no_harm():
    """With all the sensor's depth, dropouts, and light that is mirrored to another place."""
    made = cell("prp")
    view = made.T_base_view
    top = view @ frames.transform(np.diag([1.0, -1.0, -1.0]), [-0.5, 0.0, 0.29])
    square = np.array([[-0.5, -0.05], [0.5, -0.05], [0.5, 0.0], [-0.5, 0.0]])
    stem = Stem(made.centre, view[:3, 2], 0.25 * made.sizes.target.sphere_radius_m, 0.08)
    seen = replace(made.sensor, far_m=0.4, dropouts=0.02, ghosts=0.05)
    busy = replace(made, around=(Prism(top, square, 1.0), stem), sensor=seen)
    found = solve(busy.measure(np.random.default_rng(6)), "best", busy)
    assert found.verdict.accept
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(error(busy, found.T_flange_sensor)) < 4.0 * sigma)
    assert found.residual_m.max() < 3.0 * busy.sensor.noise_m


def test_a_slide_needs_the_reflectors_height():
    with pytest.raises(RankDeficientError, match="height of the reflector") as caught:
        solve(noisy(), height_m=None)
    assert caught.value.directions == ("position along the axis of joint 2",)


def first_arc(change) -> TrackerData:
    return with_arc(0, change(noisy().arcs[0]))


def with_other_arm() -> TrackerData:
    mdh = np.array(noisy().arm.mdh)
    mdh[1, 3] = np.radians(80.0)
    return replace(noisy(), arm=noisy().arm.with_mdh(mdh))


def drifting(arc: Arc) -> Arc:
    return replace(arc, q=arc.q + np.linspace(0.0, 0.1, len(arc.q))[:, None] * [0.0, 0.0, 1.0])


REFUSED = {
    "arc_a has 4 points": (
        TooFewSamplesError, lambda d: first_arc(lambda a: Arc(a.name, a.q[:4], a.points[:4])),
    ),
    "turns over 12 deg": (
        TooFewSamplesError, lambda d: first_arc(lambda a: replace(a, q=a.q * [1.0, 0.1, 1.0])),
    ),
    "joint2, joint3 moved": (InputError, lambda d: first_arc(drifting)),
    "both of joint 2": (
        RankDeficientError, lambda d: with_arc(1, replace(d.arcs[0], name="arc_b")),
    ),
    r"90\.0. deg in the tracker and at 80\.00 deg": (ResidualError, lambda d: with_other_arm()),
    "left-handed": (ResidualError, lambda d: replace(d, q=2.0 * d.q[0] - d.q)),  # built backwards
    "face_1 lie nearly on a line": (
        RankDeficientError,
        lambda d: replace(d, faces=(d.faces[0][:3].repeat(2, axis=0), d.faces[1])),
    ),
    "face_2 has 3 tracker points": (
        TooFewSamplesError, lambda d: replace(d, faces=(d.faces[0], d.faces[1][:3])),
    ),
    "scan has 5 profiles": (
        TooFewSamplesError, lambda d: replace(d, q=d.q[:5], profiles=d.profiles[:5]),
    ),
    "slide over at least 20 mm": (
        ResidualError, lambda d: replace(d, q=np.tile(d.q[0], (len(d.q), 1))),
    ),
    r"centres of the sphere differ by (0\.9|1\.0)": (
        ResidualError,
        lambda d: replace(d, sphere=d.sphere + 1e-3 * np.eye(3)[0] * np.eye(3)[:, :1]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("words", list(REFUSED))
def test_what_tells_too_little_or_contradicts_itself_is_refused(words):
    kind, change = REFUSED[words]
    with pytest.raises(kind, match=words):
        solve(change(noisy()))


def test_a_path_that_is_no_circle():
    """It bends one way, then the other: circles of ever larger radius are no worse."""
    arc = noisy().arcs[0]
    t = np.linspace(-1.0, 1.0, len(arc.q))
    bent = np.column_stack([0.1 * t, 0.005 * t**3, np.zeros(len(t))])
    with pytest.raises(ResidualError, match="arc_a: no circle fits its points"):
        solve(with_arc(0, replace(arc, points=bent)))


def test_a_sphere_whose_place_moves_on_is_refused(monkeypatch):
    """After one round alone: the closed form leaves it more than 10 um off."""
    monkeypatch.setattr(tracker, "MOST_ROUNDS", 1)
    with pytest.raises(ResidualError, match="did not settle in 1 rounds"):
        solve(noisy())


def test_a_wrong_sphere_is_named():
    with pytest.raises(ResidualError, match=r"radius of 19\.\d+ mm, the sphere's is 19\.550 mm"):
        solve(noisy(), sphere_radius_m=0.01955)
    with pytest.raises(ResidualError, match=r"the sphere's is 25\.000 mm"):
        solve(noisy(), sphere_radius_m=0.025)


def test_profiles_with_x_reversed_are_of_a_sensor_that_is_turned_about_its_beam():
    data = noisy()
    profiles = [Profile(p.points * [-1.0, 1.0], p.name) for p in data.profiles]
    other = solve(replace(data, profiles=profiles))
    turned = clean().T_flange_sensor @ np.diag([-1.0, -1.0, 1.0, 1.0])
    away = frames.invert(turned) @ other.T_flange_sensor
    assert np.all(np.abs(away[:3, 3]) < np.sqrt(np.diag(clean().covariance))[:3])


@pytest.mark.long
@pytest.mark.parametrize("method", ["best", "classic"])
def test_a_sensor_that_tells_heights_is_placed_in_its_own_axes(method):
    """z = 0 lies 0.2 m before the other's origin; y follows by the right-hand rule."""
    made = cell("prp")
    heights = [replace(p, points=p.points * [1.0, -1.0] + [0.0, 0.2]) for p in noisy().profiles]
    data = replace(noisy(), profiles=heights)
    found = solve_tracker(data, made.sizes.target, made.sizes.noise, method, towards=True)
    ahead = frames.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.2])
    away = frames.invert(clean(method).T_flange_sensor @ ahead) @ found.T_flange_sensor
    assert np.abs(away - np.eye(4)).max() < 1e-5  # closed form and descent stop at 1e-6
    assert found.working_error_m == pytest.approx(clean(method).working_error_m, rel=1e-2)


def test_z_that_grows_the_other_way_is_asked_for():
    heights = [replace(p, points=p.points * [1.0, -1.0]) for p in noisy().profiles]
    with pytest.raises(ResidualError, match="does z of the profiles grow the way"):
        solve(replace(noisy(), profiles=heights))


def test_another_face_of_the_cube_is_no_match():
    """The tracker's face_2 is one that the scan does not show."""
    made = cell("prp")
    R, t = made.T_base_cube[:3, :3], made.T_base_cube[:3, 3]
    grid = np.array([[a, b] for a in (0.02, 0.06) for b in (0.02, 0.06)])
    end = np.column_stack(
        [np.full(4, -made.sizes.target.reflector_radius_m), grid[:, 0], -grid[:, 1]]
    )
    T = made.T_tracker_base
    points = (end @ R.T + t) @ T[:3, :3].T + T[:3, 3]
    with pytest.raises(ResidualError, match="were other faces touched"):
        solve(replace(noisy(), faces=(noisy().faces[0], points)))


def test_an_edge_square_to_the_slide_leaves_two_answers():
    made = replace(cell("prp"), edge_rad=np.radians(90.0), lean_rad=0.0)
    with pytest.raises(RankDeficientError, match="two mountings") as caught:
        solve(made.exact, "best", made)
    assert caught.value.directions


def test_noise_far_above_what_was_told_is_refused():
    made = cell("prp")
    told = replace(made.sizes.noise, joint_m=2e-7, joint_rad=5e-7, tracker_m=5e-6)
    found = solve_tracker(noisy(), made.sizes.target, told)
    assert found.verdict.code.name == "RESIDUAL_TOO_LARGE"


@pytest.mark.parametrize(("kept_of_ten", "code"), [(7, "ACCEPT"), (6, "RESIDUAL_TOO_LARGE")])
def test_what_fits_most_of_the_numbers_alone_is_refused(kept_of_ten, code):
    """However well it fits those."""
    _, estimate, _ = solved()
    rows = np.arange(len(estimate.rejected))
    verdict = judge_tracker(replace(estimate, rejected=rows % 10 >= kept_of_ten), 1e-4, 5e-4)
    assert verdict.code.name == code
    assert ("numbers left out" in verdict.reason) == (code != "ACCEPT")


@pytest.mark.parametrize("angle", [1e-9, 1.5, np.pi - 1e-4, np.pi])
def test_the_spread_of_runs_at_any_angle(angle):
    """Turns of +-1e-5 rad about the axis itself, and 0.1 mm along it."""
    axis = np.array([0.6, 0.0, 0.8])
    poses = np.array(
        [
            frames.transform(frames.exp_rotation((angle + s * 1e-5) * axis), [s * 1e-4, 0.0, 0.0])
            for s in (-1.0, 0.0, 1.0)
        ]
    )
    found = spread(poses)
    assert np.allclose(found.turn_rad, [1e-5, 0.0, 1e-5], atol=1e-12)
    assert np.allclose(found.translation_m, [1e-4, 0.0, 1e-4], atol=1e-12)
    if angle > 1.0:
        assert np.allclose(found.angle_rad, [1e-5, 0.0, 1e-5], atol=1e-8)
        assert np.allclose(found.axis, 0.0, atol=1e-7)
