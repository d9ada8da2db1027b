# SPDX-License-Identifier: Apache-2.0
"""The closed loop: gaps and incidents count from when they are due, and its judging can fail."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bench.closed_loop import tables
from bench.closed_loop.faults import ALARM, Trial, report_of
from bench.closed_loop.judging import gaps_to_recover, harm, per_hour, refused, within_at_worst
from bench.closed_loop.plant import (
    AT_WORK,
    BEAT_S,
    CYCLE,
    DWELL_S,
    HOME,
    PASS_S,
    PROGRAMME,
    REST_S,
    ROUNDS,
    STEP_S,
    GapReport,
    equipped,
)
from bench.closed_loop.setting import LIMITS
from bench.closed_loop.shift import (
    GOLDEN,
    HOUR_S,
    MIDWORK,
    Incident,
    Judged,
    ShiftPlan,
    ShiftRecord,
    run_shift,
)
from robocal_ros.cell_sim.cell import SimulatedCell, kr150_cell
from robocal_ros.cell_sim.trajectory_controller import LAG_S
from robocal_ros.ground.errors import Code, ConflictError
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.accuracy import CycleResult
from robocal_ros.motion.cell import joint_way
from robocal_ros.motion.plan import JointPlan
from robocal_ros.session import events
from robocal_ros.session.events import Command
from robocal_ros.tool.driving import DrivePhase
from robocal_ros.tool.session import REFERENCE


@pytest.fixture
def cell():
    """The robot at home, and its sessions, a second after they began."""
    nominal = load_robot("kr150_r3100")
    simulated = SimulatedCell(kr150_cell(nominal, 3, points=0))
    with equipped(nominal, simulated) as (plant, suite):
        plant.listen(1.0)
        yield plant, suite


def test_nothing_is_armed_in_a_closed_gap(cell):
    plant, suite = cell
    with pytest.raises(ConflictError, match="gap_open is false"):
        suite.driver.arm(plant.now_s)


def test_a_gap_that_closes_stops_the_tools_driver(cell):
    plant, suite = cell
    plant.is_open = True
    plant.listen(plant.now_s + 2.0 * BEAT_S)
    suite.driver.arm(plant.now_s)
    suite.tool_command(Command(events.MEASURE_TOOL, {"mode": "reference", "cycle_id": "one"}))
    while suite.driver.phase is not DrivePhase.APPROACH:
        plant.step()
    plant.listen(plant.now_s + 0.5)
    assert plant.cell.moving
    plant.is_open = False
    plant.listen(plant.now_s + BEAT_S + STEP_S)
    assert not suite.driver.armed
    assert suite.driver.told == "gap_open is false"
    assert suite.tool.run is None
    hardest_s = float(np.max(np.asarray(LIMITS.joint_velocity) / LIMITS.stop_deceleration))
    plant.listen(plant.now_s + hardest_s + 3.0 * LAG_S)
    assert not plant.cell.moving
    assert plant.cell.motion.faults == 0


def test_a_jump_that_is_sent_is_counted(cell):
    plant, _ = cell
    q = plant.cell.motion.at([plant.now_s])[0]
    plant.send(JointPlan(np.array([0.0, 0.008]), np.vstack([q, q + 1.0]), *np.zeros((2, 2, 6))))
    plant.listen(plant.now_s + 1.0)
    assert plant.cell.motion.faults == 1
    assert plant.cell.motion.at([plant.now_s])[0] == pytest.approx(q, abs=1e-12)


def reference_measured_late(plant, suite):
    """The healthy tool as a commissioning measures it, at the time of that; no ball is seen."""

    def unseen(until_s):
        steps = int(np.ceil((until_s - 1e-9 - plant.now_s) / STEP_S))
        plant.cell.advance(plant.now_s + steps * STEP_S, readings=False)

    for pose in [*np.tile(CYCLE, (ROUNDS, 1)), HOME]:
        q = plant.cell.motion.at([plant.now_s])[0][0]
        plant.send(joint_way(suite.maintenance.ways.cell, q, pose))
        unseen(plant.cell.motion.end_s)
        unseen(plant.now_s + DWELL_S)
    plant.listen(plant.now_s + 0.416)
    return plant.measure_tool(suite, REFERENCE, "one")


@pytest.mark.long
@pytest.mark.parametrize("seed", [51, 65, 73])
def test_a_healthy_tool_is_found_where_noisy_readings_bend_its_path(seed):
    """Joint readings whose noise lets whole steps of the search overshoot for ever."""
    nominal = load_robot("kr150_r3100")
    with equipped(nominal, SimulatedCell(kr150_cell(nominal, seed, points=0))) as (plant, suite):
        plant.listen(1.0)
        assert reference_measured_late(plant, suite).done
        assert suite.tool.current.measured_healthy is not None


FIRST_S = 60.0  # one pass before the first gap
GAP_S, EVERY_S = 90.0, 160.0
IN_PASS_S = 30.0
ARRIVES_S = PROGRAMME[0][AT_WORK]
BEGINS_S = FIRST_S + GAP_S  # of the pass after the first gap
TOOL_M = 1.5e-3  # a tip bent by 2 mm is off by more


def plan(*incidents):
    return ShiftPlan(
        hours=(FIRST_S + 2.0 * EVERY_S) / 3600.0,
        first_s=FIRST_S,
        every_s=EVERY_S,
        gap_s=GAP_S,
        incidents=incidents,
    )


def sizes(one):
    return np.linalg.norm(one.error, axis=1)


def test_poses_before_a_collision_within_a_pass_are_made_with_the_healthy_tool():
    struck = Incident(BEGINS_S + IN_PASS_S, "collision", 2.0)
    before, hit, after = run_shift(plan(struck), seed=3, suite=False).passes
    bent = ARRIVES_S > IN_PASS_S
    assert 5 < np.count_nonzero(bent) < 22
    assert np.array_equal(sizes(hit) > TOOL_M, bent)
    assert sizes(before).max() < 1e-4
    assert sizes(after).min() > TOOL_M


@pytest.mark.long
@pytest.mark.parametrize("at_s", [BEGINS_S, BEGINS_S - 20.0])
def test_a_collision_in_a_gap_befalls_the_whole_pass_after_it(at_s):
    _, hit, _ = run_shift(plan(Incident(at_s, "collision", 2.0)), seed=3, suite=False).passes
    assert sizes(hit).min() > TOOL_M


def test_gaps_and_passes_begin_where_they_are_planned():
    made = run_shift(plan(), seed=3, suite=False)
    assert [one.cycle for one in made.passes] == [0, 1, 2]
    begins_s = [one.time_s - PASS_S - REST_S for one in made.passes]
    assert begins_s == pytest.approx([0.5, BEGINS_S, BEGINS_S + EVERY_S], abs=0.02)  # two ticks


TOLERANCE_M = 3e-4
GOOD, BENT = 5e-5, 2e-3
POSES = 27
STRUCK_S = 1500.0
PLAN = replace(MIDWORK, hours=1.0, incidents=(Incident(STRUCK_S, "collision", 2.0),))


def shift(size_m, plan=PLAN):
    """Passes after each gap; ``size_m`` of a pass's end and cycle: its error, None: refused."""
    record = ShiftRecord(plan, seed=1)
    for cycle, begin_s in enumerate(plan.begins_s, start=1):
        for number in range(1, 4):
            time_s = begin_s + plan.gap_s + number * (PASS_S + REST_S)
            if time_s > plan.hours * HOUR_S:
                break
            size = size_m(time_s, cycle)
            error = None if size is None else np.tile([0.0, 0.0, size], (POSES, 1))
            record.passes.append(Judged(time_s, cycle, error, None))
    return record


def begin_of(cycle):
    return PLAN.begins_s[cycle - 1]


def always(size_m):
    return shift(lambda time_s, cycle: size_m)


def until_gap(cycle_of_recovery, size_m=BENT):
    """Struck, and right again after a gap."""
    return shift(lambda t, cycle: size_m if t > STRUCK_S and cycle < cycle_of_recovery else GOOD)


# ---- harm ----------------------------------------------------------------------------------------


def test_harm_is_the_difference_to_the_shift_without_the_suite():
    found = harm(always(9e-5), always(5e-5))
    assert (found.rms_m, found.p99_m, found.cycle_m) == pytest.approx((4e-5, 4e-5, 4e-5))
    assert found.refused == 0


def test_the_worst_cycle_is_not_averaged_away():
    one_bad = shift(lambda t, cycle: 3e-4 if cycle == 4 else GOOD)
    found = harm(one_bad, always(GOOD))
    assert found.cycle_m == pytest.approx(2.5e-4)
    assert found.rms_m < found.cycle_m / 4.0


def test_a_cycle_before_the_fault_is_not_its_worst():
    one_bad = shift(lambda t, cycle: 3e-4 if cycle == 1 else GOOD)
    assert harm(one_bad, always(GOOD), after=1).cycle_m == pytest.approx(0.0, abs=1e-12)
    stood = shift(lambda t, cycle: GOOD if cycle == 1 else None)
    assert np.isnan(harm(stood, always(GOOD), after=1).cycle_m)


def test_refused_passes_are_counted():
    half = shift(lambda t, cycle: None if cycle % 2 else GOOD)
    found = harm(half, always(GOOD))
    assert found.refused == sum(one.cycle % 2 for one in half.passes)
    assert found.rms_m == pytest.approx(0.0, abs=1e-12)


def test_a_suite_that_refuses_everything_misses_the_goals_of_a_clean_shift():
    nothing = always(None)
    assert harm(nothing, always(GOOD)).refused == len(nothing.passes)
    table = tables.harm_table({"default": [(nothing, always(GOOD))]})
    assert not table.met
    json.dumps(table.document(), allow_nan=False)


@pytest.mark.parametrize(
    ("with_suite", "met"),
    [
        (always(GOOD + 2e-5), True),
        (always(GOOD + 4e-5), False),
        (shift(lambda t, cycle: None if begin_of(4) < t < begin_of(4) + 200.0 else GOOD), False),
        (shift(lambda t, cycle: GOOD + 1e-4 if cycle == 1 else GOOD - 1e-5), False),
    ],
    ids=["within", "rms", "one refused", "99 %"],
)
def test_the_goals_of_a_clean_shift(with_suite, met):
    assert tables.harm_table({"default": [(with_suite, always(GOOD))]}).met is met


# ---- recovery ------------------------------------------------------------------------------------


def test_the_plan_is_struck_between_two_gaps():
    assert GOLDEN.begins_s[32] == MIDWORK.incidents[0].at_s  # the bag's falls on a gap's begin
    for incident in (*MIDWORK.incidents, *PLAN.incidents):
        plan = MIDWORK if incident in MIDWORK.incidents else PLAN
        since = [incident.at_s - begin_s for begin_s in plan.begins_s]
        assert min(one for one in since if one >= 0.0) > plan.gap_s


RELAPSED = shift(lambda t, cycle: BENT if t > STRUCK_S and cycle != 6 and cycle < 9 else GOOD)
REFUSING = shift(lambda t, cycle: None if cycle == 8 else BENT if STRUCK_S < t < 1800.0 else GOOD)
STRUCK_AGAIN = shift(
    lambda t, cycle: BENT if STRUCK_S < t < 1700.0 or t > 3000.0 else GOOD,
    replace(PLAN, incidents=(*PLAN.incidents, Incident(3000.0, "sensor_knocked", 1.0))),
)


@pytest.mark.parametrize(
    ("record", "gaps"),
    [
        pytest.param(until_gap(6), 1, id="right after the next gap"),
        pytest.param(until_gap(7), 2, id="a gap later"),
        pytest.param(always(GOOD), 0, id="what is not hurt needs none"),
        pytest.param(RELAPSED, 4, id="a good pass between bad ones is no recovery"),
        pytest.param(until_gap(99), PLAN.cycles, id="never right again"),
        pytest.param(until_gap(99, None), PLAN.cycles, id="refused for ever"),
        pytest.param(REFUSING, 4, id="a refused pass is no recovery"),
        pytest.param(STRUCK_AGAIN, 1, id="the next incident is not the first one's"),
    ],
)
def test_gaps_until_it_is_right_again(record, gaps):
    assert gaps_to_recover(record, STRUCK_S, TOLERANCE_M) == gaps


# ---- share below 0.1 mm --------------------------------------------------------------------------


def test_what_is_produced_from_an_incident_to_the_next_gap_counts():
    record = until_gap(6)
    bad = sum(STRUCK_S < one.time_s < begin_of(6) for one in record.passes)
    assert bad == 2
    within = 1.0 - bad / len(record.passes) / 3  # one direction in three is off
    assert per_hour(record)[0].within == pytest.approx(within)


def test_at_worst_all_passes_between_two_gaps_are_bad():
    record = until_gap(6)
    within = 1.0 - 3 / len(record.passes) / 3
    assert within_at_worst(record, STRUCK_S) == pytest.approx(within)


def test_refused_passes_are_told_by_hour():
    two_hours = replace(PLAN, hours=2.0)
    record = shift(lambda t, cycle: None if cycle in (14, 15) else GOOD, two_hours)
    assert (refused(record, {0}), refused(record, {1}), refused(record, {0, 1})) == (0, 6, 6)


def test_an_hour_in_which_all_is_refused_misses_its_goal():
    plan = replace(PLAN, hours=2.0)
    nothing = shift(lambda t, cycle: None if t > HOUR_S else GOOD, plan)
    assert not tables.hours_table([(nothing, shift(lambda t, cycle: GOOD, plan))]).met


@pytest.mark.parametrize("first", [0, 1])
def test_an_hour_with_an_incident_in_which_all_is_refused_misses_its_goal(first):
    struck_hour = MIDWORK.incidents[0].at_s // HOUR_S
    nothing = shift(lambda t, cycle: None if t // HOUR_S == struck_hour else GOOD, MIDWORK)
    records = [nothing, shift(lambda t, cycle: GOOD, MIDWORK)]
    for record in records:
        record.gaps.append(GapReport())
    if first:
        records.reverse()
    table = tables.shift_table([(record, record) for record in records])
    named = {row[0]: row[2] for row in table.rows}
    assert not named["least share below 0.1 mm, hour with collision, %"].met
    assert named["least share below 0.1 mm, hours without an incident, %"].met


def test_at_worst_a_refused_pass_before_an_incident_is_outside():
    refused_before = shift(
        lambda t, cycle: None if cycle == 5 and t > STRUCK_S else BENT if cycle == 5 else GOOD
    )
    passes = refused_before.passes
    of_hit = sum(one.cycle == 5 for one in passes)
    assert within_at_worst(refused_before, STRUCK_S) == pytest.approx(1.0 - of_hit / len(passes))


def test_at_worst_an_incident_before_the_first_pass_is_told():
    assert within_at_worst(always(GOOD), 1.0) == 1.0
    assert within_at_worst(always(None), 1.0) == 0.0


@pytest.mark.parametrize("faults", [0, 1])
def test_a_drive_fault_misses_its_goal(faults):
    records = [shift(lambda t, cycle: GOOD, MIDWORK) for _ in range(2)]
    for record in records:
        record.gaps.append(GapReport())
        record.peak_share = 0.8
    records[1].drive_faults = faults
    table = tables.shift_table([(record, record) for record in records])
    named = {row[0]: row for row in table.rows}
    assert named["drive faults"][2].met is (faults == 0)
    assert named["greatest joint speed commanded, % of its drive's"][1] == 80.0


# ---- faults -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        (Code.NO_SIGNIFICANT_GAIN, Code.ACCEPT, ("fixture", Code.ACCEPT, 1.0)),
        (Code.NO_SIGNIFICANT_GAIN, Code.NO_SIGNIFICANT_GAIN, ("", Code.NONE, 2.0)),
        (Code.NONE, Code.SENSOR_OR_ROBOT_MOVED, ("fixture", Code.SENSOR_OR_ROBOT_MOVED, 2.0)),
        (Code.ACCEPT, Code.ACCEPT, (ALARM, Code.ACCEPT, 2.0)),
    ],
)
def test_a_fixture_that_moved_is_told_by_its_own_measurement(before, after, told):
    trial = Trial("fixture_moved", 0.5, 3, gaps=1)
    made = replace(always(GOOD), plan=trial.plan)
    results = [CycleResult("c", Code.ACCEPT, fixture_code=code) for code in (before, after)]
    said = replace(made, gaps=[GapReport(result) for result in results])
    report = report_of(trial, said, made)
    assert (report.who, report.code, report.gaps) == told


@pytest.mark.long
def test_a_fixture_that_moved_is_told_in_one_gap():
    """Taught, a clean gap, moved, a gap: with drift and tool in all of them."""
    trial = Trial("fixture_moved", 0.5, seed=3, gaps=1)
    report = report_of(trial, *(run_shift(trial.plan, seed=3, suite=s) for s in (True, False)))
    assert (report.who, report.code, report.gaps) == ("fixture", Code.ACCEPT, 1.0)
    assert report.over_s <= 0.0
    assert report.drive_faults == 0
