"""The rules of accept, reject and rollback, as a fold over the decisions log.

The log alone says what is in force: there is no second place that could disagree with it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from robocal_ros.ground.errors import Code, ConflictError, RobocalError, StaleError
from robocal_ros.ground.proposals import (
    Action,
    CalibrationState,
    Candidate,
    Decision,
    require_measured_with,
)
from robocal_ros.history.history_schema import DamagedError

NOMINAL = 0
"""As a rollback's target: the nominal model."""


class VerdictError(RobocalError):
    """A calibration whose own verdict refuses it; ``code`` is that verdict."""

    def __init__(self, message: str, code: Code) -> None:
        super().__init__(message)
        self.code = code


@dataclass
class _Standing:
    """What the log says of one calibration."""

    revision: int = 0  # as which it was accepted
    parent: int | None = None  # what was in force before it; None = nominal
    rejected: bool = False
    left: CalibrationState | None = None  # how it went out of force
    decisions: tuple[Decision, ...] = ()


class Ledger:
    """The decisions log, folded: what is in force, and where each calibration stands."""

    def __init__(self) -> None:
        self.last_seq = 0
        self._heads: dict[str, tuple[int, int | None]] = {}
        self._standings: dict[int, _Standing] = {}

    def head(self, kind: str) -> tuple[int, int | None]:
        """Revision in force and its calibration (None = nominal)."""
        return self._heads.get(kind, (0, None))

    def kinds(self) -> list[str]:
        """Kinds that have ever had a revision."""
        return sorted(self._heads)

    def standing(self, calibration_id: int) -> _Standing:
        """Tell what the log says of a calibration; the default when it says nothing."""
        return self._standings.get(calibration_id, _Standing())

    def state(self, calibration_id: int, candidate: Candidate) -> CalibrationState:
        """Where a calibration stands."""
        standing = self.standing(calibration_id)
        revision, in_force = self.head(candidate.kind)
        if calibration_id == in_force:
            return CalibrationState.IN_FORCE
        if standing.left is not None:
            return standing.left
        if standing.rejected:
            return CalibrationState.REJECTED
        if candidate.code is not Code.ACCEPT:
            return CalibrationState.REFUSED
        return (
            CalibrationState.PENDING if candidate.based_on == revision else CalibrationState.STALE
        )

    def extend(self, decisions: Iterable[Decision]) -> None:
        """Add the decisions that follow. Raises `DamagedError`, see `apply`."""
        for decision in decisions:
            self.apply(decision)

    def apply(self, decision: Decision) -> None:
        """Add the next decision.

        Raises
        ------
        DamagedError
            It does not follow from the decisions before it.
        """
        revision, in_force = self.head(decision.kind)
        step = 0 if decision.action is Action.REJECT else 1
        chained = decision.head_before == revision and decision.head_after == revision + step
        if not chained or not self._possible(decision, in_force):
            raise DamagedError(f"decision {decision.seq} contradicts those before it")
        if decision.calibration_id is not None:
            standing = self._standings.setdefault(decision.calibration_id, _Standing())
            standing.decisions += (decision,)
            if decision.action is Action.REJECT:
                standing.rejected = True
            elif decision.action is Action.ACCEPT:
                standing.revision, standing.parent = decision.head_after, in_force
        if decision.action is not Action.REJECT:
            if in_force is not None:
                out = self._standings[in_force]
                accepted = decision.action is Action.ACCEPT
                out.left = CalibrationState.SUPERSEDED if accepted else CalibrationState.ROLLED_BACK
                out.decisions += (decision,)
            self._heads[decision.kind] = (decision.head_after, decision.calibration_id)
        self.last_seq = decision.seq

    def _possible(self, decision: Decision, in_force: int | None) -> bool:
        target = decision.calibration_id
        if decision.action is Action.ROLLBACK:
            was_accepted = target is None or self.standing(target).revision > 0
            return in_force != target and was_accepted
        if target is None:
            return False
        standing = self.standing(target)
        return not standing.rejected and standing.revision == 0

    def check_open(self, calibration_id: int) -> None:
        """Refuse a calibration that was decided before.

        Raises
        ------
        ConflictError
        """
        standing = self.standing(calibration_id)
        if standing.revision:
            raise ConflictError(
                f"calibration {calibration_id} was accepted already, as revision "
                f"{standing.revision}; to return to it use rollback"
            )
        if standing.rejected:
            raise ConflictError(
                f"calibration {calibration_id} was rejected by "
                f"{standing.decisions[-1].by or 'an unnamed person'}; measure again"
            )

    def check_head(self, kind: str, expected: int | None) -> None:
        """Refuse when another revision is in force than the caller believes.

        Raises
        ------
        ConflictError
        """
        revision, _ = self.head(kind)
        if expected is not None and expected != revision:
            raise ConflictError(
                f"{kind} revision {revision} is in force, not {expected}: another change came "
                "first; look at the list and decide again"
            )

    def check_accept(
        self,
        calibration_id: int,
        candidate: Candidate,
        expected: int | None,
        with_heads: Mapping[str, int],
    ) -> None:
        """Refuse what must not come into force.

        Raises
        ------
        ConflictError, VerdictError, StaleError
        """
        self.check_open(calibration_id)
        if candidate.code is not Code.ACCEPT:
            raise VerdictError(
                f"calibration {calibration_id} was judged {candidate.code.name}: "
                f"{candidate.reason}; it cannot be accepted",
                candidate.code,
            )
        self.check_head(candidate.kind, expected)
        revision, _ = self.head(candidate.kind)
        if candidate.based_on != revision:
            raise StaleError(
                f"calibration {calibration_id} was solved against {candidate.kind} revision "
                f"{candidate.based_on}, but {revision} is in force; measure again"
            )
        what = f"{candidate.kind} {calibration_id}"
        require_measured_with(what, with_heads, lambda kind: self.head(kind)[0])

    def rollback_target(self, kind: str, to: int | None) -> int | None:
        """Calibration that a rollback returns to (None = nominal).

        ``to`` None goes to what was in force when the present one was accepted, so that each
        further rollback goes further back and never forward again.

        Raises
        ------
        ConflictError
        """
        _, in_force = self.head(kind)
        if to is None:
            if in_force is None:
                raise ConflictError(f"the nominal {kind} model is in force: nothing to roll back")
            return self.standing(in_force).parent
        target = None if to == NOMINAL else to
        if target == in_force:
            name = "the nominal model" if target is None else f"calibration {target}"
            raise ConflictError(f"{name} is in force already")
        if target is not None and not self.standing(target).revision:
            raise ConflictError(
                f"calibration {target} was never accepted: a rollback returns to what was in "
                "force before"
            )
        return target
