# SPDX-License-Identifier: Apache-2.0
"""The true robot: what really happens to the flange when the encoders show some joint values.

Forward kinematics here are plain products of 4 x 4 matrices, one per elementary motion, so that a
mistake in the estimators' compiled kernels cannot hide.
"""

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.cell_sim.gears import GearErrors
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm

LONGEST_STEP_S = 5.0


@dataclass(frozen=True, eq=False)
class Warmth:
    """Temperatures above those of the cold robot, K.

    ``motor`` (n,): of each joint's motor and gear.
    ``link`` (n,): of the link that follows each joint.
    """

    motor: Array
    link: Array

    @classmethod
    def cold(cls, n: int) -> "Warmth":
        """The cold robot."""
        return cls(np.zeros(n), np.zeros(n))


@dataclass(frozen=True, eq=False)
class WarmUp:
    """How motors and links heat up.

    ``tau dT/dt = T_end - T``: a motor tends to ``motor_rise`` times its duty, a link to
    ``link_share`` times the mean of the motors at its two ends.

    ``motor_rise`` (n,): steady rise of each motor at duty 1, K.
    ``motor_tau_s``, ``link_tau_s``: time constants.
    ``link_share`` (n,): part of the motors' rise that a link reaches.
    """

    motor_rise: Array
    motor_tau_s: float
    link_share: Array
    link_tau_s: float

    def step(self, warmth: Warmth, duty: ArrayLike, duration_s: float) -> Warmth:
        """Return the temperatures after ``duration_s`` at a constant duty (n,), each 0 to 1."""
        count = max(1, int(np.ceil(duration_s / LONGEST_STEP_S)))
        keep_motor = np.exp(-duration_s / count / self.motor_tau_s)
        keep_link = np.exp(-duration_s / count / self.link_tau_s)
        motor, link = np.append(warmth.motor, warmth.motor[-1]), warmth.link  # the last one twice
        goal = self.motor_rise * np.asarray(duty, dtype=np.float64)
        goal, half_share = np.append(goal, goal[-1]), 0.5 * self.link_share
        for _ in range(count):
            link_goal = half_share * (motor[:-1] + motor[1:])
            motor = goal + keep_motor * (motor - goal)
            link = link_goal + keep_link * (link - link_goal)
        return Warmth(motor[:-1], link)


GRAVITY = np.array([0.0, 0.0, -9.81])
ABOUT_GRAVITY = np.cross(np.eye(3), GRAVITY)  # v @ it: v x gravity


@dataclass(frozen=True)
class Effects:
    """Which parts of the truth are switched on.

    The estimators model ``static`` and ``drift``, and know the size of ``noise``. Those of a
    drift know nothing of ``compliance``, ``eccentricity``, ``gears``, ``stem`` and
    ``sensor_warm_up``, and are to recognise ``outliers``.
    """

    static: bool = True
    drift: bool = True
    noise: bool = True
    compliance: bool = True
    eccentricity: bool = True
    stem: bool = True
    sensor_warm_up: bool = True
    outliers: bool = True
    gears: bool = True

    @classmethod
    def none(cls) -> "Effects":
        """The nominal robot and a perfect sensor."""
        return cls(*[False] * 9)

    @classmethod
    def modelled(cls) -> "Effects":
        """Only what the estimators model."""
        return replace(cls.none(), static=True, drift=True, noise=True)


@dataclass(frozen=True, eq=False)
class FlexibleBody:
    """Masses and joint stiffness.

    ``mass`` (n,): of each link with its drives, the last one with the payload, kg.
    ``centre`` (n, 3): centre of mass in the link's own frame (the one after its joint), m.
    ``stiffness`` (n,): of each joint, N m / rad (prismatic: N / m).
    ``softening``: relative loss of stiffness per kelvin of the joint's motor.
    """

    mass: Array
    centre: Array
    stiffness: Array
    softening: float


@dataclass(frozen=True, eq=False)
class TrueRobot:
    """A robot as it is.

    ``nominal``: the numbers it was designed to; only those are taken from it, never its functions.
    ``static_error`` (n, 5): true minus nominal d, theta, a, alpha, beta of the cold robot, m and
    rad.
    ``motor_gain``, ``link_gain`` (n, 5, n): change of each parameter per kelvin of each motor and
    link.
    ``body``: masses and stiffness.
    ``eccentricity``, ``phase`` (n,): amplitude and phase of each encoder's once-per-turn error,
    rad.
    ``repeatability``: standard deviation of the joint values at rest, rad.
    ``gears``: their errors; None: none.
    """

    nominal: SerialArm
    static_error: Array
    motor_gain: Array
    link_gain: Array
    body: FlexibleBody
    eccentricity: Array
    phase: Array
    repeatability: float
    effects: Effects = field(default_factory=Effects)
    gears: GearErrors | None = None

    @property
    def backlash(self) -> GearErrors | None:
        """The gears where their errors are switched on."""
        return self.gears if self.effects.gears else None

    def mdh(self, warmth: Warmth) -> Array:
        """True parameters (n, 5) at these temperatures, without the joints' elastic deflection."""
        mdh = np.array(self.nominal.mdh)
        if self.effects.static:
            mdh += self.static_error
        if self.effects.drift:
            mdh += self.motor_gain @ warmth.motor + self.link_gain @ warmth.link
        return mdh

    def flange(
        self,
        reading: ArrayLike,
        warmth: Warmth,
        rng: np.random.Generator | None = None,
        behind: Array | None = None,
    ) -> Array:
        """True T_base_flange (m, 4, 4) while the encoders show ``reading`` (m, n).

        ``rng`` adds the repeatability of one visit; None gives the mean over visits. ``behind``
        (m, n): how far backlash holds each joint back, rad; a visit that is not told comes from
        either side.
        """
        q = np.atleast_2d(np.asarray(reading, dtype=np.float64))
        joint = q.copy()
        if self.effects.eccentricity:
            joint += self.eccentricity * np.sin(q + self.phase)
        if rng is not None and self.effects.noise:
            joint += self.repeatability * rng.standard_normal(q.shape)
        if (gears := self.backlash) is not None:
            joint += gears.at(q)
            if behind is None and rng is not None:
                behind = gears.behind(rng.uniform(-1.0, 1.0, q.shape))
            joint -= 0.0 if behind is None else behind
        mdh = self.mdh(warmth)
        if not self.effects.compliance:
            return self._frames(joint, mdh)[-1]
        stiffness = self.body.stiffness * (1.0 - self.body.softening * warmth.motor)
        sag = np.zeros_like(joint)
        for _ in range(2):  # the sag changes the load by a thousandth
            sag = self._load(self._frames(joint, mdh, sag)) / stiffness
        return self._frames(joint, mdh, sag)[-1]

    def point(
        self,
        reading: ArrayLike,
        warmth: Warmth,
        p_flange: ArrayLike,
        rng: np.random.Generator | None = None,
    ) -> Array:
        """True position (m, 3) in base, m, of a point (3,) fixed to the flange."""
        p = np.append(np.asarray(p_flange, dtype=np.float64), 1.0)
        return np.asarray((self.flange(reading, warmth, rng) @ p)[:, :3])

    def _frames(self, joint: Array, mdh: Array, sag: Array | None = None) -> list[Array]:
        """Poses (m, 4, 4) in base of the root and of the frame after each joint."""
        nominal, slides = self.nominal, self.nominal.prismatic
        moved = nominal.sign * joint if sag is None else nominal.sign * joint + sag
        along = np.where(slides, mdh[:, 0] + moved, mdh[:, 0])
        about = np.where(slides, mdh[:, 1], mdh[:, 1] + moved)
        drive = turn(2, about.ravel())
        drive[:, 2, 3] = along.ravel()
        fixed = turn(0, mdh[:, 3]) @ turn(1, mdh[:, 4])
        fixed[:, 0, 3] = mdh[:, 2]
        steps = drive.reshape(*joint.shape, 4, 4) @ fixed
        frames = [np.broadcast_to(np.array(nominal.T_base_root), (len(joint), 4, 4))]
        for i in range(nominal.n):
            frames.append(frames[-1] @ steps[:, i])
        return frames

    def _load(self, frames: list[Array]) -> Array:
        """Torque (m, n) of gravity about each joint's axis, N m (prismatic: force along it, N)."""
        spots = np.column_stack([self.body.centre, np.ones(len(self.body.centre))])
        centres = [(T @ spot)[:, :3] for T, spot in zip(frames[1:], spots, strict=True)]
        driven = np.array(frames[:-1])
        axes, origins = driven[:, :, :3, 2], driven[:, :, :3, 3]
        pull = np.empty_like(axes)
        mass, moment = 0.0, np.zeros((len(frames[0]), 3))  # of all that the joint carries
        for i in reversed(range(self.nominal.n)):
            mass, moment = mass + self.body.mass[i], moment + self.body.mass[i] * centres[i]
            pull[i] = mass * GRAVITY if self.nominal.prismatic[i] else moment - mass * origins[i]
        turns = ~self.nominal.prismatic
        pull[turns] = pull[turns] @ ABOUT_GRAVITY
        return np.asarray(np.sum(axes * pull, axis=2).T)


def turn(axis: int, angle: Array) -> Array:
    """Rotations (m, 4, 4) about a coordinate axis, rad."""
    T = np.tile(np.eye(4), (len(angle), 1, 1))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    T[:, i, i] = T[:, j, j] = np.cos(angle)
    T[:, i, j], T[:, j, i] = -np.sin(angle), np.sin(angle)
    return T


class Stream(IntEnum):
    """What random numbers are for."""

    STATION = 0
    SCATTER = 1
    RIPPLE = 2
    EDGES = 3
    READINGS = 4
    LOST_READINGS = 5
    SHOTS = 6
    LOST_SHOTS = 7
    LOST_EDGES = 8
    TEMPERATURES = 9
    PROFILES = 10
    LOST_COMMANDS = 11
    FEATURES = 12


class Draws:
    """Generators of one seed: the same purpose and place give the same numbers.

    So it does not matter how time is cut into pieces, and one thing that is switched on or off
    leaves the numbers of all others alone.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def of(self, stream: Stream, place: int = 0) -> np.random.Generator:
        """A generator for a purpose at a place, such as a tick."""
        return np.random.default_rng([self._seed, stream, place])


ROUNDED_K = 0.1  # a temperature is told in such steps


@dataclass(frozen=True, eq=False)
class HeatPlan:
    """What heats a robot.

    ``rated`` (n,): mean speed of each joint that is duty 1, rad/s (prismatic: m/s).
    ``ambient_c``, ``noise_k``: of the cell, and of a told temperature.
    """

    warm_up: WarmUp
    rated: Array
    ambient_c: float = 22.0
    noise_k: float = 0.1


@dataclass(frozen=True, eq=False)
class Temperatures:
    """Motor temperatures (n,), deg C, as told at a time."""

    time_s: float
    celsius: Array


class Heating:
    """A robot that warms up, from cold.

    ``warmth``: as it is.
    ``level``: factor on the heat; 0: it stays as it is, or cools.
    """

    def __init__(self, plan: HeatPlan, draws: Draws) -> None:
        self.plan, self._draws = plan, draws
        self.warmth = Warmth.cold(len(plan.rated))
        self.level = 1.0

    def step(self, way: Array, duration_s: float) -> None:
        """The joints went so far (n,), to and fro, in this time."""
        duty = self.level * way / duration_s / self.plan.rated
        self.warmth = self.plan.warm_up.step(self.warmth, duty, duration_s)

    def tell(self, time_s: float, number: int, swapped: bool) -> Temperatures:
        """What the motors' sensors say; ``swapped``: with the second and third cable exchanged."""
        noise = self._draws.of(Stream.TEMPERATURES, number).standard_normal(len(self.plan.rated))
        celsius = self.plan.ambient_c + self.warmth.motor + self.plan.noise_k * noise
        if swapped:
            celsius[[1, 2]] = celsius[[2, 1]]
        return Temperatures(time_s, np.round(celsius / ROUNDED_K) * ROUNDED_K)


SETTLE_S = 0.05  # another one is reached smoothly: the flange never jumps
KEPT = 32  # motions in one stretch of time that is looked at


class Scatter:
    """Offsets (k,) over time, each from a motion's begin on."""

    def __init__(self, size: int) -> None:
        self._time_s = np.array([-np.inf])
        self._before = self._after = np.zeros((1, size))

    @property
    def settled_s(self) -> float:
        """When the last one is reached."""
        return float(self._time_s[-1]) + SETTLE_S

    def begin(self, time_s: float, offset: Array) -> None:
        """Another offset (k,), from a time on that is not before the last one."""
        before = self.at(np.array([time_s]))
        self._time_s = np.append(self._time_s, time_s)[-KEPT:]
        self._before = np.vstack([self._before, before])[-KEPT:]
        self._after = np.vstack([self._after, offset])[-KEPT:]

    def at(self, time_s: Array) -> Array:
        """Offsets (m, k) at times (m,)."""
        i = np.maximum(np.searchsorted(self._time_s, time_s, side="right") - 1, 0)
        share = np.clip((time_s - self._time_s[i]) / SETTLE_S, 0.0, 1.0)[:, None]
        smooth = share**2 * (3.0 - 2.0 * share)
        return np.asarray(self._before[i] + smooth * (self._after[i] - self._before[i]))
