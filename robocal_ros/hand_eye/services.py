"""The services of the hand-eye node: each call becomes a command to the session."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from robocal_msgs.srv import (
    CalibrateHandEye,
    CaptureHandEye,
    RemoveHandEye,
    StartHandEye,
)
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.hand_eye.data_files import Ask, HandEyeFiles
from robocal_ros.hand_eye.outputs import MOUNTS, TARGETS
from robocal_ros.hand_eye.plan import HandEyePlan
from robocal_ros.hand_eye.session import HandEyeSession
from robocal_ros.hand_eye.settings import start_arguments
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.ros.conversions import transform_message
from robocal_ros.ros.decision_services import answer, twin
from robocal_ros.ros.endpoints import EndpointNode, trigger_text
from robocal_ros.session.events import CALIBRATE, CAPTURE, REMOVE, START, Command, Outcome


class HandEyeServices:
    """Data set, captures, calibration, with their Trigger twins.

    Parameters
    ----------
    ask : gives a command to the session and awaits its outcome.
    files : asks where data sets begin or are calibrated.
    session : the one that runs; raises while the node is inactive.
    """

    def __init__(
        self,
        node: EndpointNode,
        settings: Mapping[str, Any],
        ask: Ask,
        files: HandEyeFiles,
        session: Callable[[], HandEyeSession],
        history: CalibrationHistory,
    ) -> None:
        self._node, self._settings, self._ask = node, settings, ask
        self._files, self._session, self._history = files, session, history
        add = node.add_service
        add(StartHandEye, "~/start", self._start)
        add(Trigger, "~/start_trigger", self._start_twin)
        add(CaptureHandEye, "~/capture", self._capture)
        add(Trigger, "~/capture_trigger", self._capture_twin)
        add(Trigger, "~/result_trigger", self._result_twin)
        add(RemoveHandEye, "~/remove", self._remove)
        add(Trigger, "~/remove_trigger", twin(ask, REMOVE, {"handle": 0}))
        add(CalibrateHandEye, "~/calibrate", self._calibrate)
        add(Trigger, "~/calibrate_trigger", twin(files.calibrate, CALIBRATE, {}))
        HandEyePlan(node, settings, session, history)

    async def _start(self, request: Any, response: Any) -> Any:
        kind, mount = _named(TARGETS, request.target), _named(MOUNTS, request.mount)
        given = kind, request.target_file, request.feature, request.method, mount
        arguments = start_arguments(self._settings, *given)
        return answer(response, await self._files.begin(Command(START, arguments)))

    async def _start_twin(self, request: Any, response: Any) -> Any:
        try:
            arguments = start_arguments(self._settings)
        except RobocalError as error:
            response.message = trigger_text(0, error.code, str(error))
            return response
        return await twin(self._files.begin, START, arguments)(request, response)

    async def _capture_now(self, arguments: Mapping[str, Any]) -> Outcome:
        """A capture takes nothing that was received before its call."""
        self._node.take_waiting()
        return await self._ask(Command(CAPTURE, arguments))

    async def _capture(self, request: Any, response: Any) -> Any:
        outcome = await self._capture_now({"mark": request.mark})
        response.handle = _handle(outcome)
        return answer(response, outcome)

    async def _capture_twin(self, request: Any, response: Any) -> Any:
        try:
            outcome = await self._capture_now({})
        except RobocalError as error:  # deactivated meanwhile
            response.message = trigger_text(0, error.code, str(error))
            return response
        response.success = outcome.done
        response.message = trigger_text(_handle(outcome), outcome.status, outcome.message)
        return response

    def _result_twin(self, request: Any, response: Any) -> Any:
        """How the newest capture ended; while it waits: no success, with NONE."""
        data = self._session().data
        if data is None or not data.captures:
            response.message = trigger_text(0, Code.CONFLICT, "nothing was captured yet")
            return response
        last = data.captures[max(data.captures)]
        response.success = last.code is Code.ACCEPT
        response.message = trigger_text(last.handle, last.code, last.reason)
        return response

    async def _remove(self, request: Any, response: Any) -> Any:
        if request.handle == 0:
            raise InputError("remove needs the handle of a capture; look at the status")
        outcome = await self._ask(Command(REMOVE, {"handle": request.handle}))
        response.samples = outcome.samples
        return answer(response, outcome)

    async def _calibrate(self, request: Any, response: Any) -> Any:
        arguments = {"method": request.method, "handles": list(request.handles)}
        outcome = await self._files.calibrate(Command(CALIBRATE, arguments))
        document = outcome.document or {}
        response.candidate_id, response.samples = outcome.calibration_id, outcome.samples
        response.expected_error_mm = response.residual_mm = -1.0
        response.unobservable = list(document.get("unobservable", ()))
        if outcome.calibration_id:
            model = self._history.model(outcome.calibration_id)
            response.sensor = transform_message(np.array(model["T_parent_sensor"]))
            if document["covariance"] is not None:
                response.covariance = np.ravel(document["covariance"]).tolist()
            if document["working_error_mm"] is not None:
                response.expected_error_mm = float(document["working_error_mm"])
            response.residual_mm = float(document["residual_mm"]["rms"])
            because = document["rejected_because"]
            response.rejected = [f"{name}: {why}" for name, why in because.items()]
        return answer(response, outcome)


def _handle(outcome: Outcome) -> int:
    return int(outcome.command.arguments["handle"]) if outcome.done else 0


def _named(names: Mapping[int, str], number: int) -> str:
    """The name of a constant of HandEyeStatus; empty for 0."""
    if number and number not in names:
        known = ", ".join(f"{n} ({name})" for n, name in names.items())
        raise InputError(f"{number} is none of {known}")
    return names.get(number, "")
