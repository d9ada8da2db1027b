"""What a session needs of a calibration history, whoever keeps it."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, WrongRobotError
from robocal_ros.ground.proposals import Decision, Entry, Head, Proposal
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Command


class History(Protocol):
    """The part of ``history.calibrations.CalibrationHistory`` that sessions use."""

    serial: str

    def propose(self, proposal: Proposal) -> int:
        """Keep a candidate and return its id."""

    def accept(
        self,
        calibration_id: int,
        *,
        by: str,
        reason: str,
        expected_head: int | None,
        wall_ns: int,
        with_heads: Mapping[str, int] | None = ...,
    ) -> Head:
        """Bring a candidate into force; ``with_heads``: only beside these revisions, by kind."""

    def reject(self, calibration_id: int, *, by: str, reason: str, wall_ns: int) -> None:
        """Refuse a candidate for good."""

    def rollback(
        self,
        to: int | None,
        *,
        by: str,
        reason: str,
        expected_head: int | None,
        wall_ns: int,
        kind: str = ...,
    ) -> Head:
        """Return to an earlier calibration, or to nominal."""

    def head(self, kind: str = ...) -> Head:
        """What is in force."""

    def pending(self, kind: str = ..., limit: int = ...) -> Sequence[Entry]:
        """Candidates that wait for a decision, newest first; ``limit``: so many at the most."""

    def decisions(self, after_seq: int = ..., newest: int = ...) -> Sequence[Decision]:
        """Decisions after a sequence number, oldest first; ``newest``: so many at the most."""

    def list(self, limit: int = ...) -> Sequence[Entry]:
        """The latest calibrations, newest first."""

    def get(self, calibration_id: int) -> Entry:
        """A calibration by its id."""

    def model(self, calibration_id: int) -> dict[str, Any]:
        """A calibration's model in full precision."""

    def document(self, calibration_id: int) -> dict[str, Any]:
        """A calibration's JSON document."""

    def inputs(self, calibration_id: int) -> dict[str, NDArray[Any]]:
        """The arrays that a calibration was solved from."""

    def data_version(self) -> Any:
        """A value that changes when the history does."""


BY = "replay"


WHY = "in force when the recording began"


def require_robot(nominal: SerialArm, configured: Command) -> None:
    """Refuse a robot that the recording was not made with.

    Raises
    ------
    WrongRobotError
        Always then; the message names both models.
    """
    recorded = str(configured.arguments.get("model_hash", ""))
    if recorded != nominal.model_hash:
        raise WrongRobotError(
            f"this was recorded with robot '{configured.arguments.get('robot', '')}' of nominal "
            f"model {recorded}; '{nominal.name}' is {nominal.model_hash}"
        )


def seeded(
    history: History,
    nominal: SerialArm,
    in_force: Mapping[str, Mapping[str, Any] | None],
    software: str,
) -> bool:
    """Bring what was in force, by its kind, into an empty history; whether it was empty.

    Called once all else of the recording was read: what is left in a history after a failure would
    be taken for the user's own at the next try.
    """
    if history.list(1):
        return False
    for kind, model in in_force.items():
        bring_into_force(history, kind, nominal, model, software)
    return True


def bring_into_force(
    history: History,
    kind: str,
    nominal: SerialArm,
    model: Mapping[str, Any] | None,
    software: str,
    why: str = WHY,
) -> None:
    """Accept what was in force when, or while, a recording was made; None: nothing was."""
    if model is None:
        return
    calibration_id = history.propose(
        Proposal(
            kind=kind,
            model_hash=nominal.model_hash,
            based_on=history.head(kind).revision,
            cycle_id="",
            stamp_ns=0,
            created_ns=0,
            software=software,
            method="",
            code=Code.ACCEPT,
            reason=why,
            document={},
            model=model,
        )
    )
    history.accept(calibration_id, by=BY, reason=why, expected_head=None, wall_ns=0)
