# SPDX-License-Identifier: Apache-2.0
"""What a joint turns besides what is read: a function of its own angle, and its winding under load.

    theta_i = sign_i (q_i + delta_i(q_i) + c_i tau_i(q)) + theta0_i

delta_i, of gears, couplings and encoders, is a cubic B-spline of the angle read; c_i tau_i is how
far the gravity torque about the axis winds the joint (a joint that slides: metres and newtons).
Both come before the geometric chain: `SerialArm.turned` gives what a rigid arm would read.
"""

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.ground.frames import Array, Index

STANDARD_GRAVITY = 9.80665  # m/s², of the 3rd CGPM, 1901
# A slope from which on two readings could mean the same angle of the joint, with room to spare.
STEEPEST = 0.5


@dataclass(frozen=True, eq=False)
class IdentifiedFrom:
    """What a model with joint functions was identified from, but for what was measured.

    The covariance of geometry, functions and compliances together follows from where was measured,
    the noise and the prior (`identification.known_model`). It is full, of a thousand
    numbers and more, and its correlations count; these are few.

    ``q`` (m, n), ``target`` (m,), ``weight`` (m,): readings of the poses that were used, rad
    (prismatic: m), which target, and how many poses each stands for. ``p_flange`` (t, 3): the
    targets, m. ``lever``: length by which a measured turn counted, m; 0: positions alone.
    ``noise``: of a coordinate, m. ``parameter_sigma`` (k,), ``base_sigma``, ``target_sigma``: of
    the arm's free parameters, base
        and targets' places before the data, m and rad; 0: held, from 1 on: nothing was known.
    ``length``, ``amplitude`` (n,): of the functions' prior, rad (prismatic: m); 0: no function.

    Raises `ValueError` for shapes that do not fit or numbers that cannot be.
    """

    q: Array
    target: Index
    weight: Array
    p_flange: Array
    lever: float
    noise: float
    parameter_sigma: Array
    base_sigma: float
    target_sigma: float
    length: Array
    amplitude: Array

    def __post_init__(self) -> None:
        for part in fields(self):
            kind = np.int64 if part.name == "target" else np.float64
            value = np.array(getattr(self, part.name), dtype=kind)
            if not (np.all(np.isfinite(value)) and (part.name in _SIGNED or np.all(value >= 0))):
                raise ValueError(f"identified from: {part.name} holds a number that cannot be")
            value.flags.writeable = False
            object.__setattr__(self, part.name, value if value.ndim else value.item())
        if self.q.ndim != 2 or self.p_flange.shape[1:] != (3,):
            raise ValueError("identified from: poses must be (m, n), targets (t, 3)")
        (m, n), t = self.q.shape, len(self.p_flange)
        sizes = (self.target.shape, self.weight.shape, self.length.shape, self.amplitude.shape)
        if sizes != ((m,), (m,), (n,), (n,)) or not (m and t and self.noise > 0.0):
            raise ValueError(f"identified from: {m} poses of {n} joints do not fit the rest")
        if np.max(self.target) >= t or np.any((self.amplitude > 0.0) & (self.length <= 0.0)):
            raise ValueError("identified from: a target or a length is not told")


_SIGNED = ("q", "p_flange")


@dataclass(frozen=True, eq=False)
class JointFunctions:
    """A function of its own angle, and a compliance, for each of n joints.

    The value at q is ``sum_k coefficients[i, k] B3((q_i - first_i) / step_i - k)`` with the
    cardinal cubic B-spline B3 on [0, 4) (de Boor 1978): twice continuously differentiable, and
    zero outside the table. A joint without a function has zeros.

    ``first``, ``step`` (n,): first knot and spacing of the knots, rad (prismatic: m).
    ``coefficients`` (n, m): rad (prismatic: m), in the controller's sense of counting.
    ``compliance`` (n,): not negative, rad/(N m) (prismatic: m/N).
    ``identified_from``: what their covariance follows from; None: not known.

    Raises `ValueError` for shapes that do not fit, numbers that are not finite, a step or a
    compliance below zero, or a function that is so steep that a reading may be ambiguous.
    """

    first: Array
    step: Array
    coefficients: Array
    compliance: Array
    identified_from: IdentifiedFrom | None = None

    def __post_init__(self) -> None:
        for name in ("first", "step", "coefficients", "compliance"):
            value = np.array(getattr(self, name), dtype=np.float64)
            if not np.all(np.isfinite(value)):
                raise ValueError(f"joint functions: {name} holds a number that is not finite")
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        n = len(self.coefficients)
        if self.coefficients.ndim != 2 or any(
            value.shape != (n,) for value in (self.first, self.step, self.compliance)
        ):
            raise ValueError(
                f"joint functions: first {self.first.shape}, step {self.step.shape}, compliance "
                f"{self.compliance.shape} and coefficients {self.coefficients.shape} do not fit"
            )
        if not (np.all(self.step > 0.0) and np.all(self.compliance >= 0.0)):
            raise ValueError("joint functions: steps must be above 0, compliances not below")
        told = self.identified_from
        if told is not None and told.q.shape[1] != n:
            raise ValueError(f"joint functions: of {n} joints, identified from {told.q.shape[1]}")
        edges = np.diff(np.pad(self.coefficients, ((0, 0), (1, 1))), axis=1)
        steepest = np.max(np.abs(edges), axis=1) / self.step  # no slope is larger
        if np.any(steepest > STEEPEST):
            joint = int(np.argmax(steepest))
            raise ValueError(
                f"joint functions: that of joint {joint + 1} has a slope of up to "
                f"{steepest[joint]:.2g}, at most {STEEPEST:g} is allowed"
            )

    def _basis(self, q: ArrayLike) -> tuple[Array, Array]:
        """Coefficients (..., n, 4) whose splines reach q (..., n), and where between knots q is."""
        u = (np.asarray(q, dtype=np.float64) - self.first) / self.step
        n, m = self.coefficients.shape
        cell = np.floor(np.clip(u, -1.0, m + 3.0))
        padded = np.pad(self.coefficients, ((0, 0), (4, 7)))
        at = cell[..., None].astype(np.int64) + np.arange(1, 5)
        return padded[np.arange(n)[:, None], at], u - cell

    def delta(self, q: ArrayLike) -> Array:
        """What each function adds at readings (..., n), rad (prismatic: m)."""
        c, s = self._basis(q)
        weights = [(1 - s) ** 3, 3 * s**3 - 6 * s**2 + 4, -3 * s**3 + 3 * s**2 + 3 * s + 1, s**3]
        return np.asarray(sum(c[..., k] * w for k, w in enumerate(weights)) / 6.0)

    def slope(self, q: ArrayLike) -> Array:
        """Derivative of each function at readings (..., n)."""
        c, s = self._basis(q)
        weights = [-((1 - s) ** 2), 3 * s**2 - 4 * s, -3 * s**2 + 2 * s + 1, s**2]
        return np.asarray(sum(c[..., k] * w for k, w in enumerate(weights)) / (2.0 * self.step))


@dataclass(frozen=True, eq=False)
class ArmLoad:
    """What gravity pulls at.

    ``mass`` (n,): of the links, kg. ``centre`` (n, 3): of mass, m, each in the frame behind its
    joint (of the last: the flange). ``payload_mass``: kg. ``payload_centre`` (3,): m, in the
    flange. ``gravity`` (3,): m/s², in the base. ``found``: no masses were known; compliances were
    found with the ones here, which make units of products and are no kilograms of links. Links and
    what is carried are in them together, so there is no payload beside them.

    Raises `ValueError` for shapes that do not fit, numbers that are not finite, a mass below zero,
    or a payload beside masses that were found.
    """

    mass: Array
    centre: Array
    payload_mass: float = 0.0
    payload_centre: Array = field(default_factory=lambda: np.zeros(3))
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -STANDARD_GRAVITY]))
    found: bool = False

    def __post_init__(self) -> None:
        n = len(self.mass)
        shapes = {"mass": (n,), "centre": (n, 3), "payload_centre": (3,), "gravity": (3,)}
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.all(np.isfinite(value)):
                raise ValueError(f"load: {name} must be {shape} finite numbers")
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        if not (np.all(self.mass >= 0.0) and 0.0 <= self.payload_mass < np.inf):
            raise ValueError("load: a mass must not be below 0")
        if self.found and self.payload_mass:
            raise ValueError(
                f"load: a payload of {self.payload_mass:g} kg beside masses that were found, of "
                "which it is a part: identify the robot anew with the masses of its links"
            )

    @classmethod
    def unknown(cls, n: int) -> "ArmLoad":
        """1 kg at the flange of an upright arm of n joints whose masses nobody knows.

        Compliances are fitted: only their products with the mass count.
        """
        return cls(np.eye(n)[-1], np.zeros((n, 3)), found=True)

    def carrying(self, present: "ArmLoad | None") -> "ArmLoad":
        """These links with the payload and the mounting of another load; None: their own.

        A compliance belongs to the mass of the links that it was identified with. What the arm
        carries and how it is mounted may have changed since: masses that were found cannot follow.
        """
        if present is None or self.found or present.found:
            return self
        return replace(
            self,
            payload_mass=present.payload_mass,
            payload_centre=present.payload_centre,
            gravity=present.gravity,
        )
