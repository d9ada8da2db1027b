"""The services and the action of the tool node: each call becomes a command to the session."""

from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import ToolFrame, ToolStep
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.proposals import TOOL
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.ros.decision_services import DecisionServices
from robocal_ros.ros.endpoints import EndpointNode, trigger_text
from robocal_ros.session.events import Outcome
from robocal_ros.tool.results import FULL, QUICK, REFERENCE, WITNESS, WITNESS_REFERENCE

MODES = {
    MeasureTool.Goal.FULL: FULL,
    MeasureTool.Goal.QUICK: QUICK,
    MeasureTool.Goal.REFERENCE: REFERENCE,
    MeasureTool.Goal.WITNESS: WITNESS,
    MeasureTool.Goal.WITNESS_REFERENCE: WITNESS_REFERENCE,
}
ANSWERS = {
    "pass": MeasureTool.Result.PASS,
    "recalibrate": MeasureTool.Result.RECALIBRATE,
    "cannot tell": MeasureTool.Result.CANNOT_TELL,
}


class Runner:
    """What the services need of the node: begin a run, break it off, tell how the last one ended.

    Parameters
    ----------
    begin : takes mode, cycle id and caller; the outcome of the call.
    ended : awaits the outcome of the open run.
    cancel : breaks the open run off.
    last : the outcome of the last run; None before any.
    frame : the measured tool of an outcome.
    step : the step that is awaited.
    is_open : whether a run is.
    deaf : why the node would drive on in a closed gap; empty: it would not.
    """

    def __init__(
        self,
        begin: Callable[[str, str, str], Awaitable[Outcome]],
        ended: Callable[[], Awaitable[Outcome]],
        cancel: Callable[[str], Awaitable[Outcome]],
        last: Callable[[], Outcome | None],
        frame: Callable[[Outcome], ToolFrame],
        step: Callable[[], ToolStep],
        is_open: Callable[[], bool],
        deaf: Callable[[], str],
    ) -> None:
        self.begin, self.ended, self.cancel = begin, ended, cancel
        self.last, self.frame, self.step, self.is_open = last, frame, step, is_open
        self.deaf = deaf


class TcfServices:
    """``~/measure`` as action, the same as Triggers, and the decisions."""

    def __init__(
        self, node: EndpointNode, runner: Runner, ask: Any, history: CalibrationHistory
    ) -> None:
        self._runner, self._node = runner, node
        self._goal: ServerGoalHandle | None = None
        add = node.add_service
        add(Trigger, "~/measure_trigger", self._starter(FULL))
        add(Trigger, "~/quick_check_trigger", self._starter(QUICK))
        add(Trigger, "~/measure_reference_trigger", self._starter(REFERENCE))
        add(Trigger, "~/cancel_trigger", self._cancel_twin)
        add(Trigger, "~/result_trigger", self._result)
        DecisionServices(add, ask, history, TOOL)
        self._server = ActionServer(
            node,
            MeasureTool,
            "~/measure",
            self._execute,
            cancel_callback=self._cancel,
            callback_group=node.async_group,
        )

    def close(self) -> None:
        """Take the action down."""
        self._server.destroy()

    def feedback(self, step: ToolStep, state: str) -> None:
        """Tell a waiting caller what goes on."""
        if self._goal is not None and self._goal.is_active:
            self._goal.publish_feedback(MeasureTool.Feedback(step=step, state=state))

    # ---- action ---------------------------------------------------------------------------------

    async def _execute(self, goal: ServerGoalHandle) -> Any:
        request = goal.request
        try:
            if not self._node.is_active:
                return self._end(goal, Code.CONFLICT, f"the node is {self._node.state}")
            if request.mode not in MODES:
                words = f"mode {request.mode} is none of {', '.join(MODES.values())}"
                return self._end(goal, Code.BAD_INPUT, words)
            if request.only_in_gap and (why := self._runner.deaf()):
                return self._end(goal, Code.CONFLICT, f"{self._node.get_name()}: {why}")
            outcome = await self._runner.begin(MODES[request.mode], request.cycle_id, "action")
            if outcome.done and not outcome.repeated:
                self._goal = goal
                self.feedback(self._runner.step(), outcome.message)
                outcome = await self._runner.ended()
        except RobocalError as error:
            return self._end(goal, error.code, str(error))
        finally:
            if self._goal is goal:
                self._goal = None
        return self._end(goal, outcome.status, outcome.message, outcome)

    def _end(
        self, goal: ServerGoalHandle, code: Code, message: str, outcome: Outcome | None = None
    ) -> Any:
        document = None if outcome is None else outcome.document
        result = MeasureTool.Result(success=document is not None, message=message, status=int(code))
        result.left_plan = outcome is not None and outcome.left_plan
        if outcome is not None and document is not None:
            result.candidate_id = outcome.calibration_id
            _fill(result, document)
            if outcome.calibration_id:
                result.tool = self._runner.frame(outcome)
        if goal.is_cancel_requested:
            goal.canceled()
        elif result.success:
            goal.succeed()
        else:
            goal.abort()
        return result

    async def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        if goal is not self._goal:
            return CancelResponse.REJECT
        await self._runner.cancel("cancelled by the caller")
        return CancelResponse.ACCEPT

    # ---- Triggers -------------------------------------------------------------------------------

    def _starter(self, mode: str) -> Callable[[Any, Any], Any]:
        async def start(request: Any, response: Any) -> Any:
            try:
                outcome = await self._runner.begin(mode, "", "trigger")
            except RobocalError as error:
                response.message = trigger_text(0, error.code, str(error))
                return response
            return _trigger(response, outcome)

        return start

    async def _cancel_twin(self, request: Any, response: Any) -> Any:
        response.success = self._runner.is_open()
        outcome = await self._runner.cancel("cancelled by a Trigger")
        response.message = trigger_text(0, outcome.status, outcome.message)
        return response

    def _result(self, request: Any, response: Any) -> Any:
        outcome = self._runner.last()
        if outcome is None:
            code, words = Code.CONFLICT, "no run has ended yet"
            if self._runner.is_open():  # no code that ends a run, for a PLC that asks until then
                code, words = Code.NONE, f"run {self._runner.step().run} is open"
            response.message = trigger_text(0, code, words)
            return response
        return _trigger(response, outcome)


def _trigger(response: Any, outcome: Outcome) -> Any:
    response.success = outcome.done
    response.message = trigger_text(outcome.calibration_id, outcome.status, outcome.message)
    return response


def _fill(result: Any, document: Any) -> None:
    change = document.get("change", {})
    sigma = document["sigma_mm"]
    result.answer = ANSWERS.get(document.get("answer", ""), MeasureTool.Result.NONE)
    result.deviation_mm = float(change.get("tip_mm", 0.0))
    result.deviation_deg = float(change.get("axis_deg", 0.0))
    result.sigma_mm = float(np.max(sigma))
