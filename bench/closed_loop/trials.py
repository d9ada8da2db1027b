# SPDX-License-Identifier: Apache-2.0
"""Many shifts on all cores; those that begin alike begin once.

Trials of a seed differ in what goes wrong, and in nothing before that. One process works until
then, and forks: each child goes on from its memory with an incident of its own, and sends what
came of it back. So nothing has to be copied or read back, and a trial is what it is when it is
run whole (test/cell_sim/test_shared_trials.py).
"""

import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np

from bench.closed_loop.plant import own_history
from bench.closed_loop.shift import ShiftPlan, ShiftRecord, Worker, begun, run_shift

Job = tuple[ShiftPlan, int, bool]
"""A shift, its seed, and whether the suite is there."""

FORK = get_context("fork")


class TrialError(Exception):
    """A trial failed in its child; names it and says why."""


def run_all(pool: Executor, jobs: Iterable[Job]) -> dict[Job, ShiftRecord]:
    """What came of each job, on all cores of a pool whose processes have one thread each.

    Raises `TrialError`.
    """
    alike: dict[Job, list[ShiftPlan]] = {}
    for plan, seed, suite in dict.fromkeys(jobs):
        alike.setdefault((replace(plan, incidents=()), seed, suite), []).append(plan)
    # The longest first, so that no core is left with one at the end.
    groups = sorted(alike.items(), key=lambda one: one[0][2] * one[0][0].cycles * len(one[1]))
    running = [
        (plans, seed, suite, pool.submit(run_alike, plans, seed, suite))
        for (_, seed, suite), plans in reversed(groups)
    ]
    return {
        (plan, seed, suite): record
        for plans, seed, suite, ran in running
        for plan, record in zip(plans, ran.result(), strict=True)
    }


def run_alike(plans: Sequence[ShiftPlan], seed: int, suite: bool) -> list[ShiftRecord]:
    """Shifts of one seed whose plans differ in their incidents alone.

    Raises `TrialError`.
    """
    if len(plans) == 1:
        return [run_shift(plans[0], seed, suite)]
    struck_s = min((one.at_s for plan in plans for one in plan.incidents[:1]), default=np.inf)
    with begun(replace(plans[0], incidents=()), seed, suite) as worker:
        worker.work(struck_s)
        if worker.plant.suite is not None:
            worker.plant.suite.history.close()
        return [_in_child(partial(_rest, worker, plan), _named(plan, seed)) for plan in plans]


def _rest(worker: Worker, plan: ShiftPlan) -> ShiftRecord:
    """Go on to the end of a plan, in a child."""
    suite = worker.plant.suite
    worker.go_on_with(plan)
    with nullcontext() if suite is None else own_history(suite):
        return worker.work()


def _named(plan: ShiftPlan, seed: int) -> str:
    return f"seed {seed}, " + ", ".join(f"{one.fault} {one.size:g}" for one in plan.incidents)


def _in_child(work: Callable[[], ShiftRecord], name: str) -> ShiftRecord:
    """What a call returns in a child that begins with all that this process holds."""
    receiver, sender = FORK.Pipe(duplex=False)
    child = FORK.Process(target=_send, args=(sender, work))
    child.start()
    sender.close()
    try:
        answer = receiver.recv()  # before join: a child waits until its record is taken
    except EOFError:
        child.join()
        raise TrialError(f"{name}: its process ended by itself, exit {child.exitcode}") from None
    child.join()
    receiver.close()
    if isinstance(answer, ShiftRecord):
        return answer
    raise TrialError(f"{name}: {answer}")


def _send(sender: Connection, work: Callable[[], ShiftRecord]) -> None:
    try:
        answer: ShiftRecord | str = work()
    except Exception:
        answer = traceback.format_exc()
    sender.send(answer)
