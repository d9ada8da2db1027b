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
    withheld : (n,) offset less the one that model and tool ask for: the limiter is on its way.
    revision, tool_revision : of the model and the tool that are corrected with; None for none.
    """

    names: tuple[str, ...]
    offset: Array
    withheld: Array
    revision: int | None
    tool_revision: int | None


@dataclass(frozen=True, eq=False)
class CorrectionStatus:
    """What a correction session does; the figures are of the last message that was put out.

    Attributes
    ----------
    enabled : asked for.
    active : commands differ from what came in, or will.
    settled : the offset is the one that model and tool ask for.
    revision : of the model taken over, None without one.
    serial : the one it was made for; empty without one.
    survey : its correction over the joint range.
    waiting_revision : of a model that was refused, and that may be taken over; None without one.
    new_tool : a tool other than the taught one was taken over.
    tool_revision : of the tool taken over, None without one.
    waiting_tool : revision of a tool that waits for standstill or the next trajectory, or None.
    stale : why the model is not corrected with any more, in words; empty when it is not stale.
    tcp_shift_m : error at the tool that the drift would have made.
    largest_shift : largest offset that was asked for, rad (prismatic: m).
    remaining_m : error that was left at the tool.
    withheld, withheld_most : (n,) what the limiter withholds now, and has at most since the start.
    withheld_m, withheld_most_m : the same at the tool.
    lag_s : how far a stream's output lags what came in.
    overtaken : messages that came after a newer one.
    mismatch : why nothing is put out until it is acknowledged; empty when nothing is wrong.
    held : why no command is taken, by reason.
    reduced : how many points were corrected in part, near a singularity.
    clamped, passed : how many messages were corrected in part, or not at all, for what bound.
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
    withheld: Array
    withheld_most: Array
    withheld_m: float
    withheld_most_m: float
    lag_s: float
    overtaken: int
    mismatch: str
    held: dict[Reason, str]
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
