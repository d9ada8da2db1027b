# SPDX-License-Identifier: Apache-2.0
"""Whether commands are corrected with what is in force, by what the correction says of itself."""

from dataclasses import replace

import pytest

from robocal_ros.correction.interface import CorrectionState, ToldCorrection, uncorrected
from robocal_ros.history.history_records import THERMAL, TOOL, Head

NOMINAL, TAUGHT = Head(THERMAL, 0, None, None), Head(TOOL, 0, None, None)
MODEL, BENT = Head(THERMAL, 4, 17, {}), Head(TOOL, 2, 18, {})
BACK = Head(TOOL, 3, None, None)  # rolled back to the taught one
ON = ToldCorrection(state=CorrectionState.ON, enabled=True, model_revision=4, tool_revision=2)
OFF = replace(ON, state=CorrectionState.OFF, enabled=False)
WITHOUT = replace(ON, state=CorrectionState.WITHOUT_MODEL, model_revision=0, tool_revision=0)
SHADOW = replace(ON, shadow=True)
MISMATCH = replace(ON, state=CorrectionState.MISMATCH, mismatch="joint_a1 is 2 deg beside")
RIVAL = "planner publishes arm/joint_trajectory"
OTHER = replace(ON, state=CorrectionState.OTHER_COMMANDER, commanders=RIVAL)


def test_a_correction_with_what_is_in_force_is_right():
    assert uncorrected(ON, MODEL, BENT) == ""
    blends = replace(ON, state=CorrectionState.BLENDING)
    assert uncorrected(blends, MODEL, BENT) == ""


def test_in_each_state_the_line_reads_whether_commands_are_corrected():
    off = CorrectionState.OFF
    told = {
        state: replace(OTHER, state=state, enabled=state is not off) for state in CorrectionState
    }
    said = {state: uncorrected(told[state], MODEL, BENT) for state in CorrectionState}
    right = {state for state, words in said.items() if not words}
    # LEASED: the program's commands are refused
    assert right == {CorrectionState.ON, CorrectionState.BLENDING, CorrectionState.LEASED}
    other = said[CorrectionState.OTHER_COMMANDER]
    assert other == f"joint_correction_node puts nothing out, {RIVAL}: end them"


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (None, "silent: start it"),
        (OFF, "joint_correction_node is OFF: call ~/enable"),
        (replace(OFF, state=CorrectionState.BLENDING), "is OFF: call ~/enable"),
        (SHADOW, "shadow mode"),
        (WITHOUT, "wire its inputs"),
        (MISMATCH, "joint_a1 is 2 deg beside: see where the robot stands, call ~/acknowledge"),
        (OTHER, RIVAL),
        (replace(OTHER, enabled=False), RIVAL),
        (replace(ON, stale="model revision 4 is 90 s old, allowed 60 s"), "90 s old"),
        (replace(WITHOUT, stale="model revision 4 is 90 s old, allowed 60 s"), "90 s old"),
    ],
    ids=str,
)
def test_nothing_is_right_that_does_not_correct_what_must_be(told, words):
    assert words in uncorrected(told, MODEL, BENT)
    assert words in uncorrected(told, MODEL, BENT, follows=True)  # no news explains it


@pytest.mark.parametrize(
    "told", [None, OFF, SHADOW, MISMATCH, OTHER, replace(WITHOUT, enabled=True)]
)
def test_the_nominal_model_and_the_taught_tool_need_no_correction(told):
    assert uncorrected(told, NOMINAL, TAUGHT) == ""


def test_another_model_or_tool_than_in_force_is_told_with_what_was_refused():
    refusal = "the tool's change exceeds its bound: 5.0 mm and 4.2 deg from the taught tool"
    told = replace(ON, tool_revision=1, last_refusal=refusal)
    words = uncorrected(told, MODEL, BENT)
    assert "corrects with tool revision 1, in force is revision 2" in words
    assert refusal in words
    assert uncorrected(told, MODEL, BENT, follows=True) == ""
    model = uncorrected(replace(ON, model_revision=0), MODEL, BENT)
    assert (
        "thermal model revision 0, in force is revision 4: wire its input kinematic_model" in model
    )
    both = uncorrected(replace(ON, model_revision=3, tool_revision=1), MODEL, BENT)
    assert "thermal model" in both
    assert "; joint_correction_node corrects with tool" in both


def test_a_tool_that_waits_for_a_standstill_is_told_so():
    told = replace(ON, tool_revision=1, waiting_tool_revision=2, last_refusal="an old one")
    assert "waits until the robot stands" in uncorrected(told, MODEL, BENT)


def test_what_was_rolled_back_must_not_be_corrected_with_any_more():
    assert "tool revision 2, in force is revision 3" in uncorrected(ON, MODEL, BACK)
    assert "tool revision 2, in force is revision 0" in uncorrected(
        ON, MODEL, TAUGHT
    )  # a lost history
    assert uncorrected(replace(ON, tool_revision=3), MODEL, BACK) == ""
    assert uncorrected(replace(ON, tool_revision=0), MODEL, BACK) == ""  # it never heard of any
    assert "model revision 4, in force is revision 0" in uncorrected(ON, NOMINAL, BENT)
    assert uncorrected(OFF, NOMINAL, BACK) == ""


def test_a_model_that_is_too_old_does_not_matter_where_none_is_in_force():
    told = replace(ON, model_revision=0, stale="model revision 0 is 90 s old, allowed 60 s")
    assert uncorrected(told, NOMINAL, BENT) == ""
