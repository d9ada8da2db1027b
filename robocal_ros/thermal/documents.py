# SPDX-License-Identifier: Apache-2.0
"""What robocal thermal and correct-points print as JSON; see `robocal_ros.ground.documents`."""

from typing import Annotated, Literal, TypedDict

from robocal_ros.ground.documents import (
    ErrorsDocument,
    Matrix,
    NotNegative,
    Ordinal,
    PoseDocument,
    RobotDocument,
    Share,
    Texts,
    Three,
    VerdictDocument,
    keywords,
    printed,
    rules,
)
from robocal_ros.identification.documents import (
    IdentificationDocument,
    JudgedModelDocument,
    PlannedPoseDocument,
)


class SensorDataDocument(TypedDict):
    file: str


class PlacedSensorDocument(RobotDocument):
    method: Literal["ml", "classic"]
    T_sensor_base: Annotated[PoseDocument, "The robot's base in the sensor's frame."]
    sphere_in_flange_mm: Three
    covariance_of: Annotated[
        list[str],
        keywords(minItems=9, maxItems=9),
        "What the rows of the covariance are, in SI: shift of the base and turn about it "
        "(sensor axes), sphere (flange axes).",
    ]
    covariance: Annotated[
        Matrix | None, "In m and rad; null for the classic method, which has no noise model."
    ]
    sigma: Annotated[
        dict[str, NotNegative] | None, "Standard deviations, in the unit of each name."
    ]
    residual: ErrorsDocument
    left_out: Annotated[ErrorsDocument | None, "Each pose predicted from the others."]
    samples: Ordinal
    rejected: Texts
    verdict: VerdictDocument


@printed("thermal.sensor", "robocal thermal calibrate-sensor --json")
class SensorDocument(PlacedSensorDocument):
    data: SensorDataDocument
    output: Annotated[
        str | None,
        "The sensor file that was written; null when none was asked for or the verdict refuses.",
    ]
    warnings: Texts


class SphereCentreDocument(TypedDict):
    xyz_mm: Three


class FlangeSensorDataDocument(TypedDict):
    sessions: Texts
    check: str | None


@printed("thermal.identify")
class FlangeSensorDocument(JudgedModelDocument):
    """Of a sensor on the flange."""

    arrangement: Literal["flange-sensor"]
    T_flange_sensor: PoseDocument
    spheres: Annotated[
        dict[str, SphereCentreDocument],
        "Centres in base; <name>@<session> where there are several sessions.",
    ]
    data: FlangeSensorDataDocument
    warnings: Texts


@rules(additionalProperties=True)
class ThermalCycleDocument(IdentificationDocument):
    """One cycle's drift; the nominal figures are those of the cold model."""

    cycle: str
    cold_visits: Ordinal


class FixedSensorDataDocument(TypedDict):
    sensor: str
    cold: str
    warm: str
    check: str | None
    prior: str | None


@printed("thermal.identify")
@rules(additionalProperties=True)
class FixedSensorDocument(ThermalCycleDocument):
    arrangement: Literal["fixed-sensor"]
    cycles: Annotated[
        list[ThermalCycleDocument],
        keywords(minItems=1),
        "Every cycle of the warm table in order; the document itself is the last one's.",
    ]
    cold_rejected: Annotated[Texts, "Cold samples that other visits of the same pose contradict."]
    data: FixedSensorDataDocument
    warnings: Texts


@printed("thermal.prior", "robocal thermal learn-prior --json")
class PriorDocument(RobotDocument):
    parameters: Texts
    covariance: Annotated[Matrix, "Of the parameters' drift since the cold visit, in m and rad."]
    sigma: Annotated[dict[str, NotNegative], "In the unit of each name."]
    cycles: Ordinal
    output: str | None
    warnings: Texts


class ScreenRoundDocument(TypedDict):
    parameters: Ordinal
    names: Texts
    share: Annotated[Share | None, "Null where the poses do not determine the parameters left."]
    stationary: Texts
    removed: Annotated[str | None, "Null in the last round."]
    note: str


class BestSubsetDocument(TypedDict):
    names: Texts
    cp: float
    share: Share | None


@printed("thermal.screen")
class ScreenDocument(RobotDocument):
    removal: Literal["best", "classic"]
    stationarity: Annotated[
        Literal["autocorrelation", "ljung-box"], "The test by which a series is stationary."
    ]
    threshold_mm: NotNegative
    cycles: Ordinal
    uncompensated: Annotated[
        Share, "Share of directions within the threshold without any correction."
    ]
    rounds: Annotated[list[ScreenRoundDocument], keywords(minItems=1)]
    chosen: Texts
    highest: Annotated[Texts, "The set of the highest share."]
    best_subset: Annotated[
        BestSubsetDocument | None, "Mallows' C_p; null where it was not asked for."
    ]
    plot: str | None
    warnings: Texts


@printed("thermal.plan", "robocal thermal plan-poses --json")
class ThermalPlanDocument(RobotDocument):
    columns: Annotated[Texts, "Names of the joints' columns, with their units."]
    poses: Annotated[
        list[PlannedPoseDocument], keywords(minItems=1), "In the order of the shortest way."
    ]
    predicted_mm: Annotated[
        NotNegative, "Rms error of the tool at the working poses after one cycle."
    ]
    random_mm: Annotated[NotNegative, "The same of as many random candidates, median of 50 draws."]
    before_mm: Annotated[NotNegative, "The same without any cycle."]
    gain: Annotated[float, "Share by which the plan is better than random poses."]
    working_poses: Ordinal
    candidates: Ordinal
    own_mm: Annotated[NotNegative | None, "The same of your own poses; null where none were given."]
    own_poses: int | None
    output: str | None
    warnings: Texts


class CorrectedPointDocument(TypedDict):
    sample: str
    xyz_mm: Three


@printed("correct-points")
class CorrectedPointsDocument(RobotDocument):
    T_flange_sensor: PoseDocument
    points: Annotated[
        list[CorrectedPointDocument],
        keywords(minItems=1),
        "In base, in the order of the table or recording.",
    ]
    not_placed: Annotated[Texts, "Of a bag: what has no joints at its stamp, and why."]
    output: Annotated[str | None, "The table that was written; null where none was."]
    warnings: Texts
