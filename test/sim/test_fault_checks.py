"""The table of the fault checks can miss its goals; it says what was told of smaller faults."""

from dataclasses import replace
from math import comb

import pytest

from bench.closed_loop.checks import (
    SEEN_BY_CHECK,
    SEEN_BY_CYCLE,
    Checked,
    healthy_table,
    power_table,
)
from bench.closed_loop.faults import RIGHT, SWEEP, Report, Trial, least_power
from bench.closed_loop.judging import Harm
from bench.closed_loop.tables import detection_table, faults_table
from robocal_ros.core.codes import Code
from robocal_ros.sim.cell_faults import SIZES

CELLS = range(10)
TRIED = (*SEEN_BY_CHECK, *SEEN_BY_CYCLE)


def found(fault, code_of):
    """``code_of`` a size and a cell."""
    return [
        Checked(Trial(fault, size, cell), code_of(size, cell))
        for cell in CELLS
        for size in SWEEP.get(fault, (0.0,))
    ]


@pytest.mark.parametrize("fault", TRIED)
def test_a_sweep_holds_the_usual_size_and_something_below_it(fault):
    if fault not in SIZES:
        assert fault not in SWEEP
        return
    assert SIZES[fault][0] in SWEEP[fault]
    assert min(SWEEP[fault]) < SIZES[fault][0]


@pytest.mark.parametrize("fault", TRIED)
def test_a_fault_that_is_always_told_meets_its_goal(fault):
    table = power_table(found(fault, lambda size, cell: RIGHT[fault]))
    assert table.met
    assert table.texts()[0][5] == ""


@pytest.mark.parametrize(("missed", "met"), [(1, True), (2, False)])
@pytest.mark.parametrize("fault", TRIED)
def test_a_fault_that_is_told_in_fewer_than_nine_of_ten_cells_misses_it(fault, missed, met):
    table = power_table(
        found(fault, lambda size, cell: Code.ACCEPT if cell < missed else RIGHT[fault])
    )
    assert table.met is met


def test_each_of_a_count_must_be_told():
    table = power_table(
        found(
            "frozen_encoder",
            lambda joint, cell: (
                Code.ACCEPT if (joint, cell % 2) == (6, 1) else RIGHT["frozen_encoder"]
            ),
        )
    )
    assert not table.met
    joints = [Trial("frozen_encoder", joint, 1) for joint in SWEEP["frozen_encoder"]]
    assert all(one.must_be_told for one in joints)


def test_another_code_is_not_the_right_one():
    assert not power_table(found("wrong_tool", lambda size, cell: Code.LIMIT_EXCEEDED)).met


@pytest.mark.parametrize("fault", SEEN_BY_CYCLE)
def test_who_always_tells_the_fault_misses_its_goal(fault):
    always = [replace(one, before=one.code) for one in found(fault, lambda s, cell: RIGHT[fault])]
    assert not power_table(always).met


def test_what_is_told_of_smaller_faults_is_said():
    table = power_table(
        found("collision", lambda s, cell: Code.LIMIT_EXCEEDED if s >= 0.3 else Code.ACCEPT)
    )
    _, _, tried, smallest, least, below, _, _ = table.texts()[0]
    assert "0.2 mm: 0/10, 0.3 mm: 10/10" in tried
    assert (smallest, least, below) == ("0.3 mm", "74.113", "ACCEPT 20")


@pytest.mark.parametrize(("right", "least"), [(0, 0.0), (9, 60.584), (10, 74.113)])
def test_so_few_cells_prove_less_than_they_show(right, least):
    """By the definition: with this power so many cells or more are right in one case of twenty."""
    trials = [(0.3, cell < right) for cell in CELLS] + [(2.0, True)] * 10
    found = least_power(trials, 0.3)
    assert found == pytest.approx(least, abs=1e-3)
    if right:
        p = found / 100.0
        tail = sum(comb(10, k) * p**k * (1.0 - p) ** (10 - k) for k in range(right, 11))
        assert tail == pytest.approx(0.05, abs=1e-6)
    assert least_power(trials, None) is None


def test_the_table_of_detection_says_what_its_seeds_prove():
    """A report of each seed at two sizes; the smaller one is told in one of them alone."""
    harmless = Harm(0.0, 0.0, 0.0, 0)
    reports = [
        Report(Trial("collision", size, seed), "tool", RIGHT["collision"], gaps, harmless, 0.0, 0)
        for size, missed in ((0.2, 9), (2.0, 0))
        for seed in CELLS
        for gaps in (3.0 if seed < missed else 1.0,)
    ]
    (row,) = detection_table(reports).texts()
    assert row == ["collision", "0.2 mm, 2 mm", "2 mm", "74.113", "LIMIT_EXCEEDED"]
    assert faults_table(reports).rows


@pytest.mark.parametrize(("alarms", "met"), [(0, True), (1, False)])
def test_an_alarm_without_a_fault_is_a_missed_goal(alarms, met):
    """One check before all sizes of a fault, in one of ten cells."""
    told = [
        replace(one, before=Code.LIMIT_EXCEEDED if one.trial.seed < alarms else Code.ACCEPT)
        for fault in ("collision", "sphere_knocked")
        for one in found(fault, lambda size, cell, code=RIGHT[fault]: code)
    ]
    checks, cycles = healthy_table(told).texts()
    assert (checks[1], cycles[1]) == ("10", str(10 * len(SWEEP["sphere_knocked"])))
    assert healthy_table(told).met is met
