"""The sensor's own linearity: a smooth error of z over its field that all profiles share.

A circle's residuals show it but for what looks like another circle. What all profiles have in
common of them, as a polynomial of low degree in x and z, is the sensor's; its degree is chosen by
how well it predicts profiles that were left out (Stone 1974, cross-validation), its covariance
allows for what else the residuals of one profile share (Liang and Zeger 1986, the sandwich).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.sphere import linearised
from robocal_ros.estimation.surfaces import mirror
from robocal_ros.ground.frames import Array, Document

FEWEST_ARCS = 8  # of poses of their own; more than the terms of the third degree
DEGREES = (2, 3, 4)
CLEAR = 3.0  # standard errors of what a left-out profile gains, as the ratio of its squares
LARGEST = 0.01  # of the field's depth: makers state a tenth of it and less
SCALE = 0.01  # one sigma of the scale of z, which arcs hardly show, and the mount does
RIDGE = 1e-9  # of the trace: keeps directions solvable that nothing shows


@dataclass(frozen=True, eq=False)
class SeenArc:
    """Points (n, 2) of a profile on a sphere, sensor frame, m, and their circle (3,): x0, z0, r."""

    points: Array
    circle: Array

    def seen(self, towards: bool) -> tuple[Array, Array]:
        """Jacobian (n, 3) of the circle, as the sensor counts z, and the residual (n,), m."""
        turned = mirror(towards)
        J, residual = linearised(
            np.append(self.circle[:2] * turned, self.circle[2]), self.points * turned
        )
        return J * np.append(turned, 1.0), residual


@dataclass(frozen=True, eq=False)
class SensorLinearity:
    """An error of z over the field: told less true, m.

    ``low``, ``high`` (2,): ends of the field in x and z that profiles showed, m.
    ``degree``: of the polynomial; a shift and a turn are the mount's.
    ``coefficients`` (k,), ``covariance`` (k, k): of products of Legendre's polynomials, and of the
    scale of z, m.
    ``rms_m``, ``max_m``: of the error at the points that showed it.
    ``residual_m``, ``left_out_m``: rms of circles' residuals without it, and with one that is
    found from the other profiles.
    """

    low: Array
    high: Array
    degree: int
    coefficients: Array
    covariance: Array
    rms_m: float
    max_m: float
    residual_m: float
    left_out_m: float

    def corrected(self, points: Array) -> Array:
        """Points (n, 2) without the error; beyond the field it is that of the field's end."""
        true = points.copy()
        true[:, 1] -= _basis(points, self.low, self.high, self.degree) @ self.coefficients
        return true

    def pull(self, arc: SeenArc, towards: bool) -> Array:
        """How the circle (x0, z0, r) moves with the coefficients (3, k)."""
        J, _ = arc.seen(towards)
        shape = _basis(arc.points, self.low, self.high, self.degree)
        return np.asarray(-np.linalg.pinv(J) @ (-J[:, 1:2] * shape))

    def document(self) -> Document:
        """Figures and coefficients in um, the degree, and the field in mm: x and z."""
        return {
            "degree": self.degree,
            "rms_um": self.rms_m * 1e6,
            "max_um": self.max_m * 1e6,
            "residual_um": self.residual_m * 1e6,
            "left_out_um": self.left_out_m * 1e6,
            "coefficients_um": (self.coefficients * 1e6).tolist(),
            "low_mm": (self.low * 1e3).tolist(),
            "high_mm": (self.high * 1e3).tolist(),
        }


def _basis(points: Array, low: Array, high: Array, degree: int) -> Array:
    """Products of Legendre's polynomials in x and z (n, k), of degrees from 2, then z alone."""
    u, w = np.clip(2.0 * (points - low) / (high - low) - 1.0, -1.0, 1.0).T
    x, z = (np.polynomial.legendre.legvander(side, degree) for side in (u, w))
    pairs = [(i, k) for i in range(degree + 1) for k in range(degree + 1 - i) if i + k >= 2]
    return np.column_stack([*(x[:, i] * z[:, k] for i, k in pairs), z[:, 1]])


def fit_linearity(
    arcs: Sequence[SeenArc], poses: NDArray[np.int64], towards: bool
) -> SensorLinearity | None:
    """The error of z that arcs have in common; None where left-out ones do not clearly show it.

    ``poses`` (a,): which pose each arc is of; those of one are left out together, for they show the
    same place of the field.
    """
    groups, group = np.unique(poses, return_inverse=True)
    if len(groups) < FEWEST_ARCS:
        return None
    member = np.eye(len(groups))[group].T  # (g, a)
    every = np.concatenate([arc.points for arc in arcs])
    low, high = every.min(axis=0), every.max(axis=0)
    seen = [arc.seen(towards) for arc in arcs]
    shown = [np.linalg.qr(J)[0] for J, _ in seen]
    residuals = [r - Q @ (Q.T @ r) for (_, r), Q in zip(seen, shown, strict=True)]
    squares = member @ np.array([r @ r for r in residuals])
    best: SensorLinearity | None = None
    for degree in DEGREES:
        shapes = []
        for arc, (J, _), Q in zip(arcs, seen, shown, strict=True):
            shape = _basis(arc.points, low, high, degree)[:, :-1]
            along = -J[:, 1:2] * shape  # the normal's share of z
            shapes.append(along - Q @ (Q.T @ along))
        normals = np.tensordot(member, np.array([A.T @ A for A in shapes]), axes=1)
        rights = member @ np.array([A.T @ r for A, r in zip(shapes, residuals, strict=True)])
        total, right = normals.sum(axis=0), rights.sum(axis=0)
        ridge = RIDGE * np.trace(total) * np.eye(len(total))
        left = np.linalg.solve(total - normals + ridge, (right - rights)[..., None])[..., 0]
        missed = squares - 2.0 * np.sum(left * rights, axis=1)
        missed += np.einsum("ai,aij,aj->a", left, normals, left)
        gain = np.log(squares / missed)
        if gain.mean() <= CLEAR * gain.std(ddof=1) / np.sqrt(len(groups)):
            continue
        left_out_m = float(np.sqrt(missed.sum() / len(every)))
        if best is not None and left_out_m >= best.left_out_m:
            continue
        inverse = np.linalg.inv(total + ridge)
        found = inverse @ right
        scores = rights - normals @ found
        covariance = np.zeros((len(found) + 1, len(found) + 1))
        covariance[:-1, :-1] = inverse @ (scores.T @ scores) @ inverse
        covariance[-1, -1] = (SCALE * 0.5 * (high[1] - low[1])) ** 2
        found = np.append(found, 0.0)
        error = _basis(every, low, high, degree) @ found
        if np.max(np.abs(error)) > LARGEST * (high[1] - low[1]):
            continue  # arcs at one place of the field do not tell it apart from their circles
        best = SensorLinearity(
            low, high, degree, found, covariance,
            float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error))),
            float(np.sqrt(squares.sum() / len(every))), left_out_m,
        )  # fmt: skip
    return best
