# SPDX-License-Identifier: Apache-2.0
"""Trials that share their begin: each is as if run whole; one that fails or is killed is named."""

import os
import pickle
import signal
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import pytest
from long_form import amount, more

from bench.closed_loop.shift import Incident, ShiftPlan, Worker, run_shift
from bench.closed_loop.trials import TrialError, run_alike, run_all

SEED = 3
FAULTS = ("collision", *more("sensor_knocked", "frozen_clock"))
EVERY_S, SHARED_S = 160.0, amount(0.0, 160.0)  # after a commissioning, or a gap too
GAP_S = amount(65.0, 90.0)  # for drift and a check of the tool, or a full measurement too
EARLY, LATE = (Incident(at_s, "collision", 2.0) for at_s in (170.0, 330.0))
PLAN = ShiftPlan(hours=3.0 * EVERY_S / 3600.0, every_s=EVERY_S)


@pytest.mark.long
def test_a_trial_from_a_shared_begin_is_the_trial_run_whole():
    """Bit for bit: a child writes into a history of its own, and draws what the trial draws."""
    hours = (SHARED_S + EVERY_S) / 3600.0
    other, *plans = (  # the first must leave no trace
        replace(PLAN, hours=hours, gap_s=GAP_S, incidents=(Incident(SHARED_S, fault),))
        for fault in ("wrong_tool", *FAULTS)
    )
    _, *shared = run_alike([other, *plans], SEED, suite=True)
    for plan, record in zip(plans, shared, strict=True):
        assert pickle.dumps(record) == pickle.dumps(run_shift(plan, SEED))


@pytest.mark.long
def test_what_goes_wrong_at_different_times_is_shared_until_the_first():
    plans = [replace(PLAN, incidents=one) for one in ((), (EARLY, LATE), (LATE,))]
    jobs = [(plan, SEED, False) for plan in plans]
    jobs.insert(1, (plans[1], 4, False))  # of another seed, in between
    with ProcessPoolExecutor(1) as pool:
        found = run_all(pool, jobs)
    assert list(map(pickle.dumps, (found[job] for job in jobs))) == [
        pickle.dumps(run_shift(*job)) for job in jobs
    ]


@pytest.mark.parametrize(
    ("way", "words"),
    [
        (lambda: 1 / 0, "ZeroDivisionError"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "ended by itself, exit -9"),
    ],
)
def test_a_trial_that_fails_is_named(monkeypatch, way, words):
    go_on_with = Worker.go_on_with

    def failing(worker, plan):
        if plan.incidents == (LATE,):
            way()
        go_on_with(worker, plan)

    monkeypatch.setattr(Worker, "go_on_with", failing)
    plans = [replace(PLAN, incidents=(one,)) for one in (EARLY, LATE)]
    with pytest.raises(TrialError, match=rf"(?s)seed 3, collision 2: .*{words}"):
        run_alike(plans, SEED, suite=False)
