"""What the joint correction tells: offsets, status, diagnostics, and its part of the history."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from rclpy.publisher import Publisher

from robocal_ros import __version__
from robocal_ros.core import frames
from robocal_ros.core.correction_record import CALIBRATED, NOMINAL, CorrectionRecord
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.health import CorrectionHealth
from robocal_ros.correction.log import CorrectionLog
from robocal_ros.correction.messages import CorrectionMessages
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.correction.settings import NOMINAL as NOMINAL_CHOICE
from robocal_ros.correction.status import CorrectionStatus
from robocal_ros.nodes.base import NO_SERIAL
from robocal_ros.nodes.diagnostics import WARN, Health
from robocal_ros.nodes.history_settings import open_history

TELL_S = 1.0  # the status goes out at least so often
LOOK_S = 0.1  # between two looks at what has changed


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
        self._judge = CorrectionHealth()
        self._told: tuple[CorrectionStatus, str] | None = None
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
        self._log = CorrectionLog(lambda: open_history(settings, nominal, owner=False)[1])

    def close(self) -> None:
        """Finish the history."""
        self._log.close()

    def offset(self, cause: int, now_s: float) -> None:
        """Publish what is added to the taught joints, while somebody subscribes."""
        if self._offsets.get_subscription_count():
            offset = self._session.offset(now_s)
            self._offsets.publish(self._messages.offset(offset, cause, self._now_ns()))

    def status(self, sources: str, *, only_news: bool = False) -> None:
        """Publish the status; a figure of the last command alone is no news.

        ``sources``: what is wrong with who sends commands.
        """
        status, now = self._session.status(), time.monotonic()
        told = (replace(status, tcp_shift_m=0.0, largest_shift=0.0, remaining_m=0.0), sources)
        if only_news and told == self._told and now - self._told_s < TELL_S - 0.5 * LOOK_S:
            return
        self._told, self._told_s = told, now
        self._note(status)
        self._statuses.publish(self._messages.status(status, sources, self._now_ns()))

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

    def health(self, faults: list[str], rivals: list[str]) -> Health:
        """Tell what is corrected, and what was refused and why; see `CorrectionHealth`."""
        health = self._judge.of(self._session.status(), faults, rivals)
        if self._log.fault:
            health.worsen(WARN, self._log.fault)
        return health
