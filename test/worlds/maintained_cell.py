# SPDX-License-Identifier: Apache-2.0
"""A whole simulated cell in one process: thermal and tool session, robot, beams, sphere sensor.

What the maintenance asks is carried out by calling the sessions themselves, as a bench does.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from driven_robot import PERIOD_S, AheadMotion, Robot
from maintenance_cell import BEAT_S, HOME, Shelf
from shift import BALL, NOISE_M, T_SENSOR_BASE, warmed
from tool_driver import TAUGHT

from bench.closed_loop.carrying import Carrier
from robocal_ros.ground.samples import JointSample, PointSample
from robocal_ros.maintenance.accuracy import MaintenanceConfig
from robocal_ros.maintenance.session import MaintenanceSession
from robocal_ros.motion.cell import joint_way
from robocal_ros.session.events import CAPTURE_REFERENCE, Command, Outcome
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import ThermalSession

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
        self,
        history: Any,
        tool: np.ndarray = TAUGHT,
        mandrel: np.ndarray | None = None,
        *,
        from_s: float = 0.0,
        **changes: Any,
    ) -> None:
        super().__init__(history, tool, mandrel)
        self.now_s, self.shift_s = from_s, -from_s  # the controller's clock stands between gaps
        self.history = history
        self.arm = self.cell.arm
        self.motion, self.q = AheadMotion(HOME), HOME.copy()
        settings: dict[str, Any] = {
            "home": HOME,
            "poses": POSES,
            "T_flange_tool": TAUGHT,
            "driving": self.driving,
            "T_base_laser": self.cell.laser.T_base_laser,
            "tolerance_m": TOLERANCE_M,
            "correction_silent_s": 0.0,  # nothing is produced
        }
        config = MaintenanceConfig(**(settings | changes))
        self.maintenance = MaintenanceSession(self.arm, history, config, Shelf())
        self.thermal = ThermalSession(
            self.arm, history, ThermalConfig(tolerance_m=TOLERANCE_M), "test"
        )
        self.carrier = Carrier(
            self.maintenance,
            self.session,
            self.driver,
            self.send,
            self._to_thermal,
            self._to_tool,
        )
        self.beating = False  # the gap's beat below takes its place
        # Of twenty full measurements one leaves it in doubt what has changed (95 %): not this one.
        self.rng = np.random.default_rng(4)
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
        self.gap.look(self.now_s)
        still = np.max(np.abs(self.q - before)) < 1e-9
        self.rests_s = self.rests_s + PERIOD_S if still else 0.0
        self.thermal.add(JointSample(self.ns(self.now_s), self.arm.joint_names, self.q))
        if self.tells:
            self.maintenance.robot.watch.scaled(self.speed, self.now_s)
        if self.now_s >= self.beat_s + BEAT_S:
            self.beat_s = self.now_s
            beat = self.maintenance.beat(self.now_s)
            self.gap.saw(beat, self.now_s)
            self.gap.heard(self.is_open, beat, self.now_s)
            self.maintenance.gap(self.is_open, beat, self.now_s)
        if self.maintenance.running and self.now_s >= self.told_s + TELLS_S:
            self._tell_drift()
        if self.rests_s > 0.4 and self.now_s >= self.sensed_s + SENSE_S:
            self._sense()
        for outcome in self.thermal.advance(wall_ns=self.wall_ns):
            if not outcome.outside:
                self.last_thermal = outcome
                self.carrier.thermal_ended(outcome)
        if self.outcomes and self.session.run is None:
            self.carrier.tool_ended(self.outcomes[-1])
        self.maintenance.reading(self.now_s, self.q, self.now_s)
        self.steps += 1
        if self.steps % TICKS == 0:
            for request in self.maintenance.tick(self.now_s, self.wall_ns):
                self.carrier.carry_out(request, self.now_s)

    def _to_thermal(self, command: Command) -> None:
        self.thermal.submit(command, self.wall_ns)

    def _to_tool(self, command: Command) -> Outcome:
        self.ask(command)
        return self.outcomes[-1]

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
        self.shift_s -= hours * 3600.0
        self.true = warmed(self.arm, kelvin)
        self.run(0.5)

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

    def maintain(
        self, cycle_id: str, gap_s: float, meanwhile: Callable[[], None] = lambda: None
    ) -> Any:
        """A whole cycle, with what is done at each step of it; its result."""

        def over() -> bool:
            meanwhile()
            return self.maintenance.running is None

        begun_s = self.now_s
        self.maintenance.run(cycle_id, gap_s, self.now_s, self.wall_ns)
        self.run(gap_s, until=over)
        assert self.now_s <= begun_s + gap_s
        assert np.max(np.abs(self.q - HOME)) < 1e-3
        assert not self.driver.armed
        return self.maintenance.result(cycle_id)

    def _tell_drift(self) -> None:
        self.told_s = self.now_s
        self.maintenance.drift(self.thermal.accuracy(self.wall_ns), self.now_s)

    def accuracy(self) -> Any:
        """What the line reads."""
        self._tell_drift()
        return self.maintenance.accuracy(self.now_s, self.wall_ns)
