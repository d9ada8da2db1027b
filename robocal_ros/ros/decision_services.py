"""Accept, reject, roll back and list, with their Trigger twins: the same at every node."""

import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from robocal_msgs.srv import Decide, ListCalibrations
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.ros.conversions import summary_message
from robocal_ros.ros.endpoints import EndpointNode, trigger_text
from robocal_ros.session.decisions import NEWEST, ONLY
from robocal_ros.session.events import (
    ACCEPT,
    REJECT,
    ROLLBACK,
    Command,
    Outcome,
)

LIST_LIMIT = 50
TWIN = "trigger"

AddService = Callable[[type, str, Callable[[Any, Any], Any]], None]
Ask = Callable[[Command], Awaitable[Outcome]]


class DecisionServices:
    """Services about the calibrations of one kind.

    Parameters
    ----------
    add : creates a service.
    ask : gives a command to the session and awaits its outcome.
    """

    def __init__(self, add: AddService, ask: Ask, history: CalibrationHistory, kind: str) -> None:
        self._ask, self._history, self._kind = ask, history, kind
        add(ListCalibrations, "~/list", self._list)
        add(Trigger, "~/list_trigger", self._list_twin)
        for name in (ACCEPT, REJECT, ROLLBACK):
            add(Decide, f"~/{name}", self._decide(name))
        add(Trigger, "~/accept_trigger", twin(ask, ACCEPT, {"choose": ONLY}))
        add(Trigger, "~/reject_trigger", self._reject_twin)
        add(Trigger, "~/rollback_trigger", twin(ask, ROLLBACK, {"previous": True}))

    def _decide(self, name: str) -> Callable[[Any, Any], Any]:
        async def decide(request: Any, response: Any) -> Any:
            if name != ROLLBACK and request.id == 0:
                raise InputError(f"{name} needs the id of a calibration; look at the list")
            arguments = {"id": request.id, "by": request.by, "reason": request.reason}
            outcome = await self._ask(Command(name, arguments))
            response.revision = outcome.revision
            return answer(response, outcome)

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

    async def _reject_twin(self, request: Any, response: Any) -> Any:
        """Reject all that is pending: a PLC's way out when the accept twin may not choose."""
        reject_one = twin(self._ask, REJECT, {"choose": NEWEST})
        await reject_one(request, response)
        while response.success and self._history.pending(self._kind):
            await reject_one(request, response)
        return response


def twin(ask: Ask, name: str, arguments: Mapping[str, Any]) -> Callable[..., Any]:
    """A Trigger that gives one command; its message is `trigger_text`."""

    async def trigger(request: Any, response: Any) -> Any:
        try:
            outcome = await ask(Command(name, {"by": TWIN, **arguments}))
        except RobocalError as error:  # deactivated meanwhile
            response.message = trigger_text(0, error.code, str(error))
            return response
        response.success = outcome.done
        response.message = trigger_text(outcome.calibration_id, outcome.status, outcome.message)
        return response

    return trigger


def answer(response: Any, outcome: Outcome) -> Any:
    """Put an outcome into a response with ``success``, ``message`` and ``status``."""
    response.success = outcome.done
    response.message = outcome.message
    response.status = int(outcome.status)
    return response


# ---- an action server whose goals are ended from any callback -----------------------------------


RESULT_KEPT_S = 60  # for callers that ask late


class DeferredActionServer(ActionServer):
    """A goal begins with ``goal.execute()`` and goes on until `end`: no coroutine waits for it.

    ``callbacks`` go to rclpy; ``handle_accepted_callback`` takes the place of an execute callback.
    """

    def __init__(self, node: EndpointNode, kind: Any, name: str, **callbacks: Any) -> None:
        self._host = node
        unused = kind.Result
        super().__init__(node, kind, name, unused, result_timeout=RESULT_KEPT_S, **callbacks)

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable[..., Any] | None
    ) -> None:
        """Let rclpy run a callback whose return ends the goal; without one the goal goes on."""
        if execute_callback is not None and self._host.executor is not None:
            super().notify_execute(goal_handle, execute_callback)

    def end(self, goal: ServerGoalHandle, status: int, result: Any) -> None:
        """End a goal with a status of `GoalStatus`; one that its caller did not cancel, aborted.

        Without an executor, when the process ends, nobody is told: the action goes anyway.
        """

        def finish(goal: ServerGoalHandle) -> Any:
            if status == GoalStatus.STATUS_SUCCEEDED:
                goal.succeed()
            elif status == GoalStatus.STATUS_CANCELED and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
            return result

        self.notify_execute(goal, finish)
