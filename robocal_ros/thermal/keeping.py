"""Results into the history, with all that a later look at them needs."""

from typing import Any

from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground.proposals import THERMAL, Proposal
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Command
from robocal_ros.session.history import History
from robocal_ros.thermal.in_force import InForce


class CandidateStore:
    """Puts candidates of one session into the history.

    Parameters
    ----------
    current : what is in force, followed by the session.
    software : version that made the candidates.
    """

    def __init__(
        self, nominal: SerialArm, history: History, software: str, current: InForce
    ) -> None:
        self._nominal, self._history = nominal, history
        self._software, self._current = software, current

    def propose(
        self,
        kind: str,
        command: Command,
        wall_ns: int,
        method: str,
        verdict: Verdict,
        document: dict[str, Any],
        model: dict[str, Any],
        inputs: dict[str, NDArray[Any]],
    ) -> int:
        """Keep a candidate and return its id."""
        # What it was solved against, though another process may have decided meanwhile.
        head = self._current.head if kind == THERMAL else self._history.head(kind)
        held_out = document.get("calibrated", {}).get("held_out", {})
        return self._history.propose(
            Proposal(
                kind=kind,
                model_hash=self._nominal.model_hash,
                based_on=head.revision,
                cycle_id=str(command.arguments.get("cycle_id", "")),
                stamp_ns=command.stamp_ns or 0,
                created_ns=wall_ns,
                software=self._software,
                method=method,
                code=verdict.code,
                reason=verdict.reason,
                candidate_rms_mm=held_out.get("rms_mm"),
                document=document,
                model=model,
                inputs=inputs,
            )
        )

    def accept(self, chosen: int, command: Command, reason: str, wall_ns: int) -> None:
        """Bring a step of the set-up into force: it moves nothing."""
        by = str(command.arguments.get("by", ""))
        self._history.accept(chosen, by=by, reason=reason, expected_head=None, wall_ns=wall_ns)
