"""What a calibration is on its way from proposal to force: records that never change.

Sessions make proposals, the history keeps them, nodes and commands show them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from robocal_ros.ground.errors import Code, StaleError

if TYPE_CHECKING:  # the history is listed without loading NumPy
    from numpy.typing import NDArray

THERMAL = "thermal"
TOOL = "tool"
REFERENCE = "reference"  # the cold reference
HEALTHY_TOOL = "tool_reference"  # how the taught tool measures while it is right
MANDREL = "mandrel_reference"  # how the mandrel measures while the beam station stands right
HAND_EYE = "hand_eye"  # where a sensor sits; see `hand_eye_kind`
# What is in force before anything was accepted; of other kinds nothing.
BEFORE_ANY = {THERMAL: "the nominal model", TOOL: "the taught tool"}


def hand_eye_kind(sensor_frame: str) -> str:
    """Each sensor is calibrated on its own: the kind names its frame."""
    return f"{HAND_EYE}/{sensor_frame}"


class Action(StrEnum):
    """A decision about a calibration."""

    ACCEPT = "accept"
    REJECT = "reject"
    ROLLBACK = "rollback"


class CalibrationState(StrEnum):
    """Where a calibration stands; follows from its verdict and the decisions log."""

    PENDING = "pending"
    """Can be accepted now."""
    STALE = "stale"
    """Was solved against a revision that is no longer in force; measure again."""
    REFUSED = "refused"
    """Its own verdict is not ACCEPT; kept for the record, can never be accepted."""
    REJECTED = "rejected"
    IN_FORCE = "in_force"
    SUPERSEDED = "superseded"
    """Was in force until another one was accepted."""
    ROLLED_BACK = "rolled_back"
    """Was in force until it was rolled back."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """What is known of a calibration without opening its contents.

    Attributes
    ----------
    kind : which model it changes, e.g. ``thermal``; each kind has its own revisions.
    model_hash : hash of the nominal model that it corrects.
    based_on : revision in force when it was solved (0 = nominal).
    cycle_id : measurement cycle that gave the data.
    stamp_ns : time of the data.
    created_ns : wall clock when it was proposed.
    software, method : version and estimator that made it.
    code, reason : the verdict.
    candidate_rms_mm : held-out rms error of the proposed model, None when not judged.
    """

    kind: str = THERMAL
    model_hash: str
    based_on: int
    cycle_id: str
    stamp_ns: int
    created_ns: int
    software: str
    method: str
    code: Code
    reason: str
    candidate_rms_mm: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal(Candidate):
    """A calibration to be put into the history.

    Attributes
    ----------
    document : the JSON document of the identification, finite numbers only.
    model : the model in full precision, as JSON; what comes into force.
    inputs : named arrays that it was solved from.
    """

    document: Mapping[str, Any]
    model: Mapping[str, Any]
    inputs: "Mapping[str, NDArray[Any]]" = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Decision:
    """One line of the decisions log.

    ``calibration_id`` is the one accepted, rejected or returned to (None: the nominal model);
    ``head_before`` and ``head_after`` are revisions of its kind, equal for a rejection.
    """

    seq: int
    kind: str
    action: Action
    calibration_id: int | None
    by: str
    reason: str
    wall_ns: int
    head_before: int
    head_after: int


@dataclass(frozen=True, slots=True)
class Head:
    """What is in force: ``calibration_id`` and ``model`` are None for the nominal model.

    ``revision`` grows by one with each acceptance and each rollback, also one to nominal.
    """

    kind: str
    revision: int
    calibration_id: int | None
    model: dict[str, Any] | None


@dataclass(frozen=True, kw_only=True)
class Entry(Candidate):
    """A calibration in the history, with where it stands.

    ``revision`` is the one under which it was accepted, 0 if never; ``decisions`` are those that
    rejected it or brought it into or out of force, oldest first.
    """

    id: int
    state: CalibrationState
    revision: int
    decisions: tuple[Decision, ...]


def require_measured_with(
    what: str, needed: Mapping[str, int], revision: Callable[[str], int]
) -> None:
    """Refuse a calibration that was measured with other revisions than those in force.

    ``needed`` and ``revision`` are revisions by kind.

    Raises
    ------
    StaleError
    """
    for kind, measured in needed.items():
        if (found := revision(kind)) != measured:
            raise StaleError(
                f"{what} was measured with {kind} revision {measured}, in force is {found}: "
                "measure it again"
            )
