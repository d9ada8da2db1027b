# SPDX-License-Identifier: Apache-2.0
"""A hand-eye session that is driven as by its node, with a bag in which all of it is written."""

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from session_events import EventLog

from robocal_ros import __version__
from robocal_ros.bags.bags import BagMessage, BagReader, BagWriter
from robocal_ros.ground.samples import JOINTS
from robocal_ros.hand_eye.data import COMPRESSED, IMAGE, PROFILE, TARGET_POSE, TRACKER_POINT
from robocal_ros.hand_eye.session import (
    HandEyeConfig,
    HandEyeSession,
    configuration,
    take_hand_eye_message,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome

EVENTS = "/hand_eye_node/session_events"
SERIAL, BY = "SIM-UR10-1", "cell controller"
INPUTS = (JOINTS, PROFILE, TARGET_POSE, IMAGE, COMPRESSED, TRACKER_POINT)
TOPICS = {kind: f"/{kind}" for kind in INPUTS}
KINDS = {topic: kind for kind, topic in TOPICS.items()}

Asked = tuple[int, Command]


class _Recorder:
    def __init__(self, bag: BagWriter, session: HandEyeSession, topics: dict[str, str]) -> None:
        self._bag, self._session, self._types = bag, session, topics
        self._events = EventLog(bag, EVENTS)
        self._now_ns = 0
        self._shown: tuple[int, int] | None = None

    def play(self, messages: Iterable[BagMessage], asked: Sequence[Asked]) -> None:
        """Give the messages to the session, and each command when its time (ns) has come."""
        waiting = list(asked)
        for recorded in messages:
            while waiting and waiting[0][0] <= recorded.log_time_ns:
                self.command(waiting.pop(0)[1])
            self._give(recorded)

    def command(self, command: Command) -> Outcome:
        """Give a command to the session, and record what came of it."""
        self._session.submit(command)
        (outcome,) = self._session.step(wall_ns=self._now_ns)
        self._events.write(outcome.command, outcome, self._now_ns)
        self._show_in_force()
        return outcome

    def _give(self, recorded: BagMessage) -> None:
        self._now_ns = recorded.log_time_ns
        if self._shown is None:
            self._show_in_force()
        topic, message = recorded.topic, recorded.message
        self._bag.write(topic, self._types[topic], message, self._now_ns)
        take_hand_eye_message(self._session, KINDS.get(topic, ""), message)
        if (command := self._session.recognised()) is not None:
            self.command(command)

    def _show_in_force(self) -> None:
        shown = self._session.in_force.revision, self._session.current.thermal.revision
        if shown != self._shown:
            self._shown = shown
            self._events.write(configuration(self._session, TOPICS), None, self._now_ns)


def record_session(
    inputs: Path, path: Path, config: HandEyeConfig, asked: Sequence[Asked], latched: str
) -> Outcome:
    """Play the bag ``inputs`` to a session, calibrate and accept; all of it is in ``path``.

    Parameters
    ----------
    asked : commands, each with the time (ns) at which it is given, in order.
    latched : topic of the inputs that late subscribers get.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open(SERIAL, state_dir=Path(folder)) as history,
        BagReader(inputs) as reader,
        BagWriter(path, latched=[EVENTS, latched]) as bag,
    ):
        session = HandEyeSession(load_robot("ur10"), history, config, __version__)
        types = {topic: info.msgtype for topic, info in reader.info.topics.items()}
        recorder = _Recorder(bag, session, types)
        recorder.play(reader.messages(), asked)
        found = recorder.command(Command(events.CALIBRATE, {"method": "", "handles": []}))
        decision: dict[str, Any] = {"id": found.calibration_id, "by": BY, "reason": "its verdict"}
        recorder.command(Command(events.ACCEPT, decision))
        return found
