# SPDX-License-Identifier: Apache-2.0
"""The table of the fault checks can miss its goals; it says what was told of smaller faults."""

from dataclasses import replace
from math import comb

import pytest

from bench.closed_loop.checks import (
    CELLS,
    FIRST,
    MISSES,
    SEEN_BY_CHECK,
    SEEN_BY_CYCLE,
    SEEN_BY_FULL,
    Checked,
    healthy_table,
    power_table,
    still_open,
)
from bench.closed_loop.faults import ONLY_BY, RIGHT, SWEEP, Report, Trial, least_power, proven
from bench.closed_loop.judging import Harm
from bench.closed_loop.tables import detection_table, faults_table
from robocal_ros.cell_sim.faults import SIZES
from robocal_ros.ground.errors import Code

TRIED = (*SEEN_BY_CHECK, *SEEN_BY_FULL, *SEEN_BY_CYCLE)


def found(fault, code_of, cells=CELLS):
    """``code_of`` a size and a cell."""
    return [
        Checked(Trial(fault, size, cell), code_of(size, cell))
        for cell in range(cells)
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
    assert table.texts()[0][4] == ""


def test_every_fault_with_a_code_is_tried():
    """One that the fixture's gaps tell is swept by bench/fixture.py."""
    by_fixture = {fault for fault, by in ONLY_BY.items() if by == "fixture"}
    assert set(RIGHT) == {*TRIED, *by_fixture}


@pytest.mark.parametrize(("missed", "met"), [(MISSES, True), (MISSES + 1, False)])
@pytest.mark.parametrize("fault", TRIED)
def test_a_fault_that_is_missed_in_too_many_cells_to_prove_its_power_misses_it(fault, missed, met):
    table = power_table(
        found(fault, lambda size, cell: Code.ACCEPT if cell < missed else RIGHT[fault])
    )
    assert table.met is met


def test_each_of_a_count_must_be_told():
    table = power_table(
        found(
            "frozen_encoder",
            lambda joint, cell: (
                Code.ACCEPT if (joint, cell % 10) == (6, 1) else RIGHT["frozen_encoder"]
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


@pytest.mark.parametrize("fault", TRIED)
def test_another_alarm_before_a_fault_says_nothing_of_its_power(fault):
    """It is counted among those of the healthy cells."""
    told = [
        replace(one, before=Code.RESIDUAL_TOO_LARGE)
        for one in found(fault, lambda size, cell: RIGHT[fault])
    ]
    assert power_table(told).met
    assert RIGHT[fault] is not Code.RESIDUAL_TOO_LARGE


def test_what_is_told_of_smaller_faults_is_said():
    table = power_table(
        found("collision", lambda s, cell: Code.LIMIT_EXCEEDED if s >= 0.3 else Code.ACCEPT)
    )
    _, _, tried, smallest, below, least, _ = table.texts()[0]
    assert "0.2 mm: 0/46, 0.3 mm: 46/46" in tried
    assert (smallest, below, least) == ("0.3 mm", "ACCEPT 92", "93.695")


def test_a_size_that_cannot_be_proven_is_tried_in_the_first_cells_alone():
    """Nor is a smaller one; the larger ones, and all of a count, are."""
    first = found(
        "collision",
        lambda size, cell: Code.ACCEPT if size == 0.3 and cell < 2 else Code.LIMIT_EXCEEDED,
        FIRST,
    ) + found("frozen_encoder", lambda size, cell: Code.ACCEPT, FIRST)
    left = still_open(first)
    assert left["collision"] == [size for size in SWEEP["collision"] if size > 0.3]
    assert left["frozen_encoder"] == [*SWEEP["frozen_encoder"]]
    once = found("collision", lambda s, cell: Code.LIMIT_EXCEEDED if cell else Code.ACCEPT, FIRST)
    assert still_open(once) == still_open([]) == {f: [*sizes] for f, sizes in SWEEP.items()}


@pytest.mark.parametrize(("right", "cells"), [(9, 10), (10, 10), (45, 46), (46, 46), (44, 46)])
def test_so_few_cells_prove_less_than_they_show(right, cells):
    """By the definition: with this power so many cells or more are right in one case of twenty."""
    rights = [cell < right for cell in range(cells)]
    p = least_power(rights)
    tail = sum(comb(cells, k) * p**k * (1.0 - p) ** (cells - k) for k in range(right, cells + 1))
    assert tail == pytest.approx(0.05, abs=1e-8)
    assert proven(rights) is (cells == CELLS and cells - right <= MISSES)


def test_there_are_no_more_cells_than_a_proof_takes():
    assert proven([False] * MISSES + [True] * (CELLS - MISSES))
    assert not proven([False] * MISSES + [True] * (CELLS - MISSES - 1))


def test_no_cell_that_is_right_proves_nothing():
    assert least_power([False] * CELLS) == 0.0


def test_the_table_of_detection_says_what_its_seeds_prove():
    """A report of each seed at two sizes; the smaller one is told in one of them alone."""
    harmless = Harm(0.0, 0.0, 0.0, 0)
    reports = [
        Report(Trial("collision", size, seed), "tool", RIGHT["collision"], gaps, harmless, 0.0, 0)
        for size, missed in ((0.2, 9), (2.0, 0))
        for seed in range(10)
        for gaps in (3.0 if seed < missed else 1.0,)
    ]
    (row,) = detection_table(reports).texts()
    assert row == ["collision", "0.2 mm, 2 mm", "2 mm", "74.113", "LIMIT_EXCEEDED"]
    assert faults_table(reports).rows


@pytest.mark.parametrize(("alarms", "met"), [(0, True), (1, False)])
def test_an_alarm_without_a_fault_is_a_missed_goal(alarms, met):
    """One check, or measurement, before all sizes of a fault, in each of ten cells."""
    told = [
        replace(one, before=Code.LIMIT_EXCEEDED if one.trial.seed < alarms else Code.ACCEPT)
        for fault in ("collision", "station_knocked", "sphere_knocked")
        for one in found(fault, lambda size, cell, code=RIGHT[fault]: code, cells=10)
    ]
    rows = healthy_table(told).texts()
    assert [row[1] for row in rows] == ["10", "10", str(10 * len(SWEEP["sphere_knocked"]))]
    assert healthy_table(told).met is met
