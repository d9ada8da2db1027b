# SPDX-License-Identifier: Apache-2.0
"""The fixture in a maintenance cycle: the sensor is brought to its features, then its node judges.

The last step, so that drift and tool are decided upon before: what they leave is in the points.
"""

from dataclasses import dataclass

import numpy as np

from robocal_ros.ground.errors import Code
from robocal_ros.maintenance.robot_interface import (
    BeginFixture,
    CellInterface,
    DriverAnswer,
    MeasureFixture,
    Script,
    SilentError,
)
from robocal_ros.tool.driving import STANDS_S

NODE = "fixture node"
MEASUREMENT = "fixture measurement"
EACH_POSE = "each pose is reached through those before it"
JUDGED = (  # verdicts of a measurement; any other code says that there was none
    Code.ACCEPT,
    Code.NO_SIGNIFICANT_GAIN,
    Code.SENSOR_OR_ROBOT_MOVED,
    Code.STATION_MOVED,
    Code.RESIDUAL_TOO_LARGE,
    Code.POSES_NOT_INFORMATIVE,
)


@dataclass
class FixtureVisits:
    """The poses of a measurement that is open; over several gaps where one is too short."""

    done: int = 0  # poses, over all visits; 0: none is open
    unmeasured: int = 0  # of these, at which the sensor found nothing
    last_s: float = -np.inf  # when the last one was


class FixturePart:
    """Measures where the fixture stands; what does not fit is done in the next gap."""

    def __init__(self, cell: CellInterface, visits: FixtureVisits) -> None:
        self._cell, self._visits = cell, visits
        self._times = cell.config.times

    def worst_s(self) -> float:
        """The longest first step of a gap: one pose, with its way home."""
        ways = self._cell.fixture_ways
        return 0.0 if ways is None else self._step_s(ways.first_s())

    def script(self) -> Script[tuple[DriverAnswer | None, str]]:
        """The answer of its node, None where it is not reached, and what is left.

        Raises `SilentError`: the node did not answer; the robot may be away from home.
        """
        cell, visits, ways = self._cell, self._visits, self._cell.fixture_ways
        if ways is None:
            return None, ""
        cell.robot.ways = ways  # from home, where both rings begin
        poses = np.tile(np.arange(1, ways.count + 1), cell.config.fixture_visits).tolist()
        if cell.now_s - visits.last_s > cell.config.resume_within_s:
            self._forget()
        if todo := len(poses) - visits.done:
            if words := cell.too_short(self.worst_s()):
                left = f"{MEASUREMENT}, {todo} poses"
                return DriverAnswer(Code.LIMIT_EXCEEDED, f"{words}: {EACH_POSE}"), left
            if not visits.done:
                begun = yield from cell.ask(self._times.answer_s, NODE, BeginFixture)
                if not begun.done:
                    return begun, MEASUREMENT
            yield from self._visit(poses)
            yield from cell.go_home()
            if unvisited := len(poses) - visits.done:
                return None, f"{MEASUREMENT}, {unvisited} poses"
        if not cell.fits(self._times.solve_s):
            return None, f"end of the {MEASUREMENT}"
        return (yield from self._judged())

    def _visit(self, poses: list[int]) -> Script[None]:
        cell, visits, ways = self._cell, self._visits, self._cell.robot.ways
        yield from cell.stand(STANDS_S)
        for pose in poses[visits.done :]:
            q = yield from cell.stand()
            route = ways.onward(cell.robot.place, q, pose)
            worst_s = self._step_s(route.plan.duration_s + ways.home_s(pose))
            if not cell.fits(worst_s):
                return
            cell.doing = f"on its way to fixture pose {pose} of {ways.count}"
            yield from cell.drive(route, worst_s)
            q = yield from cell.stand()
            cell.doing = f"measuring fixture pose {pose} of {ways.count}"
            if not (yield from cell.measured_at(q, cell.features)):
                visits.unmeasured += 1
            visits.done += 1
            visits.last_s = cell.now_s

    def _judged(self) -> Script[tuple[DriverAnswer | None, str]]:
        cell, unmeasured = self._cell, self._visits.unmeasured
        cell.doing = "fixture measurement ends"
        self._forget()
        try:
            answer = yield from cell.ask(self._times.solve_s, NODE, MeasureFixture)
        except SilentError as error:
            answer = DriverAnswer(Code.CONFLICT, str(error))
        if answer.code not in JUDGED:
            return answer, MEASUREMENT
        left = f"{MEASUREMENT} at {unmeasured} poses, where the sensor found nothing"
        return answer, left if unmeasured else ""

    def _forget(self) -> None:
        visits = self._visits
        visits.done, visits.unmeasured, visits.last_s = 0, 0, -np.inf

    def _step_s(self, ways_s: float) -> float:
        """At the most, as of a measuring pose of the thermal cycle."""
        return ways_s + 4.0 * self._times.rest_s + self._times.measure_s
