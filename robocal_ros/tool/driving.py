# SPDX-License-Identifier: Apache-2.0
"""Drives a robot through the steps of a tool session; whatever is odd ends in a stop. No ROS.
Nothing is sent unless it was armed. Each motion is planned from where the robot stands, and sent
only when the one before has ended there.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, ConflictError, LimitError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.cell import (
    ROUNDING,
    DrivingConfig,
    MotionCell,
    along,
    corner_ride,
    load_motion,
    raised_way,
)
from robocal_ros.motion.plan import (
    JointPlan,
    MotionLimits,
    Ride,
    circle,
    plunge,
    ramp_of,
    start_near,
)
from robocal_ros.motion.robot_watch import BEHIND_S, LeftPlanError, MotionReport, RobotWatch
from robocal_ros.motion.stopping import WatchedStop
from robocal_ros.session.events import BREAK_OFF, LEFT_PLAN, STEP_BEGINS, Command
from robocal_ros.tool.laser_frame import FEWEST_READINGS, JointPath
from robocal_ros.tool.run import PlannedStep, ToolRun
from robocal_ros.tool.session import OF_MANDREL, ToolSession

STANDS_S = 0.2  # a robot that a run takes over has rested for so long
SETTLED_S = 0.03  # one whose own motion has ended
SILENT_ARMED_S = 1.0  # an armed robot without joint states is disarmed
REST_WITHIN_S = 2.0  # after a motion's end
MOST_EDGES = {"circle": 24, "plunge": 16}  # with bounces; more is no tool on its way
NO_RUN = (0, 0)


class DrivePhase(Enum):
    """What the robot does."""

    IDLE = "idle"
    APPROACH = "on its way to a step"
    MEASURE = "driving a step"


class StopError(RobocalError):
    """Something happened at which the robot must stop."""

    def __init__(self, code: Code, message: str) -> None:
        super().__init__(message)
        self.code = code


def station_cell(run: ToolRun, config: DrivingConfig, T_flange_tool: Array) -> MotionCell:
    """Robot, what it measures as it was seen last, and the station of a run.

    ``T_flange_tool`` (4, 4): the tool in force, which hangs beside a mandrel that is measured.

    Raises `ConflictError` where a mandrel's sizes are not known.
    """
    seen = run.plan.T_flange_tool if run.seen is None else run.seen
    body, beside = config.body(seen), config.mandrel
    if run.mode in OF_MANDREL:
        if beside is None:
            raise ConflictError("the mandrel's sizes are not known: nothing moves beside it")
        body, beside = replace(beside, T_flange_tool=seen), config.body(T_flange_tool)
    T_base_laser = run.plan.laser.T_base_laser
    return MotionCell(run.arm, body, T_base_laser, config.housing, config.limits, beside)


def start_pose(step: PlannedStep, limits: MotionLimits) -> Array:
    """T_base_flange (4, 4) where a step begins: a circle's run-up lies before its ``start_rad``."""
    T = step.T_base_flange.copy()
    if step.kind == "circle":
        angle = _from_rad(step, limits)
        place = step.radius_m * np.array([np.cos(angle), np.sin(angle), 0.0])
        T[:3, 3] += step.R_base_laser @ place
    return T


def approach(
    cell: MotionCell, step: PlannedStep, q_now: ArrayLike, *, after_circle: bool = False
) -> JointPlan:
    """From measured joints (n,) to where a step begins.

    Up along the laser's z, over, where the tool is turned, and down: over the housing at its
    retract height, within its opening at the higher of both ends, so that no beam is broken on the
    way; there from circle to circle straight. Each part is a straight line of the tip from rest to
    rest, as fast as all limits allow.
    """
    q = _joints(cell, q_now)
    here, there = cell.T_base_tip(q), cell.tip_of(start_pose(step, cell.limits))
    first, last = cell.in_laser(here[:3, 3]), cell.in_laser(there[:3, 3])
    inside = cell.housing.opening_holds(first) and cell.housing.opening_holds(last)
    if inside and after_circle and step.kind == "circle":  # both begin in one quadrant
        corners = [there]
    else:
        corners = raised_way(cell, here, there, -np.inf if inside else cell.housing.retract_m)
    return along(cell, q, corners, f"way to step {step.name}")


def least_s(cell: MotionCell, corners: list[Array]) -> float:
    """How long `along` takes at the least from pose to pose (4, 4): joints may need longer."""
    return sum(corner_ride(cell, here, there).duration_s for here, there in pairwise(corners))


def measuring(cell: MotionCell, step: PlannedStep, q_now: ArrayLike) -> JointPlan:
    """A step's circle, with run-up and run-out along it, or plunge, from measured joints (n,).

    The circle makes one full turn at constant speed, from its ``start_rad``. It begins exactly
    where the robot stands, so circle or plunge lie off the step's own by as much.

    Raises `LimitError` when the robot does not stand where the step begins; where a limit is
    broken: of depth, speed, acceleration, joints, reach, singularity, or the housing.
    """
    q = _joints(cell, q_now)
    _require_start(cell, step, q)
    limit = cell.limits.tcp_speed_m_s if step.kind == "circle" else cell.limits.plunge_speed_m_s
    if step.speed_m_s > limit:
        raise LimitError(
            f"step {step.name} asks for {step.speed_m_s * 1e3:.1f} mm/s, allowed are "
            f"{limit * 1e3:.1f} mm/s for a {step.kind}: plan it slower"
        )
    T_start, limits = cell.T_base_tip(q), cell.limits
    if step.kind == "circle":
        start_rad, turn = _from_rad(step, limits), _turn(step, limits)
        R, way = step.R_base_laser, step.direction
        path = circle(T_start, R, step.radius_m, start_rad, way, turn)
    else:
        if step.depth_m > limits.plunge_depth_m:
            raise LimitError(
                f"step {step.name} plunges {step.depth_m * 1e3:.1f} mm, allowed are "
                f"{limits.plunge_depth_m * 1e3:.1f} mm: plan it less deep"
            )
        ride = Ride.within(step.depth_m, step.speed_m_s, limits.tcp_acceleration_m_s2)
        path = plunge(T_start, step.R_base_laser, ride)
    plan = cell.joints(path, q)
    share, reason = cell.demand(plan, limit)
    if share > 1.0 + ROUNDING:
        raise LimitError(
            f"step {step.name}: {reason}. Measure with less speed, or in another posture"
        )
    cell.require_clear(plan, f"step {step.name}")
    return plan


def _joints(cell: MotionCell, q_now: ArrayLike) -> Array:
    q = np.array(q_now, dtype=np.float64)
    if q.shape != (cell.arm.n,):
        raise ValueError(f"q_now has shape {q.shape}, expected ({cell.arm.n},)")
    if not np.all(np.isfinite(q)):
        raise LimitError("the measured joints are not finite: check the joint states")
    return q


def _turn(step: PlannedStep, limits: MotionLimits) -> Ride:
    """A full turn, with a run-up before and a run-out after it."""
    ramp = ramp_of(step.speed_m_s, limits.tcp_acceleration_m_s2)
    return Ride(2.0 * np.pi * step.radius_m + step.speed_m_s * ramp, step.speed_m_s, ramp)


def _from_rad(step: PlannedStep, limits: MotionLimits) -> float:
    run_up = 0.5 * step.speed_m_s * _turn(step, limits).ramp_s
    return float(step.start_rad - step.direction * run_up / step.radius_m)


def _require_start(cell: MotionCell, step: PlannedStep, q: Array) -> None:
    """Refuse joints (n,) that are not where a step begins."""
    arm, T = cell.arm, cell.arm.fk(q)
    goal = start_pose(step, cell.limits)
    turn = frames.log_rotation(goal[:3, :3] @ T[:3, :3].T)
    shift = np.linalg.pinv(arm.jacobian(q)) @ np.concatenate([goal[:3, 3] - T[:3, 3], turn])
    near = start_near(arm)
    joint = int(np.argmax(np.abs(shift) / near))
    if abs(shift[joint]) > near[joint]:
        unit, scale = ("mm", 1e3) if arm.prismatic[joint] else ("deg", 180.0 / np.pi)
        raise LimitError(
            f"the robot does not stand where step {step.name} begins: {arm.joint_names[joint]} is "
            f"off by {scale * abs(shift[joint]):.3f} {unit}, allowed are "
            f"{scale * near[joint]:.3f} {unit}. Approach the start again"
        )


def load_measuring(arm: SerialArm) -> None:
    """The same of measuring a tool in motion: a third of a second."""
    import scipy.special  # noqa: F401

    load_motion(arm)
    time = np.linspace(0.0, 0.1, FEWEST_READINGS)
    JointPath(arm, time, np.full((len(time), arm.n), 0.3)).at(np.array([0.05]))


class ToolDriver:
    """Turns the awaited steps of a session into joint motions; times are of a steady clock.

    ``send``: publishes a plan, and whether it is a stop; returns when, where that is not now.
    ``ask``: gives a command to the session.
    ``closed``: why nothing may move at a time, empty: it may; asked before anything begins.
    ``hard_stop``: stops a robot that does not obey, by other means; takes why.

    ``robot``: where it is, and how fast its controller's clock runs. ``phase``: what the robot does
    now. ``armed``: whether motions may be sent. ``told``: why it disarmed itself last.
    """

    def __init__(
        self,
        session: ToolSession,
        config: DrivingConfig,
        send: Callable[[JointPlan, bool], float | None],
        ask: Callable[[Command], object],
        closed: Callable[[float], str] = lambda now_s: "",
        hard_stop: Callable[[str], None] = lambda why: None,
    ) -> None:
        self._session, self._config = session, config
        self._send, self._ask, self._closed = send, ask, closed
        self.phase, self.armed, self.told = DrivePhase.IDLE, False, ""
        self._armed_at_s = 0.0
        self._hard_stop = hard_stop
        self.robot = RobotWatch(session.nominal, config)
        self._stopping = WatchedStop(session.nominal, config.limits)
        self._cell: MotionCell | None = None
        self._beams: Counter[bool] = Counter()
        self._kind = ""  # of the last step that was driven
        self._driven = NO_RUN
        self._said_s = 0.0  # when the awaited step was said to begin
        self._patience_s = 0.5 * session.config.step_timeout_s
        self._failed = ""  # of the last stop, as it was acted upon

    def arm(self, now_s: float) -> None:
        """Allow motions, until the run ends.

        Raises `ConflictError` while nothing may move, joint states are missing, a run is open, or
        the robot moves.
        """
        if why := self._closed(now_s):
            raise ConflictError(f"{why}: nothing may move")
        if self.robot.silent:
            raise ConflictError("joint states are missing: nothing can be armed without them")
        if self.phase is not DrivePhase.IDLE:
            raise ConflictError(f"the robot is {self.phase.value}: arm it when it stands")
        if self._session.run is not None:
            raise ConflictError("a run is open: cancel it, then arm, then measure")
        if self.robot.resting(STANDS_S) is None or self._stopping.under_way:
            raise ConflictError("the robot moves: arm it when it stands")
        self.armed, self._armed_at_s, self.told = True, now_s, ""

    def disarm(self, reason: str, now_s: float) -> None:
        """Forbid motions; one that is under way is stopped, and an open run ends."""
        if self.phase is not DrivePhase.IDLE or self._session.run is not None:
            self._fault(Code.CONFLICT, reason, now_s)
        self.armed, self.told = False, reason

    def require_ready(self) -> None:
        """Refuse a run while nothing may move, or while something else moves the robot."""
        if not self.armed:
            why = f" ({self.told})" if self.told else ""
            raise ConflictError(f"not armed{why}: call arm before the measurement")
        if self.robot.resting(STANDS_S) is None:
            raise ConflictError("the robot moves, or its joint states are missing: let it stand")

    def words(self) -> str:
        """For people: whether it is armed, what the robot does, why it disarmed itself."""
        state = "armed" if self.armed else "disarmed"
        return f"{state}, {self.phase.value}" + (f" ({self.told})" if self.told else "")

    def trouble(self, now_s: float) -> str:
        """A robot that does not stop, or that is late; empty: neither."""
        return self._stopping.failed or self.robot.late(now_s)

    def on_its_way(self, now_s: float) -> bool:
        """Whether a step is being driven: a robot that rests then only pauses."""
        return self.phase is DrivePhase.MEASURE and not self.robot.at_end(now_s)

    @property
    def moves(self) -> bool:
        """Whether it moves the robot, or may at once."""
        return self.armed or self.phase is not DrivePhase.IDLE or self._stopping.under_way

    def reading(self, stamp_s: float, q: Array, now_s: float, late_s: float = 0.0) -> None:
        """Take joints (n,), in the arm's order, as they arrive; ``stamp_s`` on their own clock.

        After one that comes ``late_s`` late others wait, by which the robot is judged.
        """
        self.robot.reading(stamp_s, q, now_s - late_s)
        if late_s <= BEHIND_S:
            self.tick(now_s)

    def slept(self, for_s: float) -> None:
        """The host was suspended; call it before anything else with a time of afterwards."""
        self.robot.slept(for_s)

    def beam(self, broken: bool) -> None:
        """A beam has said something, usable or not."""
        self._beams[broken] += 1

    def run_failed(self, reason: str, now_s: float) -> None:
        """Stop, and disarm, because the run ended without a result."""
        self._fault(Code.CONFLICT, reason, now_s)

    def reported(self, report: MotionReport, now_s: float) -> None:
        """What the controller says of what it was sent last."""
        if self._stopping.under_way:
            if report.failed:
                self._stopping.rejected(report.words)
        elif self.phase is not DrivePhase.IDLE and report.failed:
            self._fault(Code.CONFLICT, report.words, now_s, lost=True)
        elif report.ended:
            self.robot.ended()

    def tick(self, now_s: float) -> None:
        """Look at everything; call it often, also when nothing arrives."""
        self.robot.silence.look(now_s)
        if (plan := self._stopping.look(self.robot, now_s)) is not None:
            self._send(plan, True)
        if (why := self._stopping.failed) != self._failed:
            self._failed = why
            self._hard_stop(why) if why else None
        busy = self.armed or self.phase is not DrivePhase.IDLE
        if busy and (why := self._closed(now_s)):
            self.disarm(why, now_s)
        try:
            self._tick(now_s)
        except LeftPlanError as error:
            self._fault(error.code, str(error), now_s, left_plan=True)
        except RobocalError as error:
            self._fault(error.code, str(error), now_s)

    def _tick(self, now_s: float) -> None:
        if self._session.run is None:
            # Let the last motion end, or an arming that nobody used.
            if self.phase is not DrivePhase.IDLE:
                self.armed, self.told = False, "the run has ended"
                self._supervise(now_s)
                if self.robot.at_end(now_s):
                    self._settle("the run has ended")
            elif self._driven != NO_RUN:
                self._settle("the run has ended")
            elif self.armed and self.robot.silent_s > SILENT_ARMED_S:
                self._settle("joint states are silent")
            elif self.armed and now_s - self._armed_at_s > self._config.armed_s:
                self._settle(f"no run within {self._config.armed_s:g} s")
            return
        if self.phase is not DrivePhase.IDLE:
            self._supervise(now_s)
        at_end = self.robot.at_end(now_s)
        if self.phase is DrivePhase.APPROACH and at_end:
            self._measure(now_s)
        elif self.phase is DrivePhase.APPROACH and now_s - self._said_s > self._patience_s:
            self._say_begins(now_s)  # a long or slow way is no step without edges
        elif self.phase is DrivePhase.MEASURE and at_end and self._number() != self._driven:
            self.phase = DrivePhase.IDLE
        if self.phase is DrivePhase.IDLE and self.armed and self._number() != self._driven:
            self._begin(now_s)

    def _settle(self, reason: str) -> None:
        self.phase, self.armed, self.told = DrivePhase.IDLE, False, reason
        self._driven, self._kind = NO_RUN, ""
        self.robot.forget()

    def _number(self) -> tuple[int, int]:
        run = self._session.run
        return NO_RUN if run is None else (run.number, len(run.steps) + 1)

    def _begin(self, now_s: float) -> None:
        """Send the way to the awaited step, once the robot rests."""
        q = self.robot.resting(STANDS_S if self._driven == NO_RUN else SETTLED_S)
        run, tool = self._session.run, self._session.current.tool.T_flange_tool
        if q is None or run is None:
            return
        self._driven, self._said_s = self._number(), now_s
        self._cell = station_cell(run, self._config, tool)
        plan = approach(self._cell, run.awaited, q, after_circle=self._kind == "circle")
        self._start(plan, self._cell, DrivePhase.APPROACH, now_s)

    def _measure(self, now_s: float) -> None:
        q, step = self.robot.resting(SETTLED_S), self._session.awaited
        if q is None or step is None or self._cell is None:
            return
        plan = measuring(self._cell, step, q)
        self._kind = step.kind
        self._say_begins(now_s)
        self._start(plan, self._cell, DrivePhase.MEASURE, now_s)

    def _say_begins(self, now_s: float) -> None:
        self._said_s = now_s
        if (step := self._session.awaited) is not None:
            self._ask(Command(STEP_BEGINS, {"step": step.name, "number": step.number}))

    def _start(self, plan: JointPlan, cell: MotionCell, phase: DrivePhase, now_s: float) -> None:
        self._beams.clear()
        self._stopping.forget()
        self.phase = phase
        self.robot.follow(plan, cell, now_s)
        sent_s = self._send(plan, False)  # making the plan may have taken long
        if sent_s is not None:
            self.robot.sent(sent_s)

    def _supervise(self, now_s: float) -> None:
        """Raise what must stop the robot."""
        if self.robot.silent:
            silent = f"joint states are silent for {self.robot.silent_s:.2f} s"
            raise StopError(Code.TOO_FEW_SAMPLES, silent)
        if self.phase is DrivePhase.APPROACH and self._beams[True]:
            raise StopError(
                Code.BEAM_EDGES_WRONG,
                "a beam was broken on the way to a step: the tool is bent beyond the circle, or "
                "something is in the way",
            )
        if self.phase is DrivePhase.MEASURE and self._beams.total() > MOST_EDGES[self._kind]:
            raise StopError(Code.BEAM_EDGES_WRONG, "more edges than a tool makes: look for it")
        self.robot.require_on_plan(now_s, REST_WITHIN_S)
        if self.robot.ended_for_s(now_s) > REST_WITHIN_S:
            ended = f"the motion ended {REST_WITHIN_S:g} s ago, but"
            if self.phase is not DrivePhase.MEASURE:
                raise LeftPlanError(f"{ended} the robot does not rest where it ends")
            missing = "edges are missing" if self._beams.total() else "no edge came"
            raise StopError(
                Code.BEAM_EDGES_WRONG,
                f"{ended} {missing}: there is no tool, it is far too short, or beams are dead",
            )

    def _fault(
        self, code: Code, reason: str, now_s: float, *, left_plan: bool = False, lost: bool = False
    ) -> None:
        """Stop the robot where it moves, disarm, and end the run.

        ``lost``: the controller does not drive the plan any more.
        """
        robot = self.robot
        moving = self.phase is not DrivePhase.IDLE and robot.heard
        keeps = not lost and robot.keeps(*robot.away())
        state = robot.state(now_s, keeps=keeps) if moving else None
        self._settle(reason)
        if state is not None:
            self._send(self._stopping.begin(state, now_s), True)
        if self._session.run is not None:
            told = {"code": int(code), "reason": reason}
            self._ask(Command(BREAK_OFF, {**told, LEFT_PLAN: True} if left_plan else told))
