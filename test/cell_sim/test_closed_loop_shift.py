"""When incidents befall a shift, and from when on they count."""

import numpy as np
import pytest

from bench.closed_loop.plant import AT_WORK, PASS_S, PROGRAMME, REST_S
from bench.closed_loop.shift import Incident, ShiftPlan, run_shift

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


@pytest.mark.parametrize("at_s", [BEGINS_S, BEGINS_S - 20.0])
def test_a_collision_in_a_gap_befalls_the_whole_pass_after_it(at_s):
    _, hit, _ = run_shift(plan(Incident(at_s, "collision", 2.0)), seed=3, suite=False).passes
    assert sizes(hit).min() > TOOL_M


def test_gaps_and_passes_begin_where_they_are_planned():
    made = run_shift(plan(), seed=3, suite=False)
    assert [one.cycle for one in made.passes] == [0, 1, 2]
    begins_s = [one.time_s - PASS_S - REST_S for one in made.passes]
    assert begins_s == pytest.approx([0.5, BEGINS_S, BEGINS_S + EVERY_S], abs=0.02)  # two ticks
