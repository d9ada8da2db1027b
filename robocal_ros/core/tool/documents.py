"""Measured tools and beams as plain documents (JSON), in the units people read."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.assessment import Verdict
from robocal_ros.core.codes import Code
from robocal_ros.core.documents import verdict_document
from robocal_ros.core.tool.crossed_beams import CircleFit
from robocal_ros.core.tool.laser_frame import LaserFrame
from robocal_ros.core.tool.touch_points import TouchFit

Array = NDArray[np.float64]
Document = dict[str, Any]


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
        "misfit_mm": fit.misfit_m * 1e3,
        "verdict": verdict_document(Verdict(Code.ACCEPT, words)),
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
