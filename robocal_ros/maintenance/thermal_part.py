# SPDX-License-Identifier: Apache-2.0
"""The drift in a maintenance cycle: the robot visits the measuring poses, then its node judges."""

from dataclasses import dataclass, field

import numpy as np

from robocal_ros.ground.errors import Code
from robocal_ros.ground.frames import Array
from robocal_ros.maintenance.fixture_part import EACH_POSE
from robocal_ros.maintenance.robot_interface import (
    BeginCycle,
    CellInterface,
    DriverAnswer,
    EndCycle,
    Script,
    SilentError,
)
from robocal_ros.thermal.reference import SAME_VISIT_RAD
from robocal_ros.tool.driving import STANDS_S

NODE = "thermal node"
MEASUREMENT = "thermal measurement"
NONE_BETTER = (Code.NO_SIGNIFICANT_GAIN, Code.WORSE_THAN_CURRENT)
FOUND = (Code.ACCEPT, *NONE_BETTER)  # verdicts that tell the drift; any other one leaves it unknown


@dataclass
class ThermalCycle:
    """The thermal cycle that is open; over several gaps where one is too short."""

    id: str = ""  # empty: none
    visited: set[int] = field(default_factory=set)  # poses that are done, from 1; measured or not
    unmeasured: set[int] = field(default_factory=set)  # of these, with too few measurements
    first_s: float = -np.inf  # when the first one was
    last_s: float = -np.inf  # and the last one
    moved: bool = False  # the last cycle that ended found that the sensor or the robot has moved

    def forget(self) -> None:
        """No cycle is open."""
        self.id, self.visited, self.unmeasured = "", set(), set()
        self.first_s = self.last_s = -np.inf


class ThermalPart:
    """Measures the drift; what does not fit is done in the next gap."""

    def __init__(self, cell: CellInterface, thermal: ThermalCycle) -> None:
        self._cell, self._thermal = cell, thermal
        self._times = cell.config.times

    def worst_s(self) -> float:
        """The longest first step of a gap: the cycle begins, one pose, its way home.

        A gap that has less does not begin: it would never come to the last pose.
        """
        way_s = self._cell.ways.first_s()
        return 2.0 * self._times.answer_s + STANDS_S + self._step_s(way_s)

    def drop_old(self) -> str:
        """Give up an open cycle whose last pose is too old, and say so; empty: there is none."""
        thermal, within_s = self._thermal, self._cell.config.resume_within_s
        age_s = self._cell.now_s - thermal.last_s
        if not thermal.id or age_s <= within_s:
            return ""
        message = (
            f"cycle '{thermal.id}' with {len(thermal.visited)} of {self._cell.ways.count} poses is "
            f"dropped and begins anew: its last pose is {age_s:.0f} s old (resume_within_s = "
            f"{within_s:g} s)"
        )
        thermal.forget()
        return message

    def script(self, cycle_id: str) -> Script[tuple[DriverAnswer | None, str]]:
        """The answer of the cycle's end, None where it is not reached, and what is left.

        Raises `SilentError`: the thermal node did not answer; the robot may be away from home.
        """
        cell, thermal = self._cell, self._thermal
        todo = [i for i in range(1, cell.ways.count + 1) if i not in thermal.visited]
        old = self._old() if todo else ""
        if todo and not old:
            left = f"{MEASUREMENT}, {len(todo)} poses"
            if words := cell.too_short(self.worst_s()):
                return DriverAnswer(Code.LIMIT_EXCEEDED, f"{words}: {EACH_POSE}"), left
            cell.doing = "thermal cycle begins"
            name = thermal.id or cycle_id
            begun = yield from cell.ask(self._times.answer_s, NODE, BeginCycle, name)
            if not begun.done:
                return begun, MEASUREMENT
            thermal.id, thermal.last_s = name, cell.now_s
            unvisited = yield from self._visit(todo)
            yield from cell.go_home()
            if unvisited:
                return None, f"{MEASUREMENT}, {unvisited} poses"
        if not cell.fits(self._times.solve_s):
            return None, "end of the thermal cycle"
        places: list[Array] = []  # the thermal node takes near poses for one
        for pose in sorted(thermal.visited - thermal.unmeasured):
            q = cell.config.poses[pose - 1]
            if all(np.max(np.abs(q - other)) >= SAME_VISIT_RAD for other in places):
                places.append(q)
        unmeasured, measured = ", ".join(map(str, sorted(thermal.unmeasured))), len(places)
        answer = yield from self._end()
        if answer.code not in FOUND:
            return answer, MEASUREMENT
        lacking = [f"{MEASUREMENT}, {len(todo)} poses: {old}"] if old else []
        lacking += [f"{MEASUREMENT} at pose {unmeasured}"] if unmeasured else []
        if answer.visited is not None and answer.visited < measured:
            # it was started anew meanwhile, its clock jumped, or they are not of the cold reference
            has = f"of which the thermal node has {answer.visited}"
            lacking.append(f"{MEASUREMENT} at {measured} poses, {has}")
        return answer, "; ".join(lacking)

    def _visit(self, todo: list[int]) -> Script[int]:
        """How many poses did not fit."""
        cell, thermal = self._cell, self._thermal
        yield from cell.stand(STANDS_S)
        for done, pose in enumerate(todo):
            q = yield from cell.stand()
            route = cell.ways.onward(cell.robot.place, q, pose)
            worst_s = self._step_s(route.plan.duration_s + cell.ways.home_s(pose))
            if not cell.fits(worst_s):
                return len(todo) - done
            cell.doing = f"on its way to measuring pose {pose} of {cell.ways.count}"
            yield from cell.drive(route, worst_s)
            q = yield from cell.stand()
            cell.doing = f"measuring pose {pose} of {cell.ways.count}"
            if not (yield from cell.measured_at(q, cell.measured)):
                thermal.unmeasured.add(pose)
            thermal.first_s = thermal.first_s if thermal.visited else cell.now_s
            thermal.visited.add(pose)
            thermal.last_s = cell.now_s
        return 0

    def _old(self) -> str:
        """That the open cycle ends with the poses that it has; empty: it goes on."""
        thermal, span_s = self._thermal, self._cell.config.cycle_within_s
        age_s = self._cell.now_s - thermal.first_s
        if not thermal.visited or age_s <= span_s:
            return ""
        return (
            f"the first of its cycle is {age_s:.0f} s old (cycle_within_s = {span_s:g} s), and the "
            "robot drifts on"
        )

    def _end(self) -> Script[DriverAnswer]:
        self._cell.doing = "thermal cycle ends"
        name = self._thermal.id
        self._thermal.forget()
        try:
            answer = yield from self._cell.ask(self._times.solve_s, NODE, EndCycle, name)
        except SilentError as error:
            return DriverAnswer(Code.CONFLICT, str(error))
        self._thermal.moved = answer.code is Code.SENSOR_OR_ROBOT_MOVED
        return answer

    def _step_s(self, ways_s: float) -> float:
        """At the most: a rest at each arrival, before the measurement and after it.

        What stands before a pose that does not fit need not stand again before its way home.
        """
        return ways_s + 4.0 * self._times.rest_s + self._times.measure_s
