# SPDX-License-Identifier: Apache-2.0
"""One motion of the robot at a time, supervised; whatever is odd is a reason to stop."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from robocal_ros.ground.errors import (
    Code,
    ConflictError,
    InputError,
    LimitError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.maintenance.accuracy import MaintenanceConfig
from robocal_ros.motion.cell import MotionCell, along, departure, joint_way, raised_way
from robocal_ros.motion.plan import JointPlan, joined, start_near, stop_time
from robocal_ros.motion.robot_watch import VELOCITY_S, LeftPlanError, MotionReport, RobotWatch
from robocal_ros.motion.stopping import WatchedStop
from robocal_ros.tool.driving import least_s

# Home and the measuring poses are a ring: home is 0, the poses are 1 to k in their order, and a
# straight joint line leads from each to the next, from the last one home. Nothing else is driven.


HOME = 0
Line = tuple[int, int]  # between two neighbours of the ring, or (i, i): at one
STATION: Line = (-1, -1)  # anywhere that the tool's driver may have left the robot


@dataclass(frozen=True, eq=False)
class Route:
    """A plan with the lines that it follows; ``ends_s`` (m,): when each line is over."""

    plan: JointPlan
    lines: tuple[Line, ...]
    ends_s: tuple[float, ...]

    def line_at(self, time_s: float) -> Line:
        """The line at a time from the start."""
        for line, end_s in zip(self.lines, self.ends_s, strict=True):
            if time_s < end_s:
                return line
        return self.goal

    @property
    def goal(self) -> Line:
        """Where it ends."""
        last = self.lines[-1][1]
        return (last, last)


class Ways:
    """Plans for one robot; planned from where it stands. ``line_s``: of each taught line.

    Raises `InputError` when poses have another number of joints, or ``tool_home_s`` is too short;
    `LimitError` when a taught way breaks a limit, or cuts into the station's housing.
    """

    def __init__(self, arm: SerialArm, config: MaintenanceConfig) -> None:
        driving, laser = config.driving, config.T_base_laser
        if config.home.shape != (arm.n,):
            raise InputError(f"home has {config.home.size} joints, {arm.name} has {arm.n}")
        if config.poses.ndim != 2 or config.poses.shape[1] != arm.n:
            raise InputError(f"measuring poses {config.poses.shape}: {arm.n} joints each")
        self.station = MotionCell(
            arm,
            driving.body(config.T_flange_tool),
            np.eye(4) if laser is None else laser,
            driving.housing,
            driving.limits,
            driving.mandrel,
        )
        travel = replace(driving.limits, tcp_speed_m_s=config.travel_speed_m_s)
        self.cell = replace(self.station, limits=travel)
        self._home, self._points = config.home, np.vstack([config.home, config.poses])
        ring, points = self._ring(HOME, len(self._points), +1), self._points
        lines = [joint_way(self.cell, points[a], points[b]) for a, b in ring]
        if laser is not None:
            for number, plan in enumerate(lines, start=1):
                self.cell.require_clear(plan, f"taught way {number}")
            self._require_time(config.times.tool_home_s)
        self.line_s = [plan.duration_s for plan in lines]

    @property
    def count(self) -> int:
        """Number of measuring poses."""
        return len(self._points) - 1

    def home_s(self, pose: int) -> float:
        """Duration of the way home from a pose."""
        return min(sum(self.line_s[:pose]), sum(self.line_s[pose:]))

    def beside(self, place: Line, q: Array) -> Array:
        """How far each joint (n,) is from a taught line, or from a point of the ring, rad (m)."""
        start, end = self._points[place[0]], self._points[place[1]]
        way = end - start
        share = np.clip((q - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
        away: Array = np.abs(start + share * way - q)
        return away

    def first_s(self) -> float:
        """The longest `onward` from home to a pose, and home from there; no more than the ring."""
        out = np.cumsum(self.line_s[:-1]).tolist()
        return max((out_s + self.home_s(i) for i, out_s in enumerate(out, 1)), default=0.0)

    def onward(self, place: Line, q: Array, pose: int) -> Route:
        """The way to a pose through those before it, from where the robot stands at joints (n,).

        So its joints come from one side, in whatever gap: backlash is the same at each visit.
        """
        ahead = self._ring(place[1], (pose - place[1]) % len(self._points), +1)
        return self._route(q, ahead if place[0] == place[1] and ahead else [place, *ahead])

    def home(self, place: Line, q: Array) -> Route:
        """The shortest way home, or that from the station. Raises `LimitError` when there is none.

        From there the tip leads that hangs lower, the tool's or the mandrel's: it is in the beams.
        """
        if place != STATION:
            return self._back(place, q)
        cells = [self.station]
        if (mandrel := self.station.beside) is not None:
            cells.append(replace(self.station, tool=mandrel, beside=self.station.tool))
        lower = min(cells, key=lambda cell: cell.in_laser(cell.T_base_tip(q)[:3, 3])[2])
        plan = departure(lower, q, self._home)
        return Route(plan, ((STATION[0], HOME),), (plan.duration_s,))

    def _back(self, place: Line, q: Array) -> Route:
        """The shortest of the ways home by the ring."""
        routes = []
        for near in dict.fromkeys(place):
            other = place[0] if near == place[1] else place[1]
            for sense in (+1, -1):
                lines = self._ring(near, -near * sense % len(self._points), sense)
                if other != near or not lines:
                    lines = [(other, near), *lines]
                routes.append(self._route(q, lines))
        return min(routes, key=lambda route: route.plan.duration_s)

    def _require_time(self, tool_home_s: float) -> None:
        """Refuse a time for the way home from the beams that is surely too short.

        How tcf_node turns the tool there is not known here: turned as at home it is the shortest.
        """
        cell, here = self.station, self.station.T_base_tip(self._home)
        there = here.copy()
        there[:3, 3] = cell.T_base_laser[:3, 3]
        corners = raised_way(cell, here, there, cell.housing.retract_m)
        try:
            way_s = along(cell, self._home, corners, "way from home to the beams").duration_s
        except LimitError:  # turned as at home it does not get there
            way_s = least_s(cell, [here, *corners])
        if way_s > tool_home_s:
            raise InputError(
                f"tool_home_s = {tool_home_s:g} s: the way between home and the beams alone takes "
                f"{way_s:.1f} s; allow more, or teach a home pose that is nearer"
            )

    def _ring(self, first: int, count: int, sense: int) -> list[Line]:
        points = [(first + sense * i) % len(self._points) for i in range(count + 1)]
        return list(pairwise(points))

    def _route(self, q: Array, lines: Sequence[Line]) -> Route:
        plans = []
        for _, end in lines:
            plans.append(joint_way(self.cell, q, self._points[end]))
            q = self._points[end]
        ends = np.cumsum([plan.duration_s for plan in plans])
        return Route(joined(plans), tuple(lines), tuple(ends.tolist()))


class FaultError(RobocalError):
    """Something at which the robot must stop, and a person must look."""

    def __init__(self, code: Code, message: str) -> None:
        super().__init__(message)
        self.code = code


class Mover:
    """Where the robot is, and the route that it drives; times of a steady clock.

    ``watch``: the readings, and how fast the controller's clock runs. ``stopping``: the stop that
    was sent last. ``place``: point, line or station at which it was last known to be.
    ``stops_within_s``: a stop that was sent is over in the readings by then, from any speed.
    ``ways``: the ring that it is on; another one from home alone.
    """

    def __init__(self, config: MaintenanceConfig, ways: Ways) -> None:
        self._config, self.ways = config, ways
        self._arm = ways.cell.arm
        driving = config.driving
        self.watch = RobotWatch(self._arm, driving)
        self.stopping = WatchedStop(self._arm, driving.limits)
        self._lost = ""  # why the controller does not drive the route any more
        fastest = driving.limits.of_joints(self._arm)[0]
        self.stops_within_s = driving.late_s + float(stop_time(self._arm, driving.limits, fastest))
        self._q: Array | None = None
        self._route: Route | None = None
        self.place: Line = (HOME, HOME)
        self.newest_s = -np.inf  # stamp of the newest reading

    def reading(self, stamp_s: float, q: Array, now_s: float) -> None:
        """Take joints (n,); ``stamp_s`` on their own clock."""
        self.watch.reading(stamp_s, q, now_s)
        if (newest := self.watch.newest) is not None:
            self.newest_s, self._q = newest  # an older stamp does not count

    @property
    def moving(self) -> bool:
        """Whether a route is under way."""
        return self._route is not None

    def beside_home(self) -> str:
        """Which joint is how far from home, in words; empty when the robot is there."""
        if self._q is None or self.watch.silent:
            return self.unheard
        away = np.abs(self._q - self._config.home)
        return self._off(away, np.broadcast_to(self._config.home_near, away.shape))

    def require_home(self) -> None:
        """Refuse what begins at home where the robot is not, or is not heard."""
        if self.unheard:
            raise TooFewSamplesError(f"{self.unheard}: nobody knows whether the robot is at home")
        if away := self.beside_home():
            raise LimitError(f"robot is not at home: {away}: bring it home, then acknowledge")

    def require_stopped(self) -> None:
        """Refuse what needs a robot at rest while a stop was not seen yet, as in a pause."""
        if self.stopping.under_way and self.unheard:
            words = "nobody knows whether the robot has stopped: look at its driver and network"
            raise TooFewSamplesError(f"{self.unheard}: {words}")
        if self.stopping.under_way:
            raise ConflictError(
                "a stop is under way: wait until the robot stands, and let a paused one run"
            )

    @property
    def unheard(self) -> str:
        """Why nobody knows where the robot is, in words; empty where it is known."""
        if self._q is not None and not self.watch.silent:
            return ""
        silent_s = self.watch.silent_s
        return "joint states are " + (
            "missing" if np.isinf(silent_s) else f"silent for {silent_s:.2f} s"
        )

    def exactly_home(self, q: Array) -> bool:
        """Whether joints (n,) are as near to home as the end of a motion comes."""
        return bool(np.all(np.abs(q - self._config.home) < start_near(self._arm)))

    def require_heard(self, when: str) -> Array:
        """The joints (n,); FaultError where they are silent, with words for ``when`` that was."""
        if self._q is None or self.watch.silent:
            raise FaultError(Code.TOO_FEW_SAMPLES, f"{self.unheard} {when}")
        return self._q

    def _off(self, away: Array, near: Array) -> str:
        """Which joint is off the furthest, in words; empty where all are near enough."""
        joint = int(np.argmax(away / near))
        if away[joint] <= near[joint]:
            return ""
        prismatic = self._arm.prismatic[joint]
        unit, scale = ("mm", 1e3) if prismatic else ("deg", np.degrees(1.0))
        found, allowed = scale * away[joint], scale * near[joint]
        name = self._arm.joint_names[joint]
        return f"{name} is {found:.2f} {unit} off (allowed {allowed:.2f} {unit})"

    def require_at(self, q: Array) -> None:
        """Look after a robot that is to stand at joints (n,).

        Raises `FaultError` when joint states are silent, or it is not there any more.
        """
        away = np.abs(self.require_heard("while the robot stands away from home") - q)
        self._require_near(away, self._allowed(), "where it came to rest")

    def require_taught(self, q: Array) -> None:
        """Let the robot move from joints (n,) where it rests on its taught line; else FaultError.

        At the station there is no line: the tool's driver may have left it anywhere.
        """
        if self.place != STATION:
            allowed = np.maximum(self._allowed(), self._config.home_near)
            away = self.ways.beside(self.place, q)
            self._require_near(away, allowed, "on its taught way")

    def _allowed(self) -> Array:
        driving = self._config.driving
        return np.where(self._arm.prismatic, driving.deviation_m, driving.deviation_rad)

    def _require_near(self, away: Array, allowed: Array, what: str) -> None:
        if words := self._off(away, allowed):
            raise FaultError(Code.LIMIT_EXCEEDED, f"robot is not {what}: {words}")

    def start(self, route: Route, now_s: float) -> None:
        """A route was sent."""
        self._route, self._lost = route, ""
        self.stopping.forget()
        self.watch.follow(route.plan, self.ways.cell, now_s)

    def reported(self, report: MotionReport) -> None:
        """What the controller says of what it was sent last."""
        if self.stopping.under_way:
            if report.failed:
                self.stopping.rejected(report.words)
        elif self._route is not None and report.failed:
            self._lost = report.words
        elif report.ended:
            self.watch.ended()

    def trouble(self, now_s: float) -> str:
        """That the robot does not stop, or is late on its way, in words; else empty."""
        return self.stopping.failed or self.watch.late(now_s)

    def worst_left_s(self, worst_s: float, now_s: float) -> float:
        """What is left of a time from the route's start on, as fast as the robot goes now."""
        driven_s = self.watch.driven_s(now_s) - max(self.watch.late_s(now_s), 0.0)
        return self.lasts_s(worst_s - driven_s)

    def lasts_s(self, planned_s: float) -> float:
        """How long the robot takes for what is planned, at its speed but for pauses."""
        return planned_s / max(self.watch.unpaused, 1e-3)

    def arrived(self, now_s: float) -> bool:
        """Whether the route is over, with the robot at its end."""
        if self._route is None or not self.watch.at_end(now_s):
            return False
        self.place, self._route = self._route.goal, None
        self.watch.forget()
        return True

    def require_sane(self, now_s: float) -> None:
        """Look after a motion.

        Raises `FaultError` when joint states are silent, or the robot is not where its plan has it.
        """
        if self._route is None:
            return
        self.require_heard("while the robot moves")
        if self._lost:
            raise FaultError(Code.CONFLICT, self._lost)
        try:
            self.watch.require_on_plan(now_s, self._config.times.rest_s)
        except LeftPlanError as error:
            raise FaultError(error.code, str(error)) from error

    def stop(self, now_s: float) -> JointPlan | None:
        """The stop of what moves, None where nothing does."""
        if self._route is None or not self.watch.heard:
            return None
        keeps = not self._lost and self.watch.keeps(*self.watch.away())
        state = self.watch.state(now_s, keeps=keeps)
        self.place = self._route.line_at(self.watch.driven_s(now_s))
        if self.place == (STATION[0], HOME):
            self.place = STATION
        self._route = None
        self.watch.forget()
        return self.stopping.begin(state, now_s)

    def stop_measured(self, now_s: float) -> JointPlan | None:
        """The stop of whatever moves the robot, from its readings alone; None while these fail.

        Just after a silence too: its mean speed would drive on a robot that has stopped meanwhile.
        """
        watch = self.watch
        if watch.silent or not watch.tells_speed(VELOCITY_S + self._config.driving.silence_s):
            return None
        return self.stopping.begin(watch.state(now_s, keeps=False), now_s)
