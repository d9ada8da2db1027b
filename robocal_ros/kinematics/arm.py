# SPDX-License-Identifier: Apache-2.0
"""Serial arms in Hayati's five-parameter modified Denavit-Hartenberg form, and their inverse.

The compiled kernels are loaded when they are first used: a quarter of a second that reading a
robot file and the start of a node do not need.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.kinematics.joint_functions import ArmLoad, IdentifiedFrom, JointFunctions

# ---- names and choice of the identifiable model parameters --------------------------------------


COLUMNS = ("d", "theta", "a", "alpha", "beta")
D, THETA, A, ALPHA, BETA = range(5)
IS_LENGTH = (True, False, True, False, False)
NEARLY_PARALLEL = np.sin(np.radians(5.0))
_TO_DISPLAY = {True: 1e3, False: 180.0 / np.pi}


@dataclass(frozen=True)
class ParameterSet:
    """An ordered choice of model parameters.

    ``index`` (k, 2): joint (from 0) and column (d, theta, a, alpha, beta) of each.
    """

    index: tuple[tuple[int, int], ...]

    def __len__(self) -> int:
        return len(self.index)

    @property
    def names(self) -> tuple[str, ...]:
        """Names with the unit shown to people: ``d1_mm``, ``theta1_deg``, ``beta2_deg``."""
        return tuple(
            f"{COLUMNS[column]}{joint + 1}_{'mm' if IS_LENGTH[column] else 'deg'}"
            for joint, column in self.index
        )

    @property
    def is_length(self) -> NDArray[np.bool_]:
        """(k,) True for lengths (m), False for angles (rad)."""
        return np.array([IS_LENGTH[column] for _, column in self.index], dtype=np.bool_)

    @property
    def to_display(self) -> Array:
        """(k,) factors from SI to the unit in the name."""
        return np.array([_TO_DISPLAY[IS_LENGTH[column]] for _, column in self.index])

    def read(self, mdh: Array) -> Array:
        """Values (k,) of these parameters in a model (n, 5)."""
        rows, columns = np.array(self.index, dtype=np.int64).reshape(-1, 2).T
        return np.asarray(mdh[rows, columns])

    def add(self, mdh: Array, delta: Array) -> Array:
        """Return a model (n, 5) with ``delta`` (k,) added to these parameters."""
        changed = mdh.copy()
        rows, columns = np.array(self.index, dtype=np.int64).reshape(-1, 2).T
        changed[rows, columns] += delta
        return changed

    def slots(self, n: int) -> NDArray[np.int64]:
        """Column (n, 5) of each parameter in a Jacobian of this set, -1 where not in it."""
        table = np.full((n, 5), -1, dtype=np.int64)
        for column, (joint, kind) in enumerate(self.index):
            table[joint, kind] = column
        return table

    def subset(self, names: tuple[str, ...]) -> "ParameterSet":
        """Return the parameters of these names, in this set's order.

        Raises `ValueError` when a name is not in the set.
        """
        unknown = set(names) - set(self.names)
        if unknown:
            raise ValueError(
                f"unknown parameter {sorted(unknown)[0]!r}; this model has {', '.join(self.names)}"
            )
        return ParameterSet(
            tuple(i for i, n in zip(self.index, self.names, strict=True) if n in names)
        )


def free_parameters(arm: "SerialArm") -> ParameterSet:
    """Choose the parameters that can differ between robots of this type.

    Between nearly parallel consecutive axes d is held and beta is free, elsewhere beta is held
    and d is free; the last frame is the flange, so its d is always free (Hayati 1983). A joint
    that slides leaves its axis' position without effect; what is then redundant for the flange
    pose is dropped, the later parameter first.
    """
    index: list[tuple[int, int]] = []
    for joint in range(arm.n):
        parallel = joint < arm.n - 1 and abs(np.sin(arm.mdh[joint, ALPHA])) < NEARLY_PARALLEL
        first = [BETA, THETA] if parallel else [D, THETA]
        index += [(joint, column) for column in (*first, A, ALPHA)]
    if not np.any(arm.prismatic):
        return ParameterSet(tuple(index))
    return _without_redundant(arm, ParameterSet(tuple(index)))


def _without_redundant(arm: "SerialArm", candidates: ParameterSet) -> ParameterSet:
    """Drop each parameter that the earlier ones reproduce at every pose."""
    from robocal_ros.kinematics import kernels

    rng = np.random.default_rng(0)
    poses, k = 40, len(candidates)
    q = rng.uniform(-1.0, 1.0, (poses, arm.n)) * np.where(arm.prismatic, 0.5, 2.0)
    T, J = np.empty((poses, 4, 4)), np.zeros((poses, 6, k))
    target, none = np.zeros(poses, dtype=np.int64), np.array([-1], dtype=np.int64)
    kernels.parameter_batch(
        q,
        arm.links,
        arm.T_base_root,
        np.eye(4)[None],
        target,
        candidates.slots(arm.n),
        -1,
        none,
        T,
        J,
    )
    columns = J.reshape(-1, k)
    diagonal = np.abs(np.diag(np.linalg.qr(columns, mode="r")))
    keep = diagonal > 1e-9 * np.linalg.norm(columns, axis=0)
    return ParameterSet(tuple(i for i, kept in zip(candidates.index, keep, strict=True) if kept))


# ---- serial arms in Hayati's five-parameter modified Denavit-Hartenberg form --------------------


def _identity() -> Array:
    return np.eye(4)


@dataclass(frozen=True, eq=False)
class SerialArm:
    """A serial arm of n revolute or prismatic joints.

    Per joint ``Trans(z, d) Rot(z, theta) Trans(x, a) Rot(x, alpha) Rot(y, beta)`` with
    ``theta = theta0 + sign q`` (prismatic: ``d = d0 + sign q``): Hayati's form, in which beta is
    free between nearly parallel axes and d elsewhere. With beta = 0 it is distal
    Denavit-Hartenberg.

    ``mdh`` (n, 5): columns d, theta, a, alpha, beta in m and rad. ``sign`` (n,): +1 or -1, the
    controller's direction of counting. ``prismatic`` (n,): bool. ``lower``, ``upper`` (n,): limits
    of q in rad or m; infinite where unknown. ``T_base_root`` (4, 4): pose of the first joint's
    frame in the robot's base. ``T_flange_tool`` (4, 4): tool mounted on the flange. ``functions``:
    what each joint turns besides what is read; None: nothing. ``load``: what gravity pulls at;
    None: not known.
    """

    name: str
    joint_names: tuple[str, ...]
    mdh: Array
    sign: Array
    prismatic: NDArray[np.bool_]
    lower: Array
    upper: Array
    T_base_root: Array = field(default_factory=_identity)
    T_flange_tool: Array = field(default_factory=_identity)
    functions: JointFunctions | None = None
    load: ArmLoad | None = None

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        shapes = {"mdh": (n, 5), "sign": (n,), "prismatic": (n,), "lower": (n,), "upper": (n,)}
        shapes |= {"T_base_root": (4, 4), "T_flange_tool": (4, 4)}
        for name, shape in shapes.items():
            kind = np.bool_ if name == "prismatic" else np.float64
            value: NDArray[np.float64 | np.bool_] = np.array(getattr(self, name), dtype=kind)
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, expected {shape}")
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        if not (np.all(np.isfinite(self.mdh)) and np.all(np.abs(self.sign) == 1.0)):
            raise ValueError(f"{self.name}: mdh must be finite and sign +1 or -1")
        functions, load = self.functions, self.load
        if (functions and len(functions.step) != n) or (load and len(load.mass) != n):
            raise ValueError(f"{self.name}: joint functions or load are not of {n} joints")
        if functions and load is None and np.any(functions.compliance):
            raise ValueError(f"{self.name}: compliances without a load: of what is not known")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @cached_property
    def links(self) -> Array:
        """Constants of the joints (n, 9) for the compiled kernels."""
        from robocal_ros.kinematics import kernels

        return kernels.pack_links(self.mdh, self.sign, self.prismatic)

    @cached_property
    def layer(self) -> Array:
        """Constants of the joint functions (n + 1, 15 + m) for the kernels; of an arm with some.

        Of a joint: the knot before the first, 1 / spacing, compliance, mass and its centre, the
        coefficients between four zeros and four. The last row: gravity (base), mass of the payload
        and its centre.
        """
        from robocal_ros.kinematics.kernels import BESIDE, CENTRE, COMPLIANCE, MASS, PER_STEP, TABLE

        functions, load = self.functions, self.load
        assert functions is not None
        n, m = functions.coefficients.shape
        packed = np.zeros((n + 1, TABLE + BESIDE + m + BESIDE))
        packed[:n, 0], packed[:n, PER_STEP] = functions.first - functions.step, 1.0 / functions.step
        packed[:n, COMPLIANCE] = functions.compliance
        packed[:n, TABLE + BESIDE : TABLE + BESIDE + m] = functions.coefficients
        if load is not None:
            packed[:n, MASS], packed[:n, CENTRE:TABLE] = load.mass, load.centre
            packed[n, :MASS], packed[n, MASS] = load.gravity, load.payload_mass
            packed[n, CENTRE:TABLE] = load.payload_centre
        return packed

    @property
    def masses(self) -> Literal["given", "found"] | None:
        """With which masses its compliances count (`ArmLoad`); None where it has none."""
        if self.load is None or self.functions is None or not np.any(self.functions.compliance):
            return None
        return "found" if self.load.found else "given"

    @cached_property
    def parameters(self) -> ParameterSet:
        """The model's free parameters, derived from its geometry."""
        return free_parameters(self)

    @cached_property
    def model_hash(self) -> str:
        """Identity of the model (16 hex digits): its numbers to 1e-9 m or rad, and its joints.

        The same file gives the same hash on every machine; name, limits, tool, payload and
        mounting do not enter. Compliances do to 1e-15 rad/(N m), with them the links' mass and
        whether it was found.
        """
        parts = [self.mdh, self.T_base_root[:3]]
        if self.functions is not None:
            f = self.functions
            parts += [f.first, f.step, f.coefficients, 1e6 * f.compliance]
            parts += [self.load.mass, self.load.centre] if self.load and self.masses else []
        numbers = np.round(np.hstack([part.ravel() for part in parts]), 9) + 0.0
        joints = zip(self.joint_names, self.sign, self.prismatic, strict=True)
        words = [f"{name}{sign:+.0f}{int(slides)}" for name, sign, slides in joints]
        found = ["found"] if self.masses == "found" else []
        text = "|".join([*words, *(f"{x:.9f}" for x in numbers), *found])
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def with_mdh(self, mdh: ArrayLike) -> "SerialArm":
        """Return the same arm with other model parameters (n, 5) and the same free ones."""
        arm = replace(self, mdh=np.asarray(mdh, dtype=np.float64))
        arm.__dict__["parameters"] = self.parameters
        return arm

    def with_model(
        self, mdh: ArrayLike, functions: JointFunctions | None, identified: ArmLoad | None
    ) -> "SerialArm":
        """Return the same arm with another model; of its load the payload and mounting are kept."""
        load = self.load if identified is None else identified.carrying(self.load)
        return replace(self, functions=functions, load=load).with_mdh(mdh)

    def _batch(self, q: ArrayLike) -> tuple[Array, tuple[int, ...]]:
        joints = np.asarray(q, dtype=np.float64)
        if joints.shape[-1:] != (self.n,):
            raise ValueError(f"q has shape {joints.shape}, expected (..., {self.n})")
        return np.ascontiguousarray(joints.reshape(-1, self.n)), joints.shape[:-1]

    def turned(self, q: ArrayLike) -> Array:
        """What a rigid arm would read (..., n) where this one reads q (..., n).

        q + delta(q) + c tau(q), with the torques of the arm as it stands at q: see
        `joint_functions`. Without joint functions it is q.
        """
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(q)
        if self.functions is None:
            return joints.reshape(*lead, self.n)
        turned = np.empty(joints.shape)
        kernels.turned_batch(joints, self.links, self.T_base_root, self.layer, turned)
        return turned.reshape(*lead, self.n)

    def turned_jacobian(self, q: ArrayLike) -> Array:
        """Derivative (..., n, n) of `turned` by q: I + diag(delta') + diag(c) d tau / d q."""
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(q)
        if self.functions is None:
            return np.broadcast_to(np.eye(self.n), (*lead, self.n, self.n))
        S = np.empty((*joints.shape, self.n))
        kernels.turned_jacobian_batch(joints, self.links, self.T_base_root, self.layer, S)
        return S.reshape(*lead, self.n, self.n)

    def read(self, turned: ArrayLike) -> Array:
        """The q (..., n) of which `turned` makes these: its inverse, to 1e-13 rad.

        Raises `LimitError` where there is none, as the compliances are too large for the load.
        """
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(turned)
        if self.functions is None:
            return joints.reshape(*lead, self.n)
        q = np.empty(joints.shape)
        found = kernels.read_batch(joints, self.links, self.T_base_root, self.layer, q)
        if found < len(joints):
            raise LimitError(f"{self.name}: the load bends its joints further than they resist")
        return q.reshape(*lead, self.n)

    def fk(self, q: ArrayLike) -> Array:
        """T_base_flange (..., 4, 4) at joint vectors (..., n)."""
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(q)
        if self.functions is not None:
            joints = self.turned(joints)
        T = np.empty((len(joints), 4, 4))
        kernels.fk_batch(joints, self.links, self.T_base_root, T)
        return T.reshape(*lead, 4, 4)

    def jacobian(self, q: ArrayLike) -> Array:
        """Geometric Jacobian (..., 6, n): [v; w] of the flange in base axes per unit joint rate."""
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(q)
        if self.functions is not None:
            joints = self.turned(joints)
        J = np.empty((len(joints), 6, self.n))
        kernels.jacobian_batch(joints, self.links, self.T_base_root, J)
        J = J.reshape(*lead, 6, self.n)
        return J if self.functions is None else J @ self.turned_jacobian(q)

    def parameter_jacobian(self, q: ArrayLike, p_flange: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Twist (..., 6, k) in base of the frame at ``p_flange`` (3,) per unit free parameter.

        That the torques, too, depend on the parameters is left out: of a compliant joint's turn,
        some mrad, a parameter of 1 mm or 1 mrad changes a thousandth.
        """
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(q)
        if self.functions is not None:
            joints = self.turned(joints)
        k = len(self.parameters)
        T, J = np.empty((len(joints), 4, 4)), np.zeros((len(joints), 6, k))
        tool = np.eye(4)[None]
        tool[0, :3, 3] = p_flange
        zero, none = np.zeros(len(joints), dtype=np.int64), np.array([-1], dtype=np.int64)
        slot = self.parameters.slots(self.n)
        kernels.parameter_batch(
            joints, self.links, self.T_base_root, tool, zero, slot, -1, none, T, J
        )
        return J.reshape(*lead, 6, k)


# ---- arms and their parameters as plain documents (JSON), in the units people read --------------


def model_document(arm: SerialArm) -> Document:
    """A model in full precision, SI; ``arm_of`` reads it back to the last bit.

    ``functions`` and ``load`` are there where the arm has them.
    """
    document: Document = {
        "robot": arm.name,
        "joint_names": list(arm.joint_names),
        "sign": arm.sign.tolist(),
        "prismatic": arm.prismatic.tolist(),
        "mdh": arm.mdh.tolist(),
        "T_base_root": arm.T_base_root.tolist(),
    }
    if arm.functions is not None:
        document["functions"] = _as_lists(arm.functions)
    if arm.load is not None:
        document["load"] = _as_lists(arm.load)
    return document


def _as_lists(part: JointFunctions | ArmLoad | IdentifiedFrom) -> Document:
    values = {f.name: getattr(part, f.name) for f in fields(part)}
    return {
        name: _as_lists(value) if isinstance(value, IdentifiedFrom) else np.asarray(value).tolist()
        for name, value in values.items()
        if value is not None
    }


def arm_of(model: Document, nominal: SerialArm) -> SerialArm:
    """The nominal arm with the parameters and joint functions of a model document.

    Payload and mounting are the nominal arm's where it says them, see `ArmLoad.carrying`.
    """
    return nominal.with_model(np.array(model["mdh"]), *layer_of(model))


def layer_of(model: Mapping[str, Any]) -> tuple[JointFunctions | None, ArmLoad | None]:
    """Joint functions of a model document, and the load that it was identified with.

    Raises `InputError` when they cannot be.
    """
    functions, load = model.get("functions"), model.get("load")
    try:
        if functions is not None and (told := functions.get("identified_from")) is not None:
            functions = functions | {"identified_from": IdentifiedFrom(**told)}
        return (
            None if functions is None else JointFunctions(**functions),
            None if load is None else ArmLoad(**load),
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"the model cannot be read: {error}") from error


_POSES = 2000  # over the joints' range, among which the largest shift is sought


def joint_spans(arm: SerialArm) -> tuple[Array, Array]:
    """Where joints are taken to go, from (n,) to (n,), rad or m: their limits.

    Where a limit is not known, half a turn or half a metre takes its place: from zero, or from the
    other limit where that is farther out.
    """
    span = np.where(arm.prismatic, 0.5, np.pi)
    lower = np.where(np.isfinite(arm.lower), arm.lower, np.minimum(-span, arm.upper - span))
    upper = np.where(np.isfinite(arm.upper), arm.upper, np.maximum(span, arm.lower + span))
    return lower, upper


def random_postures(arm: SerialArm, count: int = 60) -> Array:
    """The same postures (count, n) at every call, throughout the `joint_spans`."""
    return np.asarray(np.random.default_rng(0).uniform(*joint_spans(arm), (count, arm.n)))


def payload_note(arm: SerialArm, identified: ArmLoad | None, present: ArmLoad | None) -> str:
    """What it may cost that an arm carries, or hangs, otherwise than when it was identified.

    ``present``: of the robot file that the model is used with. Empty where the loads are the same,
    or where one is not known.
    """
    if present is None or identified is None or _same_load(present, identified):
        return ""
    note = (
        f"the model was identified with a payload of {_in_words(identified)}, "
        f"the robot file says {_in_words(present)}"
    )
    if identified.found or present.found:
        return (
            f"{note}: without masses the model cannot follow, and stays as it was measured; "
            "identify it anew with the masses of the links and the payload"
        )
    if arm.functions is None or not np.any(arm.functions.compliance):
        return f"{note}: how far that bends the arm is not in the model"
    q = random_postures(arm, _POSES)
    before = replace(arm, load=identified)
    shift = np.max(np.linalg.norm((arm.fk(q) - before.fk(q))[:, :3, 3], axis=1))
    return (
        f"{note}: its compliances make of that up to {1e3 * shift:.2g} mm at the flange, of which "
        "nothing was measured"
    )


def _same_load(a: ArmLoad, b: ArmLoad) -> bool:
    carried = (a.found, a.payload_mass) == (b.found, b.payload_mass)
    pulled = carried and np.array_equal(a.gravity, b.gravity)
    return pulled and (a.payload_mass == 0.0 or np.array_equal(a.payload_centre, b.payload_centre))


def _in_words(load: ArmLoad) -> str:
    centre, pull = (
        ", ".join(f"{x:.4g}" for x in v) for v in (1e3 * load.payload_centre, load.gravity)
    )
    carried = f"{load.payload_mass:.4g} kg at ({centre}) mm"
    if load.found:
        carried = "what nobody stated"
    return f"{carried} and gravity along ({pull})"


def parameters_document(
    nominal: SerialArm, identified: SerialArm, sigma: dict[str, float]
) -> Document:
    """Nominal value, identified value and standard deviation of every free parameter.

    ``sigma`` in SI by name; a parameter without one was held at its nominal value (null).
    """
    chosen = nominal.parameters
    factor = chosen.to_display
    rows = zip(
        chosen.names,
        (chosen.read(nominal.mdh) * factor).tolist(),
        (chosen.read(identified.mdh) * factor).tolist(),
        factor.tolist(),
        strict=True,
    )
    return {
        name: {
            "nominal": before,
            "value": after,
            "sigma": sigma[name] * unit if name in sigma else None,
        }
        for name, before, after, unit in rows
    }


# ---- bounded inverse kinematics -----------------------------------------------------------------
#
# Newton's method with the geometric Jacobian, each pose from the one before, so that the arm keeps
# its posture. Nothing is returned that passes a joint limit, jumps, or comes near a singularity.

# No joint moves further from one pose to the next (rad; prismatic: m): else it is no path.
LONGEST_STEP = 0.2
# Of the flange's geometric Jacobian, a turn counted as the way of a point 1 m off, m/rad. At this
# bound a joint may turn by 20 rad per metre of the flange's way: 1 rad/s at 50 mm/s.
SMALLEST_SINGULAR_VALUE = 0.05

_UNREACHED = "it is out of reach, or the arm would have to jump"
_WHAT_TO_DO = "Move the station, or begin in another posture"


@dataclass(frozen=True, eq=False)
class JointDerivatives:
    """Joints (m, n), rad (prismatic: m), and their first two derivatives by time."""

    q: Array
    qd: Array
    qdd: Array


def inverse(arm: SerialArm, T_base_flange: ArrayLike, q_near: ArrayLike) -> Array:
    """Joints (m, n) that reach flange poses (m, 4, 4) in turn, the first of them near (n,).

    Raises `LimitError` as `follow`.
    """
    T = np.asarray(T_base_flange, dtype=np.float64)
    still = np.zeros((len(T), 6))
    return follow(arm, T, still, still, q_near).q


def follow(
    arm: SerialArm,
    T_base_point: Array,
    twist: Array,
    twist_rate: Array,
    q_near: ArrayLike,
    p_flange: ArrayLike = (0.0, 0.0, 0.0),
) -> JointDerivatives:
    """Joints that carry a point of the flange along a path.

    ``T_base_point`` (m, 4, 4): poses of the flange, but with the point as their origin. ``twist``,
    ``twist_rate`` (m, 6): velocity [v; w] of the point, base, and its derivative. ``q_near`` (n,):
    joints from which the first pose is sought. ``p_flange`` (3,): the point, m.

    Raises `LimitError` where a joint limit is passed, a singularity is near
    (`SMALLEST_SINGULAR_VALUE`), a pose is out of reach, or a joint would have to move by more than
    `LONGEST_STEP` at once.
    """
    from robocal_ros.kinematics import newton

    goals = np.array(T_base_point, dtype=np.float64, order="C")
    near = np.array(q_near, dtype=np.float64)
    if goals.shape[1:] != (4, 4) or near.shape != (arm.n,) or not len(goals):
        raise ValueError(f"poses {goals.shape}, joints {near.shape}: expected (m, 4, 4), (n,)")
    if not (np.all(np.isfinite(goals)) and np.all(np.isfinite(near))):
        raise LimitError("poses or joints are not finite: check where they come from")
    ends = np.stack([arm.T_base_root, np.eye(4)])
    ends[1, :3, 3] = p_flange
    near = arm.turned(near)
    path = JointDerivatives(*(np.zeros((len(goals), arm.n)) for _ in range(3)))
    reached, outcome = newton.follow_batch(
        goals,
        np.array(twist, dtype=np.float64, order="C"),
        np.array(twist_rate, dtype=np.float64, order="C"),
        near,
        arm.links,
        ends,
        LONGEST_STEP,
        path.q,
        path.qd,
        path.qdd,
    )
    if arm.functions is not None:
        # What the arm reads while a rigid one would read `turned`.
        turned = JointDerivatives(*(x[:reached] for x in (path.q, path.qd, path.qdd)))
        q = arm.read(turned.q)
        S = arm.turned_jacobian(q)
        qd = np.linalg.solve(S, turned.qd[..., None])
        step = _AHEAD_S * qd[..., 0]
        change = (arm.turned_jacobian(q + step) - arm.turned_jacobian(q - step)) / (2.0 * _AHEAD_S)
        qdd = np.linalg.solve(S, turned.qdd[..., None] - change @ qd)
        path = JointDerivatives(q, np.asarray(qd[..., 0]), np.asarray(qdd[..., 0]))
    require_within_limits(arm, path.q[:reached])
    require_regular(arm, path.q[:reached])
    if outcome != newton.REACHED:
        why = "the arm is singular there" if outcome == newton.SINGULAR else _UNREACHED
        raise LimitError(f"{_pose(goals, reached)}: {why}. {_WHAT_TO_DO}")
    return path


# Where rounding and what the spline's third derivative leaves weigh alike.
_AHEAD_S = 1e-5


def require_within_limits(arm: SerialArm, q: Array) -> None:
    """Raise LimitError where joints (m, n) pass the arm's limits."""
    outside = (q < arm.lower) | (q > arm.upper)
    if np.any(outside):
        pose, joint = np.argwhere(outside)[0]
        unit, scale = ("mm", 1e3) if arm.prismatic[joint] else ("deg", 180.0 / np.pi)
        raise LimitError(
            f"{arm.joint_names[joint]} would be at {scale * q[pose, joint]:.3f} {unit} (pose "
            f"{pose + 1} of {len(q)}), its limits are {scale * arm.lower[joint]:.3f} to "
            f"{scale * arm.upper[joint]:.3f} {unit}: begin in another posture"
        )


def require_regular(arm: SerialArm, q: Array) -> None:
    """Raise LimitError where an arm at joints (m, n) is near a singularity."""
    smallest = np.linalg.svd(arm.jacobian(q), compute_uv=False)[:, -1]
    if np.any(smallest < SMALLEST_SINGULAR_VALUE):
        pose = int(np.argmax(smallest < SMALLEST_SINGULAR_VALUE))
        raise LimitError(
            f"{_pose(arm.fk(q), pose)}: near a singularity, smallest singular value of the "
            f"Jacobian {smallest[pose]:.4f}, at least {SMALLEST_SINGULAR_VALUE:g} is needed. "
            + _WHAT_TO_DO
        )


def _pose(T: Array, index: int) -> str:
    x, y, z = 1e3 * T[index, :3, 3]
    return f"pose {index + 1} of {len(T)} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
