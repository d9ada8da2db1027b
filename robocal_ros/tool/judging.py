"""Is a measured tool good, in mm? Against the tool in force, within what may change.

A mandrel on the flange, or the stem of a ball there, is measured as a tool is, once when the cell
is commissioned and again in doubt, with the flange turned the same way. The robot's absolute error
is in both and cancels; its drift is taken out by the thermal model through which each was measured.
What is left is the station's.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.tool.crossed_run import ToolEstimate
from robocal_ros.tool.flange_path import minimal_rotation
from robocal_ros.tool.witness import SMALL_M, BendRule, Witness, bend_or_station

Array = NDArray[np.float64]
Document = dict[str, Any]

HEALTHY_M, HEALTHY_RAD = 3e-3, float(np.radians(1.5))  # of a measured healthy tool from the taught
UNCHANGED = 0.95  # a difference below this quantile of its noise is none


@dataclass(frozen=True)
class ToolLimits:
    """What a tool measurement may say without being doubted.

    Attributes
    ----------
    sigma_m : largest standard deviation of the tip in any direction.
    change_m, tilt_rad : largest change from the taught tool: what the joint correction makes up
        for, so that no tool is proposed that it would not take over.
    """

    sigma_m: float = 2e-4
    change_m: float = 1e-2
    tilt_rad: float = float(np.radians(4.0))


@dataclass(frozen=True, eq=False)
class KnownTool:
    """A tool as it is kept.

    Attributes
    ----------
    T_flange_tool : (4, 4) pose in the flange frame.
    covariance : (5, 5) as of a `ToolEstimate`; None: not measured.
    own_covariance : (5, 5) what of it is its own run's alone; None: not known.
    against : (4, 4) the healthy tool as measured, where this tool is the change against it.
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


def judge_healthy(found: KnownTool, estimate: ToolEstimate, taught: Array) -> Verdict:
    """Whether a tool measures as a healthy one does: known well, and near the taught one.

    Between them lie the robot's absolute error and the laser frame's, no bump.
    """
    run = judge_run(estimate, ToolLimits())
    off = change_between(taught, found.T_flange_tool)
    what = (
        f"the taught tool measures {off.tip_m * 1e3:.3f} mm and {np.degrees(off.axis_rad):.3f} deg "
        f"off; {run.reason}"
    )
    if not run.accept:
        return Verdict(run.code, what)
    if off.tip_m > HEALTHY_M or off.axis_rad > HEALTHY_RAD:
        return Verdict(
            Code.LIMIT_EXCEEDED,
            f"{what}; allowed {HEALTHY_M * 1e3:.0f} mm and {np.degrees(HEALTHY_RAD):.0f} deg: is "
            "the tool bent, or taught wrongly?",
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
            f"{words} (allowed sigma {limits.sigma_m * 1e3:.1f} mm): read the beams faster, or "
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
            f"taught tool (allowed {limits.change_m * 1e3:.0f} mm, "
            f"{np.degrees(limits.tilt_rad):.0f} deg): straighten or change the tool",
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


# ---- has the beam station moved? What it measures of something that cannot bend says so ---------


MOVED = 0.99  # of a station that stands one in a hundred seems to have moved
LOOSE = 0.999  # and a mandrel that is sound to have tilted one in a thousand


@dataclass(frozen=True, eq=False)
class StationFinding:
    """What a mandrel says of the station.

    Attributes
    ----------
    shift : (3,) of the beams' crossing since the commissioning, base, m; ``covariance`` (3, 3).
    verdict : ACCEPT: it stands. STATION_MOVED: it does not. TOO_FEW_SAMPLES: cannot be told.
        WRONG_TOOL: the mandrel itself has tilted, which no knock of the station makes of it.
    """

    shift: Array
    covariance: Array
    tip_m: float
    axis_rad: float
    verdict: Verdict

    def document(self) -> dict[str, Any]:
        """In the units people read."""
        return {
            "station_shift_mm": (self.shift * 1e3).tolist(),
            "sigma_mm": (np.sqrt(np.diag(self.covariance)) * 1e3).tolist(),
            "change": {"tip_mm": self.tip_m * 1e3, "axis_deg": float(np.degrees(self.axis_rad))},
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
    return StationFinding(shift, covariance, change.tip_m, change.axis_rad, verdict)


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
