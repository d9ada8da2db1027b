"""The centre of a reference sphere of known radius, from a cloud of points of its cap.

The cloud may hold the stem, the background and spikes. A sphere through three random points and
the known radius is the start (Fischler and Bolles 1981, scored by truncated squares: MSAC, Torr
and Zisserman 2000); Gauss-Newton over the points near it is the answer.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.surfaces import MAD
from robocal_ros.ground.errors import ResidualError, TooFewSamplesError
from robocal_ros.ground.samples import (
    DEFAULT_TARGET,
    SPHERE_CLOUD,
    PointSample,
    cloud_points,
    frame_and_target,
    stamp_ns,
)

Array = NDArray[np.float64]

FEWEST_POINTS = 30
# How many triples are tried, and how many points complete and judge them: first in haste, then,
# where that finds nothing, for a sphere among much else.
_EFFORTS = ((100, 150), (400, 400))
_REACH = 1.5  # radii between the points of a triple
_NEAR_M = 3e-4  # a start is judged by the points so near to it
_ROUNDS = 12
_REJECT = 3.5  # standard deviations
_CLOSE_M = 1e-8


@dataclass(frozen=True)
class SphereRule:
    """What a measured sphere must be like.

    Attributes
    ----------
    radius_m : certified radius.
    radius_tolerance_m : how far the radius of the measured points may be off.
    noise_m : largest standard deviation of a point along its normal.
    centre_sigma_m : largest standard deviation of the centre in any direction.
    half_angle_rad : smallest half angle of the cap; a smaller one turns a form error of the
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

    Attributes
    ----------
    centre : (3,) in the frame of the points, m.
    covariance : (3, 3) of the centre from the points' scatter, m^2.
    noise_m : standard deviation of a point along its normal.
    radius_m, radius_sigma_m : of a fit with free radius; checks the known one.
    half_angle_rad : of the cone about the cap's middle that holds 95 % of its points.
    used : (n,) which points were taken for the sphere's.
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

    Raises
    ------
    TooFewSamplesError
        Fewer than 30 finite points on a sphere.
    ResidualError
        A wrong radius, too much noise, or a cap too small for a centre that is known well
        enough: the message holds the figure that failed and its limit.
    """
    finite = np.all(np.isfinite(points), axis=1)
    cloud = np.ascontiguousarray(points[finite], dtype=np.float64)
    if len(cloud) < FEWEST_POINTS:
        raise TooFewSamplesError(
            f"{len(cloud)} points give no sphere's centre: at least {FEWEST_POINTS} are needed"
        )
    for triples, judges in _EFFORTS:
        try:
            centre, near = _refine(cloud, _start(cloud, rule, triples, judges), rule)
            break
        except TooFewSamplesError:
            if (triples, judges) == _EFFORTS[-1]:
                raise
    fit = _report(cloud, centre, near, finite)
    _require(fit, rule)
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
    centres = _through(triple, rule.radius_m)
    if not len(centres):
        raise TooFewSamplesError(
            f"no sphere of radius {rule.radius_m * 1e3:.3f} mm passes through these points: check "
            "the radius, the unit of the cloud (metres), and that the sphere is in the field"
        )
    # The distance from the surface, near the surface.
    miss = (_squared(centres, judges) - rule.radius_m**2) / (2.0 * rule.radius_m)
    limit = max(_NEAR_M, 3.0 * rule.noise_m)
    return np.asarray(centres[np.argmin(np.sum(np.minimum(miss**2, limit**2), axis=1))])


def _squared(a: Array, b: Array) -> Array:
    """Squared distances (m, n) between points (m, 3) and (n, 3)."""
    square = -2.0 * a @ b.T
    square += np.einsum("ij,ij->i", a, a)[:, None]
    square += np.einsum("ij,ij->i", b, b)
    return np.asarray(square)


def _through(triple: Array, radius: float) -> Array:
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
    limit = max(_NEAR_M, 3.0 * rule.noise_m)
    near = np.zeros(len(cloud), dtype=np.bool_)
    for _ in range(_ROUNDS):
        away, distance = _distances(cloud, centre)
        miss = distance - rule.radius_m
        before, near = near, np.abs(miss) < limit
        if np.sum(near) < FEWEST_POINTS:
            raise TooFewSamplesError(
                f"{np.sum(near)} of {len(cloud)} points lie on a sphere: at least {FEWEST_POINTS} "
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


def _require(fit: SphereFit, rule: SphereRule) -> None:
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

    Raises
    ------
    InputError, TooFewSamplesError, ResidualError
        When the message is no cloud, or holds no sphere as the rule wants it.
    """
    frame, target = frame_and_target(message.header.frame_id, default_target)
    fit = fit_sphere(cloud_points(message), rule)
    sigma_m = float(np.sqrt(np.trace(fit.covariance) / 3.0))
    return PointSample(stamp_ns(message.header.stamp), frame, target, fit.centre, topic, sigma_m)
