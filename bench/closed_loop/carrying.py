# SPDX-License-Identifier: Apache-2.0
"""What the maintenance asks, carried out by the sessions themselves; their answers to it."""

from collections.abc import Callable

from bench.closed_loop.words import tool_answer
from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.maintenance import robot_interface as ask
from robocal_ros.maintenance.robot_interface import DriverAnswer
from robocal_ros.maintenance.session import MaintenanceSession
from robocal_ros.motion.plan import JointPlan
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome
from robocal_ros.tool.driving import ToolDriver
from robocal_ros.tool.session import ToolSession


class Carrier:
    """Carries out requests.

    Parameters
    ----------
    send : gives a plan to the robot's controller.
    to_thermal : gives a command to the thermal session; `thermal_ended` takes its outcome.
    to_tool : gives a command to the tool session and returns its outcome; `tool_ended` takes the
        last outcome of a run.
    to_fixture : gives a command to the fixture session; `fixture_ended` takes its outcome.
    """

    def __init__(
        self,
        maintenance: MaintenanceSession,
        tool: ToolSession,
        driver: ToolDriver,
        send: Callable[[JointPlan], None],
        to_thermal: Callable[[Command], None],
        to_tool: Callable[[Command], Outcome | None],
        to_fixture: Callable[[Command], None] = lambda command: None,
    ) -> None:
        self._maintenance, self._tool, self._driver = maintenance, tool, driver
        self._send, self._to_thermal, self._to_tool = send, to_thermal, to_tool
        self._to_fixture = to_fixture
        self._ending: dict[str, int] = {}  # request that a thermal or fixture command answers
        self._measuring = 0  # request that the open run answers

    def carry_out(self, request: ask.DriverRequest, now_s: float) -> None:
        """Do what is asked, now or from now on."""
        match request:
            case ask.Move() | ask.Stop():
                self._send(request.plan)
            case ask.BeginCycle():
                self._cycle(events.BEGIN_CYCLE, request)
            case ask.EndCycle():
                self._cycle(events.END_CYCLE, request)
            case ask.BeginFixture():
                self._ending[events.START] = request.number
                self._to_fixture(Command(events.START))
            case ask.MeasureFixture():
                self._ending[events.CALIBRATE] = request.number
                self._to_fixture(Command(events.CALIBRATE))
            case ask.Arm():
                self._answer(request.number, lambda: self._driver.arm(now_s))
            case ask.Disarm():
                self._answer(request.number, lambda: self._driver.disarm("maintenance", now_s))
            case ask.Measure():
                self._measure(request)
            case ask.CancelMeasure() if self._tool.run is not None:
                reason = {"code": int(Code.CONFLICT), "reason": "cancelled"}
                self._to_tool(Command(events.BREAK_OFF, reason))

    def thermal_ended(self, outcome: Outcome) -> None:
        """Tell the maintenance, where it waits for this."""
        if (number := self._ending.pop(outcome.command.name, 0)) != 0:
            poses = (outcome.document or {}).get("poses", {})
            answer = DriverAnswer(
                outcome.status,
                outcome.message,
                outcome.calibration_id,
                tuple(poses.get("missing", ())),
                visited=poses.get("visited"),
            )
            self._maintenance.answered(number, answer)

    def fixture_ended(self, outcome: Outcome) -> None:
        """The same, of the fixture."""
        if (number := self._ending.pop(outcome.command.name, 0)) != 0:
            answer = DriverAnswer(outcome.status, outcome.message, outcome.calibration_id)
            self._maintenance.answered(number, answer)

    def tool_ended(self, outcome: Outcome) -> None:
        """Tell the maintenance how its run ended, where it waits for one."""
        number, self._measuring = self._measuring, 0
        if number:
            self._maintenance.answered(number, tool_answer(outcome))

    def _cycle(self, name: str, request: ask.BeginCycle | ask.EndCycle) -> None:
        self._ending[name] = request.number
        self._to_thermal(Command(name, {"cycle_id": request.cycle_id}))

    def _answer(self, number: int, act: Callable[[], None]) -> None:
        try:
            act()
            self._maintenance.answered(number, DriverAnswer(Code.ACCEPT))
        except RobocalError as error:
            self._maintenance.answered(number, DriverAnswer(error.code, str(error)))

    def _measure(self, request: ask.Measure) -> None:
        try:
            self._driver.require_ready()
        except RobocalError as error:
            self._maintenance.answered(request.number, DriverAnswer(error.code, str(error)))
            return
        arguments = {"mode": request.mode, "cycle_id": request.cycle_id, "by": "maintenance"}
        begun = self._to_tool(Command(events.MEASURE_TOOL, arguments))
        if begun is not None and begun.done and not begun.repeated:
            self._measuring = request.number
        elif begun is not None:
            self._maintenance.answered(request.number, tool_answer(begun))
