"""The services of the thermal node: each call becomes a command, its outcome the answer."""

import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from robocal_msgs.srv import (
    BeginCycle,
    CaptureReference,
    Decide,
    EndCycle,
    Identify,
    ListCalibrations,
)
from std_srvs.srv import Trigger

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import InputError, RobocalError
from robocal_ros.nodes.conversions import summary_message, trigger_text
from robocal_ros.sessions.decisions import NEWEST, ONLY
from robocal_ros.sessions.events import (
    ACCEPT,
    BEGIN_CYCLE,
    CAPTURE_REFERENCE,
    END_CYCLE,
    IDENTIFY,
    REJECT,
    ROLLBACK,
    Command,
    Outcome,
)
from robocal_ros.storage.calibrations import CalibrationHistory

LIST_LIMIT = 50
TWIN = "trigger"

AddService = Callable[[type, str, Callable[[Any, Any], Any]], None]
Ask = Callable[[Command], Awaitable[Outcome]]


class ThermalServices:
    """Services and their Trigger twins.

    Parameters
    ----------
    add : creates a service.
    ask : gives a command to the session and awaits its outcome.
    """

    def __init__(self, add: AddService, ask: Ask, history: CalibrationHistory) -> None:
        self._ask = ask
        self._history = history
        add(CaptureReference, "~/capture_reference", self._capture_reference)
        add(Identify, "~/identify", self._identify)
        add(BeginCycle, "~/begin_cycle", self._begin_cycle)
        add(EndCycle, "~/end_cycle", self._end_cycle)
        add(ListCalibrations, "~/list", self._list)
        add(Trigger, "~/begin_cycle_trigger", self._twin(BEGIN_CYCLE, {}))
        add(Trigger, "~/end_cycle_trigger", self._twin(END_CYCLE, {}))
        add(Trigger, "~/capture_reference_trigger", self._twin(CAPTURE_REFERENCE, {}))
        add(Trigger, "~/identify_trigger", self._twin(IDENTIFY, {}))
        add(Trigger, "~/list_trigger", self._list_twin)
        for name in (ACCEPT, REJECT, ROLLBACK):
            add(Decide, f"~/{name}", self._decide(name))
        add(Trigger, "~/accept_trigger", self._twin(ACCEPT, {"choose": ONLY}))
        add(Trigger, "~/reject_trigger", self._reject_twin)
        add(Trigger, "~/rollback_trigger", self._twin(ROLLBACK, {"previous": True}))

    async def _capture_reference(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(CAPTURE_REFERENCE, {}))
        response.samples = outcome.samples
        return _answer(response, outcome)

    async def _identify(self, request: Any, response: Any) -> Any:
        arguments = {
            "cycle_id": request.cycle_id,
            "samples": request.samples,
            "method": request.method,
        }
        outcome = await self._ask(Command(IDENTIFY, arguments))
        response.candidate_id = outcome.calibration_id
        _answer(response, outcome)
        response.success = outcome.calibration_id > 0
        return response

    async def _begin_cycle(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(BEGIN_CYCLE, {"cycle_id": request.cycle_id}))
        response.cycle_id = str(outcome.command.arguments["cycle_id"])
        return _answer(response, outcome)

    async def _end_cycle(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(END_CYCLE, {"cycle_id": request.cycle_id}))
        response.cycle_id = str(outcome.command.arguments["cycle_id"])
        response.candidate_id = outcome.calibration_id
        known = outcome.calibration_id > 0
        poses = self._history.document(outcome.calibration_id).get("poses", {}) if known else {}
        response.visited = poses.get("visited", 0)
        response.missing = poses.get("missing", [])
        _answer(response, outcome)
        response.success = known
        return response

    def _decide(self, name: str) -> Callable[[Any, Any], Any]:
        async def decide(request: Any, response: Any) -> Any:
            if name != ROLLBACK and request.id == 0:
                raise InputError(f"{name} needs the id of a calibration; look at the list")
            arguments = {"id": request.id, "by": request.by, "reason": request.reason}
            outcome = await self._ask(Command(name, arguments))
            response.revision = outcome.revision
            return _answer(response, outcome)

        return decide

    def _list(self, request: Any, response: Any) -> Any:
        entries = self._history.list(request.limit or LIST_LIMIT)
        response.calibrations = [summary_message(entry) for entry in entries]
        response.success, response.status = True, int(Code.ACCEPT)
        return response

    def _list_twin(self, request: Any, response: Any) -> Any:
        lines = [
            {
                "id": entry.id,
                "revision": entry.revision,
                "kind": entry.kind,
                "state": entry.state.value,
                "code": entry.code.name,
                "cycle_id": entry.cycle_id,
                "candidate_rms_mm": entry.candidate_rms_mm,
            }
            for entry in self._history.list(LIST_LIMIT)
        ]
        response.success, response.message = True, json.dumps(lines, allow_nan=False)
        return response

    def _twin(self, name: str, arguments: Mapping[str, Any]) -> Callable[..., Any]:
        async def trigger(request: Any, response: Any) -> Any:
            try:
                outcome = await self._ask(Command(name, {"by": TWIN, **arguments}))
            except RobocalError as error:  # deactivated meanwhile
                response.message = trigger_text(0, error.code, str(error))
                return response
            response.success = outcome.done
            response.message = trigger_text(outcome.calibration_id, outcome.status, outcome.message)
            return response

        return trigger

    async def _reject_twin(self, request: Any, response: Any) -> Any:
        """Reject all that is pending: a PLC's way out when the accept twin may not choose."""
        reject_one = self._twin(REJECT, {"choose": NEWEST})
        await reject_one(request, response)
        while response.success and self._history.pending():
            await reject_one(request, response)
        return response


def _answer(response: Any, outcome: Outcome) -> Any:
    response.success = outcome.done
    response.message = outcome.message
    response.status = int(outcome.status)
    return response
