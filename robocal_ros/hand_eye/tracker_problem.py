"""Maximum likelihood of a calibration by laser tracker: every measurement, each with its noise.

Rows are whitened one by one, so that each is a sample of its own; the errors of the joints at a
profile are common to all that it shows, and at a point of an arc they move it along its path.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.target_models import moved, tangents
from robocal_ros.hand_eye.tracker_data import (
    FACES,
    MOVED,
    Arc,
    Axis,
    TrackerData,
    TrackerNoise,
    TrackerTarget,
    nominal_axis,
)
from robocal_ros.hand_eye.tracker_scan import Caps, Lines

# ---- tracker state ------------------------------------------------------------------------------


Array = NDArray[np.float64]

FLANGE, SENSOR = slice(0, 6), slice(6, 12)
REFLECTOR, CENTRE = slice(12, 15), slice(15, 18)
NORMALS = (slice(18, 20), slice(20, 22))
OFFSETS, MISMATCH = slice(22, 24), slice(24, 26)
UNKNOWNS = 26
NAMES = tuple(
    f"{what} {axis}"
    for what, axes in (
        ("flange in tracker", ("x", "y", "z", "turn x", "turn y", "turn z")),
        ("sensor in flange", ("x", "y", "z", "turn x", "turn y", "turn z")),
        ("reflector", ("x", "y", "z")),
        ("sphere", ("x", "y", "z")),
        *((face, ("tilt", "turn")) for face in FACES),
        ("face offset", ("1", "2")),
        ("axes", ("angle", "gap")),
    )
    for axis in axes
)


@dataclass(frozen=True, eq=False)
class TrackerUnknowns:
    """All unknowns, SI.

    Attributes
    ----------
    T_tracker_flange : (4, 4) at the first profile; T_flange_sensor (4, 4).
    reflector : (3,) in the flange; ``centre`` (3,) of the sphere, tracker.
    normals, offsets : (2, 3) and (2,) of the faces, outward, tracker.
    mismatch : (2,) of the axes' angle and gap, real minus nominal.
    """

    T_tracker_flange: Array
    T_flange_sensor: Array
    reflector: Array
    centre: Array
    normals: Array
    offsets: Array
    mismatch: Array

    def moved(self, step: Array) -> "TrackerUnknowns":
        """The state after an increment (26,)."""
        tilts = np.array(
            [tangents(n) @ step[part] for n, part in zip(self.normals, NORMALS, strict=True)]
        )
        normals = self.normals + tilts
        return TrackerUnknowns(
            T_tracker_flange=moved(self.T_tracker_flange, step[FLANGE]),
            T_flange_sensor=moved(self.T_flange_sensor, step[SENSOR]),
            reflector=self.reflector + step[REFLECTOR],
            centre=self.centre + step[CENTRE],
            normals=normals / np.linalg.norm(normals, axis=1)[:, None],
            offsets=self.offsets + step[OFFSETS],
            mismatch=self.mismatch + step[MISMATCH],
        )

    def sensor_poses(self, motion: Array) -> Array:
        """T_tracker_sensor (m, 4, 4) of the profiles, from their T_flange0_flange (m, 4, 4)."""
        return np.asarray(self.T_tracker_flange @ motion @ self.T_flange_sensor)


def adjoint(T: Array) -> Array:
    """(..., 6, 6): twists (v, w) given on the right of a frame, on the left of T (..., 4, 4).

    ``exp(adjoint(T) x) T = T exp(x)``.
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    found = np.zeros((*T.shape[:-2], 6, 6))
    found[..., :3, :3] = found[..., 3:, 3:] = R
    found[..., :3, 3:] = frames.skew(t) @ R
    return found


# ---- axes of a real arm that stand to each other a little otherwise than its model says ---------
#
# Both are taken to miss the model by half of it: they turn about their common perpendicular, and
# shift along it, in opposite directions. What the flange is then lies midway, as in the closed
# form.


ANGLE_SIGMA, GAP_SIGMA_M = float(np.radians(0.5)), 1e-3  # of real arms: hardly a restraint
HELD_M = 1e-9  # the gap from a joint that slides has no meaning


@dataclass(frozen=True, eq=False)
class AxisPair:
    """The axes of both arcs in the flange of the first profile, by the nominal geometry.

    Attributes
    ----------
    joints : of the arcs.
    screws : (6, 2) twists that turn about the common perpendicular, and shift along it.
    sigma : (2,) of the mismatch, rad and m.
    height_axis : (3,) direction of the last one that turns.
    """

    joints: tuple[int, int]
    screws: Array
    sigma: Array
    height_axis: Array

    @classmethod
    def of(cls, data: TrackerData, axes: Sequence[Axis]) -> "AxisPair":
        """The axes of the arcs of ``data``."""
        first, second = (
            nominal_axis(data, arc, axis.joint) for arc, axis in zip(data.arcs, axes, strict=True)
        )
        across = np.cross(first[0], second[0])
        across /= np.linalg.norm(across)
        turning = [i for i in (0, 1) if not axes[i].slides]
        last = max(turning, key=lambda i: axes[i].joint)
        foot = (first, second)[last][1]
        if len(turning) == 2:  # where the common perpendicular starts from the first axis
            rows = np.column_stack([first[0], -second[0], across])
            foot = first[1] + first[0] * np.linalg.solve(rows, second[1] - first[1])[0]
        screws = np.zeros((6, 2))
        screws[:3, 0], screws[3:, 0], screws[:3, 1] = np.cross(foot, across), across, across
        return cls(
            joints=(axes[0].joint, axes[1].joint),
            screws=screws,
            sigma=np.array([ANGLE_SIGMA, GAP_SIGMA_M if len(turning) == 2 else HELD_M]),
            height_axis=(first, second)[last][0],
        )

    def share_of(self, q: Array) -> float:
        """Share of the mismatch, -1/2 or 1/2, of the one joint that moves; 0 where several do."""
        moved = np.flatnonzero(np.ptp(q, axis=0) > MOVED)
        if len(moved) != 1 or moved[0] not in self.joints:
            return 0.0
        return self.joints.index(int(moved[0])) - 0.5

    def carried(self, motion: Array, mismatch: Array, share: float) -> Array:
        """Motions (n, 4, 4) about the real axis instead of the nominal one."""
        turn, gap = share * mismatch
        across = self.screws[3:, 0]
        R = frames.exp_rotation(turn * across)
        foot = np.cross(across, self.screws[:3, 0])
        C = frames.transform(R, foot - R @ foot + gap * across)
        return np.asarray(C @ motion @ frames.invert(C))

    def twists(self, carried: Array, share: float) -> Array:
        """Left twists (n, 6, 2) of carried motions by the mismatch."""
        return np.asarray(share * (self.screws - adjoint(carried) @ self.screws))


# ---- tracker problem ----------------------------------------------------------------------------


OF_FACE = 2  # rows of a profile for each face; then come those of the sphere


@dataclass(frozen=True, eq=False)
class TrackerProblem:
    """Residuals of all measurements; see `estimation.descent.Problem`.

    Attributes
    ----------
    start : the state at which the noise of the joints is turned into noise of the rows.
    axes : of the arcs, by the nominal geometry.
    lines, caps : what the profiles show of the faces and of the sphere, noise included.
    """

    data: TrackerData
    target: TrackerTarget
    noise: TrackerNoise
    start: TrackerUnknowns
    axes: AxisPair
    lines: Sequence[Lines]
    caps: Caps

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns."""
        return NAMES

    @property
    def scale_components(self) -> int:
        """The noise is known."""
        return 1

    def retract(self, state: TrackerUnknowns, step: Array) -> TrackerUnknowns:
        """Move the state."""
        return state.moved(step)

    def deviation(self, state: TrackerUnknowns) -> Array:
        """No prior."""
        return np.zeros(UNKNOWNS)

    @cached_property
    def rows(self) -> tuple[str, ...]:
        """What each row was measured by."""
        parts = [(arc.name, arc.points) for arc in self.data.arcs] + [("sphere", self.data.sphere)]
        found: list[str] = []
        for name, points in parts:
            found += [f"{name} {i + 1}" for i in range(len(points)) for _ in range(3)]
        for name, points in zip(FACES, self.data.faces, strict=True):
            found += [f"{name} {i + 1}" for i in range(len(points))]
        found += ["axes"] * 2
        found += ["height"] if self.target.height_m is not None else []
        profiles, _ = np.nonzero(self._seen)
        return tuple(found + [self.data.profiles[i].name for i in profiles.tolist()])

    def linearise(self, state: TrackerUnknowns) -> tuple[Array, Array]:
        """Whitened rows (r, 1), and their Jacobian (r, 1, 26)."""
        parts = [self._arc(state, i) for i in (0, 1)]
        parts += [self._sphere(state), *(self._face(state, i) for i in (0, 1))]
        parts.append(self._mismatch(state))
        if self.target.height_m is not None:
            parts.append(self._height(state))
        residual, J, _ = self._profiles(state)
        white = self._whitening @ np.concatenate([residual[..., None], J], axis=2)
        parts.append((white[..., 0][self._seen], white[..., 1:][self._seen]))
        return (
            np.concatenate([residual for residual, _ in parts])[:, None],
            np.concatenate([J for _, J in parts])[:, None],
        )

    def _arc(self, state: TrackerUnknowns, which: int) -> tuple[Array, Array]:
        arc, white = self.data.arcs[which], self._arc_whitening[which]
        share = self.axes.share_of(arc.q)
        T = self.axes.carried(self._motions[which], state.mismatch, share)
        place = T[:, :3, :3] @ state.reflector + T[:, :3, 3]
        R, t = state.T_tracker_flange[:3, :3], state.T_tracker_flange[:3, 3]
        J = np.zeros((len(arc.points), 3, UNKNOWNS))
        J[..., FLANGE] = np.concatenate(
            [np.broadcast_to(R, (len(place), 3, 3)), -R @ frames.skew(place)], axis=2
        )
        J[..., REFLECTOR] = R @ T[:, :3, :3]
        J[..., MISMATCH] = J[..., FLANGE] @ self.axes.twists(T, share)
        residual = place @ R.T + t - arc.points
        rows = white @ np.concatenate([residual[..., None], J], axis=2)
        return rows[..., 0].ravel(), rows[..., 1:].reshape(-1, UNKNOWNS)

    def _sphere(self, state: TrackerUnknowns) -> tuple[Array, Array]:
        sigma = self.noise.tracker_m
        J = np.zeros((len(self.data.sphere), 3, UNKNOWNS))
        J[..., CENTRE] = np.eye(3) / sigma
        return ((state.centre - self.data.sphere) / sigma).ravel(), J.reshape(-1, UNKNOWNS)

    def _face(self, state: TrackerUnknowns, face: int) -> tuple[Array, Array]:
        points, normal, sigma = self.data.faces[face], state.normals[face], self.noise.tracker_m
        J = np.zeros((len(points), UNKNOWNS))
        J[:, NORMALS[face]] = points @ tangents(normal) / sigma
        J[:, OFFSETS.start + face] = -1.0 / sigma
        off = points @ normal - state.offsets[face] - self.target.reflector_radius_m
        return off / sigma, J

    def _mismatch(self, state: TrackerUnknowns) -> tuple[Array, Array]:
        J = np.zeros((2, UNKNOWNS))
        J[:, MISMATCH] = np.diag(1.0 / self.axes.sigma)
        return state.mismatch / self.axes.sigma, J

    def _height(self, state: TrackerUnknowns) -> tuple[Array, Array]:
        axis = self.axes.height_axis
        sigma, height_m = self.target.height_sigma_m, self.target.height_m or 0.0
        J = np.zeros((1, UNKNOWNS))
        J[0, REFLECTOR] = axis / sigma
        return np.array([(axis @ state.reflector - height_m) / sigma]), J

    def _profiles(self, state: TrackerUnknowns) -> tuple[Array, Array, Array]:
        """Rows (m, 7) of the profiles, their Jacobian (m, 7, 26), and by the sensor's twist."""
        share = self.axes.share_of(self.data.q)
        motion = self.axes.carried(self.data.motion, state.mismatch, share)
        P = state.sensor_poses(motion)
        parts = [self._line(state, P, face) for face in (0, 1)] + [self._cap(state, P)]
        residual = np.concatenate([part[0] for part in parts], axis=1)
        twist = np.concatenate([part[1] for part in parts], axis=1)
        J = np.concatenate([part[2] for part in parts], axis=1)
        J[..., SENSOR] = twist
        J[..., FLANGE] = twist @ adjoint(frames.invert(motion @ state.T_flange_sensor))
        J[..., MISMATCH] = J[..., FLANGE] @ self.axes.twists(motion, share)
        return residual, J, twist

    def _line(self, state: TrackerUnknowns, P: Array, face: int) -> tuple[Array, Array, Array]:
        lines, m = self.lines[face], len(P)
        R, t = P[:, :3, :3], P[:, :3, 3]
        n = state.normals[face] @ R
        d = state.offsets[face] - t @ state.normals[face]
        slope, z = -n[:, 0] / n[:, 2], (d - n[:, 0] * lines.middle) / n[:, 2]
        sigma = np.column_stack([lines.z_sigma, lines.slope_sigma])
        residual = np.column_stack([z - lines.z_m, slope - lines.slope]) / sigma
        by_n = np.zeros((m, 2, 3))
        by_n[:, 0, 0], by_n[:, 0, 2] = -lines.middle / n[:, 2], -z / n[:, 2]
        by_n[:, 1, 0], by_n[:, 1, 2] = -1.0 / n[:, 2], -slope / n[:, 2]
        by_d = np.zeros((m, 2, 1))
        by_d[:, 0, 0] = 1.0 / n[:, 2]
        twist = np.concatenate([by_d * -n[:, None], by_n @ frames.skew(n)], axis=2)
        J = np.zeros((m, 2, UNKNOWNS))
        B = tangents(state.normals[face])
        J[..., NORMALS[face]] = (by_n @ np.swapaxes(R, 1, 2) - by_d * t[:, None]) @ B
        J[..., OFFSETS.start + face] = by_d[..., 0]
        return residual, twist / sigma[..., None], J / sigma[..., None]

    def _cap(self, state: TrackerUnknowns, P: Array) -> tuple[Array, Array, Array]:
        root = self.caps.root
        s = sphere_in(P, state.centre)
        shift = np.einsum("mij,mj->mi", root, s - self.caps.place)
        J = np.zeros((len(P), 3, UNKNOWNS))
        J[..., CENTRE] = root @ np.swapaxes(P[:, :3, :3], 1, 2)
        return shift + self.caps.offset, np.concatenate([-root, root @ frames.skew(s)], axis=2), J

    @cached_property
    def _seen(self) -> NDArray[np.bool_]:
        """Which rows (m, 7) of the profiles there are."""
        faces = [np.repeat(lines.seen[:, None], OF_FACE, axis=1) for lines in self.lines]
        return np.concatenate([*faces, self.caps.seen], axis=1)

    @cached_property
    def _motions(self) -> tuple[Array, Array]:
        first, second = (self.data.relative(arc.q) for arc in self.data.arcs)
        return first, second

    @cached_property
    def _whitening(self) -> Array:
        """Inverse square root (m, 7, 7) of the profiles' covariance."""
        twist = self._profiles(self.start)[2] * self._seen[..., None]
        to_sensor = adjoint(frames.invert(self.start.T_flange_sensor))
        G = twist @ to_sensor @ self._joint_errors(self.data.q)
        return np.linalg.inv(np.linalg.cholesky(np.eye(G.shape[1]) + G @ np.swapaxes(G, 1, 2)))

    @cached_property
    def _arc_whitening(self) -> tuple[Array, Array]:
        first, second = (
            self._arc_spread(arc, T) for arc, T in zip(self.data.arcs, self._motions, strict=True)
        )
        return first, second

    def _arc_spread(self, arc: Arc, T: Array) -> Array:
        v, w = np.split(self._joint_errors(arc.q), 2, axis=1)
        R = self.start.T_tracker_flange[:3, :3] @ T[:, :3, :3]
        G = R @ (v - frames.skew(self.start.reflector) @ w)
        covariance = self.noise.tracker_m**2 * np.eye(3) + G @ np.swapaxes(G, 1, 2)
        return np.linalg.inv(np.linalg.cholesky(covariance))

    def _joint_errors(self, q: Array) -> Array:
        """Twists (n, 6, dof) of the flange, its own axes, by one sigma of each joint.

        A joint that stands still for an arc has no error; where several move, none stands still.
        """
        arm = self.data.arm
        sigma = np.where(arm.prismatic, self.noise.joint_m, self.noise.joint_rad)
        moved = np.ptp(q, axis=0) > MOVED
        if np.sum(moved) == 1:
            sigma = np.where(moved, sigma, 0.0)
        R = np.swapaxes(arm.fk(q)[:, :3, :3], 1, 2)
        J = arm.jacobian(q)
        return np.asarray(np.concatenate([R @ J[:, :3], R @ J[:, 3:]], axis=1) * sigma)


def sphere_in(P: Array, centre: Array) -> Array:
    """A centre (3,) in the frames of sensor poses (m, 4, 4)."""
    return np.asarray(np.einsum("mji,mj->mi", P[:, :3, :3], centre - P[:, :3, 3]))
