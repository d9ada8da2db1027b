# SPDX-License-Identifier: Apache-2.0
"""What robocal tool prints as JSON; see `robocal_ros.ground.documents`."""

from typing import Annotated, Literal, TypedDict

from robocal_ros.ground.documents import (
    Four,
    JointErrorsDocument,
    NotNegative,
    Ordinal,
    PoseDocument,
    RobotDocument,
    Texts,
    Three,
    ThreeRows,
    ThreeSigmas,
    Two,
    TwoSigmas,
    VerdictDocument,
    Words,
    keywords,
    printed,
)

Five = Annotated[list[float], keywords(minItems=5, maxItems=5)]
FiveRows = Annotated[list[Five], keywords(minItems=5, maxItems=5)]
FiveUnits = Annotated[Texts, keywords(const=("m", "m", "m", "rad", "rad"))]


class ReachDocument(TypedDict):
    x: float
    y: float


class LaserDocument(TypedDict):
    """Where two crossed beams are, in base."""

    origin_mm: Three
    gap_mm: Annotated[float, "Height of the y-beam above the x-beam."]
    axes: Annotated[ThreeRows, "Rows x, y, z in base."]
    beam_angle_deg: Annotated[float, keywords(exclusiveMinimum=0, exclusiveMaximum=180)]


@printed("tool.beams")
class BeamsDocument(LaserDocument):
    reach_mm: Annotated[
        ReachDocument | None,
        "How far from its middle each beam is broken; null without --radius-mm.",
    ]
    output: Annotated[str | None, "The laser file that was written."]


class StationShiftDocument(TypedDict):
    shift_mm: Three
    shift_sigma_mm: Three
    turn_deg: Three
    turn_sigma_deg: Three
    moved: Annotated[bool, "By more than both measurements explain."]


class StationMeasuredDocument(StationShiftDocument):
    stamp_ns: int
    calibration: Ordinal


class StationTrendDocument(TypedDict):
    per_day_mm: Three | None
    sigma_mm: Three | None
    days: float


@printed("tool.station")
class StationDocument(RobotDocument, LaserDocument):
    station: str
    first_stamp_ns: int
    measured: Annotated[
        list[StationMeasuredDocument],
        "Since the first measurement with this mandrel and laser file, in the station's axes then.",
    ]
    trend: StationTrendDocument
    output: Annotated[str | None, "The laser file that was written; null where none was."]
    warnings: Texts


class SeenRadiusDocument(TypedDict):
    x: NotNegative
    y: NotNegative


@printed("tool.crossed")
class CircleDocument(TypedDict):
    """One circle."""

    method: Literal["best", "classic"]
    center_mm: Annotated[
        Two, "The tool's axis in the laser frame when the flange is at the circle's centre."
    ]
    sigma_mm: Two | None
    tool_radius_mm: SeenRadiusDocument | None
    latency_s: float
    misfit_mm: Annotated[NotNegative | None, "Null for classic, which has none."]
    verdict: VerdictDocument


class CircleRadiusDocument(TypedDict):
    circle: str
    x: float
    y: float


class ToolFrameDocument(TypedDict):
    tcp_mm: Annotated[Three, "The tip in the flange frame."]
    quat_xyzw: Annotated[
        Four, "The tool in the flange frame; its z is the axis, its turn about it as taught."
    ]
    axis: Annotated[Three, "Unit vector from flange to tip, flange frame."]


class FoundToolDocument(ToolFrameDocument):
    method: Literal["best", "classic"]
    covariance: Annotated[
        FiveRows | None,
        "Of the tip along the flange's x, y, z and of the axis' tilt along the tool's x and y.",
    ]
    covariance_units: Annotated[
        FiveUnits | None,
        "A cell of the covariance has the product of its row's and its column's unit.",
    ]
    sigma_mm: ThreeSigmas | None
    sigma_deg: TwoSigmas | None
    tool_radius_mm: Annotated[list[CircleRadiusDocument] | None, "As each circle and beam sees it."]
    latency_s: float | None
    latency_sigma_s: NotNegative | None
    misfit_mm: NotNegative | None
    shift_mm: Annotated[NotNegative | None, "Largest shift of a step against the others."]
    verdict: VerdictDocument


@printed("tool.crossed")
class ToolRunDocument(FoundToolDocument):
    """A whole run."""

    joint_errors: Annotated[
        JointErrorsDocument | None,
        "null: the robot file has joint functions, --joint-error-urad 0, or method classic.",
    ]
    figures: Annotated[str | None, "The figure; null without --figures."]
    warnings: Texts


class TouchResidualDocument(TypedDict):
    rms: NotNegative
    max: NotNegative


class TouchedToolDocument(TypedDict):
    tcp_mm: Three
    quat_xyzw: Four | None
    sigma_mm: Three
    point_mm: Three
    residual_mm: TouchResidualDocument
    touches: Annotated[int, keywords(minimum=4)]
    verdict: VerdictDocument


@printed("tool.points")
class TouchesDocument(TouchedToolDocument):
    method: Literal["four", "seven"]
    figures: Annotated[str | None, "The figure; null without --figures."]


@printed("tool.parallel")
class ParallelBeamsDocument(TypedDict):
    tcp_mm: Annotated[
        Three | None,
        "The tip in the flange frame; null without sweeps of the upright tool and a plunge.",
    ]
    quat_xyzw: Annotated[
        Four, "The tool in the flange frame, turned from it by the smallest angle."
    ]
    axis: Annotated[Three, "Unit vector from flange to tip, flange frame."]
    verdict: VerdictDocument


@printed("tool.export")
class ExportedToolDocument(TypedDict):
    format: Literal["urdf", "kuka", "abb", "fanuc", "ur", "kawasaki"]
    text: Words
    T_flange_tool: PoseDocument
