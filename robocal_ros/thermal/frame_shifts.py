# SPDX-License-Identifier: Apache-2.0
"""The shift of base and tool frame as a calibration: judged, kept, and what is in force of it."""

from dataclasses import dataclass

import numpy as np

from robocal_ros import __version__
from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground.errors import Code
from robocal_ros.ground.frames import Array, Document, transform_document
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import FRAME_SHIFT, THERMAL, Proposal
from robocal_ros.kinematics import SerialArm
from robocal_ros.programs.correcting import CorrectionModels
from robocal_ros.programs.frame_shift import FrameShift, given_shift

WORTH_IT = 0.9  # of the error: less of a gain is not worth a change of the controller's frames


@dataclass(frozen=True, eq=False)
class FrameShiftInForce:
    """A shift of the history, judged with the present model."""

    revision: int
    shift: FrameShift


def shift_in_force(
    history: CalibrationHistory, models: CorrectionModels, q: Array, T_flange_tool: Array
) -> FrameShiftInForce | None:
    """The shift in force at working poses q (m, n); None where the frames are as they were."""
    head = history.head(FRAME_SHIFT)
    if head.calibration_id is None:
        return None
    kept = history.model(head.calibration_id)
    T_base, T_tool = (np.array(kept[name]) for name in ("T_base_shift", "T_tool_shift"))
    return FrameShiftInForce(head.revision, given_shift(models, q, T_flange_tool, T_base, T_tool))


def shift_document(shift: FrameShift, names: tuple[str, ...], limit_mm: float) -> Document:
    """A shift, and its errors, of each pose by its name; ``limit_mm``: for the shares."""
    poses = zip(names, _sizes(shift.before), _sizes(shift.after), strict=True)
    return {
        "T_base_shift": transform_document(shift.T_base_shift),
        "T_tool_shift": transform_document(shift.T_tool_shift),
        "before": errors_of(shift.before, limit_mm),
        "after": errors_of(shift.after, limit_mm),
        "poses": [{"name": name, "before": one, "after": other} for name, one, other in poses],
    }


def shift_verdict(document: Document, only_judged: bool) -> Verdict:
    """Whether the shift is worth entering: against what is in force, else the frames as given."""
    was, now = document["in_force"], document["after"]["rms_mm"]
    with_what = "without a shift" if was is None else f"with that of revision {was['revision']}"
    rms = (document["before"] if was is None else was)["rms_mm"]
    if only_judged:
        gone = now <= document["before"]["rms_mm"]
        code = Code.ACCEPT if gone else Code.WORSE_THAN_CURRENT
        return Verdict(
            code, f"{document['before']['rms_mm']:.3f} mm rms are {now:.3f} mm {with_what}"
        )
    words = f"{rms:.3f} mm rms {with_what} become {now:.3f} mm"
    if now <= WORTH_IT * rms:
        return Verdict(Code.ACCEPT, words)
    hint = "correct the program instead" if was is None else "the frames in force still serve"
    return Verdict(Code.NO_SIGNIFICANT_GAIN, f"{words}: {hint}")


def keep_shift(
    history: CalibrationHistory,
    nominal: SerialArm,
    shift: FrameShift,
    q: Array,
    document: Document,
    verdict: Verdict,
    wall_ns: int,
) -> int:
    """Put a shift for the thermal model in force into the history; its number there."""
    return history.propose(
        Proposal(
            kind=FRAME_SHIFT,
            model_hash=nominal.model_hash,
            based_on=history.head(FRAME_SHIFT).revision,
            cycle_id="",
            stamp_ns=wall_ns,
            created_ns=wall_ns,
            software=__version__,
            method="frame-shift",
            code=verdict.code,
            reason=verdict.reason,
            candidate_rms_mm=document["after"]["rms_mm"],
            document=document,
            model={
                "T_base_shift": shift.T_base_shift.tolist(),
                "T_tool_shift": shift.T_tool_shift.tolist(),
                "thermal_revision": history.head(THERMAL).revision,
            },
            inputs={"q": q},
        )
    )


def _sizes(twist: Array) -> list[Document]:
    return [
        {"mm": 1e3 * float(np.linalg.norm(e[:3])), "deg": float(np.degrees(np.linalg.norm(e[3:])))}
        for e in twist
    ]


def errors_of(twist: Array, limit_mm: float) -> Document:
    """Of twists (m, 6) from where the tool stands to where it should; the share is of axes."""
    mm = 1e3 * np.linalg.norm(twist[:, :3], axis=1)
    share = float(np.mean(1e3 * np.abs(twist[:, :3]) <= limit_mm))
    rms = float(np.sqrt(np.mean(mm**2)))
    return {"rms_mm": rms, "max_mm": float(np.max(mm)), "share_within_limit": share}
