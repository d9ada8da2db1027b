"""One motion of the robot at a time, supervised; whatever is odd is a reason to stop."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, LimitError, RobocalError, TooFewSamplesError
from robocal_ros.maintenance.config import MaintenanceConfig
from robocal_ros.maintenance.ways import HOME, STATION, Line, Route, Ways
from robocal_ros.motion.limits import start_near
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import VELOCITY_S, LeftPlanError, MotionReport, RobotWatch
from robocal_ros.motion.stopping import stop, stop_time
from robocal_ros.motion.watched_stop import WatchedStop

Array = NDArray[np.float64]


class FaultError(RobocalError):
    """Something at which the robot must stop, and a person must look."""

    def __init__(self, code: Code, message: str) -> None:
        super().__init__(message)
        self.code = code


class Mover:
    """Where the robot is, and the route that it drives; times of a steady clock.

    Attributes
    ----------
    watch : the readings, and how fast the controller's clock runs.
    stopping : the stop that was sent last.
    place : point, line or station at which it was last known to be.
    stops_within_s : a stop that was sent is over in the readings by then, from any speed.
    """

    def __init__(self, config: MaintenanceConfig, ways: Ways) -> None:
        self._config, self._ways = config, ways
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

    def look(self, now_s: float) -> None:
        """Count silence; call it often."""
        self.watch.silence.look(now_s)

    def slept(self, for_s: float) -> None:
        """The host was suspended for so long."""
        self.watch.slept(for_s)

    @property
    def moving(self) -> bool:
        """Whether a route is under way."""
        return self._route is not None

    @property
    def silent(self) -> bool:
        """Whether joint states are missing."""
        return self.watch.silent_s > self._config.driving.silence_s

    def beside_home(self) -> str:
        """Which joint is how far from home, in words; empty when the robot is there."""
        if self._q is None or self.silent:
            return self.unheard
        away = np.abs(self._q - self._config.home)
        return self._off(away, np.broadcast_to(self._config.home_near, away.shape))

    def require_home(self) -> None:
        """Refuse what begins at home where the robot is not, or is not heard."""
        if self.unheard:
            raise TooFewSamplesError(f"{self.unheard}: nobody knows whether the robot is at home")
        if away := self.beside_home():
            raise LimitError(f"robot is not at home: {away}: bring it home, then acknowledge")

    @property
    def unheard(self) -> str:
        """Why nobody knows where the robot is, in words; empty where it is known."""
        if self._q is not None and not self.silent:
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
        if self._q is None or self.silent:
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

    def resting(self, span_s: float) -> Array | None:
        """The joints where the robot has rested for so long; None while it moves, or is silent."""
        return None if self.silent else self.watch.resting(span_s)

    def require_at(self, q: Array) -> None:
        """Look after a robot that is to stand at joints (n,).

        Raises
        ------
        FaultError
            When joint states are silent, or it is not there any more.
        """
        away = np.abs(self.require_heard("while the robot stands away from home") - q)
        self._require_near(away, self._allowed(), "where it came to rest")

    def require_taught(self, q: Array) -> None:
        """Let the robot move from joints (n,) where it rests on its taught line; else FaultError.

        At the station there is no line: the tool's driver may have left it anywhere.
        """
        if self.place != STATION:
            allowed = np.maximum(self._allowed(), self._config.home_near)
            away = self._ways.beside(self.place, q)
            self._require_near(away, allowed, "on its taught way")

    def _allowed(self) -> Array:
        driving = self._config.driving
        return np.where(self._arm.prismatic, driving.deviation_m, driving.deviation_rad)

    def _require_near(self, away: Array, allowed: Array, what: str) -> None:
        if words := self._off(away, allowed):
            raise FaultError(Code.LIMIT_EXCEEDED, f"robot is not {what}: {words}")

    # ---- motions --------------------------------------------------------------------------------

    def start(self, route: Route, now_s: float) -> None:
        """A route was sent."""
        self._route, self._lost = route, ""
        self.stopping.forget()
        self.watch.follow(route.plan, self._ways.cell, now_s)

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
        """How long the robot takes for what is planned, at the present speed scaling."""
        return planned_s / max(self.watch.scaling, 1e-3)

    def sent(self, now_s: float) -> None:
        """When the route really was sent: it may have taken a while to plan."""
        self.watch.sent(now_s)

    def arrived(self, now_s: float) -> bool:
        """Whether the route is over, with the robot at its end."""
        if self._route is None or not self.watch.at_end(now_s):
            return False
        self.place, self._route = self._route.goal, None
        self.watch.forget()
        return True

    def require_sane(self, now_s: float) -> None:
        """Look after a motion.

        Raises
        ------
        FaultError
            When joint states are silent, or the robot is not where its plan has it.
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
        return self._planned(state, now_s)

    def stop_measured(self, now_s: float) -> JointPlan | None:
        """The stop of whatever moves the robot, from its readings alone; None while these fail.

        Just after a silence too: its mean speed would drive on a robot that has stopped meanwhile.
        """
        if self.silent or not self.watch.tells_speed(VELOCITY_S + self._config.driving.silence_s):
            return None
        return self._planned(self.watch.state(now_s, keeps=False), now_s)

    def _planned(self, state: tuple[Array, Array], now_s: float) -> JointPlan:
        plan = stop(self._arm, self._config.driving.limits, *state)
        self.stopping.begin(plan, now_s)
        return plan
