"""A measured production shift: a cold reference, then warm cycles of a few poses while it works."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.motion import COUNT_RAD, Path
from robocal_ros.cell_sim.robot import TrueRobot
from robocal_ros.cell_sim.sensor import SphereSensor
from robocal_ros.cell_sim.thermal import Warmth, WarmUp

Array = NDArray[np.float64]

REFERENCE = "reference"
SERVO_RAD = 2e-5  # a pose is reached this well; the encoders show where it really is
MOVE_S = 5.0  # from pose to pose, in a cycle and in production
SETTLE_S = 1.0  # from arrival to measurement
REST_S = 1.4  # at a measuring pose


@dataclass(frozen=True, eq=False)
class ShiftPlan:
    """What happens in a shift.

    Attributes
    ----------
    reference, cycle : (m, n) measuring poses of the cold reference and of each warm cycle, rad.
    check : (c, n) poses at which the truth is told, and of the production motion.
    phases : (hours, level) of the programme: level 1 is the rated one, 0 a break.
    duty : (n,) of each motor at level 1.
    period_s : from one warm cycle to the next.
    """

    reference: Array
    cycle: Array
    check: Array
    phases: tuple[tuple[float, float], ...]
    duty: Array
    period_s: float

    @property
    def duration_s(self) -> float:
        """Length of the shift after the cold reference."""
        return 3600.0 * sum(hours for hours, _ in self.phases)

    def level(self, time_s: float) -> float:
        """Level of the programme at a time after the reference."""
        end = 0.0
        for hours, level in self.phases:
            end += 3600.0 * hours
            if time_s < end:
                return level
        return self.phases[-1][1]


@dataclass(frozen=True, eq=False)
class Visit:
    """A measuring pose visited: ``reading`` (n,) at rest, ``position`` (3,) in the sensor, m."""

    time_s: float
    cycle: str
    reading: Array
    position: Array


@dataclass(frozen=True, eq=False)
class Cycle:
    """A measuring cycle as a whole.

    ``time_s`` is its end; ``warmth`` the state then; ``check`` (c, 3) where the tool truly is in
    base, m, when the check poses are commanded without correction.
    """

    name: str
    time_s: float
    warmth: Warmth
    check: Array


@dataclass(frozen=True, eq=False)
class Shift:
    """Everything that happened; times in s from the start.

    ``path`` is the joints' whole motion; ``temperatures`` (t, n) of the motors above cold, K, at
    ``temperature_time_s`` (t,).
    """

    cycles: tuple[Cycle, ...]
    visits: tuple[Visit, ...]
    path: Path
    temperature_time_s: Array
    temperatures: Array


class _Course:
    """Time goes on: way points, temperatures, visits."""

    def __init__(self, robot: TrueRobot, warm_up: WarmUp, plan: ShiftPlan) -> None:
        self.robot, self.warm_up, self.plan = robot, warm_up, plan
        self.warmth = Warmth.cold(robot.nominal.n)
        self.time_s = 0.0
        self.arrive: list[float] = [0.0]
        self.depart: list[float] = [0.0]
        self.q: list[Array] = [plan.check[0]]
        self.log: list[tuple[float, Array]] = [(0.0, self.warmth.motor)]

    def move(self, q: Array, rest_s: float, level: float) -> None:
        """Go to ``q`` and rest there."""
        self.arrive.append(self.time_s + MOVE_S)
        self.depart.append(self.time_s + MOVE_S + rest_s)
        self.q.append(q)
        self.warmth = self.warm_up.step(self.warmth, self.plan.duty * level, MOVE_S + rest_s)
        self.time_s += MOVE_S + rest_s
        self.log.append((self.time_s, self.warmth.motor))

    def truth(self, name: str, tool: Array) -> Cycle:
        """The state at the end of a cycle."""
        check = self.robot.point(self.plan.check, self.warmth, tool)
        return Cycle(name, self.time_s, self.warmth, check)


def simulate(
    robot: TrueRobot,
    sensor: SphereSensor,
    warm_up: WarmUp,
    plan: ShiftPlan,
    tool: Array,
    rng: np.random.Generator,
) -> Shift:
    """Run a shift; ``tool`` (3,) is the point in the flange frame that the truth tells of."""
    course = _Course(robot, warm_up, plan)
    visits: list[Visit] = []

    def measure(name: str, poses: Array, level: float) -> Cycle:
        for pose in poses:
            exact = pose + SERVO_RAD * rng.standard_normal(pose.shape)
            reading = np.round(exact / COUNT_RAD) * COUNT_RAD
            course.move(reading, REST_S, level)
            flange = robot.flange(reading, course.warmth, rng)[0]
            at = course.time_s - REST_S + SETTLE_S
            rise = float(course.warmth.link[-1])
            visits.append(Visit(at, name, reading, sensor.measure(flange, rise, at, rng)))
        return course.truth(name, tool)

    cycles = [measure(REFERENCE, plan.reference, 0.0)]
    start = course.time_s
    count = int(plan.duration_s / plan.period_s)
    for number in range(1, count + 1):
        next_cycle = start + number * plan.period_s - len(plan.cycle) * (MOVE_S + REST_S)
        while course.time_s + MOVE_S <= next_cycle:
            level = plan.level(course.time_s - start)
            pose = plan.check[rng.integers(len(plan.check))] if level > 0.0 else course.q[-1]
            course.move(pose, 0.0, level)
        cycles.append(measure(f"cycle-{number:02d}", plan.cycle, plan.level(course.time_s - start)))
    time_s, temperatures = zip(*course.log, strict=True)
    return Shift(
        tuple(cycles),
        tuple(visits),
        Path(np.array(course.arrive), np.array(course.depart), np.array(course.q)),
        np.array(time_s),
        np.array(temperatures),
    )
