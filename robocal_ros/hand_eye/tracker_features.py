"""What a profile tells of a face and of a sphere, condensed to a few independent figures.

The sensor's noise is along its beam (z). Of a face a profile holds a line: its z at the middle of
its x, and its slope, are all that it tells. Of the sphere it tells the centre, to first order
about a place that is known well: three combinations of it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.surfaces import MAD
from robocal_ros.ground.errors import TooFewSamplesError
from robocal_ros.hand_eye.tracker_scan import Scan

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST_POINTS = 8  # of a part in a profile
FEWEST_LINES = 4
REJECT = 4.5  # standard deviations
STEEPEST = 0.25  # cosine between beam and normal below which a point of the sphere tells little
FAINT = 1e-9  # share of the largest information below which a combination tells nothing


@dataclass(frozen=True, eq=False)
class Lines:
    """A face in the m profiles.

    Attributes
    ----------
    middle : (m,) mean x, m; ``z_m`` (m,) the line there, ``slope`` (m,).
    z_sigma, slope_sigma : (m,) their standard deviations.
    seen : (m,) whether the profile shows the face; the other figures are 0, and sigma 1, without.
    """

    middle: Array
    z_m: Array
    slope: Array
    z_sigma: Array
    slope_sigma: Array
    seen: Mask


@dataclass(frozen=True, eq=False)
class Caps:
    """A sphere in the m profiles: ``root @ (s - place) + offset`` is white for its centre s.

    Attributes
    ----------
    place : (m, 3) about which it was linearised, sensor frame, m.
    root : (m, 3, 3); ``offset`` (m, 3); ``seen`` (m, 3) which of the three tell anything.
    """

    place: Array
    root: Array
    offset: Array
    seen: Mask


def fit_lines(scan: Scan, name: str) -> tuple[Lines, float]:
    """The face ``name`` in each profile, for a noise of 1 m, and the scatter of its points, m.

    Raises
    ------
    TooFewSamplesError
        When fewer than four profiles show it.
    """
    m = len(scan.motion)
    x, z = scan.points.T
    used = np.ones(len(x), dtype=np.bool_)
    for last in (False, True):
        count = np.bincount(scan.profile[used], minlength=m).astype(float)
        seen = count >= FEWEST_POINTS
        n = np.where(seen, count, 1.0)
        x0, z0 = (np.bincount(scan.profile[used], v[used], m) / n for v in (x, z))
        dx, dz = x - x0[scan.profile], z - z0[scan.profile]
        spread = np.bincount(scan.profile[used], dx[used] ** 2, m)
        product = np.bincount(scan.profile[used], dx[used] * dz[used], m)
        slope = product / np.where(spread > 0.0, spread, 1.0)
        miss = dz - slope[scan.profile] * dx
        shown = used & seen[scan.profile]
        if np.sum(seen) < FEWEST_LINES:
            raise TooFewSamplesError(
                f"{np.sum(seen)} profiles show {name} (at least {FEWEST_LINES}): scan more of it"
            )
        freedom = max(float(np.sum(shown)) - 2.0 * float(np.sum(seen)), 1.0)
        if last:
            noise = float(np.sqrt(np.sum(miss[shown] ** 2) / freedom))
        else:
            noise = MAD * float(np.median(np.abs(miss[shown])))
            used = used & (np.abs(miss) <= REJECT * noise)
    seen &= spread > 0.0
    lines = Lines(
        middle=np.where(seen, x0, 0.0),
        z_m=np.where(seen, z0, 0.0),
        slope=np.where(seen, slope, 0.0),
        z_sigma=np.where(seen, 1.0 / np.sqrt(n), 1.0),
        slope_sigma=np.where(seen, 1.0 / np.sqrt(np.where(seen, spread, 1.0)), 1.0),
        seen=seen,
    )
    return lines, noise


def fit_caps(scan: Scan, place: Array, radius_m: float, noise_m: float) -> Caps:
    """The sphere in each profile, about its centres (m, 3), sensor frames, m.

    Raises
    ------
    TooFewSamplesError
        When hardly anything of it is seen.
    """
    m = len(scan.motion)
    # Where the ball is seen at each x: the measured z, being noisy, must not enter the normals.
    x, z = scan.points.T
    side = x - place[scan.profile, 0], -place[scan.profile, 1]
    depth = radius_m**2 - side[0] ** 2 - side[1] ** 2
    used = depth > (STEEPEST * radius_m) ** 2
    front = -np.sqrt(np.where(used, depth, radius_m**2))
    r = (z - place[scan.profile, 2] - front) / noise_m
    J = -np.column_stack([side[0] / front, side[1] / front, np.ones(len(x))]) / noise_m
    for last in (False, True):
        used &= (np.bincount(scan.profile[used], minlength=m) >= FEWEST_POINTS)[scan.profile]
        if np.sum(used) < FEWEST_LINES * FEWEST_POINTS:
            raise TooFewSamplesError(f"{np.sum(used)} points show the sphere: scan more of it")
        information, gradient = _sums(J[used], r[used], scan.profile[used], m)
        size, axes = np.linalg.eigh(information)
        seen = size > FAINT * float(size.max())
        turned = np.einsum("mij,mi->mj", axes, gradient)
        if not last:  # a place that is off, or a joint's error, shifts a profile as a whole
            shift = np.einsum(
                "mij,mj->mi", axes, np.where(seen, turned / np.where(seen, size, 1.0), 0.0)
            )
            used &= np.abs(r - np.sum(J * shift[scan.profile], axis=1)) < REJECT
    length = np.sqrt(np.where(seen, size, 1.0))
    return Caps(
        place=place,
        root=np.where(seen, length, 0.0)[:, :, None] * np.swapaxes(axes, 1, 2),
        offset=np.where(seen, turned / length, 0.0),
        seen=seen,
    )


def _sums(J: Array, r: Array, profile: NDArray[np.int64], m: int) -> tuple[Array, Array]:
    """Normal matrix (m, 3, 3) and gradient (m, 3) of the points of each profile."""
    information, gradient = np.empty((m, 3, 3)), np.empty((m, 3))
    for i in range(3):
        gradient[:, i] = np.bincount(profile, J[:, i] * r, m)
        for j in range(3):
            information[:, i, j] = np.bincount(profile, J[:, i] * J[:, j], m)
    return information, gradient
