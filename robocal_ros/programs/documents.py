# SPDX-License-Identifier: Apache-2.0
"""What correct-program and frame-shift print as JSON; see `robocal_ros.ground.documents`."""

from typing import Annotated, Literal, TypedDict

from robocal_ros.ground.documents import (
    Count,
    NotNegative,
    Numbers,
    Ordinal,
    PoseDocument,
    RobotDocument,
    Share,
    Texts,
    VerdictDocument,
    Words,
    keywords,
    printed,
)
from robocal_ros.programs.conventions import Maker
from robocal_ros.programs.correcting import State


class ProgramPointDocument(TypedDict):
    name: str
    line: Ordinal
    by: Literal["pose", "joints"]
    state: State
    reason: Annotated[str, "Why it was not corrected; else empty."]
    shift_mm: Annotated[NotNegative, "How far the tool was moved in the program."]
    shift_deg: NotNegative
    left_mm: Annotated[
        NotNegative | None,
        "By how much the robot as identified misses the place with what is written; null "
        "where the point's joints are not known.",
    ]
    left_deg: NotNegative | None
    joints: Annotated[
        Numbers | None, "Taught joints, rad (prismatic: m); null where they are not known."
    ]


class PointCountsDocument(TypedDict):
    corrected: Count
    unchanged: Count
    not_corrected: Count
    of_another_group: Annotated[
        Count, "FANUC: of another motion group alone; nothing of these is to be corrected."
    ]


class ComputedPointDocument(TypedDict):
    line: Ordinal
    text: str


class ProgramReportDocument(TypedDict):
    points: Annotated[list[ProgramPointDocument], keywords(minItems=1), "In the order of the text."]
    count: PointCountsDocument
    computed: Annotated[
        list[ComputedPointDocument], "Places where the program makes a point itself."
    ]
    warnings: Texts


@printed("correct-program")
class CorrectedProgramDocument(RobotDocument, ProgramReportDocument):
    program: str
    module: Annotated[
        str | None, "KUKA: the module's other file, read with it; null where none was."
    ]
    maker: Maker
    output: Annotated[str | None, "The program that was written; null where none was."]
    verdict: VerdictDocument


class ShiftErrorsDocument(TypedDict):
    rms_mm: NotNegative
    max_mm: NotNegative
    share_within_limit: Annotated[Share, "Of the coordinates of all errors."]


class PoseErrorDocument(TypedDict):
    mm: NotNegative
    deg: NotNegative


class ShiftedPoseDocument(TypedDict):
    name: str
    before: PoseErrorDocument
    after: PoseErrorDocument


class ShiftInForceDocument(ShiftErrorsDocument):
    revision: Ordinal


class ShiftedFramesDocument(TypedDict):
    T_base_shift: Annotated[PoseDocument, "Goes before every base frame."]
    T_tool_shift: Annotated[PoseDocument, "Goes behind every tool."]


class ShiftDocument(ShiftedFramesDocument):
    before: ShiftErrorsDocument
    after: ShiftErrorsDocument
    poses: Annotated[list[ShiftedPoseDocument], keywords(minItems=1)]


@printed("frame-shift")
class FrameShiftDocument(RobotDocument, ShiftedFramesDocument):
    before: Annotated[
        ShiftErrorsDocument | None,
        "Null where no shift is in force and no poses were given to judge the frames at.",
    ]
    after: ShiftErrorsDocument | None
    poses: list[ShiftedPoseDocument]
    maker: Annotated[Maker | None, "Null where none was named, to tell what is in force."]
    text: Annotated[
        Words | None, "The frames that serve, for the controller; null without a maker."
    ]
    output: Annotated[str | None, "The file that was written."]
    warnings: Texts
    verdict: VerdictDocument
    in_force: Annotated[
        ShiftInForceDocument | None,
        "The shift in force in the history, judged with the present model; null where the "
        "frames are as they were.",
    ]
    calibration_id: Annotated[Ordinal | None, "Its number in the history, where it was kept."]
