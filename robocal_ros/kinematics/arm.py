"""Serial arms in Hayati's five-parameter modified Denavit-Hartenberg form.

The compiled kernels are loaded when they are first used: a quarter of a second that reading a
robot file and the start of a node do not need.
"""

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.kinematics.parameters import ParameterSet, free_parameters

Array = NDArray[np.float64]


def _identity() -> Array:
    return np.eye(4)


@dataclass(frozen=True, eq=False)
class SerialArm:
    """A serial arm of n revolute or prismatic joints.

    Per joint ``Trans(z, d) Rot(z, theta) Trans(x, a) Rot(x, alpha) Rot(y, beta)`` with
    ``theta = theta0 + sign q`` (prismatic: ``d = d0 + sign q``): Hayati's form, in which beta is
    free between nearly parallel axes and d elsewhere. With beta = 0 it is distal
    Denavit-Hartenberg.

    Attributes
    ----------
    mdh : (n, 5) columns d, theta, a, alpha, beta in m and rad.
    sign : (n,) +1 or -1, the controller's direction of counting.
    prismatic : (n,) bool.
    lower, upper : (n,) limits of q in rad or m; infinite where unknown.
    T_base_root : (4, 4) pose of the first joint's frame in the robot's base.
    T_flange_tool : (4, 4) tool mounted on the flange.
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
    def parameters(self) -> ParameterSet:
        """The model's free parameters, derived from its geometry."""
        return free_parameters(self)

    @cached_property
    def model_hash(self) -> str:
        """Identity of the model (16 hex digits): its numbers to 1e-9 m or rad, and its joints.

        The same file gives the same hash on every machine; name, limits and tool do not enter.
        """
        numbers = np.round(np.hstack([self.mdh.ravel(), self.T_base_root[:3].ravel()]), 9) + 0.0
        joints = zip(self.joint_names, self.sign, self.prismatic, strict=True)
        words = [f"{name}{sign:+.0f}{int(slides)}" for name, sign, slides in joints]
        text = "|".join([*words, *(f"{x:.9f}" for x in numbers)])
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def with_mdh(self, mdh: ArrayLike) -> "SerialArm":
        """Return the same arm with other model parameters (n, 5) and the same free ones."""
        arm = replace(self, mdh=np.asarray(mdh, dtype=np.float64))
        arm.__dict__["parameters"] = self.parameters
        return arm

    def _batch(self, q: ArrayLike) -> tuple[Array, tuple[int, ...]]:
        joints = np.asarray(q, dtype=np.float64)
        if joints.shape[-1:] != (self.n,):
            raise ValueError(f"q has shape {joints.shape}, expected (..., {self.n})")
        return np.ascontiguousarray(joints.reshape(-1, self.n)), joints.shape[:-1]

    def fk(self, q: ArrayLike) -> Array:
        """T_base_flange (..., 4, 4) at joint vectors (..., n)."""
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(q)
        T = np.empty((len(joints), 4, 4))
        kernels.fk_batch(joints, self.links, self.T_base_root, T)
        return T.reshape(*lead, 4, 4)

    def jacobian(self, q: ArrayLike) -> Array:
        """Geometric Jacobian (..., 6, n): [v; w] of the flange in base axes per unit joint rate."""
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(q)
        J = np.empty((len(joints), 6, self.n))
        kernels.jacobian_batch(joints, self.links, self.T_base_root, J)
        return J.reshape(*lead, 6, self.n)

    def parameter_jacobian(self, q: ArrayLike, p_flange: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Twist (..., 6, k) in base of the frame at ``p_flange`` (3,) per unit free parameter."""
        from robocal_ros.kinematics import kernels

        joints, lead = self._batch(q)
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
