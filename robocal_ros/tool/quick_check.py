"""Has the tool moved since it was measured? One circle and one plunge against the stored frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.tool.crossed_model import BeamStep, CircleFit, Held, RobotNoise
from robocal_ros.tool.crossed_run import DEFAULT_NOISE, ToolEstimate, estimate_tool
from robocal_ros.tool.flange_path import FlangePath, first_rotation
from robocal_ros.tool.judging import KnownTool, ToolChange, spread_between
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.touch_points import TouchFit

Array = NDArray[np.float64]
Answer = Literal["pass", "recalibrate", "cannot tell"]

ERROR_CHANCE = 0.05  # of a pass, or a recalibration, that is wrong
HELD_TILT_RAD = 1e-3  # one circle does not see the tilt: near the stored one
HELD_ALONG_M = 5e-3  # nor how far the tip reaches


@dataclass(frozen=True)
class CheckRule:
    """What a tool may move.

    Attributes
    ----------
    limit_m : largest deviation of the tip.
    lever_m : from where a bent tool bends to its tip; a tool bends at its mount.
    """

    limit_m: float = 2e-4
    lever_m: float = 0.15


@dataclass(frozen=True, eq=False)
class QuickCheck:
    """The answer.

    Attributes
    ----------
    deviation : (3,) of the tip from the stored one, tool axes, m; ``covariance`` (3, 3) of it.
        Along the axis 0 where the tip is too far off sideways for the plunge to tell.
    deviation_m, sigma_m : length of it, and the standard deviation along it.
    tilt_rad : the tilt that moves the tip sideways by as much, if the tool bent at its mount; one
        circle cannot tell a tilt from a shift.
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
    noise: RobotNoise = DEFAULT_NOISE,
) -> QuickCheck:
    """Compare one circle and one plunge with the stored tool, as these same beams measure it.

    Pass: a deviation at the limit would look as small as this in at most 5 % of cases;
    recalibrate: one at the limit would look as large in at most 5 %; else it cannot be told.

    Raises
    ------
    BeamError, RankDeficientError, ResidualError
        As `estimate_tool`: edges that are missing or make no sense also ask for a full run.
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
    noise: RobotNoise = DEFAULT_NOISE,
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


def _compared(
    found: ToolEstimate,
    stored: KnownTool,
    rule: CheckRule,
    ways: Array,
) -> QuickCheck:
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
    answer, reason = _answer(size, likely, sigma, rule)
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


def _answer(size: float, likely: float, sigma: float, rule: CheckRule) -> tuple[Answer, str]:
    from scipy.special import ndtr

    below = float(ndtr((likely - rule.limit_m) / sigma))
    what = (
        f"the tip is {size * 1e3:.3f} mm from the stored one (sigma {sigma * 1e3:.3f} mm, allowed "
        f"{rule.limit_m * 1e3:.3f} mm)"
    )
    if below <= ERROR_CHANCE:
        return "pass", f"{what}: a tool at the limit would look so in {below:.1%} of cases"
    if 1.0 - below <= ERROR_CHANCE:
        return (
            "recalibrate",
            f"{what}: a tool at the limit would look so in {1.0 - below:.1%} of cases",
        )
    return (
        "cannot tell",
        f"{what}: too near the limit for this noise; repeat the check, or measure the tool anew",
    )


# ---- measured tools and beams as plain documents (JSON), in the units people read ---------------


Document = dict[str, Any]

COVARIANCE_UNITS = ("m", "m", "m", "rad", "rad")


def laser_document(laser: LaserFrame) -> Document:
    """Where two beams cross: origin, gap and angle; ``axes`` has x, y, z as rows, base."""
    T_base_laser = laser.T_base_laser
    return {
        "origin_mm": (T_base_laser[:3, 3] * 1e3).tolist(),
        "gap_mm": laser.gap_m * 1e3,
        "axes": T_base_laser[:3, :3].T.tolist(),
        "beam_angle_deg": float(np.degrees(laser.beam_angle_rad)),
    }


def circle_document(fit: CircleFit) -> Document:
    """The tool's axis on one circle; what the method does not tell is null."""
    sigma = None if fit.covariance is None else np.sqrt(np.diag(fit.covariance)) * 1e3
    rho = None if fit.rho is None else dict(zip("xy", (fit.rho * 1e3).tolist(), strict=True))
    words = f"the axis is at ({fit.centre[0] * 1e3:.3f}, {fit.centre[1] * 1e3:.3f}) mm"
    if sigma is not None:
        words += f", known to {float(sigma.max()):.4f} mm; edges within {fit.misfit_m * 1e3:.4f} mm"
    return {
        "method": fit.method,
        "center_mm": (fit.centre * 1e3).tolist(),
        "sigma_mm": None if sigma is None else sigma.tolist(),
        "tool_radius_mm": rho,
        "latency_s": fit.latency_s,
        "misfit_mm": None if sigma is None else fit.misfit_m * 1e3,
        "verdict": verdict_document(Verdict(Code.ACCEPT, words)),
    }


def run_document(
    found: KnownTool, estimate: ToolEstimate, circles: Sequence[str], verdict: Verdict
) -> Document:
    """A tool ``found`` by a whole run; ``circles``: names in the order of their radii.

    ``covariance`` (5, 5), SI: of the tip along the flange's x, y, z and of the axis' tilt along the
    tool's x and y; ``sigma_mm`` and ``sigma_deg`` are the roots of its diagonal.
    """
    covariance = estimate.covariance if found.covariance is None else found.covariance
    sigma = np.sqrt(np.diag(covariance))
    radii = zip(circles, (estimate.radius * 1e3).tolist(), strict=True)
    return {
        "method": "best",
        **_tool_part(found.T_flange_tool),
        "covariance": covariance.tolist(),
        "covariance_units": list(COVARIANCE_UNITS),
        "sigma_mm": (sigma[:3] * 1e3).tolist(),
        "sigma_deg": np.degrees(sigma[3:]).tolist(),
        "tool_radius_mm": [{"circle": name, "x": x, "y": y} for name, (x, y) in radii],
        "latency_s": estimate.latency_s,
        "latency_sigma_s": estimate.latency_sigma_s,
        "misfit_mm": estimate.misfit_m * 1e3,
        "shift_mm": estimate.shift_m * 1e3,
        "verdict": verdict_document(verdict),
    }


def classic_run_document(T_flange_tool: Array) -> Document:
    """A tool by the classic method; what it does not tell is null."""
    words = "mid-times: no covariance, and biased for a thick tool; compare with method best"
    unknown = (
        *("covariance", "covariance_units", "sigma_mm", "sigma_deg", "tool_radius_mm"),
        *("latency_s", "latency_sigma_s", "misfit_mm", "shift_mm"),
    )
    return {
        "method": "classic",
        **_tool_part(T_flange_tool),
        **dict.fromkeys(unknown),
        "verdict": verdict_document(Verdict(Code.ACCEPT, words)),
    }


def parallel_document(axis: Array, tip: Array | None) -> Document:
    """A tool by parallel beams: turned from the flange's by the smallest angle; SI in, mm out."""
    words = "the straightened tool stands upright" if tip is not None else "the axis alone"
    T = frames.transform(first_rotation(axis), np.zeros(3) if tip is None else tip)
    return _tool_part(T) | {
        "tcp_mm": None if tip is None else (tip * 1e3).tolist(),
        "verdict": verdict_document(Verdict(Code.ACCEPT, words)),
    }


def _tool_part(T_flange_tool: Array) -> Document:
    return {
        "tcp_mm": (T_flange_tool[:3, 3] * 1e3).tolist(),
        "quat_xyzw": frames.quat_xyzw(T_flange_tool).tolist(),
        "axis": T_flange_tool[:3, 2].tolist(),
    }


def touch_document(fit: TouchFit) -> Document:
    """A touched tool; without an orientation its quaternion is null."""
    far = np.linalg.norm(fit.residual, axis=1)
    turn = None if fit.rotation is None else frames.transform(fit.rotation, np.zeros(3))
    return {
        "tcp_mm": (fit.tip * 1e3).tolist(),
        "quat_xyzw": None if turn is None else frames.quat_xyzw(turn).tolist(),
        "sigma_mm": (np.sqrt(np.diag(fit.covariance)) * 1e3).tolist(),
        "point_mm": (fit.point * 1e3).tolist(),
        "residual_mm": {"rms": fit.rms_m * 1e3, "max": float(far.max()) * 1e3},
        "touches": len(far),
        "verdict": verdict_document(fit.verdict),
    }


# ---- how far a tool has moved, as plain documents (JSON), in the units people read --------------


def change_document(change: ToolChange) -> Document:
    """How far a tool has moved."""
    return {"tip_mm": change.tip_m * 1e3, "axis_deg": float(np.degrees(change.axis_rad))}


def check_document(check: QuickCheck, verdict: Verdict) -> Document:
    """The answer of a quick check; ``deviation_mm`` along the tool's axes."""
    tilt_deg = float(np.degrees(check.tilt_rad))
    return {
        "answer": check.answer,
        "deviation_mm": (check.deviation * 1e3).tolist(),
        "change": {"tip_mm": check.deviation_m * 1e3, "axis_deg": tilt_deg},
        "sigma_mm": check.sigma_m * 1e3,
        "misfit_mm": check.measured.misfit_m * 1e3,
        "verdict": verdict_document(verdict),
    }
