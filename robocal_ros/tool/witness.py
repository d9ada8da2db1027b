"""Is it the tool that changed, or the beam station that measures it?

A tool bends: what lies below the bend turns as one piece about it, so its tip moves by the tilt of
its axis times the lever from bend to tip, in the direction of the tilt. A station that was knocked
shifts and turns the measured tool as it likes; so does a tool that slipped in its mount.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.ground.errors import InputError

Array = NDArray[np.float64]
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

    Attributes
    ----------
    nearest_m : lever of a bend at or below the upper circle. What bends below it also looks as if
        it had this one: the axis is the line through both circles, and the tip lies on it.
    farthest_m : from the mount to the tip; nothing of the tool bends beyond.
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

    Attributes
    ----------
    tip_m : how far the tip seems to have moved.
    tilt_rad, tilt_sigma_rad : of the axis, and its standard deviation in one direction.
    lever_m : that explains shift and tilt best. It and the sigma are None where no noise is known.
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

    Parameters
    ----------
    change : (5,) of the tip along the tool's x, y, z, m, and of its axis along x and y, rad.
    covariance : (5, 5) of it.
    small_m : what the tip's change is since a tool whose cause was known; up to `SMALL_M` the tool
        may have it without proof: more harm it cannot do.

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
    lever_m, miss = _best_lever(d, t, covariance, rule)
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


def _best_lever(d: Array, t: Array, covariance: Array, rule: BendRule) -> tuple[float, float]:
    """The lever that explains shift (2,) and tilt (2,) best, and what is left, as chi-square."""
    levers = np.linspace(rule.nearest_m, rule.farthest_m, LEVERS)
    C_dd, C_dt, C_tt = covariance[:2, :2], covariance[:2, 3:], covariance[3:, 3:]
    L = levers[:, None, None]
    spread = C_dd - L * (C_dt + C_dt.T) + L**2 * C_tt
    off = d - levers[:, None] * t
    misses = np.einsum("ki,ki->k", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
    best = int(np.argmin(misses))
    return float(levers[best]), float(misses[best])
