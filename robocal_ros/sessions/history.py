"""What a session needs of a calibration history, whoever keeps it."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from numpy.typing import NDArray

from robocal_ros.core.proposals import Decision, Entry, Head, Proposal


class History(Protocol):
    """The part of ``storage.calibrations.CalibrationHistory`` that sessions use."""

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
