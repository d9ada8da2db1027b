# SPDX-License-Identifier: Apache-2.0
"""Measured production shifts: a cold reference, then warm cycles of a few poses while it works.

Each cycle visits all sphere poses at one state of warmth. The drift of an individual robot is
scaled, before any estimator sees it, to what was published for a KR 150 R3100: without correction
40 to 50 % of the monitored directions stay within 0.1 mm, with six length parameters 70 to 88 %.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beams import COUNT_RAD, SmoothPath, read_poses
from robocal_ros.cell_sim.kr150 import BALL, TOOL, UNCORRECTED, WARM_UP, sphere_sensor
from robocal_ros.cell_sim.robot import TrueRobot, Warmth, WarmUp
from robocal_ros.cell_sim.sensors import SphereSensor
from robocal_ros.thermal.screening import share_within

Array = NDArray[np.float64]

REFERENCE = "reference"
SERVO_RAD = 2e-5  # a pose is reached this well; the encoders show where it really is
MOVE_S = 5.0  # from pose to pose, in a cycle and in production
SETTLE_S = 1.0  # from arrival to measurement
REST_S = 1.4  # at a measuring pose
# A measuring pose is always reached from the same side of each joint, so that backlash cancels.
APPROACH_RAD, APPROACH_S = float(np.radians(2.0)), 1.0


def level_at(phases: Sequence[tuple[float, float]], time_s: float) -> float:
    """Level of a programme of (hours, level) at a time after its begin."""
    end = 0.0
    for hours, level in phases:
        end += 3600.0 * hours
        if time_s < end:
            return level
    return phases[-1][1]


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
    path: SmoothPath
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

    def move(self, q: Array, rest_s: float, level: float, move_s: float = MOVE_S) -> None:
        """Go to ``q`` and rest there."""
        self.arrive.append(self.time_s + move_s)
        self.depart.append(self.time_s + move_s + rest_s)
        self.q.append(q)
        self.warmth = self.warm_up.step(self.warmth, self.plan.duty * level, move_s + rest_s)
        self.time_s += move_s + rest_s
        self.log.append((self.time_s, self.warmth.motor))


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
            before = reading - APPROACH_RAD
            course.move(before, 0.0, level, MOVE_S - APPROACH_S)
            course.move(reading, REST_S, level, APPROACH_S)
            gears = robot.backlash
            behind = None if gears is None else gears.behind(reading - before)
            flange = robot.flange(reading, course.warmth, rng, behind)[0]
            at = course.time_s - REST_S + SETTLE_S
            rise = float(course.warmth.link[-1])
            visits.append(Visit(at, name, reading, sensor.measure(flange, rise, at, rng)))
        check = robot.point(plan.check, course.warmth, tool)
        return Cycle(name, course.time_s, course.warmth, check)

    cycles = [measure(REFERENCE, plan.reference, 0.0)]
    start = course.time_s
    count = int(plan.duration_s / plan.period_s)
    for number in range(1, count + 1):
        next_cycle = start + number * plan.period_s - len(plan.cycle) * (MOVE_S + REST_S)
        while course.time_s + MOVE_S <= next_cycle:
            level = level_at(plan.phases, course.time_s - start)
            pose = plan.check[rng.integers(len(plan.check))] if level > 0.0 else course.q[-1]
            course.move(pose, 0.0, level)
        level = level_at(plan.phases, course.time_s - start)
        cycles.append(measure(f"cycle-{number:02d}", plan.cycle, level))
    time_s, temperatures = zip(*course.log, strict=True)
    return Shift(
        tuple(cycles),
        tuple(visits),
        SmoothPath(np.array(course.arrive), np.array(course.depart), np.array(course.q)),
        np.array(time_s),
        np.array(temperatures),
    )


# Shifts of a robot that drifts, at the pace of its measuring cycles: many, quickly.
MEASURING = (5, 1, 11, 8, 10, 4)  # the six of the sphere poses that estimators are given
SIX_LENGTHS = (0.70, 0.88)
PERIOD_S = 300.0
LENGTHS = ("d1_mm", "d4_mm", "d6_mm", "a1_mm", "a2_mm", "a3_mm")
TEMPERATURE_NOISE_K = 0.1
_COARSE = slice(3, None, 6)  # scaling looks at every sixth cycle
_BISECTIONS = 12


@dataclass(frozen=True, eq=False)
class DriftPlan:
    """What a shift does: (hours, level) of the programme, and each motor's duty (n,) at level 1."""

    phases: tuple[tuple[float, float], ...]
    duty: Array

    @property
    def cycles(self) -> int:
        """Number of measuring cycles."""
        return round(3600.0 * sum(hours for hours, _ in self.phases) / PERIOD_S)

    def warmths(self, parts: int = 1) -> Iterator[tuple[float, Warmth]]:
        """Time and state after each of ``parts`` equal steps of each cycle's period."""
        state, step = Warmth.cold(len(self.duty)), PERIOD_S / parts
        for i in range(self.cycles * parts):
            duty = self.duty * level_at(self.phases, i * step + 1.0)  # a second spares rounding
            state = WARM_UP.step(state, duty, step)
            yield (i + 1) * step, state


PLANS = (
    DriftPlan(((7.5, 1.0),), np.array([0.5, 1.0, 1.0, 0.8, 0.6, 0.6])),
    DriftPlan(((3.0, 1.0), (0.5, 0.0), (4.0, 0.8)), np.array([0.8, 0.7, 1.0, 0.5, 0.9, 0.4])),
    DriftPlan(
        ((2.0, 0.6), (3.0, 1.0), (0.5, 0.0), (2.0, 0.9)), np.array([0.3, 1.0, 0.6, 1.0, 0.4, 0.8])
    ),
)
"""Three shifts of 90 cycles each: steady, with a break, with changing work."""


@dataclass(frozen=True, eq=False)
class DriftingCell:
    """A scaled robot, the level of each of ``PLANS``, and the poses.

    ``sphere`` (s, n): measuring poses; ``check`` (c, n): poses at which the truth is told.
    ``lengths`` : share of directions within 0.1 mm that six ideal lengths reach in each shift.
    """

    robot: TrueRobot
    plans: tuple[DriftPlan, ...]
    sphere: Array
    check: Array
    lengths: tuple[float, ...]

    @property
    def as_published(self) -> bool:
        """Whether six lengths do as well as published in each shift."""
        return all(SIX_LENGTHS[0] <= share <= SIX_LENGTHS[1] for share in self.lengths)

    def truth(self, plan: DriftPlan, parts: int = 1, every: int = 1) -> Array:
        """True displacement (t, c, 3) of the tool at the check poses since the cold robot, m.

        At each of ``parts`` steps of each cycle's period; of these every so many.
        """
        chosen = slice(every - 1, None, every)
        return _displacement(self.robot, self.check, TOOL, plan, parts, chosen)


@dataclass(frozen=True, eq=False)
class DriftRecord:
    """What a cell measured in one shift.

    Attributes
    ----------
    time_s : (t,) of each cycle.
    cold_q, cold : (r, s, n) readings and (r, s, 3) measured centres of the cold rounds.
    q, position : (t, s, n) and (t, s, 3) of the cycles.
    temperature : (t, n) of the motors above cold at each cycle, K.
    """

    time_s: Array
    cold_q: Array
    cold: Array
    q: Array
    position: Array
    temperature: Array


def poses(kind: str) -> Array:
    """The cell's twenty poses of the ``sphere``, or 34 of ``check``: (m, 6), rad."""
    return read_poses(Path(__file__).with_name("drift_poses.csv"), kind)


def drifting_cell(robot: TrueRobot, sphere: Array, check: Array) -> DriftingCell:
    """Scale a robot's drift, and each further shift's level, to the published size."""

    def share(robot: TrueRobot, plan: DriftPlan) -> float:
        return share_within(_displacement(robot, check, TOOL, plan, chosen=_COARSE))

    def scaled(factor: float) -> TrueRobot:
        motor, link = factor * robot.motor_gain, factor * robot.link_gain
        return replace(robot, motor_gain=motor, link_gain=link)

    drifting = scaled(_bisect(lambda f: share(scaled(f), PLANS[0])))

    def levelled(plan: DriftPlan) -> DriftPlan:
        def at(factor: float) -> DriftPlan:
            phases = tuple((hours, factor * level) for hours, level in plan.phases)
            return replace(plan, phases=phases)

        return at(_bisect(lambda f: share(drifting, at(f))))

    plans = (PLANS[0], *(levelled(plan) for plan in PLANS[1:]))
    lengths = tuple(_with_lengths(drifting, sphere, check, plan) for plan in plans)
    return DriftingCell(drifting, plans, sphere, check, lengths)


def _bisect(share: Callable[[float], float]) -> float:
    """The factor at which the share falls to the published one."""
    low, high = 0.05, 4.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if share(middle) > UNCORRECTED else (low, middle)
    return 0.5 * (low + high)


def _displacement(
    robot: TrueRobot,
    q: Array,
    point: Array,
    plan: DriftPlan,
    parts: int = 1,
    chosen: slice = slice(None),
) -> Array:
    """True displacement (t, m, 3) of a point of the flange since the cold robot, m."""
    cold = robot.point(q, Warmth.cold(robot.nominal.n), point)
    states = [state for _, state in plan.warmths(parts)]
    return np.array([robot.point(q, state, point) - cold for state in states[chosen]])


def _with_lengths(robot: TrueRobot, sphere: Array, check: Array, plan: DriftPlan) -> float:
    """Share within 0.1 mm when six lengths are fitted to all spheres without any noise."""
    arm = robot.nominal
    chosen = [arm.parameters.names.index(name) for name in LENGTHS]
    seen = arm.parameter_jacobian(sphere, BALL)[:, :3, chosen].reshape(-1, len(chosen))
    told = arm.parameter_jacobian(check, TOOL)[:, :3, chosen].reshape(-1, len(chosen))
    moved = _displacement(robot, sphere, BALL, plan, chosen=_COARSE)
    lengths = moved.reshape(len(moved), -1) @ np.linalg.pinv(seen).T
    truth = _displacement(robot, check, TOOL, plan, chosen=_COARSE).reshape(len(moved), -1)
    return share_within(truth - lengths @ told.T)


def record(
    cell: DriftingCell, plan: DriftPlan, rng: np.random.Generator, *, rounds: int = 3
) -> DriftRecord:
    """Measure a shift: ``rounds`` of the cold robot, then every cycle, all sphere poses each."""
    sensor = sphere_sensor(cell.robot.effects)
    cold = Warmth.cold(cell.robot.nominal.n)
    before = [_visit(cell, sensor, cold, 0.0, rng) for _ in range(rounds)]
    states = list(plan.warmths())
    after = [_visit(cell, sensor, state, time_s, rng) for time_s, state in states]
    rise = np.array([state.motor for _, state in states])
    return DriftRecord(
        time_s=np.array([time_s for time_s, _ in states]),
        cold_q=np.array([q for q, _ in before]),
        cold=np.array([p for _, p in before]),
        q=np.array([q for q, _ in after]),
        position=np.array([p for _, p in after]),
        temperature=rise + TEMPERATURE_NOISE_K * rng.standard_normal(rise.shape),
    )


def _visit(
    cell: DriftingCell,
    sensor: SphereSensor,
    state: Warmth,
    time_s: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    servo = SERVO_RAD * rng.standard_normal(cell.sphere.shape)
    q = np.round((cell.sphere + servo) / COUNT_RAD) * COUNT_RAD
    gears, behind = cell.robot.backlash, None
    if gears is not None:
        behind = gears.behind(np.diff(cell.sphere, axis=0, prepend=cell.sphere[-1:]))
    flange = cell.robot.flange(q, state, rng, behind)
    rise = float(state.link[-1])
    return q, np.array([sensor.measure(T, rise, time_s, rng) for T in flange])
