# SPDX-License-Identifier: Apache-2.0
"""A robot with its tool at a station, and the check of a motion along its whole way."""

import inspect
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import follow, inverse, require_within_limits
from robocal_ros.motion.plan import (
    JointPlan,
    MotionLimits,
    Ride,
    TipPath,
    joined,
    line,
    stop,
    stop_time,
)


@dataclass(frozen=True)
class Housing:
    """What is solid at a station, seen from the laser frame: z up, the crossing as origin.

    Solid is all that lies below ``top_m`` outside a cylinder about z, and all below ``floor_m``, as
    far as the housing reaches.
    """

    clear_radius_m: float  # of that cylinder, the opening
    # top_m, floor_m: heights above the beam plane; the floor's is negative
    top_m: float
    floor_m: float
    retract_m: float  # height of the tool's tip on a way over the housing
    reach_m: float = np.inf  # radius about z beyond which nothing is solid; infinite: all around

    def __post_init__(self) -> None:
        opening, top, depth = 1e3 * self.clear_radius_m, 1e3 * self.top_m, -1e3 * self.floor_m
        retract, reach = 1e3 * self.retract_m, 1e3 * self.reach_m
        needed = {
            f"opening radius {opening:g} mm: must be positive": 0.0 < opening < np.inf,
            f"housing top {top:g} mm: must not be below the beams": 0.0 <= top < np.inf,
            f"housing depth {depth:g} mm: must be positive, down from the beams": (
                0.0 < depth < np.inf
            ),
            f"retract height {retract:g} mm: the tip passes over the housing there, it must be "
            f"above the housing top, {top:g} mm": top < retract < np.inf,
            f"housing reach {reach:g} mm: must be more than the opening radius, {opening:g} mm": (
                reach > opening
            ),
        }
        if wrong := [words for words, kept in needed.items() if not kept]:
            raise InputError("; ".join(wrong))

    def opening_holds(self, p_laser: Array) -> bool:
        """Whether a point (3,) is in the opening."""
        across = np.hypot(p_laser[0], p_laser[1])
        return bool(across < self.clear_radius_m and self.floor_m < p_laser[2] < self.top_m)

    def cut_by(self, start: Array, end: Array, radius_m: float) -> Array:
        """How far capsules cut into the housing (m,), m; 0 where they are clear of it.

        ``start``, ``end`` (m, 3): ends of their axes, laser frame. At the edge of the opening
        what is round counts as square: no cut is overlooked.
        """
        swapped = start[:, 2:] > end[:, 2:]
        low, high = np.where(swapped, end, start), np.where(swapped, start, end)
        brim = self.top_m + radius_m
        rise = np.maximum(high[:, 2] - low[:, 2], 1e-300)
        share = np.clip((brim - low[:, 2]) / rise, 0.0, 1.0)[:, None]
        cut = low + share * (high - low)
        # The distance from z is convex along the axis: it is largest at an end of what is below.
        widest = np.maximum(np.hypot(low[:, 0], low[:, 1]), np.hypot(cut[:, 0], cut[:, 1]))
        wall = self.clear_radius_m - radius_m - widest
        open_space = np.maximum(wall, low[:, 2] - brim)
        above_floor = low[:, 2] - radius_m - self.floor_m
        # how far beyond the housing's reach the lines pass z
        a, along = start[:, :2], end[:, :2] - start[:, :2]
        length = np.maximum(np.sum(along**2, axis=1), 1e-300)
        nearest = a + np.clip(-np.sum(a * along, axis=1) / length, 0.0, 1.0)[:, None] * along
        beyond = np.hypot(nearest[:, 0], nearest[:, 1]) - self.reach_m
        free = np.maximum(np.minimum(open_space, above_floor), beyond - radius_m)
        return np.asarray(np.maximum(-free, 0.0))


@dataclass(frozen=True, eq=False)
class ToolBody:
    """A tool as two capsules, along its axis from the tip and on to the flange, and the flange.

    A mandrel is one too.
    """

    T_flange_tool: Array  # (4, 4) tip, and axis from flange to tip along z
    # length_m, radius_m: of the part along the axis; the rest of the tool has this radius too
    length_m: float
    radius_m: float
    flange_radius_m: float  # of a ball around the flange's origin
    name: str = "tool"

    def __post_init__(self) -> None:
        sizes = {
            f"{self.name} length": self.length_m,
            f"{self.name} radius": self.radius_m,
            "flange radius": self.flange_radius_m,
        }
        for name, size in sizes.items():
            if not 0.0 < size < np.inf:
                raise InputError(f"{name} {1e3 * size:g} mm: must be positive and finite")

    @property
    def p_tip(self) -> Array:
        """(3,) flange frame."""
        return np.asarray(self.T_flange_tool[:3, 3])

    @property
    def corners(self) -> Array:
        """Tip, upper end of the axis, flange (3, 3), flange frame."""
        upper = self.p_tip - self.length_m * self.T_flange_tool[:3, 2]
        return np.stack([self.p_tip, upper, np.zeros(3)])

    def cuts(self, housing: Housing, p_laser: Array, margin_m: float) -> dict[str, Array]:
        """How far each part, grown by a margin, cuts into the housing (m,), m.

        ``p_laser`` (m, 3, 3): the corners' places.
        """
        tip, upper, flange = np.swapaxes(p_laser, 0, 1)
        radius = self.radius_m + margin_m
        return {
            f"the {self.name}": housing.cut_by(tip, upper, radius),
            f"the {self.name}'s upper part": housing.cut_by(upper, flange, radius),
            "the flange": housing.cut_by(flange, flange, self.flange_radius_m + margin_m),
        }


@dataclass(frozen=True, eq=False)
class DrivingConfig:
    """What a driven measurement may do."""

    housing: Housing
    # tool_length_m, tool_radius_m, flange_radius_m: see `ToolBody`
    tool_length_m: float
    tool_radius_m: float
    flange_radius_m: float
    limits: MotionLimits = field(default_factory=MotionLimits)
    # deviation_m, deviation_rad: largest distance of the tip, and of a turning joint, from the plan
    deviation_m: float = 2e-3
    deviation_rad: float = float(np.radians(0.5))
    silence_s: float = 0.1  # joint states may pause for so long while the robot moves
    late_s: float = 0.15  # the robot lags at most so far behind its plan
    armed_s: float = 60.0  # without a run it disarms after so long
    mandrel: ToolBody | None = None  # on the flange beside the tool

    def body(self, T_flange_tool: Array) -> ToolBody:
        """A tool (4, 4) of these sizes."""
        return ToolBody(T_flange_tool, self.tool_length_m, self.tool_radius_m, self.flange_radius_m)


ROUNDING = 1e-6  # relative, of a speed that is driven at its limit
LARGEST_STEP_M = 5e-4  # no point of the tool moves further from one checked instant to the next
FEWEST_STEPS = 4  # between two points of a plan


@dataclass(frozen=True, eq=False)
class MotionCell:
    """What motions are planned for."""

    arm: SerialArm  # the model in force, with the joints' limits
    tool: ToolBody  # whose tip moves
    T_base_laser: Array  # (4, 4) of the station
    housing: Housing
    limits: MotionLimits = field(default_factory=MotionLimits)
    beside: ToolBody | None = None  # what the flange carries too

    @cached_property
    def bodies(self) -> tuple[ToolBody, ...]:
        """All that is to be kept clear."""
        return (self.tool,) if self.beside is None else (self.tool, self.beside)

    @cached_property
    def corners(self) -> Array:
        """Of the bodies (3 k, 3), flange frame; the tip is the first."""
        return np.vstack([body.corners for body in self.bodies])

    def T_base_tip(self, q: Array) -> Array:
        """The tip's place with the flange's axes (4, 4) at joints (n,)."""
        return self.tip_of(self.arm.fk(q))

    def tip_of(self, T_base_flange: Array) -> Array:
        """The same from a flange pose (4, 4)."""
        return np.asarray(T_base_flange @ frames.transform(np.eye(3), self.tool.p_tip))

    def in_laser(self, p_base: Array) -> Array:
        """Points (..., 3) in the laser frame."""
        T = self.T_base_laser
        return np.asarray((p_base - T[:3, 3]) @ T[:3, :3])

    def joints(self, path: TipPath, q_now: Array) -> JointPlan:
        """A plan along a path that begins where the robot stands.

        Raises `LimitError` as `kinematics.arm.follow`.
        """
        found = follow(
            self.arm, path.T_base_tip, path.twist, path.twist_rate, q_now, self.tool.p_tip
        )
        return JointPlan(path.time_s, found.q, found.qd, found.qdd)

    def demand(self, plan: JointPlan, tcp_speed_m_s: float) -> tuple[float, str]:
        """Largest share of a speed or acceleration limit that a plan takes, and which."""
        velocity, acceleration, _ = self.limits.of_joints(self.arm)
        fastest, hardest = plan.peaks()
        shares = np.concatenate([fastest / velocity, np.sqrt(hardest / acceleration)])
        worst = int(np.argmax(shares))
        tip = float(np.max(self._sampled(plan).speed_m_s[:, 0]))
        if tip / tcp_speed_m_s >= shares[worst]:
            return tip / tcp_speed_m_s, (
                f"the tip would move at {tip * 1e3:.2f} mm/s, its limit is "
                f"{tcp_speed_m_s * 1e3:.2f} mm/s"
            )
        joint, of_speed = worst % self.arm.n, worst < self.arm.n
        value, limit = (fastest, velocity) if of_speed else (hardest, acceleration)
        what = "velocity" if of_speed else "acceleration"
        unit = ("m/s" if self.arm.prismatic[joint] else "rad/s") + ("" if of_speed else "^2")
        return float(shares[worst]), (
            f"{self.arm.joint_names[joint]} would need a {what} of {value[joint]:.4g} {unit}, "
            f"its limit is {limit[joint]:.4g} {unit}"
        )

    def require_clear(self, plan: JointPlan, name: str) -> None:
        """Refuse a plan that passes a joint limit or comes near the housing anywhere on its way.

        The distance to be kept is what a stop from there needs, and the way from one checked
        instant to the next.

        Raises `LimitError`, which names what comes near, where, and by how much.
        """
        seen = self._sampled(plan)
        require_within_limits(self.arm, seen.q)
        fastest = np.max(seen.speed_m_s, axis=1)
        stopping = 0.5 * fastest * stop_time(self.arm, self.limits, seen.qd)
        margin = float(np.max(stopping) + np.max(fastest) * np.max(np.diff(seen.time_s)))
        places = self.in_laser(seen.corners)
        cuts: dict[str, Array] = {}
        for body, own in zip(self.bodies, np.split(places, len(self.bodies), 1), strict=True):
            cuts |= body.cuts(self.housing, own, margin)
        for part, cut in cuts.items():
            i = int(np.argmax(cut))
            if cut[i] > 0.0:
                x, y, z = 1e3 * places[i, 0]
                raise LimitError(
                    f"{name}: {part}, with {margin * 1e3:.1f} mm to be kept free, would cut "
                    f"{cut[i] * 1e3:.1f} mm into the station's housing, the tip at "
                    f"({x:.1f}, {y:.1f}, {z:.1f}) mm of the laser frame, {seen.time_s[i]:.2f} s "
                    "after the start: drive the tool above the station by hand, or check the "
                    "sizes of housing, tool and circle"
                )

    def _sampled(self, plan: JointPlan) -> "_Sampled":
        """Between the points too, so that no point of the tool moves by more than a step."""
        speed = np.max(self._moving(plan.time_s, plan.q, plan.qd).speed_m_s)
        longest = float(np.max(np.diff(plan.time_s)))
        steps = max(int(np.ceil(1.1 * speed * longest / LARGEST_STEP_M)), FEWEST_STEPS)
        inside = plan.time_s[:-1, None] + np.diff(plan.time_s)[:, None] * np.arange(steps) / steps
        time = np.append(inside.ravel(), plan.time_s[-1])
        return self._moving(time, *plan.at(time))

    def _moving(self, time: Array, q: Array, qd: Array) -> "_Sampled":
        T, twist = self.arm.fk(q), (self.arm.jacobian(q) @ qd[:, :, None])[:, :, 0]
        arms = self.corners @ np.swapaxes(T[:, :3, :3], 1, 2)
        velocity = twist[:, None, :3] + np.cross(twist[:, None, 3:], arms)
        return _Sampled(time, q, qd, T[:, None, :3, 3] + arms, np.linalg.norm(velocity, axis=2))


@dataclass(frozen=True, eq=False)
class _Sampled:
    """A plan at instants (m,): joints; places (m, k, 3), speeds (m, k) of the cell's corners."""

    time_s: Array
    q: Array
    qd: Array
    corners: Array
    speed_m_s: Array


SHORTEST_WAY_M = 1e-6  # a shorter part of an approach is left out
SAME_POSTURE_RAD = 0.05  # as the inverse may end beside the taught pose


def joint_way(cell: MotionCell, q_from: ArrayLike, q_to: ArrayLike) -> JointPlan:
    """From joints to joints (n,), all joints together on a straight line, from rest to rest.

    As fast as the limits of joints and tip allow; nothing of the cell is looked at.

    Raises `LimitError` when an end lies beyond a joint limit.
    """
    start, end = np.array(q_from, dtype=np.float64), np.array(q_to, dtype=np.float64)
    require_within_limits(cell.arm, np.stack([start, end]))
    velocity, acceleration, _ = cell.limits.of_joints(cell.arm)
    way = end - start
    with np.errstate(divide="ignore"):
        fastest, hardest = (np.min(most / np.abs(way)) for most in (velocity, acceleration))
    ride = Ride.within(1.0, float(fastest), float(hardest))
    time = ride.times()
    share, speed, push = (part[:, None] * way for part in ride(time))
    plan = JointPlan(time, start + share, speed, push)
    demanded, _ = cell.demand(plan, cell.limits.tcp_speed_m_s)
    return plan.slower(max(demanded, 1.0))


def departure(cell: MotionCell, q_now: ArrayLike, q_home: ArrayLike) -> JointPlan:
    """From anywhere at a station to the taught home pose (n,), as an approach goes the other way.

    Up along the laser's z, over the housing, down, each a straight line of the tip; then the
    joints go to the taught ones exactly.

    Raises `LimitError` where the way passes a joint limit, the reach, a singularity or the housing,
    or ends in another posture than the taught one.
    """
    q, home = np.array(q_now, dtype=np.float64), np.array(q_home, dtype=np.float64)
    corners = raised_way(cell, cell.T_base_tip(q), cell.T_base_tip(home), cell.housing.retract_m)
    plan = along(cell, q, corners, "way home")
    beside = np.abs(plan.q[-1] - home)
    joint = int(np.argmax(beside))
    if beside[joint] > SAME_POSTURE_RAD:
        raise LimitError(
            f"the way home ends {np.degrees(beside[joint]):.1f} deg beside the taught home pose in "
            f"{cell.arm.joint_names[joint]}: drive the robot home by hand, and teach a home pose "
            "that the station is approached from in one posture"
        )
    return joined([plan, joint_way(cell, plan.q[-1], home)])


def along(cell: MotionCell, q: Array, corners: list[Array], name: str) -> JointPlan:
    """Straight from pose to pose of the tip (4, 4), from joints (n,), at rest at each.

    Raises `LimitError` where the way passes a joint limit, the reach, a singularity, or the
    housing.
    """
    plans: list[JointPlan] = []
    here = cell.T_base_tip(q)
    for number, there in enumerate(corners, start=1):
        plan = cell.joints(line(here, there, corner_ride(cell, here, there)), q)
        share, _ = cell.demand(plan, cell.limits.tcp_speed_m_s)
        plan = plan.slower(max(share, 1.0))
        cell.require_clear(plan, f"{name}, part {number}")
        plans.append(plan)
        q, here = plan.q[-1], there
    return joined(plans)


def raised_way(cell: MotionCell, here: Array, there: Array, above_m: float) -> list[Array]:
    """Poses of the tip (4, 4): up along the laser's z to ``above_m`` or the higher end, over, down.

    Parts that are no way are left out; the last pose is ``there``.
    """
    first, last = cell.in_laser(here[:3, 3]), cell.in_laser(there[:3, 3])
    height = max(first[2], last[2], above_m)
    way = [lifted(cell, here, height - first[2]), lifted(cell, there, height - last[2])]
    moves = [
        a for a, b in zip(way, [here, *way], strict=False) if way_m(cell, a, b) > SHORTEST_WAY_M
    ]
    return [*moves, there]


def lifted(cell: MotionCell, T: Array, by_m: float) -> Array:
    """A pose moved along the laser's z."""
    return np.asarray(frames.transform(np.eye(3), by_m * cell.T_base_laser[:3, 2]) @ T)


def way_m(cell: MotionCell, here: Array, there: Array) -> float:
    """No point of what the flange carries moves further, m."""
    turn = np.linalg.norm(frames.log_rotation(there[:3, :3] @ here[:3, :3].T))
    reach = np.max(np.linalg.norm(cell.corners - cell.tool.p_tip, axis=1))
    return float(np.linalg.norm(there[:3, 3] - here[:3, 3]) + turn * reach)


def corner_ride(cell: MotionCell, here: Array, there: Array) -> Ride:
    """The fastest within the tip's limits."""
    limits = cell.limits
    return Ride.within(way_m(cell, here, there), limits.tcp_speed_m_s, limits.tcp_acceleration_m_s2)


def load_motion(arm: SerialArm) -> None:
    """Call once what is compiled or imported at a motion's first use."""
    if (frame := inspect.currentframe()) is not None:
        inspect.getframeinfo(frame)  # rclpy's logger does: its first line would take 60 ms
    q = np.full(arm.n, 0.3)
    stop(arm, MotionLimits(), q, np.full(arm.n, 0.01)).at(0.0)
    with suppress(LimitError):  # a posture that some arm does not have
        inverse(arm, arm.fk(q)[None], q)
