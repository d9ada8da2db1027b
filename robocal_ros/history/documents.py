# SPDX-License-Identifier: Apache-2.0
"""What robocal history prints as JSON; see `robocal_ros.ground.documents`."""

from typing import Annotated, Any, Literal, TypedDict

from robocal_ros.ground.documents import (
    CodeName,
    Count,
    NotNegative,
    Ordinal,
    Texts,
    VerdictDocument,
    Words,
    keywords,
    printed,
)


class HistoryFileDocument(TypedDict):
    serial: Annotated[Words, "Robot serial."]
    file: Annotated[str, "The history file."]
    damaged: Annotated[
        str | None,
        "The newest damaged file that was set aside and that nobody has acknowledged, else null.",
    ]


class InForceDocument(TypedDict):
    kind: str
    revision: Ordinal
    calibration_id: Annotated[Ordinal | None, "null = the nominal model."]


class DecisionDocument(TypedDict):
    seq: Ordinal
    kind: str
    action: Literal["accept", "reject", "rollback"]
    calibration_id: Annotated[
        Ordinal | None, "Accepted, rejected or returned to; null = the nominal model."
    ]
    by: str
    reason: str
    wall_ns: Annotated[int, "Nanoseconds since 1970, UTC."]
    head_before: Annotated[Count, "Revision in force before."]
    head_after: Annotated[Count, "Revision in force after; the same for a rejection."]


class CalibrationDocument(TypedDict):
    id: Ordinal
    revision: Annotated[Count, "As which it was accepted; 0 = never."]
    kind: Annotated[str, "Which model it changes; each kind has its own revisions."]
    state: Annotated[
        Literal["pending", "stale", "refused", "rejected", "in_force", "superseded", "rolled_back"],
        "See docs/history.md.",
    ]
    code: Annotated[CodeName, "Its verdict."]
    reason: Annotated[str, "The verdict in words."]
    candidate_rms_mm: Annotated[
        NotNegative | None, "Held-out rms error; null when it was not judged."
    ]
    model_hash: Annotated[str, "Hash of the nominal model that it corrects."]
    based_on: Annotated[Count, "Revision in force when it was solved; 0 = nominal."]
    cycle_id: str
    stamp_ns: Annotated[int, "Time of the data, nanoseconds."]
    created_ns: Annotated[int, "Wall clock when it was proposed, nanoseconds since 1970, UTC."]
    software: Annotated[str, "Version that made it."]
    method: str
    decisions: Annotated[
        list[DecisionDocument],
        "Those that rejected it or brought it into or out of force, oldest first.",
    ]


@printed("history.list")
class HistoryListDocument(HistoryFileDocument):
    in_force: Annotated[list[InForceDocument], "One for each kind that ever had a revision."]
    calibrations: Annotated[list[CalibrationDocument], "Newest first."]


class InputArrayDocument(TypedDict):
    dtype: str
    shape: list[Count]


@printed("history.show")
class HistoryShowDocument(HistoryFileDocument):
    calibration: CalibrationDocument
    document: Annotated[
        dict[str, Any], "As the identification gave it; for a thermal model see identify.json."
    ]
    model: Annotated[dict[str, Any], "The model in full precision."]
    inputs: Annotated[dict[str, InputArrayDocument], "Arrays that it was solved from."]


class CorrectionDocument(TypedDict):
    wall_ns: Annotated[int, "From when on, ns since 1970, UTC."]
    software: Annotated[str, "Version of this software."]
    model_hash: Annotated[str, "Of the nominal model."]
    enabled: Annotated[bool, "Whether the correction was asked for."]
    shadow: Annotated[bool, "Whether it was only shown."]
    model_revision: Annotated[Count, "0 = none."]
    tool_revision: Annotated[Count, "0 = the taught tool."]
    reference: Annotated[Literal["nominal", "calibrated"], "Which model the program was made with."]
    reference_source: Annotated[str, "Robot type, or path of a robot file."]
    reference_name: Annotated[str, "Name of that model."]
    reference_hash: Annotated[str, "Hash of that model."]
    taught_tool: Annotated[
        list[float], keywords(minItems=7, maxItems=7), "x, y, z in m, qx, qy, qz, qw."
    ]


@printed("history.corrections")
class HistoryCorrectionsDocument(HistoryFileDocument):
    corrections: Annotated[list[CorrectionDocument], "Newest first."]


@printed("history.acknowledge")
class HistoryAcknowledgeDocument(HistoryFileDocument):
    acknowledged: Annotated[Texts, "Damaged files that were acknowledged now."]
    by: Annotated[str, "Who knows of them."]


@printed("history.decision", "robocal history accept, reject and rollback --json")
class HistoryDecisionDocument(HistoryFileDocument):
    action: Literal["accept", "reject", "rollback"]
    kind: str
    calibration_id: Annotated[
        Ordinal | None, "Accepted, rejected or returned to; null = the nominal model."
    ]
    revision: Annotated[Count, "In force now."]
    by: str
    reason: str
    verdict: Annotated[VerdictDocument, "accept: what was asked was done."]
