"""Has the beam station moved? What it measures of something that cannot bend says so.

A mandrel on the flange, or the stem of a ball there, is measured as a tool is, once when the cell
is commissioned and again in doubt, with the flange turned the same way. The robot's absolute error
is in both and cancels; its drift is taken out by the thermal model through which each was measured.
What is left is the station's.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.ground.errors import Code
from robocal_ros.tool.judging import KnownTool, change_between, difference
from robocal_ros.tool.witness import SMALL_M, Witness

Array = NDArray[np.float64]

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
