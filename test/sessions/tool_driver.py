"""A simulated robot that drives what a tool session asks for."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "core"))  # for beam_cell

from beam_cell import Q_NEAR, TAUGHT, make_cell

from robocal_ros.core.samples import JointSample
from robocal_ros.core.tool.beam_edges import InputRule
from robocal_ros.core.tool.crossed_model import RobotNoise
from robocal_ros.core.tool.edge_samples import EdgeSample
from robocal_ros.core.tool.measuring_plan import PlannedStep
from robocal_ros.sessions.events import MEASURE_TOOL, Command, Outcome
from robocal_ros.sessions.tool import ToolSession
from robocal_ros.sessions.tool_config import ToolConfig, rows_of
from robocal_ros.sim.beam_moves import Circle, Plunge
from robocal_ros.sim.beams import RoundTool, TrueInput, TrueNoise, bent
from robocal_ros.sim.tool_cell import ToolCell, joints_at

TRUTH = bent(TAUGHT, [0.003, -0.002, 0.002], [0.05, -0.04, 0.0])
NOISE = TrueNoise(3e-5, 1e-5)
START_NS = 1_700_000_000_000_000_000
RATE_HZ = 125.0


def noisy_cell() -> ToolCell:
    """A UR10 that repeats to 0.03 mm, with an input that is read every 2 ms."""
    source = TrueInput(latency_s=0.004, sample_period_s=0.002)
    return make_cell(exact=False, source=source, noise=NOISE)


def config_of(cell: ToolCell, **changes) -> ToolConfig:
    """Settings that fit a cell."""
    laser = cell.laser
    settings = {
        "points_m": rows_of(laser.points),
        "taught": rows_of(TAUGHT),
        "noise": RobotNoise(max(NOISE.step_m, 1e-7), max(NOISE.edge_m, 1e-7)),
        "input": InputRule(sample_period_s=cell.station.input.sample_period_s),
    }
    return ToolConfig(**(settings | changes))


def move_of(step: PlannedStep, start_s: float) -> Circle | Plunge:
    """A step as a motion of the flange."""
    if step.kind == "plunge":
        down = -step.R_base_laser[:, 2]
        return Plunge(step.T_base_flange, down, step.depth_m, step.speed_m_s, start_s)
    circle = Circle(
        T_base_centre=step.T_base_flange,
        R_base_laser=step.R_base_laser,
        radius=step.radius_m,
        period_s=2.0 * np.pi * step.radius_m / step.speed_m_s,
        start_rad=step.start_rad,
        direction=step.direction,
        ripple=0.02,
    )
    return circle.starting(start_s + circle.ramp_s)


@dataclass(eq=False)
class Driver:
    """Drives a session's runs; keeps all samples in the order in which they were given."""

    session: ToolSession
    cell: ToolCell
    tool: RoundTool
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))
    now_s: float = 0.0
    q: np.ndarray = field(default_factory=lambda: Q_NEAR.copy())
    samples: list = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    edit = staticmethod(lambda step, edges: edges)

    def measure(self, mode: str = "full", **arguments) -> Outcome:
        """A whole run; the outcome of its last step."""
        self.rest(0.1)
        self.command(Command(MEASURE_TOOL, {"mode": mode, **arguments}))
        while self.outcomes[-1].done and (step := self.session.awaited) is not None:
            self.drive(step)
            self.wait(step.number)
        return self.outcomes[-1]

    def command(self, command: Command) -> Outcome:
        """Give a command and carry it out."""
        self.session.submit(command)
        self.outcomes += self.session.step(wall_ns=self.wall_ns)
        return self.outcomes[-1]

    @property
    def wall_ns(self) -> int:
        return START_NS + len(self.outcomes) + len(self.samples)

    def rest(self, seconds: float) -> None:
        """Stand still."""
        count = int(seconds * RATE_HZ)
        self.play(self.now_s + np.arange(count) / RATE_HZ, np.tile(self.q, (count, 1)), [])

    def wait(self, number: int) -> None:
        """Rest until a step is taken, as a program that waits for the next one."""
        for _ in range(20):
            awaited = self.session.awaited
            if awaited is None or awaited.number != number:
                return
            self.rest(0.25)
        raise AssertionError(f"step {number} is never over")

    def drive(self, step: PlannedStep) -> None:
        """Go to a step's start, drive it, and rest."""
        move = move_of(step, self.now_s + 0.4)
        count = int(np.ceil((move.span[1] - move.span[0]) * RATE_HZ)) + 1
        time = move.span[0] + np.arange(count) / RATE_HZ
        q = joints_at(self.cell.arm, move(time), self.q)
        share = np.linspace(0.0, 1.0, 49)[:, None]
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        there = self.q + smooth * (q[0] - self.q)
        self.play(self.now_s + np.arange(49) / RATE_HZ, there, [])
        edges = self.cell.station.edges(self.tool, move, move.window, self.rng)
        self.play(time, q, self.edit(step, edges))
        self.rest(0.25)

    def play(self, time: np.ndarray, q: np.ndarray, edges: list) -> None:
        """Give samples in the order of their stamps."""
        given = [(t, JointSample(self.ns(t), self.cell.arm.joint_names, p)) for t, p in
                 zip(time.tolist(), q, strict=True)]  # fmt: skip
        given += [
            (e.time_s, EdgeSample(self.ns(e.time_s), "", e.beam, e.blocked, e.sigma_s))
            for e in edges
        ]
        for _, sample in sorted(given, key=lambda pair: pair[0]):
            self.give(sample)
        self.now_s = float(time[-1]) + 1.0 / RATE_HZ
        self.q = q[-1]

    def give(self, sample: JointSample | EdgeSample) -> None:
        """One sample, and what follows from it."""
        self.samples.append(sample)
        self.session.add(sample)
        if (command := self.session.recognised()) is not None:
            self.command(command)

    @staticmethod
    def ns(time_s: float) -> int:
        return START_NS + round(time_s * 1e9)
