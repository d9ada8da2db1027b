# SPDX-License-Identifier: Apache-2.0
"""Is it the tool that changed, or the beam station that measures it?

A tool bends: what lies below the bend turns as one piece about it, so its tip moves by the tilt of
its axis times the lever from bend to tip, in the direction of the tilt. A station that was knocked
shifts and turns the measured tool as it likes; so does a tool that slipped in its mount.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.estimation.estimation import chi2_quantile
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_errors import JointErrors, flange_errors
from robocal_ros.tool.crossed_model import BeamStep, Held, RobotNoise, ToolEstimate, estimate_tool
from robocal_ros.tool.laser_frame import FlangePath, LaserFrame, minimal_rotation

Cause = Literal["tool", "station", "doubt"]
FITS = 0.95  # a bend's shift and tilt agree below this quantile of their noise
MISSES = 0.99  # and no more above this one: one true bend in a hundred
TILTED_SIGMAS = 3.09  # of a shift alone one in a thousand seems to tilt so much its own way
SMALL_M = 1e-4  # a change of the tip that may be taken for the tool's without proof
AXIAL_SHARE = 0.5  # a collision that bends a tool by so much may also push it in along its axis
AXIAL_SIGMAS = 3.0
LEVERS = 65


@dataclass(frozen=True)
class BendRule:
    """Where a tool may bend.

    ``nearest_m``: lever of a bend at or below the upper circle. What bends below it also looks as
    if it had this one: the axis is the line through both circles, and the tip lies on it.
    ``farthest_m``: from the mount to the tip; nothing of the tool bends beyond.
    """

    nearest_m: float
    farthest_m: float

    def __post_init__(self) -> None:
        if not 0.0 < self.nearest_m <= self.farthest_m < np.inf:
            raise InputError(
                f"a tool cannot bend between {self.nearest_m * 1e3:g} and "
                f"{self.farthest_m * 1e3:g} mm from its tip: the mount ('lever_mm') lies above the "
                "upper circle ('above_tip_mm' and 'circle_height_mm' together)"
            )


@dataclass(frozen=True, eq=False)
class Witness:
    """What a change of the measured tool says of its cause.

    ``tip_m``: how far the tip seems to have moved. ``tilt_rad``, ``tilt_sigma_rad``: of the axis,
    and its standard deviation in one direction. ``lever_m``: that explains shift and tilt best. It
    and the sigma are None where no noise is known.
    """

    cause: Cause
    reason: str
    tip_m: float
    tilt_rad: float
    tilt_sigma_rad: float | None = None
    lever_m: float | None = None

    def document(self) -> dict[str, Any]:
        """In the units people read."""
        sigma, lever = self.tilt_sigma_rad, self.lever_m
        return {
            "cause": self.cause,
            "reason": self.reason,
            "tip_mm": self.tip_m * 1e3,
            "tilt_deg": float(np.degrees(self.tilt_rad)),
            "tilt_sigma_deg": None if sigma is None else float(np.degrees(sigma)),
            "lever_mm": None if lever is None else lever * 1e3,
        }


def bend_or_station(change: Array, covariance: Array, rule: BendRule, small_m: float) -> Witness:
    """Tell a bend from a knocked station by the tilt that belongs to a shift.

    ``change`` (5,): of the tip along the tool's x, y, z, m, and of its axis along x and y, rad.
    ``covariance`` (5, 5): of it. ``small_m``: what the tip's change is since a tool whose cause was
    known; up to `SMALL_M` the tool may have it without proof: more harm it cannot do.

    Notes
    -----
    Shift d and tilt t of a bend with the lever L agree in d = L t. Over all L of the rule,

        m = min (d - L t)' C(L)^-1 (d - L t),  C(L) = C_dd - L (C_dt + C_td) + L^2 C_tt

    is chi-square with at most two degrees of freedom. A station that is knocked shifts the tip and
    never tilts the axis: the axis is the line on which the flange must stand for the tool to pass
    the crossing, whichever way the beams lie. A turn about the crossing changes neither to first
    order, one about the station's foot shifts the crossing. So t = 0 but for its noise, and its
    part along d is normal.
    """
    d, t, C_tt = change[:2], change[3:], covariance[3:, 3:]
    # The lever that explains shift and tilt best, and what is left, as chi-square.
    levers = np.linspace(rule.nearest_m, rule.farthest_m, LEVERS)
    L, C_dt = levers[:, None, None], covariance[:2, 3:]
    spread = covariance[:2, :2] - L * (C_dt + C_dt.T) + L**2 * C_tt
    off = d - levers[:, None] * t
    misses = np.einsum("ki,ki->k", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
    best = int(np.argmin(misses))
    lever_m, miss = float(levers[best]), float(misses[best])
    way = d / max(float(np.linalg.norm(d)), 1e-12)
    tilted = float(t @ way) > TILTED_SIGMAS * float(np.sqrt(way @ C_tt @ way))
    axial, sideways = abs(float(change[2])), float(np.linalg.norm(d))
    pushed_m = AXIAL_SHARE * sideways + AXIAL_SIGMAS * float(np.sqrt(covariance[2, 2]))
    tip, tilt = float(np.linalg.norm(change[:3])), float(np.linalg.norm(t))
    sigma = float(np.sqrt(np.max(np.linalg.eigvalsh(C_tt))))
    wanted = np.degrees(sideways / np.array([rule.farthest_m, rule.nearest_m]))
    what = (
        f"the tip seems {tip * 1e3:.3f} mm off, {sideways * 1e3:.3f} mm of it sideways, and the "
        f"axis {np.degrees(tilt):.3f} deg (sigma {np.degrees(sigma):.3f})"
    )
    cause: Cause = "doubt"
    if miss > chi2_quantile(MISSES, 2):
        cause = "station"
        why = (
            f"a bend would tilt it the same way by {wanted[0]:.2f} to {wanted[1]:.2f} deg: the "
            "beam station was knocked, or the tool slipped in its mount"
        )
    elif max(tip, small_m) <= SMALL_M:
        cause, why = "tool", f"no more than {SMALL_M * 1e3:.1f} mm"
    elif miss > chi2_quantile(FITS, 2) or not tilted:
        why = (
            f"a bend would tilt it by {wanted[0]:.2f} to {wanted[1]:.2f} deg, which this "
            "measurement cannot tell: a bent tool, or a knocked station"
        )
    elif axial > pushed_m:
        why = (
            f"it also reaches {axial * 1e3:.3f} mm further or less along its axis, which no bend "
            "explains: a bent tool, or a knocked station"
        )
    else:
        cause, why = "tool", f"as a bend {lever_m * 1e3:.0f} mm above the tip does"
    return Witness(cause, f"{what}: {why}", tip, tilt, sigma, lever_m)


HEALTHY_M, HEALTHY_RAD = 3e-3, float(np.radians(1.5))  # of a measured healthy tool from the taught
UNCHANGED = 0.95  # a difference below this quantile of its noise is none


@dataclass(frozen=True)
class ToolLimits:
    """What a tool measurement may say without being doubted.

    ``sigma_m``: largest standard deviation of the tip in any direction.
    ``change_m``, ``tilt_rad``: largest change from the taught tool: what the joint correction makes
    up for, so that no tool is proposed that it would not take over.
    """

    sigma_m: float = 2e-4
    change_m: float = 1e-2
    tilt_rad: float = float(np.radians(4.0))


@dataclass(frozen=True, eq=False)
class KnownTool:
    """A tool as it is kept.

    ``T_flange_tool`` (4, 4): pose in the flange frame.
    ``covariance`` (5, 5): as of a `ToolEstimate`; None: not measured.
    ``own_covariance`` (5, 5): what of it is its own run's alone; None: not known.
    ``against`` (4, 4): the healthy tool as measured, where this tool is the change against it.
    """

    T_flange_tool: Array
    covariance: Array | None = None
    own_covariance: Array | None = None
    against: Array | None = None

    @classmethod
    def measured(cls, estimate: ToolEstimate) -> "KnownTool":
        """As a run shows it, with the robot's absolute error and the laser frame's."""
        return cls(estimate.T_flange_tool, estimate.covariance, estimate.own_covariance)

    @classmethod
    def taught(cls, T_flange_tool: Array, healthy: "KnownTool") -> "KnownTool":
        """The taught tool: no change against the healthy one's run, and so exact.

        A run differs from it by its own noise and the healthy run's.
        """
        exact = np.zeros((5, 5))
        return cls(T_flange_tool, exact, healthy.own_covariance, healthy.T_flange_tool)

    def document(self) -> Document:
        """In full precision, SI; `of_document` reads it back to the last bit."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: None if part is None else part.tolist() for name, part in parts.items()}

    @classmethod
    def of_document(cls, document: Document) -> "KnownTool":
        """Read what `document` gave."""
        parts = {field.name: document.get(field.name) for field in fields(cls)}
        return cls(**{name: np.array(part) for name, part in parts.items() if part is not None})


@dataclass(frozen=True)
class ToolChange:
    """How far a tool is from another one: of the tip, m; of the axis, rad."""

    tip_m: float
    axis_rad: float

    def document(self) -> Document:
        """In the units people read."""
        return {"tip_mm": self.tip_m * 1e3, "axis_deg": float(np.degrees(self.axis_rad))}


def change_between(before: Array, after: Array) -> ToolChange:
    """From one T_flange_tool (4, 4) to another."""
    cross = float(np.linalg.norm(np.cross(before[:3, 2], after[:3, 2])))
    angle = float(np.arctan2(cross, before[:3, 2] @ after[:3, 2]))
    return ToolChange(float(np.linalg.norm(after[:3, 3] - before[:3, 3])), angle)


def changed_tool(taught: Array, healthy: KnownTool, measured: KnownTool) -> KnownTool:
    """The taught tool with the change between two measurements, both in the same way.

    What both have in common cancels: the error of the laser frame and the robot's absolute one.
    """
    turn = minimal_rotation(healthy.T_flange_tool[:3, 2], measured.T_flange_tool[:3, 2])
    tip = taught[:3, 3] + measured.T_flange_tool[:3, 3] - healthy.T_flange_tool[:3, 3]
    both = [known.covariance for known in (healthy, measured)]
    known = [c for c in both if c is not None]
    covariance = np.sum(known, axis=0) if len(known) == len(both) else None
    T = frames.transform(turn @ taught[:3, :3], tip)
    return KnownTool(T, covariance, measured.own_covariance, healthy.T_flange_tool)


def judge_healthy(
    found: KnownTool, estimate: ToolEstimate, taught: Array, limits: ToolLimits, name: str
) -> Verdict:
    """Whether a tool, or the mandrel, measures as a healthy one: known well, near the taught one.

    Between them lie the robot's absolute error and the laser frame's, no bump. ``name``: in words.
    """
    run = judge_run(estimate, limits)
    off = change_between(taught, found.T_flange_tool)
    what = (
        f"the {name} measures {off.tip_m * 1e3:.3f} mm and {np.degrees(off.axis_rad):.3f} deg "
        f"off; {run.reason}"
    )
    if not run.accept:
        return Verdict(run.code, what)
    if off.tip_m > HEALTHY_M or off.axis_rad > HEALTHY_RAD:
        return Verdict(
            Code.LIMIT_EXCEEDED,
            f"{what}; allowed {HEALTHY_M * 1e3:g} mm and {np.degrees(HEALTHY_RAD):g} deg: is it "
            "bent, or told wrongly?",
        )
    return Verdict(Code.ACCEPT, f"{what}: later runs give the change against this")


def judge_run(estimate: ToolEstimate, limits: ToolLimits) -> Verdict:
    """Accepted where the tip is known well enough; edges that fit no tool never come so far."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1]))
    words = (
        f"the tip is known to {sigma * 1e3:.3f} mm; edges within {estimate.misfit_m * 1e3:.3f} mm, "
        f"steps within {estimate.shift_m * 1e3:.3f} mm"
    )
    if not sigma <= limits.sigma_m:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{words} (allowed sigma {limits.sigma_m * 1e3:g} mm): read the beams faster, or "
            "place them more exactly",
        )
    return Verdict(Code.ACCEPT, words)


def judge_tool(
    found: KnownTool,
    estimate: ToolEstimate,
    taught: Array,
    in_force: KnownTool,
    limits: ToolLimits,
    witness: Witness,
) -> Verdict:
    """Decide whether a measured tool may replace the one in force.

    Refused: what `judge_run` refuses, a change from the taught tool beyond what may be, a tool
    that is the one in force as far as its noise tells, and a change that is the beam station's.
    """
    run = judge_run(estimate, limits)
    moved = change_between(in_force.T_flange_tool, found.T_flange_tool)
    what = (
        f"tip {moved.tip_m * 1e3:.3f} mm and axis {np.degrees(moved.axis_rad):.3f} deg from the "
        f"tool in force; {run.reason}"
    )
    if not run.accept:
        return Verdict(run.code, what)
    total = change_between(taught, found.T_flange_tool)
    if total.tip_m > limits.change_m or total.axis_rad > limits.tilt_rad:
        return Verdict(
            Code.LIMIT_EXCEEDED,
            f"{what}; {total.tip_m * 1e3:.2f} mm and {np.degrees(total.axis_rad):.2f} deg from the "
            f"taught tool (allowed {limits.change_m * 1e3:g} mm, "
            f"{np.degrees(limits.tilt_rad):g} deg): straighten or change the tool",
        )
    if unchanged(found, in_force):
        return Verdict(Code.NO_SIGNIFICANT_GAIN, f"{what}; the tool has not moved")
    if witness.cause == "station":
        return Verdict(Code.STATION_MOVED, f"{what}; {witness.reason}")
    return Verdict(Code.ACCEPT, f"{what}; {witness.reason}")


def unchanged(found: KnownTool, in_force: KnownTool) -> bool:
    """Whether two tools differ by no more than their noise (chi-square, 5 unknowns)."""
    spread = spread_between(found, in_force)
    if spread is None:
        return False
    d = difference(found, in_force)
    return float(d @ np.linalg.solve(spread, d)) <= chi2_quantile(UNCHANGED, len(d))


def difference(found: KnownTool, in_force: KnownTool) -> Array:
    """(5,) of the tip along the flange's x, y, z, and of the axis along the tool's x and y."""
    R = in_force.T_flange_tool[:3, :3]
    tilt = R[:, :2].T @ (found.T_flange_tool[:3, 2] - in_force.T_flange_tool[:3, 2])
    return np.append(found.T_flange_tool[:3, 3] - in_force.T_flange_tool[:3, 3], tilt)


def witness_of(found: KnownTool, in_force: KnownTool, rule: BendRule, anchor: Array) -> Witness:
    """What the change from the tool in force says of its cause, see `bend_or_station`.

    ``anchor`` (3,): tip of the tool in force, or of the last one whose cause was known.
    """
    d, spread = difference(found, in_force), spread_between(found, in_force)
    if spread is None:
        tip, tilt = float(np.linalg.norm(d[:3])), float(np.linalg.norm(d[3:]))
        words = "without a run of the healthy tool nothing tells a bent tool from a knocked station"
        return Witness("doubt", f"{words}: measure it in mode REFERENCE", tip, tilt)
    turn = np.eye(5)
    turn[:3, :3] = in_force.T_flange_tool[:3, :3].T  # flange axes to the tool's
    small_m = float(np.linalg.norm(found.T_flange_tool[:3, 3] - anchor))
    return bend_or_station(turn @ d, turn @ spread @ turn.T, rule, small_m)


def spread_between(found: KnownTool, in_force: KnownTool) -> Array | None:
    """Covariance (5, 5) of the difference of two tools; None where it is not known.

    In that of two changes against one run of the healthy tool its error cancels, and the laser
    frame's: what is each run's own is left. All other tools count whole.
    """
    run, other = found.against, in_force.against
    one_run = run is not None and other is not None and np.array_equal(run, other)
    if one_run and found.own_covariance is not None and in_force.own_covariance is not None:
        return found.own_covariance + in_force.own_covariance
    if found.covariance is None or in_force.covariance is None:
        return None
    return found.covariance + in_force.covariance


MOVED = 0.99  # of a station that stands one in a hundred seems to have moved
LOOSE = 0.999  # and a mandrel that is sound to have tilted one in a thousand


@dataclass(frozen=True, eq=False)
class StationFinding:
    """What a mandrel says of the station.

    ``shift`` (3,): of the beams' crossing since the commissioning, base, m; ``covariance`` (3, 3).
    ``change``: of the mandrel, as these beams see it.
    ``verdict``: ACCEPT: it stands. STATION_MOVED: it does not. TOO_FEW_SAMPLES: cannot be told.
    WRONG_TOOL: the mandrel itself has tilted, which no knock of the station makes of it.
    """

    shift: Array
    covariance: Array
    change: ToolChange
    verdict: Verdict

    def document(self) -> dict[str, Any]:
        """In the units people read."""
        return {
            "station_shift_mm": (self.shift * 1e3).tolist(),
            "sigma_mm": (np.sqrt(np.diag(self.covariance)) * 1e3).tolist(),
            "change": self.change.document(),
            "verdict": verdict_document(self.verdict),
        }


def station_finding(
    found: KnownTool, reference: KnownTool, spread: Array, R_base_flange: Array
) -> StationFinding:
    """Compare a mandrel (``found``) with how it measured at the commissioning.

    ``spread`` (5, 5): covariance of the difference; ``R_base_flange`` (3, 3): of the run. Where the
    crossing has moved by s the flange must go by s further, and the tip seems to be at R' (M - x),
    less by R' s.
    """
    d = difference(found, reference)
    shift = -R_base_flange @ d[:3]
    covariance = np.asarray(R_base_flange @ spread[:3, :3] @ R_base_flange.T)
    change = change_between(reference.T_flange_tool, found.T_flange_tool)
    tilt = float(d[3:] @ np.linalg.solve(spread[3:, 3:], d[3:]))
    seen = float(d[:3] @ np.linalg.solve(spread[:3, :3], d[:3]))
    where = ", ".join(f"{1e3 * x:+.3f}" for x in shift)
    what = f"the mandrel shows the beams' crossing {change.tip_m * 1e3:.3f} mm off, ({where}) mm"
    if tilt > chi2_quantile(LOOSE, 2):
        verdict = Verdict(
            Code.WRONG_TOOL,
            f"{what}, and has tilted by {np.degrees(change.axis_rad):.3f} deg, which no knock of "
            "the station makes of it: it is loose or was hit; mount it anew and measure it in mode "
            "WITNESS_REFERENCE",
        )
    elif change.tip_m <= SMALL_M:
        verdict = Verdict(Code.ACCEPT, f"{what}: the beam station stands where it stood")
    elif seen > chi2_quantile(MOVED, 3):
        verdict = Verdict(
            Code.STATION_MOVED,
            f"{what}: the beam station has moved; move it back, or place its beams anew and "
            "measure the healthy tool (REFERENCE) and the mandrel (WITNESS_REFERENCE)",
        )
    else:
        verdict = Verdict(Code.TOO_FEW_SAMPLES, f"{what}: too near the noise; measure it again")
    return StationFinding(shift, covariance, change, verdict)


def with_mandrel(
    witness: Witness, station: StationFinding, tool_shift: Array, *, after: bool
) -> Witness:
    """What the tool's change says once the station is known.

    That the station has moved holds for all that is measured with it. That it stands says nothing
    of a change that came later: so it lifts a doubt only where the mandrel was measured ``after``
    this change was seen. What cannot be a bend stays the station's, or of a tool that slipped.

    ``tool_shift`` (3,): of the tip from the tool in force, base, m; the station's is taken out.
    """
    parts = {"tip_m": witness.tip_m, "tilt_rad": witness.tilt_rad}
    if station.verdict.code is Code.STATION_MOVED:
        own_m = float(np.linalg.norm(tool_shift + station.shift))
        reason = (
            f"{station.verdict.reason}; without it the tool's tip is {own_m * 1e3:.3f} mm from the "
            "one in force"
        )
        return Witness("station", reason, **parts)
    if witness.cause == "doubt" and after and station.verdict.code is Code.ACCEPT:
        return Witness("tool", station.verdict.reason, **parts)
    return witness


Answer = Literal["pass", "recalibrate", "cannot tell"]
ERROR_CHANCE = 0.05  # of a pass, or a recalibration, that is wrong
HELD_TILT_RAD = 1e-3  # one circle does not see the tilt: near the stored one
HELD_ALONG_M = 5e-3  # nor how far the tip reaches


@dataclass(frozen=True)
class CheckRule:
    """What a tool may move.

    ``limit_m``: largest deviation of the tip.
    ``lever_m``: from where a bent tool bends to its tip; a tool bends at its mount.
    """

    limit_m: float = 2e-4
    lever_m: float = 0.15


@dataclass(frozen=True, eq=False)
class QuickCheck:
    """The answer.

    ``deviation`` (3,): of the tip from the stored one, tool axes, m; ``covariance`` (3, 3) of it.
    Along the axis 0 where the tip is too far off sideways for the plunge to tell.
    ``deviation_m``, ``sigma_m``: length of it, and the standard deviation along it.
    ``tilt_rad``: the tilt that moves the tip sideways by as much, if the tool bent at its mount;
    one circle cannot tell a tilt from a shift.
    """

    answer: Answer
    reason: str
    deviation: Array
    covariance: Array
    deviation_m: float
    sigma_m: float
    tilt_rad: float
    measured: ToolEstimate


def quick_check(
    laser: LaserFrame,
    path: FlangePath,
    steps: Sequence[BeamStep],
    stored: KnownTool,
    rule: CheckRule,
    *,
    noise: RobotNoise | None = None,
) -> QuickCheck:
    """Compare one circle and one plunge with the stored tool, as these same beams measure it.

    Pass: a deviation at the limit would look as small as this in at most 5 % of cases;
    recalibrate: one at the limit would look as large in at most 5 %; else it cannot be told.
    """
    beside = sideways_check(laser, path, steps, stored, rule, noise=noise)
    if beside.answer == "recalibrate":
        return beside
    held = Held(tilt_rad=HELD_TILT_RAD)
    both = estimate_tool(laser, path, steps, stored.T_flange_tool, noise=noise, held=held)
    return _compared(both, stored, rule, EVERY_WAY)


def sideways_check(
    laser: LaserFrame,
    path: FlangePath,
    steps: Sequence[BeamStep],
    stored: KnownTool,
    rule: CheckRule,
    *,
    noise: RobotNoise | None = None,
) -> QuickCheck:
    """What the circle alone tells: a tool that it finds far off need not plunge.

    A tip that is round is hit late beside its axis, so that sideways the circle alone counts.
    Arguments and errors as `quick_check`.
    """
    circles = [step for step in steps if step.kind == "circle"]
    held = Held(tilt_rad=HELD_TILT_RAD, along_m=HELD_ALONG_M)
    found = estimate_tool(laser, path, circles, stored.T_flange_tool, noise=noise, held=held)
    return _compared(found, stored, rule, SIDEWAYS)


SIDEWAYS, EVERY_WAY = np.diag([1.0, 1.0, 0.0]), np.eye(3)  # what a comparison looks at, tool axes


def _compared(found: ToolEstimate, stored: KnownTool, rule: CheckRule, ways: Array) -> QuickCheck:
    from scipy.special import ndtr

    R = stored.T_flange_tool[:3, :3]
    deviation = ways @ R.T @ (found.tip - stored.T_flange_tool[:3, 3])
    measured = replace(KnownTool.measured(found), against=stored.against)
    spread = spread_between(measured, stored)
    if spread is None:  # the stored tool counts as exact
        spread = found.covariance
    covariance = R.T @ spread[:3, :3] @ R
    size = float(np.linalg.norm(deviation))
    along = deviation / size if size > 0.0 else np.array([1.0, 0.0, 0.0])
    sigma = float(np.sqrt(along @ covariance @ along))
    # Noise across the deviation makes it look longer.
    across = max(float(np.trace(ways @ covariance @ ways)) - sigma**2, 0.0)
    likely = float(np.sqrt(max(size**2 - across, 0.0)))
    below = float(ndtr((likely - rule.limit_m) / sigma))
    reason = (
        f"the tip is {size * 1e3:.3f} mm from the stored one (sigma {sigma * 1e3:.3f} mm, allowed "
        f"{rule.limit_m * 1e3:.3f} mm)"
    )
    answer: Answer = "cannot tell"
    if below <= ERROR_CHANCE:
        answer = "pass"
        reason += f": a tool at the limit would look so in {below:.1%} of cases"
    elif 1.0 - below <= ERROR_CHANCE:
        answer = "recalibrate"
        reason += f": a tool at the limit would look so in {1.0 - below:.1%} of cases"
    else:
        reason += ": too near the limit for this noise; repeat the check, or measure the tool anew"
    return QuickCheck(
        answer=answer,
        reason=reason,
        deviation=deviation,
        covariance=covariance,
        deviation_m=size,
        sigma_m=sigma,
        tilt_rad=float(np.arctan2(np.hypot(*deviation[:2]), rule.lever_m)),
        measured=found,
    )


def tip_errors(
    arm: SerialArm,
    size_rad: float,
    now: tuple[Array, Array],
    before: tuple[Array, Array] | None,
    told: Array,
) -> JointErrors | None:
    """What the joints' errors add to a tip's change; None where the model in force holds them.

    A run holds the joints within some degrees, and its residuals tell nothing of what these share.
    It cancels in a change only as far as the bent tool is measured with the healthy one's joints.

    ``now``, ``before``: joints (n,) of a run, and the tip (3,) that it found, flange frame, m; None
    before where there was no healthy tool's run: then nothing cancels. ``told`` (3, 3): covariance
    of the tip as it is told, m^2.
    """
    runs = [now] if before is None else [now, before]
    errors = flange_errors(arm, size_rad, np.array([q for q, _ in runs]))
    if errors is None:
        return None
    moves = np.array([np.hstack([np.eye(3), -frames.skew(tip)]) for _, tip in runs])
    moves[1:] *= -1.0
    more = np.einsum("gka,gahb,hlb->kl", moves, errors, moves)
    return JointErrors.beside(size_rad, more, told)
