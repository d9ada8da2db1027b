"""What the joint correction tells: offsets, status, diagnostics, and its part of the history."""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from rclpy.publisher import Publisher

from robocal_ros import __version__
from robocal_ros.core import frames
from robocal_ros.core.correction_record import CALIBRATED, NOMINAL, CorrectionRecord
from robocal_ros.core.errors import RobocalError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.messages import CorrectionMessages, in_words
from robocal_ros.correction.refusals import Reason
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.correction.settings import NOMINAL as NOMINAL_CHOICE
from robocal_ros.correction.status import CorrectionStatus
from robocal_ros.nodes.base import NO_SERIAL
from robocal_ros.nodes.diagnostics import ERROR, WARN, Health
from robocal_ros.nodes.history_settings import acknowledge_history, history_notice, open_history
from robocal_ros.storage.calibrations import CalibrationHistory

TELL_S = 1.0  # the status goes out at least so often
LOOK_S = 0.1  # between two looks at what has changed
# What changes with each command is no news.
FIGURES = (
    "header", "tool_shift_mm", "largest_offset", "remaining_mm", "withheld", "withheld_most",
    "withheld_mm", "withheld_most_mm", "lag_s",
)  # fmt: skip
RETRY_S = 5.0
CLOSE_S = 5.0  # the end of the node waits so long for what is not yet written
MOST_WAITING = 1000  # then the oldest are lost
END, ACKNOWLEDGE = "end", "acknowledge"
ACKNOWLEDGED_BY = "joint_correction_node"


class CorrectionLog:
    """Keeps each change of what is corrected with, from the first record on; and watches the disk.

    A thread of its own reads and writes: a disk that is slow, full or locked holds no command up.
    What cannot be written is told and tried again.

    Parameters
    ----------
    open_history : raises `RobocalError`. It is opened anew for what has changed.
    notice : of a damaged history that nobody has acknowledged; empty without one.
    acknowledge : writes down that somebody has; raises `RobocalError`.

    Attributes
    ----------
    fault : why something waits to be written; empty when nothing does.
    damage : the last notice.
    """

    def __init__(
        self,
        open_history: Callable[[], CalibrationHistory],
        notice: Callable[[], str],
        acknowledge: Callable[[], object],
    ) -> None:
        self._open, self._notice, self._acknowledge = open_history, notice, acknowledge
        self._last: CorrectionRecord | None = None
        self._noted: queue.SimpleQueue[CorrectionRecord | str] = queue.SimpleQueue()
        self._waiting: deque[CorrectionRecord] = deque(maxlen=MOST_WAITING)
        self.fault = self.damage = ""
        self._thread = threading.Thread(target=self._run, name="correction_log", daemon=True)
        self._thread.start()

    def note(self, record: CorrectionRecord) -> None:
        """Keep it, if more than its time has changed."""
        if self._last is None or replace(record, wall_ns=self._last.wall_ns) != self._last:
            self._last = record
            self._noted.put(record)

    def acknowledge(self) -> None:
        """Write down that somebody knows of the damage."""
        self._noted.put(ACKNOWLEDGE)

    def close(self) -> None:
        """Write what waits, if that is possible soon."""
        self._noted.put(END)
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        noted: CorrectionRecord | str = ""
        while noted != END:
            try:
                noted = self._noted.get(timeout=RETRY_S)
            except queue.Empty:
                noted = ""
            if isinstance(noted, CorrectionRecord):
                self._waiting.append(noted)
            self._try(acknowledges=noted == ACKNOWLEDGE)

    def _try(self, *, acknowledges: bool) -> None:
        try:
            if acknowledges:
                self._acknowledge()
            self.damage = self._notice()
            if self._waiting:
                with self._open() as history:
                    while self._waiting:
                        history.note_correction(self._waiting[0])
                        self._waiting.popleft()
            self.fault = ""
        except (RobocalError, OSError) as error:
            count = len(self._waiting)
            self.fault = f"{count} changes wait to be written into the history: {error}"


class CorrectionReport:
    """Tells what a session does, from its configuration to `close`.

    Parameters
    ----------
    nominal, reference : models; the reference with the taught tool.
    offsets, statuses : publishers.
    now_ns : the clock of what is published.
    """

    def __init__(
        self,
        session: CorrectionSession,
        settings: Mapping[str, Any],
        nominal: SerialArm,
        reference: SerialArm,
        offsets: Publisher,
        statuses: Publisher,
        now_ns: Callable[[], int],
    ) -> None:
        self._session, self._now_ns = session, now_ns
        self._offsets, self._statuses = offsets, statuses
        serial, chosen = settings["serial"] or NO_SERIAL, settings["reference"]
        self._messages = CorrectionMessages(
            nominal, reference, chosen, serial, bool(settings["shadow"])
        )
        self._refusals = 0
        self._told: list[str] = []
        self._told_s = 0.0
        is_nominal, T = chosen == NOMINAL_CHOICE, reference.T_flange_tool
        self._record = partial(
            CorrectionRecord,
            software=__version__,
            model_hash=nominal.model_hash,
            reference=NOMINAL if is_nominal else CALIBRATED,
            reference_source=settings["robot"] if is_nominal else chosen,
            reference_name=reference.name,
            reference_hash=reference.model_hash,
            taught_tool=(*T[:3, 3].tolist(), *frames.quat_xyzw(T).tolist()),
        )
        self._log = CorrectionLog(
            lambda: open_history(settings, nominal, owner=False)[1],
            lambda: history_notice(settings),
            lambda: acknowledge_history(settings, ACKNOWLEDGED_BY),
        )

    def close(self) -> None:
        """Finish the history."""
        self._log.close()

    def acknowledge(self) -> None:
        """Somebody has taken note of what the history tells."""
        self._log.acknowledge()

    def offset(self, cause: int, now_s: float) -> None:
        """Publish what is added to the taught joints, while somebody subscribes."""
        if self._offsets.get_subscription_count():
            offset = self._session.offset(now_s)
            self._offsets.publish(self._messages.offset(offset, cause, self._now_ns()))

    def status(self, commanders: str, lease: str, *, only_news: bool = False) -> None:
        """Publish the status; a figure of the last command alone is no news.

        ``commanders``: who else commands; ``lease``: who holds one; empty where nobody does.
        """
        now = time.monotonic()
        status = self._session.status(now)
        message = self._messages.status(status, commanders, lease, self._log.damage, self._now_ns())
        names = message.get_fields_and_field_types()
        told = [str(getattr(message, name)) for name in names if name not in FIGURES]
        if only_news and told == self._told and now - self._told_s < TELL_S - 0.5 * LOOK_S:
            return
        self._told, self._told_s = told, now
        self._note(status)
        self._statuses.publish(message)

    def _note(self, status: CorrectionStatus) -> None:
        """Keep in the history what has changed."""
        self._log.note(
            self._record(
                wall_ns=time.time_ns(),
                enabled=status.enabled,
                shadow=status.shadow,
                model_revision=0 if status.stale else status.revision or 0,
                tool_revision=status.tool_revision or 0,
            )
        )

    def health(self, faults: list[str], warnings: list[str]) -> Health:
        """Tell what is corrected, and what was refused and why; a refusal warns once.

        ``faults``: why nothing goes out, or what must not be used; ``warnings``: what an operator
        should look at besides.
        """
        status, health = self._session.status(time.monotonic()), Health()
        refusals = sum(status.refused.values())
        if refusals > self._refusals:
            health.worsen(WARN, status.last_refusal)
        self._refusals = refusals
        if status.mismatch:
            faults = [*faults, f"{Reason.START_MISMATCH.value}: {status.mismatch}"]
        for fault in faults:
            health.worsen(ERROR, fault)
        for warning in [*warnings, *_warnings(status), self._log.damage, self._log.fault]:
            if warning:
                health.worsen(WARN, warning)
        health.values = _figures(status)
        return health


def _warnings(status: CorrectionStatus) -> list[str]:
    """What an operator should look at."""
    said = [status.stale]
    if status.survey.beyond:
        said.append(f"model revision {status.revision}: {status.survey}")
    if status.waiting_revision is not None:
        said.append(
            f"model revision {status.waiting_revision} was refused, ~/take_over looks at it again"
        )
    if status.enabled and status.revision is None and not status.new_tool:
        said.append("enabled, but neither a model nor a tool was taken over")
    return said


def _figures(status: CorrectionStatus) -> dict[str, object]:
    counts = {"refused": status.refused, "clamped": status.clamped, "passed": status.passed}
    figures: dict[str, object] = {
        "correction": in_words(status),
        "reference": status.reference,
        "policy": status.policy.value,
        "tool waits": "" if status.waiting_tool is None else f"revision {status.waiting_tool}",
        "shift at the tool mm": f"{status.tcp_shift_m * 1e3:.4f}",
        "largest joint shift deg": f"{np.degrees(status.largest_shift):.4f}",
        "remaining error mm": f"{status.remaining_m * 1e3:.6f}",
        "withheld mm": f"{status.withheld_m * 1e3:.4f}",
        "withheld at most mm": f"{status.withheld_most_m * 1e3:.4f}",
        "output lags s": f"{status.lag_s:.3f}",
        "overtaken": status.overtaken,
        "over the joint range": status.survey,
        "start mismatch": status.mismatch,
        "points corrected in part": status.reduced,
    }
    for what, found in counts.items():
        figures |= {f"{what}, {reason.value}": count for reason, count in found.items()}
    return figures
