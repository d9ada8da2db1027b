# SPDX-License-Identifier: Apache-2.0
"""What JSON documents are made of: the parts that those of several commands share.

Each room declares in its own ``documents.py`` what its commands print with ``--json``, as
TypedDicts: mypy holds what writes a document against them, and ``tools/schemas.py`` makes the JSON
schemas of ``docs/schemas`` from them. In ``Annotated`` a string is a field's description,
`keywords` are those of JSON Schema. A name says its unit, SI without one. An object has no other
fields than those declared, unless its `rules` say so.

Programs import these files for their types alone: nothing here is loaded when a command starts.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal, NotRequired, TypedDict, TypeVar

C = TypeVar("C")
Failing = Literal["alone", "beside", "in full"]

PRINTED: dict[str, tuple[str, Failing, list[Any]]] = {}
"""By name of a schema: its title, where a failure stands, and the documents it may be."""
RULES: dict[Any, dict[str, Any]] = {}
"""Keywords of JSON Schema beyond what types say, by document."""


def printed(name: str, title: str = "", failing: Failing = "alone") -> Callable[[C], C]:
    """Declare what a command prints: the schema ``name``; its default title is the command.

    ``failing``: error and verdict stand ``alone``, in place of the document; or ``beside`` what
    there is of its fields; or beside all of them, ``in full``.
    """

    def declare(document: C) -> C:
        told = title or f"robocal {name.replace('.', ' ')} --json"
        PRINTED.setdefault(name, (told, failing, []))[2].append(document)
        return document

    return declare


def rules(**keywords: Any) -> Callable[[C], C]:
    """Add keywords of JSON Schema to an object."""

    def declare(document: C) -> C:
        RULES[document] = keywords
        return document

    return declare


def keywords(**values: Any) -> tuple[tuple[str, Any], ...]:
    """Keywords of JSON Schema of a field's type, as `Annotated` can hold them."""
    return tuple(values.items())


Texts = list[str]
Numbers = list[float]
Matrix = list[list[float]]
Two = Annotated[list[float], keywords(minItems=2, maxItems=2)]
Three = Annotated[list[float], keywords(minItems=3, maxItems=3)]
Four = Annotated[list[float], keywords(minItems=4, maxItems=4)]
ThreeRows = Annotated[list[Three], keywords(minItems=3, maxItems=3)]
NotNegative = Annotated[float, keywords(minimum=0)]
Positive = Annotated[float, keywords(exclusiveMinimum=0)]
Share = Annotated[float, keywords(minimum=0, maximum=1)]
Count = Annotated[int, keywords(minimum=0)]
Ordinal = Annotated[int, keywords(minimum=1)]
Words = Annotated[str, keywords(minLength=1)]
Names = Annotated[list[Words], keywords(uniqueItems=True)]
TwoSigmas = Annotated[list[NotNegative], keywords(minItems=2, maxItems=2)]
ThreeSigmas = Annotated[list[NotNegative], keywords(minItems=3, maxItems=3)]
ModelHash = Annotated[str, keywords(pattern="^[0-9a-f]{16}$")]
CodeName = Annotated[
    str, keywords(pattern="^[A-Z][A-Z_]+$"), "See docs/codes.md; later versions may add names."
]


@rules(
    **{
        "if": {"properties": {"accept": {"const": True}}},
        "then": {"properties": {"code": {"const": "ACCEPT"}}},
        "else": {"properties": {"code": {"not": {"const": "ACCEPT"}}}},
    }
)
class VerdictDocument(TypedDict):
    accept: bool
    code: CodeName
    reason: Words


@rules(additionalProperties=True)
class ErrorDocument(TypedDict):
    """What was wrong; file, row (the header is row 1) and column where they are known."""

    code: CodeName
    message: Words
    file: str | None
    row: Ordinal | None
    column: str | None


@printed("error", "What every command prints with --json when it ends with status 1, 2 or 3")
@rules(additionalProperties=True)
class FailureDocument(TypedDict):
    error: ErrorDocument
    verdict: Annotated[VerdictDocument, keywords(properties={"accept": {"const": False}})]
    unobservable: NotRequired[
        Annotated[Texts, "With RANK_DEFICIENT: what the data leave undetermined."]
    ]


@printed("information", "What every command prints with --json beside --help or --version")
@rules(minProperties=1, maxProperties=1)
class InformationDocument(TypedDict):
    help: NotRequired[Annotated[Words, "The text that --help alone prints."]]
    version: NotRequired[Annotated[str, keywords(pattern="^robocal [0-9]+\\.[0-9]+\\.[0-9]+$")]]


class RobotDocument(TypedDict):
    """Whose document it is."""

    robot: str
    model_hash: Annotated[ModelHash, "Identity of the nominal model."]


class PoseDocument(TypedDict):
    xyz_mm: Three
    quat_xyzw: Four


class ErrorsDocument(TypedDict):
    """Distances between predicted and measured points that were not used to solve."""

    mean_mm: NotNegative
    rms_mm: NotNegative
    p95_mm: NotNegative
    max_mm: NotNegative
    n: Ordinal


class JointErrorsDocument(TypedDict):
    """What joints that err add to what was found, where the model does not hold it."""

    size_urad: Annotated[NotNegative, "Of a joint, rms: as given, or less where less is seen."]
    sigma_mm: Annotated[ThreeSigmas, "What they add to a place, along the axes of its covariance."]
    factor: Annotated[NotNegative, "How many of the sigmas that are told it is off with them."]


class JudgedErrorsDocument(TypedDict):
    held_out: Annotated[ErrorsDocument, "Of every held-out row."]
    held_out_robust: NotRequired[
        Annotated[ErrorsDocument, "Without the rows of held_out_rejected."]
    ]


class PredictedErrorsDocument(TypedDict):
    """Errors to expect from the covariance: of the model at the held-out poses, the same with
    measurement noise (compare it with held_out.rms_mm), and of the model throughout the joint
    limits.
    """

    model_rms_mm: NotNegative
    total_rms_mm: NotNegative
    workspace_rms_mm: NotNegative


class CalibratedErrorsDocument(JudgedErrorsDocument):
    predicted: PredictedErrorsDocument


class JudgementDocument(TypedDict):
    """A model as identified, beside the one in force and the nominal one."""

    nominal: JudgedErrorsDocument
    in_force: Annotated[
        JudgedErrorsDocument,
        "The model that the new one must beat; for `robocal identify` the nominal one, with --keep "
        "that of the history.",
    ]
    calibrated: CalibratedErrorsDocument
