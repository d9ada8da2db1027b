# SPDX-License-Identifier: Apache-2.0
"""The sensor's own linearity: a smooth error of z over its field that all profiles share.

A circle's residuals show it but for what looks like another circle, those of a straight surface
beside an edge but for what looks like another line. What all profiles have in
common of them, as a polynomial of low degree in x and z, is the sensor's; its degree is chosen by
how well it predicts profiles that were left out (Stone 1974, cross-validation), its covariance
allows for what else the residuals of one profile share (Liang and Zeger 1986, the sandwich).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.sphere import linearised
from robocal_ros.estimation.surfaces import mirror
from robocal_ros.ground.frames import Array

if TYPE_CHECKING:
    from robocal_ros.hand_eye.documents import LinearityDocument

FEWEST_POSES = 8  # more than the terms of the third degree
BESIDE_M = 6e-4  # from a corner: so far its rounded top reaches (measured: up to 0.5 mm)
FEWEST_POINTS = 20  # of a surface beside it
DEGREES = (2, 3, 4)
CLEAR = 3.0  # standard errors of what a left-out profile gains, as the ratio of its squares
STATED = 1e-3  # of the field's depth, as makers state it
LARGEST = 10.0 * STATED
SCALE = 0.01  # one sigma of the scale of z, which arcs hardly show, and the mount does
RIDGE = 1e-9  # of the trace: keeps directions solvable that nothing shows


@dataclass(frozen=True, eq=False)
class SeenArc:
    """Points (n, 2) of a profile on a sphere, sensor frame, m, and their circle (3,): x0, z0, r."""

    points: Array
    circle: Array

    def seen(self, towards: bool) -> tuple[Array, Array, Array]:
        """Jacobian (n, 3) of the circle, residual (n,), its change with z (n,).

        As the sensor counts z, which grows ``towards`` it or away.
        """
        turned = mirror(towards)
        J, residual = linearised(
            np.append(self.circle[:2] * turned, self.circle[2]), self.points * turned
        )
        J = J * np.append(turned, 1.0)
        return J, residual, -J[:, 1]

    def moved(self, error: Callable[[Array], Array], towards: bool) -> Array:
        """How the circle (3, k) moves where z of points (n, 2) grows by errors (n, k)."""
        J, _, share = self.seen(towards)
        return np.asarray(-np.linalg.pinv(J) @ (share[:, None] * error(self.points)))


@dataclass(frozen=True, eq=False)
class SeenLine:
    """Points (n, 2) of a profile on a straight surface, sensor frame, m."""

    points: Array

    def across(self) -> tuple[Array, Array, Array]:
        """Middle (2,), direction (2,) and normal (2,)."""
        middle = self.points.mean(axis=0)
        x, z = np.linalg.svd(self.points - middle, full_matrices=False)[2][0]
        return middle, np.array([x, z]), np.array([-z, x])

    def seen(self, towards: bool) -> tuple[Array, Array, Array]:
        """The same of a shift and a turn (n, 2), whichever way z grows."""
        middle, along, normal = self.across()
        away = self.points - middle
        J = np.column_stack([np.ones(len(away)), away @ along])
        return J, away @ normal, np.full(len(away), normal[1])


@dataclass(frozen=True, eq=False)
class SeenCorner:
    """A corner (2,), sensor frame, m, of two straight surfaces; no sides where one ends alone."""

    point: Array
    sides: tuple[Array, ...]

    def moved(self, error: Callable[[Array], Array], towards: bool) -> Array:
        """How it moves, (x, z, 0) (3, k), where z of points (n, 2) grows by errors (n, k)."""
        if not self.sides:
            own = error(self.point[None])
            return np.concatenate([0.0 * own, own, 0.0 * own])
        normals, shifts = [], []
        for line in map(SeenLine, self.sides):
            middle, along, normal = line.across()
            J, _, share = line.seen(towards)
            at = np.array([1.0, (self.point - middle) @ along])
            shifts.append(at @ np.linalg.pinv(J) @ (share[:, None] * error(line.points)))
            normals.append(normal)
        step = np.linalg.solve(np.array(normals), np.array(shifts))
        return np.concatenate([step, np.zeros((1, step.shape[1]))])


SeenCurve = SeenArc | SeenLine
SeenFeature = SeenArc | SeenCorner


def beside_corners(sides: Iterable[Array], corners: Array) -> list[SeenLine]:
    """Lines of sides (n, 2) but for what is next to corners (k, 2): no edge is sharp."""
    lines = []
    for side in sides:
        far = np.linalg.norm(side[:, None] - corners, axis=2).min(axis=1) > BESIDE_M
        if np.sum(far) >= FEWEST_POINTS:
            lines.append(SeenLine(side[far]))
    return lines


@dataclass(frozen=True, eq=False)
class SensorLinearity:
    """An error of z over the field: told less true, m.

    ``low``, ``high`` (2,): ends of the field in x and z that profiles showed, m. ``degree``: of the
    polynomial; a shift and a turn are the mount's. ``coefficients`` (k,), ``covariance`` (k, k): of
    products of Legendre's polynomials, and of the scale of z, m, which the mount shows and moves
    with the others. ``rms_m``, ``max_m``: of the error as curves alone tell it, without the scale,
    at the points that showed it. ``residual_m``, ``left_out_m``: rms of residuals without it, and
    with one that is found from the other profiles. ``assumed``: not seen; none is taken out, and
    ``covariance`` and ``rms_m`` are as makers state.
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
    assumed: bool = False

    @property
    def root(self) -> Array:
        """The covariance as numbers (k, r) of size one, which are independent, make it."""
        values, vectors = np.linalg.eigh(self.covariance)
        seen = values > RIDGE * values[-1]
        return np.asarray(vectors[:, seen] * np.sqrt(values[seen]))

    def corrected(self, points: Array) -> Array:
        """Points (n, 2) without the error; beyond the field it is that of the field's end."""
        true = points.copy()
        true[:, 1] -= _basis(points, self.low, self.high, self.degree) @ self.coefficients
        return true

    def pull(self, feature: SeenFeature, towards: bool) -> Array:
        """How less of the error moves a feature with the coefficients (3, k)."""

        def error(points: Array) -> Array:
            return _basis(points, self.low, self.high, self.degree)

        return feature.moved(error, towards)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "SensorLinearity":
        """As `document` told it, but for the covariance."""
        coefficients = 1e-6 * np.array(document["coefficients_um"], dtype=np.float64)
        low, high = (
            1e-3 * np.array(document[name], dtype=np.float64) for name in ("low_mm", "high_mm")
        )
        rms, most, residual, left_out = (
            1e-6 * float(document[name])
            for name in ("rms_um", "max_um", "residual_um", "left_out_um")
        )
        unknown = np.zeros((len(coefficients), len(coefficients)))
        degree = int(document["degree"])
        return cls(low, high, degree, coefficients, unknown, rms, most, residual, left_out)

    def document(self) -> "LinearityDocument":
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
    return np.column_stack([*(x[:, i] * z[:, k] for i, k in _degrees(degree)), z[:, 1]])


def _degrees(degree: int) -> list[tuple[int, int]]:
    """Of the products in x and z, up to their sum."""
    return [(i, k) for i in range(degree + 1) for k in range(degree + 1 - i) if i + k >= 2]


def fit_linearity(
    curves: Sequence[SeenCurve], poses: NDArray[np.int64], towards: bool
) -> SensorLinearity | None:
    """The error of z that curves have in common; assumed where left-out ones show it not clearly.

    ``poses`` (a,): which pose each is of; those of one are left out together, for they show the
    same place of the field. None without curves, or where all their points are of one height.
    """
    groups, group = np.unique(poses, return_inverse=True)
    every = np.concatenate([np.empty((0, 2)), *(curve.points for curve in curves)])
    if not len(every) or np.ptp(every[:, 1]) == 0.0:
        return None
    member = np.eye(len(groups))[group].T  # (g, a)
    low, high = every.min(axis=0), every.max(axis=0)
    unseen = _unseen(every, low, high)
    if len(groups) < FEWEST_POSES:
        return unseen
    seen = [curve.seen(towards) for curve in curves]
    shown = [np.linalg.qr(J)[0] for J, _, _ in seen]
    residuals = [r - Q @ (Q.T @ r) for (_, r, _), Q in zip(seen, shown, strict=True)]
    squares = member @ np.array([r @ r for r in residuals])
    best = unseen
    products, whole = _degrees(DEGREES[-1]), _basis(every, low, high, DEGREES[-1])
    begins = np.cumsum([len(curve.points) for curve in curves])[:-1]
    for degree in DEGREES:
        some = [n for n, pair in enumerate(products) if sum(pair) <= degree]
        basis = np.ascontiguousarray(whole[:, [*some, -1]])
        shapes = []
        for part, (_, _, share), Q in zip(np.split(basis, begins), seen, shown, strict=True):
            along = share[:, None] * part[:, :-1]
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
        if not best.assumed and left_out_m >= best.left_out_m:
            continue
        inverse = np.linalg.inv(total + ridge)
        found = inverse @ right
        scores = rights - normals @ found
        covariance = np.zeros((len(found) + 1, len(found) + 1))
        covariance[:-1, :-1] = inverse @ (scores.T @ scores) @ inverse
        covariance[-1, -1] = (SCALE * 0.5 * (high[1] - low[1])) ** 2
        found = np.append(found, 0.0)
        error = basis @ found
        if np.max(np.abs(error)) > LARGEST * (high[1] - low[1]):
            continue  # curves at one place of the field do not tell it apart from themselves
        best = SensorLinearity(
            low, high, degree, found, covariance,
            float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error))),
            float(np.sqrt(squares.sum() / len(every))), left_out_m,
        )  # fmt: skip
    return best


def _unseen(points: Array, low: Array, high: Array) -> SensorLinearity:
    """None that is known, at the size that makers state, so that the mount allows for it."""
    sigma_m = STATED * (high[1] - low[1])
    basis = _basis(points, low, high, DEGREES[0])
    none = np.zeros(basis.shape[1])
    covariance = sigma_m**2 * np.eye(len(none))
    rms_m = sigma_m * float(np.sqrt(np.mean(np.sum(basis**2, axis=1))))
    return SensorLinearity(
        low, high, DEGREES[0], none, covariance, rms_m, 0.0, 0.0, 0.0, assumed=True
    )
