# SPDX-License-Identifier: Apache-2.0
"""What robocal identify and iso9283 print as JSON; see `robocal_ros.ground.documents`."""

from typing import Annotated, Literal, NotRequired, TypedDict

from robocal_ros.ground.documents import (
    CodeName,
    Count,
    ErrorsDocument,
    JudgementDocument,
    NotNegative,
    Numbers,
    Ordinal,
    PoseDocument,
    RobotDocument,
    Share,
    Texts,
    Three,
    Two,
    VerdictDocument,
    keywords,
    printed,
    rules,
)

FittedParts = Annotated[list[Literal["base", "tool", "geometry"]], keywords(uniqueItems=True)]
ParameterName = Annotated[str, keywords(pattern="^(d|a)[0-9]+_mm$|^(theta|alpha|beta)[0-9]+_deg$")]

BOUND_SIGMAS = (
    "95 % of position errors at other poses stay within so many of their sigmas, covariance and "
    "noise together; 2.80 where errors are normal and their size is well known."
)

Masses = Annotated[
    Literal["given", "found"] | None,
    "What compliances count with: masses of the robot file, or where it has none one at the flange "
    "with which they were found; null where there are no compliances.",
]


class PlannedPoseDocument(TypedDict):
    pose: str
    joints: Numbers


@printed("identify")
class PosePlanDocument(RobotDocument):
    """Of --plan: poses to measure."""

    columns: Texts
    plan: Annotated[
        list[PlannedPoseDocument],
        "In the order of their worth: the first k are the plan of k poses.",
    ]
    predicted_mm: Annotated[Numbers, "Error of the full model to expect after each of them, rms."]
    random_mm: Annotated[NotNegative, "After as many random ones."]
    candidates: Ordinal
    output: str | None
    warnings: Texts


class JointFunctionDocument(TypedDict):
    rms_urad: NotRequired[float]
    sigma_urad: NotRequired[float]
    length_deg: NotRequired[float]
    rms_um: NotRequired[float]
    sigma_um: NotRequired[float]
    length_mm: NotRequired[float]


class IdentifiedJointDocument(TypedDict):
    """A joint: from where to where it was measured, its function and its compliance."""

    name: str
    measured_deg: NotRequired[Two]
    measured_mm: NotRequired[Two]
    gaps_deg: NotRequired[
        Annotated[list[Two], "In between, where its function was not measured; of a full model."]
    ]
    gaps_mm: NotRequired[list[Two]]
    check_outside: Annotated[
        Share, "Share of the check poses that have this joint where it was not measured."
    ]
    function: Annotated[
        JointFunctionDocument | None,
        "Null where the data want none: rms and standard deviation over the measured range, "
        "and the length over which it changes.",
    ]
    compliance: Annotated[NotNegative, "rad/(N m), of a joint that slides m/N."]


class CoveredDocument(TypedDict):
    """Errors at a part of the held-out rows, and the code for it; null where there is none."""

    code: CodeName
    in_force: ErrorsDocument
    calibrated: ErrorsDocument


class CoverageDocument(TypedDict):
    """Check poses with all joints where they were measured, with the code of the verdict, and
    the others, for which the model is not accepted.
    """

    covered: CoveredDocument | None
    not_covered: CoveredDocument | None


class ParameterDocument(TypedDict):
    nominal: float
    value: float
    sigma: Annotated[NotNegative | None, "Standard deviation; null where the parameter was held."]


class JudgedModelDocument(RobotDocument, JudgementDocument):
    method: Literal["map", "lsq", "subset"]
    parameters: Annotated[
        dict[ParameterName, ParameterDocument],
        "Every free parameter of the model, in the unit of its name.",
    ]
    noise_mm: Annotated[
        NotNegative, "Standard deviation of one measured coordinate, as given or as found."
    ]
    samples: Ordinal
    rank: Count
    unknowns: Count
    condition: Annotated[
        Annotated[float, keywords(minimum=1)] | None,
        "Of the scaled problem without its unobservable directions; null where the data "
        "determine nothing.",
    ]
    unobservable: Annotated[Texts, "Directions, in words, that the data do not determine."]
    held: Annotated[
        Texts, "Parameters kept at their nominal value because others have the same effect."
    ]
    rejected: Annotated[Texts, "Ids of the samples that were not used."]
    held_out_rejected: Annotated[
        Texts,
        "Ids of the samples that do not decide because no model fits them; held_out counts them.",
    ]
    converged: bool
    verdict: VerdictDocument


class CellDocument(TypedDict):
    T_frame_base: PoseDocument
    T_flange_target: dict[str, PoseDocument]


class PlacedModelDocument(JudgedModelDocument, CellDocument):
    """Where a robot stands by its model, and what was measured on it."""


@rules(additionalProperties=True)
class IdentificationDocument(PlacedModelDocument):
    """Of a cycle, or as kept in the history: of the full model alone what is not required."""

    model: NotRequired[
        Annotated[
            Literal["full", "geometric"],
            "What was found: full with joint functions or compliances, geometric where the data "
            "want none.",
        ]
    ]
    masses: NotRequired[Masses]
    joints: NotRequired[list[IdentifiedJointDocument]]
    check_outside: NotRequired[
        Annotated[Share, "Share of the check poses that have a joint where it was not measured."]
    ]
    coverage: NotRequired[CoverageDocument]
    noise_over_sigma: NotRequired[
        Annotated[
            NotNegative,
            "What the residuals are, beside the stated sigma_mm; 1 where none was stated.",
        ]
    ]
    bound_sigmas: NotRequired[Annotated[NotNegative, BOUND_SIGMAS]]


class IdentifiedDataDocument(TypedDict):
    """What was used: files, parts fitted, and how the poses were split."""

    file: str
    check_file: str | None
    fit: FittedParts
    check_refit: FittedParts
    model: Annotated[Literal["full", "geometric"], "What was asked for."]
    hold_out: Annotated[float, keywords(exclusiveMinimum=0, exclusiveMaximum=1)] | None
    seed: int | None
    train: Ordinal
    check: Ordinal


@printed("identify")
class IdentifiedDocument(PlacedModelDocument):
    data: IdentifiedDataDocument
    warnings: Texts
    figures: Annotated[
        str | None,
        "The figure of the joints' functions, or where there are none that of the errors; null "
        "when none was asked for.",
    ]
    calibration_id: Annotated[
        int | None, "The candidate's number in the history; null without --keep."
    ]
    output: Annotated[
        str | None,
        "The robot file that was written; null when none was asked for or the verdict refuses.",
    ]
    model: Annotated[
        Literal["full", "geometric"],
        "What was found: full with joint functions or compliances, geometric where the data "
        "want none.",
    ]
    masses: Masses
    joints: list[IdentifiedJointDocument]
    check_outside: Annotated[
        Share, "Share of the check poses that have a joint where it was not measured."
    ]
    coverage: CoverageDocument
    noise_over_sigma: Annotated[
        NotNegative, "What the residuals are, beside the stated sigma_mm; 1 where none was stated."
    ]
    bound_sigmas: Annotated[NotNegative, BOUND_SIGMAS]


class PoseAccuracyDocument(TypedDict):
    n: Annotated[int, keywords(minimum=2)]
    AP_mm: Annotated[NotNegative | None, "Distance of the barycentre from the commanded position."]
    RP_mm: NotNegative
    mean_distance_mm: NotNegative
    S_mm: NotNegative
    barycentre_mm: Three
    AP_x_mm: float | None
    AP_y_mm: float | None
    AP_z_mm: float | None


@printed("iso9283")
class Iso9283Document(TypedDict):
    targets: Annotated[dict[str, PoseAccuracyDocument], keywords(minProperties=1)]
    warnings: Texts
