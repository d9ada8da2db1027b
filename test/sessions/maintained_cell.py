"""A whole simulated cell in one process: thermal and tool session, robot, beams, sphere sensor.

What the maintenance asks is carried out by calling the sessions themselves, as a bench does.
"""

from typing import Any

import numpy as np
from driven_robot import HOUSING, PERIOD_S, Robot
from maintenance_cell import BEAT_S, HOME, Shelf
from shift import BALL, NOISE_M, T_SENSOR_BASE, warmed
from tool_driver import TAUGHT

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import RobocalError
from robocal_ros.core.motion.travel import joint_way
from robocal_ros.core.samples import JointSample, PointSample
from robocal_ros.sessions.driving_config import DrivingConfig
from robocal_ros.sessions.events import (
    BEGIN_CYCLE,
    BREAK_OFF,
    CAPTURE_REFERENCE,
    END_CYCLE,
    MEASURE_TOOL,
    Command,
    Outcome,
)
from robocal_ros.sessions.maintenance import MaintenanceConfig, MaintenanceSession
from robocal_ros.sessions.maintenance import requests as ask
from robocal_ros.sessions.maintenance.accuracy import Drift
from robocal_ros.sessions.maintenance.requests import Answer
from robocal_ros.sessions.thermal import ThermalConfig, ThermalSession
from robocal_ros.sim.joint_motion import JointMotion

TICKS = 2  # of the robot, between two looks of the maintenance
OFFSETS_DEG = [
    [25.0, 10, 0, 0, 0, 0],
    [35.0, 10, 15, -10, 20, 15],
    [45.0, -5, 20, 15, 30, 40],
    [55.0, 15, -10, 25, 10, -30],
    [40.0, 20, 10, -25, -20, -50],
    [20.0, 5, 20, 10, 15, 60],
]
POSES = HOME + np.radians(OFFSETS_DEG)
SENSE_S = 0.1
TELLS_S = 1.0  # the thermal node says so often how accurate the robot is
TOLERANCE_M = 7e-4  # after one cycle the drift is not known better


class MaintainedCell(Robot):
    """Everything around one maintenance session.

    One robot drifts for the sphere and for the beams; ``from_s``: a cell that goes on where another
    one on the same history ended.
    """

    def __init__(
        self, history: Any, tool: np.ndarray = TAUGHT, *, from_s: float = 0.0, **changes: Any
    ) -> None:
        super().__init__(history, tool)
        self.now_s = from_s
        self.history = history
        self.arm = self.cell.arm
        self.motion, self.q = JointMotion(HOME), HOME.copy()
        driving = DrivingConfig(HOUSING, 0.1, 0.008, 0.05)
        settings: dict[str, Any] = {
            "home": HOME,
            "poses": POSES,
            "T_flange_tool": TAUGHT,
            "driving": driving,
            "T_base_laser": self.cell.laser.T_base_laser,
            "tolerance_m": TOLERANCE_M,
        }
        config = MaintenanceConfig(**(settings | changes))
        self.maintenance = MaintenanceSession(self.arm, history, config, Shelf())
        self.thermal = ThermalSession(
            self.arm, history, ThermalConfig(tolerance_m=TOLERANCE_M), "test"
        )
        self.pending: list[int] = []  # requests that the thermal session carries out
        self.measuring = 0
        self.is_open, self.beat_s, self.sensed_s = True, -np.inf, -np.inf
        self.told_s = -np.inf
        self.steps, self.rests_s = 0, 0.0
        self.sphere = np.random.default_rng(4)
        self.sensor_off_m = np.zeros(3)

    @property
    def wall_ns(self) -> int:
        return self.ns(self.now_s)

    # ---- time -----------------------------------------------------------------------------------

    def step(self) -> None:
        before = self.q
        super().step()
        still = np.max(np.abs(self.q - before)) < 1e-9
        self.rests_s = self.rests_s + PERIOD_S if still else 0.0
        self.thermal.add(JointSample(self.ns(self.now_s), self.arm.joint_names, self.q))
        if self.now_s >= self.beat_s + BEAT_S:
            self.beat_s = self.now_s
            self.maintenance.gap(self.is_open, self.now_s)
        if self.maintenance.running and self.now_s >= self.told_s + TELLS_S:
            self._tell_drift()
        if self.rests_s > 0.4 and self.now_s >= self.sensed_s + SENSE_S:
            self._sense()
        for outcome in self.thermal.advance(wall_ns=self.wall_ns):
            if not outcome.outside:
                self._thermal_done(outcome)
        self._tool_done()
        self.maintenance.reading(self.now_s, self.q, self.now_s)
        self.steps += 1
        if self.steps % TICKS == 0:
            for request in self.maintenance.tick(self.now_s, self.wall_ns):
                self.carry_out(request)

    def _sense(self) -> None:
        self.sensed_s = self.now_s
        ball = (T_SENSOR_BASE @ self.true.fk(self.q) @ BALL)[:3]
        measured = ball + NOISE_M * self.sphere.normal(size=3) + self.sensor_off_m
        at_s = self.now_s - 0.12
        self.thermal.add(PointSample(self.ns(at_s), "sensor", "ball", measured))
        self.maintenance.measured(at_s)

    def production(self, hours: float, kelvin: float) -> None:
        """The robot works, and warms up; the gap is closed meanwhile."""
        self.now_s += hours * 3600.0
        self.true = warmed(self.arm, kelvin)
        self.run(0.5)

    # ---- what the maintenance asks --------------------------------------------------------------

    def carry_out(self, request: ask.Request) -> None:
        match request:
            case ask.Move(plan=plan) | ask.Stop(plan=plan):
                self.send(plan)
            case ask.BeginCycle(cycle_id=name):
                self._ask_thermal(request.number, BEGIN_CYCLE, {"cycle_id": name})
            case ask.EndCycle(cycle_id=name):
                self._ask_thermal(request.number, END_CYCLE, {"cycle_id": name})
            case ask.Arm():
                self._answer(request.number, lambda: self.driver.arm(self.now_s))
            case ask.Disarm():
                self._answer(request.number, lambda: self.driver.disarm("asked", self.now_s))
            case ask.Measure():
                self._measure(request)
            case ask.CancelMeasure():
                self.ask(Command(BREAK_OFF, {"reason": "cancelled"}))

    def _ask_thermal(self, number: int, name: str, arguments: dict[str, str]) -> None:
        self.pending.append(number)
        self.thermal.submit(Command(name, arguments), self.ns(self.now_s))

    def _thermal_done(self, outcome: Outcome) -> None:
        self.last_thermal = outcome
        if self.pending:
            answer = Answer(outcome.status, outcome.message, outcome.calibration_id)
            self.maintenance.answered(self.pending.pop(0), answer)

    def _answer(self, number: int, act: Any) -> None:
        try:
            act()
        except RobocalError as error:
            self.maintenance.answered(number, Answer(error.code, str(error)))
        else:
            self.maintenance.answered(number, Answer(Code.ACCEPT))

    def _measure(self, request: ask.Measure) -> None:
        try:
            self.driver.require_ready()
        except RobocalError as error:
            self.maintenance.answered(request.number, Answer(error.code, str(error)))
            return
        self.measuring = request.number
        self.ask(Command(MEASURE_TOOL, {"mode": request.mode, "cycle_id": request.cycle_id}))

    def _tool_done(self) -> None:
        if not self.measuring or self.session.run is not None:
            return
        last, number, self.measuring = self.outcomes[-1], self.measuring, 0
        document = last.document or {}
        change, sigma = document.get("change", {}), document.get("sigma_mm", 0.0)
        answer = Answer(
            last.status,
            last.message,
            last.calibration_id,
            has_result=last.document is not None,
            answer=document.get("answer", ""),
            deviation_mm=float(change.get("tip_mm", 0.0)),
            sigma_mm=float(np.max(sigma)),
        )
        self.maintenance.answered(number, answer)

    # ---- the PLC, and a person ------------------------------------------------------------------

    def capture_reference(self) -> None:
        """Drive the cold robot through the poses and home."""
        self.run(0.5)
        for end in [*POSES, HOME]:
            plan = joint_way(self.maintenance.ways.cell, self.q, end)
            self.send(plan)
            self.run(plan.duration_s + 1.0)
        self.thermal.submit(Command(CAPTURE_REFERENCE), self.ns(self.now_s))
        self.run(0.5)
        assert self.last_thermal.done, self.last_thermal.message

    def maintain(self, cycle_id: str, gap_s: float) -> Any:
        """A whole cycle; its result."""
        begun_s = self.now_s
        self.maintenance.run(cycle_id, gap_s, self.now_s, self.wall_ns)
        self.run(gap_s, until=lambda: self.maintenance.running is None)
        assert self.now_s <= begun_s + gap_s
        assert np.max(np.abs(self.q - HOME)) < 1e-3
        assert not self.driver.armed
        return self.maintenance.result(cycle_id)

    def _tell_drift(self) -> None:
        self.told_s = self.now_s
        found = self.thermal.accuracy(self.ns(self.now_s))
        drift = Drift(found.level, found.reason, found.error, found.due_in_s)
        self.maintenance.drift(drift, self.now_s)

    def accuracy(self) -> Any:
        """What the line reads."""
        self._tell_drift()
        return self.maintenance.accuracy(self.now_s, self.wall_ns)
