# SPDX-License-Identifier: Apache-2.0
"""What robocal hand-eye prints as JSON; see `robocal_ros.ground.documents`."""

from typing import Annotated, Literal, NotRequired, TypedDict

from robocal_ros.ground.documents import (
    Count,
    ErrorsDocument,
    JointErrorsDocument,
    Matrix,
    Names,
    NotNegative,
    Numbers,
    Ordinal,
    PoseDocument,
    Positive,
    Texts,
    Three,
    ThreeSigmas,
    Two,
    VerdictDocument,
    Words,
    keywords,
    printed,
    rules,
)

# In hand, or beside the robot.
EITHER_SENSOR = [{"required": ["T_flange_sensor"]}, {"required": ["T_base_sensor"]}]


class ResidualsDocument(TypedDict):
    rms: NotNegative
    max: NotNegative
    per_sample: dict[str, NotNegative]


class HeldOutDocument(ErrorsDocument):
    """Distances of shots that were not used to solve, and which of them show nothing."""

    rejected: Names
    rejected_because: dict[str, Words]


class MountSigmaDocument(TypedDict):
    xyz_mm: ThreeSigmas
    rot_deg: ThreeSigmas


class SphereFoundDocument(TypedDict):
    center_mm: Three
    radius_mm: NotNegative


class StepFoundDocument(TypedDict):
    T_base_user: PoseDocument


class LineInBaseDocument(TypedDict):
    point_mm: Three
    direction: Three


class LineFoundDocument(TypedDict):
    line: LineInBaseDocument
    known: bool


class LeaveOneOutDocument(TypedDict):
    mean: NotNegative
    rms: NotNegative
    p95: NotNegative
    max: NotNegative


class LinearityDocument(TypedDict):
    """Of the sensor, where it was found and taken out of the profiles."""

    degree: NotNegative
    rms_um: Annotated[NotNegative, "Of its form as the profiles alone show it, without the scale."]
    max_um: Annotated[NotNegative, "The largest of that form."]
    residual_um: NotNegative
    left_out_um: NotNegative
    coefficients_um: Annotated[
        Numbers, "As mount and profiles together have them; the last, a scale of z, is the mount's."
    ]
    low_mm: Two
    high_mm: Two


class UsedLinearityDocument(LinearityDocument):
    """Of the sensor, and the error to expect of a point without it."""

    working_error_mm: NotNegative


class HandEyeResultDocument(TypedDict):
    """Of every sensor; covariances in SI, of its origin and turn, along the flange's axes."""

    method: Literal["best", "classic"]
    sigma: MountSigmaDocument | None
    covariance: Matrix | None
    pivot_mm: Three
    covariance_at_pivot: Matrix | None
    residual_mm: ResidualsDocument
    leave_one_out_mm: LeaveOneOutDocument | None
    working_error_mm: NotNegative | None
    rejected: Names
    rejected_because: dict[str, Words]
    unobservable: Names
    joint_errors: NotRequired[
        Annotated[
            JointErrorsDocument | None,
            "Of method best; null: the poses' joints are not known, or change, as in a stream; or "
            "the robot file or the model in force has joint functions.",
        ]
    ]
    figures: NotRequired[Annotated[str, "The figure, with --figures."]]
    verdict: VerdictDocument


class MountDocument(HandEyeResultDocument):
    """Where a line laser sits; see docs/hand_eye.md."""

    T_flange_sensor: PoseDocument
    residual_deg: None
    robot_sigma_mm: NotRequired[NotNegative]
    working_distance_mm: NotRequired[float]
    spread: NotRequired[ErrorsDocument]
    linearity: NotRequired[UsedLinearityDocument]
    held_out: Annotated[HeldOutDocument | None, "Of --check."]


@printed("hand-eye.sphere")
class SphereMountDocument(MountDocument):
    kind: Literal["sphere"]
    target: SphereFoundDocument
    point_residual_mm: NotRequired[
        Annotated[NotNegative, "Of all profile points on the sphere from it, rms."]
    ]


@printed("hand-eye.step")
class StepMountDocument(MountDocument):
    kind: Literal["step"]
    target: StepFoundDocument
    aim_sigma_mm: NotRequired[Annotated[NotNegative, "How well the light was laid on the marks."]]


@printed("hand-eye.line")
class LineMountDocument(MountDocument):
    kind: Literal["line"]
    target: LineFoundDocument


@rules(minProperties=2)
class JointTargetsDocument(TypedDict):
    sphere: NotRequired[SphereFoundDocument]
    step: NotRequired[StepFoundDocument]
    line: NotRequired[LineFoundDocument]


@printed("hand-eye.joint")
class JointMountDocument(MountDocument):
    kind: Literal["joint"]
    target: JointTargetsDocument
    point_residual_mm: NotRequired[NotNegative]
    aim_sigma_mm: NotRequired[NotNegative]


class CameraTargetDocument(TypedDict):
    T_base_board: NotRequired[PoseDocument]
    T_flange_board: NotRequired[PoseDocument]
    distance_mm: NotNegative


class CameraNoiseDocument(TypedDict):
    """Standard deviations an axis; see docs/hand_eye_camera.md."""

    position_mm: NotNegative
    robot_turn_deg: NotNegative
    camera_tilt_deg: NotNegative | None
    camera_roll_deg: NotNegative | None
    camera_depth_mm: NotNegative | None
    camera_scale: Annotated[float, keywords(minimum=1)] | None
    estimated: bool


class ClosedFormsDocument(TypedDict):
    """Mean residual of each, at the samples used; null where it failed."""

    tsai: NotNegative | None
    park: NotNegative | None
    horaud: NotNegative | None
    andreff: NotNegative | None
    daniilidis: NotNegative | None
    shah: NotNegative | None
    li: NotNegative | None


class IntrinsicsDocument(TypedDict):
    from_images: bool
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"]
    distortion: Numbers
    width_px: Ordinal
    height_px: Ordinal
    sigma: Annotated[
        list[NotNegative] | None,
        "Of fx, fy, cx, cy and the distortion; null where they were given.",
    ]
    noise_px: NotNegative


@printed("hand-eye.camera")
@rules(oneOf=EITHER_SENSOR)
class CameraDocument(HandEyeResultDocument):
    kind: Literal["camera"]
    T_flange_sensor: NotRequired[PoseDocument]
    T_base_sensor: NotRequired[PoseDocument]
    target: CameraTargetDocument
    residual_deg: ResidualsDocument
    mount: Literal["in-hand", "to-hand"]
    noise: CameraNoiseDocument
    start: Annotated[
        Literal["best", "tsai", "park", "horaud", "andreff", "daniilidis", "shah", "li"],
        "Where the search began, or the closed form that was taken.",
    ]
    closed_forms_mean_mm: ClosedFormsDocument
    held_out: HeldOutDocument | None
    time_offset_s: NotRequired[float]
    time_offset_sigma_s: NotRequired[NotNegative]
    intrinsics: NotRequired[IntrinsicsDocument]


class TrackerTargetDocument(TypedDict):
    center_tracker_mm: Three
    face_angle_deg: float
    sphere_height_mm: Two


class AxesOffNominalDocument(TypedDict):
    """Angle and gap of the axes of both arcs, real minus nominal. Method best alone."""

    angle_deg: float
    gap_mm: float


@printed("hand-eye.tracker")
class TrackerDocument(HandEyeResultDocument):
    kind: Literal["tracker"]
    T_flange_sensor: PoseDocument
    target: TrackerTargetDocument
    residual_deg: None
    held_out: NotRequired[None]
    reflector_flange_mm: Three
    mismatch_mm: Annotated[
        NotNegative, "By how much tracker and sensor disagree about the target's shape."
    ]
    residual_over_noise: NotRequired[
        Annotated[
            NotNegative,
            "Root mean square of the residuals over their noise; about 1. Method best alone.",
        ]
    ]
    widened_by: NotRequired[
        Annotated[
            NotNegative,
            "Factor on the standard deviations where the residuals are clearly larger than the "
            "noise explains; else 1. Method best alone.",
        ]
    ]
    axes_off_nominal: NotRequired[AxesOffNominalDocument]


class TouchedPointDocument(TypedDict):
    point: str
    scans: Ordinal
    xyz_mm: Three
    three_sigma_mm: Annotated[
        float | None, "Along the worst axis of the base; null of fewer than three poses."
    ]
    off_mm: Annotated[float | None, "Of the mean from where it was touched."]


class TouchedPointsDocument(TypedDict):
    points: Annotated[list[TouchedPointDocument], keywords(minItems=1)]
    accuracy_mm: Annotated[ErrorsDocument | None, "Scans of touched points from there."]
    three_sigma_mm: Annotated[float | None, "The largest."]


class TouchedResultDocument(TouchedPointsDocument):
    result: str
    shots: Annotated[int | None, "From which it was found, where it says so."]
    verdict: VerdictDocument


@printed("hand-eye.verify")
class TouchTestDocument(TypedDict):
    kind: Literal["point"]
    results: Annotated[
        list[TouchedResultDocument], keywords(minItems=1), "Of each result, in the order given."
    ]
    verdict: VerdictDocument


@printed("hand-eye.verify")
class VerifiedDocument(TypedDict):
    kind: Literal["sphere", "step", "line"]
    T_flange_sensor: PoseDocument
    target: Annotated[
        SphereFoundDocument | StepFoundDocument | LineFoundDocument,
        "Found from these shots with the sensor held.",
    ]
    held_out: HeldOutDocument
    per_sample_mm: dict[str, NotNegative]
    verdict: VerdictDocument


@printed("hand-eye.check-plan")
class CheckedPlanDocument(TypedDict):
    rank: Count
    unknowns: Annotated[int, keywords(minimum=6)]
    unobservable: list[Words]
    sigma: Annotated[MountSigmaDocument | None, "To expect, along the sensor's axes."]
    working_error_mm: NotNegative | None
    unseen: Annotated[dict[str, Words], "Poses that do not see the target, and why."]
    proposed: Annotated[list[PoseDocument], "Flange poses to add, the best one first."]
    proposed_marks: Annotated[
        Texts | None, "Of stairs: the mark on which each proposed pose lays the light."
    ]
    proposed_error_mm: Annotated[
        NotNegative | None, "To expect with all of them added; null where none is needed."
    ]
    verdict: VerdictDocument


@printed("hand-eye.export")
@rules(oneOf=EITHER_SENSOR)
class ExportedSensorDocument(TypedDict):
    format: Literal["urdf", "xacro", "yaml", "static-transform"]
    parent: Words
    child: Words
    text: Words
    T_flange_sensor: NotRequired[PoseDocument]
    T_base_sensor: NotRequired[PoseDocument]
