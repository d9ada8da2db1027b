"""Decisions about thermal models and tools, and what may be accepted without a person."""

import numpy as np

from robocal_ros.core.codes import Code
from robocal_ros.core.documents import arm_of, reference_of
from robocal_ros.core.errors import ConflictError, InputError, StaleError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import THERMAL, TOOL, Action, Entry, State
from robocal_ros.core.tool.judging import KnownTool, change_between
from robocal_ros.sessions.decisions import decide
from robocal_ros.sessions.events import ACCEPT, REJECT, ROLLBACK, WITHHOLD, Command, Outcome
from robocal_ros.sessions.history import History
from robocal_ros.sessions.in_force import REFERENCE
from robocal_ros.sessions.maintenance.config import MaintenanceConfig

KINDS = (THERMAL, TOOL)
BY = "maintenance"
DONE = {ACCEPT: State.IN_FORCE, REJECT: State.REJECTED}  # what a repeated decision finds


class Decider:
    """Accepts, rejects and rolls back in the history that the other nodes follow."""

    def __init__(self, nominal: SerialArm, history: History, config: MaintenanceConfig) -> None:
        self._nominal, self._history, self._config = nominal, history, config

    def pending(self, kind: str) -> list[Entry]:
        """Candidates that can be accepted now, newest first."""
        return list(self._history.pending(kind))

    def revision(self, kind: str) -> int:
        """The one in force."""
        return self._history.head(kind).revision

    def in_force(self, kind: str, calibration_id: int) -> bool:
        """Whether it is this one."""
        return self._history.head(kind).calibration_id == calibration_id

    def decide(self, name: str, calibration_id: int, by: str, why: str, wall_ns: int) -> Outcome:
        """Carry out a decision about one calibration; one that was made before is its answer again.

        Raises
        ------
        RobocalError
            As the history refuses: STALE where it was solved against a revision that is no longer
            in force.
        """
        entry = self._history.get(calibration_id)
        command = Command(name, {"id": calibration_id, "by": by, "reason": why})
        if entry.kind not in KINDS:
            raise InputError(
                f"calibration {calibration_id} is of kind {entry.kind}: decide elsewhere"
            )
        head = self._history.head(entry.kind)
        if name in DONE and entry.state is DONE[name]:
            words = f"calibration {calibration_id} is {entry.state.value.replace('_', ' ')} already"
            return Outcome(
                command, Code.ACCEPT, words, None, calibration_id, head.revision, repeated=True
            )
        if name == ACCEPT and entry.state is State.STALE:
            raise StaleError(
                f"calibration {calibration_id} was solved against revision {entry.based_on}, in "
                f"force is {head.revision}: measure again"
            )
        return self._carried_out(command, entry.kind, head.revision, wall_ns)

    def roll_back(self, kind: str, by: str, why: str, wall_ns: int) -> Outcome:
        """Return to what was in force before."""
        command = Command(ROLLBACK, {"previous": True, "by": by, "reason": why})
        return self._carried_out(command, kind, self.revision(kind), wall_ns)

    def only_pending(self) -> Entry:
        """The newest candidate, where they are of one kind.

        Raises
        ------
        ConflictError
            When nothing waits, or candidates of both kinds.
        """
        newest = [found[0] for kind in KINDS if (found := self.pending(kind))]
        if len(newest) != 1:
            words = ", ".join(f"{entry.id} ({entry.kind})" for entry in newest) or "none"
            raise ConflictError(f"one candidate must wait, found {words}: decide by id")
        return newest[0]

    def last_accepted(self) -> str:
        """Kind of the newest acceptance.

        Raises
        ------
        InputError
            When nothing was accepted.
        """
        for decision in reversed(self._history.decisions()):
            if decision.kind in KINDS and decision.action is Action.ACCEPT:
                return decision.kind
        raise InputError("nothing was accepted: there is nothing to roll back")

    def _carried_out(self, command: Command, kind: str, revision: int, wall_ns: int) -> Outcome:
        outcome = decide(self._history, command, revision, wall_ns, kind)
        return Outcome(
            outcome.command,
            outcome.status,
            outcome.message,
            None,
            outcome.calibration_id,
            self.revision(kind),
        )

    # ---- without a person -----------------------------------------------------------------------

    def withheld(self, calibration_id: int) -> str:
        """Why a candidate waits for a person; empty where it may be accepted without one."""
        bounds = self._config.bounds
        if not bounds.automatic:
            return "auto_accept is off"
        entry = self._history.get(calibration_id)
        if entry.state is not State.PENDING:
            return f"it is {entry.state.value}"
        if entry.kind == THERMAL:
            shift_m = self.thermal_shift_m(calibration_id)
            if shift_m > bounds.thermal_m:
                return (
                    f"the tool centre point would be {shift_m * 1e3:.2f} mm from where it was at "
                    f"commissioning (allowed without a person {bounds.thermal_m * 1e3:.2f} mm)"
                )
            return ""
        tip_m, tilt_rad = self.tool_shift(calibration_id)
        if tip_m > bounds.tool_m or tilt_rad > bounds.tool_rad:
            return (
                f"the tool is {tip_m * 1e3:.2f} mm and {np.degrees(tilt_rad):.2f} deg from the "
                f"taught one (allowed without a person {bounds.tool_m * 1e3:.2f} mm, "
                f"{np.degrees(bounds.tool_rad):.2f} deg)"
            )
        return ""

    def thermal_shift_m(self, calibration_id: int) -> float:
        """Largest shift of the tip from the cold reference's model at home and measuring poses."""
        reference = self._history.head(REFERENCE).model
        cold = self._nominal
        if reference is not None:
            cold = reference_of(reference, self._nominal).cell.arm
        arm = arm_of(self._history.model(calibration_id), self._nominal)
        q = np.vstack([self._config.home, self._config.poses])
        tip = np.append(self._config.T_flange_tool[:3, 3], 1.0)
        shift = (arm.fk(q) @ tip - cold.fk(q) @ tip)[:, :3]
        return float(np.max(np.linalg.norm(shift, axis=1)))

    def tool_shift(self, calibration_id: int) -> tuple[float, float]:
        """Of the tip, m, and of the axis, rad, from the taught tool that it was measured for."""
        model = self._history.model(calibration_id)
        taught = np.array(model["made_with"]["taught"])
        change = change_between(taught, KnownTool.of_document(model).T_flange_tool)
        return change.tip_m, change.axis_rad


def withholding(kind: str, calibration_id: int, why: str) -> Outcome:
    """A candidate is left to a person, for the record."""
    words = f"{kind} candidate {calibration_id} waits for a decision: {why}"
    return Outcome(Command(WITHHOLD, {"id": calibration_id, "kind": kind}), Code.ACCEPT, words)
