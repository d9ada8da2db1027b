"""Has the tool moved since it was measured? One circle and one plunge against the stored frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.tool.crossed_model import BeamStep, Held, RobotNoise
from robocal_ros.tool.crossed_run import DEFAULT_NOISE, ToolEstimate, estimate_tool
from robocal_ros.tool.flange_path import FlangePath
from robocal_ros.tool.judging import KnownTool, spread_between
from robocal_ros.tool.laser_frame import LaserFrame

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
