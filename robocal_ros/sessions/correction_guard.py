"""Order in time, own output that comes back, and the count of what was refused."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.sessions.correction_inputs import (
    JointCommand,
    Reason,
    RefusedError,
)

Array = NDArray[np.float64]
Answer = TypeVar("Answer")

READING = "joint reading"
TARGET = "joint target"
TRAJECTORY = "trajectory"

# A reading this much older than the last one comes from a clock that was set back.
CLOCK_RESET_NS = 1_000_000_000
# Positions nearer than this are the same; own output is told by what it was shifted.
SAME = 1e-12
SHIFTED = 1e-9


@dataclass(frozen=True)
class CorrectionStatus:
    """What a correction session does; the figures are of the last message that was put out.

    Attributes
    ----------
    enabled : asked for.
    active : commands differ from what came in, or will.
    settled : no blend is under way.
    revision : of the model taken over, None without one.
    new_tool : a tool other than the taught one was taken over.
    tcp_shift_m : error at the tool that the drift would have made.
    largest_shift : largest shift of a joint, rad (prismatic: m).
    remaining_m : error that was left at the tool.
    held : how often a blend waited because a bound would have been exceeded.
    reduced : how many points were corrected in part, near a singularity.
    refused : how often, by reason.
    last_refusal : in words; empty when there was none.
    """

    enabled: bool
    active: bool
    settled: bool
    revision: int | None
    new_tool: bool
    tcp_shift_m: float
    largest_shift: float
    remaining_m: float
    held: int
    reduced: int
    refused: dict[Reason, int]
    last_refusal: str


class CorrectionGuard:
    """Watches what comes in.

    Attributes
    ----------
    refused : how often, by reason.
    last_refusal : in words.
    """

    def __init__(self) -> None:
        self._clock_s = -np.inf
        self._stamps: dict[str, int] = {}
        self._last_output: tuple[tuple[str, ...], Array] | None = None
        self.refused: Counter[Reason] = Counter()
        self.last_refusal = ""

    def counted(self, act: Callable[[], Answer]) -> Answer:
        """Do something; a refusal is counted and passed on."""
        try:
            return act()
        except RefusedError as error:
            self.refused[error.reason] += 1
            self.last_refusal = str(error)
            raise

    def require_order(self, kind: str, stamp: int, mark: str, now_s: float) -> None:
        """Refuse what carries a mark of a correction, or is older than the one before."""
        if mark == CORRECTED or (mark == TAUGHT and kind == READING):
            raise RefusedError(Reason.OWN_OUTPUT, f"{kind} with frame_id '{mark}'")
        if not now_s >= self._clock_s:
            raise RefusedError(Reason.TIME_BACKWARDS, f"clock at {now_s} after {self._clock_s}")
        last = self._stamps.get(kind, 0)
        reset = kind == READING and last - stamp > CLOCK_RESET_NS
        if stamp and stamp < last and not reset:
            detail = f"{kind} is {(last - stamp) * 1e-9:.6f} s older than the one before"
            raise RefusedError(Reason.TIME_BACKWARDS, detail)

    def accept_order(self, kind: str, stamp: int, now_s: float) -> None:
        """Remember the time of what was acted on."""
        self._clock_s = now_s
        if stamp:
            self._stamps[kind] = stamp

    def forget_stamps(self) -> None:
        """Start afresh with any source stamp."""
        self._stamps.clear()

    def note_output(self, corrected: JointCommand | None, shift: float = 0.0) -> None:
        """Remember a corrected target, and by how much it was shifted."""
        self._last_output = None
        if corrected is not None and shift > SHIFTED:
            self._last_output = (corrected.names, corrected.position)

    def require_not_own(self, command: JointCommand) -> None:
        """Refuse a target that is the last corrected one."""
        if self._last_output is None:
            return
        names, position = self._last_output
        if command.names != names or command.position.shape != position.shape:
            return
        if np.max(np.abs(command.position - position)) <= SAME:
            raise RefusedError(Reason.OWN_OUTPUT, "equal to the last corrected target")
