# SPDX-License-Identifier: Apache-2.0
"""The fixture as the last step of a maintenance run: its ring of ways, its gaps, its node."""

import re

import numpy as np
import pytest
from maintenance_cell import (
    FIXTURE_POSES,
    HOME,
    LONG_S,
    REFUSED,
    SILENT,
    Cell,
    config_of,
    kinds,
    opened,
    over,
)

from robocal_ros.ground.errors import Code
from robocal_ros.maintenance import robot_interface as ask

VISITS = 2
SHORT_S = 16.0  # for some of the poses
WAYS = VISITS * [*FIXTURE_POSES]
FIXTURE = {"fixture_poses": FIXTURE_POSES, "fixture_visits": VISITS}


@pytest.fixture
def cell(history):
    """In an open gap, after what every start does."""
    return opened(history, config=config_of(**FIXTURE))


@pytest.fixture
def lone(history):
    """A cell in which the fixture alone is measured: neither drift nor tool."""
    return lone_cell(history)


def lone_cell(history, **changes):
    poses = np.empty((0, len(HOME)))
    cell = Cell(history, config_of(poses=poses, T_base_laser=None, **FIXTURE, **changes))
    cell.open_gap()
    return cell


def ends(cell):
    return np.array([r.plan.q[-1] for r in cell.log if isinstance(r, ask.Move)])


def sides(cell, poses):
    """Of each visit of one of these poses: which, and which way each joint went last."""
    found = []
    for plan in (r.plan for r in cell.log if isinstance(r, ask.Move)):
        away = np.max(np.abs(poses - plan.q[-1]), axis=1)
        if np.min(away) < 1e-9:
            went = np.sign(np.diff(plan.q, axis=0)).T
            last = tuple(float(way[np.flatnonzero(way)[-1]]) for way in went)
            found.append((int(np.argmin(away)), last))
    return found


def fixture_log(cell):
    """What was asked from the fixture's step on."""
    return kinds(cell)[kinds(cell).index("BeginFixture") :]


def test_it_comes_after_drift_and_tool_each_pose_as_often_as_set(cell):
    result = cell.ran("c1")
    assert (result.code, result.complete) == (Code.ACCEPT, True), result.message
    assert kinds(cell).index("BeginFixture") > kinds(cell).index("Measure")
    moves = len(WAYS) + 1
    assert fixture_log(cell) == ["BeginFixture", *["Move"] * moves, "MeasureFixture"]
    np.testing.assert_allclose(ends(cell)[-moves:], [*WAYS, HOME], atol=1e-9)
    assert (result.fixture_code, result.fixture_id) == (Code.ACCEPT, 9)
    said = "fixture: plate moved by 0.50 mm; candidate 9 waits for a decision"
    assert said in result.message
    assert not result.accepted
    over(cell)


def test_what_does_not_fit_goes_on_in_the_next_gap_and_is_asked_for_once(lone):
    seen, result = [], None
    while result is None or not result.complete:
        result = lone.ran(f"c{len(seen)}", SHORT_S)
        assert result.code is Code.ACCEPT, result.message
        seen += result.left
        over(lone)
        assert len(seen) < len(WAYS)
    assert seen, "all of it fitted one gap"
    assert kinds(lone).count("BeginFixture") == 1
    assert kinds(lone).count("MeasureFixture") == 1
    at = [q for q in ends(lone) if min(np.max(np.abs(FIXTURE_POSES - q), axis=1)) < 1e-9]
    np.testing.assert_allclose(at, WAYS, atol=1e-9)


def test_a_gap_that_is_too_short_for_any_pose_says_which_would_do(lone):
    """And drives nothing; that one brings the measurement on."""
    result = lone.ran("c1", 10.0)
    assert result.left == (f"fixture measurement, {len(WAYS)} poses",)
    assert not lone.log
    found = re.search(r"fixture: the gap is [\d.]+ s too short, one of (\d+) s", result.message)
    assert found, result.message
    lone.ran("c2", float(found[1]))
    assert kinds(lone).count("Move") >= 2


def test_a_gap_that_is_too_short_for_a_pose_judges_where_all_are_visited(lone):
    visits = lone.session._visits
    visits.done, visits.last_s = len(WAYS), lone.now_s
    result = lone.ran("c1", 10.0)
    assert (result.complete, result.fixture_code) == (True, Code.ACCEPT), result.message
    assert kinds(lone) == ["MeasureFixture"]


@pytest.mark.parametrize("step", ["fixture", "thermal"])
def test_a_pose_is_reached_from_one_side_in_whatever_gap(step, history):
    """From the other a joint's backlash is in the comparison with what was taught, or the cold."""
    steps = [[-9.0, 4, 3, 2, -3, 1], [-9.0, -2, 2, -3, 4, -2], [-3.0, 3, -2, -2, 2, 5]]
    steps += [[2.0, -2, -2, 3, 3, -3], [2.0, 2, 3, 3, -3, -3]]
    taught = HOME + np.radians(np.cumsum(steps, axis=0))  # each joint turns on each line
    if step == "fixture":
        changed = {"poses": np.empty((0, len(HOME))), "fixture_poses": taught}
    else:
        changed = {"poses": taught}
    cell = Cell(history, config_of(T_base_laser=None, **changed))
    cell.open_gap()
    assert cell.ran("long").complete
    over(cell)
    at_once, at_first = dict(sides(cell, taught)), len(sides(cell, taught)) // len(taught)
    assert len(at_once) == len(taught)
    assert len(set(at_once.values())) == len(taught), "another side for each, else nothing is shown"
    cell.log.clear()
    cell.run("broken off", LONG_S)
    while "measuring" not in (doing := cell.session.status(cell.now_s).doing) or "4" not in doing:
        cell.step()
    cell.session.cancel("by hand")
    cell.finish()
    over(cell)
    assert cell.ran("goes on").complete
    assert [pose for pose, _ in sides(cell, taught)].count(0) == at_first
    assert {visit in at_once.items() for visit in sides(cell, taught)} == {True}


def test_one_that_waited_too_long_begins_anew(history):
    cell = lone_cell(history, resume_within_s=30.0)
    assert not cell.ran("first", SHORT_S).complete
    cell.pass_time(40.0)
    cell.log.clear()
    assert cell.ran("later").complete
    np.testing.assert_allclose(ends(cell), [*WAYS, HOME], atol=1e-9)
    assert kinds(cell).count("BeginFixture") == 1


@pytest.mark.parametrize("how", [SILENT, REFUSED])
def test_a_node_that_does_not_answer_leaves_it_with_the_robot_at_home(cell, how):
    cell.services["fixture"] = how
    result = cell.ran("c1")
    assert (result.code, result.complete) == (Code.ACCEPT, False), result.message
    assert "fixture measurement" in result.left
    assert result.fixture_code is Code.NONE
    assert cell.at_home()
    assert fixture_log(cell) == ["BeginFixture"]  # and nothing was driven for it
    over(cell)


def test_poses_at_which_the_sensor_finds_nothing_are_named(cell):
    cell.services["features"] = SILENT
    result = cell.ran("c1")
    assert not result.complete
    assert result.left == (
        f"fixture measurement at {len(WAYS)} poses, where the sensor found nothing",
    )


def test_one_that_is_not_taught_is_left_with_what_to_do(cell):
    cell.fixture = ask.DriverAnswer(Code.CONFLICT, "plate was not taught yet: teach it first")
    result = cell.ran("c1")
    assert result.left == ("fixture measurement",)
    assert "teach it first" in result.message
    assert result.fixture_code is Code.NONE
    assert "waits" not in result.message


def under_way(cell):
    """Until the robot is away from home, on the fixture's ring."""
    cell.run("c1", LONG_S)
    while "BeginFixture" not in kinds(cell) or kinds(cell)[-1] != "Move":
        cell.step()
    cell.pass_time(1.0)
    assert not cell.at_home()


def test_a_gap_that_closes_at_the_fixture_stops_the_robot(cell):
    under_way(cell)
    cell.is_open = False
    cell.finish()
    over(cell, fault=True)
    assert not cell.at_home()
    assert "Stop" in fixture_log(cell)


def test_a_cancelled_run_comes_home_by_the_ring_it_is_on(cell):
    under_way(cell)
    cell.session.cancel("by hand")
    assert cell.finish().code is Code.CONFLICT
    over(cell)
    np.testing.assert_allclose(cell.q, HOME, atol=1e-6)
    cell.log.clear()
    assert cell.ran("c2").complete, "the next run begins on the ring of the measuring poses"
