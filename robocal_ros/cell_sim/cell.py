# SPDX-License-Identifier: Apache-2.0
"""The simulated cell: what it is made of, its course over time, and the samples that come of it.

It is driven by time, and all of it follows from one seed. The joints go where they are told; their
readings show just that. The flange is where the true robot's geometry puts it, as warm as its
motion has made it, off by a scatter that is drawn anew each time it moves after a rest. Every
random number belongs to its place in time, so that it does not matter when the cell is asked, and
what is switched on or off leaves all else alone.

All figures are plausible, none measured. `kr150_cell.csv` holds its poses: ``home``, ``tool`` (the
pin's tip 120 mm above the beams), ``cycle`` (six that show the ball to the sensor, in their order),
``work`` (27, in the order of the programme) and ``profile`` (12 that show a ball on a stem to the
flange's line laser). From home to each of them, and from each to the next of its kind, the joints'
straight way keeps clear of everything that stands in the cell.
"""

from bisect import insort
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.beams import (
    JITTER_RAD,
    BeamStation,
    BeamWatch,
    Circle,
    Plunge,
    RoundTool,
    TrueInput,
    TrueNoise,
    beams_of,
    laser_points,
    on_one_clock,
    program,
    read_poses,
)
from robocal_ros.cell_sim.faults import (
    LASTING,
    NEXT_MOTION,
    AnyFault,
    CommandGate,
    Faults,
    FaultyInput,
    JointReadings,
    size_of,
)
from robocal_ros.cell_sim.fixture import FeatureShot, FixtureStation
from robocal_ros.cell_sim.gears import BacklashPlay
from robocal_ros.cell_sim.kr150 import UNCORRECTED
from robocal_ros.cell_sim.robot import (
    Draws,
    Effects,
    FlexibleBody,
    Heating,
    HeatPlan,
    Scatter,
    Stream,
    Temperatures,
    TrueRobot,
    Warmth,
)
from robocal_ros.cell_sim.sensors import (
    TICK_S,
    ProfileSensor,
    ProfileShot,
    ProfileStation,
    SphereShot,
    SphereStation,
    Standing,
    ball_on_table,
    standstills,
)
from robocal_ros.cell_sim.trajectory_controller import (
    LAG_S,
    ROOM,
    ControllerOptions,
    JointMotion,
    Trajectory,
)
from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.ground.frames import Array, Index
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.screening import THRESHOLD_M
from robocal_ros.tool.edges import BeamEdge
from robocal_ros.tool.run import PlannedStep

NEAR = float(np.radians(8.0))  # corrections are smaller, working poses further apart


@dataclass(frozen=True, eq=False)
class CellPlan:
    """What the cell is made of.

    ``robot``: the true one; its ``nominal`` is what the program and the readings' users know.
    ``station``: the true one; its ``noise`` is the robot's scatter there.
    ``tool``: as it is mounted at the begin.
    ``q_start`` (n,): where the robot stands then.
    ``fastest``: (n,) or one for all: greatest speeds of its drives, rad/s (prismatic: m/s).
    ``limits``, ``lag_s``: whether its drives refuse what is faster; their lag: see `JointMotion`.
    ``controller``: parameters of its trajectory controller.
    ``rate_hz``, ``reading_noise_rad``: of the joint readings; without noise they are exact.
    ``ripple``: relative, of the speed of circles that the robot's program drives.
    ``heat``: what warms it up; None: it stays cold.
    ``sphere``: what it shows to a sensor; None: nothing.
    ``profile``: what it looks at with a sensor of its own; None: nothing.
    ``fixture``: what a sensor on the flange finds of a fixture; None: nothing.
    ``working`` (k, n): poses of its work, at which its tool is judged.
    """

    robot: TrueRobot
    station: BeamStation
    tool: RoundTool
    q_start: Array
    fastest: ArrayLike = np.inf
    limits: bool = False
    lag_s: float = LAG_S
    controller: ControllerOptions = field(default_factory=ControllerOptions)
    rate_hz: float = 125.0
    reading_noise_rad: float = 0.0
    ripple: float = 0.02
    heat: HeatPlan | None = None
    sphere: SphereStation | None = None
    profile: ProfileStation | None = None
    fixture: FixtureStation | None = None
    working: Array = field(default_factory=lambda: np.zeros((0, 0)))
    seed: int = 1

    @property
    def arm(self) -> SerialArm:
        """The nominal robot."""
        return self.robot.nominal

    def at_work(self, q: Array) -> tuple[Index, Index]:
        """Which working poses (k,) joints (m, n) go to, and the point of each; the last one counts.

        A point goes to the pose that it is nearest to, where no joint is further than `NEAR` away.
        """
        if not len(self.working):
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        far = np.max(np.abs(q[:, None] - self.working[None]), axis=2)
        nearest, points = np.argmin(far, axis=1), np.flatnonzero(np.min(far, axis=1) < NEAR)
        last = {int(nearest[point]): int(point) for point in points}
        return np.array(list(last), dtype=np.int64), np.array(list(last.values()), dtype=np.int64)


def rigid_robot(nominal: SerialArm, error_m: float, rng: np.random.Generator) -> TrueRobot:
    """A true robot that neither bends nor warms up, with errors in all its parameters.

    ``error_m``: standard deviation of its lengths, m; its angles err by as much at 1 m.
    """
    n = nominal.n
    still = np.zeros((n, 5, n))
    return TrueRobot(
        nominal=nominal,
        static_error=error_m * rng.standard_normal((n, 5)),
        motor_gain=still,
        link_gain=still,
        body=FlexibleBody(np.zeros(n), np.zeros((n, 3)), np.ones(n), 0.0),
        eccentricity=np.zeros(n),
        phase=np.zeros(n),
        repeatability=0.0,
        effects=replace(Effects.none(), static=True),
    )


def known_laser(
    plan: CellPlan, T_base_laser: Array, q_there: Array, rng: np.random.Generator
) -> dict[str, Array]:
    """Flange positions (3,) A1 ... D4 with which this robot places the station's beams, base, m.

    They bear its scatter, the input's errors, and its geometric error as it is at joints
    ``q_there`` (n,), at the station: what it takes for upright is not.
    """
    true = plan.robot.flange(q_there, Warmth.cold(plan.arm.n))[0]
    T_known_true = plan.arm.fk(q_there) @ frames.invert(true)
    R, p = T_known_true[:3, :3], T_known_true[:3, 3]
    x, y = (
        replace(beam, start=R @ beam.start + p, end=R @ beam.end + p) for beam in plan.station.beams
    )
    return laser_points(replace(plan.station, beams=(x, y)), T_known_true @ T_base_laser, rng)


# A whole cell: KR 150, sphere sensor, beams, line laser.
TAUGHT = frames.transform(np.eye(3), [0.0, 0.0, 0.40])  # the pin, longer than the ball's stem
PIN_RADIUS_M = 2.5e-3
T_BASE_LASER = frames.transform(frames.exp_rotation([0.02, -0.03, 0.01]), [1.25, 1.00, 0.60])
BEAM_ANGLE_RAD = float(np.radians(91.4))
BEAM_GAP_M = 5.8e-5
INPUT = TrueInput(latency_s=0.004)
NOISE = TrueNoise(step_m=0.0, edge_m=1e-5)  # the scatter of a motion is in the joints
T_FLANGE_LASER = frames.transform(np.eye(3), [-0.12, 0.0, 0.10])
TARGET = np.array([1.15, -0.60, 0.50])  # a ball on a stem
TARGET_RADIUS_M = 0.0125
FLOOR = np.array([-0.28, 0.22, 0.84])  # sphere on a post, in the sensor's frame
DUTY = np.array([0.5, 1.0, 1.0, 0.8, 0.6, 0.6])  # of the programme at its usual speed
PROGRAMME_RAD_S = np.array([0.296, 0.216, 0.172, 0.358, 0.300, 0.466])  # its mean joint speeds
SHIFT_H = 8.0
HOUR_S = 3600.0


def poses(kind: str) -> Array:
    """Poses (m, 6) of a kind, rad."""
    return read_poses(Path(__file__).with_name("kr150_cell.csv"), kind)


def kr150_cell(
    nominal: SerialArm,
    seed: int = 1,
    effects: Effects | None = None,
    points: int = 2000,
    profile: bool = False,
    fixture: bool = False,
) -> CellPlan:
    """The cell with an individual robot, at home.

    ``nominal``: the type's arm; ``points`` of a sphere's cloud, 0: centres alone;
    ``profile``: with a line laser on the flange; ``fixture``: with a fixture, and a sensor on the
    flange that finds its features. With ``effects.noise`` the encoders are noisy too,
    and show whole counts. The robot's drift has the published size: with the programme all day,
    45 % of the tip's coordinates at the working poses stay within 0.1 mm.
    """
    arm = replace(nominal, T_flange_tool=TAUGHT)
    target = ball_on_table(TARGET, TARGET_RADIUS_M)
    line_laser = ProfileStation(ProfileSensor(), T_FLANGE_LASER, target, TARGET)
    robot = kr150.true_robot(arm, np.random.default_rng([seed, 0]), effects)
    return CellPlan(
        robot=_as_published(robot, poses("work")),
        station=BeamStation(beams_of(T_BASE_LASER, BEAM_ANGLE_RAD, BEAM_GAP_M), INPUT, NOISE),
        tool=RoundTool.cylinder(TAUGHT, PIN_RADIUS_M),
        q_start=poses("home")[0],
        fastest=kr150.FASTEST_RAD_S,
        limits=True,
        reading_noise_rad=JITTER_RAD if robot.effects.noise else 0.0,
        heat=HeatPlan(kr150.WARM_UP, PROGRAMME_RAD_S / DUTY),
        sphere=SphereStation(kr150.sphere_sensor(effects), FLOOR, points=points),
        profile=line_laser if profile else None,
        fixture=FixtureStation() if fixture else None,
        working=poses("work"),
        seed=seed,
    )


def worked_for(hours: float) -> Warmth:
    """As warm as the robot is after so long with its programme, from cold."""
    return kr150.WARM_UP.step(Warmth.cold(len(DUTY)), DUTY, hours * HOUR_S)


@cache
def _warming() -> tuple[Warmth, ...]:
    """After each half hour of a shift."""
    states = [Warmth.cold(len(DUTY))]
    for _ in range(round(2.0 * SHIFT_H)):
        states.append(kr150.WARM_UP.step(states[-1], DUTY, 1800.0))
    return tuple(states[1:])


def _as_published(robot: TrueRobot, working: Array) -> TrueRobot:
    """Scale the drift: what is small grows in proportion to it."""
    whole, state = replace(robot, effects=Effects()), Warmth.cold(robot.nominal.n)
    p = robot.nominal.T_flange_tool[:3, 3]
    cold = whole.point(working, state, p)
    moved = [np.abs(whole.point(working, warm, p) - cold) for warm in _warming()]
    factor = THRESHOLD_M / float(np.quantile(moved, UNCORRECTED))
    return replace(robot, motor_gain=factor * robot.motor_gain, link_gain=factor * robot.link_gain)


@dataclass(frozen=True, eq=False)
class Happened:
    """What came of a stretch of time; each stamp bears what a fault did to it.

    ``time_s``, ``q``, ``qd``: (k,), (k, n), (k, n) joint readings.
    ``edges``: those whose stamp has passed, in its order.
    ``shots``: measurements of the spheres that were told by now.
    ``profiles``: those that were told by now.
    ``features``: points of a fixture that were found.
    ``temperatures``: of the motors.
    """

    time_s: Array
    q: Array
    qd: Array
    edges: list[BeamEdge]
    shots: list[SphereShot]
    profiles: list[ProfileShot]
    features: list[FeatureShot]
    temperatures: list[Temperatures]


OTHER_STATION = "_other"


def station_name(name: str, faults: Faults) -> str:
    """The station that the edges claim to come from."""
    return name + OTHER_STATION * ("wrong_station" in faults)


BEAT = 125  # ticks in which warmth is taken as constant: a second
STILL = 1e-9  # a joint that goes less in a tick stands, rad (prismatic: m)


class SimulatedCell:
    """The cell over time, which begins at 0.

    ``motion``: of the joints; ``gate``: what passes commands on to it, and its speed scaling.
    ``next_tool``: mounted when the next motion begins: how a tool gets bent.
    ``faults``: what is wrong now.
    ``heating``: None where the robot stays cold.
    """

    def __init__(self, plan: CellPlan) -> None:
        self.plan = plan
        self._mounted = self.next_tool = plan.tool
        self.motion = JointMotion(
            plan.q_start,
            plan.fastest,
            names=plan.arm.joint_names,
            options=plan.controller,
            limits=plan.limits,
            lag_s=plan.lag_s,
        )
        self.faults = Faults(seed=plan.seed)
        self._waiting: tuple[AnyFault, float] | None = None
        self._draws = Draws(plan.seed)
        self.gate = CommandGate(self.motion, self.faults, self._draws, self._begin)
        self.heating = Heating(plan.heat, self._draws) if plan.heat else None
        self._readings = JointReadings(
            plan.rate_hz, plan.reading_noise_rad, self.faults, self._draws, plan.arm.n
        )
        self._input = FaultyInput(self.faults)
        self._watch = BeamWatch(plan.arm, self._draws)
        self._station = on_one_clock(plan.station, self._draws.of(Stream.STATION).random())
        self._standing = Standing()
        self._scatter = Scatter(3 + plan.arm.n)
        gears = plan.robot.backlash
        self._play = None if gears is None else BacklashPlay(gears, plan.q_start)
        self._hand, self._drawn = np.zeros(3), np.zeros(3 + plan.arm.n)
        self._ticks = self._motions = 0
        self._way = np.zeros((BEAT, plan.arm.n))
        self._edges: list[BeamEdge] = []  # what waits until it is told
        self._shots: list[SphereShot] = []
        self._profiles: list[ProfileShot] = []
        self._features: list[FeatureShot] = []
        self._temperatures: list[Temperatures] = []
        # What it loads at its first use shall not stop a motion.
        self._see_edges(np.arange(2), np.array([0.0, TICK_S]), np.tile(plan.q_start, (2, 1)))

    @property
    def now_s(self) -> float:
        """Everything up to here has happened."""
        return self._ticks * TICK_S

    @property
    def moving(self) -> bool:
        """Whether a motion is not over yet."""
        return self.now_s < self.motion.end_s

    @property
    def tool(self) -> RoundTool:
        """The tool as it is."""
        return self.faults.tool(self._mounted)

    @property
    def warmth(self) -> Warmth:
        """The robot's."""
        return self.heating.warmth if self.heating else Warmth.cold(self.plan.arm.n)

    def set_fault(self, fault: AnyFault, size: float = 0.0) -> None:
        """Let something go wrong, in place of what went wrong before; "none" ends all at once.

        What `NEXT_MOTION` names begins with the next motion, all else now; what `LASTING` names
        stays until "none". ``size`` in the unit that `SIZES` gives; 0: the usual one.
        """
        self.gate.fault_began(self.now_s)
        if fault == "none":
            self._waiting = None
            self.faults.sizes.clear()
        elif fault in NEXT_MOTION:
            self._waiting = fault, size_of(fault, size)
        else:
            self._waiting = None
            self._replace_fault(fault, size_of(fault, size))

    def follow(
        self,
        time_s: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
    ) -> None:
        """Follow a trajectory at once, see `JointMotion.follow`; times of the cell.

        Raises `InputError` when the controller rejects it; what runs goes on.
        """
        names = self.plan.arm.joint_names
        self.gate.take(Trajectory.of(names, time_s, q, qd, qdd, start_s=0.0), self.now_s)

    def hold(self) -> None:
        """Stand still at once: the controller is inactive."""
        self.gate.drop_late()
        self.motion.hold(self.now_s)

    def drive(self, step: PlannedStep) -> Circle | Plunge:
        """Let the robot's own program drive a step; its motion, on the cell's clock.

        Raises `LimitError` when it is out of reach, or too fast for the drives.
        """
        q_now = self.motion.at([self.now_s])[0][0]
        phase = 2.0 * np.pi * self._draws.of(Stream.RIPPLE, self._motions).random()
        time, q, qd, move = program(self.plan.arm, step, q_now, self.plan.ripple, phase)
        share = float(np.max(np.abs(qd) / self.plan.fastest))
        if self.plan.limits and share > 1.0 + ROOM:
            raise LimitError(
                f"the robot cannot drive step {step.name}: a joint would go at {share:.3g} times "
                "its drive's greatest speed"
            )
        self.follow(self.now_s + time, q, qd)
        return replace(move, start_s=self.now_s + move.start_s)

    def advance(self, to_s: float, readings: bool = True) -> Happened:
        """Let time pass, in whole ticks, up to ``to_s``.

        Without ``readings`` no joints are read: a long stretch of work takes less time.
        """
        last = int(np.floor(to_s / TICK_S * (1.0 + 1e-12)))
        read: list[tuple[Array, Array, Array]] = []
        while True:
            number = self._readings.due(self.now_s)
            number = number if readings else number[:0]
            if len(number) or not read:
                read.append(self._readings.read(number, self.motion))
            if self._ticks >= last:
                break
            self._pass(min(last, (self._ticks // BEAT + 1) * BEAT))
        time_s, q, qd = (np.concatenate(parts) for parts in zip(*read, strict=True))
        now_s, temperatures, self._temperatures = self.now_s, self._temperatures, []
        features, self._features = self._features, []
        edges = [edge for edge in self._edges if edge.time_s <= now_s]
        shots = [shot for shot in self._shots if shot.told_s <= now_s]
        profiles = [shot for shot in self._profiles if shot.told_s <= now_s]
        del self._edges[: len(edges)], self._shots[: len(shots)], self._profiles[: len(profiles)]
        return Happened(time_s, q, qd, edges, shots, profiles, features, temperatures)

    def flange(self, time_s: Array) -> Array:
        """True T_base_flange (m, 4, 4) at times (m,), the robot as warm as it is now."""
        off = self._scatter.at(time_s)
        behind = None if self._play is None else self._play.at(time_s)
        reading = self.motion.joints(time_s) + off[:, 3:]
        T = self.plan.robot.flange(reading, self.warmth, behind=behind)
        T[:, :3, 3] += off[:, :3]
        return T

    def tcp_error(self, q: ArrayLike, which: Index | slice = slice(None)) -> Array:
        """True error (k, 3) of the tool's tip at the working poses, or at some of them, base, m.

        For joints (k, n) commanded there: where they put the tip, mean over visits, with robot
        and tool as they are now, from where the cold robot put the taught tool at the taught pose.
        """
        plan, now = self.plan, self.tool.T_flange_tool[:3, 3]
        tip = plan.robot.point(q, self.warmth, now) + self._hand
        return np.asarray(tip - self._taught[which])

    @cached_property
    def _taught(self) -> Array:
        """Where (k, 3) the cold robot put the taught tool."""
        plan = self.plan
        p = plan.arm.T_flange_tool[:3, 3]
        return plan.robot.point(plan.working, Warmth.cold(plan.arm.n), p)

    def _pass(self, stop: int) -> None:
        """From tick to tick, at most to the next beat."""
        until_s = self.gate.pass_time(self.now_s, stop * TICK_S)
        stop = min(stop, max(self._ticks + 1, int(np.ceil(until_s / TICK_S * (1.0 - 1e-12)))))
        ticks = np.arange(self._ticks, stop + 1)
        time, now = np.asarray(ticks * TICK_S), self._ticks
        q = self.motion.joints(time)
        way = np.abs(np.diff(q, axis=0))
        if self._play is not None:
            self._play.follow(time, q)
        departed, stood = self._standing.look(now, np.max(way, axis=1) > STILL)
        for tick in departed.tolist():  # it moves after a rest: another scatter
            robot, noise = self.plan.robot, self.plan.station.noise.step_m
            in_joints = robot.repeatability if robot.effects.noise else 0.0
            drawn = self._draws.of(Stream.SCATTER, tick).standard_normal(3 + self.plan.arm.n)
            self._drawn = np.append(noise * drawn[:3], in_joints * drawn[3:])
            offset = np.append(self._drawn[:3] + self._hand, self._drawn[3:])
            self._scatter.begin(tick * TICK_S, offset)
        if not np.all(stood) or self._scatter.settled_s > time[0]:
            self._see_edges(ticks, time, q)
        self._measure(ticks[1:], q[1:], stood)
        begin = now % BEAT
        self._way[begin : begin + len(way)] = way
        self._ticks = stop
        if stop % BEAT == 0 and self.heating:
            self.heating.step(np.sum(self._way, axis=0), BEAT * TICK_S)
            swapped = "swapped_temperatures" in self.faults
            self._temperatures.append(self.heating.tell(self.now_s, stop // BEAT, swapped))

    def _measure(self, ticks: Index, q: Array, stood: Index) -> None:
        """Measure sphere and target where the robot has ``stood`` still for so many ticks."""
        arm, sphere, profile = self.plan.arm, self.plan.sphere, self.plan.profile
        if sphere is not None:
            for tick in standstills(sphere, arm, ticks, q, stood):
                at_s = tick * TICK_S
                T = self.flange(np.array([at_s]))[0]
                if sphere.sees(T):
                    rise = float(self.warmth.link[-1])
                    shot = sphere.shoot(T, rise, tick, at_s, self.faults, self._draws)
                    self._shots += [] if shot is None else [shot]
        if profile is not None:
            for tick in standstills(profile, arm, ticks, q, stood):
                at_s = tick * TICK_S
                view = profile.shoot(self.flange(np.array([at_s]))[0], tick, at_s, self._draws)
                self._profiles += [] if view is None else [view]

        fixture = self.plan.fixture
        if fixture is not None:
            for tick in standstills(fixture, arm, ticks, q, stood):
                at_s = tick * TICK_S
                T = self.flange(np.array([at_s]))[0]
                found = fixture.shoot(T, tick, at_s, self.faults, self._draws)
                self._features += [] if found is None else [found]

    def _see_edges(self, ticks: Index, time_s: Array, q: Array) -> None:
        station = self.faults.station(self._station)
        found = self._watch.edges(
            station, self.tool, ticks, time_s, q, self.motion.joints, self.flange
        )
        lost = self.faults.size("lost_messages")
        for edge in self._input.passed(found):
            place = round(edge.time_s * 1e9)
            if not lost or self._draws.of(Stream.LOST_EDGES, place).random() >= lost:
                insort(self._edges, edge, key=lambda e: e.time_s)

    def _begin(self) -> None:
        """A motion is told: the tool, the fault and the hand that wait for it."""
        self._mounted = self.next_tool
        if self._waiting:
            self._replace_fault(*self._waiting)
        self._waiting = None
        self._input.begin()
        self._motions += 1
        if not np.array_equal(self._hand, self.faults.hand):
            self._hand = self.faults.hand
            offset = np.append(self._drawn[:3] + self._hand, self._drawn[3:])
            self._scatter.begin(self.now_s, offset)

    def _replace_fault(self, fault: AnyFault, size: float) -> None:
        sizes = self.faults.sizes
        for other in [name for name in sizes if name not in LASTING]:
            del sizes[other]
        sizes[fault] = size
