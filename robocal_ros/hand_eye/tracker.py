# SPDX-License-Identifier: Apache-2.0
"""Where a profile sensor sits on a robot, by laser tracker (multiple coordinate transformations).

Source: Jing, Hu and Guo 2020. ``classic`` is its closed form; ``best`` is the maximum likelihood of
all measurements at once, from there. Rows are whitened one by one, so that each is a sample of its
own; the errors of the joints at a profile are common to all that it shows, and at a point of an arc
they move it along its path.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.estimation.estimation import Estimate, solve
from robocal_ros.estimation.surfaces import mirror
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, ResidualError
from robocal_ros.ground.frames import Array
from robocal_ros.hand_eye.mount_problem import from_plane, moved, tangents
from robocal_ros.hand_eye.result import (
    MOST_REJECTED,
    HandEyeResult,
    Method,
    PoseRows,
    apart,
    expected_error_m,
    field_points,
    judge_classic,
    said_of_joints,
)
from robocal_ros.hand_eye.targets import FACES, TrackerTarget
from robocal_ros.hand_eye.tracker_data import (
    MOVED,
    Axis,
    Cube,
    TrackerData,
    TrackerNoise,
    nominal_axis,
)
from robocal_ros.hand_eye.tracker_scan import (
    Caps,
    Classic,
    Lines,
    each_without,
    fit_caps,
    fit_lines,
    solve_classic,
)
from robocal_ros.kinematics.joint_errors import JointErrors, flange_errors

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

    ``T_tracker_flange`` (4, 4): at the first profile. ``reflector`` (3,): in the flange. ``cube``:
    in the tracker frame. ``mismatch`` (2,): of the axes' angle and gap, real minus nominal.
    """

    T_tracker_flange: Array
    T_flange_sensor: Array
    reflector: Array
    cube: Cube
    mismatch: Array

    def moved(self, step: Array) -> "TrackerUnknowns":
        """The state after an increment (26,)."""
        cube = self.cube
        tilts = np.array(
            [tangents(n) @ step[part] for n, part in zip(cube.normals, NORMALS, strict=True)]
        )
        normals = cube.normals + tilts
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return TrackerUnknowns(
            T_tracker_flange=moved(self.T_tracker_flange, step[FLANGE]),
            T_flange_sensor=moved(self.T_flange_sensor, step[SENSOR]),
            reflector=self.reflector + step[REFLECTOR],
            cube=Cube(normals, cube.offsets + step[OFFSETS], cube.centre + step[CENTRE]),
            mismatch=self.mismatch + step[MISMATCH],
        )


# The axes of a real arm stand to each other a little otherwise than its model says. Both are taken
# to miss the model by half of it: they turn about their common perpendicular, and shift along it,
# in opposite directions. What the flange is then lies midway, as in the closed form.

ANGLE_SIGMA, GAP_SIGMA_M = float(np.radians(0.5)), 1e-3  # of real arms: hardly a restraint
HELD_M = 1e-9  # the gap from a joint that slides has no meaning


@dataclass(frozen=True, eq=False)
class AxisPair:
    """The axes of both arcs in the flange of the first profile, by the nominal geometry.

    ``screws`` (6, 2): twists that turn about the common perpendicular, and shift along it.
    ``sigma`` (2,): of the mismatch, rad and m. ``height_axis`` (3,): direction of the last one that
    turns.
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

    def sensor_poses(self, data: TrackerData, state: TrackerUnknowns) -> Array:
        """T_tracker_sensor (m, 4, 4) of the profiles."""
        motion = self.carried(data.motion, state.mismatch, self.share_of(data.q))
        return np.asarray(state.T_tracker_flange @ motion @ state.T_flange_sensor)

    def twists(self, carried: Array, share: float) -> Array:
        """Left twists (n, 6, 2) of carried motions by the mismatch."""
        return np.asarray(share * (self.screws - frames.adjoint(carried) @ self.screws))


OF_FACE = 2  # rows of a profile for each face; then come those of the sphere


@dataclass(frozen=True, eq=False)
class TrackerProblem:
    """Residuals of all measurements; see `estimation.estimation.Problem`.

    ``start``: the state at which the noise of the joints is turned into noise of the rows.
    ``lines``, ``caps``: what the profiles show of the faces and of the sphere, noise included.
    """

    data: TrackerData
    target: TrackerTarget
    noise: TrackerNoise
    start: TrackerUnknowns
    axes: AxisPair
    lines: Sequence[Lines]
    caps: Caps
    names: tuple[str, ...] = NAMES
    scale_components: int = 1  # the noise is known

    def retract(self, state: TrackerUnknowns, step: Array) -> TrackerUnknowns:
        """The state after an increment (26,)."""
        return state.moved(step)

    def deviation(self, state: TrackerUnknowns) -> Array:
        """Zero: there is no prior."""
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
        parts = [*self._arc_rows(state), *self._target_rows(state)]
        residual, J, _ = self._profiles(state)
        white = self._whitening @ np.concatenate([residual[..., None], J], axis=2)
        parts.append((white[..., 0][self._seen], white[..., 1:][self._seen]))
        return (
            np.concatenate([residual for residual, _ in parts])[:, None],
            np.concatenate([J for _, J in parts])[:, None],
        )

    def _arc_rows(self, state: TrackerUnknowns) -> Iterator[tuple[Array, Array]]:
        """Of both arcs."""
        R, t = state.T_tracker_flange[:3, :3], state.T_tracker_flange[:3, 3]
        for arc, (motion, white) in zip(self.data.arcs, self._arc_motions, strict=True):
            share = self.axes.share_of(arc.q)
            T = self.axes.carried(motion, state.mismatch, share)
            place = T[:, :3, :3] @ state.reflector + T[:, :3, 3]
            J = np.zeros((len(arc.points), 3, UNKNOWNS))
            J[..., FLANGE] = np.concatenate(
                [np.broadcast_to(R, (len(place), 3, 3)), -R @ frames.skew(place)], axis=2
            )
            J[..., REFLECTOR] = R @ T[:, :3, :3]
            J[..., MISMATCH] = J[..., FLANGE] @ self.axes.twists(T, share)
            residual = place @ R.T + t - arc.points
            rows = white @ np.concatenate([residual[..., None], J], axis=2)
            yield rows[..., 0].ravel(), rows[..., 1:].reshape(-1, UNKNOWNS)

    def _target_rows(self, state: TrackerUnknowns) -> Iterator[tuple[Array, Array]]:
        """Of the sphere and of the faces; then what is known of axes and height beforehand."""
        sigma, axis = self.noise.tracker_m, self.axes.height_axis
        J = np.zeros((len(self.data.sphere), 3, UNKNOWNS))
        J[..., CENTRE] = np.eye(3) / sigma
        yield ((state.cube.centre - self.data.sphere) / sigma).ravel(), J.reshape(-1, UNKNOWNS)
        for face, points in enumerate(self.data.faces):
            normal = state.cube.normals[face]
            J = np.zeros((len(points), UNKNOWNS))
            J[:, NORMALS[face]] = points @ tangents(normal) / sigma
            J[:, OFFSETS.start + face] = -1.0 / sigma
            off = points @ normal - state.cube.offsets[face] - self.target.reflector_radius_m
            yield off / sigma, J
        J = np.zeros((2, UNKNOWNS))
        J[:, MISMATCH] = np.diag(1.0 / self.axes.sigma)
        yield state.mismatch / self.axes.sigma, J
        if self.target.height_m is not None:
            J = np.zeros((1, UNKNOWNS))
            J[0, REFLECTOR] = axis / self.target.height_sigma_m
            off = axis @ state.reflector - self.target.height_m
            yield np.array([off / self.target.height_sigma_m]), J

    def _profiles(self, state: TrackerUnknowns) -> tuple[Array, Array, Array]:
        """Rows (m, 7) of the profiles, their Jacobian (m, 7, 26), and by the sensor's twist."""
        share = self.axes.share_of(self.data.q)
        motion = self.axes.carried(self.data.motion, state.mismatch, share)
        P = self.axes.sensor_poses(self.data, state)
        root, s = self.caps.root, sphere_in(P, state.cube.centre)
        shift = np.einsum("mij,mj->mi", root, s - self.caps.place) + self.caps.offset
        by_place = np.zeros((len(P), 3, UNKNOWNS))
        by_place[..., CENTRE] = root @ np.swapaxes(P[:, :3, :3], 1, 2)
        by_twist = np.concatenate([-root, root @ frames.skew(s)], axis=2)
        parts = [self._line(state, P, face) for face in (0, 1)] + [(shift, by_twist, by_place)]
        residual = np.concatenate([part[0] for part in parts], axis=1)
        twist = np.concatenate([part[1] for part in parts], axis=1)
        J = np.concatenate([part[2] for part in parts], axis=1)
        J[..., SENSOR] = twist
        J[..., FLANGE] = twist @ frames.adjoint(frames.invert(motion @ state.T_flange_sensor))
        J[..., MISMATCH] = J[..., FLANGE] @ self.axes.twists(motion, share)
        return residual, J, twist

    def _line(self, state: TrackerUnknowns, P: Array, face: int) -> tuple[Array, Array, Array]:
        lines, m = self.lines[face], len(P)
        R, t = P[:, :3, :3], P[:, :3, 3]
        n = state.cube.normals[face] @ R
        d = state.cube.offsets[face] - t @ state.cube.normals[face]
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
        B = tangents(state.cube.normals[face])
        J[..., NORMALS[face]] = (by_n @ np.swapaxes(R, 1, 2) - by_d * t[:, None]) @ B
        J[..., OFFSETS.start + face] = by_d[..., 0]
        return residual, twist / sigma[..., None], J / sigma[..., None]

    @cached_property
    def _seen(self) -> NDArray[np.bool_]:
        """Which rows (m, 7) of the profiles there are."""
        faces = [np.repeat(lines.seen[:, None], OF_FACE, axis=1) for lines in self.lines]
        return np.concatenate([*faces, self.caps.seen], axis=1)

    @cached_property
    def _whitening(self) -> Array:
        """Inverse square root (m, 7, 7) of the profiles' covariance."""
        twist = self._profiles(self.start)[2] * self._seen[..., None]
        to_sensor = frames.adjoint(frames.invert(self.start.T_flange_sensor))
        G = twist @ to_sensor @ self._joint_errors(self.data.q)
        return np.linalg.inv(np.linalg.cholesky(np.eye(G.shape[1]) + G @ np.swapaxes(G, 1, 2)))

    @cached_property
    def _arc_motions(self) -> list[tuple[Array, Array]]:
        """Of each arc its motion (n, 4, 4), and the inverse roots (n, 3, 3) of covariances."""
        found = []
        for arc in self.data.arcs:
            T = self.data.relative(arc.q)
            v, w = np.split(self._joint_errors(arc.q), 2, axis=1)
            R = self.start.T_tracker_flange[:3, :3] @ T[:, :3, :3]
            G = R @ (v - frames.skew(self.start.reflector) @ w)
            covariance = self.noise.tracker_m**2 * np.eye(3) + G @ np.swapaxes(G, 1, 2)
            found.append((T, np.linalg.inv(np.linalg.cholesky(covariance))))
        return found

    @property
    def readings(self) -> Array:
        """Of the joints (g, dof): at the points of the arcs, then at the profiles."""
        return np.concatenate([*(arc.q for arc in self.data.arcs), self.data.q])

    def pose_rows(self, state: TrackerUnknowns) -> tuple[Array, Array]:
        """What whitened rows at the readings move by: (g, 7, 26) unknowns, (g, 7, 6) the flange.

        By its (v, w), own axes. Rows that a reading lacks are zero.
        """
        R, points = state.T_tracker_flange[:3, :3], []
        for arc, (motion, white) in zip(self.data.arcs, self._arc_motions, strict=True):
            T = self.axes.carried(motion, state.mismatch, self.axes.share_of(arc.q))
            lever = np.concatenate([np.eye(3), -frames.skew(state.reflector)], axis=1)
            points.append(white @ R @ T[:, :3, :3] @ lever)
        twist = self._whitening @ self._profiles(state)[2]
        by_pose = twist @ frames.adjoint(frames.invert(state.T_flange_sensor))
        arcs = np.concatenate(points)
        by_arcs = np.zeros((len(arcs), *by_pose.shape[1:]))
        by_arcs[:, :3] = arcs
        return (
            self.of_readings(self.linearise(state)[1][:, 0]),
            np.concatenate([by_arcs, by_pose * self._seen[..., None]]),
        )

    def of_readings(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Those of all rows (r, ...) that belong to `readings`: (g, 7, ...), zero where none is."""
        points = sum(len(arc.points) for arc in self.data.arcs)
        there = np.zeros((len(self.readings), self._seen.shape[1]), dtype=np.bool_)
        there[:points, :3], there[points:] = True, self._seen
        found = np.zeros((*there.shape, *rows.shape[1:]), dtype=rows.dtype)
        found[there] = np.concatenate([rows[: 3 * points], rows[len(rows) - self._seen.sum() :]])
        return found

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


LARGEST_SCALE = 3.0  # of residuals over the noise that was given
LEAST_REST = 1e-6  # what the others say about a profile, where they say anything


def profile_distances(
    classic: Classic, states: Sequence[TrackerUnknowns]
) -> tuple[Array, NDArray[np.bool_]]:
    """Rms distance (m,), m, of each profile's points from the target, and which show it.

    ``states`` (m,): for each profile, where sensor and target are.
    """
    axes = AxisPair.of(classic.data, classic.axes)
    P = np.array([axes.sensor_poses(classic.data, state)[i] for i, state in enumerate(states)])
    normals = np.array([state.cube.normals for state in states])
    offsets = np.array([state.cube.offsets for state in states])
    centres = np.array([state.cube.centre for state in states])
    total, count = np.zeros(len(P)), np.zeros(len(P))
    for index, scan in enumerate(classic.parts):
        own = scan.profile
        points = from_plane(P[own], scan.points)
        if index < len(FACES):
            off = np.einsum("ni,ni->n", points, normals[own, index]) - offsets[own, index]
        else:
            off = np.linalg.norm(points - centres[own], axis=1) - classic.target.sphere_radius_m
        total += np.bincount(own, off**2, len(P))
        count += np.bincount(own, minlength=len(P))
    return np.sqrt(total / np.maximum(count, 1)), count > 0


def states_without(
    problem: TrackerProblem, estimate: Estimate[TrackerUnknowns], names: Sequence[str]
) -> list[TrackerUnknowns | None]:
    """The solution without each of these profiles, to first order; None where it is none.

    Without the rows i the estimate moves by M J_i^T (I - J_i M J_i^T)^-1 r_i, M the inverse
    information (Cook and Weisberg 1982, "Residuals and Influence in Regression", section 3.4).
    """
    J = problem.linearise(estimate.state)[1][:, 0]
    M = estimate.covariance / estimate.scale**2
    rows = np.array(problem.rows)
    found: list[TrackerUnknowns | None] = []
    for name in names:
        own = (rows == name) & ~estimate.rejected
        rest = np.eye(int(own.sum())) - J[own] @ M @ J[own].T
        if np.any(np.linalg.eigvalsh(rest) < LEAST_REST):
            found.append(None)
            continue
        step = M @ J[own].T @ np.linalg.solve(rest, estimate.residual[own, 0])
        found.append(estimate.state.moved(step))
    return found


def misfit(estimate: Estimate[TrackerUnknowns]) -> float:
    """Root mean square of the whitened residuals in use, unknowns counted: about 1."""
    used = estimate.residual[~estimate.rejected]
    return float(np.sqrt(np.sum(used**2) / max(used.size - len(estimate.names), 1)))


def judge_tracker(estimate: Estimate[TrackerUnknowns], working_m: float, limit_m: float) -> Verdict:
    """Whether a solution may be used; ``working_m``: error to expect at the working distance."""
    over, lost, rows = misfit(estimate), int(estimate.rejected.sum()), len(estimate.rejected)
    what = (
        f"{working_m * 1e3:.3f} mm rms to expect at the working distance (allowed "
        f"{limit_m * 1e3:.3f}), residuals {over:.2f} times the noise"
    )
    if not estimate.converged:
        return Verdict(Code.POSES_NOT_INFORMATIVE, f"{estimate.creeping}; {what}")
    if over > LARGEST_SCALE or lost > MOST_REJECTED * rows:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{what}, {lost} of {rows} numbers left out: check the robot file, the noise that was "
            "given, and that tracker, base and target stood still",
        )
    if working_m > limit_m:
        return Verdict(
            Code.POSES_NOT_INFORMATIVE,
            f"{what}: measure longer arcs, and more points spread wider over the faces",
        )
    return Verdict(Code.ACCEPT, what)


LIMIT_M = 5e-4  # of the error to expect at the working distance
SMALLEST_NOISE_M = 1e-7  # no sensor sees less; keeps data without noise solvable
MOST_ROUNDS, NEAR_M = 10, 1e-5  # the sphere is linear only near its place


def solve_tracker(
    data: TrackerData,
    target: TrackerTarget,
    noise: TrackerNoise,
    method: Method = "best",
    limit_m: float = LIMIT_M,
    joint_error_rad: float = 0.0,
    towards: bool = False,
) -> HandEyeResult:
    """Calibrate; ``limit_m``: largest error to expect at the working distance that is accepted.

    ``joint_error_rad``: see `HandEyeSettings`. ``towards``: z of the profiles grows towards the
    sensor (a height), not away from it (a distance).
    """
    if towards:
        away = [replace(one, points=one.points * mirror(towards)) for one in data.profiles]
        data = replace(data, profiles=away)
        return _turned(solve_tracker(data, target, noise, method, limit_m, joint_error_rad))
    classic = solve_classic(data, target, noise)
    problem, estimate = solve_best(classic)
    best = _result(classic, estimate.state, "best")
    worst: dict[str, float] = {}
    for index in np.flatnonzero(estimate.rejected):
        name = problem.rows[index]
        worst[name] = max(worst.get(name, 0.0), float(abs(estimate.residual[index, 0])))
    misses = {
        name: f"misses the solution by {miss:.1f} times its noise" for name, miss in worst.items()
    }
    states = states_without(problem, estimate, [profile.name for profile in data.profiles])
    told = estimate.covariance[SENSOR, SENSOR]
    field = field_points([profile.points for profile in data.profiles])
    working_m = float(expected_error_m(told, field))
    angle, gap_m = estimate.state.mismatch.tolist()
    more = {
        **best.more,
        "residual_over_noise": misfit(estimate),
        "widened_by": estimate.scale,
        "axes_off_nominal": {"angle_deg": float(np.degrees(angle)), "gap_mm": gap_m * 1e3},
    }
    best = replace(
        best,
        covariance=told,
        rejected={**best.rejected, **misses},
        leave_one_out_m=_left_out(classic, states),
        working_error_m=working_m,
        verdict=judge_tracker(estimate, working_m, limit_m),
        more=more,
    )
    erring = joint_errors(problem, estimate, joint_error_rad) if joint_error_rad else None
    best = said_of_joints(best, erring)
    return _classic(classic, best, limit_m) if method == "classic" else best


def joint_errors(
    problem: TrackerProblem, estimate: Estimate[TrackerUnknowns], size_rad: float
) -> JointErrors | None:
    """What joints that err by ``size_rad`` add to a sensor's covariance.

    None where the model holds what they err by. The noise of tracker, sensor and joints is known:
    what residuals show beyond it is by joints that err, and widens the covariance that is told.
    Where they would add more to the residuals than these show, they err by less.
    """
    data = problem.data
    errors = flange_errors(data.arm, size_rad, problem.readings)
    if errors is None:
        return None
    known = estimate.covariance / estimate.scale**2
    J, G = problem.pose_rows(estimate.state)
    used = problem.of_readings(~estimate.rejected)[..., None]
    by_joints = PoseRows(J, G * used, known, SENSOR).of_mount(errors)
    squared = PoseRows(J, G, known, SENSOR).squared(errors)  # rejected ones show the most
    left = estimate.residual.size - len(estimate.names)
    seen = max(float(np.sum(estimate.residual**2)) - left, 0.0)
    if seen < squared:
        by_joints, size_rad = by_joints * seen / squared, size_rad * float(np.sqrt(seen / squared))
    widened = (estimate.scale**2 - 1.0) * known[SENSOR, SENSOR]
    told = estimate.covariance[SENSOR, SENSOR]
    return JointErrors.beside(size_rad, by_joints - widened, told)


def _classic(classic: Classic, best: HandEyeResult, limit_m: float) -> HandEyeResult:
    """The closed form; its error is its distance from the best estimate, with that one's own."""
    away_m = apart(
        classic.T_flange_sensor,
        best.T_flange_sensor,
        field_points([profile.points for profile in classic.data.profiles]),
    )
    error_m = float(np.hypot(away_m, best.working_error_m or 0.0))
    states = [
        None if T is None else replace(_state(classic), T_flange_sensor=T)
        for T in each_without(classic)
    ]
    return replace(
        _result(classic, _state(classic), "classic"),
        leave_one_out_m=_left_out(classic, states),
        working_error_m=error_m,
        verdict=judge_classic(away_m, error_m, limit_m) if best.verdict.accept else best.verdict,
    )


def _turned(result: HandEyeResult) -> HandEyeResult:
    """A result for the same profiles with -z in place of z: half a turn about the sensor's x."""
    half = frames.transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    both, covariance = np.kron(np.eye(2), half[:3, :3]), result.covariance
    return replace(
        result,
        T_flange_sensor=result.T_flange_sensor @ half,
        covariance=None if covariance is None else both @ covariance @ both,
    )


def _left_out(classic: Classic, states: Sequence[TrackerUnknowns | None]) -> Array | None:
    """Rms distance (n,), m, of each profile's points from the target as found without it.

    None where a profile alone determines something.
    """
    known = [state for state in states if state is not None]
    if len(known) < len(states):
        return None
    distance_m, seen = profile_distances(classic, known)
    return distance_m[seen]


def _state(classic: Classic) -> TrackerUnknowns:
    poses = classic.T_tracker_flange, classic.T_flange_sensor
    return TrackerUnknowns(*poses, classic.reflector, classic.tracked, np.zeros(2))


def solve_best(classic: Classic) -> tuple[TrackerProblem, Estimate[TrackerUnknowns]]:
    """All measurements at once, from the closed form on; the noise of the profiles is theirs.

    Raises `TooFewSamplesError` or `RankDeficientError` as `estimation.estimation.solve`;
    `ResidualError` when the place of the sphere does not settle.
    """
    data, target = classic.data, classic.target
    fits = [fit_lines(scan, name) for scan, name in zip(classic.parts, FACES, strict=False)]
    scatter_m = float(np.sqrt(np.mean([scatter**2 for _, scatter, _ in fits])))
    noise_m = max(scatter_m, SMALLEST_NOISE_M)
    alike = float(np.mean([alike for _, _, alike in fits]))
    shared_m = noise_m * float(np.sqrt(alike))  # as if each point had its own
    lines = [
        replace(line, z_sigma=line.z_sigma * shared_m, slope_sigma=line.slope_sigma * shared_m)
        for line, _, _ in fits
    ]
    state = _state(classic)
    axes = AxisPair.of(data, classic.axes)
    place = sphere_in(axes.sensor_poses(data, state), state.cube.centre)
    for _ in range(MOST_ROUNDS):
        caps = fit_caps(classic.parts[2], place, target.sphere_radius_m, noise_m, alike)
        problem = TrackerProblem(data, target, classic.noise, state, axes, lines, caps)
        estimate = solve(problem, state)
        state, before = estimate.state, place
        place = sphere_in(axes.sensor_poses(data, state), state.cube.centre)
        if np.abs(place - before).max() < NEAR_M:
            return problem, estimate
    raise ResidualError(
        f"the place of the sphere in the profiles did not settle in {MOST_ROUNDS} rounds: scan "
        "more of it, and check the robot file"
    )


def _result(classic: Classic, state: TrackerUnknowns, method: Method) -> HandEyeResult:
    """What both methods report, not judged yet."""
    names = np.array([profile.name for profile in classic.data.profiles])
    residual_m, seen = profile_distances(classic, [state] * len(names))
    return HandEyeResult(
        kind="tracker",
        method=method,
        T_flange_sensor=state.T_flange_sensor,
        covariance=None,
        samples=tuple(names[seen].tolist()),
        residual_m=residual_m[seen],
        verdict=Verdict(Code.NONE, ""),
        rejected=dict.fromkeys(names[~seen].tolist(), "shows neither the faces nor the sphere"),
        target={
            "center_tracker_mm": (state.cube.centre * 1e3).tolist(),
            "face_angle_deg": float(np.degrees(state.cube.angle)),
            "sphere_height_mm": (state.cube.heights * 1e3).tolist(),
        },
        more={
            "reflector_flange_mm": (state.reflector * 1e3).tolist(),
            "mismatch_mm": classic.mismatch_m * 1e3,
        },
    )
