# SPDX-License-Identifier: Apache-2.0
"""A motion of the joints over time, as a trajectory controller will interpolate it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm

REACTION_S = 0.01  # from a message to what the controller makes of it (8 to 10 ms measured)
LEAD_S = 0.05
"""First point of what is sent, ahead of its arrival.

joint_trajectory_controller 4.42.1 commands a first point at time 0 at once, wherever the robot is;
one ahead of now begins where the controller is, without a jump. 0.05 s are five cycles of a slow
controller (100 Hz), and more than the 10 ms from a message to what becomes of it. From rest the
cubic to that point is the plan itself.
"""


@dataclass(frozen=True, eq=False)
class JointPlan:
    """Points of a joint trajectory, at rest at its end.

    Between points it is the cubic through positions and velocities: what a trajectory controller
    makes of points that carry these two. ``qdd`` is the exact path's; sent along, it would turn
    the cubic into a quintic.
    """

    time_s: Array  # (k,) from the start, increasing, the first 0
    # q, qd, qdd: (k, n) joints, rad (prismatic: m), and their derivatives
    q: Array
    qd: Array
    qdd: Array

    @property
    def duration_s(self) -> float:
        """From its start to rest."""
        return float(self.time_s[-1])

    @cached_property
    def _cubics(self) -> Array:
        """Factors (4, k - 1, n) of the cubics from each point on, of the third power first."""
        h = np.diff(self.time_s)[:, None]
        way, before, after = np.diff(self.q, axis=0) / h, self.qd[:-1], self.qd[1:]
        bend, twist = (3.0 * way - 2.0 * before - after) / h, (before + after - 2.0 * way) / h**2
        return np.stack([twist, bend, before, self.q[:-1]])

    def _since(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Factors (4, ..., n) of the cubics at times, and the times (..., 1) since they begin."""
        # each 20 ms while a robot moves: np.clip costs thrice as much
        t = np.minimum(np.maximum(np.asarray(time_s, dtype=np.float64), 0.0), self.duration_s)
        k = np.minimum(np.searchsorted(self.time_s, t, side="right") - 1, len(self.time_s) - 2)
        return self._cubics[:, k], (t - self.time_s[k])[..., None]

    def places(self, time_s: ArrayLike) -> Array:
        """Joints (..., n) alone, as `at`."""
        (a, b, c, d), u = self._since(time_s)
        return np.asarray(d + u * (c + u * (b + u * a)))

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Joints (..., n) and their velocity; before the start as there, after the end at rest."""
        (a, b, c, d), u = self._since(time_s)
        moves = np.asarray(time_s)[..., None] <= self.duration_s
        velocity = np.where(moves, c + u * (2.0 * b + u * 3.0 * a), 0.0)
        return d + u * (c + u * (b + u * a)), velocity

    def peaks(self) -> tuple[Array, Array]:
        """Largest speed and acceleration (n,) of each joint, exactly, between points too."""
        h = np.diff(self.time_s)[:, None]
        way, before, after = np.diff(self.q, axis=0) / h, self.qd[:-1], self.qd[1:]
        first = (6.0 * way - 4.0 * before - 2.0 * after) / h
        last = (4.0 * after + 2.0 * before - 6.0 * way) / h
        # The velocity is a parabola, with its vertex between the points where these differ in sign.
        turns = first * last < 0.0
        vertex = before + 0.5 * h * first**2 / np.where(turns, first - last, np.inf)
        speed = np.maximum(np.max(np.abs(self.qd), axis=0), np.max(np.abs(vertex), axis=0))
        return speed, np.max(np.maximum(np.abs(first), np.abs(last)), axis=0)

    def going_on(self, lead_s: float) -> "JointPlan":
        """The same way after a time at the speed of its begin, and so much further on."""
        further = np.concatenate([self.q[:1], self.q + lead_s * self.qd[0]])
        rates = (np.concatenate([part[:1], part]) for part in (self.qd, self.qdd))
        return JointPlan(np.concatenate([[0.0], self.time_s + lead_s]), further, *rates)

    def points(self) -> tuple[Array, Array, Array]:
        """Times (k,), joints and velocities (k, n) that a controller is sent; first: `LEAD_S`."""
        time = np.concatenate([[LEAD_S], self.time_s[self.time_s > LEAD_S + 1e-4]])
        q, qd = self.at(time)
        qd[-1] = 0.0  # exactly: a controller rejects a trajectory that does not end at rest
        return time, q, qd

    def slower(self, factor: float) -> "JointPlan":
        """The same way in ``factor`` times the time."""
        return JointPlan(
            self.time_s * factor, self.q, self.qd / factor, self.qdd / (factor * factor)
        )


def joined(plans: Sequence[JointPlan]) -> JointPlan:
    """Plans one after the other; each begins where the one before came to rest."""
    starts = np.cumsum([0.0, *(plan.duration_s for plan in plans[:-1])])
    rest = [slice(None), *([slice(1, None)] * (len(plans) - 1))]
    return JointPlan(
        np.concatenate([p.time_s[r] + t for p, r, t in zip(plans, rest, starts, strict=True)]),
        *(
            np.concatenate([getattr(p, name)[r] for p, r in zip(plans, rest, strict=True)])
            for name in ("q", "qd", "qdd")
        ),
    )


SHORTEST_RAMP_S = 0.07  # a controller smooths over some of its cycles
SPACING_S = 0.01  # of points; the cubic between two of a circle of 12 mm misses by nanometres
MOST_POINTS = 200  # of one phase


@dataclass(frozen=True)
class Ride:
    """A way of ``length_m`` at ``speed_m_s`` but for two ramps of ``ramp_s``.

    On a ramp the speed is v (3 u^2 - 2 u^3), u from 0 to 1: its acceleration begins and ends at
    zero, and is 1.5 v / ramp_s at most.
    """

    length_m: float
    speed_m_s: float
    ramp_s: float

    @classmethod
    def within(cls, length_m: float, speed_m_s: float, acceleration_m_s2: float) -> "Ride":
        """The fastest within bounds; a short way does not reach the speed."""
        reached = min(
            speed_m_s,
            length_m / SHORTEST_RAMP_S,
            float(np.sqrt(length_m * acceleration_m_s2 / 1.5)),
        )
        return cls(length_m, reached, ramp_of(reached, acceleration_m_s2))

    @property
    def cruise_s(self) -> float:
        """At constant speed."""
        if self.speed_m_s == 0.0:
            return 0.0
        return max(self.length_m / self.speed_m_s - self.ramp_s, 0.0)

    @property
    def duration_s(self) -> float:
        """From rest to rest."""
        return self.cruise_s + 2.0 * self.ramp_s

    def times(self) -> Array:
        """Times (k,) for points: dense enough for cubics, and where a phase begins or ends."""
        ends = np.cumsum([0.0, self.ramp_s, self.cruise_s, self.ramp_s])
        phases = [np.zeros(1)]
        for start, end in pairwise(ends):
            count = min(int(np.ceil((end - start) / SPACING_S - 1e-6)), MOST_POINTS)
            phases.append(np.linspace(start, end, count + 1)[1:])
        return np.concatenate(phases)

    def __call__(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Way, speed and acceleration (k,) along it."""
        v, ramp = self.speed_m_s, self.ramp_s
        to_go = self.duration_s - time_s
        late = to_go < time_s  # the second half mirrors the first
        t = np.where(late, to_go, time_s)
        u = np.clip(t / ramp, 0.0, 1.0)
        way = v * (ramp * (u**3 - 0.5 * u**4) + np.maximum(t - ramp, 0.0))
        push = 6.0 * v / ramp * (u - u * u)
        return (
            np.where(late, self.length_m - way, way),
            v * (3.0 * u**2 - 2.0 * u**3),
            np.where(late, -push, push),
        )


def ramp_of(speed_m_s: float, acceleration_m_s2: float) -> float:
    """Duration of a ramp up to a speed, s."""
    return max(SHORTEST_RAMP_S, 1.5 * speed_m_s / acceleration_m_s2)


@dataclass(frozen=True, eq=False)
class TipPath:
    """The flange's orientation and the tip's place over time."""

    time_s: Array  # (k,)
    T_base_tip: Array  # (k, 4, 4) with the flange's axes and the tip as origin
    # twist, twist_rate: (k, 6) [v; w] of the tip in base, and its derivative
    twist: Array
    twist_rate: Array


def line(T_start: Array, T_end: Array, ride: Ride) -> TipPath:
    """Straight from pose to pose (4, 4), turning evenly by the smallest angle on the way."""
    time = ride.times()
    along = np.stack(ride(time)) / max(ride.length_m, 1e-300)
    screw = np.concatenate(
        [T_end[:3, 3] - T_start[:3, 3], frames.log_rotation(T_end[:3, :3] @ T_start[:3, :3].T)]
    )
    share, speed, push = along[:, :, None] * screw
    R = frames.exp_rotation(share[:, 3:]) @ T_start[:3, :3]
    return TipPath(time, frames.transform(R, T_start[:3, 3] + share[:, :3]), speed, push)


def circle(
    T_start: Array,
    R_base_laser: Array,
    radius_m: float,
    from_rad: float,
    direction: int,
    ride: Ride,
) -> TipPath:
    """Along a circle in the laser's x-y plane, from its angle ``from_rad``; turning not at all."""
    time = ride.times()
    way, speed, push = (direction * x / radius_m for x in ride(time))
    angle = from_rad + way
    out = _across(angle, R_base_laser) - _across(np.array([from_rad]), R_base_laser)
    velocity = _across(angle + np.pi / 2.0, R_base_laser) * speed[:, None]
    acceleration = (
        _across(angle + np.pi / 2.0, R_base_laser) * push[:, None]
        - _across(angle, R_base_laser) * speed[:, None] ** 2
    )
    return _shifted(T_start, time, radius_m * out, radius_m * velocity, radius_m * acceleration)


def plunge(T_start: Array, R_base_laser: Array, ride: Ride) -> TipPath:
    """Down along the laser's -z, at rest for an instant, and up again."""
    down = ride.times()
    way, speed, push = ride(down)
    z = -R_base_laser[:, 2]
    time = np.concatenate([down, down[-1] + down[1:]])
    back = slice(-2, None, -1)
    return _shifted(
        T_start,
        time,
        np.concatenate([way, way[back]])[:, None] * z,
        np.concatenate([speed, -speed[back]])[:, None] * z,
        np.concatenate([push, push[back]])[:, None] * z,
    )


def _across(angle: Array, R_base_laser: Array) -> Array:
    """Unit vectors (k, 3), base, at angles from the laser's x."""
    return np.asarray(np.column_stack([np.cos(angle), np.sin(angle)]) @ R_base_laser[:, :2].T)


def _shifted(T: Array, time: Array, shift: Array, velocity: Array, acceleration: Array) -> TipPath:
    poses = np.tile(T, (len(time), 1, 1))
    poses[:, :3, 3] += shift
    still = np.zeros_like(shift)
    return TipPath(time, poses, np.hstack([velocity, still]), np.hstack([acceleration, still]))


# How far from where a step begins each joint may stand.
START_NEAR_RAD = float(np.radians(0.02))
START_NEAR_M = 5e-5  # prismatic


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Largest values; those of joints for all, or (n,) for each."""

    # joint_velocity, joint_acceleration: rad/s and rad/s^2 (prismatic: m/s and m/s^2)
    joint_velocity: ArrayLike = 1.0
    joint_acceleration: ArrayLike = 5.0
    stop_deceleration: ArrayLike = 10.0  # of a stop after a fault, rad/s^2 (prismatic: m/s^2)
    # tcp_speed_m_s, tcp_acceleration_m_s2: of the tool's tip along its path, on every way
    tcp_speed_m_s: float = 0.05
    tcp_acceleration_m_s2: float = 1.2
    # plunge_speed_m_s, plunge_depth_m: of a plunge
    plunge_speed_m_s: float = 0.01
    plunge_depth_m: float = 0.02

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            numbers = np.array(value, dtype=np.float64)
            if not np.all((numbers > 0.0) & (numbers < np.inf)):
                raise InputError(f"{name} = {value}: must be positive and finite")

    def of_joints(self, arm: SerialArm) -> tuple[Array, Array, Array]:
        """Velocity, acceleration and stop deceleration, (n,) each.

        Raises `InputError` when one is given for another number of joints.
        """
        found = []
        for name in ("joint_velocity", "joint_acceleration", "stop_deceleration"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape not in ((), (1,), (arm.n,)):
                raise InputError(
                    f"{name} has {values.size} values: give one for all joints or {arm.n}"
                )
            found.append(np.broadcast_to(values, (arm.n,)))
        return found[0], found[1], found[2]


def start_near(arm: SerialArm) -> Array:
    """How far (n,) from where a motion begins each joint may stand, rad (m)."""
    return np.where(arm.prismatic, START_NEAR_M, START_NEAR_RAD)


# A controller lags or leads its readings by some of its cycles: a shorter stop would throw it back.
SHORTEST_STOP_S = 0.12


def stop_time(arm: SerialArm, limits: MotionLimits, qd: Array) -> Array:
    """Duration (...,) of stops from velocities (..., n), s."""
    _, _, deceleration = limits.of_joints(arm)
    return np.asarray(np.maximum(np.max(np.abs(qd) / deceleration, axis=-1), SHORTEST_STOP_S))


def stop(
    arm: SerialArm,
    limits: MotionLimits,
    q: ArrayLike,
    qd: ArrayLike,
    shortest_s: float = SHORTEST_STOP_S,
) -> JointPlan:
    """From measured joints and velocities (n,) to rest.

    All joints slow down evenly and come to rest together, so that the way goes on in its
    direction: q(t) = q + qd (t - t^2 / 2 T). T is `stop_time`: the joint that needs longest slows
    down by ``stop_deceleration``. Where a joint would pass its limit on that way, T is what the
    limit leaves, and all slow down harder; but never in less than ``shortest_s``. A joint that
    would still pass its limit begins slower: no stop leads beyond one.

    Raises `InputError` when a value is not finite: then only a hold or the controller's own stop is
    left.
    """
    here, velocity = np.asarray(q, dtype=np.float64), np.asarray(qd, dtype=np.float64)
    if here.shape != (arm.n,) or velocity.shape != (arm.n,):
        raise ValueError(f"q {here.shape} and qd {velocity.shape}: expected ({arm.n},) each")
    if not (np.all(np.isfinite(here)) and np.all(np.isfinite(velocity))):
        raise InputError("joints or velocities are not finite: let the controller stop by itself")
    room = np.where(velocity > 0.0, arm.upper - here, here - arm.lower)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        left = np.where(velocity != 0.0, 2.0 * room / np.abs(velocity), np.inf)
    needed = float(np.max(np.abs(velocity) / limits.of_joints(arm)[2]))
    duration = max(min(max(needed, shortest_s), float(np.min(left))), shortest_s)
    most = 2.0 * np.maximum(room, 0.0) / duration
    velocity = np.clip(velocity, -most, most)
    slowing = -velocity / duration
    return JointPlan(
        np.array([0.0, duration]),
        np.stack([here, here + 0.5 * duration * velocity]),
        np.stack([velocity, np.zeros(arm.n)]),
        np.stack([slowing, slowing]),
    )
