"""Carries out what the maintenance session asks: calls of other nodes, trajectories."""

from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.action import ActionClient
from rclpy.task import Future
from robocal_msgs.action import MeasureTool
from robocal_msgs.srv import BeginCycle, EndCycle
from std_srvs.srv import SetBool

from robocal_ros.ground.errors import Code
from robocal_ros.maintenance import requests as asked
from robocal_ros.maintenance.requests import DriverAnswer
from robocal_ros.motion.driver import MotionDriver, guarded
from robocal_ros.ros.endpoints import EndpointNode
from robocal_ros.tool.services import ANSWERS, MODES

MODE_OF = {name: number for number, name in MODES.items()}
WORDS_OF = {number: words for words, number in ANSWERS.items()}
Answered = Callable[[int, DriverAnswer], None]


class MaintenanceDriver:
    """Clients of ``thermal_node`` and ``tcf_node``, and of the robot's controller.

    Parameters
    ----------
    motion : sends motions to the controller.
    answered : takes the number of a request and what came of it.
    moves : told just before a motion goes out: later, the robot would be ahead of its plan.
    """

    def __init__(
        self,
        node: EndpointNode,
        motion: MotionDriver,
        answered: Answered,
        moves: Callable[[], None],
    ) -> None:
        self._node, self._motion, self._answered, self._moves = node, motion, answered, moves
        self._begin = node.add_client(BeginCycle, "thermal_node/begin_cycle")
        self._end = node.add_client(EndCycle, "thermal_node/end_cycle")
        self._arm = node.add_client(SetBool, "tcf_node/arm")
        self._measure = ActionClient(node, MeasureTool, "tcf_node/measure")
        self._goals: dict[int, Any] = {}  # handles; None until the goal is accepted
        self._cancelled: set[int] = set()

    def close(self) -> None:
        """Take the actions' clients down."""
        self._measure.destroy()
        self._motion.close()

    def carry_out(self, request: asked.DriverRequest) -> None:
        """Do it; the answer comes later."""
        number = request.number
        match request:
            case asked.Move(plan=plan):
                self._moves()
                self._motion.send(plan, stop=False)
            case asked.Stop(plan=plan):
                self._motion.send(plan, stop=True)
            case asked.HardStop(why=why):
                self._motion.hard_stop(why)
            case asked.BeginCycle(cycle_id=name):
                self._call(self._begin, BeginCycle.Request(cycle_id=name), number, _status)
            case asked.EndCycle(cycle_id=name):
                self._call(self._end, EndCycle.Request(cycle_id=name), number, _cycle)
            case asked.Arm():
                self._call(self._arm, SetBool.Request(data=True), number, _done)
            case asked.Disarm():
                self._call(self._arm, SetBool.Request(data=False), number, _done)
            case asked.Measure(mode=mode, cycle_id=name):
                self._begin_measure(number, mode, name)
            case asked.CancelMeasure():
                self._cancel_measures()

    def _call(
        self, client: Any, request: Any, number: int, read: Callable[[Any], DriverAnswer]
    ) -> None:
        if not client.service_is_ready():
            words = f"{client.srv_name} is not there: start its node"
            self._answered(number, DriverAnswer(Code.CONFLICT, words, absent=True))
            return
        client.call_async(request).add_done_callback(
            guarded(self._node, lambda future: self._answered(number, read(future.result())))
        )

    def _begin_measure(self, number: int, mode: str, cycle_id: str) -> None:
        if not self._measure.server_is_ready():
            words = "the action tcf_node/measure is not there: start its node"
            self._answered(number, DriverAnswer(Code.CONFLICT, words))
            return
        self._goals[number] = None
        goal = MeasureTool.Goal(mode=MODE_OF[mode], cycle_id=cycle_id, only_in_gap=True)
        self._measure.send_goal_async(goal).add_done_callback(
            guarded(self._node, lambda future: self._accepted(number, future))
        )

    def _accepted(self, number: int, future: Future) -> None:
        handle: Any = future.result()
        if not handle.accepted:
            self._goals.pop(number, None)
            self._answered(number, DriverAnswer(Code.CONFLICT, "tcf_node rejected the goal"))
            return
        self._goals[number] = handle
        if number in self._cancelled:
            handle.cancel_goal_async()
        handle.get_result_async().add_done_callback(
            guarded(self._node, lambda ended: self._measured(number, ended))
        )

    def _measured(self, number: int, ended: Future) -> None:
        self._goals.pop(number, None)
        self._cancelled.discard(number)
        result: Any = ended.result().result
        found_mm = [result.deviation_mm, result.sigma_mm]
        self._answered(
            number,
            DriverAnswer(
                _code(result.status),
                result.message,
                result.candidate_id,
                has_result=result.success and bool(np.isfinite(found_mm).all()),
                answer=WORDS_OF.get(result.answer, ""),
                deviation_mm=result.deviation_mm,
                sigma_mm=result.sigma_mm,
                left_plan=result.left_plan,
            ),
        )

    def _cancel_measures(self) -> None:
        for number, handle in self._goals.items():
            self._cancelled.add(number)
            if handle is not None:
                handle.cancel_goal_async()


def _code(status: int) -> Code:
    """A status of another node; one that this version does not know is a refusal."""
    return Code(status) if status in set(Code) - {Code.NONE} else Code.BAD_INPUT


def _done(response: Any) -> DriverAnswer:
    return DriverAnswer(Code.ACCEPT if response.success else Code.CONFLICT, response.message)


def _status(response: Any) -> DriverAnswer:
    return DriverAnswer(_code(response.status), response.message)


def _cycle(response: Any) -> DriverAnswer:
    return DriverAnswer(
        _code(response.status),
        response.message,
        response.candidate_id,
        tuple(response.missing),
        visited=response.visited if response.success else None,
    )
