"""From which size on the check of the tool reports a fault with the right code. Simulated.

Only what the check can see; each seed is another cell, commissioned once, then checked with one
fault after the other. A check takes a second, where a whole cycle takes half a minute.
"""

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from bench.closed_loop import setting
from bench.closed_loop.faults import POWER, RIGHT, SWEEP, Trial, named_size, smallest_with_power
from bench.closed_loop.plant import Plant
from bench.closed_loop.shift import ROBOT
from bench.closed_loop.suite import Suite
from bench.tables import Goal, Table
from robocal_ros.core.codes import Code
from robocal_ros.sessions.tool_results import QUICK, REFERENCE
from robocal_ros.sim.cell import SimulatedCell
from robocal_ros.sim.cell_faults import SIZES, Fault
from robocal_ros.sim.kr150_cell import kr150_cell
from robocal_ros.storage.calibrations import CalibrationHistory
from robocal_ros.storage.robots import load_robot

SEEN_BY_CHECK: tuple[Fault, ...] = (
    "collision",
    "wrong_tool",
    "beam_dirty",
    "input_latency",
    "clock_jump",
    "lost_messages",
)
SETTLES_S = 0.5
SEEDS = range(41, 51)


@dataclass(frozen=True)
class Checked:
    """What a check said of a fault."""

    trial: Trial
    code: Code

    @property
    def right(self) -> bool:
        """Whether it is the code of this fault."""
        return self.code is RIGHT[self.trial.fault]


def checked(seed: int, sizes: Mapping[Fault, Sequence[float]] = SWEEP) -> Iterator[Checked]:
    """Every fault that a check can see, at all of its sizes, in the cell of a seed."""
    nominal = load_robot(ROBOT)
    cell = SimulatedCell(kr150_cell(nominal, seed, points=0))
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open(
            setting.SERIAL, model_hash=nominal.model_hash, state_dir=Path(folder)
        ) as history,
    ):
        plant = Plant(cell, None)
        suite = Suite(nominal, history, setting.laser_of(cell.plan), plant.send)
        plant.suite = suite
        plant.listen(plant.now_s + 1.0)
        plant.measure_tool(suite, REFERENCE, "healthy")
        plant.home_from_station(suite)
        for fault in SEEN_BY_CHECK:
            for size in sizes.get(fault, ()):
                cell.set_fault(fault, size)
                said = plant.measure_tool(suite, QUICK, f"{fault} {size}")
                yield Checked(Trial(fault, size, seed), said.status)
                cell.set_fault("none")
                plant.listen(plant.now_s + SETTLES_S)
                plant.home_from_station(suite)


def power_table(found: Sequence[Checked]) -> Table:
    """How often the right code came, by size."""
    seeds = len({one.trial.seed for one in found})
    table = Table(
        "closed_loop_checks",
        f"Checks of the tool with a fault, in {seeds} cells: how often the right code came",
        ("fault", "right code", "size: right of all", "smallest with 90 %", "at the usual size, %",
         "goal"),
        "Simulated: a reference of the healthy tool, the fault, one quick check. The smallest size "
        "from which on the right code comes in 90 % of the cells or more.",
    )  # fmt: skip
    for fault in dict.fromkeys(one.trial.fault for one in found):
        own = [one for one in found if one.trial.fault == fault]
        by_size: dict[float, list[Checked]] = {}
        for one in own:
            by_size.setdefault(one.trial.size, []).append(one)
        words = ", ".join(
            f"{named_size(cells[0].trial)}: {sum(c.right for c in cells)}/{len(cells)}"
            for cells in by_size.values()
        )
        smallest = smallest_with_power((one.trial.size, one.right) for one in own)
        usual = [c.right for c in by_size.get(SIZES[fault][0], own)]
        share = 100.0 * sum(usual) / len(usual)
        table.add(
            fault, RIGHT[fault].name, words,
            "none" if smallest is None else named_size(Trial(fault, smallest, 0)),
            share, Goal(share, 100.0 * POWER, at_least=True),
        )  # fmt: skip
    return table


def _all_checked(seed: int) -> list[Checked]:
    return list(checked(seed))


def tables() -> Sequence[Table]:
    """All checks, on all cores."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        return [power_table([one for cell in pool.map(_all_checked, SEEDS) for one in cell])]
