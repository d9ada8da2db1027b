# SPDX-License-Identifier: Apache-2.0
"""A reference sphere of known radius: the arc of its cut by a laser plane, or a cloud of its cap.

An arc's profile may hold the table, the stem, gaps, spikes and double reflections. The start is the
circle nearest to most points (`find_circle`); the answer is the maximum likelihood over the points
whose residual fits its own predicted variance. How the noise depends on the slope of the surface
is estimated with it: sensors err along the beam, along the surface's normal, or in between.
Source of the use: methods of the fixed sphere, where y = +-sqrt(R^2 - r^2).

A cloud may hold the stem, the background and spikes. A sphere through three random points and
the known radius is the start (Fischler and Bolles 1981, scored by truncated squares: MSAC, Torr
and Zisserman 2000); Gauss-Newton over the points near it is the answer.
"""

from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import FALSE_REJECTION, chi2_quantile
from robocal_ros.estimation.surfaces import (
    FEWEST_POINTS,
    MAD,
    OPPOSITE,
    SMALLEST_M,
    local_noise,
    mirror,
    on_curve,
    smoothed,
)
from robocal_ros.ground.errors import (
    InputError,
    RankDeficientError,
    ResidualError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, Mask
from robocal_ros.ground.samples import (
    DEFAULT_TARGET,
    SPHERE_CLOUD,
    PointSample,
    cloud_points,
    frame_and_target,
    stamp_ns,
)

# ---- where in a profile a circle may be: the start of `fit_arc` ---------------------------------
#
# Circles through three points of the smoothed profile, at all places and several widths, judged by
# truncated squares (MSAC, Torr and Zisserman 2000); the best ones are improved by Gauss-Newton
# over the points near them (Chum, Matas and Kittler 2003) and judged again. Nothing is drawn at
# random.


SMALLEST_SHARE, LARGEST_SHARE = 0.2, 1.5  # radius of a circle, of the sphere's
_FLAT_SHARE = 4.0  # what was thought a circle grows beyond this where it is a piece of a plane
_WIDTHS = (0.12, 0.2, 0.33, 0.55, 0.8)  # between the points of a triple, of the sphere's radius
_PLACES, _JUDGES = 128, 320
_BEST = 4
_REACHES = (2.0, 1.4, 1.0)  # limits, one after the other
_RIDGE = 1e-12  # keeps a flat piece solvable; where steps end it does not matter
_FEWEST = 8  # points that improve a start


def find_circle(points: Array, radius: float, limit: float) -> Array | None:
    """The circle (x0, z0, r) with its near side on most points (n, 2); None if there is none.

    ``points`` (n, 2): of the profile, m. ``radius``: of the sphere, m; the circle's is 0.2 to 1.5
    of it. ``limit``: distance from the circle within which a point is near it, m.
    """
    # Circles (c, 3) through triples (t, 3, 2); those whose near side passes through the middle.
    triples = _triples(points, radius)
    a, b = triples[:, 0] - triples[:, 1], triples[:, 2] - triples[:, 1]
    area = 2.0 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    # The outer points lie further from the sensor than the middle one: the surface is convex.
    convex = area < -np.finfo(float).tiny
    a, b, area, middle = a[convex], b[convex], area[convex], triples[convex, 1]
    aa, bb = np.sum(a * a, axis=1), np.sum(b * b, axis=1)
    foot = np.column_stack([b[:, 1] * aa - a[:, 1] * bb, a[:, 0] * bb - b[:, 0] * aa])
    foot /= area[:, None]
    circles = np.column_stack([middle + foot, np.sqrt(np.sum(foot * foot, axis=1))])
    circles = circles[
        (circles[:, 2] > SMALLEST_SHARE * radius) & (circles[:, 2] < LARGEST_SHARE * radius)
    ]
    if not len(circles):
        return None
    judges = points[:: max(len(points) // _JUDGES, 1)]
    best = circles[np.argsort(_costs(circles, judges, limit), kind="stable")[:_BEST]]
    improved = np.array([_improved_circle(circle, points, limit) for circle in best])
    improved = improved[improved[:, 2] < _FLAT_SHARE * radius]
    if not len(improved):
        return None
    return np.asarray(improved[np.argmin(_costs(improved, points, limit))])


def step(J: Array, residual: Array, weight: Array | float = 1.0) -> tuple[Array, Array]:
    """Least-squares increment (3,) of a circle and the normal matrix (3, 3) it comes from."""
    weighted = J.T * weight
    normal = weighted @ J
    ridge = _RIDGE * np.trace(normal) * np.eye(3)
    return -np.linalg.solve(normal + ridge, weighted @ residual), normal


def linearised(circle: Array, points: Array) -> tuple[Array, Array]:
    """Jacobian (n, 3) and residual (n,), distance from the centre less r, of points (n, 2).

    The unknowns are those of the circle (x0, z0, r).
    """
    away = points - circle[:2]
    distance = np.sqrt(np.einsum("ij,ij->i", away, away))
    J = np.full((len(points), 3), -1.0)
    J[:, :2] = -away / np.maximum(distance, np.finfo(float).tiny)[:, None]
    return J, distance - circle[2]


def _triples(points: Array, radius: float) -> Array:
    """Triples (t, 3, 2), left to right, of the smoothed profile."""
    smooth = smoothed(points[np.argsort(points[:, 0], kind="stable")])
    x = smooth[:, 0]
    middle = np.linspace(0, len(x) - 1, min(_PLACES, len(x))).round().astype(np.int64)
    reach = radius * np.array(_WIDTHS)[:, None]
    last = len(x) - 1
    left = np.searchsorted(x, x[middle] - reach).ravel()
    right = np.minimum(np.searchsorted(x, x[middle] + reach), last).ravel()
    rows = np.column_stack([left, np.tile(middle, len(_WIDTHS)), right])
    return np.asarray(smooth[rows])


def _costs(circles: Array, points: Array, limit: float) -> Array:
    """Truncated squares (c,) of the points' distances from the near sides of circles (c, 3)."""
    square = _misses(circles, points)
    np.square(square, out=square)
    square[points[:, 1] >= circles[:, 1:2]] = limit**2
    return np.asarray(np.minimum(square, limit**2, out=square).sum(axis=1))


def _misses(circles: Array, points: Array) -> Array:
    """Distances (c, n) of points from circles (c, 3), exact near the circle.

    ``((x - x0)^2 + (z - z0)^2 - r^2) / 2 r`` as one product of matrices.
    """
    away = points - points[0]  # so that squares of large numbers do not cancel
    x0, z0 = (circles[:, :2] - points[0]).T
    powers = np.stack([np.sum(away * away, axis=1), *away.T, np.ones(len(away))])
    r = circles[:, 2]
    shape = np.column_stack([np.ones(len(r)), -2.0 * x0, -2.0 * z0, x0**2 + z0**2 - r**2])
    return np.asarray((shape / (2.0 * r)[:, None]) @ powers)


def _improved_circle(circle: Array, points: Array, limit: float) -> Array:
    for reach in _REACHES:
        near = np.abs(_misses(circle[None], points)[0]) < reach * limit
        near &= points[:, 1] < circle[1]
        if np.sum(near) < _FEWEST:
            break
        circle = circle + step(*linearised(circle, points[near]))[0]
    return circle


# ---- the circle in which a laser plane cuts a reference sphere, from one profile ----------------


_NEAR = 3.5  # standard deviations of a point near a start
_NEAR_M = 2e-5
_FREE_ROUNDS = 25  # in which a point that was left out may come back
_GRANTED = 1.5  # of the largest noise allowed, lest the table becomes part of a noisy arc
_ISOTROPIC = 5.0  # points' worth of belief that noise does not depend on the slope
_STEEPEST = 0.05  # smallest share of variances of both directions
_SURE = 4.0  # standard deviations
_FORM_DEGREE = 6  # of the polynomial that a smooth deviation is
_ROUND = 0.01  # largest deviation of a sphere from its arc, of the arc's depth
_FORM_SEEN = 0.999  # quantile of chi-square beyond which it is no noise


class LargeArcError(ResidualError):
    """An arc of a larger circle than a plane can cut out of the sphere."""


@dataclass(frozen=True)
class ArcRule:
    """What the arc of a sphere in a profile must be like.

    ``radius_m``: R, of the sphere. ``radius_tolerance_m``: how far the arc's radius may exceed the
    sphere's. ``radius_sigma_m``: largest standard deviation of the arc's radius; a short arc has a
    larger one. ``noise_m``: largest standard deviation of a point along its normal. ``towards``:
    whether z grows towards the sensor (a height), not away from it (a distance).
    """

    radius_m: float
    radius_tolerance_m: float = 1e-4
    radius_sigma_m: float = 4e-4
    noise_m: float = 2e-4
    towards: bool = False


@dataclass(frozen=True, eq=False)
class ArcFit:
    """A fitted arc.

    ``centre`` (2,): x0, z0 of the circle, sensor frame, m. ``radius_m``: r, of the circle.
    ``covariance`` (3, 3): of (x0, z0, r) from the points' scatter and form, m^2. ``noise_m``:
    standard deviation of a point along its normal, root mean square over the arc. ``form_m``: rms
    of the smooth deviation from the circle where it is more than noise, else 0: of the sensor's
    linearity, of light that enters the surface, of the surface. ``used`` (n,): which points were
    taken for the arc's.
    """

    centre: Array
    radius_m: float
    covariance: Array
    noise_m: float
    form_m: float
    used: Mask


def fit_arc(points: Array, rule: ArcRule) -> ArcFit:
    """Fit the near side of a circle to points (n, 2) of a profile: x, z in the sensor frame, m.

    Points are in the order of the sensor's columns. The circle's radius is 0.2 R to R of the
    sphere.

    Raises `TooFewSamplesError`: fewer than 20 points on a circle; `ResidualError`: no arc, one that
    opens the other way, an arc larger than the sphere, too much noise, a surface that is not round,
    or an arc too short to know its radius: the message holds the figure that failed; `InputError`:
    the radius as given is a thousand times too small or too large for the arc that is there.
    """
    finite = np.all(np.isfinite(points), axis=1)
    turned = mirror(rule.towards)
    rows = np.ascontiguousarray(points[finite] * turned, dtype=np.float64)
    if len(rows) < FEWEST_POINTS:
        raise TooFewSamplesError(
            f"{len(rows)} points give no arc: at least {FEWEST_POINTS} are needed; check the "
            "exposure and that the sphere is in range"
        )
    try:
        fit = _fitted(rows, rule)
        _require(fit, rows, rule)
    except RobocalError:
        _blame_radius(rows, rule)
        _blame_sense(rows, rule)
        raise
    used = np.zeros(len(finite), dtype=np.bool_)
    used[np.flatnonzero(finite)[fit.used]] = True
    axes = np.append(turned, 1.0)
    covariance = fit.covariance * np.outer(axes, axes)
    return ArcFit(fit.centre * turned, fit.radius_m, covariance, fit.noise_m, fit.form_m, used)


def _fitted(points: Array, rule: ArcRule) -> ArcFit:
    """The arc of a sphere of about this radius, whatever its quality."""
    limit = max(_NEAR * local_noise(points[:, 1]), _NEAR_M)
    circle = find_circle(points, rule.radius_m, limit)
    if circle is None:
        raise ResidualError(
            f"no arc of a sphere of radius {rule.radius_m * 1e3:.6g} mm is in the profile: check "
            "the radius, and that the laser line crosses the sphere"
        )
    residual = linearised(circle, points)[1]
    used = on_curve((residual / limit) ** 2) & (points[:, 1] < circle[1])
    ab = np.full(2, (limit / _NEAR) ** 2)
    for attempt in count():
        if np.sum(used) < FEWEST_POINTS:
            raise TooFewSamplesError(
                f"{np.sum(used)} of {len(points)} points lie on an arc: at least {FEWEST_POINTS} "
                "are needed; clean the sphere, or bring it into the laser line"
            )
        circle, covariance = _improved(circle, points[used], ab)
        J, residual = linearised(circle, points)
        pull = np.einsum("ij,jk,ik->i", J, covariance, J)
        parts = _parts(circle, points)
        ab = _variances(parts[used], residual[used], pull[used] / (parts[used] @ ab))
        excess = _excess(residual, parts @ ab, np.where(used, -pull, pull), rule.noise_m)
        update = on_curve(excess) & (points[:, 1] < circle[1])
        if attempt >= _FREE_ROUNDS:  # a point at the limit must not come and go for ever
            update = update & used
        if np.array_equal(update, used):
            break
        used = update
    circle, covariance = _improved(circle, points[used], ab)
    variance = _parts(circle, points[used]) @ ab
    form, of_form = _form(circle, points[used], variance)
    noise = float(np.sqrt(np.mean(variance)))
    return ArcFit(circle[:2], float(circle[2]), covariance + of_form, noise, form, used)


def _parts(circle: Array, points: Array) -> Array:
    """Shares (n, 2) of the variances along and across the beam in that along the normal.

    The slope is taken from x: where the noise is along the beam, it then does not depend on it.
    """
    sine = np.clip((points[:, 0] - circle[0]) / circle[2], -1.0, 1.0) ** 2
    return np.column_stack([1.0 - sine, sine])


def _variances(parts: Array, residual: Array, leverage: Array) -> Array:
    """Variances (2,) of a point along and across the beam, by regression of squared residuals."""
    robust = (MAD * float(np.median(np.abs(residual)))) ** 2 + SMALLEST_M**2
    square = residual**2 / np.maximum(1.0 - leverage, 0.5)
    ab = np.full(2, robust)
    for _ in range(3):
        weight = robust**2 / (parts @ ab) ** 2
        normal = (parts.T * weight) @ parts + _ISOTROPIC * np.array([[1.0, -1.0], [-1.0, 1.0]])
        ab = np.linalg.solve(normal, parts.T @ (weight * square))
        ab = np.maximum(ab, _STEEPEST * float(np.max(ab))) + SMALLEST_M**2
    return np.asarray(ab)


def _improved(circle: Array, points: Array, ab: Array) -> tuple[Array, Array]:
    """Circle after a step of the maximum likelihood, and its covariance (3, 3).

    The normal is that of the likeliest true point, which the residual does not depend on: that of
    the measured point would bias the circle where the noise is not along the normal.
    """
    J, residual = linearised(circle, points)
    variance = _parts(circle, points) @ ab
    # J holds the normal with a minus sign: the true point is this far from the measured one.
    moved = points + (residual / variance)[:, None] * J[:, :2] * ab[::-1]
    J, _ = linearised(circle, moved)
    residual = -np.einsum("ij,ij->i", J[:, :2], points - circle[:2]) - circle[2]
    increment, information = step(J, residual, 1.0 / variance)
    return circle + increment, np.asarray(np.linalg.pinv(information, hermitian=True))


def _excess(residual: Array, variance: Array, pull: Array, noise: float) -> Array:
    """Squared residual (n,) of points over the largest one that their variance explains.

    ``pull`` is the variance of the circle at a point: less than zero where the point, in use,
    pulled the circle to itself. No more than the largest noise allowed is granted.
    """
    expected = np.minimum(variance + np.maximum(pull, -0.5 * variance), (_GRANTED * noise) ** 2)
    limit = chi2_quantile(1.0 - FALSE_REJECTION / len(residual), 1.0)
    return np.asarray(residual**2 / (limit * expected))


def _require(fit: ArcFit, points: Array, rule: ArcRule) -> None:
    r, R = fit.radius_m, rule.radius_m
    sigma = float(np.sqrt(fit.covariance[2, 2]))
    if fit.noise_m > rule.noise_m:
        raise ResidualError(
            f"the points scatter by {fit.noise_m * 1e3:.3f} mm about the arc (allowed "
            f"{rule.noise_m * 1e3:.3f} mm): clean the sphere and check the exposure"
        )
    if fit.form_m > _ROUND * float(np.ptp(points[fit.used, 1])):
        raise ResidualError(
            f"the surface differs from an arc of radius {r * 1e3:.3f} mm by {fit.form_m * 1e3:.3f} "
            "mm: it is not round; show the sphere to the sensor"
        )
    if sigma > rule.radius_sigma_m or r < _SURE * sigma:
        raise ResidualError(
            f"the arc is too short: its radius of {r * 1e3:.3f} mm is known to {sigma * 1e3:.3f} "
            f"mm (allowed {rule.radius_sigma_m * 1e3:.3f} mm); show the sensor more of the sphere"
        )
    if r - R > max(rule.radius_tolerance_m, _SURE * sigma):
        raise LargeArcError(
            f"the profile shows an arc of radius {r * 1e3:.3f} mm, but a plane cuts a sphere of "
            f"radius {R * 1e3:.3f} mm in no larger circle than that: check which sphere is "
            "mounted, and the sensor's scale"
        )


def _form(circle: Array, points: Array, variance: Array) -> tuple[float, Array]:
    """Rms of the smooth part of the residuals, m, and what it does to the circle (3, 3).

    Those degrees of a polynomial that no circle takes up tell how large each degree is, beyond the
    noise of points (n,); those that look like a shift or another radius are taken for as large.
    """
    J, residual = linearised(circle, points)
    x = points[:, 0] - points[:, 0].mean()
    shape = np.polynomial.legendre.legvander(x / np.max(np.abs(x)), _FORM_DEGREE)
    Q = np.linalg.qr(np.column_stack([J, shape[:, 3:]]))[0][:, 3:]
    seen = Q.T @ residual
    noise = float(np.mean(variance))
    total, count = float(np.sum(seen**2)), len(seen)
    if total <= noise * chi2_quantile(_FORM_SEEN, count):
        return 0.0, np.zeros((3, 3))
    alike = 2 * np.arange(_FORM_DEGREE + 1) + 1.0  # degrees of one rms
    size = alike * total / float(np.sum(alike * (Q.T @ shape) ** 2))
    sigma = np.sqrt(variance)[:, None]
    pull = np.linalg.pinv(J / sigma) @ (shape / sigma)
    return float(np.sqrt(total / len(points))), (pull * size) @ pull.T


def _blame_radius(points: Array, rule: ArcRule) -> None:
    """Raise when a sphere of a radius a thousand times smaller or larger is there instead."""
    for factor, word in ((1e-3, "large"), (1e3, "small")):
        other = replace(rule, radius_m=rule.radius_m * factor)
        try:
            fit = _fitted(points, other)
            _require(fit, points, other)
        except RobocalError:
            continue
        raise InputError(
            f"the profile shows an arc of radius {fit.radius_m * 1e3:.3f} mm, the sphere's radius "
            f"is given as {rule.radius_m * 1e3:.6g} mm, 1000 times too {word} for this arc: check "
            "its unit"
        )


def _blame_sense(points: Array, rule: ArcRule) -> None:
    """Raise when the arc is there, and opens the other way."""
    turned = points * mirror(True)
    try:
        fit = _fitted(turned, rule)
        _require(fit, turned, rule)
    except RobocalError:
        return
    raise ResidualError(
        f"the profile shows an arc of radius {fit.radius_m * 1e3:.3f} mm that opens the wrong way: "
        f"z of this sensor grows the other way, set z_grows {OPPOSITE[rule.towards]}"
    )


# ---- the centre of a reference sphere of known radius, from a cloud of points of its cap --------

FEWEST_ON_CAP = 30
# How many triples are tried, and how many points complete and judge them: first in haste, then,
# where that finds nothing, for a sphere among much else.
_EFFORTS = ((100, 150), (400, 400))
_THIN = 1e-3  # of the radius: points that leave a plane by less, rms, lie in it
_REACH = 1.5  # radii between the points of a triple
_NEAR_CAP_M = 3e-4  # a start is judged by the points so near to it
_ROUNDS = 12
_REJECT = 3.5  # standard deviations
_CLOSE_M = 1e-8


@dataclass(frozen=True)
class SphereRule:
    """What a measured sphere must be like.

    ``radius_m``: certified radius. ``radius_tolerance_m``: how far the radius of the measured
    points may be off. ``noise_m``: largest standard deviation of a point along its normal.
    ``centre_sigma_m``: largest standard deviation of the centre in any direction.
    ``half_angle_rad``: smallest half angle of the cap; a smaller one turns a form error of the
    sensor into several times as much of the centre.
    """

    radius_m: float
    radius_tolerance_m: float = 1e-4
    noise_m: float = 2e-4
    centre_sigma_m: float = 3e-5
    half_angle_rad: float = float(np.radians(20.0))


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A fitted sphere.

    ``centre`` (3,): in the frame of the points, m. ``covariance`` (3, 3): of the centre from the
    points' scatter, m^2. ``noise_m``: standard deviation of a point along its normal. ``radius_m``,
    ``radius_sigma_m``: of a fit with free radius; checks the known one. ``half_angle_rad``: of the
    cone about the cap's middle that holds 95 % of its points. ``used`` (n,): which points were
    taken for the sphere's.
    """

    centre: Array
    covariance: Array
    noise_m: float
    radius_m: float
    radius_sigma_m: float
    half_angle_rad: float
    used: NDArray[np.bool_]


def fit_sphere(points: Array, rule: SphereRule) -> SphereFit:
    """Fit the centre of a sphere of known radius to points (n, 3), m.

    The same cloud always gives the same answer: the starts are drawn with a fixed seed.

    Raises `TooFewSamplesError`: fewer than 30 finite points on a sphere; `RankDeficientError`:
    points of one plane; `ResidualError`: a wrong radius, too much noise, or a cap too small for a
    centre that is known well enough: the message holds the figure that failed and its limit.
    """
    finite = np.all(np.isfinite(points), axis=1)
    cloud = np.ascontiguousarray(points[finite], dtype=np.float64)
    if len(cloud) < FEWEST_ON_CAP:
        raise TooFewSamplesError(
            f"{len(cloud)} points give no sphere's centre: at least {FEWEST_ON_CAP} are needed"
        )
    for triples, judges in _EFFORTS:
        try:
            centre, near = _refine(cloud, _start(cloud, rule, triples, judges), rule)
            break
        except TooFewSamplesError:
            if (triples, judges) == _EFFORTS[-1]:
                raise
    thin, wide, _ = np.linalg.eigvalsh(np.cov(cloud[near].T))
    if thin < (_THIN * rule.radius_m) ** 2 < wide:
        raise RankDeficientError(
            "the points lie in one plane, which does not tell a sphere's centre: a cap must be "
            "seen, as by an area scanner, or by a line laser in several profiles",
            ("the centre, across that plane",),
        )
    fit = _report(cloud, centre, near, finite)
    _require_sphere(fit, rule)
    return fit


def _start(cloud: Array, rule: SphereRule, triples: int, judge_count: int) -> Array:
    """The best of the spheres through three points that lie near each other."""
    rng = np.random.default_rng(0)
    first = cloud[rng.integers(len(cloud), size=triples)]
    judges = cloud[rng.integers(len(cloud), size=judge_count)]
    near = _squared(first, judges) < (_REACH * rule.radius_m) ** 2
    order = (np.arange(judge_count) + rng.integers(judge_count, size=(triples, 1))) % judge_count
    rows, near = np.arange(triples), np.take_along_axis(near, order, axis=1)
    second = near.argmax(axis=1)
    near[rows, second] = False
    third = near.argmax(axis=1)
    complete = near[rows, third]
    partners = judges[order[rows[:, None], np.column_stack([second, third])]]
    triple = np.concatenate([first[:, None], partners], axis=1)[complete]
    centres = _centres(triple, rule.radius_m)
    if not len(centres):
        raise TooFewSamplesError(
            f"no sphere of radius {rule.radius_m * 1e3:.3f} mm passes through these points: check "
            "the radius, the unit of the cloud (metres), and that the sphere is in the field"
        )
    # The distance from the surface, near the surface.
    miss = (_squared(centres, judges) - rule.radius_m**2) / (2.0 * rule.radius_m)
    limit = max(_NEAR_CAP_M, 3.0 * rule.noise_m)
    return np.asarray(centres[np.argmin(np.sum(np.minimum(miss**2, limit**2), axis=1))])


def _squared(a: Array, b: Array) -> Array:
    """Squared distances (m, n) between points (m, 3) and (n, 3)."""
    square = -2.0 * a @ b.T
    square += np.einsum("ij,ij->i", a, a)[:, None]
    square += np.einsum("ij,ij->i", b, b)
    return np.asarray(square)


def _centres(triple: Array, radius: float) -> Array:
    """Both centres (c, 3) of spheres of this radius through each three points (m, 3, 3)."""
    a, b = triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0]
    normal = np.cross(a, b)
    area = np.einsum("ij,ij->i", normal, normal)
    wide = area > (0.02 * radius**2) ** 2  # near points give a centre of noise
    a, b, normal, area, first = a[wide], b[wide], normal[wide], area[wide, None], triple[wide, 0]
    aa, bb = np.sum(a * a, axis=1, keepdims=True), np.sum(b * b, axis=1, keepdims=True)
    foot = np.cross(aa * b - bb * a, normal) / (2.0 * area)  # of the circumscribed circle
    rise = radius**2 - np.sum(foot**2, axis=1)
    fits = rise > 0.0
    up = normal[fits] * np.sqrt(rise[fits, None] / area[fits])
    middle = first[fits] + foot[fits]
    return np.vstack([middle + up, middle - up])


def _refine(cloud: Array, centre: Array, rule: SphereRule) -> tuple[Array, NDArray[np.bool_]]:
    """Gauss-Newton and rejection in turn until the points in use no longer change."""
    limit = max(_NEAR_CAP_M, 3.0 * rule.noise_m)
    near = np.zeros(len(cloud), dtype=np.bool_)
    for _ in range(_ROUNDS):
        away, distance = _distances(cloud, centre)
        miss = distance - rule.radius_m
        before, near = near, np.abs(miss) < limit
        if np.sum(near) < FEWEST_ON_CAP:
            raise TooFewSamplesError(
                f"{np.sum(near)} of {len(cloud)} points lie on a sphere: at least {FEWEST_ON_CAP} "
                "are needed; clean the sphere, or bring it into the sensor's field"
            )
        direction = away[near] / distance[near, None]
        step = np.linalg.solve(direction.T @ direction, direction.T @ miss[near])
        centre = centre + step
        if np.array_equal(before, near) and float(np.linalg.norm(step)) < _CLOSE_M:
            break
        # Its own scatter, about the median: a wrong radius shifts all of them.
        spread = MAD * float(np.median(np.abs(miss[near] - np.median(miss[near]))))
        limit = min(limit, _REJECT * spread + abs(float(np.median(miss[near]))) + _CLOSE_M)
    return centre, near


def _distances(cloud: Array, centre: Array) -> tuple[Array, Array]:
    away = cloud - centre
    return away, np.sqrt(np.einsum("ij,ij->i", away, away))


def _report(
    cloud: Array, centre: Array, near: NDArray[np.bool_], finite: NDArray[np.bool_]
) -> SphereFit:
    away, distance = _distances(cloud[near], centre)
    direction = away / distance[:, None]
    count = len(direction)
    # Free radius, linearised here: unknowns are the shift of the centre and the radius.
    J = np.column_stack([direction, np.ones(count)])
    free, *_ = np.linalg.lstsq(J, distance, rcond=None)
    residual = distance - J @ free
    noise = float(np.sqrt(residual @ residual / max(count - 4, 1)))
    information = direction.T @ direction
    middle = direction.mean(axis=0)
    cosine = direction @ (middle / np.linalg.norm(middle))
    used = np.zeros(len(finite), dtype=np.bool_)
    used[np.flatnonzero(finite)[near]] = True
    return SphereFit(
        centre=centre,
        covariance=np.asarray(noise**2 * np.linalg.inv(information)),
        noise_m=noise,
        radius_m=float(free[3]),
        radius_sigma_m=noise * float(np.sqrt(np.linalg.inv(J.T @ J)[3, 3])),
        half_angle_rad=float(np.arccos(np.clip(np.quantile(cosine, 0.05), -1.0, 1.0))),
        used=used,
    )


def _require_sphere(fit: SphereFit, rule: SphereRule) -> None:
    if fit.noise_m > rule.noise_m:
        raise ResidualError(
            f"the points scatter by {fit.noise_m * 1e3:.3f} mm about the sphere (allowed "
            f"{rule.noise_m * 1e3:.3f} mm): clean the sphere and check the exposure"
        )
    off = abs(fit.radius_m - rule.radius_m)
    if off > rule.radius_tolerance_m and off > 4.0 * fit.radius_sigma_m:
        raise ResidualError(
            f"the points lie on a radius of {fit.radius_m * 1e3:.3f} mm, the sphere's is "
            f"{rule.radius_m * 1e3:.3f} mm (allowed difference "
            f"{rule.radius_tolerance_m * 1e3:.3f} mm): check which sphere is mounted, and the "
            "sensor's scale"
        )
    sigma = float(np.sqrt(np.linalg.eigvalsh(fit.covariance)[-1]))
    if fit.half_angle_rad < rule.half_angle_rad:
        raise ResidualError(
            f"the cap has a half angle of {np.degrees(fit.half_angle_rad):.0f} deg (at least "
            f"{np.degrees(rule.half_angle_rad):.0f} deg): show the sensor more of the sphere"
        )
    if sigma > rule.centre_sigma_m:
        raise ResidualError(
            f"a cap of {np.degrees(fit.half_angle_rad):.0f} deg half angle gives the centre to "
            f"{sigma * 1e3:.3f} mm (allowed {rule.centre_sigma_m * 1e3:.3f} mm): show the sensor "
            "more of the sphere"
        )


def cloud_sample(
    message: Any, rule: SphereRule, default_target: str = DEFAULT_TARGET, topic: str = SPHERE_CLOUD
) -> PointSample:
    """Build a sample of a sphere's centre from a ``sensor_msgs/PointCloud2`` of its cap.

    Raises `InputError` when the message is no cloud; as `fit_sphere` when it holds no sphere as the
    rule wants it.
    """
    frame, target = frame_and_target(message.header.frame_id, default_target)
    fit = fit_sphere(cloud_points(message), rule)
    sigma_m = float(np.sqrt(np.trace(fit.covariance) / 3.0))
    return PointSample(stamp_ns(message.header.stamp), frame, target, fit.centre, topic, sigma_m)
