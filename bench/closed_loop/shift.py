# SPDX-License-Identifier: Apache-2.0
"""Shifts of the cell, with and without its suite, and what came of them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bench.closed_loop.earlier import taught
from bench.closed_loop.plant import (
    AT_WORK,
    LISTEN_S,
    PASS_S,
    PROGRAMME,
    REST_S,
    GapReport,
    Plant,
    equipped,
)
from bench.closed_loop.suite import Record, unrecorded
from robocal_ros.cell_sim.cell import SimulatedCell, kr150_cell
from robocal_ros.cell_sim.faults import Fault
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.accuracy import Accuracy
from robocal_ros.thermal.drift_following import Prior

Array = NDArray[np.float64]

HOUR_S = 3600.0
BEGINS_H = 8.0  # o'clock
ROBOT = "kr150_r3100"


@dataclass(frozen=True)
class Incident:
    """Something goes wrong at a time since the shift's begin; ``size`` in the fault's own unit."""

    at_s: float
    fault: Fault
    size: float = 0.0


@dataclass(frozen=True)
class ShiftPlan:
    """A shift.

    Attributes
    ----------
    work_s : production without gaps before the shift, after the commissioning of the cold robot.
    first_s, every_s, gap_s : a gap of this length begins then, and each so often.
    pauses : from and to, in which nothing is produced.
    incidents : in their order; one within a gap happens at its end.
    prior : what drift to expect: the default, or as earlier shifts of this robot have taught.
    points : of a sphere's cloud; 0: centres alone.
    fixture : there is one, which is measured in each gap.
    """

    hours: float
    work_s: float = 0.0
    first_s: float = 0.0
    every_s: float = 300.0
    gap_s: float = 90.0
    pauses: tuple[tuple[float, float], ...] = ()
    incidents: tuple[Incident, ...] = ()
    points: int = 2000
    prior: Prior = "default"
    fixture: bool = False

    @property
    def cycles(self) -> int:
        """Number of gaps."""
        return round(self.hours * HOUR_S / self.every_s)

    @property
    def begins_s(self) -> list[float]:
        """When the gaps begin."""
        return [self.first_s + i * self.every_s for i in range(self.cycles)]


def at(hour: int, minute: int = 0) -> float:
    """Seconds since the shift's begin at a time of the day."""
    return round((hour + minute / 60.0 - BEGINS_H) * HOUR_S)


GOLDEN = ShiftPlan(
    hours=8.0,
    gap_s=120.0,
    pauses=((at(12), at(12, 30)),),
    incidents=(
        Incident(at(10, 40), "collision", 2.0),
        Incident(at(13, 15), "sensor_knocked", 1.0),
    ),
)
MIDWORK = replace(GOLDEN, first_s=90.0)  # so both incidents fall halfway between two gaps


@dataclass(frozen=True, eq=False)
class Judged:
    """A pass of the programme as it was, by the truth.

    Attributes
    ----------
    time_s : of its end, since the shift's begin; ``cycle`` : the gap before it, from 1; 0: none.
    error : (k, 3) of the tip at the working poses, base, m; None where it was not produced.
    accuracy : what the line read then; None without a suite.
    """

    time_s: float
    cycle: int
    error: Array | None
    accuracy: Accuracy | None


@dataclass
class ShiftRecord:
    """What came of a shift.

    Attributes
    ----------
    drive_faults : trajectories, from the commissioning on, that the robot's drives did not take.
    peak_share : greatest joint speed that was commanded, over that of its drive.
    """

    plan: ShiftPlan
    seed: int
    passes: list[Judged] = field(default_factory=list)
    gaps: list[GapReport] = field(default_factory=list)
    refused: list[tuple[float, str]] = field(default_factory=list)
    drive_faults: int = 0
    peak_share: float = 0.0

    def errors(self) -> tuple[Array, Array]:
        """Times (p,) and errors (p, k, 3) of the passes that were produced."""
        made = [one for one in self.passes if one.error is not None]
        return np.array([one.time_s for one in made]), np.array([one.error for one in made])


Watch = Callable[[Plant], None]


def run_shift(
    plan: ShiftPlan,
    seed: int,
    suite: bool = True,
    record: Record = unrecorded,
    watch: Watch = lambda plant: None,
) -> ShiftRecord:
    """A whole shift; ``watch`` is given the plant before its commissioning."""
    with begun(plan, seed, suite, record, watch) as worker:
        return worker.work()


@contextmanager
def begun(
    plan: ShiftPlan,
    seed: int,
    suite: bool = True,
    record: Record = unrecorded,
    watch: Watch = lambda plant: None,
) -> Iterator["Worker"]:
    """A shift at its begin, as `run_shift`: with a suite the cell is commissioned."""
    nominal = load_robot(ROBOT)
    made = kr150_cell(nominal, seed, points=plan.points, fixture=plan.fixture)
    cell = SimulatedCell(made)
    if not suite:
        watch(plant := Plant(cell, None))
        yield Worker(plan, seed, plant)
        return
    expected = taught(nominal, made.robot, seed) if plan.prior == "learned" else None
    with equipped(nominal, cell, record, expected) as (plant, sessions):
        watch(plant)
        plant.commission()
        sessions.enable()
        yield Worker(plan, seed, plant)


class Worker:
    """Works through a shift."""

    def __init__(self, plan: ShiftPlan, seed: int, plant: Plant) -> None:
        self._plan, self.plant = plan, plant
        self._record = ShiftRecord(plan, seed, refused=plant.refused)
        self._waiting = list(plan.incidents)

    def work(self, until_s: float = np.inf) -> ShiftRecord:
        """The shift, or as many of its gaps, each with its production, as end by a time.

        Called again it goes on from there.
        """
        plan, plant, record = self._plan, self.plant, self._record
        if not np.isfinite(plant.begin_s):
            self._begin()
        ends_s = [*plan.begins_s[1:], plan.hours * HOUR_S]
        for number in range(len(record.gaps) + 1, plan.cycles + 1):
            if ends_s[number - 1] > until_s:
                break
            self._happens(self._now_s)
            record.gaps.append(plant.gap(f"cycle-{number}", plan.gap_s))
            self._produce(number, ends_s[number - 1])
        motion = plant.cell.motion
        record.drive_faults, record.peak_share = motion.faults, motion.peak_share
        return record

    def go_on_with(self, plan: ShiftPlan) -> None:
        """Follow another plan from now on, which has been the same until now."""
        self._plan = self._record.plan = plan
        self._waiting = list(plan.incidents)

    def _begin(self) -> None:
        """What comes before the first gap."""
        plan, plant = self._plan, self.plant
        worked_s = plant.now_s + plan.work_s
        while plant.now_s + PASS_S + REST_S < worked_s:
            plant.begin_pass()
            plant.work(plant.now_s + PASS_S + REST_S)
        plant.begin_s = plant.now_s
        plant.work(plant.begin_s + min(LISTEN_S, plan.first_s))  # the correction wants readings
        self._produce(0, plan.first_s)

    def _produce(self, cycle: int, until_s: float) -> None:
        plant = self.plant
        while self._now_s + PASS_S + REST_S < until_s and not self._pauses():
            error = self._pass()
            accuracy = None if plant.suite is None else plant.suite.accuracy()
            self._record.passes.append(Judged(self._now_s, cycle, error, accuracy))
        plant.work(plant.begin_s + until_s)

    def _pass(self) -> Array | None:
        """Errors (k, 3) of a pass, each as things were when the robot arrived at its pose."""
        plant, begin_s = self.plant, self._now_s
        self._happens(begin_s)
        made = plant.begin_pass()
        end_s = begin_s + PASS_S + REST_S
        arrives_s = begin_s + PROGRAMME[0][AT_WORK]
        error = np.zeros((len(arrives_s), 3))
        since_s = begin_s
        for until_s in [*(i.at_s for i in self._waiting if i.at_s < end_s), end_s]:
            plant.work(plant.begin_s + until_s)
            if made is not None:
                there = (since_s <= arrives_s) & (arrives_s < until_s)
                error[there] = plant.cell.tcp_error(made)[there]
            since_s = until_s
            self._happens(until_s)
        return None if made is None else error

    @property
    def _now_s(self) -> float:
        return self.plant.now_s - self.plant.begin_s

    def _pauses(self) -> bool:
        return any(start <= self._now_s < end for start, end in self._plan.pauses)

    def _happens(self, now_s: float) -> None:
        while self._waiting and now_s >= self._waiting[0].at_s:
            incident = self._waiting.pop(0)
            self.plant.cell.set_fault(incident.fault, incident.size)
