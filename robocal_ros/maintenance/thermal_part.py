"""The thermal part of a run: visit the measuring poses, end the cycle."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code
from robocal_ros.maintenance.hands import Hands
from robocal_ros.maintenance.mover import HOME
from robocal_ros.maintenance.requests import BeginCycle, DriverAnswer, EndCycle, Script, SilentError
from robocal_ros.thermal.reference import SAME_VISIT_RAD
from robocal_ros.tool.driving import STANDS_S

Array = NDArray[np.float64]

NODE = "thermal node"
MEASUREMENT = "thermal measurement"
NONE_BETTER = (Code.NO_SIGNIFICANT_GAIN, Code.WORSE_THAN_CURRENT)
FOUND = (Code.ACCEPT, *NONE_BETTER)  # verdicts that tell the drift; any other one leaves it unknown


@dataclass
class ThermalCycle:
    """The thermal cycle that is open; over several gaps where one is too short.

    Attributes
    ----------
    id : empty: none.
    visited : poses that are done, from 1; measured or not.
    unmeasured : of these, where too few measurements came.
    last_s : when the last one was.
    moved : whether the last cycle that ended found that the sensor or the robot has moved.
    """

    id: str = ""
    visited: set[int] = field(default_factory=set)
    unmeasured: set[int] = field(default_factory=set)
    last_s: float = -np.inf
    moved: bool = False

    def forget(self) -> None:
        """No cycle is open."""
        self.id, self.visited, self.unmeasured, self.last_s = "", set(), set(), -np.inf


class ThermalPart:
    """Measures the drift; what does not fit is done in the next gap."""

    def __init__(self, hands: Hands, book: ThermalCycle) -> None:
        self._hands, self._book = hands, book
        self._times = hands.config.times

    def worst_s(self) -> float:
        """The longest first step of a gap, before it is planned: one pose, with its way home."""
        ways = self._hands.ways
        homes = max((ways.home_s(i) for i in range(1, ways.count + 1)), default=0.0)
        return self._first_s(ways.longest_line_s(), homes)

    def drop_old(self) -> str:
        """Give up an open cycle whose last pose is too old, and say so; empty: there is none."""
        book, within_s = self._book, self._hands.config.resume_within_s
        age_s = self._hands.now_s - book.last_s
        if not book.id or age_s <= within_s:
            return ""
        words = (
            f"cycle '{book.id}' with {len(book.visited)} of {self._hands.ways.count} poses is "
            f"dropped and begins anew: its last pose is {age_s:.0f} s old (resume_within_s = "
            f"{within_s:g} s)"
        )
        book.forget()
        return words

    def script(self, cycle_id: str) -> Script[tuple[DriverAnswer | None, str]]:
        """The answer of the cycle's end, None where it is not reached, and what is left.

        Raises
        ------
        SilentError
            The thermal node did not answer; the robot may be away from home.
        """
        hands, book = self._hands, self._book
        todo = [i for i in range(1, hands.ways.count + 1) if i not in book.visited]
        if todo:
            way_s = hands.ways.to((HOME, HOME), hands.config.home, todo[0]).plan.duration_s
            if not hands.fits(self._first_s(way_s, hands.ways.home_s(todo[0]))):
                return None, f"{MEASUREMENT}, {len(todo)} poses"
            begun = yield from self._begin(cycle_id)
            if not begun.done:
                return begun, MEASUREMENT
            left = yield from self._visit(todo)
            yield from hands.go_home()
            if left:
                return None, f"{MEASUREMENT}, {left} poses"
        if not hands.fits(self._times.solve_s):
            return None, "end of the thermal cycle"
        unmeasured, measured = ", ".join(map(str, sorted(book.unmeasured))), self._places()
        answer = yield from self._end()
        if answer.code not in FOUND:
            return answer, MEASUREMENT
        lacking = [f"{MEASUREMENT} at pose {unmeasured}"] if unmeasured else []
        if answer.visited is not None and answer.visited < measured:
            # it was started anew meanwhile, its clock jumped, or they are not of the cold reference
            has = f"of which the thermal node has {answer.visited}"
            lacking.append(f"{MEASUREMENT} at {measured} poses, {has}")
        return answer, "; ".join(lacking)

    def _places(self) -> int:
        """At how many places this cycle measured; the thermal node takes near ones for one."""
        found: list[Array] = []
        for pose in sorted(self._book.visited - self._book.unmeasured):
            q = self._hands.config.poses[pose - 1]
            if all(np.max(np.abs(q - other)) >= SAME_VISIT_RAD for other in found):
                found.append(q)
        return len(found)

    def _begin(self, cycle_id: str) -> Script[DriverAnswer]:
        book, hands = self._book, self._hands
        hands.doing = "thermal cycle begins"
        name = book.id or cycle_id
        answer = yield from hands.ask(self._times.answer_s, NODE, BeginCycle, name)
        if answer.done:
            book.id, book.last_s = name, hands.now_s
        return answer

    def _visit(self, todo: list[int]) -> Script[int]:
        """How many poses did not fit."""
        hands = self._hands
        yield from hands.stand(STANDS_S)
        for done, pose in enumerate(todo):
            q = yield from hands.stand()
            route = hands.ways.to(hands.robot.place, q, pose)
            worst_s = self._step_s(route.plan.duration_s, hands.ways.home_s(pose))
            if not hands.fits(worst_s):
                return len(todo) - done
            hands.doing = f"on its way to measuring pose {pose} of {hands.ways.count}"
            yield from hands.drive(route, worst_s)
            q = yield from hands.stand()
            hands.doing = f"measuring pose {pose} of {hands.ways.count}"
            if not (yield from self._measured(q)):
                self._book.unmeasured.add(pose)
            self._book.visited.add(pose)
            self._book.last_s = hands.now_s
        return 0

    def _measured(self, q: Array) -> Script[bool]:
        """Stand at joints (n,) until the measurements are there; False: their time is over."""
        hands, times = self._hands, self._times
        from_s = hands.robot.newest_s + times.settle_s
        until_s = hands.now_s + times.measure_s
        hands.measured.clear()
        while hands.now_s < until_s:
            hands.robot.require_at(q)
            fresh = sorted(stamp for stamp in hands.measured if stamp >= from_s)
            enough = fresh[: hands.config.measurements]  # more may come, faster than the stay ends
            if (
                len(enough) == hands.config.measurements
                and hands.robot.newest_s >= enough[-1] + times.stay_s
            ):
                return True
            yield
        return False

    def _end(self) -> Script[DriverAnswer]:
        book, hands = self._book, self._hands
        hands.doing = "thermal cycle ends"
        name = book.id
        book.forget()
        try:
            answer = yield from hands.ask(self._times.solve_s, NODE, EndCycle, name)
        except SilentError as error:
            return DriverAnswer(Code.CONFLICT, str(error))
        book.moved = answer.code is Code.SENSOR_OR_ROBOT_MOVED
        return answer

    def _first_s(self, way_s: float, home_s: float) -> float:
        """The cycle begins before it."""
        return 2.0 * self._times.answer_s + STANDS_S + self._step_s(way_s, home_s)

    def _step_s(self, way_s: float, home_s: float) -> float:
        """At the most: a rest at each arrival, before the measurement and after it.

        What stands before a pose that does not fit need not stand again before its way home.
        """
        return way_s + home_s + 4.0 * self._times.rest_s + self._times.measure_s
