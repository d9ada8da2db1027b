"""What the correction session says of itself, and whether that is what is in force."""

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

from robocal_ros.correction.inputs import Array, Reason
from robocal_ros.ground.proposals import Head

if TYPE_CHECKING:  # who hears a status needs no compiled code
    from robocal_ros.correction.bounds import Policy, Survey

NODE = "joint_correction_node"


class CorrectionState(IntEnum):
    """What a joint correction does; the numbers of ``robocal_msgs/CorrectionStatus``."""

    OFF = 1
    BLENDING = 2
    ON = 3
    WITHOUT_MODEL = 4
    MISMATCH = 5
    OTHER_COMMANDER = 6
    LEASED = 7


@dataclass(frozen=True)
class Offset:
    """What is added to the taught joints at an instant: where they were commanded, or read, last.

    ``withheld``: offset less the one that model and tool ask for: the limiter is on its way.
    """

    names: tuple[str, ...]
    offset: Array  # (n,) corrected less taught, rad (prismatic: m)
    withheld: Array  # (n,)
    revision: int | None  # of the model that is corrected with; None for none
    tool_revision: int | None


@dataclass(frozen=True, eq=False)
class CorrectionStatus:
    """What a correction session does; the figures are of the last message that was put out."""

    enabled: bool  # asked for
    active: bool  # commands differ from what came in, or will
    settled: bool  # the offset is the one that model and tool ask for
    revision: int | None  # of the model taken over
    serial: str  # the one it was made for; empty without one
    survey: "Survey"  # its correction over the joint range
    waiting_revision: int | None  # of a model that was refused, and that may be taken over
    new_tool: bool  # a tool other than the taught one was taken over
    tool_revision: int | None  # of the tool taken over
    waiting_tool: int | None  # revision of one that waits for standstill or the next trajectory
    stale: str  # why the model is not corrected with any more; empty when it is not stale
    tcp_shift_m: float  # error at the tool that the drift would have made
    largest_shift: float  # largest offset that was asked for, rad (prismatic: m)
    remaining_m: float  # error that was left at the tool
    withheld: Array  # (n,) what the limiter withholds now
    withheld_most: Array  # (n,) and has at most since the start
    withheld_m: float  # the same at the tool
    withheld_most_m: float  # when that of all joints together was largest
    lag_s: float  # how far a stream's output lags what came in
    overtaken: int  # messages that came after a newer one
    mismatch: str  # why nothing is put out until it is acknowledged; empty: nothing is wrong
    held: dict[Reason, str]  # why no command is taken
    reduced: int  # points that were corrected in part, near a singularity
    clamped: dict[Reason, int]  # messages that were corrected in part, by what bound
    passed: dict[Reason, int]  # and those not at all
    policy: "Policy"
    reference: str  # name and hash of the model that the program was taught with
    shadow: bool  # commands pass as they came, and the correction is only shown
    refused: dict[Reason, int]  # how often
    last_refusal: str  # empty when there was none

    @property
    def state(self) -> CorrectionState:
        """All of it in one word."""
        if Reason.OTHER_COMMANDER in self.held:
            return CorrectionState.OTHER_COMMANDER
        if Reason.LEASED in self.held:
            return CorrectionState.LEASED
        if self.mismatch:
            return CorrectionState.MISMATCH
        if not self.settled:
            return CorrectionState.BLENDING
        if not self.enabled:
            return CorrectionState.OFF
        known = self.revision is not None or self.new_tool
        return CorrectionState.ON if known else CorrectionState.WITHOUT_MODEL

    def in_words(self) -> str:
        """What the correction does now, in one line."""
        said = self._said()
        return f"shadow, nothing is changed; it would be {said}" if self.shadow else said

    def _said(self) -> str:
        for reason, detail in self.held.items():
            return f"nothing goes out, {reason.value}: {detail}"
        if self.mismatch:
            return f"nothing goes out, {Reason.START_MISMATCH.value}: {self.mismatch}"
        if not self.enabled:
            return "off, the offset goes to zero with the next commands" if self.active else "off"
        parts = [] if self.revision is None else [f"model revision {self.revision}"]
        parts += [f"tool revision {self.tool_revision}"] if self.new_tool else []
        if not parts:
            return "on, but there is no model and no tool yet: nothing is corrected"
        settled = "on" if self.settled else "on, the offset changes with the next commands"
        return f"{settled}: {' and '.join(parts)}"


@dataclass(frozen=True, kw_only=True)
class ToldCorrection:
    """What a joint correction says of itself; revisions 0: the nominal model, the taught tool."""

    state: CorrectionState
    enabled: bool
    shadow: bool = False
    model_revision: int = 0
    tool_revision: int = 0
    waiting_tool_revision: int | None = None  # it waits for a standstill or a trajectory
    stale: str = ""
    mismatch: str = ""
    commanders: str = ""  # who else commands the robot; nothing goes out in OTHER_COMMANDER
    last_refusal: str = ""


def uncorrected(
    told: ToldCorrection | None, thermal: Head, tool: Head, *, follows: bool = False
) -> str:
    """Why commands are not corrected with model and tool in force, and what to do; empty: they are.

    Nominal model and taught tool need no correction. An offset that is still on its way counts as
    done. In the state LEASED the program's commands are refused: none goes out uncorrected.

    Parameters
    ----------
    told : None: the correction is silent.
    follows : something came into force so lately that the correction may not know of it yet.
    """
    needed = not (_is_plain(thermal) and _is_plain(tool))
    if told is None:
        return f"{NODE} is silent: start it, it corrects nothing" if needed else ""
    if needed and (why := _idle(told, thermal)):
        return f"{NODE} {why}"
    silent = told.state in (CorrectionState.MISMATCH, CorrectionState.OTHER_COMMANDER)
    if follows or not told.enabled or told.shadow or silent:
        return ""
    pairs = [
        _other("thermal model", "kinematic_model", told.model_revision, thermal, told),
        _other("tool", "tool", told.tool_revision, tool, told),
    ]
    return "; ".join(filter(None, pairs))


def _is_plain(head: Head) -> bool:
    return head.calibration_id is None


def _idle(told: ToldCorrection, thermal: Head) -> str:
    """Why nothing is corrected, whatever the revisions in use."""
    if told.shadow:
        return "is in shadow mode, nothing is corrected: start it with shadow false"
    if told.state is CorrectionState.MISMATCH:
        return f"puts nothing out, {told.mismatch}: see where the robot stands, call ~/acknowledge"
    if told.state is CorrectionState.OTHER_COMMANDER:
        return f"puts nothing out, {told.commanders}: end them"
    if not told.enabled:
        return "is OFF: call ~/enable"
    if told.state is CorrectionState.WITHOUT_MODEL:
        return "has heard of no model and no tool: wire its inputs kinematic_model and tool"
    if told.stale and not _is_plain(thermal):
        return f"corrects without the model, {told.stale}: accept a newer one"
    return ""


def _other(what: str, topic: str, used: int, head: Head, told: ToldCorrection) -> str:
    """Words where another revision is in use than in force; 0 is as good as any plain one."""
    if used == head.revision or (used == 0 and _is_plain(head)):
        return ""
    words = f"{NODE} corrects with {what} revision {used}, in force is revision {head.revision}"
    if topic == "tool" and told.waiting_tool_revision == head.revision:
        return f"{words}: that one waits until the robot stands or a trajectory begins"
    if told.last_refusal:
        return f"{words}: it refused last: {told.last_refusal}; mend that, or roll back"
    return f"{words}: wire its input {topic}"
