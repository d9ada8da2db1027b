# SPDX-License-Identifier: Apache-2.0
"""A simulated robot that drives what a tool session asks for."""

import numpy as np
from beam_cell import make_cell

from bench.measured_runs import TAUGHT, RobotProgram, Sample, ToolCell
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, TrueNoise, bent
from robocal_ros.session.events import MEASURE_TOOL, Command, Outcome
from robocal_ros.tool.crossed_model import RobotNoise
from robocal_ros.tool.edges import InputRule
from robocal_ros.tool.run import ToolConfig, rows_of
from robocal_ros.tool.session import ToolSession

TRUTH = bent(TAUGHT, [0.003, -0.002, 0.001], [0.025, 0.0375, 0.0])  # 80 mm above its tip
NOISE = TrueNoise(3e-5, 1e-5)
START_NS = 1_700_000_000_000_000_000


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


class Driver:
    """Drives a session's runs; keeps all samples in the order in which they were given."""

    def __init__(self, session: ToolSession | None, cell: ToolCell, tool: RoundTool) -> None:
        self.session = session
        self.program = RobotProgram(cell, tool, np.random.default_rng(1), START_NS)
        self.samples: list[Sample] = []
        self.outcomes: list[Outcome] = []

    @property
    def cell(self) -> ToolCell:
        return self.program.cell

    def measure(self, mode: str = "full", **arguments) -> Outcome:
        """A whole run; the outcome of its last step."""
        self.rest(0.1)
        self.command(Command(MEASURE_TOOL, {"mode": mode, **arguments}))
        while self.outcomes[-1].done and (step := self.session.awaited) is not None:
            self.play(self.program.drive(step))
            self.wait(step.number)
        return self.outcomes[-1]

    def command(self, command: Command) -> Outcome:
        """Give a command and carry it out."""
        self.session.submit(command)
        self.outcomes += self.session.step(wall_ns=START_NS + len(self.samples))
        return self.outcomes[-1]

    def rest(self, seconds: float) -> None:
        """Stand still."""
        self.play(self.program.rest(seconds))

    def wait(self, number: int) -> None:
        """Rest until a step is taken, as a program that waits for the next one."""
        for _ in range(20):
            awaited = self.session.awaited
            if awaited is None or awaited.number != number:
                return
            self.rest(0.25)
        raise AssertionError(f"step {number} is never over")

    def play(self, samples: list[Sample]) -> None:
        """Give samples."""
        for sample in samples:
            self.give(sample)

    def give(self, sample: Sample) -> None:
        """One sample, and what follows from it."""
        self.samples.append(sample)
        self.session.add(sample)
        if (command := self.session.recognised()) is not None:
            self.command(command)
