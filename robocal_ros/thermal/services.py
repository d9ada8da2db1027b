"""The services of the thermal node: each call becomes a command, its outcome the answer."""

from typing import Any

from robocal_msgs.srv import BeginCycle, CaptureReference, EndCycle, Identify
from std_srvs.srv import Trigger

from robocal_ros.ground.proposals import THERMAL
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.ros.decision_services import AddService, Ask, DecisionServices, answer, twin
from robocal_ros.session.events import BEGIN_CYCLE, CAPTURE_REFERENCE, END_CYCLE, IDENTIFY, Command


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
        for name in (BEGIN_CYCLE, END_CYCLE, CAPTURE_REFERENCE, IDENTIFY):
            add(Trigger, f"~/{name}_trigger", twin(ask, name, {}))
        DecisionServices(add, ask, history, THERMAL)

    async def _capture_reference(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(CAPTURE_REFERENCE, {}))
        response.samples = outcome.samples
        return answer(response, outcome)

    async def _identify(self, request: Any, response: Any) -> Any:
        arguments = {
            "cycle_id": request.cycle_id,
            "samples": request.samples,
            "method": request.method,
        }
        outcome = await self._ask(Command(IDENTIFY, arguments))
        response.candidate_id = outcome.calibration_id
        answer(response, outcome)
        response.success = outcome.calibration_id > 0
        return response

    async def _begin_cycle(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(BEGIN_CYCLE, {"cycle_id": request.cycle_id}))
        response.cycle_id = str(outcome.command.arguments["cycle_id"])
        return answer(response, outcome)

    async def _end_cycle(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(END_CYCLE, {"cycle_id": request.cycle_id}))
        response.cycle_id = str(outcome.command.arguments["cycle_id"])
        response.candidate_id = outcome.calibration_id
        known = outcome.calibration_id > 0
        poses = self._history.document(outcome.calibration_id).get("poses", {}) if known else {}
        response.visited = poses.get("visited", 0)
        response.missing = poses.get("missing", [])
        answer(response, outcome)
        response.success = known
        return response
