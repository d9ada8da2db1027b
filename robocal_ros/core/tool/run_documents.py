"""Whole runs through the beams as plain documents (JSON), in the units people read."""

from typing import Any

import numpy as np

from robocal_ros.core import frames
from robocal_ros.core.assessment import Verdict
from robocal_ros.core.documents import verdict_document
from robocal_ros.core.tool.crossed_run import ToolEstimate
from robocal_ros.core.tool.judging import KnownTool, ToolChange
from robocal_ros.core.tool.quick_check import QuickCheck

Document = dict[str, Any]


def tool_document(found: KnownTool, estimate: ToolEstimate, verdict: Verdict) -> Document:
    """A measured tool.

    ``covariance`` (5, 5), SI: of the tip along the flange's x, y, z and of the axis' tilt along the
    tool's x and y; ``sigma_mm`` and ``sigma_deg`` are the roots of its diagonal.
    """
    T = found.T_flange_tool
    covariance = estimate.covariance if found.covariance is None else found.covariance
    sigma, radii = np.sqrt(np.diag(covariance)), (estimate.radius * 1e3).tolist()
    return {
        "tcp_mm": (T[:3, 3] * 1e3).tolist(),
        "quat_xyzw": frames.quat_xyzw(T).tolist(),
        "axis": T[:3, 2].tolist(),
        "covariance": covariance.tolist(),
        "sigma_mm": (sigma[:3] * 1e3).tolist(),
        "sigma_deg": np.degrees(sigma[3:]).tolist(),
        "tool_radius_mm": [dict(zip("xy", radius, strict=True)) for radius in radii],
        "latency_s": estimate.latency_s,
        "latency_sigma_s": estimate.latency_sigma_s,
        "misfit_mm": estimate.misfit_m * 1e3,
        "shift_mm": estimate.shift_m * 1e3,
        "verdict": verdict_document(verdict),
    }


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
