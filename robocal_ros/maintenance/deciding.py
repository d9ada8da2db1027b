# SPDX-License-Identifier: Apache-2.0
"""Decisions about thermal models and tools, and what may be accepted without a person."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from robocal_ros.ground.errors import (
    Code,
    ConflictError,
    InputError,
    RobocalError,
    StaleError,
    StorageError,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import (
    FIXTURE,
    REFERENCE,
    THERMAL,
    TOOL,
    Action,
    CalibrationState,
    Decision,
    Entry,
    Head,
    require_measured_with,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.maintenance.accuracy import MaintenanceConfig
from robocal_ros.maintenance.robot_interface import CellInterface, Script
from robocal_ros.session.events import (
    ACCEPT,
    REJECT,
    ROLLBACK,
    WITHHOLD,
    Command,
    Outcome,
    decide,
)
from robocal_ros.thermal.reference import commissioned_of
from robocal_ros.tool.judging import KnownTool, change_between
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.run import SAME

KINDS = (THERMAL, TOOL)
BY = "maintenance"
MOST_AT_ONCE = 2  # of a kind: each takes up to 20 ms, in which nobody watches the robot
LOOKED_AT = 200  # newest decisions that a call without an id may mean
REPEAT_NS = 60 * 1_000_000_000  # a call without an id is repeated within
DONE = {  # what a repeated decision finds
    ACCEPT: CalibrationState.IN_FORCE,
    REJECT: CalibrationState.REJECTED,
    ROLLBACK: CalibrationState.IN_FORCE,
}


class Decider:
    """Accepts, rejects and rolls back in the history that the other nodes follow."""

    def __init__(
        self, nominal: SerialArm, history: CalibrationHistory, config: MaintenanceConfig
    ) -> None:
        self._nominal, self._history, self._config = nominal, history, config

    def newest(self, kind: str) -> Entry | None:
        """The newest candidate, where it can be accepted now; None where nothing waits.

        Where the newest is outdated, those measured before it are too: revisions only grow.
        """
        return next(iter(self._history.pending(kind, 1)), None)

    def newest_fixture(self) -> Entry | None:
        """The newest of the fixtures' that can be accepted now; None where nothing waits.

        One that stands again where it was in force needs no other frame.
        """
        found = (e for e in self._history.fixtures() if e.state is CalibrationState.PENDING)
        return max(found, key=lambda entry: entry.id, default=None)

    def _outdated(self, entry: Entry) -> str:
        """Why it is STALE although its own kind's revision is in force; else empty."""
        try:
            self._require_beside(entry)
        except StaleError as error:
            return str(error)
        return ""

    def _require_beside(self, entry: Entry) -> None:
        needed = self._history.measured_with(entry.id)
        require_measured_with(f"{entry.kind} {entry.id}", needed, self.revision)

    def head(self, kind: str) -> Head:
        """What is in force."""
        return self._history.head(kind)

    def revision(self, kind: str) -> int:
        """Of what is in force."""
        return self.head(kind).revision

    def in_force(self, kind: str, calibration_id: int) -> bool:
        """Whether it is this one."""
        return self.head(kind).calibration_id == calibration_id

    def in_doubt(self, calibration_id: int) -> bool:
        """Whether nothing proves that a tool candidate is the tool's change, not the station's."""
        return self._history.model(calibration_id).get("cause") != "tool"

    def is_for_mandrel(self, calibration_id: int) -> bool:
        """Whether it is in doubt and the mandrel was first measured beside the same station."""
        young = self._history.model(calibration_id).get("mandrel_young", False)
        return not young and self.in_doubt(calibration_id)

    def decided(self, calibration_id: int) -> str:
        """What became of a candidate; empty while it waits."""
        state = self._history.get(calibration_id).state
        return "" if state is CalibrationState.PENDING else f"it is {state.value}"

    def accepted_here(self, calibration_id: int) -> bool:
        """Whether it is in force since it was accepted without a person."""
        entry = self._history.get(calibration_id)
        return entry.state is CalibrationState.IN_FORCE and entry.decisions[-1].by == BY

    def decide(self, name: str, calibration_id: int, by: str, why: str, wall_ns: int) -> Outcome:
        """Carry out a decision about one calibration; one that was made before is its answer again.

        Raises `RobocalError` as the history refuses: STALE where it was solved against a revision
        that is no longer in force.
        """
        entry = self._history.get(calibration_id)
        command = Command(name, {"id": calibration_id, "by": by, "reason": why})
        if entry.kind not in KINDS and entry.kind.split("/")[0] != FIXTURE:
            raise InputError(
                f"calibration {calibration_id} is of kind {entry.kind}: decide elsewhere"
            )
        head = self.head(entry.kind)
        if name in DONE and entry.state is DONE[name]:
            words = f"calibration {calibration_id} is {entry.state.value.replace('_', ' ')} already"
            return Outcome(
                command, Code.ACCEPT, words, None, calibration_id, head.revision, repeated=True
            )
        if name == ACCEPT:
            self._require_beside(entry)
        if name == ACCEPT and entry.state is CalibrationState.STALE:
            raise StaleError(
                f"calibration {calibration_id} was solved against revision {entry.based_on}, in "
                f"force is {head.revision}: measure again"
            )
        return self._carried_out(command, entry.kind, head.revision, wall_ns)

    def roll_back(self, kind: str, revision: int, by: str, why: str, wall_ns: int) -> Outcome:
        """Return to what was in force before ``revision``; CONFLICT where that is not any more."""
        command = Command(ROLLBACK, {"previous": True, "by": by, "reason": why})
        return self._carried_out(command, kind, revision, wall_ns)

    def only_pending(self) -> Entry:
        """The newest candidate, where they are of one kind.

        Raises `ConflictError` when nothing waits, or candidates of both kinds.
        """
        newest = [found for kind in KINDS if (found := self.newest(kind))]
        if len(newest) != 1:
            words = ", ".join(f"{entry.id} ({entry.kind})" for entry in newest) or "none"
            raise ConflictError(f"one candidate must wait, found {words}: decide by id")
        return newest[0]

    def decide_only(self, name: str, by: str, wall_ns: int) -> Iterator[Outcome]:
        """A decision without an id; each outcome as soon as it is made.

        Accept: the one candidate that waits. Reject: what waits, the newest first, two of a kind
        in a call. Rollback: take the last acceptance back. Each may come twice: nothing more is
        done.

        Raises `RobocalError` as `decide`, `only_pending`; BAD_INPUT where nothing was accepted
        lately.
        """
        if name == ROLLBACK:
            yield self._take_back(by, wall_ns)
            return
        if name == ACCEPT:
            yield self.decide(name, self._meant(by, wall_ns), by, "", wall_ns)
            return
        found = [self._history.pending(kind, MOST_AT_ONCE + 1) for kind in KINDS]
        waiting = [entry.id for entries in found for entry in entries[:MOST_AT_ONCE]]
        if not waiting:
            yield _nothing_to_do(Command(name, {"by": by}), "nothing waits for a decision")
        for number in waiting:
            try:
                outcome = self.decide(name, number, by, "", wall_ns)
            except RobocalError as error:  # those before it stay rejected, and are told
                command = Command(name, {"id": number, "by": by, "reason": ""})
                outcome = Outcome(command, error.code, str(error))
            yield outcome
            if outcome.status is Code.STORAGE_FAILED:
                return  # each further one would wait for the history as long
        if any(len(entries) > MOST_AT_ONCE for entries in found):
            yield _nothing_to_do(Command(name, {"by": by}), "more wait: call again")

    def _meant(self, by: str, wall_ns: int) -> int:
        """The candidate to accept; where none waits, what the same caller accepted just before."""
        waits = any(self.newest(kind) for kind in KINDS)
        made = [] if waits else self._made()
        last = made[-1] if made else None
        if (
            last
            and last.action is Action.ACCEPT
            and last.by == by
            and 0 <= wall_ns - last.wall_ns <= REPEAT_NS
        ):
            return last.calibration_id or 0
        return self.only_pending().id

    def _made(self) -> list[Decision]:
        """The newest decisions about kinds of this node, oldest first."""
        return [d for d in self._history.decisions(newest=LOOKED_AT) if d.kind in KINDS]

    def _take_back(self, by: str, wall_ns: int) -> Outcome:
        made = self._made()
        accepted = [d for d in made if d.action is Action.ACCEPT]
        if not accepted:
            raise InputError("nothing was accepted lately: there is nothing to roll back")
        last = accepted[-1]
        since = [d for d in made if d.seq > last.seq and d.kind == last.kind]
        again = self.head(last.kind).calibration_id == last.calibration_id  # by a rollback to it
        if again or not any(d.action is Action.ROLLBACK for d in since):
            return self.roll_back(last.kind, self.revision(last.kind), by, "", wall_ns)
        command = Command(ROLLBACK, {"previous": True, "by": by})
        return _nothing_to_do(command, f"calibration {last.calibration_id} is taken back already")

    def _carried_out(self, command: Command, kind: str, revision: int, wall_ns: int) -> Outcome:
        """Nothing is read after it: a decision that was made must not look like one that failed."""
        outcome = decide(self._history, command, revision, wall_ns, kind)
        return replace(outcome, revision=outcome.revision or revision)

    def withheld(self, calibration_id: int) -> str:
        """Why a candidate waits for a person; empty where it may be accepted without one."""
        bounds = self._config.bounds
        if not bounds.automatic:
            return "auto_accept is off"
        entry = self._history.get(calibration_id)
        if words := self._outdated(entry) or self.decided(calibration_id):
            return words
        if entry.kind != THERMAL:
            return self._tool_withheld(calibration_id)
        allowed_m, shift_m = bounds.thermal_m, self.thermal_shift_m(calibration_id)
        if not shift_m <= allowed_m:
            return (
                f"the tool centre point would be {shift_m * 1e3:.2f} mm from where it was at "
                f"commissioning (allowed without a person {allowed_m * 1e3:.2f} mm)"
            )
        return ""

    def _tool_withheld(self, calibration_id: int) -> str:
        bounds, config = self._config.bounds, self._config
        model = self._history.model(calibration_id)
        if what := self._other_reference(model["made_with"]):
            return f"it was measured with another {what} than this node's: give both nodes the same"
        found = KnownTool.of_document(model).T_flange_tool
        change = change_between(config.T_flange_tool, found)
        if not (change.tip_m <= bounds.tool_m and change.axis_rad <= bounds.tool_rad):
            return (
                f"the tool is {change.tip_m * 1e3:.2f} mm and {np.degrees(change.axis_rad):.2f} "
                f"deg from the taught one (allowed without a person {bounds.tool_m * 1e3:.2f} mm, "
                f"{np.degrees(bounds.tool_rad):.2f} deg)"
            )
        if self.in_doubt(calibration_id):
            return (
                "nothing proves that the tool has changed and not the beam station: look at both, "
                "then accept or reject it"
            )
        return ""

    def _other_reference(self, made_with: Mapping[str, Any]) -> str:
        """What the tool node was given differently, so that bounds would mean something else."""
        taught = np.array(made_with["taught"])
        if not np.max(np.abs(taught - self._config.T_flange_tool)) <= SAME:
            return "'taught' tool"
        laser, T_base_laser = LaserFrame(np.array(made_with["points_m"])), self._config.T_base_laser
        if T_base_laser is None or not np.max(np.abs(laser.T_base_laser - T_base_laser)) <= SAME:
            return "'laser'"
        return ""

    def thermal_shift_m(self, calibration_id: int) -> float:
        """Largest shift of the tip since commissioning at home and measuring poses."""
        reference = self._history.head(REFERENCE).model
        cold = self._nominal
        if reference is not None:
            cold = commissioned_of(reference, self._nominal)
        arm = arm_of(self._history.model(calibration_id), self._nominal)
        q = np.vstack([self._config.home, self._config.poses])
        tip = np.append(self._config.T_flange_tool[:3, 3], 1.0)
        shift = (arm.fk(q) @ tip - cold.fk(q) @ tip)[:, :3]
        return float(np.max(np.linalg.norm(shift, axis=1)))


def _nothing_to_do(command: Command, words: str) -> Outcome:
    return Outcome(command, Code.ACCEPT, words, repeated=True)


HELD_S = 2.0  # another process's change is a matter of milliseconds
WITHIN = "within the configured bounds"


def patiently(cell: CellInterface, act: Callable[[], Outcome]) -> Script[Outcome]:
    """What ``act`` gives; where the storage refuses, at the next ticks again while time allows.

    Raises `StorageError`: the last refusal, where it raised.
    """
    until_s = cell.now_s + HELD_S
    while True:
        last = cell.now_s >= until_s or not cell.fits(0.0)
        try:
            outcome = act()
        except StorageError:
            if last:
                raise
        else:
            if last or outcome.status is not Code.STORAGE_FAILED:
                return outcome
        yield


def settled(
    cell: CellInterface,
    decider: Decider,
    kind: str,
    calibration_id: int,
    unsure: Callable[[], str],
    wall_ns: int,
) -> Script[Outcome]:
    """Accept a candidate that lies inside the bounds, or leave it to a person.

    ``unsure`` says why it waits although it lies inside them; empty: it need not.
    """

    def act() -> Outcome:
        mine = decider.accepted_here(calibration_id)  # by a try whose answer was lost
        if not mine and (why := decider.withheld(calibration_id) or unsure()):
            message = f"{kind} candidate {calibration_id} waits for a decision: {why}"
            command = Command(WITHHOLD, {"id": calibration_id, "kind": kind})
            return Outcome(command, Code.ACCEPT, message)
        return decider.decide(ACCEPT, calibration_id, BY, WITHIN, wall_ns)

    return (yield from patiently(cell, act))


def is_accepted(outcome: Outcome) -> bool:
    """Whether what was settled is in force now."""
    return outcome.done and outcome.command.name == ACCEPT
