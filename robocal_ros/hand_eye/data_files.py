"""The data sets of the hand-eye node as files: those that a call names, and those that it keeps."""

import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from robocal_msgs.srv import HandEyeFile
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.ground.files import made_folder_beside
from robocal_ros.hand_eye.data import MOST_POINTS, DataSet, data_set_begun
from robocal_ros.hand_eye.session import HandEyeSession
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import unused
from robocal_ros.ros.decision_services import answer
from robocal_ros.ros.endpoints import EndpointNode, trigger_text
from robocal_ros.session.events import LOAD, Command, Outcome

Ask = Callable[[Command], Awaitable[Outcome]]

KEPT, SUFFIX = "hand_eye", ".mcap"


class HandEyeFiles:
    """``~/load``, ``~/save`` and its Trigger twin; the data set of each calibration is kept.

    Parameters
    ----------
    ask : gives a command to the session and awaits its outcome.
    session : the one that runs; raises while the node is inactive.
    history : beside its file data sets are kept.
    """

    def __init__(
        self,
        node: EndpointNode,
        ask: Ask,
        session: Callable[[], HandEyeSession],
        history: CalibrationHistory,
    ) -> None:
        self._node, self._ask, self._session, self._history = node, ask, session, history
        self._saved: tuple[DataSet | None, frozenset[int]] = None, frozenset()
        self._fault: tuple[int, str] = 0, ""  # of the last calibration
        node.add_service(HandEyeFile, "~/load", self._load)
        node.add_service(HandEyeFile, "~/save", self._save)
        node.add_service(Trigger, "~/save_trigger", self._save_twin)

    async def begin(self, command: Command) -> Outcome:
        """Give a command that opens a data set; the answer tells of what was dropped unsaved."""
        before = self._session().data
        outcome = await self._ask(command)
        if not outcome.done or not (lost := self._unsaved(before)):
            return outcome
        words = f"{outcome.message}; {lost} samples were dropped that were not saved"
        return replace(outcome, message=words)

    async def calibrate(self, command: Command) -> Outcome:
        """Give a command that calibrates; the answer tells when its data set could not be kept."""
        outcome = await self._ask(command)
        number, fault = self._fault
        if not fault or number != outcome.calibration_id:
            return outcome
        return replace(outcome, message=f"{outcome.message}; {fault}")

    def keep(self, outcome: Outcome) -> None:
        """Keep the data set of a calibration under its id; one that cannot be kept is told of."""
        number = outcome.calibration_id
        self._fault = number, ""
        if not number:
            return
        try:
            self._write(unused(self._folder(), str(number), SUFFIX))
        except RobocalError as error:
            self._fault = number, f"its samples were not kept, call save: {error}"
            self._node.get_logger().error(f"calibration {number}: {self._fault[1]}")

    def _folder(self) -> Path:
        return made_folder_beside(self._history.path, KEPT)

    def _unsaved(self, data: DataSet | None) -> int:
        of, handles = self._saved
        samples = () if data is None else data.samples
        return len(set(samples) - (handles if data is of else set()))

    def _mark_saved(self) -> None:
        data = self._session().data
        self._saved = data, frozenset(() if data is None else data.samples)

    async def _load(self, request: Any, response: Any) -> Any:
        from robocal_ros.bags.hand_eye_bags import read_data_set

        path = _path(request)
        document = read_data_set(path, self._session().nominal)
        outcome = await self.begin(Command(LOAD, {"path": str(path), "set": document}))
        if outcome.done:
            self._mark_saved()
        response.samples = outcome.samples
        return answer(response, outcome)

    def _save(self, request: Any, response: Any) -> Any:
        response.samples, response.message = self._write(_path(request))
        response.success, response.status = True, int(Code.ACCEPT)
        return response

    def _save_twin(self, request: Any, response: Any) -> Any:
        try:
            _, words = self._write(unused(self._folder(), self._stem(), SUFFIX))
        except RobocalError as error:
            response.message = trigger_text(0, error.code, str(error))
            return response
        response.success, response.message = True, trigger_text(0, Code.ACCEPT, words)
        return response

    def _stem(self) -> str:
        """Sensor and time (UTC)."""
        frame = quote(self._session().config.sensor_frame, safe="")
        return f"{frame}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"

    def _write(self, path: Path) -> tuple[int, str]:
        """Write the open data set; how many samples it has, and what to say."""
        from robocal_ros.bags.hand_eye_bags import write_data_set

        session = self._session()
        document = session.document()
        topic = data_set_begun(document).topic
        write_data_set(path, document, topic, session.config.sensor_frame, session.nominal)
        self._mark_saved()
        rows = document["samples"]
        words = f"{len(rows)} samples saved in {path}"
        points = sum(len(row["values"]) for row in rows)
        if points > MOST_POINTS:
            words += f"; {points} points are too many to load (at most {MOST_POINTS})"
        return len(rows), words


def _path(request: Any) -> Path:
    """The whole path: the caller does not see the node's working folder."""
    if not request.path:
        raise InputError("path is empty: name the file")
    try:
        return Path(request.path).expanduser().absolute()
    except RuntimeError as error:
        raise InputError(f"{error}: name the whole path", file=request.path) from error
