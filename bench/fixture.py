# SPDX-License-Identifier: Apache-2.0
"""A fixture that moved, and all else that could be taken for it: said in one gap; all simulated.

Each cell has a robot with errors of its own that no model knows, and its own direction of a move.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.measured_fixture import (
    ARM,
    FRAME,
    GAP_VISITS,
    LIMITS,
    PLATE,
    TAUGHT_VISITS,
    MeasuredFixture,
    fixture_poses,
)
from bench.tables import Goal, Table
from robocal_ros.cell_sim.cell import worked_for
from robocal_ros.fixture.features import FixturePoints
from robocal_ros.fixture.judging import FixtureResult, judge_fixture
from robocal_ros.fixture.witnesses import ROBOT
from robocal_ros.ground.frames import Array

CELLS = range(101, 161)  # other ones than those of the tests
RESUMED = 30  # of these, in which a measurement goes on in another gap
MOVED_M = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3)
MOST_OFF_MM = 0.1
VISITS = (TAUGHT_VISITS, GAP_VISITS)
MORE_VISITS = (5, 4)
NAME = PLATE.name
POST = "post left"


@dataclass(frozen=True)
class Said:
    """What the gaps of all cells said; ``truth``: what has moved, empty: nothing."""

    truth: str
    results: Sequence[FixtureResult]
    off_mm: Sequence[float] = ()

    @property
    def told(self) -> float:
        """Share in which the right thing was told; of nothing, that it is so, without a doubt."""
        return self._count("told") / len(self.results)

    @property
    def doubtful(self) -> float:
        """Share in which it was in doubt whether the right thing has moved; any, of nothing."""
        return self._count("in doubt") / len(self.results)

    @property
    def wrong(self) -> int:
        """Number in which something else was told for sure."""
        return self._count("wrong")

    def _count(self, kind: str) -> int:
        return sum(self._kind(result) == kind for result in self.results)

    def _kind(self, result: FixtureResult) -> str:
        """What a gap counts as: one thing, so that a row's shares are of all of them."""
        moved, doubtful = _findings(result)
        if {*moved} - {self.truth}:
            return "wrong"
        if (self.truth in doubtful) if self.truth else doubtful:
            return "in doubt"
        return "told" if self.truth in moved or not self.truth else "passed over"


def _findings(result: FixtureResult) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if result.findings is None:
        raise ValueError("a fixture that is taught says nothing of what moved")
    return result.findings.moved, result.findings.doubtful


def tables() -> Sequence[Table]:
    """All tables of this module."""
    cells = [MeasuredFixture(seed) for seed in CELLS]
    return [moved_table(cells), others_table(cells), resumed_table(cells[:RESUMED])]


def moved_table(cells: Sequence[MeasuredFixture]) -> Table:
    """The fixture has moved."""
    table = Table(
        "fixture_moved",
        f"A fixture that has shifted and turned, in {len(cells)} cells; simulated",
        ("moved, mm", "visits taught, gap", "told, share", "in doubt", "something else told",
         "worst place by the new frame, mm", "goal"),
        "It turns by 0.1 deg for 1 mm, too. Told: the fixture, and nothing else, in the first gap. "
        "Worst place: over all features and cells, also where it was in doubt; what is in doubt "
        "is not offered for acceptance.",
    )  # fmt: skip
    for size_m in MOVED_M:
        for visits in (VISITS, MORE_VISITS) if size_m == MOVED_M[0] else (VISITS,):
            results = [cell.gap("fixture_moved", size_m, visits=visits) for cell in cells]
            off = [
                1e3 * cell.worst_m(result, "fixture_moved", size_m)
                for cell, result in zip(cells, results, strict=True)
            ]
            said = Said(NAME, results, off)
            worst = max(off)
            figures = said.told, said.doubtful, Goal(said.wrong, 0), worst
            table.add(1e3 * size_m, "{}, {}".format(*visits), *figures, Goal(worst, MOST_OFF_MM))
    return table


def others_table(cells: Sequence[MeasuredFixture]) -> Table:
    """Something else has moved, or nothing."""
    table = Table(
        "fixture_others",
        f"What is not the fixture, in {len(cells)} cells; simulated",
        ("what", "told, share", "in doubt", "something else told", "fixture told"),
        "The drift is of a robot that worked since it was taught with no thermal cycle: bending "
        "and the gears' errors too, which no model has. A frame is offered in none of these. Each "
        "gap counts once: told, in doubt, something else told, or nothing said of what moved.",
    )
    cases: list[tuple[str, str, Callable[[MeasuredFixture], FixtureResult]]] = [
        ("nothing", "", lambda c: c.gap()),
        ("the sensor, 0.3 mm", FRAME, lambda c: c.gap("sensor_knocked", 3e-4)),
        ("the sensor, 1 mm", FRAME, lambda c: c.gap("sensor_knocked", 1e-3)),
        ("a witness, 0.3 mm", POST, lambda c: _displaced(c, POST, np.array([1.8e-4, -2.4e-4, 0]))),
        (
            "dirt under a feature, 0.5 mm",
            "A2",
            lambda c: _displaced(c, "A2", 5e-4 * PLATE.T_base_fixture[:3, 2]),
        ),
        ("the tool, bent by 2 mm", "", lambda c: c.gap("collision", 2e-3)),
        ("the robot's drift of 1 h", ROBOT, lambda c: c.gap(warm=worked_for(1.0))),
        ("the robot's drift of 3 h", ROBOT, lambda c: c.gap(warm=worked_for(3.0))),
    ]
    for words, truth, made in cases:
        said = Said(truth, [made(cell) for cell in cells])
        as_fixture = sum(NAME in _findings(result)[0] for result in said.results)
        table.add(words, said.told, said.doubtful, said.wrong, Goal(as_fixture, 0))
    return table


def resumed_table(cells: Sequence[MeasuredFixture]) -> Table:
    """A measurement that goes on in a second gap."""
    table = Table(
        "fixture_resumed",
        f"A measurement that another gap goes on with, in {len(cells)} cells with backlash",
        ("reached from the pose after it, not from the one before", "most displaced by that, mm",
         "nothing moved: told", "in doubt", "something told", "moved by 0.2 mm: told", "in doubt",
         "something else told", "worst place by the new frame, mm"),
        "Joints come from the other side there, 70 urad each. maintenance_node drives to each pose "
        "through those before it, in every gap: the first row.",
    )  # fmt: skip
    size_m, count = MOVED_M[1], len(fixture_poses())
    for words, chosen in (
        ("none", lambda first: ()),
        ("the first one of the second gap", lambda first: (first,)),
        ("the first one of each of five gaps", lambda first: range(first % 6, 2 * count, 6)),
        ("all", lambda first: range(2 * count)),
    ):
        away, still, moved, off = [0.0], [], [], []
        for number, cell in enumerate(cells):
            visits = chosen(number % (2 * count))
            points = [cell.points(cell.faults(), GAP_VISITS, 2, backwards=v) for v in ((), visits)]
            away.append(float(np.max(np.linalg.norm(points[1].p - points[0].p, axis=1))))
            still.append(cell.gap(backwards=visits))
            moved.append(cell.gap("fixture_moved", size_m, backwards=visits))
            off.append(1e3 * cell.worst_m(moved[-1], "fixture_moved", size_m))
        nothing, fixture = Said("", still), Said(NAME, moved)
        figures = nothing.told, nothing.doubtful, nothing.wrong
        figures += fixture.told, fixture.doubtful, fixture.wrong
        table.add(words, 1e3 * max(away), *figures, max(off))
    return table


def _displaced(cell: MeasuredFixture, name: str, by: Array) -> FixtureResult:
    """A gap in which one place (its points shifted by (3,), m) has moved."""
    points: FixturePoints = cell.points(cell.faults(), GAP_VISITS, 2)
    off = np.array([one == name for one in points.name])
    moved = replace(points, p=points.p + off[:, None] * by)
    return judge_fixture(PLATE, moved, ARM, LIMITS, cell.taught())
