# SPDX-License-Identifier: Apache-2.0
"""What the joint correction tells: offsets, status, diagnostics, and its part of the history."""

import queue
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from robocal_msgs.msg import CorrectionStatus as StatusMessage
from robocal_msgs.msg import JointOffset

from robocal_ros import __version__
from robocal_ros.correction.interface import CorrectionStatus, Reason
from robocal_ros.correction.messages import doubles
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.correction.settings import NOMINAL as NOMINAL_CHOICE
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RobocalError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import (
    CALIBRATED,
    NOMINAL,
    THERMAL,
    TOOL,
    CorrectionRecord,
    Past,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import RobotDescription
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import NO_SERIAL
from robocal_ros.ros.conversions import header, transform_message
from robocal_ros.ros.endpoints import ERROR, WARN, Health
from robocal_ros.ros.robot import RobotNode
from robocal_ros.ros.session_node import acknowledge_history, history_notice, open_history

TELL_S = 1.0  # the status goes out at least so often
LOOK_S = 0.1  # between two looks at what has changed
# What changes with each command is no news.
FIGURES = (
    "header", "tool_shift_mm", "largest_offset", "remaining_mm", "withheld", "withheld_most",
    "withheld_mm", "withheld_most_mm", "lag_s",
)  # fmt: skip
# Fields of the message that are those of the session.
SAME = ("enabled", "stale", "mismatch", "lag_s", "overtaken", "reduced", "last_refusal")
STREAM = int(JointOffset.STREAM)
RETRY_S = 5.0
CLOSE_S = 5.0  # the end of the node waits so long for what is not yet written
MOST_WAITING = 1000  # then the oldest are lost
END = "end"
ACKNOWLEDGED_BY = "joint_correction_node"


class CorrectionLog:
    """Keeps each change of what is corrected with, from the first record on; and watches the disk.

    A thread of its own reads and writes: a disk that is slow, full or locked holds no command up.
    What cannot be written is told and tried again. ``fault`` says why something waits to be
    written, ``damage`` what is wrong with a history that nobody has acknowledged. ``past``: of
    models and tools, as read at the beginning and with each record.
    """

    def __init__(self, settings: Mapping[str, Any], robot: RobotDescription) -> None:
        self._settings, self._robot = settings, robot
        self._last: CorrectionRecord | None = None
        self._noted: queue.SimpleQueue[CorrectionRecord | str] = queue.SimpleQueue()
        self._waiting: deque[CorrectionRecord] = deque(maxlen=MOST_WAITING)
        self.fault = self.damage = ""
        self.past = Past(), Past()
        # what fails is told by the thread, which tries again
        with (
            suppress(RobocalError, OSError),
            open_history(settings, robot, owner=False)[1] as history,
        ):
            self._read_past(history)
        self._thread = threading.Thread(target=self._run, name="correction_log", daemon=True)
        self._thread.start()

    def note(self, record: CorrectionRecord) -> None:
        """Keep it, if more than its time has changed."""
        if self._last is None or replace(record, wall_ns=self._last.wall_ns) != self._last:
            self._last = record
            self._noted.put(record)

    def acknowledge(self, damage: str) -> None:
        """Write down that somebody knows of this damage, and of no other one."""
        self._noted.put(damage)

    def close(self) -> None:
        """Write what waits, if that is possible soon."""
        self._noted.put(END)
        self._thread.join(CLOSE_S)

    def _read_past(self, history: CalibrationHistory) -> None:
        self.past = history.past(THERMAL), history.past(TOOL)

    def _run(self) -> None:
        noted: CorrectionRecord | str = ""
        while noted != END:
            try:
                noted = self._noted.get(timeout=RETRY_S)
            except queue.Empty:
                noted = ""
            if isinstance(noted, CorrectionRecord):
                self._waiting.append(noted)
            self._try(noted)

    def _try(self, noted: CorrectionRecord | str) -> None:
        try:
            self.damage = history_notice(self._settings)
            if self.damage and noted == self.damage:
                acknowledge_history(self._settings, ACKNOWLEDGED_BY)
                self.damage = ""
            if self._waiting:
                with open_history(self._settings, self._robot, owner=False)[1] as history:
                    self._read_past(history)
                    while self._waiting:
                        history.note_correction(self._waiting[0])
                        self._waiting.popleft()
            self.fault = ""
        except (RobocalError, OSError) as error:
            count = len(self._waiting)
            self.fault = f"{count} changes wait to be written into the history: {error}"


class CorrectionReport:
    """Tells what a node's session does, until its ``log`` is closed.

    ``reference`` has the taught tool.
    """

    def __init__(self, node: RobotNode, session: CorrectionSession, reference: SerialArm) -> None:
        settings, robot, nominal = node.settings, node.robot, node.robot.arm
        self._session, self._now_ns = session, node.now_ns
        self._offsets = node.add_output(JointOffset, "~/correction", endpoints.RELIABLE)
        self._statuses = node.add_output(StatusMessage, "~/status", endpoints.LATCHED)
        serial, chosen = settings["serial"] or NO_SERIAL, settings["reference"]
        self._joint_names, self._chosen = list(nominal.joint_names), chosen
        self._own = {
            "robot": nominal.name,
            "serial": serial,
            "model_hash": nominal.model_hash,
            "taught_tool": transform_message(reference.T_flange_tool),
            "shadow": bool(settings["shadow"]),
        }
        self._subscribed, self._look_s = False, 0.0
        self._refusals = 0
        self._told: list[str] = []
        self._damage = ""  # as the last status told it
        self._told_s = 0.0
        is_nominal, T = chosen == NOMINAL_CHOICE, reference.T_flange_tool
        self._record = partial(
            CorrectionRecord,
            software=__version__,
            model_hash=nominal.model_hash,
            reference=NOMINAL if is_nominal else CALIBRATED,
            reference_source=(settings["robot"] or str(robot.path)) if is_nominal else chosen,
            reference_name=reference.name,
            reference_hash=reference.model_hash,
            taught_tool=(*T[:3, 3].tolist(), *frames.quat_xyzw(T).tolist()),
        )
        self.log = CorrectionLog(settings, robot)
        session.know_past(*self.log.past)

    def offset(self, cause: int, now_s: float) -> None:
        """Publish what is added to the taught joints, while somebody subscribes.

        Of a stream's the subscribers are those of the last `LOOK_S`.
        """
        if cause != STREAM or now_s >= self._look_s:
            self._look_s = now_s + LOOK_S
            self._subscribed = self._offsets.get_subscription_count() > 0
        if not self._subscribed:
            return
        offset = self._session.offset(now_s)
        message = JointOffset(
            header=header(self._now_ns(), ""),
            cause=cause,
            joint_names=self._joint_names,
            offset=doubles(offset.offset),
            model_revision=offset.revision or 0,
            tool_revision=offset.tool_revision or 0,
            withheld=doubles(offset.withheld),
            shadow=self._own["shadow"],
        )
        self._offsets.publish(message)

    def status(self, commanders: str, lease: str, *, only_news: bool = False) -> None:
        """Publish the status; a figure of the last command alone is no news.

        ``commanders``: who else commands; ``lease``: who holds one; empty where nobody does.
        """
        now = time.monotonic()
        self._session.know_past(*self.log.past)
        status = self._session.status(now)
        message = self._message(status)
        message.commanders, message.lease, message.history = commanders, lease, self.log.damage
        names = message.get_fields_and_field_types()
        told = [str(getattr(message, name)) for name in names if name not in FIGURES]
        if only_news and told == self._told and now - self._told_s < TELL_S - 0.5 * LOOK_S:
            return
        self._told, self._told_s, self._damage = told, now, message.history
        self.log.note(
            self._record(
                wall_ns=time.time_ns(),
                enabled=status.enabled,
                shadow=status.shadow,
                model_revision=0 if status.stale else status.revision or 0,
                tool_revision=status.tool_revision or 0,
            )
        )
        self._statuses.publish(message)

    def acknowledge(self) -> str:
        """What a person acknowledges now, in words; damage of the history is noted as known.

        One thing at a time: damage only where no mismatch waits, and where the status told it.
        """
        if self._session.status().mismatch:
            return Reason.START_MISMATCH.value
        if self._damage:
            self.log.acknowledge(self._damage)
        return self._damage or "nothing"

    def _message(self, status: CorrectionStatus) -> StatusMessage:
        return StatusMessage(
            header=header(self._now_ns(), ""),
            **self._own,
            **{name: getattr(status, name) for name in SAME},
            state=int(status.state),
            reason=status.in_words(),
            reference=f"{self._chosen}: {status.reference}",
            policy=getattr(StatusMessage, status.policy.name),
            model_revision=status.revision or 0,
            tool_revision=status.tool_revision or 0,
            model_waits=status.waiting_revision is not None,
            waiting_model_revision=status.waiting_revision or 0,
            tool_waits=status.waiting_tool is not None,
            waiting_tool_revision=status.waiting_tool or 0,
            joint_names=self._joint_names,
            withheld=doubles(status.withheld),
            withheld_most=doubles(status.withheld_most),
            withheld_mm=status.withheld_m * 1e3,
            withheld_most_mm=status.withheld_most_m * 1e3,
            tool_shift_mm=status.tcp_shift_m * 1e3,
            remaining_mm=status.remaining_m * 1e3,
            largest_offset=status.largest_shift,
            **_counts("refused", status.refused),
            **_counts("clamped", status.clamped),
            **_counts("passed", status.passed),
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
        waits = status.waiting_revision
        of_model = {
            status.stale: True,
            status.payload: True,
            f"model revision {status.revision}: {status.survey}": status.survey.beyond,
            f"model revision {waits} was refused, ~/take_over looks at it again": waits is not None,
            "enabled, but neither a model nor a tool was taken over": (
                status.enabled and status.revision is None and not status.new_tool
            ),
        }
        found = [words for words, is_so in of_model.items() if is_so]
        for warning in [*warnings, *found, self.log.damage, self.log.fault]:
            if warning:
                health.worsen(WARN, warning)
        health.values = _figures(status)
        return health


def _counts(what: str, counts: Mapping[Reason, int]) -> dict[str, Sequence[Any]]:
    return {f"{what}_reasons": [r.value for r in counts], what: list(counts.values())}


def _figures(status: CorrectionStatus) -> dict[str, object]:
    counts = {"refused": status.refused, "clamped": status.clamped, "passed": status.passed}
    figures: dict[str, object] = {
        "correction": status.in_words(),
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
