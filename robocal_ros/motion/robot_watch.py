# SPDX-License-Identifier: Apache-2.0
"""What is watched while the robot moves: its plan, and the production gap."""

import math
import secrets
from collections import deque
from dataclasses import dataclass

import numpy as np

from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import Silence
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.cell import DrivingConfig, MotionCell
from robocal_ros.motion.plan import JointPlan, start_near

TOLD_S = 1.0  # what was not told again for so long is not known
PERCENT = 0.01
CONTROLLER, SLIDER = "controller", "slider"


class SpeedScaling:
    """The newest of each source, by a steady clock; the controller knows better than the slider.

    A controller that fills no scaling leaves it at 0, and a broadcaster says 0 before it knows
    any: so a 0 counts only after another number of the same source. What is negative or not
    finite tells nothing, and what is faster than planned counts as 1. A robot that pauses goes on
    to tell so; a source that is silent has died, and says nothing of the robot now.
    """

    def __init__(self) -> None:
        self._told: dict[str, tuple[float, float]] = {}

    def controller(self, factor: float, now_s: float) -> None:
        """Take ``speed_scaling_factor`` of a controller's state, 1 as planned."""
        self._tell(CONTROLLER, factor, now_s)

    def slider(self, percent: float, now_s: float) -> None:
        """Take what ur_robot_driver's speed_scaling_state_broadcaster publishes, 100 as planned."""
        self._tell(SLIDER, percent * PERCENT, now_s)

    def _tell(self, source: str, factor: float, now_s: float) -> None:
        if math.isfinite(factor) and (factor > 0.0 or (factor == 0.0 and source in self._told)):
            self._told[source] = min(factor, 1.0), now_s

    def at(self, now_s: float) -> float | None:
        """The scaling, 0 to 1; None where nobody told it lately."""
        for source in (CONTROLLER, SLIDER) if self._told else ():
            factor, told_s = self._told.get(source, (0.0, -math.inf))
            if now_s - told_s <= TOLD_S:
                return factor
        return None


# Two clocks run apart by less: ntpd slews by 500 ppm, crystals err by 100.
DRIFT = 6e-4
USUAL_S = 0.01  # what is no later: stamps and messages scatter by as much
BEHIND_S = 0.03  # after later ones more wait: they are taken before anything is made of them
LATE_S, LATELY_S = 0.1, 5.0  # later ones are told of, for so long
# chronyd slews by up to 83 333 ppm (maxslewrate of chrony.conf): what it takes back makes messages
# late. Lateness that grew no faster, also over the longest time without a message that is bridged,
# and then was the same for `STEADY_S`, with hardly a message left out, is of a clock.
SLEW, BRIDGED_S, STEADY_S = 0.0834, 0.25, 5.0
LEFT_OUT, APART = 0.005, 1.75  # share of intervals that are so much longer than the mean
# Small stalls, or a queue that is hardly too slow, make messages late as a slewed clock does. Where
# the quickest one is no older than this, the two wall clocks agree, or come to agree, and tell it.
AGREE_S = 2.0


class Lateness:
    """How late messages of one source come, by their own stamps; times of a steady clock.

    Later than the quickest one: what the clocks differ by is in all of them alike. They are as late
    as that clock has them which has them least, so that setting one of the receiver's makes nothing
    late. A source's clock that is set back begins anew; one that is taken back bit by bit makes
    late while it is, and for `STEADY_S` more. A queue grows by stalls, or drains, or is full and
    leaves messages out; by clocks that agree what waits in it is old.

    ``late_s``: the last message; 0 where that is usual, or it has no stamp.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self.late_s = 0.0
        self._stamp_s = self._taken_s = -math.inf
        self._least_s: list[float] = []
        self._worst_s, self._worst_at_s = 0.0, -math.inf
        # what of it came no faster than a clock is slewed, seen when; since when that is the same,
        # by the clock and the stamps, how much it was, messages since, those after one left out
        self._slewed_s, self._slewed_at_s = 0.0, -math.inf
        self._steady = (-math.inf, 0.0, 0.0)
        self._count = self._left_out = 0

    def take(self, stamp_s: float, now_s: float, *ages_s: float) -> float:
        """Take a message that comes now, of these ages by other clocks; how late it is."""
        self.late_s = 0.0
        if not stamp_s:
            return 0.0
        offsets, least, late_s = [now_s - stamp_s, *ages_s], self._least_s, math.inf
        if stamp_s < self._stamp_s or len(offsets) != len(least):
            least = self._least_s = list(offsets)
            self._slewed_s, self._taken_s = 0.0, now_s
            self._steady_from(now_s, stamp_s)
        drift_s = DRIFT * max(now_s - self._taken_s, 0.0)
        for i, offset in enumerate(offsets):
            least[i] = min(offset, least[i] + drift_s)
            late_s = min(late_s, offset - least[i])
        self._slewed_s -= drift_s
        late_s -= self._made_up(late_s, stamp_s, now_s)
        self._stamp_s, self._taken_s = stamp_s, now_s
        self.late_s = late_s if late_s > USUAL_S else 0.0
        if self.late_s > LATE_S:
            lately = now_s - self._worst_at_s <= LATELY_S
            self._worst_s = max(self.late_s, self._worst_s * lately)
            self._worst_at_s = now_s
        return self.late_s

    def _steady_from(self, now_s: float, stamp_s: float) -> None:
        self._steady = now_s, stamp_s, self._slewed_s
        self._count = self._left_out = 0

    def _made_up(self, late_s: float, stamp_s: float, now_s: float) -> float:
        """What of the lateness of a message is a clock's, and counts no more from now on."""
        grown_s = SLEW * min(max(now_s - self._slewed_at_s, 0.0), BRIDGED_S)
        if late_s > self._slewed_s + grown_s + USUAL_S:
            return 0.0
        self._slewed_s, self._slewed_at_s = min(late_s, self._slewed_s + grown_s), now_s
        since_s, first_s, then_s = self._steady
        self._count += 1
        if abs(self._slewed_s - then_s) > USUAL_S:
            self._steady_from(now_s, stamp_s)
        elif (stamp_s - self._stamp_s) * self._count > APART * (stamp_s - first_s):
            self._left_out += 1
        if now_s - since_s < STEADY_S:
            return 0.0
        made_up_s = self._slewed_s if self._left_out <= LEFT_OUT * self._count else 0.0
        for age_s in self._least_s[1:]:
            if age_s < AGREE_S:
                made_up_s = min(made_up_s, BEHIND_S - age_s)
        if made_up_s <= USUAL_S:
            made_up_s = 0.0
        self._slewed_s -= made_up_s
        self._least_s = [each + made_up_s for each in self._least_s]
        self._steady_from(now_s, stamp_s)
        return made_up_s

    def words(self, now_s: float) -> str:
        """That messages are late, and what to do; empty where none were lately."""
        if now_s - self._worst_at_s > LATELY_S:
            return ""
        return (
            f"{self._what} come up to {self._worst_s * 1e3:.0f} ms late, so that nobody knows "
            "where the robot is now: this computer or its network has too much to do; give this "
            "node a core of its own, end other processes, or let the controller publish less "
            "often. Where the robot's computer takes its clock back bit by bit (chronyd), to what "
            f"this one's says, this ends {STEADY_S:g} s after that"
        )


VELOCITY_S = 0.03  # span of the readings that give a velocity
LEAST, OLDEST_S = 5, 0.2  # of them, if not too old: one wild reading is outvoted
REST_RAD = 1e-4  # a robot that rests moves less
BACK_S = 1.0  # stamps that go back by more began anew
FARTHEST = 1e9  # rad or m; of what is beyond no speed is finite
AS_NEAR = 0.01  # of the allowed deviation: what no reading tells apart
APART_S = 0.00375  # instants of the plan that a reading is compared with
REFERENCE_S = 0.1  # a controller's place that is older is none
JITTER_S = 0.03  # by so much noise moves a reading back or forth along the plan
UNSAID_S = 0.1  # a scaling that rises is known so late: the robot is then ahead of its clock
PACE_S = 0.5  # ur_robot_driver's scaling comes out of a pause by 0.01 in each of its cycles of 2 ms
PAUSED_S = 15.0  # a robot that stands on its path is waited for so long where no scaling is known
LAG_S = 0.03  # of drives behind their controller; what is later began later
NEARLY_S = 0.5  # before its end a plan may bend back to where it has been
NEAR_REFERENCE_RAD = 1e-3  # a reference so near to the plan tells the plan's clock
STANDS_S = 0.1  # a robot that has rested for so long stands
# From a message to what the controller says of it (10 ms measured, a cycle, 10 ms at the speed
# before), and to readings that show it: drives lag by some 15 ms, and a speed is of readings that
# are half a span old.
SEEN_S = {True: 0.03, False: 0.045}


class LeftPlanError(LimitError):
    """The robot is not where its plan has it: it may be held, or have hit something."""


@dataclass(frozen=True)
class MotionReport:
    """What a controller says of the motion that it was sent last.

    ``ended``: it is through with it; ``failed``: it rejected it, or ended it otherwise than as
    planned; ``words``: its own. That a motion ended well proves nothing: another one may have
    taken its place.
    """

    ended: bool = False
    failed: bool = False
    words: str = ""


class RobotWatch:
    """Readings of the joints as they arrive, and the plan in force; times of a steady clock.

    A controller that scales its speed stretches the plan's clock, which stands while it pauses.
    Where nobody tells the scaling, a robot that is on its path is late, not lost.

    ``driving``: how far the robot may be beside its plan, and how fast its joints are.
    ``silence``: how long no new reading came. ``scaling``: how fast the controller's clock runs, 1
    as planned; 1 where nobody tells it lately; ``unpaused``: the same but for pauses, which tell
    nothing of what comes after them, and ramps into and out of them: a slower one counts once it
    was so for `PACE_S`. ``held_s``: when a controller that pauses was last seen to give up a
    motion, as `StatedController` has it. ``heard_s``: of when the newest reading is.
    """

    def __init__(self, arm: SerialArm, driving: DrivingConfig) -> None:
        self._arm, self._driving, self._turns = arm, driving, ~arm.prismatic
        self._fastest = driving.limits.of_joints(arm)[0]
        self.silence = Silence()
        self.scaling, self.unpaused, self.held_s = 1.0, 1.0, -np.inf
        self._scaled_s = -np.inf  # when that was told
        self._paced_s = -np.inf  # when it was last 0, or no slower than `unpaused`
        self.heard_s = 0.0
        self._readings: deque[tuple[float, Array]] = deque(maxlen=512)
        self._reference: tuple[Array, Array] | None = None
        self._reference_s = -np.inf
        self._plan: JointPlan | None = None
        self._cell: MotionCell | None = None
        self._at_s = self._driven_s = 0.0  # the plan's clock at a time
        # how far the robot has come, seen when, by which reading's stamp
        self._reached_s = self._looked_s = self._looked_at_s = 0.0
        self._moved_to_s = self._moved_s = 0.0  # the plan's clock when it last came further
        self._ended_s = np.inf  # since when the plan is over, with the robot at its end
        self._over = False
        self._away: tuple[float, float] | None = None  # by what is known now

    def reading(self, stamp_s: float, q: Array, now_s: float) -> None:
        """Take joints (n,) of the time ``now_s``; ``stamp_s`` on their own clock."""
        if self.scaling != 1.0 and not self.scaling_known(now_s):
            self._driven_s, self._at_s = self.driven_s(now_s), now_s
            self.scaling = self.unpaused = 1.0
        if self._readings and stamp_s <= self._readings[-1][0]:
            if stamp_s > self._readings[-1][0] - BACK_S:
                return  # a clock that stands still is heard as silence
            self._readings.clear()
        elif self._readings:  # of one that was set back stamps do not tell how long that was
            passed_s, told_s = now_s - self.heard_s, stamp_s - self._readings[-1][0]
            if passed_s - told_s > self._driving.silence_s:
                self._readings.clear()
        self._readings.append((stamp_s, np.clip(q, -FARTHEST, FARTHEST)))
        self.heard_s, self._away = now_s, None
        self.silence.heard(now_s)

    def scaled(self, factor: float, now_s: float) -> None:
        """The controller's clock runs so fast, 1 as planned; what is no such number is none."""
        if not 0.0 <= factor < np.inf:
            return
        self._driven_s, self._at_s = self.driven_s(now_s), now_s
        self.scaling, self._scaled_s, self._away = factor, now_s, None
        if factor == 0.0 or factor >= self.unpaused:
            self.unpaused, self._paced_s = factor or self.unpaused, now_s
        elif now_s - self._paced_s >= PACE_S:
            self.unpaused = factor

    def controller(self, q: Array, qd: Array, now_s: float) -> None:
        """Where the controller is on its trajectory: joints and unscaled velocities (n,)."""
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(qd))):
            return
        self._reference, self._reference_s = (q, qd), now_s
        if self._plan is None or np.max(np.abs(qd)) < 1e-2:
            return
        here_s = self.driven_s(now_s)
        times = here_s + np.linspace(-UNSAID_S, UNSAID_S, 41)
        away = np.max(np.abs(self._plan.places(times) - q), axis=1)
        if away[nearest := int(np.argmin(away))] < NEAR_REFERENCE_RAD:
            self._driven_s, self._at_s, self._away = float(times[nearest]), now_s, None

    def follow(self, plan: JointPlan, cell: MotionCell, now_s: float) -> None:
        """A plan was sent."""
        self._plan, self._cell, self._away = plan, cell, None
        self._driven_s = self._reached_s = self._moved_s = self._moved_to_s = 0.0
        self._at_s = self._looked_s = now_s
        self._looked_at_s = self._readings[-1][0] if self._readings else np.inf
        self._ended_s, self._over = np.inf, False

    def sent(self, now_s: float) -> None:
        """When the plan really was sent."""
        self._at_s = self._looked_s = now_s
        self._away = None

    def ended(self) -> None:
        """The controller says that it is through with the plan."""
        self._over = True

    def slept(self, for_s: float) -> None:
        """The host was suspended for so long, and the plan with it: its controller is there too."""
        self._at_s += for_s
        self.heard_s += for_s
        self._looked_s += for_s
        self._away = None

    def forget(self) -> None:
        """No plan is in force any more."""
        self._plan = self._away = None

    @property
    def heard(self) -> bool:
        """Whether there is any reading."""
        return bool(self._readings)

    @property
    def newest(self) -> tuple[float, Array] | None:
        """Stamp and joints (n,) of the newest reading that counts; None before any."""
        return self._readings[-1] if self._readings else None

    @property
    def silent_s(self) -> float:
        """How long the joint states have been silent."""
        return self.silence.lasts_s if self._readings else np.inf

    @property
    def silent(self) -> bool:
        """Whether joint states are missing for longer than they may while the robot moves."""
        return self.silent_s > self._driving.silence_s

    def scaling_known(self, now_s: float) -> bool:
        """Whether the controller's speed scaling was told lately."""
        return now_s - self._scaled_s <= TOLD_S

    def reference(self, now_s: float) -> tuple[Array, Array] | None:
        """Joints and unscaled velocities (n,) where the controller is now; None: not known."""
        if self._reference is None or now_s - self._reference_s > REFERENCE_S:
            return None
        q, qd = self._reference
        return q + qd * self.scaling * (now_s - self._reference_s), qd

    def driven_s(self, now_s: float) -> float:
        """How far the plan's clock is."""
        return self._driven_s + (now_s - self._at_s) * self.scaling

    def late_s(self, now_s: float) -> float:
        """How far the newest reading of a robot on its path was late; 0 without a plan."""
        if self._plan is None:
            return 0.0
        driven_s = self.driven_s(min(self.heard_s, now_s))
        return min(driven_s, self._plan.duration_s) - self._reached_s

    def late(self, now_s: float) -> str:
        """That the robot is late while nobody tells its speed scaling, in words; else empty."""
        late_s = self.late_s(now_s)
        if late_s <= self._driving.late_s or self.scaling_known(now_s):
            return ""
        return (
            f"the robot is {late_s:.1f} s behind its plan, on its path: is its speed scaled, or "
            "does it pause? connect controller_state or speed_scaling, which tell it"
        )

    def at_end(self, now_s: float) -> bool:
        """Whether the plan has ended, with the robot where it ends."""
        plan = self._plan
        if plan is None or not self._readings:
            return True
        self.away()
        came = plan.duration_s - self._reached_s <= min(NEARLY_S, 0.5 * plan.duration_s)
        ended = came and self.driven_s(now_s) >= plan.duration_s
        if ended:
            off = np.abs(plan.q[-1] - self._readings[-1][1])
            ended = bool(np.all(off < start_near(self._arm)))
        self._ended_s = min(self._ended_s, now_s) if ended else np.inf
        return ended

    def ended_for_s(self, now_s: float) -> float:
        """How long ago the robot reached the plan's end; negative before."""
        return now_s - self._ended_s if self.at_end(now_s) else -np.inf

    def resting(self, span_s: float) -> Array | None:
        """The joints where the robot has rested for so long; None while it moves, or is silent."""
        recent = self._since(span_s)
        if recent is None or self.silent:
            return None
        spread = np.ptp(np.array([q for _, q in recent]), axis=0)
        return recent[-1][1] if np.max(spread) < REST_RAD else None

    def away(self) -> tuple[float, float]:
        """How far tip (m) and turning joints (rad) are from the plan's path.

        The path goes on from where the robot was, and no further than the plan's clock is.
        """
        plan, cell = self._plan, self._cell
        if plan is None or cell is None or not self._readings:
            return 0.0, 0.0
        if self._away is not None:
            return self._away
        (at_s, q), heard_s = self._readings[-1], self.heard_s
        first_s = max(self._reached_s - JITTER_S, 0.0)
        # readings that waited come at once: the time between them is that of their stamps
        since_s = max(heard_s - self._looked_s, at_s - self._looked_at_s, 0.0)
        last_s = self._reached_s + since_s + UNSAID_S
        last_s = min(last_s, self.driven_s(heard_s) + UNSAID_S * self.scaling_known(heard_s))
        last_s = max(min(last_s, plan.duration_s), first_s)
        # at each reading while a robot moves: np.linspace, vstack and norm cost twice as much
        count = math.ceil((last_s - first_s) / APART_S)
        times = first_s + np.arange(count + 1) * ((last_s - first_s) / max(count, 1))
        times[count] = last_s
        planned = plan.places(times)
        joints = (np.abs(planned - q) * self._turns).max(axis=1)
        T = cell.arm.fk(np.concatenate([planned, q[None]]))
        tips = T[:, :3, :3] @ cell.tool.p_tip + T[:, :3, 3]
        off = tips[:-1] - tips[-1]
        tip = np.sqrt((off * off).sum(axis=1))
        driving = self._driving
        shares = np.hypot(tip / driving.deviation_m, joints / driving.deviation_rad)
        nearest = int(np.argmin(shares))
        # where the plan rests all its instants are as near: it is as far as its clock
        as_near = (shares <= shares[nearest] + AS_NEAR) & (times <= self.driven_s(heard_s))
        nearest = max([nearest, *np.flatnonzero(as_near)[-1:].tolist()])
        found = float(tip[nearest]), float(joints[nearest])
        if self.keeps(*found) and times[nearest] > self._reached_s:
            self._reached_s = float(times[nearest])
            if self._reached_s > self._moved_to_s + JITTER_S:
                self._moved_to_s, self._moved_s = self._reached_s, self.driven_s(heard_s)
        self._looked_s, self._away = max(heard_s, self._looked_s), found
        self._looked_at_s = at_s
        return found

    def keeps(self, tip_m: float, joint_rad: float) -> bool:
        """Whether a robot so far from its path is on it."""
        return tip_m <= self._driving.deviation_m and joint_rad <= self._driving.deviation_rad

    def require_on_plan(self, now_s: float, rest_s: float) -> None:
        """Look after a motion; ``rest_s``: the robot may come to its end so late.

        Raises `LeftPlanError` when the robot is beside its path, behind what its controller sends
        it, or stands.
        """
        driving, plan = self._driving, self._plan
        tip_m, joint_rad = self.away()
        if not self.keeps(tip_m, joint_rad):
            raise LeftPlanError(
                f"the robot is {tip_m * 1e3:.1f} mm and {np.degrees(joint_rad):.2f} deg away from "
                f"its plan (allowed {driving.deviation_m * 1e3:.1f} mm, "
                f"{np.degrees(driving.deviation_rad):.2f} deg)"
            )
        if plan is None or self.at_end(now_s):
            return
        late_s, known = self.late_s(now_s), self.reference(now_s) is not None
        if known and not self._over and late_s > driving.late_s + UNSAID_S:
            raise LeftPlanError(
                f"the robot is {late_s:.2f} s behind its controller (allowed "
                f"{driving.late_s + UNSAID_S:.2f} s)"
            )
        nearly = self._reached_s >= plan.duration_s - driving.late_s - UNSAID_S
        told = nearly or self._over or self.scaling_known(now_s)
        waits_s = rest_s if told else PAUSED_S
        since_s = max(self._moved_s, min(plan.duration_s, self.driven_s(now_s)) * nearly)
        if self.driven_s(now_s) - since_s > waits_s:
            raise LeftPlanError(
                f"the robot has not come further on its path for {waits_s:g} s, and is not where "
                "its motion ends"
            )

    def state(self, now_s: float, *, keeps: bool) -> tuple[Array, Array]:
        """Joints and unscaled velocities (n,) to stop from.

        The controller's, where it tells them; the plan's, where the robot keeps to it in time:
        readings lag behind what the controller commands; a stop from there would throw it back.
        A motion that reached the controller late is ahead of it: from there it would be hurried.
        One that does not keep to its plan is where most of its last readings have it (Theil-Sen:
        the medians of the slopes of all pairs, and of where each reading puts it): a stop from a
        single wild reading would be a motion of its own. A robot that pauses is held where it is.
        """
        paused = self.scaling == 0.0
        if not paused and keeps and (reference := self.reference(now_s)) is not None:
            return reference
        late_s = self.late_s(now_s)
        if self._plan is not None and keeps and late_s <= self._driving.late_s and not paused:
            return self._plan.at(self.driven_s(now_s) - max(late_s - LAG_S, 0.0))
        times, q = self._latest()
        velocity = np.zeros(q.shape[1])
        if times[0] <= times[-1] - VELOCITY_S and not paused:
            velocity = self._slope(times, q)
        since_s = times[-1] - times + np.clip(now_s - self.heard_s, 0.0, OLDEST_S)
        here = np.median(q + since_s[:, None] * velocity, axis=0)
        return here, np.clip(velocity / max(self.scaling, 0.1), -self._fastest, self._fastest)

    def blind(self, now_s: float) -> bool:
        """Whether joint states are missing, so that nobody knows whether it stands."""
        return self.silent_s > STANDS_S

    def at_rest(self, now_s: float) -> bool:
        """Whether the robot has stood for `STANDS_S`."""
        return self.resting(STANDS_S) is not None

    def seen_s(self, now_s: float) -> float:
        """What the robot is sent shows so late."""
        if self.reference(now_s) is not None:
            return SEEN_S[True] + max(self.silent_s, now_s - self._reference_s)
        return SEEN_S[False] + max(self.silent_s, now_s - self.heard_s)

    def to_stop(self, now_s: float) -> tuple[Array, Array]:
        """The `state` of a robot that did not obey a stop."""
        return self.state(now_s, keeps=self.reference(now_s) is not None)

    def speed(self, now_s: float) -> float:
        """Largest unscaled speed of a joint, rad/s (m/s); NaN where nothing tells it.

        Readings from before a silence do not: the robot may have stopped meanwhile.
        """
        if (reference := self.reference(now_s)) is not None:
            return float(np.max(np.abs(reference[1])))
        if not self._readings:
            return float("nan")
        times, q = self._latest()
        if len(times) < 2 or np.max(np.diff(times)) > self._driving.silence_s:
            return float("nan")
        return float(np.max(np.abs(self._slope(times, q)))) / max(self.scaling, 0.1)

    def _slope(self, times: Array, q: Array) -> Array:
        i, j = np.triu_indices(len(times), 1)
        slopes = (q[j] - q[i]) / (times[j] - times[i])[:, None]
        return np.clip(np.median(slopes, axis=0), -self._fastest, self._fastest)

    def _latest(self) -> tuple[Array, Array]:
        """Stamps (m,) and joints (m, n) of the readings that tell where it is and how fast."""
        count = max(len(self._since(VELOCITY_S) or ()), LEAST)
        oldest_s = self._readings[-1][0] - OLDEST_S
        recent = [reading for reading in list(self._readings)[-count:] if reading[0] >= oldest_s]
        return np.array([at_s for at_s, _ in recent]), np.array([q for _, q in recent])

    def tells_speed(self, within_s: float) -> bool:
        """Whether the readings that give a velocity span no more than this."""
        recent = self._since(VELOCITY_S)
        return recent is not None and recent[-1][0] - recent[0][0] <= within_s

    def _since(self, span_s: float) -> list[tuple[float, Array]] | None:
        """Readings of the last ``span_s``; None before there are enough."""
        readings = self._readings
        if not readings or readings[0][0] > (first_s := readings[-1][0] - span_s):
            return None
        recent = []
        for reading in reversed(readings):
            recent.append(reading)
            if reading[0] <= first_s:
                break
        return recent[::-1]


LONGEST_GAP_S = 86_400.0
STALL_S = 0.1  # between two looks: more is a pause of the own process
DRAIN_S = 0.1  # after one, until all that waited for it has been taken
BEAT_S = 0.2  # between two beats
MOST_BEAT = 2**32 - 1  # 1 follows; 0, which a message has by itself, is never a beat
KNOWN_BEATS = 16


class Gap:
    """Follows the PLC's heartbeat ``gap_open`` and the end of the gap that was told; steady clock.

    The PLC echoes the newest beat that it has read. An echo is fresh while its beat was counted up
    no longer than ``stale_s`` ago, so that the way to the PLC and back is in it. The gap is open
    while the last message says so, a fresh echo came no longer than ``stale_s`` ago, and its beat
    is no older than ``stale_s + BEAT_S``: a value that is repeated closes the gap by then.

    A message that is taken just after a pause of the own process may have waited all through it: it
    counts from before the pause, or from when its beat was counted up.

    ``stale_s``: a heartbeat counts for so long, and so old may the beat be that it echoes.
    """

    def __init__(self, stale_s: float) -> None:
        self._stale_s = stale_s
        self._open, self._came_s = False, -np.inf  # what the newest message said, and when
        self._echo: int | None = None
        self._fresh_s = self._beat_s = -np.inf  # the newest fresh echo: when it came, its beat
        self.beat = secrets.randbelow(MOST_BEAT) + 1  # an echo of before a restart is none of ours
        self._counted_s: dict[int, float] = {}
        self._looked_s: float | None = None
        self._paused_s = self._drained_s = -np.inf  # the last pause's begin, and the end of doubt
        self._doubt = ""
        self.ends_s = -np.inf

    def look(self, now_s: float) -> None:
        """The own process goes on; call it every 20 ms."""
        if self._looked_s is not None and now_s - self._looked_s > STALL_S:
            if self._looked_s >= self._drained_s:
                self._paused_s = self._looked_s
            self._drained_s = now_s + DRAIN_S
        self._looked_s = now_s

    def count(self, now_s: float) -> int:
        """The next beat, which is to be published now."""
        self.beat = self.beat % MOST_BEAT + 1
        self._know(self.beat, now_s)
        return self.beat

    def saw(self, beat: int, now_s: float) -> None:
        """Take a beat that another process counts; one that comes again is no newer."""
        self.look(now_s)
        if beat and beat not in self._counted_s:
            self._know(beat, self._since_s(now_s))

    def heard(self, is_open: bool, echo: int | None, now_s: float) -> None:
        """Take a heartbeat; ``echo`` None: of a PLC that does not echo, and counts as fresh."""
        self.look(now_s)
        self._open, self._echo, self._came_s = is_open, echo, self._since_s(now_s)
        beat_s = self._came_s if echo is None else self._counted_s.get(echo, -np.inf)
        if not is_open:
            self._fresh_s = self._beat_s = -np.inf
        elif self._came_s - beat_s <= self._stale_s:
            self._fresh_s, self._beat_s = max(self._came_s, beat_s), beat_s

    def doubt(self, why: str) -> None:
        """Nobody knows whose heartbeats these are: closed; empty ends that."""
        self._doubt = why

    def begin(self, gap_s: float, now_s: float) -> None:
        """A gap of a length at the most begins.

        Raises `InputError` when the length makes no sense.
        """
        if not 0.0 < gap_s <= LONGEST_GAP_S:
            raise InputError(
                f"a gap of {gap_s:g} s: tell its length, up to {LONGEST_GAP_S:g} s, in seconds"
            )
        self.ends_s = now_s + gap_s

    def left_s(self, now_s: float) -> float:
        """Until the end that was told; negative afterwards."""
        return self.ends_s - now_s

    def closed(self, now_s: float) -> str:
        """Why the robot may not be moved by the heartbeat; empty when it may."""
        stale_s = self._stale_s
        if self._doubt:
            return self._doubt
        if self._came_s == -np.inf:
            return "gap_open was never heard: let the PLC publish it at 5 Hz"
        if not 0.0 <= now_s - max(self._came_s, self._fresh_s) <= stale_s:
            return f"gap_open is silent for more than {stale_s:g} s"
        if not self._open:
            return "gap_open is false"
        if now_s - self._fresh_s > stale_s or now_s - self._beat_s > stale_s + BEAT_S:
            return (
                f"gap_open echoes {self._echo}, which is no beat of the last {stale_s:g} s: let "
                "the PLC's program echo the newest beat of maintenance_node/status"
            )
        return ""

    def waits(self, now_s: float) -> bool:
        """Whether no heartbeat is fresh for a pause of the own process alone.

        All that is known is from before the pause; a PLC that lives says more within ``stale_s``.
        """
        if not self._fresh_s < self._drained_s or now_s > self._drained_s + self._stale_s:
            return False
        return self._open and not self._doubt and self.left_s(now_s) > 0.0

    def over(self, now_s: float) -> str:
        """Why the run must end: the gap is closed, or its time has run out; else empty."""
        if (why := self.closed(now_s)) != "":
            return why
        return "the gap's time has run out" if self.left_s(now_s) <= 0.0 else ""

    def _since_s(self, now_s: float) -> float:
        """From when on counts what is taken now."""
        return now_s if now_s >= self._drained_s else self._paused_s

    def _know(self, beat: int, counted_s: float) -> None:
        self._counted_s[beat] = counted_s
        if len(self._counted_s) > KNOWN_BEATS:
            del self._counted_s[next(iter(self._counted_s))]
