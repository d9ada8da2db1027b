"""Joint targets that make a drifted robot, or a bent tool, reach the taught poses."""

from robocal_ros.core.joint_correction.correction import (
    CorrectionResult,
    JointCorrection,
    blend_models,
    pack_model,
)

__all__ = ["CorrectionResult", "JointCorrection", "blend_models", "pack_model"]
