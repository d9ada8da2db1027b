"""Measured tools and beams as plain documents (JSON), in the units people read."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.tool.crossed_beams import CircleFit
from robocal_ros.tool.crossed_run import ToolEstimate
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.tool_axis import first_rotation
from robocal_ros.tool.touch_points import TouchFit

Array = NDArray[np.float64]
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
