# SPDX-License-Identifier: Apache-2.0
"""A simulated robot that follows what it is sent, under a tool session's driver."""

from dataclasses import replace

import numpy as np
from tool_driver import START_NS, TAUGHT, TRUTH, config_of, noisy_cell

from robocal_ros.cell_sim.beams import RoundTool, joints_at
from robocal_ros.cell_sim.trajectory_controller import CYCLE_S, JointMotion
from robocal_ros.ground.samples import JointSample
from robocal_ros.motion.cell import DrivingConfig, Housing, ToolBody
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import Gap
from robocal_ros.session.events import MEASURE_TOOL, TOOL_STEP, Command
from robocal_ros.tool.driving import DrivePhase, ToolDriver
from robocal_ros.tool.edges import EdgeSample
from robocal_ros.tool.run import rows_of
from robocal_ros.tool.session import ToolSession

PERIOD_S = 0.008
MANDREL_RADIUS_M = 0.004
STALE_S = 0.5  # of the heartbeat
LAG_S = 0.02  # of the controller behind its trajectory
AHEAD_S = 0.2
HOUSING = Housing(clear_radius_m=0.06, top_m=0.03, floor_m=-0.12, retract_m=0.05)


class AheadMotion(JointMotion):
    """Computes cycles together, which costs less; what is sent meanwhile undoes those after it."""

    ahead_s = 0.0

    def now(self, now_s: float) -> np.ndarray:
        """Where the joints (n,) are."""
        if now_s > self.ahead_s:
            self.pass_to(now_s - LAG_S)
            self.ahead_s = now_s + AHEAD_S
            self.joints(np.array([self.ahead_s]))
        # As `at`, which costs thrice as much for a single time.
        t = now_s / CYCLE_S
        number = int(t * (1.0 + 1e-12))
        self._run(number + 1)
        number = min(max(number, self._begin), self._count - 1)
        s = min(max(t - number, 0.0), 1.0)
        row = number - self._begin
        (q0, v0), (q1, v1) = self._rows[row : row + 2, :2]
        way, v0, v1 = q1 - q0, v0 * CYCLE_S, v1 * CYCLE_S
        c2, c3 = 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way
        return q0 + s * (v0 + s * (c2 + s * c3))


class Robot:
    """Follows plans with a lag; its beams see the true tool on the true robot.

    ``true`` is the arm as it is; one that drifts is another one than the nodes know.
    """

    def __init__(self, history, tool=TRUTH, mandrel=None, **changes):
        self.cell = noisy_cell()
        arm = self.true = self.cell.arm
        known = {}
        if mandrel is not None:
            known = {"mandrel": rows_of(mandrel), "mandrel_radius_m": MANDREL_RADIUS_M}
        self.session = ToolSession(arm, history, config_of(self.cell, **known), "test")
        config = DrivingConfig(HOUSING, 0.1, 0.008, 0.05, **changes)
        self.mandrel = None
        if mandrel is not None:
            config = replace(config, mandrel=ToolBody(mandrel, 0.08, 0.008, 0.05, "mandrel"))
            self.mandrel = RoundTool.cylinder(mandrel, MANDREL_RADIUS_M)
        self.gap, self.beating = Gap(STALE_S), True
        self.driving = config
        self.driver = ToolDriver(self.session, config, self.send, self.ask, self.closed)
        self.tool = RoundTool.cylinder(tool, 0.0025)
        self.rng = np.random.default_rng(3)
        above = self.cell.pose(TAUGHT, 0.0)
        above[:3, 3] += 0.08 * self.cell.up
        self.q = joints_at(arm, above[None], self.cell.q_near)[0]
        self.now_s = 0.0
        self.motion = AheadMotion(self.q)
        self.coming: list[tuple[float, JointPlan]] = []
        self.sent: list[tuple[float, JointPlan]] = []
        self.outcomes = []
        self.edges: list[EdgeSample] = []
        self.path: list[np.ndarray] = []
        self.silent = False
        self.deaf = False  # no edge comes
        self.offset = np.zeros(arm.n)
        self.speed, self.shift_s = 1.0, 0.0  # of the controller's clock, and what it is ahead
        self.tells = False  # the controller tells its speed
        self.lost, self.stops = 0, 0  # stops that do not arrive; that were sent

    def closed(self, now_s: float) -> str:
        self.gap.look(now_s)
        return self.gap.closed(now_s)

    def send(self, plan: JointPlan, stop: bool = False) -> None:
        """The controller gets it with a lag, and goes on from where it is and moves by then."""
        self.sent.append((self.now_s, plan))
        self.stops += stop
        if stop and self.stops <= self.lost:
            return
        self.coming.append((self.now_s + LAG_S, plan))

    def receive(self, at_s: float, plan: JointPlan) -> None:
        time_s, q, qd = plan.points()
        at_s += self.shift_s
        self.motion.follow(at_s, time_s + at_s, q, qd)
        motion, end_s = self.motion, at_s + plan.duration_s
        moved = [
            edge
            for body in filter(None, (self.tool, self.mandrel))
            for edge in self.cell.station.edges(
                body, lambda t: self.true.fk(motion.joints(t)), (at_s, end_s), self.rng
            )
        ]
        self.edges = [
            EdgeSample(self.ns(e.time_s), "", e.beam, e.blocked, e.sigma_s)
            for e in sorted(moved, key=lambda edge: edge.time_s)
        ]
        if self.deaf:
            self.edges.clear()

    def ask(self, command: Command) -> None:
        self.session.submit(command)
        self.outcomes += self.session.step(wall_ns=START_NS + len(self.outcomes))
        outcome = self.outcomes[-1]
        if self.session.run is None and not outcome.done:
            self.driver.run_failed(outcome.message, self.now_s)

    def measure(self, mode="full") -> None:
        self.driver.require_ready()
        self.ask(Command(MEASURE_TOOL, {"mode": mode}))

    @staticmethod
    def ns(time_s: float) -> int:
        return START_NS + round(time_s * 1e9)

    def run(self, seconds: float, until=lambda: False) -> None:
        """Let time pass."""
        for _ in range(round(seconds / PERIOD_S)):
            self.step()
            if until():
                return

    def step(self) -> None:
        self.now_s += PERIOD_S
        self.shift_s += (self.speed - 1.0) * PERIOD_S
        if self.tells:
            self.driver.robot.scaled(self.speed, self.now_s)
        if self.beating:
            self.gap.heard(True, self.gap.count(self.now_s), self.now_s)
        while self.coming and self.coming[0][0] <= self.now_s:
            self.receive(*self.coming.pop(0))
        here_s = self.now_s + self.shift_s
        self.q = self.motion.now(here_s)
        self.path.append(self.q.copy())
        while self.edges and self.edges[0].stamp_ns <= self.ns(here_s):
            edge = self.edges.pop(0)
            ago_ns = round((self.ns(here_s) - edge.stamp_ns) / self.speed)
            self.driver.beam(edge.blocked)
            self.session.add(replace(edge, stamp_ns=self.ns(self.now_s) - ago_ns))
        if self.silent:
            self.driver.tick(self.now_s)
            return
        q = self.q + self.offset
        self.driver.reading(self.now_s, q, self.now_s)
        self.session.add(JointSample(self.ns(self.now_s), self.cell.arm.joint_names, q))
        command = self.session.recognised()
        if command is not None and (
            command.name != TOOL_STEP or not self.driver.on_its_way(self.now_s)
        ):
            self.ask(command)

    def at_rest(self) -> bool:
        """Whether all is over."""
        return not self.driver.armed and self.driver.phase is DrivePhase.IDLE

    def stands_still(self, since_s: float) -> bool:
        count = round((self.now_s - since_s) / PERIOD_S)
        return bool(np.ptp(np.array(self.path[-count:]), axis=0).max() < 1e-9)
