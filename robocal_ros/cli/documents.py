# SPDX-License-Identifier: Apache-2.0
"""What the commands of this room print as JSON; see `robocal_ros.ground.documents`."""

from typing import Annotated, Any, Literal, NotRequired, TypedDict

from robocal_ros.ground.documents import (
    CodeName,
    Count,
    ErrorDocument,
    Four,
    Matrix,
    NotNegative,
    Numbers,
    Ordinal,
    PoseDocument,
    Positive,
    RobotDocument,
    Share,
    Texts,
    Three,
    VerdictDocument,
    keywords,
    printed,
    rules,
)
from robocal_ros.identification.documents import IdentificationDocument, Masses

REPLAY_FAILS = (
    "Where the samples were read but a reference or every identification failed, the document has "
    "error and verdict beside all the rest."
)
VALIDATE_FAILS = (
    "A bag that could not be validated has an error in its row; the document then has one too."
)


class JointValueDocument(TypedDict):
    name: str
    value: float
    unit: Literal["deg", "mm"]
    within_limits: bool


@printed("fk")
class FkDocument(RobotDocument):
    joints: Annotated[list[JointValueDocument], keywords(minItems=1)]
    T_base_flange: PoseDocument
    T_base_tool: NotRequired[Annotated[PoseDocument, "Only when the robot file has a tool."]]
    warnings: Texts


class FactDocument(TypedDict):
    name: str
    value: str


class BagTopicDocument(TypedDict):
    topic: str
    type: str
    messages: Count


@printed("info")
class InfoDocument(TypedDict):
    file: str
    kind: Annotated[str, "What it is, in words."]
    facts: list[FactDocument]
    topics: Annotated[list[BagTopicDocument], "Of a bag; empty for files."]
    commands: Annotated[Texts, "That take it; words in capitals are to be filled in."]


class DataSetDocument(TypedDict):
    name: str
    title: str
    holds: Texts
    licence: str
    source: Annotated[str, "Its repository."]
    commit: Annotated[str, "State of the repository that was used."]
    citation: str | None
    size: Annotated[str, "Of the files that are needed, in words."]
    found: Annotated[bool, "Whether it is in the folder."]
    get: Annotated[Texts, "Commands that get it."]
    commands: Annotated[Texts, "What can be done with it; OUT stands for a folder to write to."]


class ConvertedDocument(TypedDict):
    part: str
    holds: Annotated[str, "How much, in words."]
    files: Texts


@printed("data")
class DataDocument(TypedDict):
    folder: Annotated[str | None, "What ROBOCAL_DATA names; null where it is not set."]
    sets: Annotated[list[DataSetDocument], "All, or the one that was named."]
    written: Annotated[list[ConvertedDocument], "Parts that were converted."]


# "from" is a word of Python's.
JointRangeDocument = TypedDict(
    "JointRangeDocument",
    {
        "from": Annotated[float | None, "Where the function begins; null: there is none."],
        "to": float | None,
    },
)


class FunctionOfJointDocument(JointRangeDocument):
    name: str
    unit: Annotated[Literal["deg", "mm"], "Of from and to."]
    rms_urad: NotRequired[
        Annotated[
            NotNegative,
            "In between, in microradians; of a joint that slides `rms_um`, `largest_um`.",
        ]
    ]
    largest_urad: NotRequired[NotNegative]
    sigma_urad: NotRequired[
        Annotated[
            NotNegative | None,
            "Rms of its standard deviation; null: the file does not say what it was identified "
            "from.",
        ]
    ]
    sigma_um: NotRequired[NotNegative | None]
    rms_um: NotRequired[NotNegative]
    largest_um: NotRequired[NotNegative]
    compliance_micro: Annotated[
        NotNegative, "In microradians per newton metre (prismatic: micrometres per newton)."
    ]


class PredictedErrorDocument(TypedDict):
    poses: Ordinal
    rms_mm: NotNegative
    max_mm: NotNegative
    not_covered: Annotated[Share, "Share of the poses with a joint where it was not measured."]


@printed("joint-functions")
class FunctionsOfJointsDocument(RobotDocument):
    masses: Masses
    joints: Annotated[list[FunctionOfJointDocument], keywords(minItems=1)]
    predicted: Annotated[
        PredictedErrorDocument | None,
        "Error to expect of the target at the poses of --data, base and target placed there; "
        "null without them.",
    ]
    figures: Annotated[
        str | None,
        "The figure of the functions with their bands; null when none was asked for or their "
        "sigmas are not known.",
    ]
    output: Annotated[str | None, "The table that was written."]
    warnings: Texts


class HayatiRowDocument(TypedDict):
    name: str
    d_mm: float
    theta_deg: float
    a_mm: float
    alpha_deg: float
    beta_deg: float


class FromNominalDocument(TypedDict):
    """Distance of the flange from where the nominal model has it, over n random poses."""

    mean_mm: NotNegative
    max_mm: NotNegative
    n: Ordinal


@printed("import-ur")
class ImportUrDocument(RobotDocument):
    output: Annotated[str, "The robot file that was written."]
    joints: Annotated[list[HayatiRowDocument], keywords(minItems=6, maxItems=6)]
    from_nominal: FromNominalDocument
    conversion_error_mm: Annotated[
        NotNegative,
        "Largest distance of the flange from where the controller's own numbers have it, over "
        "the same poses.",
    ]


class ConvertedUrdfDocument(RobotDocument):
    base: Annotated[str, "Link that is the robot's base."]
    tip: Annotated[str, "Link that is its flange."]
    output: Annotated[str, "The file that was written."]
    conversion_error_mm: Annotated[
        NotNegative,
        "Largest difference of an element of the flange's pose, mm (of its turn: at a metre), "
        "over 1000 poses.",
    ]


@printed("import-urdf")
class ImportUrdfDocument(ConvertedUrdfDocument):
    joints: Annotated[list[HayatiRowDocument], keywords(minItems=1)]
    warnings: Texts


@printed("export-urdf")
class ExportUrdfDocument(ConvertedUrdfDocument):
    T_tip_flange: Annotated[
        PoseDocument, "What a kinematics.yaml has no place for; else no motion."
    ]
    warnings: Texts


@rules(additionalProperties=True)
class ReplayedCandidateDocument(IdentificationDocument):
    stamp: Annotated[float, "Time of the data, s."]
    stamp_ns: int
    cycle_id: str


class AcceptedDocument(TypedDict):
    stamp: float
    revision: Ordinal
    candidate: Annotated[
        Count | None, "Place in candidates, from 0; null: one from before the recording."
    ]
    by: str
    reason: str


class IdentifiedFromDocument(TypedDict):
    """What joint functions, compliances and geometry were identified from, but for what was
    measured: their covariance follows from it; m and rad, see docs/files.md.
    """

    q: Matrix
    target: list[Count]
    weight: Numbers
    p_flange: Matrix
    lever: NotNegative
    noise: Positive
    parameter_sigma: Numbers
    base_sigma: NotNegative
    target_sigma: NotNegative
    length: Numbers
    amplitude: Numbers


class JointFunctionsDocument(TypedDict):
    """B-splines and compliances of the joints; see docs/files.md."""

    first: Numbers
    step: Numbers
    coefficients: Matrix
    compliance: Numbers
    identified_from: NotRequired[IdentifiedFromDocument]


class LoadDocument(TypedDict):
    """What gravity pulls at, kg, m and m/s²; see docs/files.md."""

    mass: Numbers
    centre: Matrix
    payload_mass: NotNegative
    payload_centre: Three
    gravity: Three
    found: NotRequired[
        Annotated[bool, "No masses were known: those here are units of products, no kilograms."]
    ]


class FinalModelDocument(TypedDict):
    """The model in force at the end, in SI and full precision."""

    robot: str
    joint_names: Texts
    sign: list[Literal[1, -1]]
    prismatic: list[bool]
    mdh: Annotated[Matrix, "d, theta, a, alpha, beta of each joint, m and rad."]
    T_base_root: Matrix
    functions: NotRequired[JointFunctionsDocument]
    load: NotRequired[LoadDocument]
    revision: Annotated[Count, "0: the nominal model."]


class StreamDocument(TypedDict):
    rate_hz: NotNegative
    clock_ns: Annotated[int, "Its clock ahead of the joints'."]
    latency_s: Annotated[float | None, "null: too little motion shows it, or it is another."]
    latency_sigma_s: NotNegative | None
    burst: Annotated[Ordinal, "Most messages within 10 ms."]


class DamagedPartDocument(TypedDict):
    from_ns: int | None
    to_ns: int | None


class GapsDocument(TypedDict):
    """Pauses in the joint readings longer than the standstill check allows."""

    count: Count
    longest_s: NotNegative
    damaged: Annotated[
        list[DamagedPartDocument],
        "Damaged parts of the bag, left out: first and last log time; null: unknown.",
    ]


class CommandDocument(TypedDict):
    command: str
    stamp: float
    code: CodeName
    message: str
    samples: Count


class ReplayedBagDocument(RobotDocument):
    start_ns: Annotated[int, "Stamp of the first joint reading; windows count from it."]
    topics: Annotated[dict[str, str], "Topic of the bag for each input."]
    recorded: Annotated[
        bool, "Whether the recorded commands were obeyed (else: windows, or --auto)."
    ]
    ignored: Annotated[dict[str, Ordinal], "Messages of each topic that were not used."]
    ignored_reasons: dict[str, dict[str, Ordinal]]
    gaps: GapsDocument
    commands: Annotated[list[CommandDocument], "Everything that was carried out, in order."]
    differs: Annotated[Texts, "Recorded results that do not come out equal to the last bit."]
    warnings: Texts


@printed("replay", failing="beside")
@rules(additionalProperties=True, description=REPLAY_FAILS)
class ReplayDocument(ReplayedBagDocument):
    candidates: list[ReplayedCandidateDocument]
    accepted: list[AcceptedDocument]
    final_model: FinalModelDocument
    streams: NotRequired[
        Annotated[
            dict[str, StreamDocument],
            "How each stream of measurements stands to the joints' clock; of recordings without a "
            "node of ours.",
        ]
    ]


@rules(additionalProperties=True)
class ToolChangeDocument(TypedDict):
    """From the tool in force."""

    tip_mm: Any
    axis_deg: Any


@rules(additionalProperties=True)
class ReplayedRunDocument(TypedDict):
    stamp: Annotated[float, "Time of the data, s."]
    run: int
    answer: NotRequired[Literal["pass", "recalibrate", "cannot tell"]]
    tcp_mm: NotRequired[Three]
    change: ToolChangeDocument
    sigma_mm: Any
    misfit_mm: Any
    verdict: VerdictDocument


@rules(additionalProperties=True)
class FinalToolDocument(TypedDict):
    revision: int
    xyz_mm: Three
    quat_xyzw: Four


@printed("replay.tool", "robocal replay --json, of the bag of a tool node", "beside")
@rules(additionalProperties=True)
class ReplayToolDocument(ReplayedBagDocument):
    runs: Annotated[
        list[ReplayedRunDocument],
        "Runs that ended with a result: tools as in tool.crossed, quick checks with their answer.",
    ]
    final_tool: FinalToolDocument


@rules(additionalProperties=True)
class ReplayedSensorDocument(TypedDict):
    stamp: Annotated[float, "Time of the data, s."]
    kind: Literal["sphere", "step", "line", "tracker", "camera"]
    method: Literal["best", "classic"]
    working_error_mm: NotRequired[
        Annotated[
            float | None,
            "Error to expect of a point at the working distance, rms; null where not known.",
        ]
    ]
    rejected: Texts
    unobservable: Texts
    residual_mm: Any
    verdict: VerdictDocument


class FinalFrameDocument(TypedDict):
    xyz_mm: Three
    quat_xyzw: Four
    revision: int


@rules(additionalProperties=True)
class FinalSensorDocument(FinalFrameDocument):
    parent: str
    child: str


@printed("replay.hand_eye", "robocal replay --json, of the bag of a hand-eye node", "beside")
@rules(additionalProperties=True)
class ReplayHandEyeDocument(ReplayedBagDocument):
    calibrations: Annotated[
        list[ReplayedSensorDocument], "Candidates, as robocal hand-eye gives them."
    ]
    final_sensor: Annotated[
        FinalSensorDocument | None, "What is in force at the end; null when nothing is."
    ]


@rules(additionalProperties=True)
class ReplayedFixtureDocument(TypedDict):
    stamp: Annotated[float, "Time of the data, s."]
    frame: PoseDocument
    left_out_mm: Any
    moved: Any
    verdict: VerdictDocument


@rules(additionalProperties=True)
class FinalFixtureDocument(FinalFrameDocument):
    name: str


@printed("replay.fixture", "robocal replay --json, of the bag of a fixture node", "beside")
@rules(additionalProperties=True)
class ReplayFixtureDocument(ReplayedBagDocument):
    fixtures: Annotated[
        list[ReplayedFixtureDocument], "Frames that were found, as robocal fixture gives them."
    ]
    final_fixture: Annotated[
        FinalFixtureDocument | None, "What is in force at the end; null when nothing is."
    ]


class FailedBagDocument(TypedDict):
    bag: str
    kind: None
    error: ErrorDocument


class SkippedBagDocument(TypedDict):
    """A session that could not be replayed, and why."""

    bag: str
    kind: None
    node: Annotated[str, "Its session events."]
    skipped: str


@rules(additionalProperties=True)
class ValidatedSessionDocument(TypedDict):
    bag: str
    node: Annotated[str | None, "Its session events; null: no commands were recorded."]
    robot: str
    simulated: bool
    duration_s: NotNegative
    as_recorded: bool
    differs: Count
    decisions: Count
    refused: Count
    warnings: Count


@rules(additionalProperties=True)
class ValidatedThermalDocument(ValidatedSessionDocument):
    kind: Literal["thermal"]
    cycles: Count
    accepted: Count
    judged_by: Literal["truth", "measurements"]
    rms_without_mm: NotNegative | None
    rms_in_force_mm: NotNegative | None
    rms_after_mm: Annotated[NotNegative | None, "By the truth alone."]
    rms_candidate_mm: Annotated[
        NotNegative | None, "By measurements; of all candidates, those too that were refused."
    ]
    lambda_without: Share | None
    lambda_in_force: Share | None
    lambda_after: Share | None
    share_below_bound: Share | None


@rules(additionalProperties=True)
class ValidatedToolDocument(ValidatedSessionDocument):
    kind: Literal["tool"]
    runs: Count
    largest_change_mm: NotNegative | None
    largest_true_error_mm: NotNegative | None


@rules(additionalProperties=True)
class ValidatedHandEyeDocument(ValidatedSessionDocument):
    kind: Literal["hand_eye"]
    calibrations: Count
    residual_rms_mm: NotNegative | None
    predicted_rms_mm: NotNegative | None
    true_error_mm: NotNegative | None


ValidatedBagDocument = (
    FailedBagDocument
    | SkippedBagDocument
    | ValidatedThermalDocument
    | ValidatedToolDocument
    | ValidatedHandEyeDocument
)


@printed("validate", failing="in full")
@rules(additionalProperties=True, description=VALIDATE_FAILS)
class ValidateDocument(TypedDict):
    created: str
    software: str
    versions: dict[str, str]
    tolerance_mm: Positive
    report: str
    bags: Annotated[list[ValidatedBagDocument], keywords(minItems=1)]


class WarmStepDocument(TypedDict):
    name: Annotated[str, "What the kernels are for."]
    compiled: Annotated[Count, "How many were compiled; the others were loaded."]
    seconds: NotNegative


@printed("warm")
class WarmDocument(TypedDict):
    steps: list[WarmStepDocument]
    compiled: Annotated[Count, "Sum of those of all steps."]
    warnings: Texts


@printed("plc", "robocal plc certificates|user --json")
class PlcAccessDocument(TypedDict):
    output: Annotated[str, "File that was written."]
    application_uri: Annotated[str, "Of the server, as its certificate has it."]
    valid_until: Annotated[
        str, keywords(pattern="^\\d{4}-\\d\\d-\\d\\d$"), "The server's certificate; YYYY-MM-DD."
    ]
    users: Annotated[dict[str, Literal["operator", "engineer"]], "Role of each user."]
    trusted: Annotated[Texts, "Files of clients' certificates that are trusted."]
