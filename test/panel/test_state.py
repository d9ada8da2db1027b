# SPDX-License-Identifier: Apache-2.0
"""What the page shows, from what nodes say: fresh, finite, bounded, and the right thing to do."""

import json
import math
import tracemalloc
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from panel_faults import SENDS_TO, heard, told, wrongly_told
from panel_page import NOTHING, accuracy, ended, status

from bench.closed_loop.faults import RIGHT
from robocal_ros.correction.interface import CorrectionState, ToldCorrection, uncorrected
from robocal_ros.ground.errors import Code
from robocal_ros.history.history_records import THERMAL, TOOL, Head
from robocal_ros.panel.state import (
    ACCURACY,
    BUCKET_S,
    CORRECTION,
    CORRECTIONS,
    FIXTURE,
    GAPS,
    LONGEST_TEXT,
    POINTS,
    SHIFT_S,
    SILENT_S,
    STATUS,
    STEPS,
    PanelState,
)

NOW_S = 100.0


def shown(**sources):
    panel = PanelState()
    heard(panel, {ACCURACY: accuracy(), STATUS: status()} | sources, NOW_S)
    return panel


def keys(panel, now_s=NOW_S):
    return [task.key for task in panel.tasks(now_s)]


# ---- never old as new ---------------------------------------------------------------------------


def test_one_latched_message_says_nothing_of_whether_its_node_lives():
    panel = PanelState()
    for _ in range(2):  # of each source, and the same one once more
        for name, values in {ACCURACY: accuracy(), STATUS: status()}.items():
            panel.show(name, values, 1, NOW_S, 1e9)
    assert panel.headline(NOW_S) == "SILENT"
    shown = panel.document(NOW_S, 1e9)
    assert (shown["bound_mm"], shown["age_s"], shown["maintenance"]) == (None, None, None)
    assert not panel.curve.points
    panel.show(STATUS, status(), 2, NOW_S, 1e9)
    assert panel.headline(NOW_S) == "SILENT"
    panel.show(ACCURACY, accuracy(), 2, NOW_S, 1e9)
    assert panel.headline(NOW_S) == "OK"


@pytest.mark.parametrize("silent", [ACCURACY, STATUS])
def test_what_falls_silent_is_not_shown_on(silent):
    panel = shown()
    end_s = NOW_S + SILENT_S[silent]
    talks = ({ACCURACY, STATUS} - {silent}).pop()
    panel.show(talks, accuracy() if talks == ACCURACY else status(), 3, end_s, 1e9)
    assert panel.headline(end_s) == "OK"
    assert panel.document(end_s, 1e9)["age_s"] == SILENT_S[silent]
    late_s = end_s + 0.01
    assert panel.headline(late_s) == "SILENT"
    assert keys(panel, late_s) == ["state/SILENT"]
    assert panel.document(late_s, 1e9)["error_mm"] is None


number = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True), st.sampled_from([-1.0, 0.0, math.nan])
)


@given(number, number, number, number, number, st.integers(0, 255), st.integers(0, 255))
def test_no_figure_that_is_none_leaves(error, bound, allowed, due, left, level, code):
    figures = {"predicted_error_mm": error, "bound_mm": bound, "tolerance_mm": allowed}
    told = status(left_s=left, fault_code=code, last=ended(code=code, tool_code=code))
    panel = shown(
        **{ACCURACY: accuracy(state=level, due_in_s=due, **figures), STATUS: told},
    )
    document = panel.document(NOW_S, 1e9)
    json.dumps([document, [*panel.curve.points]], allow_nan=False)
    for name, given_one in (("error_mm", error), ("bound_mm", bound), ("tolerance_mm", allowed)):
        is_known = math.isfinite(given_one) and given_one >= 0.0
        assert document[name] == (given_one if is_known else None)


def test_a_number_of_a_later_version_is_the_worst_and_calls_the_engineer():
    assert shown(**{ACCURACY: accuracy(state=77)}).headline(NOW_S) == "FAULT"
    assert keys(shown(**{STATUS: status(fault_code=200)}))[0] == Code.BAD_INPUT.name


# ---- the right thing to do ----------------------------------------------------------------------


def by_whom(fault):
    """How maintenance_node tells a fault's code (docs/maintenance_node.md)."""
    code = int(RIGHT[fault])
    stopped = {"state": "FAULT", "fault_code": code, "fault": fault}
    as_fault = status(**stopped, last=ended(code=code, tool_code=0, tool_found_code=0))
    as_tool = status(last=ended(tool_found_code=code, tool_code=code))
    as_drift = status(last=ended(thermal_code=code))
    if RIGHT[fault] is Code.SENSOR_OR_ROBOT_MOVED:
        return [as_drift]
    if fault == "fixture_moved":  # by fixture_node itself
        return [status(last=ended(), fixture_pending=9)]
    if fault == "frozen_encoder":  # tcf_node stops the robot, which left its plan: a FAULT
        both = ended(code=code, tool_code=code, tool_found_code=code)
        return [as_fault, status(**stopped, last=both)]
    return [as_tool] + ([as_fault] if RIGHT[fault] is Code.TOO_FEW_SAMPLES else [])


@pytest.mark.parametrize("fault", RIGHT)
def test_each_fault_of_the_simulator_leads_to_what_has_it(fault):
    for said in by_whom(fault):
        panel = shown(**{STATUS: said, ACCURACY: accuracy("DEGRADED")})
        if fault == "fixture_moved":
            heard(panel, {FIXTURE: verdict(Code.ACCEPT, 9), STATUS: said}, NOW_S)
        assert not wrongly_told(fault, panel, NOW_S)


def test_each_fault_that_must_be_told_has_its_place():
    assert SENDS_TO.keys() == RIGHT.keys()


@pytest.mark.parametrize("what", ["tool: beam station", "tool: tool measurement (full)", "fixture"])
def test_a_gap_that_is_too_short_for_what_is_due_is_told_until_one_is_not(what):
    short = f"tool: pass; {what}: the gap is 12.0 s too short, one of 120 s would do"
    panel = shown(**{STATUS: status(last=ended(message=short, complete=False))})
    assert keys(panel) == ["LIMIT_EXCEEDED/gap"]
    assert panel.tasks(NOW_S)[0].detail == short
    done = ended(message="tool: pass", cycle_id="next")
    heard(panel, {ACCURACY: accuracy(), STATUS: status(last=done)}, NOW_S)
    assert keys(panel) == ["state/OK"]


def verdict(code, candidate_id=0):
    """What fixture_node says once of a measurement."""
    return {"code": int(code), "candidate_id": candidate_id, "reason": f"{code.name} in words"}


def test_a_fixture_that_moved_is_told_until_a_person_has_decided():
    waits = status(fixture_pending=9)
    panel = shown(**{FIXTURE: verdict(Code.ACCEPT, 9), STATUS: waits})
    assert not wrongly_told("fixture_moved", panel, NOW_S)
    assert keys(panel) == ["ACCEPT/fixture"]
    assert panel.tasks(NOW_S)[0].detail == "ACCEPT in words"
    later_s = NOW_S + 1e5  # it is said once, and stays; the others go on
    heard(panel, {ACCURACY: accuracy(), STATUS: waits}, later_s)
    assert not wrongly_told("fixture_moved", panel, later_s)
    assert panel.document(later_s, 1e9)["waiting"] == [9]
    heard(panel, {ACCURACY: accuracy(), STATUS: status()}, later_s)
    assert keys(panel, later_s) == ["state/OK"]


def test_a_fixture_that_waits_since_before_the_panel_started_is_told_as_what_waits():
    """Also where the verdict that is heard is of another one, measured meanwhile."""
    assert keys(shown(**{STATUS: status(fixture_pending=9)})) == ["state/DECIDE"]
    halted = status("FAULT", fixture_pending=9, fault_code=10, fault="left its plan")
    assert keys(shown(**{FIXTURE: verdict(Code.ACCEPT, 9), STATUS: halted}))[1] == "state/DECIDE"
    other = shown(**{FIXTURE: verdict(Code.NO_SIGNIFICANT_GAIN), STATUS: status(fixture_pending=9)})
    assert keys(other) == ["state/DECIDE"]


@pytest.mark.parametrize(
    "code", [Code.SENSOR_OR_ROBOT_MOVED, Code.RESIDUAL_TOO_LARGE, Code.POSES_NOT_INFORMATIVE]
)
def test_what_is_not_the_fixture_has_words_of_its_own(code):
    assert keys(shown(**{FIXTURE: verdict(code, 9)}))[0] == f"{code.name}/fixture"
    assert keys(shown(**{FIXTURE: verdict(Code.NO_SIGNIFICANT_GAIN)})) == ["state/OK"]


def test_a_bent_tool_is_told_until_a_gap_has_measured_it_or_it_is_mended():
    bent = ended("a", tool_found_code=10, tool_code=10, tool_id=5)
    panel = shown(**{STATUS: status(last=bent, tool_pending=5)})
    assert keys(panel)[:2] == ["LIMIT_EXCEEDED/tool", "state/DECIDE"]
    unmeasured = ended("b", tool_code=0)
    panel.show(STATUS, status(last=unmeasured), 3, NOW_S, 1e9)
    assert keys(panel)[0] == "LIMIT_EXCEEDED/tool"
    panel.in_force = frozenset({5})  # a person accepted it
    assert keys(panel)[0] == "LIMIT_EXCEEDED/tool mended"
    panel.show(STATUS, status(last=ended("c")), 4, NOW_S, 1e9)
    assert keys(panel) == ["state/OK"]
    mended = ended("d", tool_found_code=10, tool_code=1, tool_id=7, accepted=[7])
    panel.show(STATUS, status(last=mended), 5, NOW_S, 1e9)
    assert keys(panel)[0] == "LIMIT_EXCEEDED/tool mended"


def test_beams_that_were_not_found_again_are_told_until_they_are():
    lost = ended("a", station_code=6)
    panel = shown(**{STATUS: status(last=lost)})
    assert keys(panel) == ["RESIDUAL_TOO_LARGE"]
    panel.show(STATUS, status(last=ended("b")), 3, NOW_S, 1e9)  # they were not looked for
    assert keys(panel) == ["RESIDUAL_TOO_LARGE"]
    panel.show(STATUS, status(last=ended("c", station_code=10)), 4, NOW_S, 1e9)
    assert keys(panel) == ["LIMIT_EXCEEDED/gap"]
    panel.show(STATUS, status(last=ended("d", station_code=1)), 5, NOW_S, 1e9)
    assert keys(panel) == ["state/OK"]


def test_while_the_robot_moves_the_one_thing_to_do_is_to_keep_away():
    for state in ("RUNNING", "BREAKING_OFF"):
        said = status(state, cycle_id="x", doing="on its way home", last=ended(tool_code=15))
        panel = shown(**{STATUS: said})
        assert keys(panel) == [f"state/{state}"]
        assert panel.headline(NOW_S) == state


def test_of_a_correction_only_what_stops_or_what_it_spoils_is_told():
    def told(state, level="OK"):
        values = {"state": CORRECTIONS.index(state), "reason": "so"}
        return keys(shown(**{CORRECTION: values, ACCURACY: accuracy(level)}))[0]

    for well in ("BLENDING", "ON", "LEASED", "OFF", "WITHOUT_MODEL"):
        assert told(well) == "state/OK"
    for stops in ("MISMATCH", "OTHER_COMMANDER"):
        assert told(stops) == f"correction/{stops}"
    for spoils in ("OFF", "WITHOUT_MODEL"):
        assert told(spoils, "DEGRADED") == f"correction/{spoils}"


def test_no_gap_is_asked_for_where_the_correction_alone_is_amiss():
    """As accuracy_of of maintenance has it: its reason names the parts at the worst level."""
    in_force = Head(THERMAL, 4, 17, {}), Head(TOOL, 3, 18, {})
    on = ToldCorrection(state=CorrectionState.ON, enabled=True, model_revision=4, tool_revision=2)
    old = f"correction: {uncorrected(on, *in_force)}"
    degraded = accuracy("DEGRADED", reason=old)
    assert keys(shown(**{ACCURACY: degraded})) == ["state/UNCORRECTED"]
    for state, first in (("ON", []), ("OFF", ["correction/OFF"])):
        told = {"state": CORRECTIONS.index(state), "reason": ""}
        panel = shown(**{CORRECTION: told, ACCURACY: degraded})
        assert keys(panel) == [*first, "state/UNCORRECTED"]
    waits = uncorrected(replace(on, waiting_tool_revision=3), *in_force)
    stale = uncorrected(replace(on, stale="model revision 4 is 9 s old, allowed 8 s"), *in_force)
    for reason in (f"drift: below 0.4 mm; {old}", f"correction: {waits}", f"correction: {stale}"):
        assert keys(shown(**{ACCURACY: accuracy("DEGRADED", reason=reason)})) == ["state/DEGRADED"]


def test_a_gap_that_was_broken_off_is_measured_again():
    panel = shown(**{STATUS: status(last=ended(code=int(Code.CONFLICT)))})
    assert "again in the next gap" in told(panel, NOW_S)["en"]


@pytest.mark.parametrize("code", [Code.WRONG_ROBOT, Code.STORAGE_FAILED])
def test_what_the_next_gap_does_not_mend_calls_the_engineer(code):
    panel = shown(**{STATUS: status(last=ended(code=code))})
    assert keys(panel) == [f"{code.name}/gap"]
    assert "Call the engineer" in told(panel, NOW_S)["en"]


# ---- a gap, step by step ------------------------------------------------------------------------


def test_the_steps_of_a_gap_are_each_told_once_with_their_time():
    panel = shown()
    says = ["begins", "measuring pose 1 of 6", "tool measurement (quick)", "something new"]
    for i, doing in enumerate(says):
        for again in range(3):
            said = status("RUNNING", cycle_id="g", doing=f"{doing}; the disk is slow")
            panel.show(STATUS, said, 10 * i + again + 3, NOW_S, 1e9 + i)
    panel.show(STATUS, status(cycle_id="g", last=ended("g")), 99, NOW_S, 1e9 + 9.0)
    document = panel.document(NOW_S, 1e9)
    assert document["steps"] == [
        {"key": "begins", "numbers": [], "at_s": 1e9},
        {"key": "pose", "numbers": ["1", "6"], "at_s": 1e9 + 1},
        {"key": "check", "numbers": [], "at_s": 1e9 + 2},
        {"key": "other", "numbers": ["something new"], "at_s": 1e9 + 3},
    ]
    assert document["last"]["code"] == "ACCEPT"
    # the next one begins anew; one that was not seen has no steps
    panel.show(STATUS, status(cycle_id="h", last=ended("h")), 100, NOW_S, 1e9)
    assert panel.document(NOW_S, 1e9)["steps"] == []


# ---- bounds -------------------------------------------------------------------------------------


def shifts(panel, days, start_s):
    """Days with a gap each five minutes, of which each step and each message is another one."""
    stamp = round(start_s * 1e9)
    for minute in range(days * 24 * 60):
        wall_s, now_s = start_s + 60.0 * minute, start_s + 60.0 * minute
        for half in range(2):
            stamp += 1
            bound = 0.1 + 1e-6 * (minute % 1000)
            panel.show(ACCURACY, accuracy(bound_mm=bound), stamp, now_s, wall_s + 20.0 * half)
        if minute % 5 == 0:
            cycle = f"gap {minute}"
            for step in range(12):
                stamp += 1
                said = status(
                    "RUNNING", cycle_id=cycle, doing=f"new step {minute} {step} {'x' * 60}"
                )
                panel.show(STATUS, said, stamp, now_s, wall_s)
            last = ended(cycle, stamp_ns=round(wall_s * 1e9), left=[f"left {minute}"])
            panel.show(STATUS, status(cycle_id=cycle, last=last), stamp + 1, now_s, wall_s)
            stamp += 1
        panel.document(now_s, wall_s)


def test_a_page_that_is_open_for_days_holds_as_much_as_one_of_a_day():
    panel = PanelState()
    shifts(panel, 1, 1e9)
    tracemalloc.start()
    shifts(panel, 1, 1e9 + 86400.0)
    before = tracemalloc.get_traced_memory()[0]
    shifts(panel, 2, 1e9 + 2 * 86400.0)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert len(panel.curve.points) <= POINTS
    assert len(panel.gaps) == GAPS
    assert len(panel.steps) <= STEPS
    assert grown < 20_000  # a point of the curve has 300 bytes, a gap 1 kB
    shown = panel.document(1e9, 1e9 + 4 * 86400.0)
    assert len(json.dumps(shown)) < 30_000
    assert shown["shift"]["gaps"] <= SHIFT_S / 300.0 + 1


def test_the_curve_has_the_worst_of_each_minute_and_is_as_long_as_a_shift():
    panel = PanelState()
    start_s = 1e9 - 1e9 % BUCKET_S
    for k, (bound, level) in enumerate([(0.1, "OK"), (0.3, "DUE"), (0.2, "OK"), (0.15, "OK")]):
        values = accuracy(level, bound_mm=bound)
        panel.show(ACCURACY, values, k, NOW_S + k, start_s + 15.0 * k)
    assert [*panel.curve.points] == [[start_s, 0.08, 0.3, 2]]
    panel.show(ACCURACY, accuracy(bound_mm=-1.0), 9, NOW_S + 9, start_s + 59.0)
    assert panel.curve.points[-1][2] is None  # not known for a moment is not known
    panel.show(ACCURACY, accuracy(), 10, NOW_S + 10, start_s + SHIFT_S + BUCKET_S)
    assert len(panel.curve.points) == 1
    panel.show(ACCURACY, accuracy(), 11, NOW_S + 11, start_s)  # the clock was set back
    assert [point[0] for point in panel.curve.points] == [start_s]


def test_texts_are_cut():
    said = status("RUNNING", cycle_id="c", doing="x" * 10 * LONGEST_TEXT, last=NOTHING)
    panel = shown(**{STATUS: said})
    assert len(panel.steps[-1]["numbers"][0]) == LONGEST_TEXT
