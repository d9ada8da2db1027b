"""How far a tool has moved, as plain documents (JSON), in the units people read."""

from typing import Any

import numpy as np

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.tool.judging import ToolChange
from robocal_ros.tool.quick_check import QuickCheck

Document = dict[str, Any]


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
