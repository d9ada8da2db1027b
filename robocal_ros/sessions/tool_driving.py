"""Drives a robot through the steps of a tool session; whatever is odd ends in a stop. No ROS.

Nothing is sent unless it was armed. Each motion is planned from where the robot stands, and sent
only when the one before has ended there.
"""

from collections import deque
from collections.abc import Callable
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import ConflictError, RobocalError
from robocal_ros.core.motion.cell import MotionCell
from robocal_ros.core.motion.housing import ToolBody
from robocal_ros.core.motion.measuring import approach, measuring
from robocal_ros.core.motion.plan import JointPlan
from robocal_ros.core.motion.stopping import stop
from robocal_ros.sessions.driving_config import DrivingConfig
from robocal_ros.sessions.events import BREAK_OFF, STEP_BEGINS, Command
from robocal_ros.sessions.silence import Silence
from robocal_ros.sessions.tool import EDGES, ToolSession

Array = NDArray[np.float64]

VELOCITY_S = 0.03  # span of the readings that give a velocity
REST_RAD = 1e-4  # within that span a robot that rests moves less
REST_WITHIN_S = 2.0  # after a motion's end
BACK_S = 1.0  # stamps that go back by more began anew
LATE_S = 0.15  # a controller lags at most so far behind its trajectory


class Phase(Enum):
    """What the robot does."""

    IDLE = "idle"
    APPROACH = "on its way to a step"
    MEASURE = "driving a step"


class ToolDriver:
    """Turns the awaited steps of a session into joint motions; times are of a steady clock.

    Parameters
    ----------
    send : publishes a plan.
    ask : gives a command to the session.

    Attributes
    ----------
    phase : what the robot does now.
    armed : whether motions may be sent.
    told : why it disarmed itself last.
    """

    def __init__(
        self,
        session: ToolSession,
        config: DrivingConfig,
        send: Callable[[JointPlan], None],
        ask: Callable[[Command], object],
    ) -> None:
        self._session, self._config = session, config
        self._send, self._ask = send, ask
        self.phase, self.armed, self.told = Phase.IDLE, False, ""
        self._armed_at_s = self._sent_s = self._heard_s = 0.0
        self._silence = Silence()
        self._plan: JointPlan | None = None
        self._cell: MotionCell | None = None
        self._edges = 0
        self._driven = (0, 0)
        self._readings: deque[tuple[float, Array]] = deque(maxlen=256)

    # ---- arming ---------------------------------------------------------------------------------

    def arm(self, now_s: float) -> None:
        """Allow motions, until the run ends.

        Raises
        ------
        ConflictError
            While joint states are missing, or a motion is not over yet.
        """
        if self.phase is not Phase.IDLE:
            raise ConflictError(f"the robot is {self.phase.value}: arm it when it stands")
        if self._silent_s > self._config.silence_s:
            raise ConflictError("joint states are missing: nothing can be armed without them")
        self.armed, self._armed_at_s, self.told = True, now_s, ""

    def disarm(self, reason: str, now_s: float) -> None:
        """Forbid motions; one that is under way is stopped, and its run ends."""
        if self.phase is not Phase.IDLE:
            self._fault(Code.CONFLICT, reason, now_s)
        self.armed, self.told = False, reason

    def require_armed(self) -> None:
        """Refuse a run while nothing may move."""
        if not self.armed:
            why = f" ({self.told})" if self.told else ""
            raise ConflictError(f"not armed{why}: call arm before the measurement")

    # ---- what happens ---------------------------------------------------------------------------

    def reading(self, stamp_s: float, q: Array, now_s: float) -> None:
        """Take joints (n,), in the arm's order, as they arrive; ``stamp_s`` on their own clock."""
        if self._readings and stamp_s <= self._readings[-1][0]:
            if stamp_s > self._readings[-1][0] - BACK_S:
                return  # a clock that stands still is heard as silence
            self._readings.clear()
        self._readings.append((stamp_s, q))
        self._heard_s = now_s
        self._silence.heard(now_s)
        self.tick(now_s)

    def tick(self, now_s: float) -> None:
        """Look at everything; call it often, also when nothing arrives."""
        self._silence.look(now_s)
        try:
            self._tick(now_s)
        except RobocalError as error:
            self._fault(error.code, str(error), now_s)

    def _tick(self, now_s: float) -> None:
        run = self._session.run
        if run is None:
            self._without_run(now_s)
            return
        if self.phase is not Phase.IDLE:
            self._supervise(now_s)
        if self.phase is Phase.APPROACH and self._arrived(now_s):
            self._measure(now_s)
        elif self.phase is Phase.MEASURE and self._number() != self._driven:
            self.phase = Phase.IDLE
        if self.phase is Phase.IDLE and self.armed and self._number() != self._driven:
            self._begin(now_s)

    def _without_run(self, now_s: float) -> None:
        """Let the last motion end, or an arming that nobody used."""
        if self.phase is not Phase.IDLE:
            self.armed, self.told = False, "the run has ended"
            self._supervise(now_s)
            if self._at_end(now_s):
                self._settle("the run has ended")
        elif self._driven != (0, 0):
            self._settle("the run has ended")
        elif self.armed and now_s - self._armed_at_s > self._config.armed_s:
            self._settle(f"no run within {self._config.armed_s:g} s")

    def run_failed(self, reason: str, now_s: float) -> None:
        """Stop, and disarm, because the run ended without a result."""
        self._fault(Code.CONFLICT, reason, now_s)

    def _settle(self, reason: str) -> None:
        self.phase, self.armed, self.told = Phase.IDLE, False, reason
        self._driven, self._plan = (0, 0), None

    def _number(self) -> tuple[int, int]:
        run = self._session.run
        return (0, 0) if run is None else (run.number, len(run.steps) + 1)

    def _begin(self, now_s: float) -> None:
        """Send the way to the awaited step; the robot rests."""
        q = self._resting(now_s)
        step = self._session.awaited
        if q is None or step is None:
            return
        self._driven = self._number()
        self._cell = self._made_cell()
        self._start(approach(self._cell, step, q), Phase.APPROACH, now_s)

    def _measure(self, now_s: float) -> None:
        q, step = self._resting(now_s), self._session.awaited
        if q is None or step is None or self._cell is None:
            return
        plan = measuring(self._cell, step, q)
        self._ask(Command(STEP_BEGINS, {"step": step.name, "number": step.number}))
        self._start(plan, Phase.MEASURE, now_s)

    def _start(self, plan: JointPlan, phase: Phase, now_s: float) -> None:
        self._edges = self._session.received[EDGES]
        self._plan, self.phase, self._sent_s = plan, phase, now_s
        self._send(plan)

    def _made_cell(self) -> MotionCell:
        config, run = self._config, self._session.run
        if run is None:
            raise ConflictError("no run is open")
        seen = run.plan.T_flange_tool if run.seen is None else run.seen
        body = ToolBody(seen, config.tool_length_m, config.tool_radius_m, config.flange_radius_m)
        T_base_laser = run.plan.laser.T_base_laser
        return MotionCell(run.arm, body, T_base_laser, config.housing, config.limits)

    # ---- supervision ----------------------------------------------------------------------------

    def _supervise(self, now_s: float) -> None:
        """Raise what must stop the robot."""
        silent_s = self._silent_s
        if silent_s > self._config.silence_s:
            raise StopError(Code.TOO_FEW_SAMPLES, f"joint states are silent for {silent_s:.2f} s")
        if self.phase is Phase.APPROACH and self._session.received[EDGES] != self._edges:
            raise StopError(
                Code.BEAM_EDGES_WRONG,
                "a beam was broken on the way to a step: the tool is bent beyond the circle, or "
                "something is in the way",
            )
        away = self._away(now_s)
        if away > self._config.deviation_rad:
            raise StopError(
                Code.LIMIT_EXCEEDED,
                f"the robot is {np.degrees(away):.2f} deg away from its plan (allowed "
                f"{np.degrees(self._config.deviation_rad):.2f} deg)",
            )
        if self._plan is not None and now_s - self._sent_s > self._plan.duration_s + REST_WITHIN_S:
            raise StopError(
                Code.TOO_FEW_SAMPLES if self.phase is Phase.MEASURE else Code.LIMIT_EXCEEDED,
                f"the motion ended {REST_WITHIN_S:g} s ago, but the robot is not where it ends, or "
                "edges are missing",
            )

    def _away(self, now_s: float) -> float:
        """How far the joints are from the plan, at the instant of it that is nearest."""
        if self._plan is None or not self._readings:
            return 0.0
        at_s = self._heard_s - self._sent_s
        times = np.clip(np.linspace(at_s - LATE_S, at_s, 41), 0.0, self._plan.duration_s)
        planned, _ = self._plan.at(times)
        return float(np.min(np.max(np.abs(planned - self._readings[-1][1]), axis=1)))

    def _arrived(self, now_s: float) -> bool:
        return self._at_end(now_s) and self._resting(now_s) is not None

    def _at_end(self, now_s: float) -> bool:
        if self._plan is None or not self._readings:
            return True
        near = np.max(np.abs(self._plan.q[-1] - self._readings[-1][1]))
        return now_s - self._sent_s >= self._plan.duration_s and bool(near < 10.0 * REST_RAD)

    @property
    def _silent_s(self) -> float:
        return self._silence.lasts_s if self._readings else np.inf

    def _recent(self) -> tuple[float, Array] | None:
        """Span of the last readings and the joints' way in it; None before there are enough."""
        if not self._readings:
            return None
        last_s, last = self._readings[-1]
        for at_s, q in reversed(self._readings):
            if last_s - at_s >= VELOCITY_S:
                return last_s - at_s, last - q
        return None

    def _resting(self, now_s: float) -> Array | None:
        """The joints where the robot rests; None while it moves."""
        recent = self._recent()
        if recent is None or self._silent_s > self._config.silence_s:
            return None
        return self._readings[-1][1] if np.max(np.abs(recent[1])) < REST_RAD else None

    def _fault(self, code: Code, reason: str, now_s: float) -> None:
        """Stop the robot where it moves, disarm, and end the run."""
        moving = self.phase is not Phase.IDLE
        self._settle(reason)
        if moving and self._readings:
            recent = self._recent()
            qd = np.zeros_like(self._readings[-1][1]) if recent is None else recent[1] / recent[0]
            q = self._readings[-1][1] + qd * min(self._silent_s, self._config.silence_s)
            self._send(stop(self._session.nominal, self._config.limits, q, qd))
        if self._session.run is not None:
            self._ask(Command(BREAK_OFF, {"code": int(code), "reason": reason}))


class StopError(RobocalError):
    """Something happened at which the robot must stop."""

    def __init__(self, code: Code, message: str) -> None:
        super().__init__(message)
        self.code = code
