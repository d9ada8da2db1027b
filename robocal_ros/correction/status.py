"""What the correction session says of itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.bounds import Policy, Survey
from robocal_ros.correction.refusals import Reason
from robocal_ros.correction.reported import CorrectionState

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Offset:
    """What is added to the taught joints at an instant: where they were commanded, or read, last.

    Attributes
    ----------
    names : of the n joints.
    offset : (n,) corrected less taught, rad (prismatic: m).
    revision, tool_revision : of the model and the tool that are headed for; None for none.
    s : of the blend towards them, 0 to 1; 1 when no blend is under way.
    """

    names: tuple[str, ...]
    offset: Array
    revision: int | None
    tool_revision: int | None
    s: float


@dataclass(frozen=True)
class CorrectionStatus:
    """What a correction session does; the figures are of the last message that was put out.

    Attributes
    ----------
    enabled : asked for.
    active : commands differ from what came in, or will.
    settled : no blend is under way.
    revision : of the model taken over, None without one.
    serial : the one it was made for; empty without one.
    survey : its correction over the joint range.
    waiting_revision : of a model that was refused, and that enabling takes over; None without one.
    new_tool : a tool other than the taught one was taken over.
    tool_revision : of the tool taken over, None without one.
    waiting_tool : revision of a tool that waits for standstill or the next trajectory, or None.
    stale : why the model is not corrected with any more, in words; empty when it is not stale.
    tcp_shift_m : error at the tool that the drift would have made.
    largest_shift : largest shift of a joint, rad (prismatic: m).
    remaining_m : error that was left at the tool.
    held : how often a blend waited because a bound would have been exceeded.
    waits : why a blend waits now; empty when none does.
    mismatch : why nothing is put out until the correction is enabled or disabled again; empty
        when nothing is wrong.
    reduced : how many points were corrected in part, near a singularity.
    clamped, passed : how many messages were corrected in part, or on the way to not at all, for
        what bound.
    policy : what is done with a command that exceeds a bound.
    reference : name and hash of the model that the program was taught with.
    shadow : whether commands pass as they came, and the correction is only shown.
    refused : how often, by reason.
    last_refusal : in words; empty when there was none.
    """

    enabled: bool
    active: bool
    settled: bool
    revision: int | None
    serial: str
    survey: Survey
    waiting_revision: int | None
    new_tool: bool
    tool_revision: int | None
    waiting_tool: int | None
    stale: str
    tcp_shift_m: float
    largest_shift: float
    remaining_m: float
    held: int
    waits: str
    mismatch: str
    reduced: int
    clamped: dict[Reason, int]
    passed: dict[Reason, int]
    policy: Policy
    reference: str
    shadow: bool
    refused: dict[Reason, int]
    last_refusal: str

    @property
    def state(self) -> CorrectionState:
        """All of it in one word."""
        if self.mismatch:
            return CorrectionState.MISMATCH
        if not self.settled:
            return CorrectionState.BLENDING
        if not self.enabled:
            return CorrectionState.OFF
        known = self.revision is not None or self.new_tool
        return CorrectionState.ON if known else CorrectionState.WITHOUT_MODEL
