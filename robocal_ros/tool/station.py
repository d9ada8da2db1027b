# SPDX-License-Identifier: Apache-2.0
"""The laser frame measured in a run: a known cylinder, the mandrel, through both beams.

Upright circles tell where each beam lies across and which way it runs, plunges beside the crossing
how high it is at two places. The problem is that of a tool's run (`crossed_model`) the other way
round: the tool is known and the points A ... D of the beams are free, so that the covariance holds
the robot's repeatability and the edges. What the mandrel's place is off by is in every measurement
alike: it is not in the sigma, and cancels in a change. Nor can a run tell a wrong radius from beams
that reach further: so what its shadows are wider than both say counts in the frame's height.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.estimation.estimation import SOUND_FIT, chi2_quantile, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, ResidualError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.tool.crossed_model import (
    EXACT_M,
    LARGEST_MISFIT_M,
    BeamStep,
    Held,
    RobotNoise,
    run_problem,
)
from robocal_ros.tool.laser_frame import POINTS, FlangePath, LaserFrame
from robocal_ros.tool.run import LITTLE_TURN_RAD, TraitLimits, WrongToolError, beyond

if TYPE_CHECKING:
    from robocal_ros.tool.documents import StationShiftDocument, StationTrendDocument

ROUGH_M = 5e-3  # how well the beams' points are known before: a drawing, or before a knock
KNOWN = Held(tilt_rad=EXACT_M, along_m=EXACT_M, across_m=EXACT_M)
REACHES = 3  # turns of reach and place: one moves the other by its square
NEVER = 0.001  # chance that a station that stands still looks moved
CLEAR_SIGMAS = 3.29  # as seldom a mandrel of the right radius seems another
LARGEST_REACH_M = 2e-3  # half of the thickest beam
DAY_NS = 86_400 * 10**9
H_M = 1e-7


@dataclass(frozen=True, eq=False)
class StationMeasurement:
    """Beams as a run found them.

    ``laser``: with the reach of each beam. ``covariance`` (8, 8): of A ... D, each across its beam
    and upwards, m^2. ``misfit_m``: rms of the edges, m. ``wider_m``, ``wider_sigma_m``: by how much
    the shadows are wider, in the mean of both beams, than the mandrel's radius and the reach that
    the laser file had.
    """

    laser: LaserFrame
    covariance: Array
    misfit_m: float
    wider_m: float = 0.0
    wider_sigma_m: float = 0.0

    @property
    def frame_covariance(self) -> Array:
        """(6, 6) of the frame's origin and of its turn about that, base, m^2 and rad^2."""
        R, rows = np.kron(np.eye(2), self.laser.T_base_laser[:3, :3]), _frame_rows(self.laser)
        spread = rows @ self.covariance @ rows.T
        spread[2, 2] += clear_m(self.wider_m, self.wider_sigma_m) ** 2
        return np.asarray(R @ spread @ R.T)

    @property
    def sigma_m(self) -> float:
        """Standard deviation of a coordinate of a point across its beam."""
        return float(np.sqrt(np.mean(np.diag(self.covariance))))


@dataclass(frozen=True, eq=False)
class StationShift:
    """How a station has moved, in its own axes then.

    ``shift`` (3,) of the crossing, m, and ``turn`` (3,) of the frame, rad; ``covariance`` (6, 6),
    of both measurements, and ``own`` (6, 6) of the later one.
    ``moved``: whether one of them is more than both measurements explain.
    """

    shift: Array
    turn: Array
    covariance: Array
    own: Array
    moved: bool

    @property
    def size_m(self) -> float:
        """Length of the shift."""
        return float(np.linalg.norm(self.shift))

    @property
    def sigma_m(self) -> float:
        """Its standard deviation, in the worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def turned_rad(self) -> float:
        """Angle of the turn."""
        return float(np.linalg.norm(self.turn))

    def document(self) -> "StationShiftDocument":
        """For people: mm and degrees."""
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            "shift_mm": (1e3 * self.shift).tolist(),
            "shift_sigma_mm": (1e3 * sigma[:3]).tolist(),
            "turn_deg": np.degrees(self.turn).tolist(),
            "turn_sigma_deg": np.degrees(sigma[3:]).tolist(),
            "moved": self.moved,
        }


def clear_m(wider_m: float, sigma_m: float) -> float:
    """What chance does not explain of it: all, or nothing."""
    return wider_m if abs(wider_m) > CLEAR_SIGMAS * sigma_m else 0.0


def moved_points(laser: LaserFrame, bend: Array) -> LaserFrame:
    """The frame with A ... D moved (4, 2), across each beam and upwards, m."""
    across = bend[:, :1] * np.repeat(laser.normals, 2, axis=0)
    up = bend[:, 1:] * laser.T_base_laser[:3, 2]
    return replace(laser, points=laser.points + across + up)


def measure_station(
    laser: LaserFrame,
    path: FlangePath,
    steps: Sequence[BeamStep],
    T_flange_cylinder: Array,
    radius_m: float,
    noise: RobotNoise,
) -> StationMeasurement:
    """Find the beams from the edges of a cylinder of known place, axis and radius.

    ``laser``: the beams roughly, to some millimetres; A ... D stay beside its points.
    ``T_flange_cylinder`` (4, 4): its end, z along its axis; ``radius_m`` as certified: how far a
    beam reaches is what its shadows are wider than that.

    Raises `BeamError` when edges are missing or out of order; `InputError` or `ResidualError` when
    no two beams explain them; `WrongToolError` when the shadows are another cylinder's.
    """
    rough, bend = replace(laser, sigma_m=ROUGH_M), np.zeros((4, 2))
    for _ in range(REACHES):
        problem, start = run_problem(rough, path, steps, T_flange_cylinder, noise, held=KNOWN)
        start = replace(start, bend=bend, radius=np.full_like(start.radius, radius_m))
        found = solve(problem, start, prior_information=problem.prior, robust=False)
        if not found.converged:
            raise ResidualError(
                "no two beams are found: the search still moves; check the mandrel's place on the "
                "flange, the robot's model and the laser file"
            )
        bend = found.state.bend
        wider = found.state.radius.mean(axis=0) - radius_m
        if float(np.abs(wider).max()) > LARGEST_REACH_M:
            raise WrongToolError(
                f"its shadows are those of a radius of {1e3 * (radius_m + wider.max()):.2f} mm, "
                f"the mandrel's is {1e3 * radius_m:.2f} mm: another one is mounted, or "
                "mandrel_radius_mm is wrong"
            )
        rough = replace(rough, reach=wider)
    misfit_m = problem.edges_rms_m(found)
    if misfit_m > LARGEST_MISFIT_M:
        raise ResidualError(
            f"the edges miss any two beams by {1e3 * misfit_m:.3f} mm rms (allowed "
            f"{1e3 * LARGEST_MISFIT_M:.1f} mm): is the mandrel bent or loose?"
        )
    names = found.names
    beams = [i for i, name in enumerate(names) if name.startswith("laser_")]
    C, reach_variance = found.covariance[np.ix_(beams, beams)].copy(), []
    for b, beam in enumerate("xy"):  # what is not known of a reach lifts both points of its beam
        own = [i for i, name in enumerate(names) if name.startswith(f"radius_{beam}_")]
        variance = float(found.covariance[np.ix_(own, own)].mean())
        up = [4 * b + 1, 4 * b + 3]
        C[np.ix_(up, up)] += variance
        reach_variance.append(variance)
    squares = problem.misfit(found, found.scale)
    free = len(found.residual) - problem.undetermined - bend.size
    if free > 0 and squares > chi2_quantile(SOUND_FIT, free):
        C *= squares / free
    placed = moved_points(rough, bend)
    sigma_m = float(np.sqrt(np.mean(np.diag(C))))
    wider_m = float(np.mean(wider - laser.reach))
    wider_sigma_m = float(np.hypot(0.5 * np.sqrt(np.sum(reach_variance)), laser.sigma_m))
    return StationMeasurement(replace(placed, sigma_m=sigma_m), C, misfit_m, wider_m, wider_sigma_m)


def station_shift(before: StationMeasurement, now: StationMeasurement) -> StationShift:
    """How the station has moved between two measurements with one mandrel.

    What the shadows of both are wider, no more than a tool's may be, counts in the height.

    Raises `InputError` when they are not of the same beams; `WrongToolError` when their shadows are
    of two cylinders.
    """
    bend = _bend(before.laser, now.laser)
    C, up = before.covariance + now.covariance, np.tile([0.0, 1.0], 4)
    sigma_m = float(np.hypot(now.wider_sigma_m, before.wider_sigma_m or now.wider_sigma_m))
    wider_m = clear_m(float(np.mean(now.laser.reach - before.laser.reach)), sigma_m)
    if beyond(wider_m, sigma_m, TraitLimits.radius_m):
        raise WrongToolError(
            f"its shadows are of a radius {1e3 * wider_m:+.3f} mm from that of the first time: "
            "another mandrel is mounted, it or both beams are dirty, or mandrel_radius_mm was "
            "wrong then; mount the right one, clean all"
        )
    C = C + wider_m**2 * np.outer(up, up)
    if float(np.abs(bend).max()) > 2.0 * ROUGH_M:
        raise InputError(
            f"the beams lie {1e3 * np.abs(bend).max():.1f} mm apart: these are two stations"
        )

    found, rows = _frame_moved(before.laser, bend), _frame_rows(before.laser)
    spread, limit = rows @ C @ rows.T, chi2_quantile(1.0 - NEVER / 2.0, 3)
    parts = [(found[i], spread[i, i]) for i in (slice(3), slice(3, 6))]
    moved = any(away @ np.linalg.solve(own, away) > limit for away, own in parts)
    return StationShift(found[:3], found[3:], spread, rows @ now.covariance @ rows.T, moved)


def station_verdict(
    found: StationMeasurement, shift: StationShift | None, limit_m: float, sigma_limit_m: float
) -> Verdict:
    """Whether the laser file still holds; ``shift``: against the first time, None of that.

    ``limit_m``: so far the crossing may move; a move beyond it that may be chance is no answer. A
    turn that a tool's full run tells is one here. ``sigma_limit_m``: so well the first one must
    know the beams, as all later ones are compared with it.
    """
    if shift is None:
        words = f"the beams are known to {1e3 * found.sigma_m:.3f} mm at each point"
        if wider_m := clear_m(found.wider_m, found.wider_sigma_m):
            words += (
                f"; the mandrel's shadows are {1e3 * wider_m:+.3f} mm from what mandrel_radius_mm "
                "and the laser file's reach_mm say: where the radius is wrong the height is"
            )
        if not found.sigma_m <= sigma_limit_m:
            words += f"; allowed {1e3 * sigma_limit_m:g} mm: read the beams faster, or repeat it"
            return Verdict(Code.RESIDUAL_TOO_LARGE, words)
        return Verdict(Code.ACCEPT, words)
    words = (
        f"the crossing is {1e3 * shift.size_m:.3f} mm from where it was first "
        f"(sigma {1e3 * shift.sigma_m:.3f})"
    )
    turned = shift.turned_rad > LITTLE_TURN_RAD
    if shift.moved and (turned or shift.size_m > limit_m):
        if turned:
            words += f", and the station has turned by {np.degrees(shift.turned_rad):.2f} deg"
        words += ": write its new laser file (robocal tool station), and use it"
        return Verdict(Code.STATION_MOVED, words)
    if shift.size_m > limit_m:
        return Verdict(Code.TOO_FEW_SAMPLES, f"{words}, which may be chance: repeat it")
    if shift.moved:
        words += ", more than chance, less than matters"
    return Verdict(Code.ACCEPT, words)


def _frame_moved(laser: LaserFrame, bend: Array) -> Array:
    """Shift and turn (6,) of the frame in its own axes, by moved points (4, 2)."""
    away = frames.invert(laser.T_base_laser) @ moved_points(laser, bend).T_base_laser
    return np.concatenate([away[:3, 3], frames.log_rotation(away[:3, :3])])


def _frame_rows(laser: LaserFrame) -> Array:
    """Of `_frame_moved` by the points' moves (6, 8)."""
    steps = H_M * np.eye(8).reshape(8, 4, 2)
    moved = [_frame_moved(laser, h) - _frame_moved(laser, -h) for h in steps]
    return np.array(moved).T / (2.0 * H_M)


def _bend(before: LaserFrame, now: LaserFrame) -> Array:
    """How far (4, 2) the new beams pass the old points, across each beam and upwards, m."""
    along = np.repeat(now.direction, 2, axis=0)
    apart = np.repeat(now.points[[0, 2]], 2, axis=0) - before.points
    u = np.repeat(before.direction, 2, axis=0)
    # to where the new beam crosses the plane through the old point, across the old beam
    reach = np.sum(apart * u, axis=1) / np.sum(along * u, axis=1)
    away = apart - reach[:, None] * along
    normals = np.repeat(before.normals, 2, axis=0)
    return np.column_stack([np.sum(away * normals, axis=1), away @ before.T_base_laser[:3, 2]])


def measurement_document(found: StationMeasurement) -> Document:
    """A measurement in SI, for keeping; `measurement_of` reads it back."""
    return {
        "points_m": dict(zip(POINTS, found.laser.points.tolist(), strict=True)),
        "reach_m": found.laser.reach.tolist(),
        "covariance": found.covariance.tolist(),
        "misfit_m": found.misfit_m,
        "wider_m": found.wider_m,
        "wider_sigma_m": found.wider_sigma_m,
    }


def measurement_of(document: Document) -> StationMeasurement:
    """Read a measurement back."""
    C = np.array(document["covariance"])
    points = np.array([document["points_m"][name] for name in POINTS])
    laser = LaserFrame(points, float(np.sqrt(np.mean(np.diag(C)))), np.array(document["reach_m"]))
    wider = (document.get(name, 0.0) for name in ("wider_m", "wider_sigma_m"))  # older have none
    return StationMeasurement(laser, C, document["misfit_m"], *wider)


@dataclass(frozen=True, eq=False)
class StationTrend:
    """Straight line through the crossing's shifts over time, in the station's axes at first.

    Weighted by each measurement's own covariance. What the first one is off by is in all shifts
    alike: it moves the line, and is neither in its slope nor in the slope's sigma. Of a station
    that drifts; one that was knocked is another one from then on.

    ``from_ns``, ``to_ns``: stamps of the first and the last measurement, of ``count``.
    ``information`` (6, 6), ``right`` (6,): normal equations of the line's height at ``from_ns``, m,
    and of its slope, m a day.
    """

    from_ns: int = 0
    to_ns: int = 0
    count: int = 0
    information: Array = field(default_factory=lambda: np.zeros((6, 6)))
    right: Array = field(default_factory=lambda: np.zeros(6))

    def after(self, stamp_ns: int, one: StationShift) -> "StationTrend":
        """With one measurement more; of the first one the shift is none."""
        from_ns = self.from_ns if self.count else stamp_ns
        rows = np.concatenate([np.eye(3), (stamp_ns - from_ns) / DAY_NS * np.eye(3)], axis=1)
        weight = np.linalg.inv(one.own[:3, :3])
        return StationTrend(
            from_ns,
            max(self.to_ns, stamp_ns),
            self.count + 1,
            self.information + rows.T @ weight @ rows,
            self.right + rows.T @ weight @ one.shift,
        )

    @property
    def days(self) -> float:
        """From the first measurement to the last."""
        return (self.to_ns - self.from_ns) / DAY_NS

    @property
    def line(self) -> tuple[Array, Array] | None:
        """Slope (3,), m a day, and its covariance (3, 3); None of measurements at one time."""
        if self.count < 2 or self.days <= 0.0:
            return None
        C = np.asarray(np.linalg.inv(self.information))
        return (C @ self.right)[3:], C[3:, 3:]

    def document(self) -> "StationTrendDocument":
        """For people: mm and days; null where there is no line."""
        if (line := self.line) is None:
            return {"per_day_mm": None, "sigma_mm": None, "days": self.days}
        slope, C = line
        return {
            "per_day_mm": (1e3 * slope).tolist(),
            "sigma_mm": (1e3 * np.sqrt(np.diag(C))).tolist(),
            "days": self.days,
        }

    def words(self, limit_m: float) -> str:
        """Whether it drifts, and when that is ``limit_m`` from where it was; empty of no line."""
        if (line := self.line) is None:
            return ""
        slope, C = line
        over = f"over {self.count} measurements in {self.days:.2g} days"
        if slope @ np.linalg.solve(C, slope) <= chi2_quantile(1.0 - NEVER, 3):
            worst_m = self.days * float(np.sqrt(np.linalg.eigvalsh(C)[-1]))
            return f"no drift is seen {over} (sigma {1e3 * worst_m:.3f} mm)"
        rate = float(np.linalg.norm(slope))
        sigma = float(np.sqrt(slope @ C @ slope)) / rate
        return (
            f"it drifts by {1e3 * rate:.3g} mm a day (sigma {1e3 * sigma:.2g}, {over}): "
            f"{1e3 * limit_m:.2f} mm in {limit_m / rate:.2g} days"
        )

    def model(self) -> Document:
        """In SI, for keeping; `of_model` reads it back."""
        return {
            "from_ns": self.from_ns,
            "to_ns": self.to_ns,
            "count": self.count,
            "information": self.information.tolist(),
            "right": self.right.tolist(),
        }

    @classmethod
    def of_model(cls, model: Document) -> "StationTrend":
        """Read what `model` gave, also after JSON."""
        matrix, right = (np.array(model[name]) for name in ("information", "right"))
        return cls(model["from_ns"], model["to_ns"], model["count"], matrix, right)


ANSWER_OF: Mapping[Code, str] = {Code.ACCEPT: "pass", Code.STATION_MOVED: "recalibrate"}


def result_document(
    found: StationMeasurement,
    shift: StationShift,
    trend: StationTrend,
    verdict: Verdict,
    *,
    commissioned: bool,
) -> Document:
    """What a run's caller is told; ``commissioned``: whether there was a first one before it."""
    return {
        "answer": ANSWER_OF.get(verdict.code, "cannot tell"),
        "change": {"tip_mm": 1e3 * shift.size_m, "axis_deg": np.degrees(shift.turned_rad)},
        "sigma_mm": [1e3 * (shift.sigma_m if commissioned else found.sigma_m)],
        "misfit_mm": 1e3 * found.misfit_m,
        "station": shift.document(),
        "trend": trend.document(),
        "verdict": verdict_document(verdict),
    }
