"""The ways that the robot may take: taught lines, forward or back, and home from the beams.

Home and the measuring poses are a ring: home is 0, the poses are 1 to k in their order, and a
straight joint line leads from each to the next, from the last one home. Nothing else is driven.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.kinematics import SerialArm
from robocal_ros.maintenance.config import MaintenanceConfig
from robocal_ros.motion.cell import MotionCell
from robocal_ros.motion.housing import ToolBody
from robocal_ros.motion.plan import JointPlan, joined
from robocal_ros.motion.travel import along, departure, joint_way, raised_way
from robocal_ros.tool.driving import least_s

Array = NDArray[np.float64]

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
    """Plans for one robot; planned from where it stands.

    Raises
    ------
    InputError
        When poses have another number of joints, or ``tool_home_s`` is too short.
    LimitError
        When a taught way breaks a limit, or cuts into the station's housing.
    """

    def __init__(self, arm: SerialArm, config: MaintenanceConfig) -> None:
        driving, laser = config.driving, config.T_base_laser
        if config.home.shape != (arm.n,):
            raise InputError(f"home has {config.home.size} joints, {arm.name} has {arm.n}")
        if config.poses.ndim != 2 or config.poses.shape[1] != arm.n:
            raise InputError(f"measuring poses {config.poses.shape}: {arm.n} joints each")
        body = ToolBody(
            config.T_flange_tool,
            driving.tool_length_m,
            driving.tool_radius_m,
            driving.flange_radius_m,
        )
        T_base_laser = np.eye(4) if laser is None else laser
        self.station = MotionCell(arm, body, T_base_laser, driving.housing, driving.limits)
        travel = replace(driving.limits, tcp_speed_m_s=config.travel_speed_m_s)
        self.cell = replace(self.station, limits=travel)
        self._home, self._points = config.home, np.vstack([config.home, config.poses])
        lines = [self._line(a, b) for a, b in self._ring(HOME, len(self._points), +1)]
        if laser is not None:
            for number, plan in enumerate(lines, start=1):
                self.cell.require_clear(plan, f"taught way {number}")
            self._require_time(config.times.tool_home_s)
        self._line_s = [plan.duration_s for plan in lines]

    @property
    def count(self) -> int:
        """Number of measuring poses."""
        return len(self._points) - 1

    def home_s(self, pose: int) -> float:
        """Duration of the way home from a pose."""
        return min(sum(self._line_s[:pose]), sum(self._line_s[pose:]))

    def longest_line_s(self) -> float:
        """Duration of the longest taught line."""
        return max(self._line_s)

    def beside(self, place: Line, q: Array) -> Array:
        """How far each joint (n,) is from a taught line, or from a point of the ring, rad (m)."""
        start, end = self._points[place[0]], self._points[place[1]]
        way = end - start
        share = np.clip((q - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
        away: Array = np.abs(start + share * way - q)
        return away

    def to(self, place: Line, q: Array, goal: int) -> Route:
        """The shortest way from a place, where the robot stands at joints (n,), to a point."""
        routes = []
        for near in dict.fromkeys(place):
            other = place[0] if near == place[1] else place[1]
            for sense in (+1, -1):
                lines = self._ring(near, (goal - near) * sense % len(self._points), sense)
                if other != near or not lines:
                    lines = [(other, near), *lines]
                routes.append(self._route(q, lines))
        return min(routes, key=lambda route: route.plan.duration_s)

    def home(self, place: Line, q: Array) -> Route:
        """The way home, also from the station.

        Raises
        ------
        LimitError
            When there is none.
        """
        if place != STATION:
            return self.to(place, q, HOME)
        plan = departure(self.station, q, self._home)
        return Route(plan, ((STATION[0], HOME),), (plan.duration_s,))

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

    def _line(self, a: int, b: int) -> JointPlan:
        return joint_way(self.cell, self._points[a], self._points[b])

    def _route(self, q: Array, lines: Sequence[Line]) -> Route:
        plans = []
        for _, end in lines:
            plans.append(joint_way(self.cell, q, self._points[end]))
            q = self._points[end]
        ends = np.cumsum([plan.duration_s for plan in plans])
        return Route(joined(plans), tuple(lines), tuple(ends.tolist()))
