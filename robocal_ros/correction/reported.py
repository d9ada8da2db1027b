"""Whether commands are corrected with what is in force, by what the joint correction says."""

from dataclasses import dataclass
from enum import IntEnum

from robocal_ros.core.proposals import Head

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


@dataclass(frozen=True, kw_only=True)
class ToldCorrection:
    """What a joint correction says of itself.

    Attributes
    ----------
    enabled : asked for; where it is not, it may still be on its way out.
    shadow : commands pass as they came.
    model_revision, tool_revision : in use; 0: none, the nominal model, the taught tool.
    waiting_tool_revision : of a tool that waits for a standstill or a trajectory; None: none.
    stale : why the model is not corrected with any more; empty: it is.
    mismatch : why nothing goes out; empty: commands do.
    commanders : who else commands the robot; nothing goes out in the state OTHER_COMMANDER.
    last_refusal : in words; empty: there was none.
    """

    state: CorrectionState
    enabled: bool
    shadow: bool = False
    model_revision: int = 0
    tool_revision: int = 0
    waiting_tool_revision: int | None = None
    stale: str = ""
    mismatch: str = ""
    commanders: str = ""
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
    if told.state is CorrectionState.OTHER_COMMANDER:
        return f"puts nothing out, {told.commanders}: end them"
    if told.state is CorrectionState.MISMATCH:
        return f"puts nothing out, {told.mismatch}: see where the robot stands, call ~/acknowledge"
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
